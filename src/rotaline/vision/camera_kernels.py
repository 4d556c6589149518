"""The inverse of the lens distortion, compiled: Newton's method on tiles of points side by side.

Every point settles for itself, and every tile is worked on whole, so that a point has the same result to the last bit whatever other points
stand in the call.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

TILE = 64
"""Points side by side: some vectors of the processor, small enough for its fastest memory."""

_STEPS = 50
_SETTLED = 1e-14
_WRONG = 1e-10
_ROWS = 5


@compiled
@no_type_check
def distortion(x: float, y: float, k1: float, k2: float, p1: float, p2: float, k3: float) -> tuple:
    """Distorted normalised coordinates of an ideal point, and their derivatives dx/dx, dx/dy = dy/dx, dy/dy: eq. (2) of the camera model."""
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
    return (
        x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
        y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x,
        slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y,
        radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x,
    )


@compiled
@no_type_check
def undistort_tile(tile: np.ndarray, k1: float, k2: float, p1: float, p2: float, k3: float) -> None:
    """Distorted to ideal normalised coordinates: rows 0, 1 of ``tile`` (5 or more, ``TILE``) to rows 2, 3; row 4 is used.

    NaN where no ideal point exists, as in :meth:`rotaline.vision.camera.CameraModel.undistort`.
    """
    for j in range(TILE):
        tile[2, j] = tile[0, j]
        tile[3, j] = tile[1, j]
        tile[4, j] = np.inf
    for _ in range(_STEPS):
        n_moving = 0.0
        for j in range(TILE):
            x, y = tile[2, j], tile[3, j]
            x_d, y_d, xx, xy, yy = distortion(x, y, k1, k2, p1, p2, k3)
            off_x, off_y = x_d - tile[0, j], y_d - tile[1, j]
            inverse = 1.0 / (xx * yy - xy * xy)
            step_x = (yy * off_x - xy * off_y) * inverse
            step_y = (xx * off_y - xy * off_x) * inverse
            moving = tile[4, j] > _SETTLED
            size = max(abs(step_x), abs(step_y))
            tile[2, j] = x - step_x if moving else x
            tile[3, j] = y - step_y if moving else y
            tile[4, j] = size if moving else 0.0
            n_moving += 1.0 if moving and size > _SETTLED else 0.0
        if n_moving == 0.0:
            break
    for j in range(TILE):
        x, y = tile[2, j], tile[3, j]
        x_d, y_d, xx, xy, yy = distortion(x, y, k1, k2, p1, p2, k3)
        off_x, off_y = x_d - tile[0, j], y_d - tile[1, j]
        right = off_x * off_x + off_y * off_y <= _WRONG * _WRONG
        # the branch that holds the optical axis: distortion stretches, it does not fold or mirror
        right = right and xx * yy - xy * xy > 0.0 and xx + yy > 0.0
        tile[2, j] = x if right else np.nan
        tile[3, j] = y if right else np.nan


@compiled
@no_type_check
def undistort(xy_distorted: np.ndarray, k1: float, k2: float, p1: float, p2: float, k3: float, xy: np.ndarray) -> None:
    """Distorted to ideal normalised coordinates, (n, 2) to (n, 2)."""
    n = len(xy_distorted)
    tile = np.zeros((_ROWS, TILE))
    for start in range(0, n, TILE):
        count = min(TILE, n - start)
        for j in range(count):
            tile[0, j] = xy_distorted[start + j, 0]
            tile[1, j] = xy_distorted[start + j, 1]
        undistort_tile(tile, k1, k2, p1, p2, k3)
        for j in range(count):
            xy[start + j, 0] = tile[2, j]
            xy[start + j, 1] = tile[3, j]
