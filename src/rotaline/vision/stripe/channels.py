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
from rotaline.vision.stripe.plane import Plane
from rotaline.vision.stripe.signal import (
    CHANNELS,
    CORE_PX,
    LEAST_PIXELS,
    LEAST_SPREAD,
    LIT,
    MATCH_BELOW,
    MATCH_PASSES,
    MOST_GAIN,
    WHITE,
    check_background,
    is_lit,
    match_step,
)
from rotaline.vision.stripe.signal_kernels import WHITE_TILE, fit_line, heights, score, subtract, take_pairs

STEPS = 32  # of a searched image, for one grey value of an 8 bit image
_ZERO = 32768
_CORE_MARGIN_PX = 2 * WHITE_TILE  # what lies so far from a saturated core does not change what it is filled with
_NEAR_WHITE_PX = 4
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
    found = take_pairs(image, background, k, n, step, MATCH_BELOW * top, x, y)
    if found < LEAST_PIXELS:
        return 1.0, 0.0
    unit = top / 255.0
    gain, offset = fit_line(
        x[:found], y[:found], unit, MATCH_PASSES, LEAST_PIXELS, LEAST_SPREAD * unit, LIT * unit
    )
    return (gain, offset) if 1.0 / MOST_GAIN < gain < MOST_GAIN else (1.0, 0.0)


def _rows(image: Image) -> Shaped[np.ndarray, "h values"]:
    """The values in rows, to be read only: so one compiled kernel serves all images of a depth."""
    view = np.ascontiguousarray(image).reshape(len(image), -1).view()
    view.flags.writeable = False
    return view


class _Space(threading.local):
    """Work space of one thread: the image that is searched."""

    def __init__(self) -> None:
        self._values = np.zeros((0, 0), dtype=np.uint16)

    def image(self, shape: tuple[int, int]) -> UInt16[np.ndarray, "h w"]:
        """An image with any values."""
        if self._values.shape != shape:
            self._values = np.empty(shape, dtype=np.uint16)
        return self._values


_space = _Space()


def score_image(channels: Channels, name: str) -> UInt16[np.ndarray, "h w"]:
    """The image in which a stripe of a colour is bright, or the ``grey`` one, of a colour frame; see
    :func:`rotaline.vision.stripe.signal.score_images`.

    The next call in the same thread overwrites it.
    """
    image, background, subtracted = channels.rows()
    weights = np.full(3, 1.0 / 3.0) if name == "grey" else np.where(np.array(CHANNELS) == name, 1.0, -0.5)
    h, w = channels.image.shape[:2]
    out = _space.image((h, w))
    white = np.zeros((-(-h // WHITE_TILE), -(-w // WHITE_TILE)), dtype=bool)
    weights *= STEPS / channels.unit
    score(image, background, subtracted, channels.lines, weights, _ZERO, WHITE * channels.top, out, white)
    if name != "grey" and white.any():
        _fill_cores(out, channels, white)
    return out


def _fill_cores(values: UInt16[np.ndarray, "h w"], channels: Channels, white: Bool[np.ndarray, "rows columns"]) -> None:
    """Close the valleys in the score where all channels are near the top: the core of a stripe may have lost its colour.

    Done in boxes around connected tiles with white pixels, each with what lies near them; all from the values as they were.
    """
    count, _, boxes, _ = cv2.connectedComponentsWithStats(white.astype(np.uint8))
    h, w = values.shape
    filled = []
    for left, top, width, height, _ in (boxes[k] for k in range(1, count)):
        rows = _span(top, height, h)
        columns = _span(left, width, w)
        filled.append((rows, columns, _filled(values[rows, columns], channels.image[rows, columns], channels.top)))
    for rows, columns, (near, closed) in filled:
        np.copyto(values[rows, columns], closed, where=near)


def _span(first: int, count: int, size: int) -> slice:
    """Pixels of some tiles and a margin; all of them where their number is odd, so that the half size has the same pixels."""
    if size % 2:
        return slice(0, size)
    begin = first * WHITE_TILE - _CORE_MARGIN_PX
    return slice(max(begin, 0), min(begin + count * WHITE_TILE + 2 * _CORE_MARGIN_PX, size))


def _filled(
    values: UInt16[np.ndarray, "h w"], image: Image, top: int
) -> tuple[Bool[np.ndarray, "h w"], UInt16[np.ndarray, "h w"]]:
    """Where there is white near, and the values with valleys closed."""
    least = float(np.ceil(WHITE * top))
    white = cv2.inRange(image, (least,) * 3, (float(top),) * 3)
    near = cv2.dilate(white, np.ones((2 * _NEAR_WHITE_PX + 1,) * 2, np.uint8))
    small = cv2.resize(values, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    closed = cv2.morphologyEx(small, cv2.MORPH_CLOSE, np.ones((CORE_PX // 2 | 1,) * 2, np.uint8))
    closed = cv2.resize(closed, values.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return near > 0, np.asarray(cv2.max(values, closed))


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
        image, background, subtracted, channels.lines, float(_limit(channels)), uv[some], steep[own], scale_px[own],
        height, clipped,
    )  # fmt: skip
    return int(np.argmax(np.median(height, axis=1) * np.maximum(1.0 - clipped.mean(axis=1), 0.1)))


def _limit(channels: Channels) -> int:
    """Least value that counts as clipped."""
    top = channels.top
    return top - 2 if top == 255 else int(0.98 * top)


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
