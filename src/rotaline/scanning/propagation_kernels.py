"""The kernel of :mod:`rotaline.scanning.propagation`: moves of points for each column of a factor of the covariance, summed up at once.

As in :mod:`rotaline.vision.camera_kernels`, a point has the same result whatever other points stand in the call.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.camera_kernels import TILE, distortion

_ROWS = 26


@compiled
@no_type_check
def sum_moves(
    points_camera: np.ndarray,
    starts: np.ndarray,
    camera: tuple[float, ...],
    sheet: tuple[float, ...],
    plane_pivot: tuple[float, ...],
    by_camera: np.ndarray,
    by_sheet: np.ndarray,
    by_run: np.ndarray,
    weights_camera: np.ndarray,
    variance: np.ndarray,
    totals: np.ndarray,
) -> None:
    """Moves ``dX_k`` of points when all parameters change by column k of a factor, k = 1 ... q; sums of their squares and weighted sums.

    Parameters
    ----------
    points_camera : (n, 3)   mm
    starts : (f + 1,)   run i is ``starts[i]:starts[i + 1]``
    camera, sheet : see :mod:`rotaline.scanning.runs`
    plane_pivot : (3,)   mm
    by_camera : (9, q)   columns of the factor: camera parameters in the order of ``camera``
    by_sheet : (6, q)   two turns, offset, three curvatures
    by_run : (f, q, 3, 4)   what else moves points: ``A X + b`` of each column, in the camera frame
    weights_camera : (m, n, 3)   of each point in m quantities
    variance : (n,) or (0,)   result: ``sum_k |dX_k|^2``
    totals : (m, q)   result: ``sum_i w_i . dX_ik``
    """
    fx, fy, _, _, k1, k2, p1, p2, k3 = camera
    nx, ny, nz, _, ax, ay, az, bx, by, bz, ox, oy, oz, cuu, cuv, cvv = sheet
    px, py, pz = plane_pivot
    n_quantities, n_columns = totals.shape
    tile = np.zeros((_ROWS, TILE))
    weights = np.zeros((n_quantities, 3, TILE))
    for run in range(len(starts) - 1):
        for start in range(starts[run], starts[run + 1], TILE):
            count = min(TILE, starts[run + 1] - start)
            for j in range(TILE):
                i = start + (j if j < count else 0)
                tile[0, j] = points_camera[i, 0]
                tile[1, j] = points_camera[i, 1]
                tile[2, j] = points_camera[i, 2]
            for m in range(n_quantities):
                for j in range(TILE):
                    for a in range(3):
                        weights[m, a, j] = weights_camera[m, start + j, a] if j < count else 0.0
            for j in range(TILE):
                z = tile[2, j]
                x, y = tile[0, j] / z, tile[1, j] / z
                r2 = x * x + y * y
                x_d, y_d, xx, xy, yy = distortion(x, y, k1, k2, p1, p2, k3)
                tile[3, j] = x
                tile[4, j] = y
                tile[5, j] = r2
                tile[6, j] = x_d
                tile[7, j] = y_d
                tile[8, j] = 2.0 * x * y
                tile[9, j] = r2 + 2.0 * x * x
                tile[10, j] = r2 + 2.0 * y * y
                back = -z / (xx * yy - xy * xy)
                tile[11, j] = back * yy
                tile[12, j] = -back * xy
                tile[13, j] = back * xx
            for j in range(TILE):
                xc, yc, z = tile[0, j], tile[1, j], tile[2, j]
                u = ax * (xc - ox) + ay * (yc - oy) + az * (z - oz)
                v = bx * (xc - ox) + by * (yc - oy) + bz * (z - oz)
                slope_u, slope_v = cuu * u + cuv * v, cuv * u + cvv * v
                gx = nx + slope_u * ax + slope_v * bx
                gy = ny + slope_u * ay + slope_v * by
                gz = nz + slope_u * az + slope_v * bz
                tile[14, j] = ax * (xc - px) + ay * (yc - py) + az * (z - pz)
                tile[15, j] = bx * (xc - px) + by * (yc - py) + bz * (z - pz)
                tile[16, j] = 0.5 * u * u
                tile[17, j] = u * v
                tile[18, j] = 0.5 * v * v
                tile[19, j] = gx
                tile[20, j] = gy
                tile[21, j] = 1.0 / (gx * tile[3, j] + gy * tile[4, j] + gz)
                tile[22, j] = 0.0
            for k in range(n_columns):
                dfx, dfy, dcx, dcy = (
                    by_camera[0, k] / fx,
                    by_camera[1, k] / fy,
                    by_camera[2, k] / fx,
                    by_camera[3, k] / fy,
                )
                dk1, dk2, dk3 = by_camera[4, k], by_camera[5, k], by_camera[8, k]
                dp1, dp2 = by_camera[6, k], by_camera[7, k]
                turn_1, turn_2, shift = by_sheet[0, k], by_sheet[1, k], by_sheet[2, k]
                duu, duv, dvv = by_sheet[3, k], by_sheet[4, k], by_sheet[5, k]
                rest = by_run[run, k]
                mxx, mxy, mxz, mx = rest[0, 0], rest[0, 1], rest[0, 2], rest[0, 3]
                myx, myy, myz, my = rest[1, 0], rest[1, 1], rest[1, 2], rest[1, 3]
                mzx, mzy, mzz, mz = rest[2, 0], rest[2, 1], rest[2, 2], rest[2, 3]
                for j in range(TILE):
                    xc, yc, z = tile[0, j], tile[1, j], tile[2, j]
                    x, y, r2 = tile[3, j], tile[4, j], tile[5, j]
                    radial = r2 * (dk1 + r2 * (dk2 + r2 * dk3))
                    # the pixel stays: what the parameters add to it, the ray takes off
                    add_x = dcx + dfx * tile[6, j] + x * radial + dp1 * tile[8, j] + dp2 * tile[9, j]
                    add_y = dcy + dfy * tile[7, j] + y * radial + dp1 * tile[10, j] + dp2 * tile[8, j]
                    aside_x = tile[11, j] * add_x + tile[12, j] * add_y
                    aside_y = tile[12, j] * add_x + tile[13, j] * add_y
                    off = shift + turn_1 * tile[14, j] + turn_2 * tile[15, j]
                    off += duu * tile[16, j] + duv * tile[17, j] + dvv * tile[18, j]
                    slide = (off + tile[19, j] * aside_x + tile[20, j] * aside_y) * tile[21, j]
                    tile[23, j] = aside_x - slide * x + mxx * xc + mxy * yc + mxz * z + mx
                    tile[24, j] = aside_y - slide * y + myx * xc + myy * yc + myz * z + my
                    tile[25, j] = -slide + mzx * xc + mzy * yc + mzz * z + mz
                for j in range(TILE):
                    tile[22, j] += tile[23, j] ** 2 + tile[24, j] ** 2 + tile[25, j] ** 2
                for m in range(n_quantities):
                    total = 0.0
                    for j in range(TILE):
                        total += (
                            weights[m, 0, j] * tile[23, j]
                            + weights[m, 1, j] * tile[24, j]
                            + weights[m, 2, j] * tile[25, j]
                        )
                    totals[m, k] += total
            for j in range(min(count, len(variance) - start)):
                variance[start + j] = tile[22, j]
