"""Kernels of :mod:`rotaline.io.report.raster`: points into a depth buffer, and the enlarged picture into the finished one."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled


@compiled
@no_type_check
def draw_discs(xyz: np.ndarray, disc: np.ndarray, depth: np.ndarray, which: np.ndarray) -> None:
    """Draw every point with all pixels of a disc; where several fall on a pixel, the nearest to the viewer is seen.

    Parameters
    ----------
    xyz : (n, 3)   column, row and depth (larger is nearer), px; points with a NaN are left out
    disc : (k, 2)   whole numbers of columns and rows from the point
    depth : (h, w)   gets the depth that is seen; NaN where nothing is
    which : (h, w)   gets the number of the point that is seen; -1 where nothing is
    """
    height, width = depth.shape
    depth[:] = np.nan
    which[:] = -1
    for i in range(len(xyz)):
        if np.isnan(xyz[i, 0] + xyz[i, 1] + xyz[i, 2]):
            continue
        column, row = np.rint(xyz[i, 0]), np.rint(xyz[i, 1])
        for k in range(len(disc)):
            u, v = column + disc[k, 0], row + disc[k, 1]
            if 0 <= u < width and 0 <= v < height:
                u, v = int(u), int(v)
                if which[v, u] < 0 or xyz[i, 2] > depth[v, u]:
                    depth[v, u] = xyz[i, 2]
                    which[v, u] = i


@compiled
@no_type_check
def finish(
    colours: np.ndarray, which: np.ndarray, depth: np.ndarray, strength: float, step: int, far: float, out: np.ndarray
) -> None:
    """Darken edges, put the picture on a white ground and average it down.

    A pixel is darker where others beside it stand nearer to the viewer (an eye-dome light).

    Parameters
    ----------
    colours : (n, 3)   0 to 1
    which : (k h, k w)   number of the colour of each pixel; -1 for the ground
    depth : (k h, k w)   larger is nearer, px
    strength : of the darkening
    step, far : distance of the neighbours, and the difference in depth beyond which nothing gets darker, px
    out : (h, w, 3)   gets the finished picture, 0 to 255
    """
    height, width = which.shape
    k = height // out.shape[0]
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            red, green, blue = 0.0, 0.0, 0.0
            for v in range(k * row, k * row + k):
                for u in range(k * column, k * column + k):
                    i = which[v, u]
                    if i < 0:
                        red, green, blue = red + 1.0, green + 1.0, blue + 1.0
                        continue
                    nearer = 0.0
                    for du, dv in ((step, 0), (-step, 0), (0, step), (0, -step)):
                        a, b = u + du, v + dv
                        if 0 <= a < width and 0 <= b < height and which[b, a] >= 0:
                            nearer += min(max(depth[b, a] - depth[v, u], 0.0), far)
                    shade = np.exp(-strength * nearer / far) if nearer > 0.0 else 1.0
                    red += shade * colours[i, 0]
                    green += shade * colours[i, 1]
                    blue += shade * colours[i, 2]
            scale = 255.0 / (k * k)
            out[row, column, 0] = np.uint8(red * scale + 0.5)
            out[row, column, 1] = np.uint8(green * scale + 0.5)
            out[row, column, 2] = np.uint8(blue * scale + 0.5)
