"""Centres of the stripe from strips of pixels (:mod:`rotaline.vision.stripe.strip_kernels`), in compiled loops.

The sums over a strip are made in single precision, eight pixels at once; what that leaves out is 1e-6 of a pixel.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

_F = np.float32
_ZERO, _UNIT, _FLAT, _PART = _F(0.0), _F(1.0), _F(16.0), _F(1.0 / 16.0)
_SIDE = 3.0  # the sides begin so many widths from the centre
_LEAST_SIDE = 2  # pixels
_MOST_STEPS = 6
_LEAST_WINDOW_PX = 1.0
# exp(-t), 0 <= t <= 1, to 1e-6
_C0, _C1, _C2 = _F(0.9999995544211945), _F(-0.9999678512243936), _F(0.4996208737479462)
_C3, _C4, _C5 = _F(-0.16501271678028187), _F(0.03833892232810025), _F(-0.0050997276264818465)


@compiled
@no_type_check
def _bell(t: float) -> float:
    """exp(-t) for t >= 0, single precision; what is below 1e-7 is about that."""
    t = min(t, _FLAT) * _PART
    e = _C0 + t * (_C1 + t * (_C2 + t * (_C3 + t * (_C4 + t * _C5))))
    e = e * e
    e = e * e
    e = e * e
    return e * e


@compiled
@no_type_check
def _sums(
    distance: np.ndarray,
    above: np.ndarray,
    share: np.ndarray,
    a: int,
    b: int,
    shift: float,
    by_shape: float,
    by_window: float,
) -> tuple:
    """Sums over a strip that settle height and step of the centroid: of weight times bell, and of weight times light, times powers of x."""
    g0, g1, g2, p0, p1, p2 = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    s, q, r = _F(shift), _F(by_shape), _F(by_window)
    d, p, w = distance[a:b], above[a:b], share[a:b]
    if by_shape == by_window:
        for k in range(len(d)):
            x = d[k] - s
            square = x * x
            g = _bell(square * q)
            weight = w[k] * g
            wg = weight * g
            wp = weight * p[k]
            g0 += wg
            g1 += wg * x
            g2 += wg * square
            p0 += wp
            p1 += wp * x
            p2 += wp * square
    else:
        for k in range(len(d)):
            x = d[k] - s
            square = x * x
            weight = w[k] * _bell(square * r)
            wg = weight * _bell(square * q)
            wp = weight * p[k]
            g0 += wg
            g1 += wg * x
            g2 += wg * square
            p0 += wp
            p1 += wp * x
            p2 += wp * square
    return g0, g1, g2, p0, p1, p2


@compiled
@no_type_check
def _noise_sums(distance: np.ndarray, share: np.ndarray, a: int, b: int, shift: float, by_window: float) -> tuple:
    """Sums of weight squared times powers of x, and of weight times x and its square."""
    k0, k1, k2, w1, w2 = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
    s, r = _F(shift), _F(by_window)
    d, w = distance[a:b], share[a:b]
    for k in range(len(d)):
        x = d[k] - s
        square = x * x
        weight = w[k] * _bell(square * r)
        wx = weight * x
        k0 += weight * weight
        k1 += weight * wx
        k2 += wx * wx
        w1 += wx
        w2 += weight * square
    return k0, k1, k2, w1, w2


@compiled
@no_type_check
def weighted_centroids(
    spans: np.ndarray,
    distance: np.ndarray,
    above: np.ndarray,
    share: np.ndarray,
    slope_variance: np.ndarray,
    start_px: np.ndarray,
    width_px: np.ndarray,
    window: float,
    short_px: float,
    shift_px: np.ndarray,
    u_px: np.ndarray,
    measured_px: np.ndarray,
    height: np.ndarray,
) -> None:
    """As :func:`rotaline.vision.stripe.plain.centres.weighted_centroid`, until a step is shorter than ``short_px``. Results stand in the last four arrays."""
    for i in range(len(start_px)):
        a, b = spans[i], spans[i + 1]
        width = width_px[i]
        variance = width * width
        window_variance = max(window * width, _LEAST_WINDOW_PX) ** 2
        by_shape, by_window = 0.5 / variance, 0.5 / window_variance
        shift = start_px[i]
        for _ in range(_MOST_STEPS):
            f0, f1, f2, q0, q1, q2 = _sums(distance, above, share, a, b, shift, by_shape, by_window)
            g0, g1, g2, p0, p1, p2 = float(f0), float(f1), float(f2), float(q0), float(q1), float(q2)
            determinant = g0 * g2 - g1 * g1
            peak = g2 * p0 - g1 * p1
            step = variance * (g0 * p1 - g1 * p0) / peak
            if not np.isfinite(step):
                break
            step = min(max(step, -1.5 * width), 1.5 * width)
            shift += step
            if abs(step) < short_px:
                break
        f0, f1, f2, w1, w2 = _noise_sums(distance, share, a, b, shift, by_window)
        k0, k1, k2 = float(f0), float(f1), float(f2)
        from_slope = g0 * w2 - g1 * w1
        high = peak / determinant
        u = (
            variance
            / peak
            * np.sqrt(g0 * g0 * k2 - 2.0 * g0 * g1 * k1 + g1 * g1 * k0 + slope_variance[i] * from_slope * from_slope)
        )
        product = variance * window_variance / (variance + window_variance)
        moment = p2 / p0 - g2 / g0 + product
        wide = moment * window_variance / max(window_variance - moment, 1e-3 * window_variance)
        found = p0 > 0 and high > 0 and np.isfinite(u) and u > 0
        shift_px[i] = shift if found else np.nan
        u_px[i] = u
        measured_px[i] = min(np.sqrt(max(wide, 0.1)), 3.0 * width)
        height[i] = high


@compiled
@no_type_check
def subtract_sides(
    spans: np.ndarray,
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
    for i in range(len(width_px)):
        limit = _F(_SIDE * width_px[i])
        d, p, share_i = (
            distance[spans[i] : spans[i + 1]],
            above[spans[i] : spans[i + 1]],
            share[spans[i] : spans[i + 1]],
        )
        if hits[i]:
            for k in range(len(d)):
                if clipped[spans[i] + k]:
                    share_i[k] = -share_i[k]
        reference = _ZERO
        for k in range(len(d)):
            if share_i[k] > _ZERO:
                reference = p[k]
                break
        n, m, x1, x2, p1, xp, left = _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO, _ZERO
        for k in range(len(d)):
            x, q = d[k], p[k] - reference
            use = _UNIT if (abs(x) > limit) & (share_i[k] > _ZERO) else _ZERO
            negative = use if x < _ZERO else _ZERO
            n += use
            m += negative
            left += negative * q
            x1 += use * x
            p1 += use * q
            x2 += use * x * x
            xp += use * x * q
        if hits[i]:
            for k in range(len(d)):
                share_i[k] = abs(share_i[k])
        count, below, sum_x, sum_p, sum_left = float(n), float(m), float(x1), float(p1), float(left)
        slope, variance, level = 0.0, 0.0, 0.0
        if count > 0.0:
            mean_x, mean_p = sum_x / count, sum_p / count
            if below >= _LEAST_SIDE and count - below >= _LEAST_SIDE:
                spread = max(float(x2) - count * mean_x * mean_x, 1e-9)
                slope = (float(xp) - mean_x * sum_p) / spread
                variance = 1.0 / spread
            level = mean_p - slope * mean_x
        level += reference
        sides[i, 0] = sum_left / below + reference if below > 0.0 else np.nan
        sides[i, 1] = (sum_p - sum_left) / (count - below) + reference if count > below else np.nan
        line[i, 0], line[i, 1], line[i, 2] = level, slope, variance
        c0, c1 = _F(level), _F(slope)
        for k in range(len(d)):
            p[k] -= c0 + c1 * d[k]
