"""Grey gravity on the rows or columns in which a stripe was found, in compiled loops. See :mod:`rotaline.vision.stripe.gravity`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.centre_kernels import subtract_sides, weighted_centroids
from rotaline.vision.stripe.chain_kernels import alike, window_mean
from rotaline.vision.stripe.trace_kernels import normals
from rotaline.vision.stripe.uncertainty_kernels import pixel_noise, scatter_and_floor

_SHORT_PX = 0.05  # a step is the last when it is shorter
_FINE_PX = 0.05  # misfit of a line that is not worth a one-sided window
_LEAST_WIDTH_PX, _MOST_WIDTH_PX = 0.4, 40.0


@compiled
@no_type_check
def rough_centres(
    uv: np.ndarray,
    starts: np.ndarray,
    width_px: np.ndarray,
    along: np.ndarray,
    first: np.ndarray,
    count: np.ndarray,
    distance: np.ndarray,
    level: np.ndarray,
    share: np.ndarray,
    clipped: np.ndarray,
    hits: np.ndarray,
) -> tuple:
    """Where the stripe is in strips along rows and columns, and how wide.

    Parameters
    ----------
    along : (n, 2)   direction of the row or column of each point
    level : grey values in, what stands above a line through the sides out

    Returns
    -------
    shift : (n,)   along the row or column
    good : (n,) bool   there is a stripe, as wide as its neighbours
    points, normals : (n, 2)   moved to the stripe; of the stripe
    width : (n,)   along the row or column, averaged along the stripe
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
    for i in range(n):
        good[i] = abs(shift[i]) <= 1.5 * width_px[i] + 1.0
        wide = measured[i] if good[i] else width_px[i]
        measured[i] = min(max(wide, _LEAST_WIDTH_PX), _MOST_WIDTH_PX)
        if not good[i]:
            shift[i] = 0.0
        moved[i, 0], moved[i, 1] = uv[i, 0] + shift[i] * along[i, 0], uv[i, 1] + shift[i] * along[i, 1]
    alike(measured, starts, 0.25, good)
    window_mean(measured, starts, 10, width)
    return shift, good, moved, normals(moved, starts, _FINE_PX), width


@compiled
@no_type_check
def noise_and_floor(
    uv: np.ndarray,
    starts: np.ndarray,
    along: np.ndarray,
    shift_px: np.ndarray,
    u_px: np.ndarray,
    good: np.ndarray,
    differences: np.ndarray,
    ends: np.ndarray,
    least: float,
) -> tuple:
    """Noise of a pixel at each point, and the scatter of the centres that it does not explain; centres that are not ``good`` become NaN."""
    for i in range(len(shift_px)):
        if not good[i]:
            shift_px[i] = np.nan
    noise = pixel_noise(differences, ends, starts, least)
    _, floor = scatter_and_floor(uv, starts, along, shift_px, u_px, noise)
    return noise, floor
