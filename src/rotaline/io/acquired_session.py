"""A session that grows while a rig takes it: nothing that was taken is lost, and nothing is listed before it is complete.

An image is written beside its place, forced to disk and renamed; only then its row is appended to ``frames.csv``, and forced to disk as
well. So whatever ends the program, each row names a complete image, and what is missing is taken again by the next start. Rows never
change; what is removed is what an interruption has left at the end of a table: half a line, or the first frames of a pose that nobody
can hold once more. ``session.toml`` lists the captures that have frames. What the acquisition itself has to remember is in the folder
``acquisition``, which readers of sessions ignore.
"""

import csv
import errno
import io
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rotaline.errors import OutputError, SessionError
from rotaline.io.files import held_alone, whole_file
from rotaline.io.plan_differences import require_same_plan
from rotaline.io.session_access import FRAMES_FILE
from rotaline.io.session_file import SESSION_FILE
from rotaline.vision.images import image_size

COLUMNS = ("image", "angle_deg", "laser", "pose", "exposure_us", "gain", "time", "u_angle_deg", "number")
ACQUISITION = "acquisition"
REFERENCE = "reference"

_PLAN, _RIG, _EVENTS, _SETTINGS, _LOCK = "plan.toml", "rig.toml", "events.jsonl", "settings.json", "lock"
_UNFINISHED = ".part"


@dataclass(frozen=True)
class FrameRow:
    """A row of ``frames.csv``, as text; ``image`` is the file's name."""

    image: str
    angle_deg: float | None
    laser: bool
    pose: str = ""
    exposure_us: float | None = None
    gain: float | None = None
    time: str = ""
    u_angle_deg: float | None = None
    number: int | None = None

    def text(self) -> str:
        """The line, with its end."""
        stream = io.StringIO()
        csv.writer(stream, lineterminator="\n").writerow(
            [
                self.image,
                "" if self.angle_deg is None else f"{self.angle_deg:.6f}",
                "on" if self.laser else "off",
                self.pose,
                "" if self.exposure_us is None else f"{self.exposure_us:.10g}",
                "" if self.gain is None else f"{self.gain:.10g}",
                self.time,
                "" if self.u_angle_deg is None else f"{self.u_angle_deg:.6g}",
                "" if self.number is None else self.number,
            ]
        )
        return stream.getvalue()


@dataclass(frozen=True)
class Found:
    """What an earlier start has left, by folder.

    Attributes
    ----------
    rows : of frames whose images are whole
    listed : names of all images that the table lists, in its order; some may be gone
    repaired : what had to be repaired, in words
    """

    rows: Mapping[str, tuple[Mapping[str, str], ...]]
    listed: Mapping[str, tuple[str, ...]]
    repaired: tuple[str, ...]


class AcquiredSession:
    """A session folder that frames are added to. A context: it holds the folder against a second program.

    Parameters
    ----------
    path : the session folder; made if it is not there
    plan_text, rig_text : kept beside the frames; an unfinished session goes on only with the plan that it was begun with, comments aside

    Attributes
    ----------
    same_rig : whether the file of the devices is the one that the session was begun with

    Raises
    ------
    SessionError
        If the folder is no session that an acquisition began, or belongs to another plan.
    OutputError
        If the folder cannot be written, or another program holds it.
    """

    def __init__(self, path: Path, plan_text: str, rig_text: str) -> None:
        self.path = path
        self._own = path / ACQUISITION
        with _in_words(path):
            if path.exists() and not _may_go_on(path):
                raise SessionError(
                    f"{path}: exists already, and is no session that an acquisition began. Choose another place for the session."
                )
            self._own.mkdir(parents=True, exist_ok=True)
            self._lock = (self._own / _LOCK).open("a")
        self._is_held = False
        try:
            self._is_held = held_alone(self._lock)
            if not self._is_held:
                raise OutputError(
                    f"{path}: another `rotaline acquire` writes this session. Wait until it has ended, or choose another place."
                )
            with _in_words(path):
                self.same_rig = self._begin(plan_text, rig_text)
        except BaseException:
            self.close()
            raise

    def _begin(self, plan_text: str, rig_text: str) -> bool:
        plan, rig = self._own / _PLAN, self._own / _RIG
        for file in (self.path / SESSION_FILE, plan, rig, self._own / _SETTINGS):
            for left_over in file.parent.glob(f".{file.stem}-*{file.suffix}"):  # it was to take the place of the file
                left_over.unlink()
        if not plan.exists():
            for path, text in ((rig, rig_text), (plan, plan_text)):
                with whole_file(path) as temporary:
                    temporary.write_bytes(text.encode())
            for folder in (self._own, self.path, self.path.parent):
                _sync_folder(folder)
        if plan.read_bytes() != plan_text.encode():
            require_same_plan(self.path, plan, plan_text)
        events = self._own / _EVENTS
        if events.exists():
            _cut_to_lines(events)
        return rig.read_bytes() == rig_text.encode()

    def __enter__(self) -> "AcquiredSession":
        """The session itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Let the folder go."""
        self.close()

    def close(self) -> None:
        """Let the folder go, and remove it if nothing was put into it; may be called twice."""
        if self._is_held and not self._lock.closed:
            with suppress(OSError):  # not empty: it stays
                if {file.name for file in self._own.iterdir()} <= {_PLAN, _RIG, _LOCK} and [*self.path.iterdir()] == [
                    self._own
                ]:
                    shutil.rmtree(self._own)
                    self.path.rmdir()
        self._lock.close()

    def found(self, folders: list[str]) -> Found:
        """What is complete, after repairing what an interruption has left.

        Raises
        ------
        SessionError
            If a table is not as this program writes it.
        OutputError
            If something cannot be repaired.
        """
        rows: dict[str, tuple[Mapping[str, str], ...]] = {}
        listed: dict[str, tuple[str, ...]] = {}
        repaired: list[str] = []
        for folder in folders:
            with _in_words(self.path / folder):
                for left_over in sorted((self.path / folder).glob(f"*{_UNFINISHED}")):
                    left_over.unlink()
                    name = left_over.name.removesuffix(_UNFINISHED)
                    repaired.append(f"{folder}/{name}: it was half written; the frame is taken again.")
                table = self._table(folder, repaired)
                rows[folder] = tuple(row for row in table if self._whole(folder, row["image"], repaired))
                listed[folder] = tuple(row["image"] for row in table)
        return Found(rows, listed, tuple(repaired))

    def _table(self, folder: str, repaired: list[str]) -> list[dict[str, str]]:
        path = self.path / folder / FRAMES_FILE
        if not path.exists():
            return []
        if _cut_to_lines(path):
            repaired.append(f"{folder}/{FRAMES_FILE}: the last line was half written; its frame is taken again.")
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        if not lines:
            path.unlink()
            return []
        if lines[0] != ",".join(COLUMNS):
            raise SessionError(
                f"{path}, line 1: found {lines[0]!r}, expected {','.join(COLUMNS)!r}. The table was changed since; acquire into "
                "another folder."
            )
        table = []
        for number, fields in enumerate(csv.reader(lines[1:]), start=2):
            row = dict(zip(COLUMNS, fields, strict=False))
            if len(fields) != len(COLUMNS) or not row["image"] or Path(row["image"]).name != row["image"]:
                raise SessionError(
                    f"{path}, line {number}: found {lines[number - 1]!r}, expected a row of {len(COLUMNS)} fields with the name of an image. "
                    "The table was changed since; acquire into another folder."
                )
            table.append(row)
        return table

    def _whole(self, folder: str, image: str, repaired: list[str]) -> bool:
        label = f"{folder}/{image}"
        try:
            with (self.path / folder / image).open("rb") as stream:
                image_size(stream, label)
        except FileNotFoundError:
            repaired.append(f"{label}: it is listed, but the image is gone; it is taken again.")
        except SessionError:
            repaired.append(f"{label}: it is listed, but the image is damaged; it is taken again.")
        else:
            return True
        return False

    def take_back(self, folder: str, n_rows: int) -> None:
        """Remove the last rows of a table, and then their images: of a pose that was not finished and cannot be held once more."""
        path = self.path / folder / FRAMES_FILE
        with _in_words(path):
            lines = path.read_bytes().splitlines(keepends=True)
            with path.open("r+b") as stream:
                stream.truncate(sum(len(line) for line in lines[:-n_rows]))
                os.fsync(stream.fileno())
            for fields in csv.reader(line.decode() for line in lines[-n_rows:]):
                (path.parent / fields[0]).unlink(missing_ok=True)

    def add(self, folder: str, row: FrameRow, encoded: bytes) -> None:
        """Add a frame: the image first, on disk, then its row.

        Raises
        ------
        OutputError
            If one of them cannot be written; then the frame is not listed.
        """
        image = self.path / folder / row.image
        part = image.with_name(image.name + _UNFINISHED)
        try:
            self._add(image, part, row, encoded)
        except OSError as error:
            with suppress(OSError):  # the next start removes it
                part.unlink(missing_ok=True)
            raise _not_written(image, error) from error

    @staticmethod
    def _add(image: Path, part: Path, row: FrameRow, encoded: bytes) -> None:
        folder = image.parent
        if not folder.is_dir():
            folder.mkdir(parents=True)
            _sync_folder(folder.parent)
        _write(part, encoded, os.O_TRUNC)
        part.replace(image)
        _sync_folder(folder)
        table = folder / FRAMES_FILE
        new = not table.exists()
        _write(table, ((",".join(COLUMNS) + "\n" if new else "") + row.text()).encode(), os.O_APPEND)
        if new:
            _sync_folder(folder)

    def write_session_file(self, text: str) -> None:
        """Replace ``session.toml``."""
        self._replace(self.path / SESSION_FILE, text)

    def remember(self, name: str, value: Any) -> None:
        """Keep a value for the next start, e.g. the exposures of a capture."""
        self._replace(self._own / _SETTINGS, json.dumps(self.remembered() | {name: value}, indent=1) + "\n")

    def remembered(self) -> dict[str, Any]:
        """All that was kept."""
        path = self._own / _SETTINGS
        return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}

    def event(self, time: str, kind: str, text: str, **figures: Any) -> None:
        """Append to the record of what happened: retaken frames, exposures, interruptions."""
        line = json.dumps({"time": time, "kind": kind, "text": text, **figures}) + "\n"
        with _in_words(self._own / _EVENTS):
            _write(self._own / _EVENTS, line.encode(), os.O_APPEND)

    @staticmethod
    def _replace(path: Path, text: str) -> None:
        with _in_words(path):
            with whole_file(path) as temporary:
                temporary.write_bytes(text.encode())
            _sync_folder(path.parent)


def _may_go_on(path: Path) -> bool:
    """Whether a folder is empty, or one that an acquisition began; perhaps it got no further than its own folder."""
    return path.is_dir() and (
        (path / ACQUISITION / _PLAN).exists() or {p.name for p in path.iterdir()} <= {ACQUISITION}
    )


def _write(path: Path, data: bytes, how: int) -> None:
    """Write, or append, and force it to disk; what was appended by halves is cut off again."""
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | how | getattr(os, "O_BINARY", 0), 0o666)
    try:
        before = os.fstat(handle).st_size
        try:
            rest = memoryview(data)
            while rest:
                rest = rest[os.write(handle, rest) :]
            os.fsync(handle)
        except OSError:
            os.ftruncate(handle, before)
            raise
    finally:
        os.close(handle)


def _sync_folder(path: Path) -> None:
    """Force the names in a folder to disk, where the system can."""
    if os.name != "posix":
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno != errno.EINVAL:  # a network folder that cannot
            raise
    finally:
        os.close(handle)


def _cut_to_lines(path: Path) -> bool:
    """Cut off what stands behind the last whole line; a crash may leave zeros there. Whether there was something."""
    data = path.read_bytes()
    whole = data[: data.find(b"\0")] if b"\0" in data else data
    n = whole.rfind(b"\n") + 1
    if n == len(data):
        return False
    with path.open("r+b") as stream:
        stream.truncate(n)
        os.fsync(stream.fileno())
    return True


def _not_written(path: Path, error: OSError) -> OutputError:
    return OutputError(
        f"{path}: cannot be written ({error.strerror or error}). All frames that are listed are kept. Free some space, change the "
        "permissions, or see whether the disk is there; then start the same command again: it goes on with the first missing frame."
    )


@contextmanager
def _in_words(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise _not_written(Path(error.filename) if isinstance(error.filename, str) else path, error) from error
    except OutputError as error:
        if isinstance(error.__cause__, OSError):  # its advice is for commands with --out
            raise _not_written(path, error.__cause__) from error.__cause__
        raise
