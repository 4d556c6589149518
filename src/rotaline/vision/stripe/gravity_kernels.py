"""Grey gravity on the rows or columns in which a stripe was found, in compiled loops. See :mod:`rotaline.vision.stripe.gravity`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.chain_kernels import window_mean
from rotaline.vision.stripe.clear_gravity_kernels import (
    LANES,
    MOST_PAIRS,
    centroids,
    differences,
    half_length,
    has_clipped,
    read_strips,
    saturated_points,
    without_clipped,
)
from rotaline.vision.stripe.judge_kernels import sound_points
from rotaline.vision.stripe.line_kernels import BLOCK, flat_centroids, read_lines, rough_centres
from rotaline.vision.stripe.row_kernels import whole_lines
from rotaline.vision.stripe.uncertainty_kernels import pixel_noise, scatter_and_floor

_WINDOW = 6  # points on either side that settle the direction
_FINE_PX = 0.05  # misfit of a line that is not worth a one-sided window
_WIDTH_PX = 1.5  # of the stripe, to begin with
_LEAST_WIDTH_PX, _MOST_WIDTH_PX = 0.4, 40.0
_LAG, _PAIRS = 3, 64  # points between strips whose pixels are compared; such pairs a chain
_NOISE_FROM = 3.3  # widths: pixels further out tell the noise
_CORE = 1.5  # widths: a clipped pixel as near makes the point saturated


@compiled
@no_type_check
def _fitted(s0: float, s1: float, s2: float, n: float) -> tuple:
    """Mean square misfit and slope of the line through ``n`` values, one a step, from sums of y, i y and y y."""
    variance = max(n * (n * n - 1.0) / 12.0, 1e-9)
    slope = (s1 - 0.5 * (n - 1.0) * s0) / variance
    return max(s2 - s0 * s0 / n - variance * slope * slope, 0.0) / max(n - 2.0, 1.0), slope


@compiled
@no_type_check
def _slopes_at_end(
    place: np.ndarray, first: int, step: int, side_misfit: np.ndarray, side_slope: np.ndarray, slope: np.ndarray
) -> None:
    """Slopes of the points at the end ``first`` of a piece, where there is no room for whole windows; ``step`` leads into it."""
    s0, s1, s2, floor = 0.0, 0.0, 0.0, _FINE_PX * _FINE_PX
    for j in range(2 * _WINDOW):
        y = place[first + step * j] - place[first]
        s0, s1, s2 = s0 + y, s1 + y * j, s2 + y * y
        i = j - _WINDOW
        if i >= 0:
            misfit, best = _fitted(s0, s1, s2, j + 1.0)
            best *= step
            for low in (first + min(step, 0) * _WINDOW, first + step * i + min(step, 0) * _WINDOW):
                other = 4.0 * (side_misfit[low] + floor) - floor
                misfit, best = (other, side_slope[low]) if other < misfit else (misfit, best)
            slope[first + step * i] = best


@compiled
@no_type_check
def _slope_of_all(place: np.ndarray) -> float:
    """Slope of the line through all points."""
    s0, s1, s2 = 0.0, 0.0, 0.0
    for j in range(len(place)):
        y = place[j] - place[0]
        s0, s1, s2 = s0 + y, s1 + y * j, s2 + y * y
    return _fitted(s0, s1, s2, float(len(place)))[1]


@compiled
@no_type_check
def _slopes(place: np.ndarray, side_misfit: np.ndarray, side_slope: np.ndarray, slope: np.ndarray) -> None:
    """Slopes of points, px a line: of a window on both sides, or of the better one-sided window where that fits clearly better.

    Parameters
    ----------
    side_misfit, side_slope, slope : to write; the former two are of the one-sided windows, by their first points
    """
    n, w, floor = len(place), _WINDOW, _FINE_PX * _FINE_PX
    for i in range(np.uint64(max(n - w, 0))):
        s0, s1, s2 = 0.0, 0.0, 0.0
        for j in range(np.uint64(_WINDOW + 1)):
            y = place[i + j] - place[i]
            s0, s1, s2 = s0 + y, s1 + y * j, s2 + y * y
        side_misfit[i], side_slope[i] = _fitted(s0, s1, s2, _WINDOW + 1.0)
    for i in range(np.uint64(max(n - 2 * w, 0))):
        s0, s1, s2 = 0.0, 0.0, 0.0
        for j in range(np.uint64(2 * _WINDOW + 1)):
            y = place[i + j] - place[i]
            s0, s1, s2 = s0 + y, s1 + y * j, s2 + y * y
        misfit, own = _fitted(s0, s1, s2, 2.0 * _WINDOW + 1.0)
        after = i + np.uint64(w)
        other = min(side_misfit[i], side_misfit[after])
        other_slope = side_slope[i] if side_misfit[i] <= side_misfit[after] else side_slope[after]
        slope[after] = other_slope if 4.0 * (other + floor) < misfit + floor else own


@compiled
@no_type_check
def line_normals(uv: np.ndarray, starts: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Normals of pieces with a point on every row, or on every column, (n, 2).

    As :func:`rotaline.vision.stripe.direction_kernels.local_lines` settles them, to which the rows are no news; a short piece has one direction.
    """
    n = len(uv)
    normal, place, slope, side_misfit, side_slope = (
        np.empty_like(uv),
        np.empty(n),
        np.empty(n),
        np.empty(n),
        np.empty(n),
    )
    components, places = normal.reshape(-1), uv.reshape(-1)
    for c in range(len(starts) - 1):
        own, there = place[starts[c] : starts[c + 1]], places[2 * starts[c] + (along[starts[c], 0] == 0.0) :]
        for i in range(len(own)):
            own[i] = there[2 * i]
    _slopes(place, side_misfit, side_slope, slope)
    for c in range(len(starts) - 1):
        start, stop = starts[c], starts[c + 1]
        if stop - start > 2 * _WINDOW:
            _slopes_at_end(place, start, 1, side_misfit, side_slope, slope)
            _slopes_at_end(place, stop - 1, -1, side_misfit, side_slope, slope)
        else:
            slope[start:stop] = _slope_of_all(place[start:stop])
        steep, own, both = along[start, 0] != 0.0, slope[start:stop], components[2 * start :]
        sense = uv[start, 1] - uv[start + 1, 1] if steep else uv[start + 1, 0] - uv[start, 0]
        for i in range(len(own)):
            across = 1.0 / np.sqrt(1.0 + own[i] * own[i])
            one, other = sense * across, own[i] * across
            both[2 * i], both[2 * i + 1] = one if steep else -other, other if steep else one
    return normal


@compiled
@no_type_check
def _differences(
    starts: np.ndarray,
    along: np.ndarray,
    middle: np.ndarray,
    half: np.ndarray,
    off: np.ndarray,
    ground: np.ndarray,
    shift: np.ndarray,
    width: np.ndarray,
) -> tuple:
    """As :func:`rotaline.vision.stripe.strip_kernels.side_differences`, from strips that hold the pixels of one row or column each.

    The strips' own pixels are compared with those of the other strip as far from its centre, interpolated.
    """
    n_chains, longest = len(starts) - 1, 0
    for h in half:
        longest = max(longest, 2 * h)
    out, ends = np.empty(n_chains * _PAIRS * longest, np.float32), np.zeros(n_chains + 1, np.int64)
    m = 0
    for c in range(n_chains):
        n_pairs = starts[c + 1] - starts[c] - _LAG
        pairs = min(max(n_pairs, 0), _PAIRS)
        for k in range(pairs):
            i = starts[c] + (k * n_pairs) // pairs
            j = i + _LAG
            if along[i, 0] != along[j, 0]:
                continue
            h, own, other = half[i // BLOCK], middle[i // BLOCK] + i % BLOCK, middle[j // BLOCK] + j % BLOCK
            centre = shift[i] - off[i]
            further = shift[j] - off[j] - centre
            whole = int(np.floor(further))
            g = np.float32(further - whole)
            gain = 1.0 / np.sqrt(2.0 - 2.0 * g * (1.0 - g))
            side = _NOISE_FROM * width[i]
            inner, outer = int(np.ceil(centre - side)), int(np.floor(centre + side)) + 1
            begin, end = max(-h, -half[j // BLOCK] - whole), min(h, half[j // BLOCK] - 1 - whole)
            for beyond in range(2):
                low, high = (max(begin, outer), end) if beyond else (begin, min(inner, end))
                for t in range(low, high):
                    there = other + BLOCK * (t + whole)
                    p = ground[np.uint64(there)]
                    q = p + g * (ground[np.uint64(there + BLOCK)] - p) - ground[np.uint64(own + BLOCK * t)]
                    out[m] = abs(q) * gain
                    m += q == q
        ends[c + 1] = m
    return out[:m], ends


@compiled
@no_type_check
def measure_found(
    value: np.ndarray,
    source: np.ndarray,
    subtracted: bool,
    limit: float,
    size: tuple,
    least_noise: float,
    uv: np.ndarray,
    chain: np.ndarray,
    spread_px2: np.ndarray,
) -> tuple:
    """Where the stripe is along the rows and columns that the found chains cross: the centroid of what stands above the background.

    A centroid under a bell tells place and width first, in strips for a usual width, and once more in longer ones where these do not reach far enough.

    Parameters
    ----------
    value, source, subtracted, limit, size : of :func:`rotaline.vision.stripe.line_kernels.read_lines`
    least_noise : float   of a pixel
    uv, chain, spread_px2 : of :class:`rotaline.vision.stripe.found.FoundStripe`

    Returns
    -------
    points, starts
    width : (n,)   along the row or column, averaged along the stripe
    along : (n, 2)   direction of the row or column of each point
    normals : (n, 2)   of the stripe
    shifts, uncertainties for a noise of 1, widths, heights; shifts are NaN where there is no stripe
    noise : (n,)   of a pixel
    floor : float   scatter of the centres that the noise does not explain
    saturated : (n,) bool
    """
    uv, starts, along, stretch, measured = whole_lines(uv, chain, spread_px2)
    n = len(uv)
    width, shift, good, moved = np.empty(n), np.zeros(n), np.ones(n, np.bool_), np.empty((n, 2))
    for i in range(n):
        width[i] = np.sqrt(stretch[i]) * _WIDTH_PX
    for _ in range(2):
        middle, half, off, level, ground, hits = read_lines(value, source, subtracted, limit, size, uv, along, width)
        rough, rough_width = rough_centres(middle, half, off, level, ground, width)
        enough = True
        for i in range(n):
            good[i] = abs(rough[i]) <= 1.5 * width[i] + 1.0
            wide = rough_width[i] if good[i] else width[i]
            measured[i] = min(max(wide, _LEAST_WIDTH_PX), _MOST_WIDTH_PX)
            shift[i] = rough[i] if good[i] else 0.0
            moved[i, 0], moved[i, 1] = uv[i, 0] + shift[i] * along[i, 0], uv[i, 1] + shift[i] * along[i, 1]
        window_mean(measured, starts, 10, width)
        for i in range(n):
            enough &= 3.0 * width[i] + 2.5 <= half[i // BLOCK]
        if enough:
            break
    pairs, ends = _differences(starts, along, middle, half, off, ground, shift, width)
    noise = pixel_noise(pairs, ends, starts, least_noise)
    normal = line_normals(moved, starts, along)
    saturated = np.zeros(n, np.bool_)
    for i in range(n):
        at, h, core = middle[i // BLOCK] + i % BLOCK, half[i // BLOCK], _CORE * width[i]
        for t in range(-h, h if hits[i] > 0 else -h):
            clipped = np.isnan(ground[at + t * BLOCK]) and not np.isnan(level[at + t * BLOCK])
            saturated[i] |= clipped and abs(t + off[i] - shift[i]) <= core
    centre, u, wide_px, high = flat_centroids(middle, half, off, level, ground, width, shift, 2)
    for i in range(n):
        if not good[i]:
            centre[i] = np.nan
    _, floor = scatter_and_floor(uv, starts, along, centre, u, noise)
    return uv, starts, width, along, normal, centre, u, wide_px, high, noise, floor, saturated


@compiled
@no_type_check
def clear_points(
    value: np.ndarray,
    source: np.ndarray,
    subtracted: bool,
    limit: float,
    size: tuple,
    least_noise: float,
    uv: np.ndarray,
    chain: np.ndarray,
    spread_px2: np.ndarray,
    least_px: float,
    most_px: float,
    least_height: float,
    least: int,
    min_length: float,
) -> tuple:
    """Measure a clear stripe that is not wide on the rows and columns that the found chains cross, and judge the points.

    The tops of the chains and the spread of these tell place and width.

    Parameters
    ----------
    value, source, subtracted, limit, size, least_noise, uv, chain, spread_px2 : of :func:`measure_found`
    least_px, most_px : float   widths between which the spread tells the width
    least_height, least, min_length : of :func:`rotaline.vision.stripe.judge_kernels.sound_points`

    Returns
    -------
    known : bool   the widths are as they have to be; else nothing was measured
    points   as :func:`rotaline.vision.stripe.judge_kernels.sound_points` returns them
    """
    uv, starts, along, stretch, wide = whole_lines(uv, chain, spread_px2)
    n = len(uv)
    width, known = np.ones(n + LANES), True
    for i in range(n):
        wide[i] = np.sqrt(max(wide[i], _LEAST_WIDTH_PX * _LEAST_WIDTH_PX))
    window_mean(wide, starts, 10, width)
    for i in range(n):
        known &= (least_px <= width[i]) & (width[i] <= most_px)
    if not known:
        n, starts = 0, starts[:1]
        uv, along = uv[:0], along[:0]
    for i in range(n):
        width[i] *= np.sqrt(stretch[i])
    pieces = len(starts) - 1
    halves, most_lanes, most_pixels, most_pairs = np.empty(pieces, np.int64), 0, 0, LANES
    for c in range(pieces):
        m = starts[c + 1] - starts[c]
        halves[c] = half_length(width[starts[c] : starts[c + 1]])
        lanes = (m + LANES - 1) // LANES * LANES
        most_lanes, most_pixels = max(most_lanes, lanes), max(most_pixels, 2 * halves[c] * lanes)
        most_pairs += 2 * halves[c] * min(m, MOST_PAIRS)
    pixel, centre = np.empty(most_lanes, np.int64), np.empty(most_lanes, np.float32)
    level, pairs = np.empty(most_pixels, np.float32), np.empty(most_pairs, np.float32)
    measured, saturated = np.empty((4, n + LANES)), np.zeros(n, np.bool_)
    ends = np.zeros(pieces + 1, np.int64)
    for c in range(pieces):
        start, stop, half = starts[c], starts[c + 1], halves[c]
        own = width[start:stop]
        lanes = (stop - start + LANES - 1) // LANES * LANES
        axis = 0 if along[start, 0] != 0.0 else 1
        read_strips(value, uv[start:stop], axis, size, half, lanes, pixel, centre, level)
        ground, clipped = level, False
        if subtracted or has_clipped(level[: 2 * half * lanes], limit):
            ground = level.copy()
            clipped = without_clipped(source, limit, pixel, size[0] if axis else 1, half, lanes, ground)
        if clipped:
            saturated_points(ground, half, lanes, centre, own, saturated[start:stop])
        centroids(level, ground, half, lanes, centre, width[start:], clipped, measured, start)
        ends[c + 1] = differences(ground, half, lanes, centre, own, clipped, pairs, ends[c])
    shift, u, wide_px, high = measured[0, :n], measured[1, :n], measured[2, :n], measured[3, :n]
    noise = pixel_noise(pairs[: ends[pieces]], ends, starts, least_noise)
    normal = line_normals(uv, starts, along)
    _, floor = scatter_and_floor(uv, starts, along, shift, u, noise)
    points = sound_points(
        uv, starts, along, normal, width[:n], noise, shift, u, wide_px, high, np.zeros(n), saturated, floor, least_height, size, least,
        min_length,
    )  # fmt: skip
    return known, points
