"""Grey gravity along rows and columns, in compiled loops. See :mod:`rotaline.vision.stripe.plain.rows`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.chain_kernels import starts_of, window_mean
from rotaline.vision.stripe.strip_kernels import BLOCK

_UNDECIDED = 0.15  # difference of the normal's components
_AROUND = 8  # pixels to both sides, along the stripe: the direction that decides between rows and columns
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
def _crossings(
    uv: np.ndarray,
    begin: int,
    end: int,
    balance: np.ndarray,
    points: np.ndarray,
    after: np.ndarray,
    part: np.ndarray,
    edges: np.ndarray,
    kinds: np.ndarray,
    pieces: int,
) -> tuple:
    """Where a chain crosses whole rows (where it is steep: the balance is positive) or whole columns (where it is flat).

    Near 45 deg what held before goes on.

    Parameters
    ----------
    points, edges, kinds : of the ``pieces`` before, and of those to come: where they start and the last one stops, which of them are steep
    after, part : the point behind each crossing, and where the crossing is on the way there from the one before it

    Returns
    -------
    points, pieces : int   that there are now
    """
    m, most = edges[pieces], len(points)
    steep = balance[begin] >= 0.0
    while begin < end:
        stop = begin + 1
        later = steep
        while stop < end:
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
            there = max(line, sense * uv[i, k])
            while whole <= there and m < most:
                f = (whole - line) / (there - line) if there > line else 0.0
                points[m, k] = sense * whole
                points[m, 1 - k] = uv[i - 1, 1 - k] + f * (uv[i, 1 - k] - uv[i - 1, 1 - k])
                after[m], part[m] = i, f
                m += 1
                whole += 1.0
            line = there
        if m - first >= 2:
            kinds[pieces] = steep
            pieces += 1
            edges[pieces] = m
        else:
            m = first
        begin, steep = stop, later
    return m, pieces


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
    most = int(2 * n + 2 * len(starts))
    points, after, part = np.empty((most, 2)), np.empty(most, np.int64), np.empty(most)
    edges, steep = np.zeros(n + len(starts), np.int64), np.empty(n + len(starts), np.bool_)
    m = pieces = 0
    for c in range(len(starts) - 1):
        m, pieces = _crossings(uv, starts[c], starts[c + 1], mean, points, after, part, edges, steep, pieces)
    points, edges = points[:m], edges[: pieces + 1]
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
def _slopes(uv: np.ndarray, start: int, stop: int, k: int, out: np.ndarray) -> bool:
    """Whether a chain has a point on each row (``k`` is 0) or column that it passes, and is nowhere nearer to the other direction; its slopes, px a line."""
    m, w = stop - start, _AROUND
    if m <= 2 * w:
        return False
    across, line = uv[start:stop, k], uv[start:stop, 1 - k]
    sense, own = line[1] - line[0], out[start:stop]
    stays = abs(sense) == 1.0
    for i in range(m - 1):
        stays &= line[i + 1] - line[i] == sense
    for i in range(m - 2 * w):
        own[w + i] = (across[2 * w + i] - across[i]) / (2.0 * w)
        stays &= abs(own[w + i]) <= 1.0
    own[:w], own[m - w :] = own[w], own[m - w - 1]
    return stays


@compiled
@no_type_check
def _directions(uv: np.ndarray, start: int, stop: int, cosine: np.ndarray, balance: np.ndarray) -> None:
    """Components of the normals of a chain whose points may be some pixels apart, without signs, and the first of them minus the second."""
    at = np.empty(stop - start)
    at[0] = 0.0
    for i in range(start + 1, stop):
        du, dv = uv[i, 0] - uv[i - 1, 0], uv[i, 1] - uv[i - 1, 1]
        at[i - start] = at[i - start - 1] + np.sqrt(du * du + dv * dv)
    a = b = 0
    last = stop - start - 1
    for i in range(last + 1):
        while at[a] < min(at[i], at[last] - _AROUND) - _AROUND:
            a += 1
        while b < last and at[b + 1] <= max(at[i], _AROUND) + _AROUND:
            b += 1
        du, dv = abs(uv[start + b, 0] - uv[start + a, 0]), abs(uv[start + b, 1] - uv[start + a, 1])
        length = max(np.sqrt(du * du + dv * dv), 1e-9)
        cosine[start + i, 0], cosine[start + i, 1] = dv / length, du / length
        balance[start + i] = (dv - du) / length


@compiled
@no_type_check
def whole_lines(uv: np.ndarray, chain: np.ndarray, spread_px2: np.ndarray) -> tuple:
    """Where the chains that were found cross whole rows or columns; their points may be some pixels apart.

    Parameters
    ----------
    spread_px2 : (n,)   variance of the smoothed profile along the row or column in which a point was found

    Returns
    -------
    points, starts
    along : (m, 2)   direction of the row or column of each point
    stretch : (m,)   square of the length along it of what is one pixel long across the stripe
    wide_px2 : (m,)   variance across the stripe, without the smoothing
    """
    starts = starts_of(chain)
    n = len(uv)
    most = int(2 * n + 2 * len(starts))
    points, after, part = np.empty((most, 2)), np.empty(most, np.int64), np.empty(most)
    along, stretch, wide = np.zeros((most, 2)), np.empty(most), np.empty(most)
    edges, kinds = np.zeros(n + len(starts), np.int64), np.empty(n + len(starts), np.bool_)
    balance, cosine, slope = np.empty(n), np.empty((n, 2)), np.empty(n)
    m = pieces = 0
    for c in range(len(starts) - 1):
        start, stop, first, before = starts[c], starts[c + 1], m, pieces
        rows = True
        for i in range(start, stop):
            rows &= uv[i, 1] == np.floor(uv[i, 1])
        own = 0 if rows else 1
        if _slopes(uv, start, stop, own, slope):
            m, pieces = m + stop - start, pieces + 1
            edges[pieces] = m
            points[first:m] = uv[start:stop]
            for i in range(stop - start):
                square = 1.0 + slope[start + i] * slope[start + i]
                along[first + i, own], stretch[first + i] = 1.0, square
                wide[first + i] = spread_px2[start + i] / square - 1.0
            continue
        _directions(uv, start, stop, cosine, balance)
        m, pieces = _crossings(uv, start, stop, balance, points, after, part, edges, kinds, pieces)
        for piece in range(before, pieces):
            k = 0 if kinds[piece] else 1
            for j in range(edges[piece], edges[piece + 1]):
                i = after[j]
                along[j, k], stretch[j] = 1.0, 1.0 / max(cosine[i, k] * cosine[i, k], 0.25)
                wide[j] = spread_px2[i] * cosine[i, own] * cosine[i, own] - 1.0
    return points[:m], edges[: pieces + 1], along[:m], stretch[:m], wide[:m]


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
