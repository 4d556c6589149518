"""Sessions as one container and back: the same pixels, the same texts, written whole or not at all."""

import csv
import io
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count
from pathlib import Path, PurePath
from uuid import uuid4

from rotaline.errors import OutputError, SessionError
from rotaline.io.acquired_session import REFERENCE
from rotaline.io.files import make_folder, output_error
from rotaline.io.frame_images import read_source
from rotaline.io.locations import PACKED_SUFFIX, locate
from rotaline.io.packed import METADATA_FILE, encode_image
from rotaline.io.packed_writer import PackedWriter
from rotaline.io.session import Frame, Session, read_session
from rotaline.io.session_access import FRAMES_FILE, PackedFiles, SessionFiles, open_session_files
from rotaline.io.session_file import SESSION_FILE
from rotaline.pipeline.frames import work_side_by_side
from rotaline.pipeline.observer import Observer
from rotaline.vision.images import encode_png


@dataclass(frozen=True)
class PackResult:
    """What was written, and how many images were left out because they cannot be read, or (unpacked) got another name."""

    folder: Path
    n_images: int
    n_bytes: int
    n_left_out: int
    n_renamed: int = 0


def pack_session(
    session: str | os.PathLike[str], out: Path | None, observer: Observer, force: bool = False
) -> PackResult:
    """Write the frames of a session into one container.

    Parameters
    ----------
    session : a folder or the address of one
    out : where; default: ``<session>.rotaline.zarr`` beside the session, in this folder for one at an address
    force : a packed session that stands there is replaced

    Raises
    ------
    SessionError
        If the session cannot be read, or the container would lie inside it.
    OutputError
        If something stands there, or it cannot be written; then nothing has changed.
    """
    content, files = read_session(session), open_session_files(session)
    if isinstance(files, PackedFiles):
        raise SessionError(f"{files.label}: this session is packed already. Expected a folder of images.")
    target = _target(session, out, PACKED_SUFFIX)
    for problem in content.problems:
        observer.warning(str(problem))
    n_images = n_left_out = 0
    with _whole_folder(target, METADATA_FILE, force) as folder:
        observer.stage(f"Packing into {target}", stored=False)
        with PackedWriter(folder, files.session_file().decode()) as writer:
            for name, frames in _frames_by_folder(content).items():
                table = files.frames_file(name).decode()
                writer.open_capture(name, table)
                left_out = _unreadable(files, name, table, frames)
                for frame, packed in zip(frames, work_side_by_side(_pack, frames, observer, name), strict=True):
                    image = PurePath(frame.name).name
                    if isinstance(packed, str):
                        observer.warning(f"{packed} The frame is left out.")
                        left_out[image] = _reason(packed, image)
                    else:
                        writer.append(name, image, packed.shape, packed.bits, packed.data)
                        n_images += 1
                for image, why in left_out.items():
                    writer.leave_out(name, image, why)
                writer.close_capture(name)
                n_left_out += len(left_out)
            writer.finish()
        n_bytes = _size(folder)
    return PackResult(target, n_images, n_bytes, n_left_out)


def unpack_session(
    packed: str | os.PathLike[str], out: Path | None, observer: Observer, force: bool = False
) -> PackResult:
    """Write a packed session as a folder of PNG images; images that were of another kind get the suffix ``.png``.

    Parameters
    ----------
    packed : a packed session or the address of one
    out : where; default: the name without ``.rotaline.zarr``, beside the packed session
    force : a session that stands there is replaced

    Raises
    ------
    SessionError
        If the session cannot be read.
    OutputError
        If something stands there, or it cannot be written; then nothing has changed.
    """
    content, files = read_session(packed), open_session_files(packed)
    if not isinstance(files, PackedFiles):
        raise SessionError(f"{files.label}: this is a folder of images already. Expected a packed session.")
    target = _target(packed, out, "")
    for problem in content.problems:
        observer.warning(str(problem))
    n_images = n_left_out = n_renamed = 0
    with _whole_folder(target, SESSION_FILE, force) as folder:
        observer.stage(f"Unpacking into {target}", stored=False)
        for name, frames in _frames_by_folder(content).items():
            (folder / name).mkdir(parents=True, exist_ok=True)
            names = _png_names([PurePath(frame.name).name for frame in frames])
            for new, data in zip(names.values(), work_side_by_side(_png, frames, observer, name), strict=True):
                (folder / name / new).write_bytes(data)
            renamed = {old: new for old, new in names.items() if old != new}
            table = files.frames_file(name)
            (folder / name / FRAMES_FILE).write_bytes(_with_names(table.decode(), renamed) if renamed else table)
            n_images += len(frames)
            n_left_out += len(set(_image_names(table.decode())) - set(names))
            n_renamed += len(renamed)
        (folder / SESSION_FILE).write_bytes(files.session_file())
        n_bytes = _size(folder)
    return PackResult(target, n_images, n_bytes, n_left_out, n_renamed)


@dataclass(frozen=True)
class _Packed:
    shape: tuple[int, ...]
    bits: int
    data: bytes


def _pack(frame: Frame) -> _Packed | str:
    """The compressed image, or why there is none."""
    try:
        image = read_source(frame.source)
    except SessionError as error:
        return str(error)
    return _Packed(image.shape, 8 * image.itemsize, encode_image(image))


def _png(frame: Frame) -> bytes:
    return encode_png(read_source(frame.source))


def _reason(message: str, image: str) -> str:
    """A message without the place that it begins with."""
    return message.partition(f"{image}: ")[2] or message


def _frames_by_folder(session: Session) -> dict[str, tuple[Frame, ...]]:
    """The frames of each folder, each image once; also of the folder of reference frames."""
    folders = {c.folder: c.frames for c in session.captures}
    if session.references:
        folders[REFERENCE] = session.references
    return {folder: tuple({f.name: f for f in frames}.values()) for folder, frames in folders.items()}


def _unreadable(files: SessionFiles, folder: str, table: str, frames: Sequence[Frame]) -> dict[str, str]:
    """Images that the table names and the session lacks, with the reason."""
    result = {}
    for image in set(_image_names(table)) - {PurePath(frame.name).name for frame in frames}:
        try:
            files.image(folder, image)
        except SessionError as error:
            result[image] = _reason(str(error), image)
    return result


def _table(text: str) -> tuple[list[list[str]], int]:
    """The rows of a ``frames.csv``, the first of them its header, and the column of the images."""
    rows = [row for row in csv.reader(text.removeprefix("\ufeff").splitlines(), skipinitialspace=True) if row]
    return rows, [cell.strip() for cell in rows[0]].index("image")


def _image_names(text: str) -> list[str]:
    rows, column = _table(text)
    return [row[column].strip() for row in rows[1:]]


def _png_names(images: Sequence[str]) -> dict[str, str]:
    """A name with the suffix ``.png`` for each image, different from each other."""
    names: dict[str, str] = {}
    taken = set(images)
    for image in images:
        new = image
        if PurePath(image).suffix.lower() != ".png":
            new = str(PurePath(image).with_suffix(".png"))
            for n in count(1):
                if new not in taken:
                    break
                new = f"{PurePath(image).stem}-{n}.png"
        taken.add(new)
        names[image] = new
    return names


def _with_names(text: str, renamed: dict[str, str]) -> bytes:
    """A ``frames.csv`` with other names of images."""
    rows, column = _table(text)
    for row in rows[1:]:
        row[column] = renamed.get(row[column].strip(), row[column])
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows(rows)
    return stream.getvalue().encode()


def _target(session: str | os.PathLike[str], out: Path | None, suffix: str) -> Path:
    location = locate(session)
    path = Path(location.address) if location.is_local else None
    target = (out or (path.parent if path else Path()) / f"{location.name}{suffix}").resolve()
    if path is not None and (target == path or path in target.parents):
        raise SessionError(f"{target}: nothing is written into a session ({path}). Choose another place.")
    return target


@contextmanager
def _whole_folder(target: Path, mark: str, force: bool) -> Iterator[Path]:
    """A folder beside ``target`` that takes its place when the block ends without an error; it is removed otherwise."""
    exists = os.path.lexists(target)
    if exists and not force:
        raise OutputError(f"{target}: there is something already. Choose another place, or replace it with --force.")
    if exists and not (target / mark).is_file():
        raise OutputError(
            f"{target}: --force replaces a session of the same kind only, and there is no {mark} in this. Choose another place."
        )
    make_folder(target.parent)
    temporary = target.with_name(f".{target.name}-{uuid4().hex[:8]}")
    try:
        temporary.mkdir()
        yield temporary
        if exists:
            old = temporary.with_name(f"{temporary.name}-old")
            target.replace(old)
            temporary.replace(target)
            shutil.rmtree(old)
        else:
            temporary.replace(target)
    except OSError as error:
        raise output_error(target, error) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
