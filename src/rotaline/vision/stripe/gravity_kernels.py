"""Grey gravity on the rows or columns in which a stripe was found, in compiled loops. See :mod:`rotaline.vision.stripe.gravity`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.chain_kernels import window_mean
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
def line_normals(uv: np.ndarray, starts: np.ndarray, along: np.ndarray) -> np.ndarray:
    """Normals of pieces with a point on every row, or on every column, (n, 2).

    As :func:`rotaline.vision.stripe.direction_kernels.local_lines` settles them, to which the rows are no news.
    """
    n = len(uv)
    normal, total = np.empty_like(uv), (np.zeros(n + 1), np.zeros(n + 1), np.zeros(n + 1))
    slope, scale, side_misfit, side_slope = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    floor = _FINE_PX * _FINE_PX
    for c in range(len(starts) - 1):
        start, m = starts[c], starts[c + 1] - starts[c]
        k = 0 if along[start, 0] != 0.0 else 1
        s0, s1, s2 = 0.0, 0.0, 0.0
        for i in range(m):
            y = uv[start + i, k] - uv[start, k]
            s0, s1, s2 = s0 + y, s1 + y * i, s2 + y * y
            total[0][i + 1], total[1][i + 1], total[2][i + 1] = s0, s1, s2
        for i in range(m - _WINDOW):  # one-sided windows by their first points
            side_misfit[i], side_slope[i] = _line(total, i, _WINDOW + 1)
        for i in range(_WINDOW, m - _WINDOW):
            misfit, own = _line(total, i - _WINDOW, 2 * _WINDOW + 1)
            before, after = np.uint64(i - _WINDOW), np.uint64(i)
            other = min(side_misfit[before], side_misfit[after])
            other_slope = side_slope[before] if side_misfit[before] <= side_misfit[after] else side_slope[after]
            slope[after] = other_slope if 4.0 * (other + floor) < misfit + floor else own
        for i in range(m):
            if i < _WINDOW or i >= m - _WINDOW:
                slope[i] = _slope_at_end(total, i, m, floor)
        sense = uv[start + 1, 1 - k] - uv[start, 1 - k]
        for i in range(m):
            scale[i] = (1.0 if k else -1.0) / np.sqrt(1.0 + slope[i] * slope[i])
        for i in range(m):
            normal[start + i, k], normal[start + i, 1 - k] = sense * scale[i], -slope[i] * scale[i]
    return normal


@compiled
@no_type_check
def _slope_at_end(total: tuple, i: int, m: int, floor: float) -> float:
    """Slope at point ``i`` of ``m``, where there is no room for whole windows."""
    before, after = max(i - _WINDOW, 0), min(i + _WINDOW, m - 1)
    least, most = min(i, max(m - 1 - _WINDOW, 0)), max(i, min(_WINDOW, m - 1))  # where one-sided windows begin and end
    low = min(before, least)
    misfit, slope = _line(total, low, max(after, most) + 1 - low)
    for low, high in ((before, most), (least, after)):
        other, other_slope = _line(total, low, high + 1 - low)
        if 4.0 * (other + floor) < misfit + floor:
            misfit, slope = 4.0 * (other + floor) - floor, other_slope
    return slope


@compiled
@no_type_check
def _line(total: tuple, low: int, count: int) -> tuple:
    """Mean square misfit and slope of the line through ``count`` points from ``low`` on, from sums of y, i y and y y."""
    first, behind, mean_i = np.uint64(low), np.uint64(low + count), low + 0.5 * (count - 1)
    variance = max(count * (count * count - 1.0) / 12.0, 1e-9)
    y, iy, yy = total
    mean = (y[behind] - y[first]) / count
    slope = (iy[behind] - iy[first] - mean_i * mean * count) / variance
    rest = yy[behind] - yy[first] - count * mean * mean - variance * slope * slope
    return max(rest, 0.0) / max(count - 2.0, 1.0), slope


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
    clear: bool,
    least_px: float,
    most_px: float,
) -> tuple:
    """Where the stripe is along the rows and columns that the found chains cross: the centroid of what stands above the background.

    Where the chains are clear and the stripe is not wide, their tops and the spread of these tell place and width. Otherwise a centroid under a bell
    does, in strips for a usual width, and once more in longer ones where these do not reach far enough.

    Parameters
    ----------
    value, source, subtracted, limit, size : of :func:`rotaline.vision.stripe.line_kernels.read_lines`
    least_noise : float   of a pixel
    uv, chain, spread_px2, clear : of :class:`rotaline.vision.stripe.found.FoundStripe`
    least_px, most_px : float   widths between which the spread tells the width

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
    width, shift, good, moved = np.empty(n), np.zeros(n), np.ones(n, np.bool_), uv
    known = clear
    for i in range(n):
        measured[i] = np.sqrt(max(measured[i], _LEAST_WIDTH_PX * _LEAST_WIDTH_PX))
    window_mean(measured, starts, 10, width)
    for i in range(n):
        known &= least_px <= width[i] <= most_px
    for i in range(n):
        width[i] = np.sqrt(stretch[i]) * (width[i] if known else _WIDTH_PX)
    for _ in range(2):
        middle, half, off, level, ground, hits = read_lines(value, source, subtracted, limit, size, uv, along, width)
        if known:
            break
        rough, rough_width = rough_centres(middle, half, off, level, ground, width)
        moved, enough = np.empty((n, 2)), True
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
    any_hits = False
    for i in range(n):
        any_hits |= hits[i] > 0
    differences, ends = _differences(starts, along, middle, half, off, ground, shift, width)
    noise = pixel_noise(differences, ends, starts, least_noise)
    normal = line_normals(moved, starts, along)
    saturated = np.zeros(n, np.bool_)
    if any_hits:
        for i in range(n):
            at, h, core = middle[i // BLOCK] + i % BLOCK, half[i // BLOCK], _CORE * width[i]
            for t in range(-h, h if hits[i] > 0 else -h):
                clipped = np.isnan(ground[at + t * BLOCK]) and not np.isnan(level[at + t * BLOCK])
                saturated[i] |= clipped and abs(t + off[i] - shift[i]) <= core
    centre, u, wide_px, high = flat_centroids(middle, half, off, level, ground, width, shift, 1 if known else 2)
    for i in range(n):
        if not good[i]:
            centre[i] = np.nan
    _, floor = scatter_and_floor(uv, starts, along, centre, u, noise)
    return uv, starts, width, along, normal, centre, u, wide_px, high, noise, floor, saturated
