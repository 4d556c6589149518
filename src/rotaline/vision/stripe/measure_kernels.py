"""The steps from strips to centres in compiled loops. See :mod:`rotaline.vision.stripe.measure`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.centre_kernels import subtract_sides, weighted_centroids
from rotaline.vision.stripe.chain_kernels import window_mean
from rotaline.vision.stripe.strip_kernels import BLOCK, read_strips, side_differences
from rotaline.vision.stripe.uncertainty_kernels import pixel_noise, scatter_and_floor

SIDE_PX, SIDE_WIDTHS = 4.0, 4.0  # the strips reach so many widths and px to both sides
NOISE_FROM = 3.3  # widths: pixels further out tell the noise
LAG, _PAIRS = 3, 64  # points between profiles whose pixels are compared; such pairs a chain
_DIFFER = 4.0  # noises
_AROUND = 8  # points on both sides that tell of an edge
_LEAST_STEPPED = 5  # so few are at a corner, where the side of a point sees what the stripe turns to
_WIDTH_TOLERANCE = 0.08  # a window may be off by this part
WIDER = 1.05  # a wider window, which minds the shape of the profile less, may cost so much scatter
SHORT_PX = 0.25  # a step is the last when it is shorter: the next would be some hundredths of it


@compiled
@no_type_check
def read_stripe(
    value: np.ndarray,
    source: np.ndarray,
    subtracted: bool,
    limit: float,
    size: tuple,
    uv: np.ndarray,
    starts: np.ndarray,
    normal: np.ndarray,
    width_px: np.ndarray,
    lanes: int,
    floor: float,
) -> tuple:
    """The strips of a traced stripe, without their background.

    Parameters
    ----------
    value, source, subtracted, limit, size, lanes
        See :func:`rotaline.vision.stripe.strip_kernels.read_strips`.
    floor : least noise of a pixel

    Returns
    -------
    first, count, distance, level, share, clipped, hits
        See :class:`rotaline.vision.stripe.strips.Strips`.
    line : (n, 3)   of :func:`subtract_sides`
    noise : (n,)   of a pixel
    steps : (n,) bool   the two sides differ, here and around
    any_steps : bool   at some points, which are worth a fit
    any_hits : bool   some pixel is clipped
    """
    n = len(width_px)
    far, side = np.empty(n), np.empty(n)
    for i in range(n):
        far[i], side[i] = SIDE_WIDTHS * width_px[i] + SIDE_PX, NOISE_FROM * width_px[i]
    first, count, distance, level, share, clipped, hits = read_strips(
        value, source, subtracted, limit, size, uv, normal, far, lanes
    )
    differences, ends = side_differences(value, size, uv, normal, starts, side, far, LAG, _PAIRS)
    line, sides = np.empty((n, 3)), np.empty((n, 2))
    subtract_sides(first, count, distance, level, share, clipped, hits, width_px, line, sides)
    noise = pixel_noise(differences, ends, starts, floor)
    steps, some = stepped(np.abs(sides[:, 0] - sides[:, 1]), noise, starts)
    any_hits = False
    for i in range(n):
        any_hits |= hits[i] > 0
    return first, count, distance, level, share, clipped, hits, line, noise, steps, some, any_hits


@compiled
@no_type_check
def stepped(differ: np.ndarray, noise: np.ndarray, starts: np.ndarray) -> tuple:
    """Where the two sides differ by more than the noise, here and around, (n,) bool; and whether that is so at points that are worth a fit."""
    n, some = len(noise), False
    for i in range(n):
        differs = differ[i] > _DIFFER * max(noise[i], 0.3)
        differ[i] = differs
        some |= differs
    steps = np.zeros(n, np.bool_)
    if some:
        mean = np.empty(n)
        window_mean(differ, starts, _AROUND, mean)
        some = False
        number = 0
        for i in range(n):
            steps[i] = mean[i] > 0.5
            number += steps[i]
        some = number >= _LEAST_STEPPED
    return steps, some


@compiled
@no_type_check
def best_centres(
    uv: np.ndarray,
    starts: np.ndarray,
    normal: np.ndarray,
    width_px: np.ndarray,
    noise: np.ndarray,
    first: np.ndarray,
    count: np.ndarray,
    distance: np.ndarray,
    level: np.ndarray,
    share: np.ndarray,
    slope_variance: np.ndarray,
    start_px: np.ndarray,
    window: float,
    adapt: bool,
    most_held_px: float,
    best_scatter: float,
) -> tuple:
    """Centres under a window of one width, and under one of two where these scatter as little.

    Parameters
    ----------
    window : float   the first one, widths
    adapt : bool   take the measured widths, averaged along the stripe
    most_held_px : float   the strips hold the wider window of a stripe up to this width; 0 if that is not wanted
    best_scatter : float   of narrower windows that were tried

    Returns
    -------
    shifts, uncertainties for a noise of 1, measured widths, heights
        Under the best window; under the last one, if no new one is better.
    width : (n,)   widths that were used
    scatter, floor : float   of these centres, and its part that the noise does not explain
    better : bool   they are better than those of narrower windows
    wider : bool   the wider window is still to be tried
    """
    n = len(width_px)
    shift, u, measured, height = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    other_shift, other_u, other_measured, other_height = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    start, width, wanted = start_px.copy(), width_px.copy(), np.ones(n // BLOCK + 1, np.bool_)
    scatter, floor, better, wider = best_scatter, 0.0, False, False
    while True:
        weighted_centroids(
            first, count, distance, level, share, slope_variance, start, width, window, SHORT_PX, wanted,
            other_shift, other_u, other_measured, other_height,
        )  # fmt: skip
        for i in range(n):
            start[i] = start[i] if np.isnan(other_shift[i]) else other_shift[i]
        if adapt:
            adapt = False
            if adapt_widths(other_measured, starts, width_px, width, wanted):
                continue
        wanted[:] = True
        scatter_now, floor_now = scatter_and_floor(uv, starts, normal, other_shift, other_u, noise)
        if not better or scatter_now < WIDER * scatter:
            better = scatter_now < WIDER * scatter
            scatter, floor = scatter_now, floor_now
            shift, other_shift = other_shift, shift
            u, other_u = other_u, u
            measured, other_measured = other_measured, measured
            height, other_height = other_height, height
        if floor_now < 0.5 * scatter_now or window > 1.0 or most_held_px == 0.0:
            break  # where the noise of the pixels explains the scatter, the narrow window is the best
        widest = 0.0
        for i in range(n):
            widest = max(widest, width[i])
        if widest > most_held_px:
            wider = True
            break
        window = 2.0
    return shift, u, measured, height, width, scatter, floor, better, wider


@compiled
@no_type_check
def adapt_widths(
    measured: np.ndarray, starts: np.ndarray, width_px: np.ndarray, width: np.ndarray, changed: np.ndarray
) -> bool:
    """Put measured widths, averaged along the stripe, in the place of ``width`` in blocks in which that matters; whether there are such."""
    n = len(width_px)
    bounded, better = np.empty(n), np.empty(n)
    for i in range(n):
        w = measured[i] if measured[i] > 0.0 else 1.0  # NaN where nothing was seen
        bounded[i] = min(max(w, 0.6 * width_px[i]), 1.5 * width_px[i])
    window_mean(bounded, starts, 10, better)
    some = False
    for a in range(0, n, BLOCK):
        b = min(a + BLOCK, n)
        same = True
        for i in range(a, b):
            same &= abs(better[i] - width[i]) <= _WIDTH_TOLERANCE * width[i]
        changed[a // BLOCK] = not same
        if not same:
            width[a:b] = better[a:b]
            some = True
    return some


@compiled
@no_type_check
def subtract_lines(
    line: np.ndarray, first: np.ndarray, count: np.ndarray, distance: np.ndarray, level: np.ndarray
) -> None:
    """Subtract known lines (n, 3) from strips."""
    for i in range(len(line)):
        c0, c1 = np.float32(line[i, 0]), np.float32(line[i, 1])
        for k in range(first[i], first[i] + BLOCK * count[i], BLOCK):
            level[k] -= c0 + c1 * distance[k]


@compiled
@no_type_check
def clipped_cores(
    hits: np.ndarray,
    start_px: np.ndarray,
    width_px: np.ndarray,
    first: np.ndarray,
    count: np.ndarray,
    distance: np.ndarray,
    clipped: np.ndarray,
) -> np.ndarray:
    """True where a pixel within 1.5 widths of the centre is clipped."""
    saturated = np.zeros(len(hits), np.bool_)
    for i in range(len(hits)):
        if hits[i] > 0:
            for k in range(first[i], first[i] + BLOCK * count[i], BLOCK):
                if clipped[k] and abs(distance[k] - start_px[i]) <= 1.5 * width_px[i]:
                    saturated[i] = True
    return saturated
