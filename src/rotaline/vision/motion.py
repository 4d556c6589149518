"""How far points of a scene have moved from one image to another.

Points with structure around them are followed by the pyramidal method of Lucas and Kanade, there and back again; where both ways
disagree, a point is lost.
"""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from rotaline.vision.images import Image, to_grey

_WINDOW_PX = 21
_LEVELS = 4
_DISAGREE_PX = 0.3
_APART_PX = 12.0


def points_to_follow(image: Image, at_most: int = 300) -> Float[np.ndarray, "n 2"]:
    """Points that can be told from what is around them, px; none where the image is plain."""
    grey = _eight_bit(image, _scale(image))
    # the noise of the image must not pass for structure
    found = cv2.goodFeaturesToTrack(cv2.GaussianBlur(grey, (0, 0), 1.5), at_most, 0.05, _APART_PX, blockSize=7)
    return np.zeros((0, 2)) if found is None else found.reshape(-1, 2).astype(float)


def follow(before: Image, after: Image, uv: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """How far each point has moved, px.

    Parameters
    ----------
    before, after : of the same size and depth
    uv : (n, 2)   places in ``before``, px

    Returns
    -------
    (n, 2)   displacement; NaN rows where a point was lost
    """
    if len(uv) == 0:
        return np.zeros((0, 2))
    scale = _scale(before)
    first, second = _eight_bit(before, scale), _eight_bit(after, scale)
    start = uv.astype(np.float32).reshape(-1, 1, 2)
    there, found = _flow(first, second, start)
    back, again = _flow(second, first, there)
    sure = found & again & (np.linalg.norm((back - start).reshape(-1, 2), axis=1) < _DISAGREE_PX)
    moved = (there - start).reshape(-1, 2).astype(float)
    moved[~sure] = np.nan
    return moved


def _flow(
    first: UInt8[np.ndarray, "h w"], second: UInt8[np.ndarray, "h w"], start: Float[np.ndarray, "n 1 2"]
) -> tuple[np.ndarray, np.ndarray]:
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
    there, status, _ = cv2.calcOpticalFlowPyrLK(
        first, second, start, start.copy(), winSize=(_WINDOW_PX, _WINDOW_PX), maxLevel=_LEVELS, criteria=criteria
    )
    return np.asarray(there), np.asarray(status).ravel() == 1


def _scale(image: Image) -> float:
    """So that the brightest parts use the 8 bits that OpenCV follows points in."""
    return 250.0 / max(float(np.quantile(to_grey(image)[::2, ::2], 0.999)), 1.0)


def _eight_bit(image: Image, scale: float) -> UInt8[np.ndarray, "h w"]:
    return np.clip(np.rint(to_grey(image).astype(np.float32) * scale), 0, 255).astype(np.uint8)
