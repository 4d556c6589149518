"""Grey gravity along rows and columns, in compiled loops. See :mod:`rotaline.vision.stripe.plain.rows`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.chain_kernels import window_mean
from rotaline.vision.stripe.strip_kernels import BLOCK

_UNDECIDED = 0.15  # difference of the normal's components
_SIDE = 3.0  # widths: the background begins, the window ends
_LEAST_SIDE = 2  # pixels
_PASSES = 3
_ROOT_2PI = np.sqrt(2.0 * np.pi)
_ZERO, _UNIT = np.float32(0.0), np.float32(1.0)
_SHORT = np.float32(0.003)  # px; steps are the last when none is longer
_CENTRE, _LIMIT, _LEVEL, _SLOPE = 0, BLOCK, 2 * BLOCK, 3 * BLOCK
_N, _BELOW, _X1, _X2, _Q, _XQ, _XXQ = (k * BLOCK for k in range(4, 11))


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
def _add_outside(s: np.ndarray, d: np.ndarray, p: np.ndarray, w: np.ndarray) -> None:
    """One place of a block of strips: sums for the line through what lies outside the window."""
    for k in range(BLOCK):
        x, q = d[k] - s[_CENTRE + k], p[k]
        use = _UNIT if (abs(x) > s[_LIMIT + k]) & (w[k] > _ZERO) else _ZERO
        ux = use * x
        s[_N + k] += use
        s[_BELOW + k] += use if x < _ZERO else _ZERO
        s[_X1 + k] += ux
        s[_X2 + k] += ux * x
        s[_Q + k] += use * q
        s[_XQ + k] += ux * q


@compiled
@no_type_check
def _add_inside(s: np.ndarray, d: np.ndarray, p: np.ndarray, w: np.ndarray) -> None:
    """One place of a block: moments of the window itself, and of what stands above the line in it."""
    for k in range(BLOCK):
        x = d[k] - s[_CENTRE + k]
        use = _UNIT if (abs(x) <= s[_LIMIT + k]) & (w[k] != _ZERO) else _ZERO
        q = use * max(p[k] - s[_LEVEL + k] - s[_SLOPE + k] * x, _ZERO)
        ux, qx = use * x, q * x
        s[_N + k] += use
        s[_X1 + k] += ux
        s[_X2 + k] += ux * x
        s[_Q + k] += q
        s[_XQ + k] += qx
        s[_XXQ + k] += qx * x


@compiled
@no_type_check
def flat_centroids(
    first: np.ndarray,
    count: np.ndarray,
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

    Parameters
    ----------
    level : grey values, but for a line that may have been subtracted

    Returns
    -------
    shifts, uncertainties for a noise of 1, widths, heights
    """
    n = len(start_px)
    shift, u, wide, high = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    s = np.zeros(11 * BLOCK, np.float32)
    for begin in range(0, n, BLOCK):
        m = min(BLOCK, n - begin)
        low, end = first[begin], first[begin] + BLOCK * count[begin]
        for k in range(m):
            s[_CENTRE + k], s[_LIMIT + k] = start_px[begin + k], _SIDE * width_px[begin + k]
            if hits[begin + k]:  # clipped pixels say nothing about the background
                for a in range(low + k, end, BLOCK):
                    if clipped[a]:
                        share[a] = -share[a]
        for _ in range(_PASSES):
            s[_N:] = _ZERO
            for a in range(low, end, BLOCK):
                _add_outside(s, distance[a : a + BLOCK], level[a : a + BLOCK], share[a : a + BLOCK])
            for k in range(m):
                c, below, x1 = float(s[_N + k]), float(s[_BELOW + k]), float(s[_X1 + k])
                mean_x, mean_q, slope = x1 / max(c, 1.0), s[_Q + k] / max(c, 1.0), 0.0
                if below >= _LEAST_SIDE and c - below >= _LEAST_SIDE:
                    slope = (s[_XQ + k] - mean_x * s[_Q + k]) / max(s[_X2 + k] - mean_x * x1, 1e-9)
                s[_LEVEL + k], s[_SLOPE + k] = mean_q - slope * mean_x, slope
            s[_N:] = _ZERO
            reach = _ZERO
            for k in range(m):
                reach = max(reach, abs(s[_CENTRE + k]) + s[_LIMIT + k])
            inner = min(int(reach + 1.5), count[begin] // 2)
            middle = low + BLOCK * (count[begin] // 2)
            for a in range(middle - BLOCK * inner, middle + BLOCK * (inner + 1), BLOCK):
                _add_inside(s, distance[a : a + BLOCK], level[a : a + BLOCK], share[a : a + BLOCK])
            longest = _ZERO
            for k in range(BLOCK):
                step = s[_XQ + k] / s[_Q + k] if s[_Q + k] > _ZERO else _ZERO
                s[_BELOW + k] = step
                s[_CENTRE + k] += step
                longest = max(longest, abs(step) if k < m else _ZERO)
            if longest < _SHORT:
                break
        for k in range(m):
            i = begin + k
            mass, step = float(s[_Q + k]), float(s[_BELOW + k])
            near = s[_X2 + k] - 2.0 * step * s[_X1 + k] + step * step * s[_N + k]
            shift[i] = s[_CENTRE + k] if mass > 0.0 else np.nan
            u[i] = np.sqrt(max(near, 0.0)) / mass
            wide[i] = np.sqrt(max(s[_XXQ + k] / mass - step * step, 0.1))
            high[i] = mass / (_ROOT_2PI * wide[i])
        for k in range(m):
            if hits[begin + k]:
                for a in range(low + k, end, BLOCK):
                    share[a] = abs(share[a])
    return shift, u, wide, high
