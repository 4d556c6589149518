"""Grey gravity along rows and columns, in compiled loops. See :mod:`rotaline.vision.stripe.plain.rows`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.chain_kernels import starts_of, window_mean
from rotaline.vision.stripe.strip_kernels import BLOCK

_UNDECIDED = 0.15  # difference of the normal's components
_AROUND_PX = 8.0  # to both sides, along the stripe: the direction that decides between rows and columns
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
def _crossings(uv: np.ndarray, starts: np.ndarray, balance: np.ndarray) -> tuple:
    """Where chains cross whole rows (where they are steep: the balance is positive) or whole columns (where they are flat).

    Near 45 deg what held before goes on.

    Returns
    -------
    points, starts, steep : (pieces,) bool
    after, part   the point behind each crossing, and where the crossing is on the way there from the one before it
    """
    n = len(uv)
    most = int(2 * n + 2 * len(starts))
    points, after, part = np.empty((most, 2)), np.empty(most, np.int64), np.empty(most)
    edges, kinds = np.empty(n + len(starts), np.int64), np.empty(n + len(starts), np.bool_)
    m, pieces = 0, 0
    for c in range(len(starts) - 1):
        begin = starts[c]
        steep = balance[begin] >= 0.0
        while begin < starts[c + 1]:
            stop = begin + 1
            later = steep
            while stop < starts[c + 1]:
                if abs(balance[stop]) > _UNDECIDED:
                    later = balance[stop] >= 0.0
                    if later != steep:
                        break
                stop += 1
            k = 1 if steep else 0
            sense = 1.0 if uv[stop - 1, k] >= uv[begin, k] else -1.0
            line = sense * uv[begin, k]
            whole = np.ceil(line)
            first = m
            for i in range(begin + 1, stop):
                end = max(line, sense * uv[i, k])
                while whole <= end and m < most:
                    f = (whole - line) / (end - line) if end > line else 0.0
                    points[m, k] = sense * whole
                    points[m, 1 - k] = uv[i - 1, 1 - k] + f * (uv[i, 1 - k] - uv[i - 1, 1 - k])
                    after[m], part[m] = i, f
                    m += 1
                    whole += 1.0
                line = end
            if m - first >= 2:
                edges[pieces], kinds[pieces] = first, steep
                pieces += 1
            else:
                m = first
            begin, steep = stop, later
    edges[pieces] = m
    return points[:m], edges[: pieces + 1], kinds[:pieces], after[:m], part[:m]


@compiled
@no_type_check
def cross_lines(uv: np.ndarray, starts: np.ndarray, width_px: np.ndarray, normal: np.ndarray) -> tuple:
    """Where a curve of points one pixel apart crosses whole rows (where it is steep) or whole columns (where it is flat).

    Returns
    -------
    points, starts, widths as seen along the row or column, direction of the row or column, normals of the stripe
    """
    n = len(uv)
    balance, mean = np.empty(n), np.empty(n)
    for i in range(n):
        balance[i] = abs(normal[i, 0]) - abs(normal[i, 1])
    window_mean(balance, starts, 10, mean)
    points, edges, steep, after, part = _crossings(uv, starts, mean)
    m = len(points)
    own, along, wide = np.empty((m, 2)), np.zeros((m, 2)), np.empty(m)
    for c in range(len(edges) - 1):
        k = 0 if steep[c] else 1
        for j in range(edges[c], edges[c + 1]):
            i, f = after[j], part[j]
            nu = normal[i - 1, 0] + f * (normal[i, 0] - normal[i - 1, 0])
            nv = normal[i - 1, 1] + f * (normal[i, 1] - normal[i - 1, 1])
            norm = np.sqrt(nu * nu + nv * nv)
            own[j, 0], own[j, 1] = nu / norm, nv / norm
            along[j, k] = 1.0 if own[j, k] >= 0.0 else -1.0
            wide[j] = (width_px[i - 1] + f * (width_px[i] - width_px[i - 1])) / max(abs(own[j, k]), 0.5)
    return points, edges, wide, along, own


@compiled
@no_type_check
def whole_lines(uv: np.ndarray, chain: np.ndarray, width_px: float) -> tuple:
    """Where the chains that were found cross whole rows or columns; their points may be some pixels apart.

    Returns
    -------
    points, starts, widths as seen along the row or column, direction of the row or column
    """
    starts = starts_of(chain)
    n = len(uv)
    balance, cosine, at = np.empty(n), np.empty((n, 2)), np.empty(n)
    for c in range(len(starts) - 1):
        a = b = starts[c]
        last = starts[c + 1] - 1
        at[a] = 0.0
        for i in range(starts[c] + 1, starts[c + 1]):
            du, dv = uv[i, 0] - uv[i - 1, 0], uv[i, 1] - uv[i - 1, 1]
            at[i] = at[i - 1] + np.sqrt(du * du + dv * dv)
        for i in range(starts[c], starts[c + 1]):
            while at[a] < min(at[i], at[last] - _AROUND_PX) - _AROUND_PX:
                a += 1
            while b < last and at[b + 1] <= max(at[i], _AROUND_PX) + _AROUND_PX:
                b += 1
            du, dv = abs(uv[b, 0] - uv[a, 0]), abs(uv[b, 1] - uv[a, 1])
            length = max(np.sqrt(du * du + dv * dv), 1e-9)
            cosine[i, 0], cosine[i, 1] = dv / length, du / length
            balance[i] = cosine[i, 0] - cosine[i, 1]
    points, edges, steep, after, _ = _crossings(uv, starts, balance)
    along, wide = np.zeros((len(points), 2)), np.empty(len(points))
    for c in range(len(edges) - 1):
        k = 0 if steep[c] else 1
        for j in range(edges[c], edges[c + 1]):
            along[j, k], wide[j] = 1.0, width_px / max(cosine[after[j], k], 0.5)
    return points, edges, wide, along


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
