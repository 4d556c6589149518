"""Noise of the pixels and scatter of the centres in compiled loops. See :mod:`rotaline.vision.stripe.plain.uncertainty`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

_GRAINY = 1.25
_TRIM = 0.9
_TRIMMED_TO_SIGMA = 1.267  # of a Gaussian cut at its 90 % quantile
_LEAST_PAIRS, _LEAST_POINTS = 40, 40
_LAGS = (3, 8)  # points between centres that are compared
_HALVINGS = 18
_RUN = 64  # values that are looked at together; what an array lacks to a number of such runs is infinite
_FAR_PX = 9.0  # uncertainty of a point that was not found
_F = np.float32


@compiled
@no_type_check
def _room(n: int) -> np.ndarray:
    """Room for ``n`` values in whole runs, with infinities behind them."""
    size = (n + _RUN - 1) // _RUN * _RUN
    values = np.empty(size, _F)
    values[max(size - _RUN, 0) :] = np.inf
    return values


@compiled
@no_type_check
def _just_above(values: np.ndarray, k: int) -> float:
    """Just above the ``k``-th smallest (from 0) of values in whole runs, by a thousandth of it at the most; single precision, none negative.

    Such numbers are in order as their bits are, which are halved until few are left; counting is done for many values at once.
    """
    bits = values.view(np.int32)
    low, high = np.int32(0), np.int32(0x7F800000)
    for _ in range(_HALVINGS):
        middle, count = np.int32(low + (high - low) // 2), np.int32(0)
        for i in range(len(bits)):
            count = np.int32(count + (bits[i] < middle))
        if count > k:
            high = middle
        else:
            low = middle
    return np.array([high]).view(_F)[0]


@compiled
@no_type_check
def _trimmed(values: np.ndarray, least: int) -> float:
    """Standard deviation of a zero-mean sample from its smaller 90 %; -1 of fewer than ``least`` finite values."""
    own, number = _room(len(values)), np.int32(0)
    for i in range(len(values)):
        own[i] = values[i]
        number = np.int32(number + (own[i] < _F(np.inf)))
    if number < least:
        return -1.0
    k = int(_TRIM * (number - 1))
    limit = _just_above(own, k)
    total, count = _F(0.0), np.int32(0)
    for i in range(len(own)):
        below = own[i] < limit
        v = own[i] if below else _F(0.0)
        count = np.int32(count + below)
        total += v * v
    rest = float(total) + (k + 1 - count) * limit * limit
    return _TRIMMED_TO_SIGMA * np.sqrt(max(rest, 0.0) / (k + 1))


@compiled
@no_type_check
def pixel_noise(differences: np.ndarray, ends: np.ndarray, starts: np.ndarray, floor: float) -> np.ndarray:
    """Standard deviation of a pixel beside each point's chain, from differences as of :func:`rotaline.vision.stripe.strip_kernels.side_differences`.

    Those of chain c are ``ends[c]`` to ``ends[c + 1]``; infinite ones do not count.
    """
    noise, everywhere = np.empty(starts[-1]), np.nan
    for c in range(len(starts) - 1):
        own = _trimmed(differences[ends[c] : ends[c + 1]], _LEAST_PAIRS)
        if own < 0.0:
            everywhere = _trimmed(differences, 1) if np.isnan(everywhere) else everywhere
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
    lag: int,
    limit: float,
    out: np.ndarray,
) -> int:
    """Fourth differences along the normals, from the place of the first of five points on, infinite where the stated uncertainty is above a limit.

    How many are finite.
    """
    number, top = np.int32(0), _F(limit)
    b, c, d, e = np.uint64(lag), np.uint64(2 * lag), np.uint64(3 * lag), np.uint64(4 * lag)
    for i in range(np.uint64(len(out))):
        du = u[i] - _F(4.0) * u[b + i] + _F(6.0) * u[c + i] - _F(4.0) * u[d + i] + u[e + i]
        dv = v[i] - _F(4.0) * v[b + i] + _F(6.0) * v[c + i] - _F(4.0) * v[d + i] + v[e + i]
        clear = stated[c + i] <= top
        out[i] = abs(du * nu[c + i] + dv * nv[c + i]) if clear else _F(np.inf)
        number = np.int32(number + clear)
    return number


@compiled
@no_type_check
def _inner(stated: np.ndarray, starts: np.ndarray, reach: int) -> int:
    """Make the uncertainties of points that are not ``reach`` from the ends of their chain infinite; how many others there are."""
    number = 0
    for c in range(len(starts) - 1):
        start, stop = starts[c], starts[c + 1]
        stated[start : min(start + reach, stop)] = np.inf
        stated[max(stop - reach, start) : stop] = np.inf
        number += max(stop - start - 2 * reach, 0)
    return number


@compiled
@no_type_check
def scatter_and_floor(
    uv: np.ndarray, starts: np.ndarray, normal: np.ndarray, shift_px: np.ndarray, u_px: np.ndarray, noise: np.ndarray
) -> tuple:
    """As :func:`rotaline.vision.stripe.plain.uncertainty.scatter_and_floor`, of points moved by ``shift_px`` (NaN: not found).

    Places in single precision tell fourth differences to 1e-4 px.
    """
    n = len(uv)
    scratch = _room(n)
    size = len(scratch) + 2 * _RUN
    u, v, nu, nv, stated = (
        np.zeros(size, _F),
        np.zeros(size, _F),
        np.empty(size, _F),
        np.empty(size, _F),
        np.empty(size, _F),
    )
    place, across = uv.reshape(-1), normal.reshape(-1)
    for i in range(n):
        found = shift_px[i] == shift_px[i]
        s = shift_px[i] if found else 0.0
        nu[i], nv[i] = across[2 * i], across[2 * i + 1]
        u[i], v[i] = place[2 * i] + s * across[2 * i], place[2 * i + 1] + s * across[2 * i + 1]
        stated[i] = u_px[i] * noise[i] if found else _FAR_PX
    stated[n:] = np.inf
    m = _inner(stated, starts, 2 * _LAGS[0])
    if m < _LEAST_POINTS:
        return 0.0, 0.0
    own = stated[: len(scratch)]
    middle, expected = _just_above(own, m // 2), _just_above(own, m // 4)  # median of all, and of the clear half
    first = measured = limit = 0.0
    for lag in _LAGS:
        m = _inner(stated, starts, 2 * lag)
        if m < _LEAST_POINTS:
            break
        clear = _fourth_differences(u, v, nu, nv, stated, lag, middle, scratch)
        limit = expected * (1.0 + 3.5 / np.sqrt(clear))
        found_now = 1.4826 / np.sqrt(70.0) * _just_above(scratch, clear // 2)
        if lag == _LAGS[0]:
            first = measured = found_now
        elif found_now > _GRAINY * first:
            measured = found_now
        else:
            measured = np.sqrt(0.5 * (first * first + found_now * found_now))
    if measured > limit:
        return measured, np.sqrt(measured * measured - expected * expected)
    return measured, 0.0
