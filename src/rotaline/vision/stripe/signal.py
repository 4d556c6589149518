"""One grey image in which the stripe is found, and one in which it is measured, from a grey or colour frame.

A coloured laser is found in the difference of its channel from the mean of the other two: white and grey things vanish,
however bright they are. Where the core of the stripe saturates all channels it is as white as paper; there the difference is
filled in from its surroundings. The centre is measured in the channel that shows the stripe best: highest above its
background, and not clipped. For a red laser on white paper that is green, on a dark surface red.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from rotaline.vision.images import Image
from rotaline.vision.stripe.profiles import sample_profiles
from rotaline.vision.stripe.ridges import Ridge, find_ridges

CHANNELS = ("red", "green", "blue")
_CORE_PX = 25  # a saturated core up to this wide is filled
_WHITE = 0.85  # of the range: what is brighter in all channels has lost its colour
_CLEAR = 6.0  # grey values of an 8 bit image: prominence of a ridge in colour that things in a room hardly reach
_CROWD = 20  # ridges; a stripe alone makes fewer
_CROWD_PART, _CROWD_SHARE, _FAINT_PART = 0.25, 0.04, 0.035


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame as floating point planes, background subtracted.

    Attributes
    ----------
    planes : 1 or 3 of (h, w)   grey values
    clipped : same number, (h, w) or None   pixels at the top of the range
    unit : float   one grey value of an 8 bit image, in the image's grey values (1 or 257)
    """

    planes: tuple[Float32[np.ndarray, "h w"], ...]
    clipped: tuple[Bool[np.ndarray, "h w"] | None, ...]
    unit: float


def split_frame(image: Image, background: Image | None) -> Frame:
    """Planes of the image minus those of the background.

    The background is scaled by the ratio of the median brightness where that lies near 1: lamps and exposure drift.

    Raises
    ------
    ValueError
        If the two differ in shape or type.
    """
    if background is not None and (background.shape != image.shape or background.dtype != image.dtype):
        raise ValueError(
            f"the background is {background.shape} {background.dtype}, the image {image.shape} {image.dtype}; "
            "both must come from one camera with one setting"
        )
    top = int(np.iinfo(image.dtype).max)
    unit = top / 255.0
    limit = top - 2 if top == 255 else int(0.98 * top)
    sources = [image] if image.ndim == 2 else list(cv2.split(image))
    clipped: list[np.ndarray | None] = []
    planes = []
    scale = 1.0
    if background is not None:
        few, few_background = image[::7, ::7].astype(float), background[::7, ::7].astype(float)
        lit = (few_background > 20 * unit) & (few < 0.9 * top)
        if lit.sum() > 100:
            ratio = float(np.median(few[lit] / few_background[lit]))
            scale = ratio if 0.9 < ratio < 1.1 else 1.0
    grounds = (
        [None] * len(sources) if background is None else [background] if image.ndim == 2 else cv2.split(background)
    )
    for source, ground in zip(sources, grounds, strict=True):
        top_pixels = source >= limit
        clipped.append(top_pixels if top_pixels.any() else None)
        plane = source.astype(np.float32)
        planes.append(plane if ground is None else cv2.scaleAdd(ground.astype(np.float32), -scale, plane))
    return Frame(tuple(planes), tuple(clipped), unit)


def score_images(frame: Frame, colour: str) -> Iterator[tuple[str, Float32[np.ndarray, "h w"]]]:
    """Images in which a stripe of the colour is bright, by name; for ``auto`` one for each colour, and grey last."""
    if len(frame.planes) == 1:
        yield "grey", frame.planes[0]
        return
    total = frame.planes[0] + frame.planes[1] + frame.planes[2]
    wanted = CHANNELS if colour == "auto" else (colour,) if colour in CHANNELS else ()
    for name in wanted:
        plane = frame.planes[CHANNELS.index(name)]
        yield name, _fill_core(frame, cv2.addWeighted(plane, 1.5, total, -0.5, 0.0))
    if colour == "auto" or not wanted:
        yield "grey", total / np.float32(3.0)


def _fill_core(frame: Frame, score: np.ndarray) -> np.ndarray:
    """Close the valley in the score where all channels are near the top: the core of a stripe may have lost its colour."""
    if all(c is None for c in frame.clipped):
        return score
    dark = cv2.min(cv2.min(frame.planes[0], frame.planes[1]), frame.planes[2])
    white = (dark >= np.float32(_WHITE * 255.0 * frame.unit)).astype(np.uint8)
    if not white.any():
        return score
    near_white = cv2.dilate(white, np.ones((9, 9), np.uint8))
    small = cv2.resize(score, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    kernel = np.ones((_CORE_PX // 2 | 1, _CORE_PX // 2 | 1), np.uint8)
    closed = cv2.morphologyEx(small, cv2.MORPH_CLOSE, kernel)
    closed = cv2.resize(closed, score.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(near_white > 0, np.maximum(score, closed), score)


def find_stripe(
    frame: Frame, colour: str, threshold: float, min_contrast: float, min_length_px: float
) -> tuple[list[Ridge], bool]:
    """The ridges of the score image that shows the strongest, see :func:`score_images`.

    Any colour with a clear ridge goes before grey, since the things in a room make strong ridges in grey but weak ones in
    colour. A frame with many ridges shows the scene itself; then only those stay that have a quarter of the prominence of
    the strongest one and a twenty-fifth of its strength. Elsewhere a thirtieth of the prominence is enough.

    Returns
    -------
    ridges : list of Ridge
    crowded : bool   the frame shows the scene itself
    """
    best: list[Ridge] = []
    best_strength = 0.0
    clear = False
    for name, score in score_images(frame, colour):
        if name == "grey" and clear:
            continue
        ridges = find_ridges(score, threshold, min_contrast * frame.unit, min_length_px)
        strongest = max(ridges, key=_strength, default=None)
        if strongest is not None and _strength(strongest) > best_strength:
            best, best_strength = ridges, _strength(strongest)
            clear |= len(strongest.uv) * strongest.scale_px >= 3.0 * min_length_px and bool(
                np.median(strongest.prominence) >= _CLEAR * frame.unit
            )
    if not best:
        return best, False
    usual = float(np.median(max(best, key=_strength).prominence))
    crowded = len(best) > _CROWD
    part, share = (_CROWD_PART, _CROWD_SHARE) if crowded else (_FAINT_PART, 0.0)
    best = [r for r in best if np.median(r.prominence) > part * usual and _strength(r) > share * best_strength]
    return best, crowded


def _strength(ridge: Ridge) -> float:
    """Sum of prominence along the ridge, grey values x px."""
    return float(ridge.prominence.sum()) * ridge.scale_px


def measuring_plane(frame: Frame, channel: str, ridges: list[Ridge]) -> int:
    """Index of the plane in which the centres are measured: the wanted channel, or the one that shows the stripe best.

    The figure of merit of a plane is the median height of the stripe above its sides over their scatter, times the part of
    the stripe that is not clipped (at least a tenth).
    """
    if len(frame.planes) == 1:
        return 0
    if channel in CHANNELS:
        return CHANNELS.index(channel)
    most = max(_strength(ridge) for ridge in ridges)
    ridges = [ridge for ridge in ridges if _strength(ridge) >= 0.2 * most]
    uv = np.concatenate([ridge.uv for ridge in ridges])[::3]
    steep = np.concatenate([np.full(len(ridge.uv), ridge.steep) for ridge in ridges])[::3]
    scale = np.concatenate([np.full(len(ridge.uv), ridge.scale_px) for ridge in ridges])[::3]
    normal = np.where(steep[:, None], [1.0, 0.0], [0.0, 1.0])
    merit = []
    for plane, clipped in zip(frame.planes, frame.clipped, strict=True):
        profiles = sample_profiles(plane, clipped, uv, normal, 6.0 * scale)
        near = profiles.valid & (np.abs(profiles.offset_px) <= 2.0 * scale[:, None])
        far = profiles.valid & (np.abs(profiles.offset_px) >= 4.0 * scale[:, None])
        with np.errstate(invalid="ignore"):
            peak = np.where(near, profiles.value, -np.inf).max(axis=1)
            side = (profiles.value * far).sum(axis=1) / np.maximum(far.sum(axis=1), 1)
        height = float(np.median(np.maximum(peak - side, 0.0)))
        whole = 1.0 - float((profiles.clipped & near).any(axis=1).mean())
        merit.append(height * max(whole, 0.1))
    return int(np.argmax(merit))
