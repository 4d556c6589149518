"""Kernels of :mod:`rotaline.scanning.triangulation`: pixels to points of the sheet, and points moved frame by frame.

As in :mod:`rotaline.vision.camera_kernels`, a point has the same result whatever other points stand in the call.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.camera_kernels import TILE, distortion, undistort_tile

_NEWTON_STEPS = 4
_ROWS = 12


@compiled
@no_type_check
def meet_sheet(
    uv: np.ndarray,
    normal_px: np.ndarray,
    u_px: np.ndarray,
    camera: tuple[float, ...],
    sheet: tuple[float, ...],
    grazing_sine: float,
    on_sheet_mm: float,
    points_camera: np.ndarray,
    u_mm: np.ndarray,
) -> None:
    """Viewing rays meet the sheet of light, and what an error of the pixel along the stripe's normal does to the point.

    The rules for rays that miss the sheet are those of :func:`rotaline.geometry.intersect.intersect_rays_with_sheet`. The point ``s r``
    of the ray ``r = (x, y, 1)`` moves by ``s (d - r (g . d) / (g . r))`` when the ray moves by ``d``; g is the gradient of the sheet.

    Parameters
    ----------
    uv, normal_px : (n, 2)   px
    u_px : (n,)   standard uncertainty along the normal
    camera, sheet : see :mod:`rotaline.scanning.runs`
    points_camera, u_mm : (n, 3), (n,)   results; NaN where no point exists
    """
    fx, fy, cx, cy, k1, k2, p1, p2, k3 = camera
    nx, ny, nz, offset, ax, ay, az, bx, by, bz, ox, oy, oz, cuu, cuv, cvv = sheet
    curved = cuu != 0.0 or cuv != 0.0 or cvv != 0.0
    tile = np.zeros((_ROWS, TILE))
    for start in range(0, len(uv), TILE):
        count = min(TILE, len(uv) - start)
        for j in range(count):
            tile[0, j] = (uv[start + j, 0] - cx) / fx
            tile[1, j] = (uv[start + j, 1] - cy) / fy
            tile[8, j] = normal_px[start + j, 0] / fx
            tile[9, j] = normal_px[start + j, 1] / fy
            tile[10, j] = u_px[start + j]
        undistort_tile(tile, k1, k2, p1, p2, k3)
        for j in range(TILE):
            x, y = tile[2, j], tile[3, j]
            along = nx * x + ny * y + nz
            s = -offset / along
            fixed = abs(along) > grazing_sine * np.sqrt(x * x + y * y + 1.0) and s > 0.0 and s < np.inf
            tile[5, j] = s if fixed else np.nan
        if curved:
            for _ in range(_NEWTON_STEPS):
                for j in range(TILE):
                    x, y, s = tile[2, j], tile[3, j], tile[5, j]
                    u = ax * (s * x - ox) + ay * (s * y - oy) + az * (s - oz)
                    v = bx * (s * x - ox) + by * (s * y - oy) + bz * (s - oz)
                    slope_u, slope_v = cuu * u + cuv * v, cuv * u + cvv * v
                    distance = s * (nx * x + ny * y + nz) + offset + 0.5 * (slope_u * u + slope_v * v)
                    gx = nx + slope_u * ax + slope_v * bx
                    gy = ny + slope_u * ay + slope_v * by
                    gz = nz + slope_u * az + slope_v * bz
                    tile[5, j] = s - distance / (gx * x + gy * y + gz)
        for j in range(TILE):
            x, y, s = tile[2, j], tile[3, j], tile[5, j]
            u = ax * (s * x - ox) + ay * (s * y - oy) + az * (s - oz)
            v = bx * (s * x - ox) + by * (s * y - oy) + bz * (s - oz)
            slope_u, slope_v = cuu * u + cuv * v, cuv * u + cvv * v
            distance = s * (nx * x + ny * y + nz) + offset + 0.5 * (slope_u * u + slope_v * v)
            if curved:
                s = s if abs(distance) < on_sheet_mm and s > 0.0 else np.nan
            gx = nx + slope_u * ax + slope_v * bx
            gy = ny + slope_u * ay + slope_v * by
            gz = nz + slope_u * az + slope_v * bz
            _, _, xx, xy, yy = distortion(x, y, k1, k2, p1, p2, k3)
            scale = s * tile[10, j] / (xx * yy - xy * xy)
            dx = scale * (yy * tile[8, j] - xy * tile[9, j])
            dy = scale * (xx * tile[9, j] - xy * tile[8, j])
            slide = (gx * dx + gy * dy) / (gx * x + gy * y + gz)
            mx, my = dx - slide * x, dy - slide * y
            tile[5, j] = s * x
            tile[6, j] = s * y
            tile[7, j] = s
            tile[11, j] = np.sqrt(mx * mx + my * my + slide * slide)
        for j in range(count):
            points_camera[start + j, 0] = tile[5, j]
            points_camera[start + j, 1] = tile[6, j]
            points_camera[start + j, 2] = tile[7, j]
            u_mm[start + j] = tile[11, j]


@compiled
@no_type_check
def move_runs(points: np.ndarray, starts: np.ndarray, poses: np.ndarray, moved: np.ndarray) -> None:
    """Run k, ``points[starts[k]:starts[k + 1]]``, moved by ``poses[k] = [R | t]``; (n, 3) to (n, 3)."""
    tile = np.zeros((6, TILE))
    for run in range(len(starts) - 1):
        m = poses[run]
        for start in range(starts[run], starts[run + 1], TILE):
            count = min(TILE, starts[run + 1] - start)
            for j in range(count):
                tile[0, j] = points[start + j, 0]
                tile[1, j] = points[start + j, 1]
                tile[2, j] = points[start + j, 2]
            for k in range(3):
                mx, my, mz, mt = m[k, 0], m[k, 1], m[k, 2], m[k, 3]
                for j in range(TILE):
                    tile[3 + k, j] = mx * tile[0, j] + my * tile[1, j] + mz * tile[2, j] + mt
            for j in range(count):
                moved[start + j, 0] = tile[3, j]
                moved[start + j, 1] = tile[4, j]
                moved[start + j, 2] = tile[5, j]
