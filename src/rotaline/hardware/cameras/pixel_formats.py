"""From the bytes that a camera sends to an image, by the name of its pixel format.

Names are those of the Pixel Format Naming Convention of EMVA/GenICam, and the older ones of GigE Vision that end in ``Packed``. 8 bit stay
uint8; 10, 12, 14 and 16 bit become uint16 with full scale 65535: the high bits are repeated below the low ones, so that 0 stays 0, full
scale becomes 65535, and each step of the camera stays a step. A Bayer mosaic becomes red, green, blue by bilinear interpolation, which
is linear in the light.
"""

import re
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from rotaline.errors import DeviceStateError, LostFrameError
from rotaline.hardware.camera import Image

_GREY_OR_BAYER = re.compile(r"(Mono|BayerRG|BayerGR|BayerGB|BayerBG)(8|10|12|14|16)(p|Packed)?")
_COLOURS = {
    "RGB8": (3, (0, 1, 2)),
    "RGB8Packed": (3, (0, 1, 2)),
    "BGR8": (3, (2, 1, 0)),
    "BGR8Packed": (3, (2, 1, 0)),
    "RGBa8": (4, (0, 1, 2)),
    "RGBA8Packed": (4, (0, 1, 2)),
    "BGRa8": (4, (2, 1, 0)),
    "BGRA8Packed": (4, (2, 1, 0)),
}
# the convention names the first two pixels of the first row; so do these names of OpenCV, its older ones the second row
_DEMOSAIC = {
    "BayerRG": cv2.COLOR_BayerRGGB2RGB,
    "BayerGR": cv2.COLOR_BayerGRBG2RGB,
    "BayerGB": cv2.COLOR_BayerGBRG2RGB,
    "BayerBG": cv2.COLOR_BayerBGGR2RGB,
}


def supported(pixel_format: str) -> bool:
    """Whether :func:`to_image` knows the format."""
    return pixel_format in _COLOURS or _parts(pixel_format) is not None


def depth_bits(pixel_format: str) -> int:
    """Bits of a pixel, or of one of its colours, 8 to 16.

    Raises
    ------
    DeviceStateError
        If the format is not known.
    """
    parts = _parts(pixel_format)
    if parts is not None:
        return parts[1]
    if pixel_format in _COLOURS:
        return 8
    raise unsupported("the camera", pixel_format)


def is_colour(pixel_format: str) -> bool:
    """Whether the image has red, green and blue."""
    return not pixel_format.startswith("Mono")


def unsupported(device: str, pixel_format: str, offered: Sequence[str] = ()) -> DeviceStateError:
    """The error for a format that cannot be read; ``offered``: all that the camera has."""
    usable = [name for name in offered if supported(name)]
    advice = (
        f"Set pixel_format to one of {', '.join(usable)}."
        if usable
        else "Set the camera to Mono8, Mono12 or a Bayer format."
    )
    return DeviceStateError(f"{device}: the pixel format {pixel_format} cannot be read. {advice}")


def to_image(data: Any, pixel_format: str, width: int, height: int, padding_bytes: int = 0) -> Image:
    """Make an image from the bytes of a frame.

    Parameters
    ----------
    data : bytes, or anything with the buffer interface; what stands behind the image is ignored
    pixel_format : ``Mono8``, ``Mono12p``, ``Mono12Packed``, ``BayerRG8``, ``RGB8`` ...
    width, height : px
    padding_bytes : at the end of each line

    Returns
    -------
    image : (h, w), or (h, w, 3) red, green, blue; uint8, or uint16 with full scale 65535; a copy

    Raises
    ------
    DeviceStateError
        If the format is not known.
    LostFrameError
        If there are too few bytes.
    """
    raw = np.frombuffer(data, np.uint8)
    if pixel_format in _COLOURS:
        n_bytes, order = _COLOURS[pixel_format]
        lines = _lines(raw, width * n_bytes, height, padding_bytes, pixel_format)
        return np.ascontiguousarray(lines.reshape(height, width, n_bytes)[:, :, list(order)])
    parts = _parts(pixel_format)
    if parts is None:
        raise unsupported("the camera", pixel_format)
    kind, bits, packing = parts
    values = _values(raw, bits, packing, width, height, padding_bytes, pixel_format)
    if kind == "Mono":
        return values
    return np.ascontiguousarray(cv2.cvtColor(values, _DEMOSAIC[kind]))


def to_full_scale(values: np.ndarray, bits: int) -> np.ndarray:
    """Values of 8 to 16 bits in uint16, as uint16 with full scale 65535."""
    wide = values.astype(np.uint16)
    if bits == 16:
        return wide
    wide &= np.uint16((1 << bits) - 1)  # some cameras send other things in the upper bits
    return (wide << np.uint16(16 - bits)) | (wide >> np.uint16(2 * bits - 16))


def _parts(pixel_format: str) -> tuple[str, int, str] | None:
    match = _GREY_OR_BAYER.fullmatch(pixel_format)
    if match is None:
        return None
    kind, bits, packing = match[1], int(match[2]), match[3] or ""
    if (packing and bits in (8, 16)) or (packing == "Packed" and bits == 14):
        return None
    return kind, bits, packing


def _lines(raw: np.ndarray, line_bytes: int, height: int, padding_bytes: int, pixel_format: str) -> np.ndarray:
    stride = line_bytes + padding_bytes
    needed = stride * height - padding_bytes  # the last line may come without its padding
    _enough(raw, needed, pixel_format)
    if padding_bytes == 0:
        return raw[:needed].reshape(height, line_bytes)
    whole = np.zeros(stride * height, np.uint8)
    whole[: min(raw.size, whole.size)] = raw[: whole.size]
    return whole.reshape(height, stride)[:, :line_bytes]


def _enough(raw: np.ndarray, needed: int, pixel_format: str) -> None:
    if raw.size < needed:
        raise LostFrameError(f"A frame came with {raw.size} bytes instead of the {needed} of its {pixel_format} image.")


def _values(
    raw: np.ndarray, bits: int, packing: str, width: int, height: int, padding_bytes: int, pixel_format: str
) -> np.ndarray:
    if bits == 8:
        return _lines(raw, width, height, padding_bytes, pixel_format).copy()
    if not packing:
        lines = _lines(raw, 2 * width, height, padding_bytes, pixel_format)
        return to_full_scale(np.ascontiguousarray(lines).view("<u2"), bits)
    per_pixel = (
        12 if packing == "Packed" else bits
    )  # the older formats put two pixels of 10 bit into three bytes as well
    if padding_bytes:  # then each line begins with a byte of its own
        rows = _lines(raw, (width * per_pixel + 7) // 8, height, padding_bytes, pixel_format)
        values = np.stack([_unpack(row, width, bits, packing) for row in rows])
    else:
        needed = (width * height * per_pixel + 7) // 8
        _enough(raw, needed, pixel_format)
        values = _unpack(raw[:needed], width * height, bits, packing).reshape(height, width)
    return to_full_scale(values, bits)


def _unpack(raw: np.ndarray, n: int, bits: int, packing: str) -> np.ndarray:
    """``n`` values from packed bytes."""
    if packing == "Packed":  # high bits of a, low bits of both, high bits of b
        groups = _groups(raw, 3)
        low = bits - 8
        mask = (1 << low) - 1
        a = (groups[:, 0] << low) | (groups[:, 1] & mask)
        b = (groups[:, 2] << low) | ((groups[:, 1] >> 4) & mask)
        return np.stack([a, b], axis=1).reshape(-1)[:n]
    group_bytes = {10: 5, 12: 3, 14: 7}[bits]  # little endian, one value behind the other
    groups = _groups(raw, group_bytes).astype(np.uint64)
    word = np.zeros(len(groups), np.uint64)
    for i in range(group_bytes):
        word |= groups[:, i] << np.uint64(8 * i)
    per_group = 8 * group_bytes // bits
    shifts = np.arange(per_group, dtype=np.uint64) * np.uint64(bits)
    values = (word[:, None] >> shifts) & np.uint64((1 << bits) - 1)
    return values.astype(np.uint16).reshape(-1)[:n]


def _groups(raw: np.ndarray, size: int) -> np.ndarray:
    """(n, size) bytes as uint16; a last group that is cut off is filled with 0."""
    n = -(-raw.size // size)
    whole = np.zeros(n * size, np.uint16)
    whole[: raw.size] = raw
    return whole.reshape(n, size)
