"""The packed session: all frames of a session in one lossless array container, a zarr 3 folder.

The group's ``zarr.json`` holds ``session.toml`` and each ``frames.csv`` as text, and where each image is, so that one request tells all of
a session. Each capture has an array for each size and depth of its images, in files ("shards") of ``SHARD`` images one after another;
each image is compressed on its own (blosc) and followed by a checksum (CRC-32C). Any zarr 3 library reads the arrays. Here an image is
read by its place in its file, without one: that takes a third of the time off, needs no cache and no state, and images that follow
one another are read at once.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rotaline.errors import SessionError
from rotaline.io.locations import Location
from rotaline.vision.images import Image

METADATA_FILE = "zarr.json"
ATTRIBUTE = "rotaline"
VERSION: Literal[1] = 1
SHARD = 64
"""Images in a file: with some 100 kB an image, a million of them are 16000 files of 6 MB."""
_CHECKSUM_BYTES = 4
_AT_ONCE = 8 << 20
"""Bytes that are read at once at the most."""
_GAP = 1 << 18
"""Bytes between two images that are rather read too than asked around."""
_COPY_AGAIN = "Copy the packed session again from where it was made, or pack the session again."


class PackedArray(BaseModel):
    """Images of one shape and depth: ``shape`` of each, (h, w) or (h, w, 3); their names and lengths in bytes, in their order in the files."""

    model_config = ConfigDict(frozen=True)
    path: str
    shape: Annotated[tuple[int, ...], Field(min_length=2, max_length=3)]
    bits: Literal[8, 16]
    images: tuple[str, ...]
    lengths: tuple[int, ...]


class PackedCapture(BaseModel):
    """A folder of the session; ``left_out`` says of images that were not packed why they could not be read."""

    model_config = ConfigDict(frozen=True)
    frames_csv: str
    arrays: tuple[PackedArray, ...]
    left_out: dict[str, str]


class PackedContent(BaseModel):
    """What ``zarr.json`` says: texts as they were, captures by folder; ``digest`` changes with any pixel."""

    model_config = ConfigDict(frozen=True)
    version: Literal[1]
    session_toml: str
    captures: dict[str, PackedCapture]
    digest: str


@dataclass(frozen=True)
class PackedImage:
    """An image of a packed session: ``length`` bytes from ``start`` of ``file``; small and picklable."""

    address: str
    file: str
    start: int
    length: int
    shape: tuple[int, ...]
    bits: int
    name: str
    digest: str

    @property
    def stop(self) -> int:
        """Where it ends in its file."""
        return self.start + self.length


def shard_file(path: str, number: int, shape: Sequence[int]) -> str:
    """The file of an array that holds the images ``number * SHARD`` and following."""
    return "/".join([path, "c", str(number), *["0"] * len(shape)])


def parse_packed(data: bytes, place: str) -> PackedContent:
    """What the ``zarr.json`` of a packed session says.

    Raises
    ------
    SessionError
        If it is not that of a packed session, or of a newer program.
    """
    try:
        found = json.loads(data)["attributes"][ATTRIBUTE]
        if found["version"] != VERSION:
            raise SessionError(
                f"{place}: packed sessions of version {found['version']} are not known here, only version {VERSION}. Update Rotaline."
            )
        return PackedContent.model_validate(found)
    except (ValueError, KeyError, TypeError, ValidationError) as error:
        raise SessionError(
            f"{place}: its {METADATA_FILE} is not that of a packed session, or is damaged. Expected a folder that `rotaline pack` wrote."
        ) from error


def packed_images(location: Location, content: PackedContent, folder: str) -> dict[str, PackedImage]:
    """The images of a capture's folder by name."""
    result: dict[str, PackedImage] = {}
    for array in content.captures[folder].arrays:
        start = 0
        for i, (name, length) in enumerate(zip(array.images, array.lengths, strict=True)):
            start = 0 if i % SHARD == 0 else start
            file = shard_file(array.path, i // SHARD, array.shape)
            result[name] = PackedImage(
                location.address, file, start, length, array.shape, array.bits, f"{folder}/{name}", content.digest
            )
            start += length
    return result


def read_packed(images: Sequence[PackedImage]) -> Iterator[Image]:
    """The images, in order, read from their file at once where they follow one another.

    Raises
    ------
    SessionError
        If a file of the container is missing, cut off or damaged.
    """
    breaks = [i for i, (a, b) in enumerate(pairwise(images), start=1) if not _follows(a, b)]
    for first, last in pairwise([0, *breaks, len(images)]):
        yield from _read_row(images[first:last])


def _follows(a: PackedImage, b: PackedImage) -> bool:
    return (a.address, a.file) == (b.address, b.file) and 0 <= b.start - a.stop <= _GAP


def _read_row(images: Sequence[PackedImage]) -> Iterator[Image]:
    while images:
        first = images[0]
        n = max(1, sum(image.stop - first.start <= _AT_ONCE for image in images))
        data = _read(first, images[n - 1].stop)
        for image in images[:n]:
            yield _decode(image, data[image.start - first.start : image.stop - first.start])
        images = images[n:]


def _read(image: PackedImage, stop: int) -> bytes:
    try:
        return Location(image.address).read(image.file, image.start, stop)
    except FileNotFoundError as error:
        raise SessionError(
            f"{image.address}, {image.name}: the file {image.file} of the packed session is missing. {_COPY_AGAIN}"
        ) from error
    except OSError as error:
        raise SessionError(f"{image.address}/{image.file}: the file cannot be read ({error.strerror}).") from error


def encode_image(image: Image) -> bytes:
    """The bytes of an image in a packed session."""
    import google_crc32c
    from numcodecs import blosc

    c = compressor(image.shape, 8 * image.itemsize)
    shuffle = {"noshuffle": blosc.NOSHUFFLE, "bitshuffle": blosc.BITSHUFFLE}[c["shuffle"]]
    data: bytes = blosc.compress(image, c["cname"].encode(), c["clevel"], shuffle, c["blocksize"], c["typesize"])
    return data + int(google_crc32c.value(data)).to_bytes(_CHECKSUM_BYTES, "little")


def _decode(image: PackedImage, data: bytes) -> Image:
    import google_crc32c
    from numcodecs import blosc

    body, checksum = data[:-_CHECKSUM_BYTES], int.from_bytes(data[-_CHECKSUM_BYTES:], "little")
    if len(data) != image.length or google_crc32c.value(body) != checksum:
        raise SessionError(
            f"{image.address}, {image.name}: the packed session is damaged or cut off (file {image.file}, byte {image.start}). {_COPY_AGAIN}"
        )
    pixels = np.empty(image.shape, np.uint8 if image.bits == 8 else np.uint16)
    blosc.decompress(body, pixels)
    return pixels


def compressor(shape: Sequence[int], bits: int) -> dict[str, Any]:
    """How images are compressed, as the zarr codec ``blosc`` has it; by measurement (docs/decisions/0013)."""
    shuffle = "noshuffle" if len(shape) == 3 and bits == 8 else "bitshuffle"
    return {"typesize": bits // 8, "cname": "zstd", "clevel": 5, "shuffle": shuffle, "blocksize": 0}
