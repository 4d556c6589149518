"""Which of the measured points are what a stripe gives, in compiled loops. See :mod:`rotaline.vision.stripe.plain.ends`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.chain_kernels import alike, break_chains, median_of
from rotaline.vision.stripe.piece_kernels import LEAST_PART, SLENDER

_REFERENCE, _MOST = 12, 6  # points that say how a piece goes on; points taken from an end


@compiled
@no_type_check
def _continues(
    uv: np.ndarray, width: np.ndarray, at: int, step: int, w: np.ndarray, x: np.ndarray, y: np.ndarray
) -> int:
    """Number of points to take from an end: as :func:`rotaline.vision.stripe.plain.ends.sound_ends`."""
    first, last = at + step * _MOST, at + step * (_MOST + _REFERENCE - 1)
    for k in range(_REFERENCE):
        w[k] = width[first + step * k]
    usual = median_of(w, _REFERENCE)
    for k in range(_REFERENCE):
        w[k] = abs(width[first + step * k] - usual)
    allowed = 0.06 * usual + 6.0 * median_of(w, _REFERENCE)
    cu, cv = uv[last, 0] - uv[first, 0], uv[last, 1] - uv[first, 1]
    length = max(cu * cu + cv * cv, 1e-18)
    s1 = s2 = s3 = s4 = t0 = t1 = t2 = 0.0
    for k in range(_REFERENCE):
        du, dv = uv[first + step * k, 0] - uv[first, 0], uv[first + step * k, 1] - uv[first, 1]
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
        i = at + step * k
        du, dv = uv[i, 0] - uv[first, 0], uv[i, 1] - uv[first, 1]
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
def sound_ends(uv: np.ndarray, starts: np.ndarray, width: np.ndarray) -> np.ndarray:
    """As :func:`rotaline.vision.stripe.plain.ends.sound_ends`."""
    keep = np.ones(len(uv), np.bool_)
    w, x, y = np.empty(_REFERENCE), np.empty(_REFERENCE), np.empty(_REFERENCE)
    for c in range(len(starts) - 1):
        start, stop = starts[c], starts[c + 1]
        if stop - start < _MOST + _REFERENCE:
            continue
        keep[start : start + _continues(uv, width, start, 1, w, x, y)] = False
        keep[stop - _continues(uv, width, stop - 1, -1, w, x, y) : stop] = False
    return keep


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
    good = np.empty(n, np.bool_)
    moved, tangent, u = np.empty((n, 2)), np.empty((n, 2)), np.empty(n)
    for i in range(n):
        cosine = abs(along[i, 0] * normal[i, 0] + along[i, 1] * normal[i, 1])
        u[i] = np.sqrt((u_px[i] * noise[i]) ** 2 + floor * floor + u_edge[i] ** 2) * cosine
        reach_u, reach_v = abs(along[i, 0]) * 2.0 * traced_px[i], abs(along[i, 1]) * 2.0 * traced_px[i]
        good[i] = (
            (abs(shift[i]) <= width[i] + 1.0)
            & (u[i] < 1.0)
            & (height[i] > max(2.5 * noise[i], least_height))
            & (min(uv[i, 0] - reach_u, uv[i, 1] - reach_v) >= 0.0)
            & (uv[i, 0] + reach_u <= size[0] - 1.0)
            & (uv[i, 1] + reach_v <= size[1] - 1.0)
        )
    alike(width, starts, 0.2, good)
    for i in range(n):
        s = shift[i] if good[i] else 0.0
        moved[i, 0], moved[i, 1] = uv[i, 0] + s * along[i, 0], uv[i, 1] + s * along[i, 1]
        tangent[i, 0], tangent[i, 1] = normal[i, 1], -normal[i, 0]
    index, edges = break_chains(moved, tangent, good, starts, least)
    keep = sound_ends(moved[index], edges, width[index])
    most = len(index)
    wide, high, stated, top = np.empty(most), np.empty(most), np.empty(most), np.empty(most, np.bool_)
    segment, out, across = np.empty(most, np.int64), np.empty((most, 2)), np.empty((most, 2))
    m = pieces = 0
    plain = True
    for c in range(len(edges) - 1):
        begin, end = edges[c], edges[c + 1]
        while begin < end and not keep[begin]:
            begin += 1
        while begin < end and not keep[end - 1]:
            end -= 1
        if end - begin < least:
            continue
        first, highest, widest = m, 0.0, 0.0
        for j in range(begin, end):
            i = index[j]
            cosine = abs(along[i, 0] * normal[i, 0] + along[i, 1] * normal[i, 1])
            out[m, 0], out[m, 1], across[m, 0], across[m, 1] = moved[i, 0], moved[i, 1], normal[i, 0], normal[i, 1]
            wide[m], high[m], stated[m], top[m] = width[i] * cosine, height[i], u[i], saturated[i]
            segment[m] = pieces
            highest, widest = max(highest, high[m]), max(widest, wide[m])
            m += 1
        core = 0
        for j in range(first, m):
            core += high[j] > LEAST_PART * highest
        plain &= m - first >= min_length and m - first >= _MOST + _REFERENCE and core >= SLENDER * widest
        pieces += 1
    return out[:m], across[:m], wide[:m], high[:m], stated[:m], top[:m], segment[:m], plain
