"""One grey image in which the stripe is found, and one in which it is measured, from a grey or colour frame.

A coloured laser is found in the difference of its channel from the mean of the other two: white and grey things vanish,
however bright they are. Where the core of the stripe saturates all channels it is as white as paper; there the difference is
filled in from its surroundings. Where a background is subtracted, grey is as good as colour, and does not mind saturation.
The centre is measured in the channel that shows the stripe best: highest above its background, and not clipped. For a red
laser on white paper that is green, on a dark surface red.

This is the plain way, which works on whole planes; :mod:`rotaline.vision.stripe.channels` is the fast one.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8, UInt16

from rotaline.vision.images import Image
from rotaline.vision.stripe.plane import clip_limit
from rotaline.vision.stripe.profiles import sample_profiles
from rotaline.vision.stripe.ridges import Ridge, find_ridges

CHANNELS = ("red", "green", "blue")
CORE_PX = 25  # a saturated core up to this wide is filled
NEAR_WHITE_PX = 9  # so wide the surroundings of a white pixel are
_MATCH_PIXELS, LEAST_PIXELS, MATCH_PASSES = 40_000, 100, 6
MATCH_BELOW = 0.97  # of the range
LEAST_SPREAD, MOST_GAIN = 8.0, 1.4  # standard deviation in grey values of an 8 bit image; ratio
WHITE = 0.85  # of the range: what is brighter in all channels has lost its colour
LIT = 20.0  # grey values of an 8 bit image
CLEAR = 6.0  # grey values of an 8 bit image: prominence of a ridge in colour that things in a room hardly reach
_CROWD = 20  # ridges; a stripe alone makes fewer
_CROWD_PART, _CROWD_SHARE, _FAINT_PART = 0.25, 0.04, 0.035


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame as floating point planes, background subtracted.

    Attributes
    ----------
    planes : 1 or 3 of (h, w)   grey values
    clipped : same number, (h, w) or None   pixels at the top of the range
    white : (h, w) or None   pixels near the top of the range in all channels of a colour image
    subtracted : bool   a background was subtracted
    lit : bool   that background shows a scene in the light of lamps
    unit : float   one grey value of an 8 bit image, in the image's grey values (1 or 257)
    """

    planes: tuple[Float32[np.ndarray, "h w"], ...]
    clipped: tuple[Bool[np.ndarray, "h w"] | None, ...]
    white: Bool[np.ndarray, "h w"] | None
    subtracted: bool
    lit: bool
    unit: float


def split_frame(image: Image, background: Image | None) -> Frame:
    """Planes of the image minus those of the background, which is matched to the image first: exposure and lamps drift.

    Raises
    ------
    ValueError
        If the two differ in shape or type.
    """
    check_background(image, background)
    top = int(np.iinfo(image.dtype).max)
    unit = top / 255.0
    limit = clip_limit(top)
    sources = [image] if image.ndim == 2 else list(cv2.split(image))
    grounds = (
        [None] * len(sources) if background is None else [background] if image.ndim == 2 else cv2.split(background)
    )
    clipped: list[np.ndarray | None] = []
    planes = []
    for source, ground in zip(sources, grounds, strict=True):
        top_pixels = source >= limit
        clipped.append(top_pixels if top_pixels.any() else None)
        plane = source.astype(np.float32)
        if ground is not None:
            gain, offset = match_exposure(source, ground)
            plane -= np.float32(gain) * ground + np.float32(offset)
        planes.append(plane)
    white = np.logical_and.reduce([source >= WHITE * top for source in sources]) if len(sources) == 3 else None
    if white is not None and not white.any():
        white = None
    lit = background is not None and is_lit(background)
    return Frame(tuple(planes), tuple(clipped), white, background is not None, lit, unit)


def check_background(image: Image, background: Image | None) -> None:
    """Raise ValueError if the two differ in shape or type."""
    if background is not None and (background.shape != image.shape or background.dtype != image.dtype):
        raise ValueError(
            f"the background is {background.shape} {background.dtype}, the image {image.shape} {image.dtype}; "
            "both must come from one camera with one setting"
        )


def is_lit(background: Image) -> bool:
    """At least half of a background is as bright as a scene in the light of lamps."""
    some = background[::7, ::7]
    return bool(2 * np.count_nonzero(some >= LIT * np.iinfo(background.dtype).max / 255.0) >= some.size)


def match_step(n_pixels: int) -> int:
    """Of so many rows and columns one is looked at to match the exposure."""
    return max(1, int(np.sqrt(n_pixels / _MATCH_PIXELS)))


def match_exposure(
    image: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"],
    background: UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"],
) -> tuple[float, float]:
    """Gain and offset that make the background as bright as the image where the laser does not shine.

    A straight line through the grey values of the two, fitted again and again to the pixels that lie near it; clipped pixels
    do not count. A scene too plain for a line has the ratio of the medians as gain. (1, 0) where it is too dark to tell, and
    where the gain is not near 1: then the frames differ by more than their exposure.
    """
    top = int(np.iinfo(image.dtype).max)
    unit = top / 255.0
    step = match_step(image.size)
    x, y = (np.asarray(part[::step, ::step], dtype=float).ravel() for part in (background, image))
    usable = (np.maximum(x, y) < MATCH_BELOW * top) & (x > 0)
    if usable.sum() < LEAST_PIXELS:
        return 1.0, 0.0
    x, y = x[usable], y[usable]
    gain, offset = 1.0, float(np.median(y - x))
    for _ in range(MATCH_PASSES):
        rest = np.abs(y - gain * x - offset)
        near = rest <= 3.0 * max(1.4826 * float(np.median(rest)), unit)
        if near.sum() < LEAST_PIXELS or np.std(x[near]) < LEAST_SPREAD * unit:
            bright = float(np.median(x))
            gain, offset = float(np.median(y)) / bright if bright >= LIT * unit else 1.0, 0.0
            break
        mean_x, mean_y = float(x[near].mean()), float(y[near].mean())
        dx = x[near] - mean_x
        gain = float(dx @ y[near] / (dx @ dx))
        offset = mean_y - gain * mean_x
    return (gain, offset) if 1.0 / MOST_GAIN < gain < MOST_GAIN else (1.0, 0.0)


def score_images(frame: Frame, colour: str) -> Iterator[tuple[str, Float32[np.ndarray, "h w"]]]:
    """Images in which a stripe of the colour is bright, by name; for ``auto`` one for each colour, and grey last."""
    if len(frame.planes) == 1:
        yield "grey", frame.planes[0]
        return
    total = frame.planes[0] + frame.planes[1] + frame.planes[2]
    for name in score_names(colour):
        if name == "grey":
            yield name, total / np.float32(3.0)
        else:
            plane = frame.planes[CHANNELS.index(name)]
            yield name, _fill_core(frame, cv2.addWeighted(plane, 1.5, total, -0.5, 0.0))


def score_names(colour: str) -> tuple[str, ...]:
    """The images in which a stripe of the colour is looked for in a colour frame."""
    return (*CHANNELS, "grey") if colour == "auto" else (colour,) if colour in CHANNELS else ("grey",)


def _fill_core(frame: Frame, score: np.ndarray) -> np.ndarray:
    """Close the valley in the score where all channels are near the top: the core of a stripe may have lost its colour."""
    if frame.white is None:
        return score
    near_white = cv2.dilate(frame.white.astype(np.uint8), np.ones((NEAR_WHITE_PX, NEAR_WHITE_PX), np.uint8))
    small = cv2.resize(score, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    kernel = np.ones((CORE_PX // 2 | 1, CORE_PX // 2 | 1), np.uint8)
    closed = cv2.morphologyEx(small, cv2.MORPH_CLOSE, kernel)
    closed = cv2.resize(closed, score.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.where(near_white > 0, np.maximum(score, closed), score)


def find_stripe(
    frame: Frame, colour: str, threshold: float, min_contrast: float, min_length_px: float
) -> tuple[list[Ridge], bool]:
    """The ridges of the score image that shows the strongest, see :func:`score_images`.

    Any colour with a clear ridge goes before grey, since the things in a room make strong ridges in grey but weak ones in
    colour; not so where a background was subtracted, which takes them away. A frame with many ridges shows the scene itself;
    then only those stay that have a quarter of the prominence of the strongest one and a twenty-fifth of its strength.
    Elsewhere a thirtieth of the prominence is enough.

    Returns
    -------
    ridges : list of Ridge
    crowded : bool   the frame shows the scene itself
    """
    best: list[Ridge] = []
    best_strength = 0.0
    clear = False
    for name, score in score_images(frame, colour):
        if name == "grey" and clear and not frame.subtracted:
            continue
        ridges = find_ridges(score, threshold, min_contrast * frame.unit)
        strongest = max(ridges, key=lambda r: r.strength, default=None)
        if strongest is not None and strongest.strength > best_strength:
            best, best_strength = ridges, strongest.strength
            clear |= len(strongest.uv) * strongest.scale_px >= 3.0 * min_length_px and bool(
                np.median(strongest.prominence) >= CLEAR * frame.unit
            )
    if not best:
        return best, False
    usual = float(np.median(max(best, key=lambda r: r.strength).prominence))
    long = [r for r in best if len(r.uv) * r.scale_px >= min_length_px]
    crowded = len(long) > _CROWD
    if crowded:
        best = long
    part, share = (_CROWD_PART, _CROWD_SHARE) if crowded else (_FAINT_PART, 0.0)
    best = [r for r in best if np.median(r.prominence) > part * usual and r.strength > share * best_strength]
    return best, crowded


def measuring_plane(frame: Frame, channel: str, ridges: list[Ridge]) -> int:
    """Index of the plane in which the centres are measured: the wanted channel, or the one that shows the stripe best.

    The figure of merit of a plane is the median height of the stripe above its sides over their scatter, times the part of
    the stripe that is not clipped (at least a tenth).
    """
    if len(frame.planes) == 1:
        return 0
    if channel in CHANNELS:
        return CHANNELS.index(channel)
    most = max(ridge.strength for ridge in ridges)
    ridges = [ridge for ridge in ridges if ridge.strength >= 0.2 * most]
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
