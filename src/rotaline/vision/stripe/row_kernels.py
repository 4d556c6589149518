"""Grey gravity along rows and columns, in compiled loops. See :mod:`rotaline.vision.stripe.plain.rows`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.chain_kernels import copy_values, starts_of, window_mean
from rotaline.vision.stripe.strip_kernels import BLOCK

_UNDECIDED, _UNDECIDED_SQUARES = 0.15, 0.21  # difference of the normal's components, and of their squares
_AROUND = 8  # pixels to both sides, along the stripe: the direction that decides between rows and columns
_LINES_AROUND = 6  # the same where there is a point on every line
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
def _same_kind(balance: np.ndarray, begin: int, end: int, steep: bool, undecided: float) -> tuple:
    """Where a part of a chain stops that is steep (the balance is positive) or flat as it begins, and what comes then.

    Near 45 deg what held before goes on.
    """
    sign = 1.0 if steep else -1.0
    stop = begin + 1
    while stop < end and sign * balance[stop] >= -undecided:
        stop += 1
    return stop, steep == (stop == end)


@compiled
@no_type_check
def _cross(
    uv: np.ndarray, begin: int, stop: int, k: int, points: np.ndarray, after: np.ndarray, part: np.ndarray, m: int
) -> int:
    """Where a part of a chain crosses whole rows (``k`` is 1) or columns (0); it may go to and fro a little.

    Parameters
    ----------
    points, after, part : to write from ``m`` on: the crossings, the point of the chain behind each, and where on the way there it is

    Returns
    -------
    int   where the crossings end
    """
    sense = 1.0 if uv[stop - 1, k] >= uv[begin, k] else -1.0
    line = sense * uv[begin, k]
    whole = np.ceil(line)
    for i in range(begin + 1, stop):
        there = max(line, sense * uv[i, k])
        while whole <= there and m < len(points):
            f = (whole - line) / (there - line) if there > line else 0.0
            points[m, k] = sense * whole
            points[m, 1 - k] = uv[i - 1, 1 - k] + f * (uv[i, 1 - k] - uv[i - 1, 1 - k])
            after[m], part[m] = i, f
            m += 1
            whole += 1.0
        line = there
    return m


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
        begin, kind = starts[c], mean[starts[c]] >= 0.0
        while begin < starts[c + 1]:
            stop, later = _same_kind(mean, begin, starts[c + 1], kind, _UNDECIDED)
            end = _cross(uv, begin, stop, 1 if kind else 0, points, after, part, m)
            if end - m >= 2:
                steep[pieces] = kind
                pieces += 1
                edges[pieces] = m = end
            begin, kind = stop, later
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
def _steps_of_one(line: np.ndarray) -> bool:
    """Whether the values are whole numbers, each one more (or each one less) than the one before."""
    step, same = line[1] - line[0], True
    if abs(step) != 1.0 or line[0] != np.floor(line[0]):
        return False
    for i in range(len(line) - 1):
        same &= line[i + 1] - line[i] == step
    return same


@compiled
@no_type_check
def _balance_of_lines(place: np.ndarray, sign: float, balance: np.ndarray) -> None:
    """As :func:`_balance`, of a chain with a point on each row (``sign`` is 1) or column (-1) that it passes."""
    m, w = len(place), _LINES_AROUND
    inner = balance[w:]
    for i in range(m - 2 * w):
        slope = (place[2 * w + i] - place[i]) * (0.5 / w)
        inner[i] = sign * (2.0 / (1.0 + slope * slope) - 1.0)
    for i in range(w):
        balance[i], balance[m - 1 - i] = balance[w], balance[m - 1 - w]


@compiled
@no_type_check
def _balance(uv: np.ndarray, balance: np.ndarray) -> None:
    """The square of the normal's first component minus that of the second, of a chain whose points may be some pixels apart."""
    at = np.empty(len(uv))
    at[0] = 0.0
    for i in range(1, len(uv)):
        du, dv = uv[i, 0] - uv[i - 1, 0], uv[i, 1] - uv[i - 1, 1]
        at[i] = at[i - 1] + np.sqrt(du * du + dv * dv)
    a = b = 0
    last = len(uv) - 1
    for i in range(len(uv)):
        while at[a] < min(at[i], at[last] - _AROUND) - _AROUND:
            a += 1
        while b < last and at[b + 1] <= max(at[i], _AROUND) + _AROUND:
            b += 1
        du, dv = uv[b, 0] - uv[a, 0], uv[b, 1] - uv[a, 1]
        balance[i] = (dv * dv - du * du) / max(du * du + dv * dv, 1e-18)


@compiled
@no_type_check
def _squares(balance: np.ndarray, sign: float, spread_px2: np.ndarray, stretch: np.ndarray, wide: np.ndarray) -> None:
    """Stretch and width of points that stand where they were found, on rows (``sign`` is 1) or columns (-1)."""
    for i in range(len(balance)):
        square = 0.5 + 0.5 * sign * balance[i]
        stretch[i], wide[i] = 1.0 / square, spread_px2[i] * square - 1.0


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
    along, stretch, wide = np.empty((most, 2)), np.empty(most), np.empty(most)
    edges, balance = np.zeros(n + len(starts), np.int64), np.empty(n)
    pairs, found, lines = points.reshape(-1), uv.reshape(-1), along.reshape(-1)
    m = pieces = 0
    for c in range(len(starts) - 1):
        begin, end = starts[c], starts[c + 1]
        rows = _steps_of_one(uv[begin:end, 1])
        whole = rows or _steps_of_one(uv[begin:end, 0])
        if not whole:
            rows = True
            for i in range(begin, end):
                rows &= uv[i, 1] == np.floor(uv[i, 1])
        sign = 1.0 if rows else -1.0
        if whole and end - begin > 2 * _LINES_AROUND:
            _balance_of_lines(uv[begin:end, 0 if rows else 1], sign, balance[begin:end])
        else:
            _balance(uv[begin:end], balance[begin:end])
        steep = balance[begin] >= 0.0
        while begin < end:
            stop, later = _same_kind(balance, begin, end, steep, _UNDECIDED_SQUARES)
            last = m + stop - begin
            if whole and steep == rows:
                copy_values(found[2 * begin : 2 * stop], pairs[2 * m :])
                _squares(balance[begin:stop], sign, spread_px2[begin:stop], stretch[m:], wide[m:])
            else:
                last = _cross(uv, begin, stop, 1 if steep else 0, points, after, part, m)
                for j in range(m, last):
                    square = 0.5 + 0.5 * balance[after[j]]  # of the normal's first component
                    stretch[j] = 1.0 / max(square if steep else 1.0 - square, 0.25)
                    wide[j] = spread_px2[after[j]] * (square if rows else 1.0 - square) - 1.0
            if last - m >= 2:
                own = lines[2 * m :]
                for j in range(last - m):
                    own[2 * j], own[2 * j + 1] = 1.0 if steep else 0.0, 0.0 if steep else 1.0
                pieces += 1
                edges[pieces] = m = last
            begin, steep = stop, later
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
