"""Centres of the stripe from strips of pixels (:mod:`rotaline.vision.stripe.strip_kernels`), in compiled loops.

The sums over the strips of a block of points are made side by side, in single precision; what that leaves out is 1e-6 of a pixel.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.strip_kernels import BLOCK

_F = np.float32
_ZERO, _UNIT, _TWO, _HALF, _SIXTH = _F(0.0), _F(1.0), _F(2.0), _F(0.5), _F(1.0 / 6.0)
_LEAST_RATE = _F(0.5)
_HUGE, _THIN, _NARROW, _NONE = _F(1e30), _F(1e-3), _F(0.1), _F(np.nan)
_SIDE = 3.0  # the sides begin so many widths from the centre
_LEAST_SIDE = 2  # pixels
_MOST_STEPS = 8
_FLAT, _LONGEST = _F(1.0 / 32.0), _F(1.5)  # of a bell's variance; of the width
_LEAST_WINDOW_PX = _F(1.0)
_REACH = _F(4.0)  # widths of the window
_SHIFT, _BY_SHAPE, _BY_WINDOW = 0, BLOCK, 2 * BLOCK
_G0, _G1, _G2, _P0, _P1, _P2 = 3 * BLOCK, 4 * BLOCK, 5 * BLOCK, 6 * BLOCK, 7 * BLOCK, 8 * BLOCK
_K0, _K1, _K2, _W1, _W2 = 9 * BLOCK, 10 * BLOCK, 11 * BLOCK, 12 * BLOCK, 13 * BLOCK
_STEP, _VARIANCE, _WINDOW, _MOST, _SLOPE_VARIANCE = 14 * BLOCK, 15 * BLOCK, 16 * BLOCK, 17 * BLOCK, 18 * BLOCK
_PRODUCT = 19 * BLOCK


@compiled
@no_type_check
def _bell(t: float) -> float:
    """exp(-16 t) for t >= 0, single precision: to 0.3 % where it is above 0.02; what is below 1e-7 is about that."""
    t = min(t, _UNIT)
    e = _UNIT - t * (_UNIT - t * (_HALF - t * _SIXTH))
    e = e * e
    e = e * e
    e = e * e
    return e * e


@compiled
@no_type_check
def _add(s: np.ndarray, d: np.ndarray, p: np.ndarray, w: np.ndarray) -> None:
    """One place of a block: all that centre, width, height and uncertainty are made of is added to the sums ``s``.

    They are those of weight times bell, of weight times light, and of weight squared, times powers of x.
    """
    for k in range(BLOCK):
        x = d[k] - s[_SHIFT + k]
        square = x * x
        weight = w[k] * _bell(square * s[_BY_WINDOW + k])
        wg = weight * _bell(square * s[_BY_SHAPE + k])
        wp, wx = weight * p[k], weight * x
        s[_G0 + k] += wg
        s[_G1 + k] += wg * x
        s[_G2 + k] += wg * square
        s[_P0 + k] += wp
        s[_P1 + k] += wp * x
        s[_P2 + k] += wp * square
        s[_K0 + k] += weight * weight
        s[_K1 + k] += weight * wx
        s[_K2 + k] += wx * wx
        s[_W1 + k] += wx
        s[_W2 + k] += weight * square


@compiled
@no_type_check
def _add_3(s: np.ndarray, d: np.ndarray, p: np.ndarray, w: np.ndarray) -> None:
    """The same for three places at once."""
    for k in range(BLOCK):
        centre, by_window, by_shape = s[_SHIFT + k], s[_BY_WINDOW + k], s[_BY_SHAPE + k]
        x, y, z = d[k] - centre, d[k + BLOCK] - centre, d[k + 2 * BLOCK] - centre
        xx, yy, zz = x * x, y * y, z * z
        a = w[k] * _bell(xx * by_window)
        b = w[k + BLOCK] * _bell(yy * by_window)
        c = w[k + 2 * BLOCK] * _bell(zz * by_window)
        ag, bg, cg = a * _bell(xx * by_shape), b * _bell(yy * by_shape), c * _bell(zz * by_shape)
        ap, bp, cp = a * p[k], b * p[k + BLOCK], c * p[k + 2 * BLOCK]
        ax, by, cz = a * x, b * y, c * z
        s[_G0 + k] += ag + bg + cg
        s[_G1 + k] += ag * x + bg * y + cg * z
        s[_G2 + k] += ag * xx + bg * yy + cg * zz
        s[_P0 + k] += ap + bp + cp
        s[_P1 + k] += ap * x + bp * y + cp * z
        s[_P2 + k] += ap * xx + bp * yy + cp * zz
        s[_K0 + k] += a * a + b * b + c * c
        s[_K1 + k] += a * ax + b * by + c * cz
        s[_K2 + k] += ax * ax + by * by + cz * cz
        s[_W1 + k] += ax + by + cz
        s[_W2 + k] += a * xx + b * yy + c * zz


@compiled
@no_type_check
def _step(s: np.ndarray, short: float) -> int:
    """The next step of each point of a block, by Newton's method; how many are longer than ``short``.

    The centre of what is under a window that is a bell moves with the window, by the part that the variance of what is under it is of the bell's.
    """
    far = 0
    for k in range(BLOCK):
        g0, p0 = s[_G0 + k], s[_P0 + k]
        own, off = s[_G1 + k] / g0, s[_P1 + k] / p0
        rate = (s[_G2 + k] / g0 - own * own) / s[_PRODUCT + k] - (s[_P2 + k] / p0 - off * off) / s[_WINDOW + k]
        step = (off - own) / min(max(rate, _LEAST_RATE), _UNIT)
        step = min(max(step, -s[_MOST + k]), s[_MOST + k]) if abs(step) < _HUGE else _ZERO
        s[_STEP + k] = step
        far += abs(step) > short
    return far


@compiled
@no_type_check
def _finish(s: np.ndarray) -> None:
    """Centres, uncertainties, widths and heights of a block from its sums; they take the place of the first of these."""
    for k in range(BLOCK):
        g0, g1, g2 = s[_G0 + k], s[_G1 + k], s[_G2 + k]
        p0, p1, p2 = s[_P0 + k], s[_P1 + k], s[_P2 + k]
        variance, window_variance = s[_VARIANCE + k], s[_WINDOW + k]
        peak = g2 * p0 - g1 * p1
        high = peak / (g0 * g2 - g1 * g1)
        from_slope = g0 * s[_W2 + k] - g1 * s[_W1 + k]
        total = g0 * g0 * s[_K2 + k] - _TWO * g0 * g1 * s[_K1 + k] + g1 * g1 * s[_K0 + k]
        u = variance / peak * np.sqrt(total + s[_SLOPE_VARIANCE + k] * from_slope * from_slope)
        product = s[_PRODUCT + k]
        off, own = p1 / p0, g1 / g0  # the same but for the last step
        moment = p2 / p0 - off * off - g2 / g0 + own * own + product
        wide = moment * window_variance / max(window_variance - moment, _THIN * window_variance)
        found = (p0 > _ZERO) & (high > _ZERO) & (u > _ZERO) & (u < _HUGE)
        s[_G0 + k] = s[_SHIFT + k] + s[_STEP + k] if found else _NONE
        s[_G1 + k] = u
        s[_G2 + k] = min(np.sqrt(max(wide, _NARROW)), _TWO * s[_MOST + k])
        s[_P0 + k] = high


@compiled
@no_type_check
def weighted_centroids(
    first: np.ndarray,
    count: np.ndarray,
    distance: np.ndarray,
    above: np.ndarray,
    share: np.ndarray,
    slope_variance: np.ndarray,
    start_px: np.ndarray,
    width_px: np.ndarray,
    window: float,
    short_px: float,
    wanted: np.ndarray,
    shift_px: np.ndarray,
    u_px: np.ndarray,
    measured_px: np.ndarray,
    height: np.ndarray,
) -> None:
    """As :func:`rotaline.vision.stripe.plain.centres.weighted_centroid`, until no step in a block is longer than ``short_px``.

    Only of ``wanted`` blocks, (blocks,) bool. Results stand in the last four arrays. The uncertainties are left out where ``u_px`` is empty.
    """
    n = len(start_px)
    s = np.zeros(20 * BLOCK, _F)
    s[_BY_SHAPE:_G0], s[_VARIANCE:] = _UNIT, _UNIT
    limit = np.zeros(BLOCK, _F)
    short = _F(short_px)
    for begin in range(0, n, BLOCK):
        end = min(begin + BLOCK, n)
        if not wanted[begin // BLOCK]:
            continue
        _prepare(s, limit, start_px[begin:end], width_px[begin:end], slope_variance[begin:end], window)
        low, high = _inside(s, limit, distance, first[begin], count[begin], end - begin)
        rest = low + (high - low) // (3 * BLOCK) * 3 * BLOCK
        for turn in range(_MOST_STEPS):
            s[_G0:_STEP] = _ZERO
            for a in range(low, rest, 3 * BLOCK):
                b = a + 3 * BLOCK
                _add_3(s, distance[a:b], above[a:b], share[a:b])
            for a in range(rest, high, BLOCK):
                b = a + BLOCK
                _add(s, distance[a:b], above[a:b], share[a:b])
            if _step(s, short) == 0 or turn == _MOST_STEPS - 1:
                break
            for k in range(BLOCK):
                s[_SHIFT + k] += s[_STEP + k]
        _finish(s)
        for k in range(end - begin):
            shift_px[begin + k], measured_px[begin + k], height[begin + k] = s[_G0 + k], s[_G2 + k], s[_P0 + k]
        for k in range(end - begin if len(u_px) else 0):
            u_px[begin + k] = s[_G1 + k]


@compiled
@no_type_check
def _prepare(
    s: np.ndarray,
    limit: np.ndarray,
    start_px: np.ndarray,
    width_px: np.ndarray,
    slope_variance: np.ndarray,
    window: float,
) -> None:
    """What the steps of a block begin with, and how far from the points' places the window ends."""
    for k in range(len(start_px)):
        width = _F(width_px[k])
        window_px = max(_F(window) * width, _LEAST_WINDOW_PX)
        variance, window_variance = width * width, window_px * window_px
        s[_SHIFT + k] = start_px[k]
        s[_BY_SHAPE + k], s[_BY_WINDOW + k] = _FLAT / variance, _FLAT / window_variance
        s[_VARIANCE + k], s[_WINDOW + k], s[_MOST + k] = variance, window_variance, _LONGEST * width
        s[_SLOPE_VARIANCE + k] = slope_variance[k]
        product = variance * window_variance / (variance + window_variance)
        s[_PRODUCT + k], s[_G2 + k] = product, product
        limit[k] = _REACH * window_px


@compiled
@no_type_check
def _inside(s: np.ndarray, limit: np.ndarray, distance: np.ndarray, first: int, count: int, size: int) -> tuple:
    """The places of a block that may be inside of the windows: where they begin and end.

    Distances change evenly from place to place, but for a pixel.
    """
    low, high = np.float32(count), _ZERO
    last = first + (count - 1) * BLOCK
    for k in range(size):
        begin = distance[np.uint64(first + k)]
        per_px = np.float32(count - 1) / (distance[np.uint64(last + k)] - begin)
        middle, reach = (s[_SHIFT + k] - begin) * per_px, (limit[k] + _UNIT) * abs(per_px)
        low, high = min(low, middle - reach), max(high, middle + reach)
    begin, end = max(int(low), 0) // 3 * 3, min(int(high) + 2, count)
    return first + begin * BLOCK, first + max(end, begin) * BLOCK


@compiled
@no_type_check
def _add_sides(s: np.ndarray, d: np.ndarray, p: np.ndarray, w: np.ndarray) -> None:
    """One place of a block: sums for the line through the sides, of what lies beyond a limit."""
    for k in range(BLOCK):
        x, q = d[k], p[k] - s[k]
        use = _UNIT if (abs(x) > s[BLOCK + k]) & (w[k] > _ZERO) else _ZERO
        negative = use if x < _ZERO else _ZERO
        ux, uq = use * x, use * q
        s[2 * BLOCK + k] += use
        s[3 * BLOCK + k] += negative
        s[4 * BLOCK + k] += negative * q
        s[5 * BLOCK + k] += ux
        s[6 * BLOCK + k] += uq
        s[7 * BLOCK + k] += ux * x
        s[8 * BLOCK + k] += ux * q


@compiled
@no_type_check
def _add_sides_3(s: np.ndarray, d: np.ndarray, p: np.ndarray, w: np.ndarray) -> None:
    """The same for three places at once."""
    for k in range(BLOCK):
        zero, limit = s[k], s[BLOCK + k]
        x, y, z = d[k], d[k + BLOCK], d[k + 2 * BLOCK]
        a = _UNIT if (abs(x) > limit) & (w[k] > _ZERO) else _ZERO
        b = _UNIT if (abs(y) > limit) & (w[k + BLOCK] > _ZERO) else _ZERO
        c = _UNIT if (abs(z) > limit) & (w[k + 2 * BLOCK] > _ZERO) else _ZERO
        e, f, g = a if x < _ZERO else _ZERO, b if y < _ZERO else _ZERO, c if z < _ZERO else _ZERO
        q, r, t = p[k] - zero, p[k + BLOCK] - zero, p[k + 2 * BLOCK] - zero
        ax, by, cz = a * x, b * y, c * z
        s[2 * BLOCK + k] += a + b + c
        s[3 * BLOCK + k] += e + f + g
        s[4 * BLOCK + k] += e * q + f * r + g * t
        s[5 * BLOCK + k] += ax + by + cz
        s[6 * BLOCK + k] += a * q + b * r + c * t
        s[7 * BLOCK + k] += ax * x + by * y + cz * z
        s[8 * BLOCK + k] += ax * q + by * r + cz * t


@compiled
@no_type_check
def _lines_through(s: np.ndarray, found: np.ndarray) -> None:
    """Level, slope and its variance, and means of both sides, from the sums of a block; level and slope take the place of the first two of these."""
    for k in range(BLOCK):
        reference, n_all, below = float(s[k]), float(s[2 * BLOCK + k]), float(s[3 * BLOCK + k])
        sum_left, sum_x, sum_p = float(s[4 * BLOCK + k]), float(s[5 * BLOCK + k]), float(s[6 * BLOCK + k])
        beyond = n_all - below
        number = max(n_all, 1.0)
        mean_x, mean_p = sum_x / number, sum_p / number
        spread = max(float(s[7 * BLOCK + k]) - number * mean_x * mean_x, 1e-9)
        both = min(below, beyond) >= _LEAST_SIDE
        slope = (float(s[8 * BLOCK + k]) - mean_x * sum_p) / spread if both else 0.0
        level = mean_p - slope * mean_x + reference
        found[k], found[BLOCK + k], found[2 * BLOCK + k] = level, slope, 1.0 / spread if both else 0.0
        found[3 * BLOCK + k] = sum_left / below + reference if below > 0.0 else np.nan
        found[4 * BLOCK + k] = (sum_p - sum_left) / beyond + reference if beyond > 0.0 else np.nan
        s[k], s[BLOCK + k] = level, slope


@compiled
@no_type_check
def _take_line(s: np.ndarray, d: np.ndarray, p: np.ndarray) -> None:
    """Subtract lines (level, slope) from one place of a block."""
    for k in range(BLOCK):
        p[k] -= s[k] + s[BLOCK + k] * d[k]


@compiled
@no_type_check
def subtract_sides(
    first: np.ndarray,
    count: np.ndarray,
    distance: np.ndarray,
    above: np.ndarray,
    share: np.ndarray,
    clipped: np.ndarray,
    hits: np.ndarray,
    width_px: np.ndarray,
    line: np.ndarray,
    sides: np.ndarray,
) -> None:
    """Fit a line to what lies beyond three widths on both sides of each strip, and subtract it from the strip.

    Parameters
    ----------
    above : grey values in, what stands above the line out
    line : (n, 3) out   level at the point, slope, variance of the slope for a pixel variance of 1; a level where one side is not seen
    sides : (n, 2) out   mean grey value of each side; NaN where there is none
    """
    n = len(width_px)
    s, found = np.zeros(9 * BLOCK, _F), np.empty(5 * BLOCK)
    for begin in range(0, n, BLOCK):
        m = min(BLOCK, n - begin)
        low, high = first[begin], first[begin] + BLOCK * count[begin]
        any_hits = hits[begin : begin + m].any()
        if any_hits:  # clipped pixels do not count here
            for k in range(m):
                for a in range(low + k, high if hits[begin + k] else low, BLOCK):
                    share[a] = -share[a] if clipped[a] else share[a]
        s[:] = _ZERO
        middle = low + BLOCK * (count[begin] // 2)
        for k in range(m):
            s[k] = above[np.uint64(middle + k)]  # sums of small numbers are more exact
            s[BLOCK + k] = _SIDE * width_px[np.uint64(begin + k)]
        rest = low + count[begin] // 3 * 3 * BLOCK
        for a in range(low, rest, 3 * BLOCK):
            b = a + 3 * BLOCK
            _add_sides_3(s, distance[a:b], above[a:b], share[a:b])
        for a in range(rest, high, BLOCK):
            b = a + BLOCK
            _add_sides(s, distance[a:b], above[a:b], share[a:b])
        if any_hits:
            for k in range(m):
                for a in range(low + k, high if hits[begin + k] else low, BLOCK):
                    share[a] = abs(share[a])
        _lines_through(s, found)
        for k in range(m):
            i = begin + k
            line[i, 0], line[i, 1], line[i, 2] = found[k], found[BLOCK + k], found[2 * BLOCK + k]
            sides[i, 0], sides[i, 1] = found[3 * BLOCK + k], found[4 * BLOCK + k]
        for a in range(low, high, BLOCK):
            _take_line(s, distance[a : a + BLOCK], above[a : a + BLOCK])
