"""Grey gravity of a clear, thin stripe, in compiled loops: the tops that were found tell place and width, so one centroid a point is enough.

The points of a piece stand on rows or on columns one after the other, each with a strip of ``2 * half`` pixels about it. Pixels in the same place of all
strips stand side by side, so that sums over strips are made for ``LANES`` points at once, and for four pixels of each.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

LANES = 32  # points; the strips of a piece are a multiple of it
_F = np.float32
_ZERO, _HALF, _UNIT, _TWO = _F(0.0), _F(0.5), _F(1.0), _F(2.0)
_NARROW, _SIXTH, _ROOT_2PI, _NONE = _F(0.1), _F(1.0 / 6.0), _F(np.sqrt(2.0 * np.pi)), _F(np.nan)
_SIDE = _F(3.0)  # widths: the background begins, the window ends
_REACH, _REACH_PX = 3.5, 6.0  # widths and px to both sides, about
_LAG = 3  # points between strips whose pixels are compared
_PAIRS, _GROUPS = 16, 4  # such pairs side by side; groups of them a piece
_NOISE_FROM = _F(3.3)  # widths: pixels further out tell the noise
MOST_PAIRS = _PAIRS * _GROUPS
_CORE = _F(1.5)  # widths: a clipped pixel as near makes the point saturated
_CENTRE, _LIMIT, _LOW, _HIGH, _LEVEL, _SLOPE = (k * LANES for k in range(6))
_N, _X, _XX = (k * LANES for k in range(6, 9))  # of the pixels in the windows
_CLIPPED, _CLIPPED_X, _CLIPPED_XX = (k * LANES for k in range(9, 12))  # of clipped ones outside
_Q, _XQ, _XXQ = (k * LANES for k in range(12, 15))
_RESULTS, _SIZE = 15 * LANES, 19 * LANES


@compiled
@no_type_check
def half_length(width_px: np.ndarray) -> int:
    """Pixels of the strips of a piece on either side of the points: an even number."""
    quarter = np.int32(0)
    for i in range(len(width_px)):
        quarter = max(quarter, np.int32(0.5 * (_REACH * width_px[i] + _REACH_PX)))
    return 2 * quarter


@compiled
@no_type_check
def read_strips(
    value: np.ndarray,
    uv: np.ndarray,
    axis: int,
    size: tuple,
    half: int,
    lanes: int,
    pixel: np.ndarray,
    centre: np.ndarray,
    level: np.ndarray,
) -> None:
    """Read the strips of a piece. Those that would leave the image are moved into it.

    Parameters
    ----------
    value : (h * w,)
    axis : 0 for strips along rows, 1 along columns
    size : width and height of the image
    lanes : number of points, rounded up; the last point is repeated
    pixel, centre, level : to write: the strips' first pixels; places of the points, counted from the strips' middle pixel; the values,
        those in place t of the strips from ``t * lanes`` on
    """
    m, stride, across = len(uv), (1, size[0])[axis], (size[0], 1)[axis]
    place, line, last = uv[:, axis], uv[:, 1 - axis], float(size[axis] - 2 * half)
    for i in range(m):
        first = min(max(np.floor(place[i]) + (1.0 - half), 0.0), last)
        centre[i] = place[i] - first - half
        pixel[i] = np.int64(first * stride + np.floor(line[i] + 0.5) * across)
    for i in range(m, lanes):
        pixel[i], centre[i] = pixel[m - 1], centre[m - 1]
    for t in range(np.uint64(2 * half)):
        there, off = t * np.uint64(lanes), t * np.uint64(stride)
        for first in range(0, lanes, LANES):
            at = np.uint64(first)
            for k in range(np.uint64(LANES)):
                level[there + at + k] = value[np.uint64(pixel[at + k]) + off]


@compiled
@no_type_check
def has_clipped(level: np.ndarray, limit: float) -> bool:
    """Whether a value is at the limit or above it."""
    number, top = np.int32(0), _F(limit)
    for i in range(len(level)):
        number += np.int32(level[i] >= top)
    return number > 0


@compiled
@no_type_check
def _sum_of_squares(last: float) -> float:
    """Of the whole numbers from 1 to the last."""
    return last * (last + _UNIT) * (_TWO * last + _UNIT) * _SIXTH


@compiled
@no_type_check
def _set_windows(s: np.ndarray, centre: np.ndarray, width_px: np.ndarray, half: int) -> int:
    """Set the windows of a group of strips, and the sums over the pixels in them; an even number of pixels to which they reach."""
    reach = np.int32(0)
    for k in range(LANES):
        middle, limit = centre[k], _SIDE * _F(width_px[k])
        low, high = max(np.ceil(middle - limit), _F(-half)), min(np.floor(middle + limit), _F(half - 1))
        count = high - low + _UNIT
        s[_CENTRE + k], s[_LIMIT + k], s[_LOW + k], s[_HIGH + k] = middle, limit, low, high
        s[_N + k], s[_X + k] = count, _HALF * count * (low + high)
        s[_XX + k] = _sum_of_squares(high) - _sum_of_squares(low - _UNIT)
    for k in range(LANES):
        reach = max(reach, np.int32(max(-s[_LOW + k], s[_HIGH + k] + _UNIT)))
    return (reach + 1) // 2 * 2


@compiled
@no_type_check
def _add_outside(s: np.ndarray, level: np.ndarray, at: int, lanes: int, t: float) -> None:
    """Four pixels of a group of strips, from ``t`` on: sums of the values outside of the windows."""
    for k in range(LANES):
        q0 = q1 = _ZERO
        low, high = s[_LOW + k], s[_HIGH + k]
        for j in range(4):
            q, x = level[at + np.uint64(j * lanes + k)], t + _F(j)
            light = q if (q == q) & ((x < low) | (x > high)) else _ZERO
            q0, q1 = q0 + light, q1 + light * x
        s[_Q + k] += q0
        s[_XQ + k] += q1


@compiled
@no_type_check
def _add_inside(s: np.ndarray, level: np.ndarray, at: int, lanes: int, t: float) -> None:
    """Four pixels of a group of strips, from ``t`` on: moments of what stands above the background in the windows."""
    for k in range(LANES):
        q0 = q1 = q2 = _ZERO
        low, high, ground, slope = s[_LOW + k], s[_HIGH + k], s[_LEVEL + k], s[_SLOPE + k]
        for j in range(4):
            q, x = level[at + np.uint64(j * lanes + k)], t + _F(j)
            light = max(q - ground - slope * x, _ZERO) if (q == q) & (x >= low) & (x <= high) else _ZERO
            q0, q1, q2 = q0 + light, q1 + light * x, q2 + light * (x * x)
        s[_Q + k] += q0
        s[_XQ + k] += q1
        s[_XXQ + k] += q2


@compiled
@no_type_check
def _leave_out(s: np.ndarray, ground: np.ndarray, at: int, half: int, lanes: int) -> None:
    """Count clipped pixels outside of the windows as if they were inside."""
    for t in range(2 * half):
        x = _F(t - half)
        for k in range(LANES):
            q = ground[at + t * lanes + k]
            out = _UNIT if (q != q) & ((x < s[_LOW + k]) | (x > s[_HIGH + k])) else _ZERO
            s[_CLIPPED + k] += out
            s[_CLIPPED_X + k] += out * x
            s[_CLIPPED_XX + k] += out * x * x


@compiled
@no_type_check
def centroids(
    level: np.ndarray,
    ground: np.ndarray,
    half: int,
    lanes: int,
    centre: np.ndarray,
    width_px: np.ndarray,
    clipped: bool,
    out: np.ndarray,
    start: int,
) -> None:
    """Centroid of what stands above the background within three widths of the points of a piece; all grey values count alike.

    The ends of the window fall on whole pixels. The background is a line through what lies outside of it.

    Parameters
    ----------
    level, ground : the ground is NaN where a pixel is clipped
    width_px : (at least lanes,)
    clipped : there are such pixels
    out : (4, n)   to write from ``start`` on, as many as lanes: shifts, NaN where nothing stands above the background; uncertainties for a noise
        of 1; widths; heights
    """
    s = np.empty(_SIZE, _F)
    all_n, all_x = _F(2 * half), _F(-half)
    all_xx = _sum_of_squares(_F(half)) + _sum_of_squares(_F(half - 1))
    for first in range(0, lanes, LANES):
        reach = _set_windows(s, centre[first:], width_px[first:], half)
        s[_CLIPPED:] = _ZERO
        for t in range(0, 2 * half, 4):
            _add_outside(s, ground, np.uint64(first + t * lanes), lanes, _F(t - half))
        if clipped:
            _leave_out(s, ground, first, half, lanes)
        for k in range(LANES):
            count, x = all_n - s[_N + k] - s[_CLIPPED + k], all_x - s[_X + k] - s[_CLIPPED_X + k]
            square, q = all_xx - s[_XX + k] - s[_CLIPPED_XX + k], s[_Q + k]
            mean, light = x / max(count, _UNIT), q / max(count, _UNIT)
            slope = (s[_XQ + k] - mean * q) / max(square - mean * x, _HALF)
            slope = slope if abs(mean - s[_CENTRE + k]) < s[_LIMIT + k] else _ZERO  # one side alone tells no slope
            s[_LEVEL + k], s[_SLOPE + k] = light - slope * mean, slope
        s[_Q:] = _ZERO
        for t in range(half - reach, half + reach, 4):
            _add_inside(s, level, np.uint64(first + t * lanes), lanes, _F(t - half))
        for k in range(LANES):
            mass = s[_Q + k]
            place = s[_XQ + k] / mass
            near = s[_XX + k] - _TWO * place * s[_X + k] + place * place * s[_N + k]
            wide = np.sqrt(max(s[_XXQ + k] / mass - place * place, _NARROW))
            s[_RESULTS + k] = place - s[_CENTRE + k] if mass > _ZERO else _NONE
            s[_RESULTS + LANES + k] = np.sqrt(max(near, _ZERO)) / mass
            s[_RESULTS + 2 * LANES + k], s[_RESULTS + 3 * LANES + k] = wide, mass / (_ROOT_2PI * wide)
        for j in range(4):
            own = out[j, start + first :]
            for k in range(LANES):
                own[k] = s[_RESULTS + j * LANES + k]


@compiled
@no_type_check
def differences(
    ground: np.ndarray,
    half: int,
    lanes: int,
    centre: np.ndarray,
    width_px: np.ndarray,
    clipped: bool,
    out: np.ndarray,
    m: int,
) -> int:
    """Differences of pixels beside a piece, of strips a few points apart and as far from the stripe, scaled to one pixel's noise.

    The strips' own pixels are compared with those of the other strip as far from its centre, interpolated.

    Parameters
    ----------
    clipped : there are pixels that are NaN
    out : to write from ``m`` on

    Returns
    -------
    int   where the differences end
    """
    n_pairs = len(width_px) - _LAG
    if n_pairs <= 0:
        return m
    side_by_side = min(n_pairs, _PAIRS)
    groups = min((n_pairs + _PAIRS - 1) // _PAIRS, _GROUPS)
    further, before, gain = np.empty(_PAIRS, _F), np.empty(_PAIRS, _F), np.empty(_PAIRS, _F)
    for g in range(groups):
        begin = (g * (n_pairs - side_by_side)) // max(groups - 1, 1)
        reach, moved = np.int32(0), np.int32(0)
        for k in range(_PAIRS):
            c = centre[begin + k]
            f = centre[begin + k + _LAG] - c
            further[k], before[k] = max(f, _ZERO), min(f, _ZERO)
            moved += np.int32((c < -_UNIT) | (c >= _ZERO) | (abs(f) >= _UNIT))
            f = abs(f)
            gain[k] = _UNIT / np.sqrt(_TWO - _TWO * f * (_UNIT - f))
        for k in range(side_by_side):
            reach = max(reach, np.int32(_NOISE_FROM * _F(width_px[begin + k])) + np.int32(1))
        if moved > 0:  # at the image's border
            continue
        for beyond in range(2):  # the centres are up to one pixel before the middle pixel
            low, high = (half + reach, 2 * half - 1) if beyond else (1, half - reach)
            for t in range(low, high):
                own = np.uint64(t * lanes + begin)
                there = own + np.uint64(_LAG)
                row, to = np.uint64(lanes), np.uint64(m)
                for k in range(np.uint64(_PAIRS)):
                    p = ground[there + k]
                    q = p + further[k] * (ground[there + row + k] - p) + before[k] * (p - ground[there + k - row])
                    out[to + k] = abs(q - ground[own + k]) * gain[k]
                if not clipped:
                    m += side_by_side
                else:
                    for k in range(m, m + side_by_side):
                        out[m] = out[k]
                        m += out[m] == out[m]
    return m


@compiled
@no_type_check
def without_clipped(
    source: np.ndarray, limit: float, pixel: np.ndarray, stride: int, half: int, lanes: int, ground: np.ndarray
) -> bool:
    """Make those values NaN whose pixels are clipped; whether there are any. They say nothing about the background."""
    found = False
    for i in range(lanes):
        for t in range(2 * half):
            at = t * lanes + i
            if source[pixel[i] + t * stride] >= limit:
                ground[at] = _NONE
                found = True
    return found


@compiled
@no_type_check
def saturated_points(
    ground: np.ndarray, half: int, lanes: int, centre: np.ndarray, width_px: np.ndarray, out: np.ndarray
) -> None:
    """Points with a clipped pixel, which is NaN, in the core of the stripe."""
    for i in range(len(width_px)):
        for t in range(2 * half):
            out[i] |= np.isnan(ground[t * lanes + i]) and abs(_F(t - half) - centre[i]) <= _CORE * width_px[i]
