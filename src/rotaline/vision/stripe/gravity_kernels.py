"""Grey gravity on the rows or columns in which a stripe was found, in compiled loops. See :mod:`rotaline.vision.stripe.gravity`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.centre_kernels import subtract_sides, weighted_centroids
from rotaline.vision.stripe.chain_kernels import alike, starts_of, window_mean
from rotaline.vision.stripe.measure_kernels import clipped_cores
from rotaline.vision.stripe.row_kernels import cross_lines, flat_centroids
from rotaline.vision.stripe.strip_kernels import BLOCK
from rotaline.vision.stripe.trace_kernels import normals
from rotaline.vision.stripe.uncertainty_kernels import pixel_noise, scatter_and_floor

_CHORD = 6  # points on either side that settle the direction
_WIDTH_PX = 1.5  # of the stripe, to begin with
_SHORT_PX = 0.3  # a step is the last when it is shorter: good enough to know the width
_FINE_PX = 0.05  # misfit of a line that is not worth a one-sided window
_LEAST_WIDTH_PX, _MOST_WIDTH_PX = 0.4, 40.0
_LAG, _PAIRS = 3, 64  # points between strips whose pixels are compared; such pairs a chain


@compiled
@no_type_check
def whole_lines(uv: np.ndarray, chain: np.ndarray) -> tuple:
    """The points of the found chains on whole rows or columns.

    Returns
    -------
    points, starts, widths as seen along the row or column, direction of the row or column
    """
    starts = starts_of(chain)
    n = len(uv)
    normal, width = np.empty((n, 2)), np.empty(n)
    for c in range(len(starts) - 1):
        for i in range(starts[c], starts[c + 1]):
            a, b = max(i - _CHORD, starts[c]), min(i + _CHORD, starts[c + 1] - 1)
            du, dv = uv[b, 0] - uv[a, 0], uv[b, 1] - uv[a, 1]
            length = max(np.sqrt(du * du + dv * dv), 1e-9)
            normal[i, 0], normal[i, 1], width[i] = -dv / length, du / length, _WIDTH_PX
    points, edges, wide, along, _ = cross_lines(uv, starts, width, normal)
    return points, edges, wide, along


@compiled
@no_type_check
def _differences(
    starts: np.ndarray,
    uv: np.ndarray,
    along: np.ndarray,
    first: np.ndarray,
    count: np.ndarray,
    distance: np.ndarray,
    level: np.ndarray,
    share: np.ndarray,
    line: np.ndarray,
    shift: np.ndarray,
    width: np.ndarray,
    near: float,
) -> tuple:
    """As :func:`rotaline.vision.stripe.strip_kernels.side_differences`, from strips that hold the pixels of one row or column each.

    Beyond ``near`` widths; the strips' own pixels are compared with those of the other strip, interpolated.
    """
    n_chains = len(starts) - 1
    room = 0
    for c in range(n_chains):
        pairs = min(max(starts[c + 1] - starts[c] - _LAG, 0), _PAIRS)
        longest = 0
        for i in range(starts[c], starts[c + 1]):
            longest = max(longest, count[i])
        room += pairs * longest
    out, ends = np.empty(room), np.zeros(n_chains + 1, np.int64)
    m = 0
    for c in range(n_chains):
        n_pairs = starts[c + 1] - starts[c] - _LAG
        pairs = min(max(n_pairs, 0), _PAIRS)
        for k in range(pairs):
            i = starts[c] + (k * n_pairs) // pairs
            j = i + _LAG
            if along[i, 0] != along[j, 0] or along[i, 1] != along[j, 1]:
                continue
            x, step = distance[first[i]] - shift[i], along[i, 0] + along[i, 1]
            off = (x + shift[j] - distance[first[j]]) / step
            further = int(np.floor(off))
            g = off - further
            middle, side = -x / step, near * width[i]
            inner, outer = int(np.ceil(middle - side)), int(np.floor(middle + side)) + 1
            begin, end = max(0, -further), min(count[i], count[j] - 1 - further)
            gain = 1.0 / np.sqrt(2.0 - 2.0 * g * (1.0 - g))
            # what was taken away: lines in d; the other strip's is looked at as far from its centre
            level_i, level_j = line[i, 0] + line[i, 1] * shift[i], line[j, 0] + line[j, 1] * shift[j]
            back, slope = level_i - level_j, line[i, 1] - line[j, 1]
            for half in range(2):
                low, high = (max(begin, outer), end) if half else (begin, min(inner, end))
                for place in range(low, high):
                    one, two = first[i] + BLOCK * place, first[j] + BLOCK * (place + further)
                    if min(share[one], min(share[two], share[two + BLOCK])) > 0.0:
                        q = (1.0 - g) * level[two] + g * level[two + BLOCK]
                        out[m] = abs(level[one] - q + back + slope * (x + step * place)) * gain
                        m += 1
        ends[c + 1] = m
    return out[:m], ends


@compiled
@no_type_check
def centres_on_lines(
    uv: np.ndarray,
    starts: np.ndarray,
    width_px: np.ndarray,
    along: np.ndarray,
    reach_px: np.ndarray,
    first: np.ndarray,
    count: np.ndarray,
    distance: np.ndarray,
    level: np.ndarray,
    share: np.ndarray,
    clipped: np.ndarray,
    hits: np.ndarray,
    least_noise: float,
    noise_from: float,
    side: float,
    again: bool,
) -> tuple:
    """Where the stripe is in strips along rows and columns: the centroid of what stands above the background.

    Parameters
    ----------
    along : (n, 2)   direction of the row or column of each point
    reach_px : (n,)   half length of the strips
    level : grey values in, what stands above a line through the sides out
    least_noise : float   of a pixel
    noise_from, side : float   widths: pixels further out tell the noise; the background begins
    again : bool   to stop when the strips do not reach far enough

    Returns
    -------
    width : (n,)   along the row or column, averaged along the stripe
    enough : bool   the strips are long enough; otherwise what follows is empty
    normals : (n, 2)   of the stripe
    shifts, uncertainties for a noise of 1, widths, heights; shifts are NaN where there is no stripe, or it is not as wide as beside
    noise : (n,)   of a pixel
    floor : float   scatter of the centres that the noise does not explain
    saturated : (n,) bool
    """
    n = len(uv)
    line, sides = np.empty((n, 3)), np.empty((n, 2))
    subtract_sides(first, count, distance, level, share, clipped, hits, width_px, line, sides)
    shift, measured, good, height = np.empty(n), np.empty(n), np.empty(n, np.bool_), np.empty(n)
    weighted_centroids(
        first, count, 1, distance, level, share, line[:, 2], np.zeros(n), width_px, 1.0, _SHORT_PX, shift, np.empty(0),
        measured, height,
    )  # fmt: skip
    moved, width = np.empty((n, 2)), np.empty(n)
    any_hits = False
    for i in range(n):
        good[i] = abs(shift[i]) <= 1.5 * width_px[i] + 1.0
        wide = measured[i] if good[i] else width_px[i]
        measured[i] = min(max(wide, _LEAST_WIDTH_PX), _MOST_WIDTH_PX)
        if not good[i]:
            shift[i] = 0.0
        moved[i, 0], moved[i, 1] = uv[i, 0] + shift[i] * along[i, 0], uv[i, 1] + shift[i] * along[i, 1]
        any_hits |= hits[i] > 0
    alike(measured, starts, 0.25, good)
    window_mean(measured, starts, 10, width)
    enough = True
    for i in range(n):
        enough &= side * width[i] + 2.0 <= reach_px[i]
    if again and not enough:
        none, no_shift = np.empty((0, 2)), np.empty(0)
        return width, False, none, no_shift, no_shift, no_shift, no_shift, no_shift, 0.0, good
    differences, ends = _differences(
        starts, uv, along, first, count, distance, level, share, line, shift, width, noise_from
    )
    noise = pixel_noise(differences, ends, starts, least_noise)
    normal = normals(moved, starts, _FINE_PX)
    saturated = np.zeros(n, np.bool_)
    if any_hits:
        saturated = clipped_cores(hits, shift, width, first, count, distance, clipped)
    centre, u, wide_px, high = flat_centroids(first, count, distance, level, share, clipped, hits, width, shift)
    for i in range(n):
        if not good[i]:
            centre[i] = np.nan
    _, floor = scatter_and_floor(uv, starts, along, centre, u, noise)
    return width, True, normal, centre, u, wide_px, high, noise, floor, saturated
