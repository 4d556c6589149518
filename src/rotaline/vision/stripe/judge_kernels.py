"""Which of the measured points are what a stripe gives, in compiled loops. See :mod:`rotaline.vision.stripe.plain.ends`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.chain_kernels import alike, break_chains, copy_values, greatest, median_of
from rotaline.vision.stripe.piece_kernels import LEAST_PART, SLENDER

_REFERENCE, _MOST = 12, 6  # points that say how a piece goes on; points taken from an end


@compiled
@no_type_check
def _continues(
    uv: np.ndarray,
    width: np.ndarray,
    index: np.ndarray,
    at: int,
    step: int,
    w: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
) -> int:
    """Number of points to take from an end: as :func:`rotaline.vision.stripe.plain.ends.sound_ends`."""
    first, last = index[at + step * _MOST], index[at + step * (_MOST + _REFERENCE - 1)]
    u0, v0 = uv[first, 0], uv[first, 1]
    for k in range(_REFERENCE):
        w[k] = width[index[at + step * (_MOST + k)]]
    usual = median_of(w, _REFERENCE)
    for k in range(_REFERENCE):
        w[k] = abs(w[k] - usual)
    allowed = 0.06 * usual + 6.0 * median_of(w, _REFERENCE)
    cu, cv = uv[last, 0] - u0, uv[last, 1] - v0
    length = max(cu * cu + cv * cv, 1e-18)
    s1 = s2 = s3 = s4 = t0 = t1 = t2 = 0.0
    for k in range(_REFERENCE):
        i = index[at + step * (_MOST + k)]
        du, dv = uv[i, 0] - u0, uv[i, 1] - v0
        x[k], y[k] = (cu * du + cv * dv) / length, (cu * dv - cv * du) / np.sqrt(length)
        square = x[k] * x[k]
        s1 += x[k]
        s2 += square
        s3 += square * x[k]
        s4 += square * square
        t0 += y[k]
        t1 += y[k] * x[k]
        t2 += y[k] * square
    s0 = float(_REFERENCE)
    # inverse of the symmetric matrix [[s0, s1, s2], [s1, s2, s3], [s2, s3, s4]]
    a, b, c = s2 * s4 - s3 * s3, s2 * s3 - s1 * s4, s1 * s3 - s2 * s2
    d, e, f = s0 * s4 - s2 * s2, s1 * s2 - s0 * s3, s0 * s2 - s1 * s1
    determinant = s0 * a + s1 * b + s2 * c
    if not abs(determinant) > 1e-12:
        return 0
    c0 = (a * t0 + b * t1 + c * t2) / determinant
    c1 = (b * t0 + d * t1 + e * t2) / determinant
    c2 = (c * t0 + e * t1 + f * t2) / determinant
    rest = 0.0
    for k in range(_REFERENCE):
        rest += (y[k] - c0 - c1 * x[k] - c2 * x[k] * x[k]) ** 2
    rest = np.sqrt(rest / _REFERENCE)
    taken = 0
    for k in range(_MOST):
        i = index[at + step * k]
        du, dv = uv[i, 0] - u0, uv[i, 1] - v0
        t, place = (cu * du + cv * dv) / length, (cu * dv - cv * du) / np.sqrt(length)
        square = t * t
        lever = a + 2.0 * b * t + (2.0 * c + d) * square + 2.0 * e * t * square + f * square * square
        doubt = rest * np.sqrt(1.0 + lever / determinant)
        off = abs(place - c0 - c1 * t - c2 * square)
        if not (abs(width[i] - usual) <= allowed and off <= 0.1 + 5.0 * doubt):
            taken = k + 1
    return taken


@compiled
@no_type_check
def sound_ends(uv: np.ndarray, width: np.ndarray, index: np.ndarray, starts: np.ndarray) -> tuple:
    """As :func:`rotaline.vision.stripe.plain.ends.sound_ends`, of the points ``index``: where in it the sound part of each chain begins and ends."""
    w, x, y = np.empty(_REFERENCE), np.empty(_REFERENCE), np.empty(_REFERENCE)
    begin, end = starts[:-1].copy(), starts[1:].copy()
    for c in range(len(begin)):
        start, stop = starts[c], starts[c + 1]
        if stop - start >= _MOST + _REFERENCE:
            begin[c] += _continues(uv, width, index, start, 1, w, x, y)
            end[c] -= _continues(uv, width, index, stop - 1, -1, w, x, y)
    return begin, end


@compiled
@no_type_check
def sound_points(
    uv: np.ndarray,
    starts: np.ndarray,
    along: np.ndarray,
    normal: np.ndarray,
    traced_px: np.ndarray,
    noise: np.ndarray,
    shift: np.ndarray,
    u_px: np.ndarray,
    width: np.ndarray,
    height: np.ndarray,
    u_edge: np.ndarray,
    saturated: np.ndarray,
    floor: float,
    least_height: float,
    size: tuple,
    least: int,
    min_length: float,
) -> tuple:
    """Points that are what a stripe gives, in unbroken pieces.

    Parameters
    ----------
    along, normal : (n, 2)   direction in which ``shift`` moves a point; the stripe's normal
    size : width and height of the image

    Returns
    -------
    uv, normal, width, intensity, u, saturated, segment, plain   of the points that stay; plain: every piece is longer than it is wide and
    than the least length, so that none needs another look
    """
    n = len(uv)
    wide, u, good = np.empty(n), np.empty(n), np.empty(n, np.bool_)
    place, direction, across = uv.reshape(-1), along.reshape(-1), normal.reshape(-1)
    for i in range(n):  # loops over few arrays, which become vector instructions
        wide[i] = abs(direction[2 * i] * across[2 * i] + direction[2 * i + 1] * across[2 * i + 1])
    for i in range(n):
        u[i] = np.sqrt((u_px[i] * noise[i]) ** 2 + floor * floor + u_edge[i] ** 2) * wide[i]
        wide[i] *= width[i]
    for i in range(n):
        good[i] = (abs(shift[i]) <= width[i] + 1.0) & (u[i] < 1.0) & (height[i] > max(2.5 * noise[i], least_height))
    for i in range(n):
        reach_u, reach_v = abs(direction[2 * i]) * 2.0 * traced_px[i], abs(direction[2 * i + 1]) * 2.0 * traced_px[i]
        good[i] &= (
            (min(place[2 * i] - reach_u, place[2 * i + 1] - reach_v) >= 0.0)
            & (place[2 * i] + reach_u <= size[0] - 1.0)
            & (place[2 * i + 1] + reach_v <= size[1] - 1.0)
        )
    alike(width, starts, 0.2, good)
    points, ahead = np.empty((n, 2)), np.empty((n, 2))
    moved, tangent = points.reshape(-1), ahead.reshape(-1)
    for i in range(n):
        s = shift[i] if good[i] else 0.0
        moved[2 * i] = place[2 * i] + s * direction[2 * i]
        moved[2 * i + 1] = place[2 * i + 1] + s * direction[2 * i + 1]
    for i in range(n):
        tangent[2 * i], tangent[2 * i + 1] = across[2 * i + 1], -across[2 * i]
    index, edges = break_chains(points, ahead, good, starts, least)
    begin, end = sound_ends(points, width, index, edges)
    most = len(index)
    out, values = np.empty((2, 2 * most)), np.empty((3, most))
    top, segment = np.empty(most, np.bool_), np.empty(most, np.int64)
    m = pieces = 0
    plain = True
    for c in range(len(begin)):
        count = end[c] - begin[c]
        if count < least:
            continue
        first, j = m, begin[c]
        while j < end[c]:
            i, run = index[j], end[c] - j
            while index[j + run - 1] != i + run - 1:
                run //= 2
            copy_values(moved[2 * i : 2 * (i + run)], out[0, 2 * m :])
            copy_values(across[2 * i : 2 * (i + run)], out[1, 2 * m :])
            copy_values(wide[i : i + run], values[0, m:])
            copy_values(height[i : i + run], values[1, m:])
            copy_values(u[i : i + run], values[2, m:])
            copy_values(saturated[i : i + run], top[m:])
            m, j = m + run, j + run
        segment[first:m] = pieces
        widths, heights = values[0, first:m], values[1, first:m]
        widest, least_high, core = greatest(widths), LEAST_PART * greatest(heights), 0
        for k in range(count):
            core += heights[k] > least_high
        plain &= count >= min_length and count >= _MOST + _REFERENCE and core >= SLENDER * widest
        pieces += 1
    points_out, normal_out = out[0, : 2 * m].reshape((m, 2)), out[1, : 2 * m].reshape((m, 2))
    return points_out, normal_out, values[0, :m], values[1, :m], values[2, :m], top[:m], segment[:m], plain
