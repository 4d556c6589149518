"""Directions along chains of points, from straight lines through the neighbours, in compiled loops.

See :mod:`rotaline.vision.stripe.plain.curve`. Chain k is the points ``starts[k]`` to ``starts[k + 1]``.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled


@compiled
@no_type_check
def _sums(pairs: np.ndarray, total: np.ndarray) -> None:
    """Sums along a chain, ``pairs`` u, v, u, v, ..., up to each point: of u, v, i u, i v and u u + v v, from its first point."""
    n, u0, v0 = len(pairs) // 2, pairs[0], pairs[1]
    u, v, iu, iv, square = total[0, 1:], total[1, 1:], total[2, 1:], total[3, 1:], total[4, 1:]
    for i in range(n):
        du, dv = pairs[2 * i] - u0, pairs[2 * i + 1] - v0
        u[i], v[i], iu[i], iv[i], square[i] = du, dv, du * i, dv * i, du * du + dv * dv
    total[:, 0] = 0.0
    s0, s1, s2, s3, s4 = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        s0, s1, s2, s3, s4 = s0 + u[i], s1 + v[i], s2 + iu[i], s3 + iv[i], s4 + square[i]
        u[i], v[i], iu[i], iv[i], square[i] = s0, s1, s2, s3, s4


@compiled
@no_type_check
def _line(total: np.ndarray, low: int, count: int) -> tuple:
    """The line through ``count`` points from ``low`` on, of :func:`_sums`: mean, slope (u and v of both), and mean square misfit."""
    high = low + count
    mean_t, var_t = low + 0.5 * (count - 1.0), max(count * (count * count - 1.0) / 12.0, 1e-9)
    sum_u, sum_v = total[0, high] - total[0, low], total[1, high] - total[1, low]
    mean_u, mean_v = sum_u / count, sum_v / count
    slope_u = (total[2, high] - total[2, low] - mean_t * sum_u) / var_t
    slope_v = (total[3, high] - total[3, low] - mean_t * sum_v) / var_t
    rest = total[4, high] - total[4, low] - sum_u * mean_u - sum_v * mean_v
    rest -= var_t * (slope_u * slope_u + slope_v * slope_v)
    return mean_u, mean_v, slope_u, slope_v, max(rest, 0.0) / max(count - 2.0, 1.0)


@compiled
@no_type_check
def _whole_windows(
    u0: float, v0: float, total: np.ndarray, half_window: int, floor: float, smooth: np.ndarray, tangent: np.ndarray
) -> None:
    """Lines at the points whose window does not leave the chain; ``smooth`` and ``tangent`` begin with the first of them.

    The windows on one side of a point are those that end at it (b) or begin at it (c).
    """
    m, reach = total.shape[1] - 1 - 2 * half_window, 0.5 * half_window
    for i in range(m):
        mean_u, mean_v, slope_u, slope_v, misfit = _line(total, i, 2 * half_window + 1)
        bu, bv, btu, btv, before = _line(total, i, half_window + 1)
        cu, cv, ctu, ctv, after = _line(total, i + half_window, half_window + 1)
        best, before, after = misfit + floor, 4.0 * (before + floor), 4.0 * (after + floor)
        b, c = before < best, after < min(best, before)
        mean_u = cu - reach * ctu if c else bu + reach * btu if b else mean_u
        mean_v = cv - reach * ctv if c else bv + reach * btv if b else mean_v
        slope_u, slope_v = ctu if c else btu if b else slope_u, ctv if c else btv if b else slope_v
        square = slope_u * slope_u + slope_v * slope_v
        some = square > 1e-18
        per_norm = 1.0 / np.sqrt(square if some else 1.0)
        smooth[2 * i], smooth[2 * i + 1] = u0 + mean_u, v0 + mean_v
        tangent[2 * i], tangent[2 * i + 1] = slope_u * per_norm if some else 1.0, slope_v * per_norm if some else 0.0


@compiled
@no_type_check
def local_lines(
    uv: np.ndarray, starts: np.ndarray, half_window: int, noise_px: float, smooth: np.ndarray, tangent: np.ndarray
) -> None:
    """As :func:`rotaline.vision.stripe.plain.curve.local_lines`."""
    floor = noise_px * noise_px
    for k in range(len(starts) - 1):
        start, stop = starts[k], starts[k + 1]
        n = stop - start
        if n == 0:
            continue
        pairs = uv.reshape(-1)[2 * start : 2 * stop]
        lines, ahead = smooth.reshape(-1)[2 * start : 2 * stop], tangent.reshape(-1)[2 * start : 2 * stop]
        total = np.empty((5, n + 1))
        _sums(pairs, total)
        u0, v0, end, whole = pairs[0], pairs[1], n - 1, max(n - 2 * half_window, 0)
        if whole > 0:
            _whole_windows(u0, v0, total, half_window, floor, lines[2 * half_window :], ahead[2 * half_window :])
        first, last = max(end - half_window, 0), min(half_window, end)
        for j in range(n - whole):
            i = j if j < half_window else j + whole
            before, after = max(i - half_window, 0), min(i + half_window, end)
            best = np.inf
            su, sv, tu, tv = pairs[2 * i], pairs[2 * i + 1], 0.0, 0.0
            for rank in range(3):
                if rank == 0:
                    low, high = min(before, first), max(after, last)
                elif best <= 4.0 * floor:
                    break
                elif rank == 1:
                    low, high = before, max(i, last)
                else:
                    low, high = min(i, first), after
                mean_u, mean_v, slope_u, slope_v, misfit = _line(total, low, high + 1 - low)
                misfit = (misfit + floor) * (4.0 if rank else 1.0)
                if misfit < best:
                    best, off = misfit, i - 0.5 * (low + high)
                    su, sv = u0 + mean_u + slope_u * off, v0 + mean_v + slope_v * off
                    tu, tv = slope_u, slope_v
            norm = np.sqrt(tu * tu + tv * tv)
            some = norm > 1e-9
            lines[2 * i], lines[2 * i + 1] = su, sv
            ahead[2 * i], ahead[2 * i + 1] = tu / norm if some else 1.0, tv / norm if some else 0.0
