"""Reading one image file: PNG, JPEG, BMP or TIFF, grey or colour, 8 or 16 bit."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16

from rotaline.errors import SessionError

Image = UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"] | UInt8[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w 3"]
"""Grey (h, w) or colour (h, w, 3) in the order red, green, blue; ``image[v, u]``."""

EXTENSIONS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_PNG_END = b"IEND\xaeB`\x82"


def read_image(path: Path) -> Image:
    """Read an image as it was stored; an alpha channel is dropped.

    Returns
    -------
    (h, w) or (h, w, 3) red, green, blue; uint8 or uint16

    Raises
    ------
    SessionError
        If the file is missing, is cut off, or is no image; the message names the file and what to do.
    """
    if path.suffix.lower() not in EXTENSIONS:
        raise SessionError(f"{path}: expected one of {', '.join(EXTENSIONS)}, found '{path.suffix}'.")
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SessionError(
            f"{path}: the image cannot be read ({error.strerror}). Put it back or remove its row."
        ) from error
    cut = (data[:4] == b"\x89PNG" and data[-8:] != _PNG_END) or (
        data[:2] == b"\xff\xd8" and b"\xff\xd9" not in data[-1024:]
    )
    if cut:
        raise SessionError(
            f"{path}: the file is cut off ({len(data)} bytes). Copy it again from the camera's computer."
        )
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if image is None:
        raise SessionError(
            f"{path}: this is not a readable image ({len(data)} bytes). Copy it again or remove its row."
        )
    if image.dtype not in (np.uint8, np.uint16):
        raise SessionError(f"{path}: expected 8 or 16 bit values, found {image.dtype}.")
    if image.ndim == 2:
        return image
    return np.ascontiguousarray(image[:, :, 2::-1])


def to_grey(image: Image) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]:
    """Grey values of a colour image (Rec. 601 weights), same depth; a grey image as it is."""
    return image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
