"""A laser line has a width, and on a curved surface the middle of its image is not the image of its middle.

Along the stripe's normal in the image (``s``, px) the surface passes through the sheet of light: its distance from the middle of the sheet is
``t(s) = a s + b s^2 / 2`` (mm). Light with the Gaussian profile of the standard deviation ``sigma`` then has its centre of gravity not at ``s = 0`` but at

``shift = sigma^2 E[...] = -3 b sigma^2 / (2 a^3)`` (px),

to first order in ``b``: half of it because the middle of the parabola is not its mean, the rest because the image is denser where the surface is steeper. On a
ball or rod of radius R lit through its axis that takes 3 sigma^2 / R off the diameter. The blur of the lens, being symmetric, changes nothing. A change of
the surface's brightness across the line would add to it; it is small where the sheet passes near the axis, and stands in the uncertainty.

The width itself follows from the widths of the stripes: ``width_px^2 = blur_px^2 + (sigma / a)^2``, and ``a`` differs widely over the surfaces.
"""

import numpy as np
from jaxtyping import Float

SHARE_UNKNOWN = 0.25
"""Standard uncertainty of the correction, as a share of it: profiles are not quite Gaussian, extractors no exact centres of gravity."""
_N_BINS = 24
_MIN_POINTS = 400


def crossing(
    rays: Float[np.ndarray, "n 3"],
    by_px: Float[np.ndarray, "n 2"],
    depth_mm: Float[np.ndarray, " n"],
    normal: Float[np.ndarray, "n 3"],
    curvature: Float[np.ndarray, " n"],
    straight: Float[np.ndarray, "n 3"],
    sheet: Float[np.ndarray, "n 3"],
) -> tuple[Float[np.ndarray, " _"], Float[np.ndarray, " n"]]:
    """How a surface passes through the sheet as the pixel moves along the stripe's normal: ``a`` (mm/px) and ``b`` (mm/px^2).

    Parameters
    ----------
    rays : (n, 3)   viewing rays (x, y, 1), camera frame
    by_px : (n, 2)   derivative of (x, y) by a px along the stripe's normal
    depth_mm : (n,)   z of the points
    normal : (n, 3)   unit normals of the surface
    curvature : (n,)   1/mm: 0 for a plane, 1/R for a sphere or the side of a cylinder
    straight : (n, 3)   unit direction in which the surface is straight: the axis of a cylinder; 0 for a sphere
    sheet : (n, 3)   unit normals of the sheet
    """
    moving = np.column_stack([by_px, np.zeros(len(rays))])
    facing = np.einsum("ni,ni->n", normal, rays)
    turning = np.einsum("ni,ni->n", normal, moving)
    slope = -depth_mm * turning / facing
    along = slope[:, None] * rays + depth_mm[:, None] * moving
    sag = curvature * (np.einsum("ni,ni->n", along, along) - np.einsum("ni,ni->n", along, straight) ** 2)
    second = (-sag - 2.0 * slope * turning) / facing
    through, across = np.einsum("ni,ni->n", sheet, rays), np.einsum("ni,ni->n", sheet, moving)
    return slope * through + depth_mm * across, second * through + 2.0 * slope * across


def centre_shift(a: Float[np.ndarray, " n"], b: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Shift of the stripe's centre along its normal for a line of ``sigma`` = 1 mm, px / mm^2."""
    return np.asarray(-1.5 * b / a**3)


def line_sigma(width_px: Float[np.ndarray, " n"], a: Float[np.ndarray, " n"]) -> float:
    """Standard deviation of the line (mm) from the widths of stripes on surfaces of different steepness; 0 where they do not show it."""
    good = np.isfinite(width_px) & np.isfinite(a) & (np.abs(a) > 0)
    if np.count_nonzero(good) < _MIN_POINTS:
        return 0.0
    x, y = 1.0 / a[good] ** 2, width_px[good] ** 2
    edges = np.quantile(x, np.linspace(0.0, 1.0, _N_BINS + 1))
    place = np.clip(np.searchsorted(edges, x) - 1, 0, _N_BINS - 1)
    bins = [place == k for k in range(_N_BINS) if np.count_nonzero(place == k) >= 10]
    centres = np.array([np.median(x[m]) for m in bins])
    middles = np.array([np.median(y[m]) for m in bins])
    if len(bins) < 4 or np.ptp(centres) < 0.3 * float(np.mean(centres)):
        return 0.0
    blur, slope = np.linalg.lstsq(np.column_stack([np.ones(len(bins)), centres]), middles, rcond=None)[0]
    if blur < 0:  # the line alone makes the width
        slope = float(np.sum(middles * centres) / np.sum(centres**2))
    largest = float(np.median(middles / centres))  # all of the width from the line
    return float(np.sqrt(np.clip(slope, 0.0, largest)))
