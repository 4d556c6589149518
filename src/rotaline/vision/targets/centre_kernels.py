"""Kernels of :mod:`rotaline.vision.targets.centres`: windows read out of the image, and one step of the search in each of them."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled


@compiled
@no_type_check
def read_windows(
    image: np.ndarray,
    centres: np.ndarray,
    half_sides: np.ndarray,
    bend: np.ndarray,
    offsets: np.ndarray,
    out: np.ndarray,
) -> None:
    """Grey values of windows, smoothed by the cubic B-spline; beyond the image its border goes on.

    Parameters
    ----------
    image : (h, w)
    centres : (n, 2)   px
    half_sides, bend : (n, 2, 2), (n, 2, 2, 2)   first and second derivatives of the map from window to image, px
    offsets : (p, 2)   where, in the window
    out : (n, p)   grey values
    """
    height, width = image.shape
    wu = np.empty(4)
    wv = np.empty(4)
    for i in range(len(centres)):
        h, b = half_sides[i], bend[i]
        for p in range(len(offsets)):
            x, y = offsets[p, 0], offsets[p, 1]
            xx, xy, yy = 0.5 * x * x, 0.5 * x * y, 0.5 * y * y
            u = (
                centres[i, 0]
                + h[0, 0] * x
                + h[0, 1] * y
                + b[0, 0, 0] * xx
                + (b[0, 0, 1] + b[0, 1, 0]) * xy
                + b[0, 1, 1] * yy
            )
            v = (
                centres[i, 1]
                + h[1, 0] * x
                + h[1, 1] * y
                + b[1, 0, 0] * xx
                + (b[1, 0, 1] + b[1, 1, 0]) * xy
                + b[1, 1, 1] * yy
            )
            left, upper = int(np.floor(u)) - 1, int(np.floor(v)) - 1
            for weights, t in ((wu, u - left - 1), (wv, v - upper - 1)):
                s = 1.0 - t
                weights[0] = s * s * s / 6.0
                weights[1] = (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0
                weights[2] = (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0
                weights[3] = t * t * t / 6.0
            total = 0.0
            if left >= 0 and upper >= 0 and left + 3 < width and upper + 3 < height:
                for k in range(4):
                    line = image[upper + k]
                    total += wv[k] * (
                        wu[0] * line[left] + wu[1] * line[left + 1] + wu[2] * line[left + 2] + wu[3] * line[left + 3]
                    )
            else:
                for k in range(4):
                    line = image[min(max(upper + k, 0), height - 1)]
                    for m in range(4):
                        total += wv[k] * wu[m] * line[min(max(left + m, 0), width - 1)]
            out[i, p] = total


@compiled
@no_type_check
def normal_equations(
    patch: np.ndarray,
    offsets: np.ndarray,
    counting: np.ndarray,
    next_alpha: np.ndarray,
    next_beta: np.ndarray,
    step: float,
    weight: np.ndarray,
    template: np.ndarray,
    symmetric: np.ndarray,
    normal: np.ndarray,
    right: np.ndarray,
    figures: np.ndarray,
) -> None:
    """Normal equations of the least squares for a window's shift and uneven light.

    Parameters
    ----------
    patch : (n, p)   grey values of the windows; the reversed order holds the opposite points
    offsets, counting, next_alpha, next_beta, step, weight : the window, see ``_Window``
    template : (q,)   what the symmetric part is compared with, its weighted mean taken off
    symmetric : (n, q)   gets the symmetric part
    normal, right : (n, 6, 6), (n, 6)   get the normal equations, in units of the contrast
    figures : (n, 3)   get contrast, mean square of the odd part relative to it, product with the template
    """
    n, p = patch.shape
    q = len(counting)
    even = np.empty(p)
    row = np.empty(6)
    for i in range(n):
        for k in range(p):
            even[k] = 0.5 * (patch[i, k] + patch[i, p - 1 - k])
        mean = 0.0
        for k in range(q):
            symmetric[i, k] = even[counting[k]]
            mean += weight[k] * symmetric[i, k]
        variance = 0.0
        product = 0.0
        for k in range(q):
            level = symmetric[i, k] - mean
            variance += weight[k] * level * level
            product += weight[k] * level * template[k]
        contrast = np.sqrt(variance) + 1e-12
        scale = 1.0 / contrast
        slope = scale / (2.0 * step)
        for a in range(6):
            right[i, a] = 0.0
            for b in range(6):
                normal[i, a, b] = 0.0
        square = 0.0
        for k in range(q):
            at = counting[k]
            odd = 0.5 * (patch[i, at] - patch[i, p - 1 - at]) * scale
            level = (symmetric[i, k] - mean) * scale
            row[0] = (even[next_alpha[0, k]] - even[next_alpha[1, k]]) * slope
            row[1] = (even[next_beta[0, k]] - even[next_beta[1, k]]) * slope
            row[2] = offsets[at, 0]
            row[3] = offsets[at, 1]
            row[4] = row[2] * level
            row[5] = row[3] * level
            w = weight[k]
            square += w * odd * odd
            for a in range(6):
                weighted = w * row[a]
                right[i, a] += weighted * odd
                for b in range(a + 1):
                    normal[i, a, b] += weighted * row[b]
        for a in range(6):
            for b in range(a):
                normal[i, b, a] = normal[i, a, b]
        figures[i, 0] = contrast
        figures[i, 1] = square
        figures[i, 2] = product
