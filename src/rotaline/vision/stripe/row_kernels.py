"""Grey gravity along rows and columns, in compiled loops. See :mod:`rotaline.vision.stripe.plain.rows`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.chain_kernels import window_mean

_UNDECIDED = 0.15  # difference of the normal's components
_SIDE = 3.0  # widths: the background begins, the window ends
_LEAST_SIDE = 2  # pixels
_PASSES = 3
_ROOT_2PI = np.sqrt(2.0 * np.pi)


@compiled
@no_type_check
def cross_lines(uv: np.ndarray, starts: np.ndarray, width_px: np.ndarray, normal: np.ndarray) -> tuple:
    """Where a curve crosses whole rows (where it is steep) or whole columns (where it is flat).

    Near 45 deg what held before goes on.

    Returns
    -------
    points, starts, widths as seen along the row or column, direction of the row or column, normals of the stripe
    """
    n = len(uv)
    balance, mean = np.empty(n), np.empty(n)
    for i in range(n):
        balance[i] = abs(normal[i, 0]) - abs(normal[i, 1])
    window_mean(balance, starts, 10, mean)
    most = int(2 * n + 2 * len(starts))
    points, own, along, wide = np.empty((most, 2)), np.empty((most, 2)), np.empty((most, 2)), np.empty(most)
    edges = np.empty(n + len(starts), np.int64)
    m, pieces = 0, 0
    for c in range(len(starts) - 1):
        begin = starts[c]
        steep = mean[begin] >= 0.0
        while begin < starts[c + 1]:
            stop = begin + 1
            later = steep
            while stop < starts[c + 1]:
                if abs(mean[stop]) > _UNDECIDED:
                    later = mean[stop] >= 0.0
                    if later != steep:
                        break
                stop += 1
            k = 1 if steep else 0
            sense = 1.0 if uv[stop - 1, k] >= uv[begin, k] else -1.0
            line = sense * uv[begin, k]
            whole = np.ceil(line)
            first = m
            for i in range(begin + 1, stop):
                after = max(line, sense * uv[i, k])
                while whole <= after and m < most:
                    f = (whole - line) / (after - line) if after > line else 0.0
                    nu = normal[i - 1, 0] + f * (normal[i, 0] - normal[i - 1, 0])
                    nv = normal[i - 1, 1] + f * (normal[i, 1] - normal[i - 1, 1])
                    norm = np.hypot(nu, nv)
                    points[m, k] = sense * whole
                    points[m, 1 - k] = uv[i - 1, 1 - k] + f * (uv[i, 1 - k] - uv[i - 1, 1 - k])
                    own[m, 0], own[m, 1] = nu / norm, nv / norm
                    component = own[m, 1 - k]
                    along[m, k], along[m, 1 - k] = 0.0, 1.0 if component >= 0.0 else -1.0
                    cosine = max(abs(component), 0.5)
                    wide[m] = (width_px[i - 1] + f * (width_px[i] - width_px[i - 1])) / cosine
                    m += 1
                    whole += 1.0
                line = after
            if m - first >= 2:
                edges[pieces] = first
                pieces += 1
            else:
                m = first
            begin, steep = stop, later
    edges[pieces] = m
    return points[:m], edges[: pieces + 1], wide[:m], along[:m], own[:m]


@compiled
@no_type_check
def flat_centroids(
    spans: np.ndarray,
    distance: np.ndarray,
    level: np.ndarray,
    share: np.ndarray,
    clipped: np.ndarray,
    hits: np.ndarray,
    width_px: np.ndarray,
    start_px: np.ndarray,
) -> tuple:
    """Centroid of what stands above the background within three widths; all grey values count alike.

    The window follows the result; its ends fall on whole pixels.

    Returns
    -------
    shifts, uncertainties for a noise of 1, widths, heights
    """
    n = len(start_px)
    shift, u, wide, high = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    for i in range(n):
        a, b = spans[i], spans[i + 1]
        centre, limit = start_px[i], _SIDE * width_px[i]
        mass, spread = 0.0, 0.0
        for turn in range(_PASSES + 1):
            if turn < _PASSES:
                c = m = 0
                x1, x2, p1, xp = 0.0, 0.0, 0.0, 0.0
                for k in range(a, b):
                    x = distance[k] - centre
                    if share[k] > 0.0 and abs(x) > limit and not (hits[i] > 0 and clipped[k]):
                        p = float(level[k])
                        c += 1
                        m += x < 0.0
                        x1 += x
                        x2 += x * x
                        p1 += p
                        xp += x * p
                mean_x, mean_p = x1 / max(c, 1), p1 / max(c, 1)
                slope = 0.0
                if m >= _LEAST_SIDE and c - m >= _LEAST_SIDE:
                    slope = (xp - mean_x * p1) / max(x2 - c * mean_x * mean_x, 1e-9)
                ground = mean_p - slope * (mean_x + centre)
                mass = moment = 0.0
                for k in range(a, b):
                    if share[k] > 0.0 and abs(distance[k] - centre) <= limit:
                        p = max(level[k] - ground - slope * distance[k], 0.0)
                        mass += p
                        moment += p * distance[k]
                last = centre
                if mass > 0.0:
                    centre = moment / mass
            else:
                near, second = 0.0, 0.0
                for k in range(a, b):
                    if share[k] > 0.0 and abs(distance[k] - last) <= limit:
                        x = distance[k] - centre
                        near += x * x
                        second += max(level[k] - ground - slope * distance[k], 0.0) * x * x
                spread = second / mass
                u[i] = np.sqrt(near) / mass
        shift[i] = centre if mass > 0.0 else np.nan
        wide[i] = np.sqrt(max(spread, 0.1))
        high[i] = mass / (_ROOT_2PI * wide[i])
    return shift, u, wide, high
