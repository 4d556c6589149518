"""What a user would take to find the stripe in a grey frame without this project: each from an image to points ``(n, 2)`` as (u, v).

All take the stripe for one point a row, as open scanners do, apart from Steger's, which takes it for a ridge of any direction.
"""

from collections.abc import Callable
from importlib.util import find_spec

import cv2
import numpy as np

WINDOW = 6
"""Pixels on both sides of a row's brightest that count."""
THRESHOLD = 20.0
SIGMA_PX = 1.5
"""Of the smoothing in the ridge filters: about the width of the stripe."""


def numpy_gathered(image: np.ndarray) -> np.ndarray:
    """NumPy: row maxima, centroid of the pixels around them."""
    peak = image.argmax(axis=1)
    rows = np.flatnonzero(image[np.arange(len(image)), peak] > THRESHOLD)
    columns = np.clip(peak[rows, None] + np.arange(-WINDOW, WINDOW + 1), 0, image.shape[1] - 1)
    values = image[rows[:, None], columns].astype(np.float32)
    values[values <= THRESHOLD] = 0
    return np.column_stack([(values * columns).sum(axis=1) / values.sum(axis=1), rows])


class MaskedFrame:
    """NumPy over the whole frame: a window is left of each row, and a matrix of column numbers weights all pixels."""

    def __init__(self) -> None:
        self._weights = np.empty((0, 0))

    def __call__(self, image: np.ndarray) -> np.ndarray:
        """Points of a frame."""
        height, width = image.shape
        if self._weights.shape != image.shape:
            self._weights = np.tile(np.arange(width, dtype=float), (height, 1))
        _, bright = cv2.threshold(image, THRESHOLD, 255, cv2.THRESH_TOZERO)
        mask = np.zeros_like(image)
        for row, peak in enumerate(bright.argmax(axis=1)):
            mask[row, max(peak - WINDOW, 0) : peak + WINDOW + 1] = 255
        bright = cv2.bitwise_and(bright, mask)
        total = bright.sum(axis=1)
        rows = np.flatnonzero(total > 0)
        return np.column_stack([(self._weights * bright).sum(axis=1)[rows] / total[rows], rows])


def opencv_moments(image: np.ndarray) -> np.ndarray:
    """OpenCV: blur, threshold, and the centroid of each row by its sums."""
    smooth = cv2.GaussianBlur(image, (5, 5), 0)
    _, bright = cv2.threshold(smooth, THRESHOLD, 255, cv2.THRESH_TOZERO)
    total = cv2.reduce(bright, 1, cv2.REDUCE_SUM, dtype=cv2.CV_32F).ravel()
    numbers = np.arange(image.shape[1], dtype=np.float32)[:, None]
    first = cv2.gemm(bright.astype(np.float32), numbers, 1.0, None, 0.0).ravel()
    rows = np.flatnonzero(total > 0)
    return np.column_stack([first[rows] / total[rows], rows])


def scikit_image_ridge(image: np.ndarray) -> np.ndarray:
    """scikit-image: Sato's ridge filter at one width, centroid of its answer around each row's highest."""
    from skimage.filters import sato

    ridge = sato(image, sigmas=[SIGMA_PX], black_ridges=False)
    peak = ridge.argmax(axis=1)
    rows = np.flatnonzero(ridge[np.arange(len(ridge)), peak] > THRESHOLD / 4)
    columns = np.clip(peak[rows, None] + np.arange(-3, 4), 0, image.shape[1] - 1)
    values = ridge[rows[:, None], columns]
    return np.column_stack([(values * columns).sum(axis=1) / values.sum(axis=1), rows])


def opencv_steger(image: np.ndarray) -> np.ndarray:
    """OpenCV: Steger's ridge points from five derivatives of the whole frame."""
    reach = int(np.ceil(4 * SIGMA_PX))
    x = np.arange(-reach, reach + 1, dtype=float)
    g0 = np.exp(-0.5 * (x / SIGMA_PX) ** 2)
    g0 /= g0.sum()
    g1, g2 = x / SIGMA_PX**2 * g0, (x**2 / SIGMA_PX**4 - 1 / SIGMA_PX**2) * g0
    pairs = ((g1, g0), (g0, g1), (g2, g0), (g1, g1), (g0, g2))
    du, dv, duu, duv, dvv = (cv2.sepFilter2D(image, cv2.CV_32F, a, b) for a, b in pairs)
    # the eigenvalue of largest magnitude of the second derivatives, and its direction
    half = 0.5 * (duu - dvv)
    root = np.sqrt(half**2 + duv**2)
    strongest = 0.5 * (duu + dvv) - root
    nu, nv = duv, strongest - duu
    swap = np.abs(nv) + np.abs(nu) < 1e-9
    nu, nv = np.where(swap, 1.0, nu), np.where(swap, 0.0, nv)
    length = np.sqrt(nu**2 + nv**2)
    nu, nv = nu / length, nv / length
    along = -(nu * du + nv * dv) / (nu**2 * duu + 2 * nu * nv * duv + nv**2 * dvv + 1e-12)
    pu, pv = along * nu, along * nv
    ridge = (np.abs(pu) <= 0.5) & (np.abs(pv) <= 0.5) & (strongest < -0.15 * THRESHOLD)
    v, u = np.nonzero(ridge)
    return np.column_stack([u + pu[v, u], v + pv[v, u]])


def others() -> dict[str, Callable[[np.ndarray], np.ndarray]]:
    """All of the above that can run here, by the name in the table."""
    ways: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "NumPy argmax + centroid, gathered": numpy_gathered,
        "NumPy argmax + centroid, whole frame": MaskedFrame(),
        "OpenCV blur, threshold, row sums": opencv_moments,
        "OpenCV Steger, whole frame": opencv_steger,
    }
    if find_spec("skimage"):
        ways["scikit-image ridge filter"] = scikit_image_ridge
    return ways
