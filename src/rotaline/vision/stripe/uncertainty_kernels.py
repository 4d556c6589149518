"""Noise of the pixels and scatter of the centres in compiled loops. See :mod:`rotaline.vision.stripe.plain.uncertainty`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

_GRAINY = 1.25
_TRIM = 0.9
_TRIMMED_TO_SIGMA = 1.267  # of a Gaussian cut at its 90 % quantile
_LEAST_PAIRS, _LEAST_POINTS = 40, 40
_HALVINGS = 20
_REACH = 6  # points to the outermost of those that tell the scatter of one, at the shorter distance


@compiled
@no_type_check
def _just_above(values: np.ndarray, n: int, k: int) -> float:
    """Just above the ``k``-th smallest (from 0) of the first ``n`` values, by less than a thousandth of it; single precision, none negative.

    Such numbers are in order as their bits are, which are halved until few are left; counting is done for many values at once.
    """
    bits = values.view(np.int32)
    low, high = np.int32(0), np.int32(0x7F800000)
    for _ in range(_HALVINGS):
        middle, count = low + (high - low) // np.int32(2), np.int32(0)
        for i in range(n):
            count += np.int32(bits[i] < middle)
        if count > k:
            high = np.int32(middle)
        else:
            low = np.int32(middle)
    return np.array([high]).view(np.float32)[0]


@compiled
@no_type_check
def _trimmed(values: np.ndarray) -> float:
    """Standard deviation of a zero-mean sample from its smaller 90 %."""
    if len(values) == 0:
        return 0.0
    k = int(_TRIM * (len(values) - 1))
    limit = _just_above(values, len(values), k)
    total, count = 0.0, 0
    for i in range(len(values)):
        v = values[i] if values[i] < limit else 0.0
        count += values[i] < limit
        total += v * v
    total += (k + 1 - count) * limit * limit
    return _TRIMMED_TO_SIGMA * np.sqrt(max(total, 0.0) / (k + 1))


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
def scatter_and_floor(
    uv: np.ndarray, starts: np.ndarray, normal: np.ndarray, shift_px: np.ndarray, u_px: np.ndarray, noise: np.ndarray
) -> tuple:
    """As :func:`rotaline.vision.stripe.plain.uncertainty.scatter_and_floor`, of points moved by ``shift_px`` (NaN: not found)."""
    n = len(uv)
    u, v, stated = np.empty(n), np.empty(n), np.empty(n, np.float32)
    for i in range(n):
        found = not np.isnan(shift_px[i])
        s = shift_px[i] if found else 0.0
        u[i], v[i] = uv[i, 0] + s * normal[i, 0], uv[i, 1] + s * normal[i, 1]
        stated[i] = u_px[i] * noise[i] if found else 9.0
    scratch, m = np.empty(n, np.float32), 0
    for c in range(len(starts) - 1):
        for i in range(starts[c] + _REACH, starts[c + 1] - _REACH):
            scratch[m] = stated[i]
            m += 1
    if m < _LEAST_POINTS:
        return 0.0, 0.0
    middle, expected = (
        _just_above(scratch, m, m // 2),
        _just_above(scratch, m, m // 4),
    )  # median of all, and of the clear half
    first = measured = limit = 0.0
    for lag in (3, 8):
        reach = 2 * lag
        m = clear = 0
        for c in range(len(starts) - 1):
            m += max(starts[c + 1] - starts[c] - 2 * reach, 0)
            for i in range(starts[c] + reach, starts[c + 1] - reach):
                du = u[i - reach] - 4.0 * u[i - lag] + 6.0 * u[i] - 4.0 * u[i + lag] + u[i + reach]
                dv = v[i - reach] - 4.0 * v[i - lag] + 6.0 * v[i] - 4.0 * v[i + lag] + v[i + reach]
                scratch[clear] = abs(du * normal[i, 0] + dv * normal[i, 1])
                clear += stated[i] <= middle
        if m < _LEAST_POINTS:
            break
        limit = expected * (1.0 + 3.5 / np.sqrt(clear))
        found_now = 1.4826 / np.sqrt(70.0) * _just_above(scratch, clear, clear // 2)
        if lag == 3:
            first = measured = found_now
        elif found_now > _GRAINY * first:
            measured = found_now
        else:
            measured = np.sqrt(0.5 * (first * first + found_now * found_now))
    if measured > limit:
        return measured, np.sqrt(measured * measured - expected * expected)
    return measured, 0.0
