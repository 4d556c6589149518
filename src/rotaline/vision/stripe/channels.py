"""The channels of a frame, worked on only as far as they are asked for.

The same as :mod:`rotaline.vision.stripe.signal`, which makes floating point planes of all channels, in compiled sweeps over the frame. An image
in which a stripe is to be found has whole numbers, in steps of a 32nd of a grey value of an 8 bit image, and lives in work space of the thread.
"""

import threading
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8, UInt16

from rotaline.vision.images import Image
from rotaline.vision.stripe.plane import Plane, clip_limit
from rotaline.vision.stripe.signal import (
    CHANNELS,
    CORE_PX,
    LEAST_PIXELS,
    LEAST_SPREAD,
    LIT,
    MATCH_BELOW,
    MATCH_PASSES,
    MOST_GAIN,
    NEAR_WHITE_PX,
    WHITE,
    check_background,
    is_lit,
    match_step,
)
from rotaline.vision.stripe.signal_kernels import fit_line, heights, score, subtract, take_pairs, to_steps

STEPS = 32  # of a searched image, for one grey value of an 8 bit image
ZERO = 32768  # of a searched image
_CORE_MARGIN_PX = 48  # what lies so far from a saturated core does not change what it is filled with
_SPARSE = 3  # of so many points of a stripe one tells in which channel it is best seen


@dataclass(frozen=True, eq=False)
class Channels:
    """A frame, and how its background is to be subtracted.

    Attributes
    ----------
    image : (h, w) or (h, w, 3)
    background : the same, or None
    lines : (1, 2) or (3, 2)   gain and offset that make each channel of the background as bright as the image
    lit : bool   the background shows a scene in the light of lamps
    top : int   greatest value of the sensor's range
    """

    image: Image
    background: Image | None
    lines: Float[np.ndarray, "k 2"]
    lit: bool
    top: int

    @property
    def unit(self) -> float:
        """One grey value of an 8 bit image, in the image's grey values (1 or 257)."""
        return self.top / 255.0

    def rows(self) -> tuple[np.ndarray, np.ndarray, bool]:
        """The values of image and background in rows of pixels, to be read only; and whether there is a background."""
        image = _rows(self.image)
        return image, image if self.background is None else _rows(self.background), self.background is not None


def channels_of(image: Image, background: Image | None) -> Channels:
    """Match the background to the image, channel by channel; see :func:`rotaline.vision.stripe.signal.match_exposure`.

    Raises
    ------
    ValueError
        If the two differ in shape or type.
    """
    check_background(image, background)
    top = int(np.iinfo(image.dtype).max)
    n = 1 if image.ndim == 2 else 3
    lines = np.tile([1.0, 0.0], (n, 1))
    if background is not None:
        rows, ground = _rows(image), _rows(background)
        for k in range(n):
            lines[k] = _match(rows, ground, k, n, top)
    return Channels(image, background, lines, background is not None and is_lit(background), top)


def _match(
    image: Shaped[np.ndarray, "h values"], background: Shaped[np.ndarray, "h values"], k: int, n: int, top: int
) -> tuple[float, float]:
    """Gain and offset for channel ``k`` of ``n``."""
    h, w = image.shape[0], image.shape[1] // n
    step = match_step(h * w)
    x, y = np.empty((2, -(-h // step) * -(-w // step) + 1), dtype=np.float32)
    times = np.empty(len(x), dtype=np.int32)
    found = take_pairs(image, background, k, n, step, MATCH_BELOW * top, x, y, times)
    if times[:found].sum() < LEAST_PIXELS:
        return 1.0, 0.0
    unit = top / 255.0
    gain, offset = fit_line(
        x[:found], y[:found], times[:found], unit, MATCH_PASSES, LEAST_PIXELS, LEAST_SPREAD * unit, LIT * unit
    )
    return (gain, offset) if 1.0 / MOST_GAIN < gain < MOST_GAIN else (1.0, 0.0)


def _rows(image: Image) -> Shaped[np.ndarray, "h values"]:
    """The values in rows, to be read only: so one compiled kernel serves all images of a depth."""
    view = np.ascontiguousarray(image).reshape(len(image), -1).view()
    view.flags.writeable = False
    return view


@dataclass(frozen=True, eq=False)
class Planes:
    """The channels of a colour frame and of its background one after the other, to be read only; the same, where there is no background."""

    image: Shaped[np.ndarray, "3 h w"]
    background: Shaped[np.ndarray, "3 h w"]


class _Space(threading.local):
    """Work space of one thread, for images of one size: the image that is searched, where the frame is white, and its channels."""

    def __init__(self) -> None:
        self.values, self.white = np.zeros((0, 0), dtype=np.uint16), np.zeros((0, 0), dtype=np.uint8)
        self.planes = np.zeros((2, 3, 0, 0), dtype=np.uint8)

    def fit(self, shape: tuple[int, ...]) -> tuple[UInt16[np.ndarray, "h w"], UInt8[np.ndarray, "h w"]]:
        """The image and the white, with any values."""
        if self.values.shape != shape:
            self.values, self.white = np.empty(shape, dtype=np.uint16), np.empty(shape, dtype=np.uint8)
        return self.values, self.white

    def split(self, image: Image, k: int) -> Shaped[np.ndarray, "3 h w"]:
        """The channels of the image (k = 0) or of its background (k = 1)."""
        shape = (2, 3, *image.shape[:2])
        if self.planes.shape != shape or self.planes.dtype != image.dtype:
            self.planes = np.empty(shape, dtype=image.dtype)
        cv2.split(np.ascontiguousarray(image), list(self.planes[k]))
        return self.planes[k]


_space = _Space()


def planes_of(channels: Channels) -> Planes:
    """The channels of a colour frame, for :func:`score_image`.

    The next call in the same thread overwrites them.
    """
    image = _space.split(channels.image, 0)
    return Planes(image, image if channels.background is None else _space.split(channels.background, 1))


def score_image(channels: Channels, planes: Planes, name: str) -> UInt16[np.ndarray, "h w"]:
    """The image in which a stripe of a colour is bright, or the ``grey`` one, of a colour frame; see
    :func:`rotaline.vision.stripe.signal.score_images`.

    The next call in the same thread overwrites it.
    """
    weights = np.full(3, 1.0 / 3.0) if name == "grey" else np.where(np.array(CHANNELS) == name, 1.0, -0.5)
    weights *= STEPS / channels.unit
    values, white = _space.fit(channels.image.shape[:2])
    n_white = score(
        planes.image, planes.background, channels.background is not None, channels.lines, weights, ZERO,
        WHITE * channels.top, values, white,
    )  # fmt: skip
    if n_white and name != "grey":
        _fill_core(values, white)
    return values


def steps_of(plane: Plane) -> UInt16[np.ndarray, "h w"]:
    """The values of a plane as the image in which a stripe is searched.

    The next call in the same thread overwrites it.
    """
    values, _ = _space.fit(plane.value.shape)
    to_steps(plane.value, STEPS / plane.unit, ZERO, values)
    return values


def _fill_core(values: UInt16[np.ndarray, "h w"], white: UInt8[np.ndarray, "h w"]) -> None:
    """Close the valleys in the score where all channels are near the top: the core of a stripe may have lost its colour.

    Only the box around the white pixels is looked at.
    """
    left, top, width, height = cv2.boundingRect(white)
    box = _span(top, height, values.shape[0]), _span(left, width, values.shape[1])
    part = values[box]
    small = cv2.resize(part, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    closed = cv2.morphologyEx(small, cv2.MORPH_CLOSE, np.ones((CORE_PX // 2 | 1,) * 2, np.uint8))
    closed = cv2.resize(closed, part.shape[::-1], interpolation=cv2.INTER_LINEAR)
    near = cv2.dilate(white[box], np.ones((NEAR_WHITE_PX,) * 2, np.uint8))
    cv2.copyTo(cv2.max(part, closed), near, part)


def _span(first: int, count: int, size: int) -> slice:
    """Some pixels of a row or column, and a margin; all of them where their number is odd, so that the half size has the same pixels."""
    if size % 2:
        return slice(0, size)
    return slice(max((first - _CORE_MARGIN_PX) & ~1, 0), min((first + count + _CORE_MARGIN_PX) & ~1, size))


def measuring_channel(
    channels: Channels,
    wanted: str,
    uv: Float[np.ndarray, "n 2"],
    prominence: Float[np.ndarray, " n"],
    chain: Shaped[np.ndarray, " n"],
    steep: Bool[np.ndarray, " k"],
    scale_px: Float[np.ndarray, " k"],
) -> int:
    """The channel in which the centres of found chains are measured; see :func:`rotaline.vision.stripe.signal.measuring_plane`."""
    if channels.image.ndim == 2 or len(uv) == 0:
        return 0
    if wanted in CHANNELS:
        return CHANNELS.index(wanted)
    strength = np.bincount(chain, prominence, len(scale_px)) * scale_px
    some = np.flatnonzero((strength >= 0.2 * strength.max())[chain])[::_SPARSE]
    image, background, subtracted = channels.rows()
    height, clipped = np.empty((3, len(some))), np.empty((3, len(some)), dtype=bool)
    own = chain[some]
    heights(
        image, background, subtracted, channels.lines, float(clip_limit(channels.top)), uv[some], steep[own], scale_px[own],
        height, clipped,
    )  # fmt: skip
    return int(np.argmax(np.median(height, axis=1) * np.maximum(1.0 - clipped.mean(axis=1), 0.1)))


def plane_of(channels: Channels, k: int) -> Plane:
    """One channel as the image in which centres are measured."""
    source = _channel(channels.image, k)
    if channels.background is None:
        return Plane(source, source)
    value = np.empty(source.shape, dtype=np.float32)
    gain, offset = channels.lines[k]
    subtract(_rows(source), _rows(_channel(channels.background, k)), gain, offset, value)
    return Plane(value, source, channels.lit)


def _channel(image: Image, k: int) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]:
    """One channel; a grey image as it is."""
    return image if image.ndim == 2 else np.asarray(cv2.extractChannel(np.ascontiguousarray(image), k))
