"""The steps from strips to centres in compiled loops. See :mod:`rotaline.vision.stripe.measure`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.centre_kernels import subtract_sides, weighted_centroids
from rotaline.vision.stripe.chain_kernels import window_mean
from rotaline.vision.stripe.uncertainty_kernels import pixel_noise, scatter_and_floor

_DIFFER = 4.0  # noises
_SHORT_PX = 1e-3  # a centre is settled when it moves by less


@compiled
@no_type_check
def sides_and_noise(
    starts: np.ndarray,
    width_px: np.ndarray,
    spans: np.ndarray,
    distance: np.ndarray,
    level: np.ndarray,
    share: np.ndarray,
    clipped: np.ndarray,
    hits: np.ndarray,
    differences: np.ndarray,
    ends: np.ndarray,
    floor: float,
) -> tuple:
    """Subtract the background from the strips.

    Returns
    -------
    line : (n, 3)   of :func:`subtract_sides`
    noise : (n,)   of a pixel
    steps : (n,) bool   the two sides differ, here and around
    any_steps : bool
    """
    n = len(width_px)
    line, sides = np.empty((n, 3)), np.empty((n, 2))
    subtract_sides(spans, distance, level, share, clipped, hits, width_px, line, sides)
    noise = pixel_noise(differences, ends, starts, floor)
    differ = np.empty(n)
    some = False
    for i in range(n):
        differs = abs(sides[i, 0] - sides[i, 1]) > _DIFFER * max(noise[i], 0.3)
        differ[i] = differs
        some |= differs
    steps = np.zeros(n, np.bool_)
    if some:
        mean = np.empty(n)
        window_mean(differ, starts, 8, mean)
        some = False
        for i in range(n):
            steps[i] = mean[i] > 0.5
            some |= steps[i]
    return line, noise, steps, some


@compiled
@no_type_check
def centres_under(
    uv: np.ndarray,
    starts: np.ndarray,
    normal: np.ndarray,
    width_px: np.ndarray,
    noise: np.ndarray,
    spans: np.ndarray,
    distance: np.ndarray,
    level: np.ndarray,
    share: np.ndarray,
    slope_variance: np.ndarray,
    start_px: np.ndarray,
    window: float,
) -> tuple:
    """Centres under a window: shifts, uncertainties for a noise of 1, widths, heights; their scatter and its unexplained part."""
    n = len(width_px)
    shift, u, measured, height = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    weighted_centroids(
        spans, distance, level, share, slope_variance, start_px, width_px,
        window, _SHORT_PX, shift, u, measured, height,
    )  # fmt: skip
    scatter, floor = scatter_and_floor(uv, starts, normal, shift, u, noise)
    return shift, u, measured, height, scatter, floor


@compiled
@no_type_check
def subtract_lines(line: np.ndarray, spans: np.ndarray, distance: np.ndarray, level: np.ndarray) -> None:
    """Subtract known lines (n, 3) from strips."""
    for i in range(len(line)):
        c0, c1 = np.float32(line[i, 0]), np.float32(line[i, 1])
        for k in range(spans[i], spans[i + 1]):
            level[k] -= c0 + c1 * distance[k]


@compiled
@no_type_check
def clipped_cores(
    hits: np.ndarray,
    start_px: np.ndarray,
    width_px: np.ndarray,
    spans: np.ndarray,
    distance: np.ndarray,
    clipped: np.ndarray,
) -> np.ndarray:
    """True where a pixel within 1.5 widths of the centre is clipped."""
    saturated = np.zeros(len(hits), np.bool_)
    for i in range(len(hits)):
        if hits[i] > 0:
            for k in range(spans[i], spans[i + 1]):
                if clipped[k] and abs(distance[k] - start_px[i]) <= 1.5 * width_px[i]:
                    saturated[i] = True
    return saturated
