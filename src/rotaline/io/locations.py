"""Where sessions are: a folder on this machine, or an address that fsspec opens (``s3://bucket/session``, ``zip::session.zip``).

What is read from either is the same; files on this machine are read without fsspec. Nothing is ever written here.
"""

import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from io import BufferedReader
from pathlib import Path
from typing import Any

from rotaline.errors import SessionError

PACKED_SUFFIX = ".rotaline.zarr"
_ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*(://|::)")
_ON_THIS_MACHINE = re.compile(r"^(file|local)://")
_BLOCK = 1 << 16
"""Bytes that are fetched at once where only the header of a file is wanted."""


@dataclass(frozen=True)
class Location:
    """A folder: its absolute path on this machine, or its address."""

    address: str

    @property
    def is_local(self) -> bool:
        """It is on this machine."""
        return _ADDRESS.match(self.address) is None

    @property
    def name(self) -> str:
        """The name of the session there: the last part of the address, without what only says how it is stored.

        Examples
        --------
        >>> [Location(a).name for a in ("/data/rod", "s3://bucket/rod.rotaline.zarr/", "zip::file:///data/rod.zip")]
        ['rod', 'rod', 'rod']
        """
        *around, innermost = self.address.split("::")
        for part in (*(a for a in around if "://" in a), innermost):
            if name := Path(part.rpartition("://")[2]).name:
                return name.removesuffix(".zip").removesuffix(PACKED_SUFFIX)
        return "session"

    def kind(self) -> str:
        """What stands here: ``folder``, ``file``, or ``nothing``."""
        if self.is_local:
            path = Path(self.address)
            return "folder" if path.is_dir() else "file" if path.exists() else "nothing"
        with _explained(self.address):
            fs, root = _filesystem(self.address)
            return "folder" if fs.isdir(root) else "file" if fs.exists(root) else "nothing"

    def has_folder(self, name: str) -> bool:
        """There is a folder ``name`` in it."""
        if self.is_local:
            return os.path.isdir(f"{self.address}/{name}")
        with _explained(self.address):
            fs, root = _filesystem(self.address)
            return bool(fs.isdir(_join(root, name)))

    def is_empty(self) -> bool:
        """There is nothing in the folder."""
        if self.is_local:
            return not os.listdir(self.address)
        with _explained(self.address):
            fs, root = _filesystem(self.address)
            return not fs.ls(root, detail=False)

    def files(self, folder: str) -> dict[str, "FileState"]:
        """The files of a folder in it, by name, with one request."""
        if self.is_local:
            with os.scandir(f"{self.address}/{folder}") as entries:
                states = [(e.name, e.stat()) for e in entries if e.is_file()]
            return {name: FileState(state.st_size, state.st_mtime_ns) for name, state in states}
        with _explained(self.address):
            fs, root = _filesystem(self.address)
            found = fs.ls(_join(root, folder), detail=True)
            return {Path(e["name"]).name: _remote_state(e) for e in found if e["type"] == "file"}

    def read(self, name: str, start: int = 0, stop: int | None = None) -> bytes:
        """Bytes of a file in it.

        Raises
        ------
        OSError
            If a file on this machine is missing or cannot be read; FileNotFoundError also for one at an address.
        SessionError
            If the address cannot be opened; the message says what is missing.
        """
        if self.is_local:
            with open(f"{self.address}/{name}", "rb") as stream:
                stream.seek(start)
                return stream.read() if stop is None else stream.read(stop - start)
        with _explained(self.address):
            fs, root = _filesystem(self.address)
            return bytes(fs.cat_file(_join(root, name), start=start or None, end=stop))

    @contextmanager
    def open(self, name: str) -> Iterator[BufferedReader]:
        """A file in it, to look at parts of it; raises as :meth:`read` does."""
        if self.is_local:
            with open(f"{self.address}/{name}", "rb") as stream:
                yield stream
        else:
            with _explained(self.address):
                fs, root = _filesystem(self.address)
                with fs.open(_join(root, name), "rb", block_size=_BLOCK) as stream, BufferedReader(stream) as buffered:
                    yield buffered


@dataclass(frozen=True)
class FileState:
    """Size in bytes and time of change; where files have none, a number that changes with the file."""

    size: int
    changed: int


def locate(place: str | os.PathLike[str]) -> Location:
    """The location of a path or an address, as users write them."""
    text = os.fspath(place)
    if "::" not in text:
        text = _ON_THIS_MACHINE.sub("", text)
    return Location(text if _ADDRESS.match(text) else os.path.realpath(text))


def _join(root: str, name: str) -> str:
    return f"{root.rstrip('/')}/{name}" if root.rstrip("/") else name


def _remote_state(entry: dict[str, Any]) -> FileState:
    """All that is said of a remote file stands for its time of change: what there is (ETag, time, ...) is different everywhere."""
    digest = hashlib.sha256(repr(sorted((str(k), str(v)) for k, v in entry.items())).encode()).digest()
    return FileState(int(entry.get("size") or 0), int.from_bytes(digest[:7], "big"))


@lru_cache(maxsize=16)
def _filesystem(address: str) -> tuple[Any, str]:
    """What reads an address, and the path of its folder there."""
    from fsspec.core import url_to_fs

    try:
        fs, root = url_to_fs(address)
    except ImportError as error:
        raise SessionError(
            f"{address}: a package for such addresses is missing ({error}). Install it with pip, or copy the session to this machine."
        ) from error
    except ValueError as error:
        raise SessionError(
            f"{address}: such addresses are not known ({error}). Expected a folder, or an address like s3://bucket/session, "
            "gs://bucket/session, https://host/session.rotaline.zarr or zip::session.zip."
        ) from error
    return fs, root


@contextmanager
def _explained(address: str) -> Iterator[None]:
    """What goes wrong between here and there becomes a sentence; a file that is missing stays a FileNotFoundError."""
    try:
        yield
    except (FileNotFoundError, SessionError):
        raise
    except Exception as error:
        # drivers raise errors of their own; Python's own, but those of files and connections, are defects
        if type(error).__module__ == "builtins" and not isinstance(error, OSError):
            raise
        what = "no permission" if isinstance(error, PermissionError) else f"{type(error).__name__}: {error}"
        raise SessionError(
            f"{address}: cannot be read ({what}). Check the address, the connection and the credentials for it."
        ) from error
