"""Where the image of a frame is, and what is in it."""

from dataclasses import dataclass
from pathlib import Path

from rotaline.vision.images import Image, read_image


@dataclass(frozen=True)
class ImageFile:
    """An image file of a session folder."""

    path: str


ImageSource = ImageFile
"""Small and picklable: a task names its images by these, wherever it runs."""


def read_source(source: ImageSource) -> Image:
    """The image, as it was stored.

    Raises
    ------
    SessionError
        If it is missing, damaged or no image; the message says what to do.
    """
    return read_image(Path(source.path))


def source_state(source: ImageSource) -> tuple[str, int, int]:
    """Name, size in bytes and time of change: another state makes stored results void."""
    path = Path(source.path)
    state = path.stat()
    return path.name, state.st_size, state.st_mtime_ns
