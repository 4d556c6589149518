"""Where the image of a frame is, and what is in it."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from rotaline.errors import SessionError
from rotaline.io.locations import Location
from rotaline.io.packed import PackedImage, read_packed
from rotaline.vision.images import Image, decode_image, missing_image, read_image


@dataclass(frozen=True)
class ImageFile:
    """An image file of a session folder."""

    path: str


@dataclass(frozen=True)
class RemoteImage:
    """An image file of a session folder at an address; ``size`` in bytes and ``changed`` are what its folder said when the session was read."""

    address: str
    name: str
    size: int
    changed: int


ImageSource = ImageFile | RemoteImage | PackedImage
"""Small and picklable: a task names its images by these, wherever it runs."""


def read_source(source: ImageSource) -> Image:
    """The image, as it was stored.

    Raises
    ------
    SessionError
        If it is missing, damaged or no image; the message says what to do.
    """
    match source:
        case ImageFile(path):
            return read_image(Path(path))
        case RemoteImage(address, name):
            return _read_remote(address, name)
        case PackedImage():
            return next(read_packed((source,)))


def read_sources(sources: Iterable[ImageSource]) -> Iterator[Image]:
    """The images, in order and one after the other; those of a packed session that follow one another are read at once.

    Raises
    ------
    SessionError
        As :func:`read_source` does, when its turn comes.
    """
    packed: list[PackedImage] = []
    for source in sources:
        if isinstance(source, PackedImage):
            packed.append(source)
            continue
        yield from read_packed(packed)
        packed = []
        yield read_source(source)
    yield from read_packed(packed)


def source_state(source: ImageSource) -> tuple[str, int, int]:
    """Name, size in bytes and time of change (or a number that changes with the content): another state makes stored results void."""
    match source:
        case ImageFile(path):
            state = Path(path).stat()
            return Path(path).name, state.st_size, state.st_mtime_ns
        case RemoteImage(_, name, size, changed):
            return Path(name).name, size, changed
        case PackedImage():
            return Path(source.name).name, source.length, int(source.digest[:15], 16)


def _read_remote(address: str, name: str) -> Image:
    label = f"{address.rstrip('/')}/{name}"
    try:
        data = Location(address).read(name)
    except FileNotFoundError as error:
        raise missing_image(label) from error
    except OSError as error:
        raise SessionError(f"{label}: the image cannot be read ({error}).") from error
    return decode_image(data, label)
