"""Writing a packed session, image by image: what is in memory is one compressed image and the lengths of those before it."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from rotaline import __version__
from rotaline.errors import SessionError
from rotaline.io.packed import (
    ATTRIBUTE,
    METADATA_FILE,
    SHARD,
    VERSION,
    PackedArray,
    PackedCapture,
    PackedContent,
    compressor,
    shard_file,
)

_NO_IMAGE = 2**64 - 1
"""Place and length, in the index of a file, of an image that is not there."""


class PackedWriter:
    """Writes a packed session into an empty folder; :meth:`finish` makes it complete. Its files are closed at the end of its context."""

    def __init__(self, folder: Path, session_toml: str) -> None:
        self._folder = folder
        self._session_toml = session_toml
        self._captures: dict[str, _Capture] = {}
        self._digest = hashlib.sha256()

    def __enter__(self) -> "PackedWriter":
        return self

    def __exit__(self, *_: object) -> None:
        for capture in self._captures.values():
            for array in capture.arrays.values():
                array.abandon()

    def open_capture(self, folder: str, frames_csv: str) -> None:
        """Begin the capture that the next images belong to.

        Raises
        ------
        SessionError
            If the folder is not inside the session.
        """
        if any(part in ("", ".", "..") for part in folder.split("/")):
            raise SessionError(
                f"session.toml, capture '{folder}': it lies outside the session; a packed session holds what is inside. "
                "Move the folder into the session."
            )
        self._captures[folder] = _Capture(frames_csv)

    def append(self, folder: str, name: str, shape: Sequence[int], bits: int, data: bytes) -> None:
        """Add an image, compressed by :func:`rotaline.io.packed.encode_image`."""
        self._digest.update(data[-4:] + name.encode())
        path = f"{folder}/{'x'.join(map(str, shape))}-uint{bits}"
        arrays = self._captures[folder].arrays
        if path not in arrays:
            arrays[path] = _Array(self._folder, path, tuple(shape), bits)
        arrays[path].append(name, data)

    def leave_out(self, folder: str, name: str, why: str) -> None:
        """An image that cannot be read."""
        self._captures[folder].left_out[name] = why

    def close_capture(self, folder: str) -> None:
        """Its images are all there."""
        for array in self._captures[folder].arrays.values():
            array.close()

    def finish(self) -> None:
        """Write what the container says of itself, last of all."""
        captures = {
            folder: PackedCapture(
                frames_csv=capture.frames_csv,
                arrays=tuple(array.content() for array in capture.arrays.values()),
                left_out=capture.left_out,
            )
            for folder, capture in self._captures.items()
        }
        content = PackedContent(
            version=VERSION, session_toml=self._session_toml, captures=captures, digest=self._digest.hexdigest()
        )
        nodes: dict[str, dict[str, Any]] = {}
        for folder, capture in self._captures.items():
            parts = folder.split("/")
            nodes |= {"/".join(parts[: i + 1]): _group({}) for i in range(len(parts))}
            nodes |= {path: _array(array.content()) for path, array in capture.arrays.items()}
        for path, node in nodes.items():
            (self._folder / path).mkdir(parents=True, exist_ok=True)
            (self._folder / path / METADATA_FILE).write_text(json.dumps(node), encoding="utf-8")
        attributes = {ATTRIBUTE: content.model_dump(mode="json") | {"written_by": f"rotaline {__version__}"}}
        consolidated = {"kind": "inline", "must_understand": False, "metadata": nodes}
        root = _group(attributes) | {"consolidated_metadata": consolidated}
        (self._folder / METADATA_FILE).write_text(json.dumps(root), encoding="utf-8")


class _Capture:
    def __init__(self, frames_csv: str) -> None:
        self.frames_csv = frames_csv
        self.arrays: dict[str, _Array] = {}
        self.left_out: dict[str, str] = {}


class _Array:
    """Files of ``SHARD`` images, each with an index at its end (zarr's codec ``sharding_indexed``)."""

    def __init__(self, folder: Path, path: str, shape: tuple[int, ...], bits: int) -> None:
        self._folder = folder
        self._path = path
        self._shape = shape
        self._bits = bits
        self._images: list[str] = []
        self._lengths: list[int] = []
        self._stream: BinaryIO | None = None

    def append(self, name: str, data: bytes) -> None:
        if self._stream is None:
            file = self._folder / shard_file(self._path, len(self._images) // SHARD, self._shape)
            file.parent.mkdir(parents=True, exist_ok=True)
            self._stream = file.open("xb")
        self._stream.write(data)
        self._images.append(name)
        self._lengths.append(len(data))
        if len(self._images) % SHARD == 0:
            self.close()

    def close(self) -> None:
        """Write the index of the file that is open."""
        if self._stream is None:
            return
        import google_crc32c

        n = (len(self._images) - 1) % SHARD + 1
        lengths = self._lengths[-n:]
        index = np.full((SHARD, 2), _NO_IMAGE, dtype="<u8")
        index[:n, 0] = np.cumsum([0, *lengths[:-1]])
        index[:n, 1] = lengths
        data = index.tobytes()
        with self._stream as stream:
            stream.write(data + int(google_crc32c.value(data)).to_bytes(4, "little"))
        self._stream = None

    def abandon(self) -> None:
        """Close the file that is open as it is."""
        if self._stream is not None:
            self._stream.close()

    def content(self) -> PackedArray:
        return PackedArray(
            path=self._path,
            shape=self._shape,
            bits=8 if self._bits == 8 else 16,
            images=tuple(self._images),
            lengths=tuple(self._lengths),
        )


def _group(attributes: dict[str, Any]) -> dict[str, Any]:
    return {"zarr_format": 3, "node_type": "group", "attributes": attributes}


def _array(array: PackedArray) -> dict[str, Any]:
    checksum = {"name": "crc32c"}
    little = {"name": "bytes", "configuration": {"endian": "little"}}
    blosc = {"name": "blosc", "configuration": compressor(array.shape, array.bits)}
    shards = {
        "chunk_shape": [1, *array.shape],
        "codecs": [little, blosc, checksum],
        "index_codecs": [little, checksum],
        "index_location": "end",
    }
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": [len(array.images), *array.shape],
        "data_type": f"uint{array.bits}",
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [SHARD, *array.shape]}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": 0,
        "codecs": [{"name": "sharding_indexed", "configuration": shards}],
        "attributes": {},
        "storage_transformers": [],
    }
