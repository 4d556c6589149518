"""Reading one image file: PNG, JPEG, BMP or TIFF, grey or colour, 8 or 16 bit."""

import warnings
from io import BufferedReader, BytesIO
from pathlib import Path, PurePath

import cv2
import numpy as np
from jaxtyping import UInt8, UInt16
from PIL import Image as Pillow

from rotaline.errors import SessionError

Image = UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"] | UInt8[np.ndarray, "h w 3"] | UInt16[np.ndarray, "h w 3"]
"""Grey (h, w) or colour (h, w, 3) in the order red, green, blue; ``image[v, u]``."""

EXTENSIONS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
_COPY_AGAIN = "Copy it again from where it was taken, or remove its row from frames.csv."


def one_thread_per_image() -> None:
    """Keep OpenCV from starting threads of its own: frames are worked on side by side already."""
    cv2.setNumThreads(1)


def image_size(stream: BufferedReader, label: str) -> tuple[int, int]:
    """Width and height of an image file from its header; also notices a file that is cut off.

    Parameters
    ----------
    stream : the file, from its beginning
    label : its name for messages, with the suffix

    Raises
    ------
    SessionError
        If the file is cut off or no image; the message names the file and what to do.
    """
    suffix = PurePath(label).suffix
    if suffix.lower() not in EXTENSIONS:
        raise SessionError(f"{label}: expected one of {', '.join(EXTENSIONS)}, found '{suffix}'.")
    try:
        head = stream.read(8)
        length = stream.seek(0, 2)
        stream.seek(max(0, length - 1024))
        _check_end(label, head, stream.read(), length)
        stream.seek(0)
        with warnings.catch_warnings(action="ignore"), Pillow.open(stream) as image:
            _check_strips(label, image, length)
            return image.size
    except (OSError, SyntaxError, ValueError, Pillow.DecompressionBombError) as error:
        raise SessionError(f"{label}: this is not a readable image. {_COPY_AGAIN}") from error


def _check_end(label: str, head: bytes, tail: bytes, length: int) -> None:
    cut = (
        length == 0
        or (head[:4] == b"\x89PNG" and b"IEND" not in tail[-64:])
        or (head[:2] == b"\xff\xd8" and b"\xff\xd9" not in tail)
        or (head[:2] == b"BM" and int.from_bytes(head[2:6], "little") > length)
    )
    if cut:
        raise SessionError(f"{label}: the file is cut off ({length} bytes). {_COPY_AGAIN}")


def _check_strips(label: str, image: Pillow.Image, length: int) -> None:
    """A TIFF says where its strips or tiles end."""
    tags = getattr(image, "tag_v2", {})
    for offsets, counts in ((273, 279), (324, 325)):
        ends = [offset + count for offset, count in zip(tags.get(offsets, ()), tags.get(counts, ()), strict=False)]
        if ends and max(ends) > length:
            raise SessionError(f"{label}: the file is cut off ({length} bytes). {_COPY_AGAIN}")


def decode_image(data: bytes, label: str) -> Image:
    """The image that the content of a file is, as it was stored; an alpha channel is dropped.

    Parameters
    ----------
    data : the file
    label : its name for messages, with the suffix

    Returns
    -------
    (h, w) or (h, w, 3) red, green, blue; uint8 or uint16

    Raises
    ------
    SessionError
        If it is cut off, damaged, or no image; the message names the file and what to do.
    """
    width, height = image_size(BufferedReader(BytesIO(data)), label)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None or image.shape[:2] != (height, width):
        raise SessionError(f"{label}: the image is damaged. {_COPY_AGAIN}")
    if image.dtype not in (np.uint8, np.uint16):
        raise SessionError(f"{label}: expected 8 or 16 bit values, found {image.dtype}. Save it with 8 or 16 bit.")
    if image.ndim == 2:
        return image
    if image.shape[2] == 1:
        return np.ascontiguousarray(image[:, :, 0])
    return np.ascontiguousarray(image[:, :, 2::-1])


def encode_png(image: Image) -> bytes:
    """The PNG file of an image: the same pixels come out of it."""
    done, data = cv2.imencode(".png", image if image.ndim == 2 else image[:, :, ::-1])
    assert done
    return data.tobytes()


def read_image(path: Path) -> Image:
    """Read an image file, as :func:`decode_image` does.

    Raises
    ------
    SessionError
        If the file is missing, cut off, or no image; the message names the file and what to do.
    """
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise missing_image(str(path)) from error
    except OSError as error:
        raise SessionError(f"{path}: the image cannot be read ({error.strerror}).") from error
    return decode_image(data, str(path))


def missing_image(label: str) -> SessionError:
    """What is said of an image that is not there."""
    return SessionError(f"{label}: the image is missing. Put it back or remove its row from frames.csv.")


def to_grey(image: Image) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]:
    """Grey values of a colour image (Rec. 601 weights), same depth; a grey image as it is."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))


def small_picture(image: Image, width: int) -> tuple[UInt8[np.ndarray, "rows columns 3"], float]:
    """An image as 8-bit colour, no wider than ``width``, brightened so that its brightest parts can be seen.

    Returns
    -------
    picture : (h, w, 3)   red, green, blue
    scale : float   picture pixels per image pixel
    """
    scale = min(1.0, width / image.shape[1])
    if scale < 1.0:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA))
    colour = image if image.ndim == 3 else np.repeat(image[:, :, None], 3, axis=2)
    top = max(float(np.quantile(colour, 0.999)), 1.0)
    return np.clip(colour * (255.0 / top), 0, 255).astype(np.uint8), scale
