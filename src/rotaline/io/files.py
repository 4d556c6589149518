"""Writing files whole or not at all."""

import errno
import json
import math
import os
import sys
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np

from rotaline.errors import OutputError, SessionError


def output_error(path: Path, error: OSError) -> OutputError:
    """The message for a file that could not be written."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return OutputError(
            f"{path}: no space left to write this file. What was finished before is kept; "
            "free some space (or choose another place with --out) and start the same command again."
        )
    return OutputError(
        f"{path}: cannot be written ({error.strerror or error}). Choose another place with --out, or change the permissions."
    )


def make_folder(path: Path) -> None:
    """Create a folder for results, with its parents.

    Raises
    ------
    OutputError
        If it cannot be created, or a file stands in its place.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise output_error(path, error) from error


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Write to a temporary file beside ``path``; it takes the place of ``path`` when the block ends without an error.

    Yields
    ------
    Path
        Where to write; same suffix as ``path``.

    Raises
    ------
    OutputError
        If the file cannot be written; then ``path`` is as it was.
    """
    make_folder(path.parent)
    temporary = path.with_name(f".{path.stem}-{uuid.uuid4().hex[:8]}{path.suffix}")
    try:
        temporary.touch(exist_ok=False)  # an interrupt at any moment from here on leaves nothing behind
        yield temporary
        with temporary.open("rb") as stream:
            os.fsync(stream.fileno())
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(path)
    except OSError as error:
        raise output_error(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def _umask() -> int:
    mask = os.umask(0o022)
    os.umask(mask)
    return mask


def held_alone(stream: IO[str]) -> bool:
    """Hold an open file against other programs until it is closed; False: another one holds it."""
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(stream.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def plain(value: Any) -> Any:
    """NumPy scalars and arrays as plain numbers and lists; NaN and infinities as None, which JSON can hold."""
    if isinstance(value, dict):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def write_json(path: Path, value: Any) -> None:
    """Write a value as indented JSON, whole or not at all."""
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(plain(value), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_json(path: Path, what: str) -> Any:
    """Read a JSON file; ``what`` names it in the message.

    Raises
    ------
    SessionError
        If the file is missing or no JSON, with the line.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SessionError(f"{path}: the {what} cannot be read ({error.strerror}).") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        line = f", line {error.lineno}" if isinstance(error, json.JSONDecodeError) else ""
        raise SessionError(f"{path}{line}: the {what} is not valid JSON ({error}). Write it again.") from error
