"""Noise of the pixels and scatter of the centres in compiled loops. See :mod:`rotaline.vision.stripe.plain.uncertainty`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

_GRAINY = 1.25
_TRIM = 0.9
_TRIMMED_TO_SIGMA = 1.267  # of a Gaussian cut at its 90 % quantile
_LEAST_PAIRS, _LEAST_POINTS = 40, 40
_MOST_PASSES = 20
_CLOSE, _ABOUT = 0.001, 0.02  # parts of a value; about: what is trimmed by mistake is put back, as large as the limit
_REACH = 6  # points to the outermost of those that tell the scatter of one, at the shorter distance


@compiled
@no_type_check
def _just_above(values: np.ndarray, n: int, k: int, tolerance: float) -> float:
    """Just above the ``k``-th smallest (from 0) of the first ``n`` values, of which more are finite; single precision, none negative.

    Where it can be is divided by four, as their mean bounds it, until it is known to a part ``tolerance`` of it; counting is done for many values at once.
    """
    total, finite = np.float32(0.0), np.int32(0)
    for i in range(n):
        some = values[i] < np.float32(np.inf)
        total += values[i] if some else np.float32(0.0)
        finite += np.int32(some)
    low, high = np.float32(0.0), np.float32(1.001) * total / np.float32(finite - k)
    for _ in range(_MOST_PASSES):
        step = np.float32(0.25) * (high - low)
        a, b, c = low + step, low + step + step, high - step
        below_a, below_b, below_c = np.int32(0), np.int32(0), np.int32(0)
        for i in range(n):
            below_a += np.int32(values[i] < a)
            below_b += np.int32(values[i] < b)
            below_c += np.int32(values[i] < c)
        if below_b > k:
            low, high = (low, a) if below_a > k else (a, b)
        else:
            low, high = (b, c) if below_c > k else (c, high)
        if high - low <= np.float32(tolerance) * high:
            break
    return high


@compiled
@no_type_check
def _trimmed(values: np.ndarray) -> float:
    """Standard deviation of a zero-mean sample from its smaller 90 %."""
    if len(values) == 0:
        return 0.0
    k = int(_TRIM * (len(values) - 1))
    limit = _just_above(values, len(values), k, _ABOUT)
    total, count = np.float32(0.0), np.int32(0)
    for i in range(len(values)):
        v = values[i] if values[i] < limit else np.float32(0.0)
        count += np.int32(values[i] < limit)
        total += v * v
    rest = total + (k + 1.0 - count) * limit * limit
    return _TRIMMED_TO_SIGMA * np.sqrt(max(rest, 0.0) / (k + 1.0))


@compiled
@no_type_check
def pixel_noise(differences: np.ndarray, ends: np.ndarray, starts: np.ndarray, floor: float) -> np.ndarray:
    """Standard deviation of a pixel beside each point's chain, from :func:`rotaline.vision.stripe.strip_kernels.side_differences`."""
    noise, single = np.empty(starts[-1]), differences.astype(np.float32)
    everywhere = -1.0
    for c in range(len(starts) - 1):
        if ends[c + 1] - ends[c] >= _LEAST_PAIRS:
            own = _trimmed(single[ends[c] : ends[c + 1]])
        else:
            if everywhere < 0.0:
                everywhere = _trimmed(single)
            own = everywhere
        noise[starts[c] : starts[c + 1]] = max(own, floor)
    return noise


@compiled
@no_type_check
def _fourth_differences(
    u: np.ndarray,
    v: np.ndarray,
    nu: np.ndarray,
    nv: np.ndarray,
    stated: np.ndarray,
    start: int,
    size: int,
    lag: int,
    limit: float,
    out: np.ndarray,
) -> int:
    """Fourth differences of a chain along its normals where the stated uncertainty is not above a limit, infinite elsewhere; how many are finite."""
    number, a = np.int32(0), np.uint64(start)
    b, c, d, e = a + np.uint64(lag), a + np.uint64(2 * lag), a + np.uint64(3 * lag), a + np.uint64(4 * lag)
    for i in range(np.uint64(size)):
        du = u[a + i] - 4.0 * u[b + i] + 6.0 * u[c + i] - 4.0 * u[d + i] + u[e + i]
        dv = v[a + i] - 4.0 * v[b + i] + 6.0 * v[c + i] - 4.0 * v[d + i] + v[e + i]
        clear = stated[c + i] <= limit
        out[i] = np.float32(abs(du * nu[c + i] + dv * nv[c + i])) if clear else np.float32(np.inf)
        number += np.int32(clear)
    return number


@compiled
@no_type_check
def scatter_and_floor(
    uv: np.ndarray, starts: np.ndarray, normal: np.ndarray, shift_px: np.ndarray, u_px: np.ndarray, noise: np.ndarray
) -> tuple:
    """As :func:`rotaline.vision.stripe.plain.uncertainty.scatter_and_floor`, of points moved by ``shift_px`` (NaN: not found)."""
    n = len(uv)
    u, v, nu, nv, stated = np.empty(n), np.empty(n), np.empty(n), np.empty(n), np.empty(n, np.float32)
    for i in range(n):
        found = shift_px[i] == shift_px[i]
        s = shift_px[i] if found else 0.0
        nu[i], nv[i] = normal[i, 0], normal[i, 1]
        u[i], v[i] = uv[i, 0] + s * nu[i], uv[i, 1] + s * nv[i]
        stated[i] = u_px[i] * noise[i] if found else 9.0
    scratch, m = np.empty(n, np.float32), 0
    for c in range(len(starts) - 1):
        size = max(starts[c + 1] - starts[c] - 2 * _REACH, 0)
        scratch[m : m + size] = stated[starts[c] + _REACH : starts[c] + _REACH + size]
        m += size
    if m < _LEAST_POINTS:
        return 0.0, 0.0
    middle, expected = (
        _just_above(scratch, m, m // 2, _CLOSE),
        _just_above(scratch, m, m // 4, _CLOSE),
    )  # median of all, and of the clear half
    first = measured = limit = 0.0
    for lag in (3, 8):
        m = clear = 0
        for c in range(len(starts) - 1):
            size = max(starts[c + 1] - starts[c] - 4 * lag, 0)
            clear += _fourth_differences(u, v, nu, nv, stated, starts[c], size, lag, middle, scratch[m : m + size])
            m += size
        if m < _LEAST_POINTS:
            break
        limit = expected * (1.0 + 3.5 / np.sqrt(clear))
        found_now = 1.4826 / np.sqrt(70.0) * _just_above(scratch, m, clear // 2, _CLOSE)
        if lag == 3:
            first = measured = found_now
        elif found_now > _GRAINY * first:
            measured = found_now
        else:
            measured = np.sqrt(0.5 * (first * first + found_now * found_now))
    if measured > limit:
        return measured, np.sqrt(measured * measured - expected * expected)
    return measured, 0.0
