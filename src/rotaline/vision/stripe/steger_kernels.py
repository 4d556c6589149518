"""Ridge points of the smoothed image in compiled loops: only where the stripe is, pixel by pixel. See :mod:`rotaline.vision.stripe.plain.steger`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

_VISITS = 5  # pixels looked at for each point
_INSIDE_PX = 0.6


@compiled
@no_type_check
def _derivatives(value: np.ndarray, column: int, row: int, bells: np.ndarray) -> tuple:
    """First and second derivatives (u, v, uu, uv, vv) of the smoothed image in a pixel; beyond its border the image stays as it is there."""
    height, width = value.shape
    n = bells.shape[1]
    half = n // 2
    inside = half <= column < width - half and half <= row < height - half
    du, dv, duu, duv, dvv = 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(n):
        s, t, r = np.float32(0.0), np.float32(0.0), np.float32(0.0)
        if inside:
            line = value[row + j - half, column - half : column + half + 1]
            for i in range(n):
                p = np.float32(line[i])
                s += bells[0, i] * p
                t += bells[1, i] * p
                r += bells[2, i] * p
        else:
            y = min(max(row + j - half, 0), height - 1)
            for i in range(n):
                p = np.float32(value[y, min(max(column + i - half, 0), width - 1)])
                s += bells[0, i] * p
                t += bells[1, i] * p
                r += bells[2, i] * p
        du += bells[0, j] * t
        dv += bells[1, j] * s
        duu += bells[0, j] * r
        duv += bells[1, j] * t
        dvv += bells[2, j] * s
    return du, dv, duu, duv, dvv


@compiled
@no_type_check
def ridge_points(
    value: np.ndarray, uv: np.ndarray, normal: np.ndarray, width_px: np.ndarray, sigma_px: float, bells: np.ndarray
) -> tuple:
    """As :func:`rotaline.vision.stripe.plain.steger.steger_centres`.

    Parameters
    ----------
    value : (h, w)
    bells : (3, m) single precision   Gaussian of ``sigma_px``, and what makes its first and second derivative of an image

    Returns
    -------
    shift, u, first   see there
    """
    height, width = value.shape
    n = len(uv)
    shift, u, found = np.full(n, np.nan), np.full(n, np.inf), np.zeros(n, np.bool_)
    seen = set()
    for i in range(n):
        column, row = int(np.rint(uv[i, 0])), int(np.rint(uv[i, 1]))
        for _ in range(_VISITS):
            column, row = min(max(column, 0), width - 1), min(max(row, 0), height - 1)
            gu, gv, guu, guv, gvv = _derivatives(value, column, row, bells)
            half, root = 0.5 * (guu + gvv), np.hypot(0.5 * (guu - gvv), guv)
            lowest = half - root
            if not lowest < 0.0:
                break
            angle = 0.5 * np.arctan2(2.0 * guv, guu - gvv) + 0.5 * np.pi
            eu, ev = np.cos(angle), np.sin(angle)
            t = -(gu * eu + gv * ev) / lowest
            move = 2.0 * t / (1.0 + np.sqrt(1.0 + 4.0 * t * t / (sigma_px * sigma_px + width_px[i] * width_px[i])))
            mu, mv = move * eu, move * ev
            if abs(mu) <= _INSIDE_PX and abs(mv) <= _INSIDE_PX:
                shift[i] = (column + mu - uv[i, 0]) * normal[i, 0] + (row + mv - uv[i, 1]) * normal[i, 1]
                # variance of a first derivative of smoothed white noise: 1 / (8 pi sigma^4)
                u[i] = -1.0 / (np.sqrt(8.0 * np.pi) * sigma_px * sigma_px * lowest)
                pixel = row * width + column
                found[i] = pixel not in seen
                seen.add(pixel)
                break
            if max(abs(mu), abs(mv)) > 2.0 * sigma_px + 2.0:
                break
            column, row = int(np.rint(column + mu)), int(np.rint(row + mv))
    return shift, u, found
