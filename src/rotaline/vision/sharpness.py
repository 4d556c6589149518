"""How sharp the edges in an image are, and where.

An edge of height ``H`` that is blurred by a Gaussian of the standard deviation ``s`` is steepest with ``H / (s sqrt(2 pi))`` a pixel. In each
tile of the image the height is what lies between its dark and its bright parts, and the steepness that of its steepest hundredth.
"""

import math

import cv2
import numpy as np
from jaxtyping import Float

from rotaline.vision.images import Image, to_grey

TILE_PX = 48
_SMOOTH_PX = 1.0
_STEEPEST = 0.01
_BESIDE_PX = 12
_LEAST_HEIGHT = 0.04
"""Of full scale, for an edge."""
_OVER_NOISE = 12.0


def edge_blur_px(image: Image, noise: float, tile_px: int = TILE_PX) -> Float[np.ndarray, "rows columns"]:
    """Standard deviation of the blur of the edges in each tile, px; what a pixel itself blurs is part of it.

    Parameters
    ----------
    image : of a scene that stands
    noise : standard deviation of a pixel, in the image's grey values
    tile_px : side of a tile

    Returns
    -------
    (rows, columns)   NaN where a tile has no clear edge
    """
    grey = cv2.GaussianBlur(to_grey(image).astype(np.float32), (0, 0), _SMOOTH_PX)
    full = float(np.iinfo(image.dtype).max)
    steep = np.hypot(np.diff(grey, axis=1)[:-1], np.diff(grey, axis=0)[:, :-1])
    rows, columns = (max(n // tile_px, 1) for n in steep.shape)
    blur = np.full((rows, columns), np.nan)
    least = max(_LEAST_HEIGHT * full, _OVER_NOISE * noise)
    for row in range(rows):
        for column in range(columns):
            inside = grey[_span(row, tile_px), _span(column, tile_px)]
            # the height is that of the whole edge, of which the tile must hold the middle
            beside = grey[_span(row, tile_px, _BESIDE_PX), _span(column, tile_px, _BESIDE_PX)]
            height = _range(beside)
            if height < least or _range(inside) < 0.6 * height:
                continue
            values = steep[_span(row, tile_px), _span(column, tile_px)].ravel()
            n = max(int(_STEEPEST * values.size), 3)
            steepest = float(np.mean(np.partition(values, -n)[-n:]))
            measured = height / (steepest * math.sqrt(2.0 * math.pi))
            # what smoothing, and the difference over a pixel, add
            blur[row, column] = math.sqrt(max(measured**2 - _SMOOTH_PX**2 - 1.0 / 12.0, 0.0))
    return blur


def _span(index: int, tile_px: int, beside_px: int = 0) -> slice:
    """Rows or columns of a tile, and some beside it."""
    return slice(max(index * tile_px - beside_px, 0), (index + 1) * tile_px + beside_px)


def _range(grey: Float[np.ndarray, "h w"]) -> float:
    low, high = np.quantile(grey, [0.005, 0.995])
    return float(high - low)
