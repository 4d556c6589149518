"""Where the light of a point goes on the sensor: pixels of side 1 behind a Gaussian blur, and the points that stand for an area.

Light that the lens spreads over a Gaussian falls on the pixel at the distance x with the share ``F(x) F(y)``,
``F(x) = Phi((x + 1/2) / s) - Phi((x - 1/2) / s)``. Pixels whose light is even give the pixel at the distance i
``W(i) W(j)``, ``W`` the mean of ``F`` over a pixel. A point inside a pixel stands for an area, and hands its light to all
pixels that its blur reaches.
"""

from functools import lru_cache

import numpy as np
from jaxtyping import Float
from scipy.special import ndtr

_SHARP_PX = 1e-3


def reach_px(sigma_px: float) -> int:
    """How many pixels away the light of a point may fall."""
    return 0 if sigma_px < _SHARP_PX else int(np.ceil(3.2 * sigma_px))


def _share(x: Float[np.ndarray, "*n"], sigma_px: float) -> Float[np.ndarray, "*n"]:
    if sigma_px < _SHARP_PX:
        return (np.abs(x) <= 0.5).astype(float)
    return np.asarray(ndtr((x + 0.5) / sigma_px) - ndtr((x - 0.5) / sigma_px))


@lru_cache(maxsize=64)
def pixel_kernel(sigma_px: float) -> Float[np.ndarray, " k"]:
    """Share of an even pixel's light that falls on the pixels ``-reach .. reach`` away, along a row or a column; the sum is 1."""
    reach = reach_px(sigma_px)
    if reach == 0:
        return np.ones(1)
    nodes, weights = np.polynomial.legendre.leggauss(40)
    away = np.arange(-reach, reach + 1)
    kernel = _share(away[:, None] + nodes / 2, sigma_px) @ (weights / 2)
    return np.asarray(kernel / kernel.sum())


def point_kernels(offsets: Float[np.ndarray, "n 2"], sigma_px: float) -> Float[np.ndarray, "n k k"]:
    """Share of the light of each of a pixel's points that falls on the pixels around: index point, row, column.

    Together the points give what an even pixel gives.

    Parameters
    ----------
    offsets : (n, 2)   of the points from the pixel's middle; each stands for the same area
    sigma_px : of the blur
    """
    u, v = offsets.T
    reach, even = reach_px(sigma_px), pixel_kernel(sigma_px)
    away = np.arange(-reach, reach + 1)
    shares = _share(away - v[:, None], sigma_px)[:, :, None] * _share(away - u[:, None], sigma_px)[:, None, :]
    total = shares.sum(axis=0)
    return np.asarray(shares * np.divide(np.outer(even, even), total, out=np.zeros_like(total), where=total > 0))
