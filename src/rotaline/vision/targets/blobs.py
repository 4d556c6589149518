"""Candidates for the dots of a plate: filled ellipses that stand out from their surroundings."""

import cv2
import numpy as np
from jaxtyping import UInt8

from rotaline.vision.targets.lattice import Candidates


def find_blobs(grey: UInt8[np.ndarray, "h w"], window_px: int, light: bool, offset: float = 6.0) -> Candidates:
    """Find connected regions that are darker (lighter) than their surroundings and filled like an ellipse.

    Parameters
    ----------
    grey : (h, w)
    window_px : int   side of the square over which the surroundings are averaged; at least twice a dot's diameter
    light : bool   light dots on a dark plate
    offset : float   grey values by which a dot must differ from the average

    Returns
    -------
    Candidates   the largest first; size = area
    """
    mode = cv2.THRESH_BINARY if light else cv2.THRESH_BINARY_INV
    window = window_px | 1
    average = cv2.boxFilter(grey, cv2.CV_32F, (window, window), borderType=cv2.BORDER_REPLICATE)
    difference = grey.astype(np.float32) - average
    _, binary = cv2.threshold(difference, offset if light else -offset, 255, mode)
    count, labels, stats, centroids = cv2.connectedComponentsWithStats(binary.astype(np.uint8), connectivity=4)
    height, width = grey.shape
    area = stats[:, cv2.CC_STAT_AREA].astype(float)
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    w, h = stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]
    keep = (area >= 12) & (area < 0.03 * height * width) & (left > 0) & (top > 0)
    keep &= (left + w < width) & (top + h < height) & (np.maximum(w, h) < 0.25 * max(height, width))
    keep &= (area > 0.3 * w * h) & (w >= 3) & (h >= 3)
    keep[0] = False
    number = np.full(count, -1)
    number[keep] = np.arange(keep.sum())
    if not keep.any():
        return Candidates(np.zeros((0, 2)), np.zeros(0), np.zeros(0))
    at = number[labels]
    v, u = np.nonzero(at >= 0)
    which = at[v, u]
    centre = centroids[keep]
    du, dv = u - centre[which, 0], v - centre[which, 1]
    n = len(centre)
    uu = np.bincount(which, du * du, n) / area[keep] + 1 / 12
    vv = np.bincount(which, dv * dv, n) / area[keep] + 1 / 12
    uv = np.bincount(which, du * dv, n) / area[keep]
    determinant = np.maximum(uu * vv - uv * uv, 1e-12)
    filled = area[keep] / (4 * np.pi * np.sqrt(determinant))  # 1 for every ellipse
    trace = (uu + vv) / 2
    slender = (trace + np.sqrt(np.maximum(trace**2 - determinant, 0))) / np.sqrt(determinant)  # ratio of the axes
    small = area[keep] < 60
    good = (np.abs(filled - 1) < np.where(small, 0.2, 0.1)) & (slender < 6)
    order = np.argsort(-area[keep][good], kind="stable")
    return Candidates(
        centre[good][order].astype(float), np.full(int(good.sum()), np.nan), area[keep][good][order].astype(float)
    )
