"""How a surface passes through the sheet of light, and how wide the line is.

What the width of the line does to the centre of a stripe on a curved surface stands in :mod:`rotaline.calibration.stripe_shift`; here are the
derivatives that it needs, and the width itself. It follows from the widths of the stripes on surfaces of different steepness ``a`` (mm of distance from the sheet
per px): ``width_px^2 = blur_px^2 + (sigma / a)^2``.
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


def line_and_blur(width_px: Float[np.ndarray, " n"], a: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Standard deviations of the line (mm) and of the blur (px) from the widths of stripes on surfaces of different steepness.

    The line is 0 where they do not show it.
    """
    sigma = _line_sigma(width_px, a)
    good = np.isfinite(width_px) & np.isfinite(a) & (np.abs(a) > 0)
    if not good.any():
        return sigma, 0.0
    return sigma, float(np.sqrt(max(float(np.median(width_px[good] ** 2 - (sigma / a[good]) ** 2)), 0.0)))


def _line_sigma(width_px: Float[np.ndarray, " n"], a: Float[np.ndarray, " n"]) -> float:
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
