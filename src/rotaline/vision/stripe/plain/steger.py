"""Centre of the stripe as the ridge of the smoothed image (Steger's method).

References
----------
.. [1] Steger, An unbiased detector of curvilinear structures, IEEE PAMI 20(2), 1998
"""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from rotaline.vision.stripe.centres import Centres


def steger_centres(
    image: Float32[np.ndarray, "h w"],
    uv: Float[np.ndarray, "n 2"],
    normal: Float[np.ndarray, "n 2"],
    width_px: Float[np.ndarray, " n"],
) -> tuple[Centres, Bool[np.ndarray, " n"]]:
    """Ridge points at the pixels that a curve passes.

    The image is smoothed by a Gaussian as wide as the stripe. With gradient g and Hessian H of the smoothed image in a
    pixel and e the eigenvector of the most negative eigenvalue, the ridge lies at ``-(g . e) / (e' H e) e`` from the
    pixel's centre; it counts in this pixel if that is at most 0.6 px away along both axes [1]_. The expansion stops at the
    second order; what it leaves out is known for a Gaussian stripe and is put right.

    Returns
    -------
    centres : Centres   shift along ``normal`` from ``uv``; no height
    first : (n,)   False where an earlier point of the curve has found the same pixel
    """
    sigma = float(np.clip(np.median(width_px), 0.8, 10.0))
    height, width = image.shape
    margin = int(np.ceil(5 * sigma)) + 2
    u0, v0 = np.maximum(np.floor(uv.min(axis=0)).astype(int) - margin, 0)
    u1, v1 = np.minimum(np.ceil(uv.max(axis=0)).astype(int) + margin + 1, [width, height])
    part = image[v0:v1, u0:u1]
    size = 2 * int(np.ceil(4 * sigma)) + 1
    x = np.arange(size) - size // 2
    g = np.exp(-0.5 * (x / sigma) ** 2)
    g /= g.sum()
    first_order, second_order = g * x / sigma**2, g * (x**2 / sigma**2 - 1.0) / sigma**2
    border = cv2.BORDER_REPLICATE
    gu, gv, guu, gvv, guv = (
        cv2.sepFilter2D(part, cv2.CV_32F, a, b, borderType=border)
        for a, b in (
            (first_order, g),
            (g, first_order),
            (second_order, g),
            (g, second_order),
            (first_order, first_order),
        )
    )
    pixel = np.rint(uv).astype(int)
    shape = np.array(part.shape[::-1]) - 1
    shape2 = sigma**2 + width_px**2
    found = np.zeros(len(uv), dtype=bool)
    ridge = uv.copy()
    curvature = np.ones(len(uv))
    for _ in range(5):
        c, r = (pixel - [u0, v0]).clip(0, shape).T
        a, b, d = guu[r, c].astype(float), guv[r, c].astype(float), gvv[r, c].astype(float)
        half, root = 0.5 * (a + d), np.hypot(0.5 * (a - d), b)
        lowest = half - root
        # eigenvector of the lowest eigenvalue
        angle = 0.5 * np.arctan2(2 * b, a - d) + 0.5 * np.pi
        e = np.column_stack([np.cos(angle), np.sin(angle)])
        slope = gu[r, c] * e[:, 0] + gv[r, c] * e[:, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            move = _without_third_order(np.where(lowest < 0, -slope / lowest, np.inf), shape2)[:, None] * e
        inside = np.isfinite(move).all(axis=1) & (np.abs(move) <= 0.6).all(axis=1)
        new = inside & ~found
        ridge[new] = (pixel + move)[new]
        curvature[new] = -lowest[new]
        found |= inside
        go = ~found & np.isfinite(move).all(axis=1) & (np.abs(move) <= 2.0 * sigma + 2.0).all(axis=1)
        if not go.any():
            break
        pixel[go] = np.rint((pixel + move)[go]).astype(int)
    shift = np.where(found, ((ridge - uv) * normal).sum(axis=1), np.nan)
    # variance of a first derivative of smoothed white noise: 1 / (8 pi sigma^4)
    u = 1.0 / (np.sqrt(8.0 * np.pi) * sigma**2 * curvature)
    _, earliest = np.unique(pixel[:, 1] * width + pixel[:, 0], return_index=True)
    first = np.zeros(len(uv), dtype=bool)
    first[earliest] = True
    return Centres(shift, u, width_px, np.full(len(uv), np.nan)), first & found


def _without_third_order(t: np.ndarray, variance_px2: np.ndarray) -> np.ndarray:
    """Distance x of a Gaussian ridge's top where gradient over curvature is t: ``t = x / (1 - x^2 / s^2)`` solved for x."""
    with np.errstate(divide="ignore", invalid="ignore"):
        x = 2.0 * t / (1.0 + np.sqrt(1.0 + 4.0 * t * t / variance_px2))
    return np.where(np.isfinite(t), x, np.inf)
