"""Centres of a block of points under two windows at once, in compiled loops. See :mod:`rotaline.vision.stripe.block_kernels`.

The sums over the strips are made side by side, in single precision; what that leaves out is 1e-6 of a pixel.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.block_kernels import BLOCK, LINE

_F = np.float32
_ZERO, _UNIT, _TWO, _HALF = _F(0.0), _F(1.0), _F(2.0), _F(0.5)
_HUGE, _THIN, _NARROW, _NONE = _F(1e30), _F(1e-3), _F(0.1), _F(np.nan)
_FLAT, _QUARTER, _LONGEST, _MOST_STEPS = _F(1.0 / 32.0), _F(0.25), _F(1.5), 8
_LEAST_RATE, _LEAST_SIDE, _TINY = _F(0.5), _F(1.5), _F(1e-9)
BEYOND = _F(3.0)  # widths: the sides begin
WIDTH, SHIFT, LEVEL, SLOPE, VARIANCE, DIFFER, _BY_NARROW, _BY_WIDE = (k * BLOCK for k in range(8))
_SUMS = 8 * BLOCK
_BEFORE, _BEHIND = 8 * BLOCK, 13 * BLOCK
_X, _Q, _XX, _XQ = (k * BLOCK for k in range(1, 5))
_G0, _G1, _G2, _P0, _P1, _P2, _W2, _K2 = (k * BLOCK for k in range(8, 16))
_SECOND = 8 * BLOCK  # from the sums under the narrow window to those under the wide one
NARROW, WIDE = 8 * BLOCK, 16 * BLOCK
SIZE = 24 * BLOCK


@compiled
@no_type_check
def _bell(t: float) -> float:
    """exp(-16 t) for t >= 0, single precision: to 0.4 % where it is above 0.2; 1.5e-5 at the least."""
    t = min(t, _UNIT)
    e = _UNIT - t * (_UNIT - t * _HALF)
    e = e * e
    e = e * e
    e = e * e
    return e * e


@compiled
@no_type_check
def _add_side(s: np.ndarray, to: int, d: np.ndarray, w: np.ndarray, q: np.ndarray, at: int) -> None:
    """One line of a block, from place ``at`` on: sums for the straight line through the sides, of what lies beyond three widths."""
    for k in range(BLOCK):
        limit = BEYOND * s[WIDTH + k]
        n = x1 = q1 = x2 = xq = _ZERO
        for lane in range(3):
            j = at + np.uint64(k + lane * BLOCK)
            x, p = d[j], _F(q[j])
            use = (abs(x) > limit) & (w[j] > _ZERO)
            one, ux, p = _UNIT if use else _ZERO, x if use else _ZERO, p if use else _ZERO
            n, x1, q1, x2, xq = n + one, x1 + ux, q1 + p, x2 + ux * ux, xq + ux * p
        s[to + k] += n
        s[to + BLOCK + k] += x1
        s[to + 2 * BLOCK + k] += q1
        s[to + 3 * BLOCK + k] += x2
        s[to + 4 * BLOCK + k] += xq


@compiled
@no_type_check
def straight_ground(s: np.ndarray, d: np.ndarray, w: np.ndarray, q: np.ndarray, steps: int, near: int) -> None:
    """A straight line through what lies beyond three widths on both sides of each strip, where weights are positive.

    The strips have ``steps`` lines on either side of the middle one; the first ``near`` of them, and that one, are too near. ``s`` takes its level and slope, the variance of the slope for a pixel variance of 1, and by how much the sides differ.
    """
    s[_SUMS:] = _ZERO
    for line in range(np.uint64(steps - near)):
        _add_side(s, _BEFORE, d, w, q, line * np.uint64(LINE))
    for line in range(np.uint64(steps + near + 1), np.uint64(2 * steps + 1)):
        _add_side(s, _BEHIND, d, w, q, line * np.uint64(LINE))
    for k in range(BLOCK):
        before, behind, one, other = s[_BEFORE + k], s[_BEHIND + k], s[_BEFORE + _Q + k], s[_BEHIND + _Q + k]
        x1, xq = s[_BEFORE + _X + k] + s[_BEHIND + _X + k], s[_BEFORE + _XQ + k] + s[_BEHIND + _XQ + k]
        per = _UNIT / max(before + behind, _UNIT)
        mean_x, mean_q = x1 * per, (one + other) * per
        spread = max(s[_BEFORE + _XX + k] + s[_BEHIND + _XX + k] - mean_x * x1, _TINY)
        both = min(before, behind) > _LEAST_SIDE
        slope = (xq - mean_x * (one + other)) / spread if both else _ZERO
        s[LEVEL + k], s[SLOPE + k] = mean_q - slope * mean_x, slope
        s[VARIANCE + k] = _UNIT / spread if both else _ZERO
        s[DIFFER + k] = abs(one / before - other / behind)


@compiled
@no_type_check
def _add_both(s: np.ndarray, d: np.ndarray, w: np.ndarray, q: np.ndarray, at: int) -> None:
    """One line of a block, from place ``at`` on: the sums under both windows."""
    for k in range(BLOCK):
        shift, slope = s[SHIFT + k], s[SLOPE + k]
        level = s[LEVEL + k] + shift * slope
        by_narrow, by_wide = s[_BY_NARROW + k], s[_BY_WIDE + k]
        g0 = g1 = g2 = p0 = p1 = p2 = w2 = k2 = _ZERO
        h0 = h1 = h2 = q0 = q1 = q2 = v2 = l2 = _ZERO
        for lane in range(3):
            j = at + np.uint64(k + lane * BLOCK)
            x = d[j] - shift
            p = _F(q[j]) - level - slope * x
            square = x * x
            bell = _bell(square * by_wide)
            a, b = w[j] * _bell(square * by_narrow), w[j] * bell
            g = bell * bell
            g *= g
            ag, ap, aa = a * g, a * p, a * square
            bg, bp, bb = b * g, b * p, b * square
            g0, g1, g2 = g0 + ag, g1 + ag * x, g2 + ag * square
            p0, p1, p2 = p0 + ap, p1 + ap * x, p2 + ap * square
            w2, k2 = w2 + aa, k2 + a * aa
            h0, h1, h2 = h0 + bg, h1 + bg * x, h2 + bg * square
            q0, q1, q2 = q0 + bp, q1 + bp * x, q2 + bp * square
            v2, l2 = v2 + bb, l2 + b * bb
        s[_G0 + k] += g0
        s[_G1 + k] += g1
        s[_G2 + k] += g2
        s[_P0 + k] += p0
        s[_P1 + k] += p1
        s[_P2 + k] += p2
        s[_W2 + k] += w2
        s[_K2 + k] += k2
        s[_SECOND + _G0 + k] += h0
        s[_SECOND + _G1 + k] += h1
        s[_SECOND + _G2 + k] += h2
        s[_SECOND + _P0 + k] += q0
        s[_SECOND + _P1 + k] += q1
        s[_SECOND + _P2 + k] += q2
        s[_SECOND + _W2 + k] += v2
        s[_SECOND + _K2 + k] += l2


@compiled
@no_type_check
def _finish(s: np.ndarray, more: int, window: float, short: float) -> int:
    """Centres, uncertainties, widths and heights of a block take the place of its first sums; how many steps are longer than ``short``."""
    far = np.int32(0)
    for k in range(BLOCK):
        width = s[WIDTH + k]
        g0, g1, g2 = s[_G0 + more + k], s[_G1 + more + k], s[_G2 + more + k]
        p0, p1, p2 = s[_P0 + more + k], s[_P1 + more + k], s[_P2 + more + k]
        window_px = max(window * width, _UNIT)
        variance, window_variance = width * width, window_px * window_px
        product = variance * window_variance / (variance + window_variance)
        per_g, per_p = _UNIT / g0, _UNIT / p0
        own, off = g1 * per_g, p1 * per_p
        spread_g, spread_p = g2 * per_g - own * own, p2 * per_p - off * off
        rate = spread_g / product - spread_p / window_variance
        step = (off - own) / min(max(rate, _LEAST_RATE), _UNIT)
        most = _LONGEST * width
        step = min(max(step, -most), most) if abs(step) < _HUGE else _ZERO
        far = np.int32(far + (abs(step) > short))
        peak = g2 * p0 - g1 * p1
        high = peak / (g0 * g2 - g1 * g1)
        from_slope = s[_W2 + more + k]
        u = variance * g0 / peak * np.sqrt(s[_K2 + more + k] + s[VARIANCE + k] * from_slope * from_slope)
        moment = spread_p - spread_g + product
        wide = moment * window_variance / max(window_variance - moment, _THIN * window_variance)
        found = (p0 > _ZERO) & (high > _ZERO) & (u > _ZERO) & (u < _HUGE)
        s[_G0 + more + k] = s[SHIFT + k] + step if found else _NONE
        s[_G1 + more + k] = u
        s[_G2 + more + k] = min(np.sqrt(max(wide, _NARROW)), _TWO * most)
        s[_P0 + more + k] = high
    return far


@compiled
@no_type_check
def centres_of_two(
    s: np.ndarray, d: np.ndarray, w: np.ndarray, q: np.ndarray, first: int, stop: int, short: float
) -> None:
    """Centres, uncertainties for a noise of 1, widths and heights of a block under both windows, until no step is longer than ``short``.

    From the lines ``first`` to ``stop``.

    They stand behind each other from ``NARROW`` and ``WIDE`` on. The steps begin at the shift in ``s``.
    """
    for k in range(BLOCK):
        square = s[WIDTH + k] * s[WIDTH + k]
        s[_BY_NARROW + k], s[_BY_WIDE + k] = _FLAT / max(square, _UNIT), _QUARTER * _FLAT / square
    for _ in range(_MOST_STEPS):
        s[_SUMS:] = _ZERO
        for line in range(np.uint64(first), np.uint64(stop)):
            _add_both(s, d, w, q, line * np.uint64(LINE))
        far = _finish(s, 0, _UNIT, short)
        far += _finish(s, _SECOND, _TWO, short)
        if far == 0:
            break
        for k in range(BLOCK):
            s[SHIFT + k] = s[NARROW + k] if s[NARROW + k] == s[NARROW + k] else s[SHIFT + k]
