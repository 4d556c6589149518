"""The session: what a rig has taken and what is known about the targets.

:func:`inspect_session` reads a folder or a packed session and lists everything that is wrong with it; :func:`read_session` raises on errors.
Angles are in rad from here on, lengths in mm. Nothing is ever written into a session.

A folder ``reference`` that is no capture holds frames by which an acquisition watches the drift of the rig; ``pose`` names the capture that
each belongs to.
"""

import csv
import math
import os
from collections import Counter
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import PurePath
from typing import Any

from rotaline.calibration.speckle_limit import LaserOptics
from rotaline.errors import SessionError
from rotaline.geometry.primitives import Artifact
from rotaline.io.acquired_session import REFERENCE
from rotaline.io.frame_images import ImageSource
from rotaline.io.locations import locate
from rotaline.io.session_access import FRAMES_FILE, SessionFiles, open_session_files
from rotaline.io.session_file import SESSION_FILE, MeasurementRequest, SessionFile, parse_session_file
from rotaline.vision.targets.model import Target

COLUMNS = ("image", "angle_deg", "laser", "pose")
ROLES = ("camera", "laser-plane", "axis", "artifact", "scan")


@dataclass(frozen=True)
class Problem:
    """Something wrong with a session: where, what was found, what was expected.

    ``fatal``: the session cannot be processed before it is mended; otherwise the element is left out.
    """

    where: str
    text: str
    fatal: bool = True

    def __str__(self) -> str:
        """One line for the user."""
        return f"{self.where}: {self.text}"


@dataclass(frozen=True)
class Frame:
    """One row of ``frames.csv``; what is empty or not stated is None.

    ``u_angle_rad`` is the standard uncertainty of the angle, ``time_s`` when the frame was taken, counted from 1970.
    """

    source: ImageSource
    name: str
    angle_rad: float | None
    laser_on: bool
    pose: str | None
    u_angle_rad: float | None = None
    time_s: float | None = None


@dataclass(frozen=True)
class Capture:
    """One folder of frames in one role; ``target`` is None for a scan of a part."""

    folder: str
    role: str
    target_name: str
    target: Target | Artifact | None
    frames: tuple[Frame, ...]

    @property
    def off_frames(self) -> tuple[Frame, ...]:
        """Frames with the laser off."""
        return tuple(f for f in self.frames if not f.laser_on)

    @property
    def on_frames(self) -> tuple[Frame, ...]:
        """Frames with the laser on."""
        return tuple(f for f in self.frames if f.laser_on)

    def background_of(self, frame: Frame) -> Frame | None:
        """The laser-off frame with the same angle or pose, if there is one."""
        for off in self.off_frames:
            same_pose = frame.pose is not None and off.pose == frame.pose
            same_angle = frame.angle_rad is not None and off.angle_rad is not None
            if same_pose or (same_angle and abs(frame.angle_rad - off.angle_rad) < 1e-9):  # type: ignore[operator]
                return off
        return None


@dataclass(frozen=True)
class Session:
    """A session as read; ``path`` as given: a folder, a packed session, or the address of one.

    ``image_size`` is (width, height) of all its frames; ``optics`` is None where they are not stated. ``references`` watch the drift; their
    ``pose`` is the folder of the capture that they belong to.
    """

    path: str | os.PathLike[str]
    targets: dict[str, Target | Artifact]
    captures: tuple[Capture, ...]
    measurements: tuple[MeasurementRequest, ...]
    image_size: tuple[int, int]
    problems: tuple[Problem, ...] = field(default=())
    optics: LaserOptics | None = None
    references: tuple[Frame, ...] = ()

    @property
    def name(self) -> str:
        """The name of its folder; a packed session has that of the folder that it was made from."""
        return locate(self.path).name

    def in_role(self, role: str) -> tuple[Capture, ...]:
        """The captures of one role, in the order of the file."""
        return tuple(c for c in self.captures if c.role == role)


def inspect_session(path: str | os.PathLike[str]) -> tuple[Session | None, tuple[Problem, ...]]:
    """Read a session and list all that is wrong with it.

    Parameters
    ----------
    path : a folder, a packed session, or the address of one, e.g. ``s3://bucket/session``

    Returns
    -------
    session : Session or None
        Without the elements that are left out; None if a problem is fatal
    problems : tuple of Problem
    """
    try:
        files = open_session_files(path)
    except SessionError as error:
        place = os.fspath(path)
        return None, (Problem(place, str(error).removeprefix(f"{place}: ")),)
    content, texts = parse_session_file(files.session_file(), f"{files.label}/{SESSION_FILE}")
    problems = [Problem(where, text, fatal) for where, text, fatal in texts]
    if content is None:
        return None, tuple(problems)
    captures, sizes = _read_captures(files, content, problems)
    if not problems or not any(p.fatal for p in problems):
        problems += _size_problems(sizes)
        problems += _role_problems(captures)
        problems += _measurement_problems(content, captures)
    if any(p.fatal for p in problems):
        return None, tuple(problems)
    size = Counter(sizes.values()).most_common(1)[0][0]
    measurements = tuple(m for m in content.measurements if m.capture in {c.folder for c in captures})
    references = _read_references(files, content, size, problems)
    found = tuple(problems)
    return Session(path, content.targets, tuple(captures), measurements, size, found, content.optics, references), found


def read_session(path: str | os.PathLike[str]) -> Session:
    """Read a session: a folder, a packed session, or the address of one.

    Raises
    ------
    SessionError
        With all fatal problems, one a line: file, line, field, found, expected.
    """
    session, problems = inspect_session(path)
    if session is None:
        raise SessionError("\n".join(str(p) for p in problems if p.fatal))
    return session


def _read_captures(
    files: SessionFiles, content: SessionFile, problems: list[Problem]
) -> tuple[list[Capture], dict[str, tuple[int, int]]]:
    captures: list[Capture] = []
    sizes: dict[str, tuple[int, int]] = {}
    folders: dict[str, tuple[Frame, ...]] = {}
    for request in content.captures:
        if request.folder not in folders:
            folders[request.folder] = _read_frames(files, request.folder, sizes, problems)
        target = content.targets.get(request.target) if request.target else None
        captures.append(Capture(request.folder, request.role, request.target or "", target, folders[request.folder]))
    return captures, sizes


def _read_references(
    files: SessionFiles, content: SessionFile, size: tuple[int, int], problems: list[Problem]
) -> tuple[Frame, ...]:
    """The frames that watch the drift; whatever is wrong with them, the session can be processed."""
    if any(c.folder == REFERENCE for c in content.captures) or not files.has_folder(REFERENCE):
        return ()
    try:
        files.frames_file(REFERENCE)
    except OSError:
        return ()  # a folder of that name that has nothing to do with this
    found: list[Problem] = []
    sizes: dict[str, tuple[int, int]] = {}
    frames = _read_frames(files, REFERENCE, sizes, found)
    fitting = tuple(f for f in frames if f.pose and sizes[f"{files.label}/{f.name}"] == size)
    if len(fitting) < len(frames):
        text = (
            f"{len(frames) - len(fitting)} frame(s) without the capture that they belong to in column pose, or not of {size[0]} x {size[1]} "
            "pixels: left out."
        )
        found.append(Problem(f"{files.label}/{REFERENCE}/{FRAMES_FILE}", text))
    problems += [replace(problem, fatal=False) for problem in found]
    return fitting


def _read_frames(
    files: SessionFiles, folder: str, sizes: dict[str, tuple[int, int]], problems: list[Problem]
) -> tuple[Frame, ...]:
    table = f"{files.label}/{folder}/{FRAMES_FILE}"
    if not files.has_folder(folder):
        text = f"there is no folder '{folder}' in the session. Copy it there, or remove the capture from session.toml."
        problems.append(Problem(f"session.toml, capture '{folder}'", text))
        return ()
    try:
        text = files.frames_file(folder).decode("utf-8-sig")
    except FileNotFoundError:
        problems.append(Problem(table, f"the file is missing. Expected a table with the header {','.join(COLUMNS)}."))
        return ()
    except (OSError, UnicodeDecodeError) as error:
        problems.append(Problem(table, f"the table cannot be read as UTF-8 text ({error})."))
        return ()
    reader = csv.DictReader(text.splitlines(), skipinitialspace=True)
    header = [name.strip() for name in reader.fieldnames or []]
    missing = [name for name in COLUMNS if name not in header]
    if missing:
        found = ",".join(header) or "nothing"
        problems.append(
            Problem(
                f"{table}, line 1",
                f"the header lacks {', '.join(missing)}; found {found}; expected {','.join(COLUMNS)}.",
            )
        )
        return ()
    reader.fieldnames = header
    frames: list[Frame] = []
    for row in reader:
        frame = _read_row(files, folder, row, f"{table}, line {reader.line_num}", sizes, problems)
        if frame is not None:
            frames.append(frame)
    if not frames and not any(f"{files.label}/{folder}" in p.where for p in problems):
        problems.append(Problem(table, "the table lists no frames. Expected one row a frame."))
    return tuple(frames)


def _read_row(
    files: SessionFiles,
    folder: str,
    row: dict[str, Any],
    where: str,
    sizes: dict[str, tuple[int, int]],
    problems: list[Problem],
) -> Frame | None:
    values = {name: (row.get(name) or "").strip() for name in COLUMNS}
    before = len(problems)
    image = values["image"]
    if not image or PurePath(image).name != image:
        problems.append(Problem(f"{where}, image", f"found '{image}', expected the name of a file beside frames.csv."))
    angle: float | None = None
    if values["angle_deg"]:
        try:
            angle = math.radians(float(values["angle_deg"]))
        except ValueError:
            angle = math.nan
        if not math.isfinite(angle):
            problems.append(
                Problem(
                    f"{where}, angle_deg",
                    f"found '{values['angle_deg']}', expected a finite number of degrees, or nothing.",
                )
            )
    if values["laser"] not in ("on", "off"):
        problems.append(Problem(f"{where}, laser", f"found '{values['laser']}', expected 'on' or 'off'."))
    if len(problems) > before:
        return None
    u_angle = _number_or_none(row.get("u_angle_deg"))
    if u_angle is not None and not (math.isfinite(u_angle) and u_angle >= 0.0):
        text = f"found '{row['u_angle_deg']}', expected a standard uncertainty in degrees, or nothing. It is not used."
        problems.append(Problem(f"{where}, u_angle_deg", text, fatal=False))
        u_angle = None
    path = f"{files.label}/{folder}/{image}"
    try:
        source, sizes[path] = files.image(folder, image)
    except SessionError as error:
        text = str(error).removeprefix(f"{path}: ")
        problems.append(Problem(f"{where}, {path}", f"{text} The frame is left out.", fatal=False))
        return None
    return Frame(
        source,
        f"{folder}/{image}",
        angle,
        values["laser"] == "on",
        values["pose"] or None,
        None if u_angle is None else math.radians(u_angle),
        _time_s(row.get("time")),
    )


def _number_or_none(text: str | None) -> float | None:
    """A number; NaN where it is none; None for nothing."""
    if not (text or "").strip():
        return None
    try:
        return float(text or "")
    except ValueError:
        return math.nan


def _time_s(text: str | None) -> float | None:
    """Seconds since 1970 of a moment as ``2026-01-31T12:00:00.000Z``, UTC unless it says otherwise; None for anything else."""
    try:
        moment = datetime.fromisoformat((text or "").strip())
    except ValueError:
        return None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def _size_problems(sizes: dict[str, tuple[int, int]]) -> list[Problem]:
    if not sizes:
        return [Problem("session", "no image can be read. Expected at least one capture with frames.")]
    counts = Counter(sizes.values())
    (usual, n_usual), *others = counts.most_common()
    problems = []
    for size, n in others:
        example = next(path for path, found in sizes.items() if found == size)
        problems.append(
            Problem(
                example,
                f"{n} image(s) of {size[0]} x {size[1]} pixels, but {n_usual} of {usual[0]} x {usual[1]}. All frames of a "
                "session must come from one camera at one resolution: put the others into a session of their own.",
            )
        )
    if min(usual) < 32:
        problems.append(
            Problem(
                "session",
                f"the images are {usual[0]} x {usual[1]} pixels; nothing can be measured in them (at least 32 x 32).",
            )
        )
    return problems


def _role_problems(captures: list[Capture]) -> list[Problem]:
    problems: list[Problem] = []
    if not captures:
        problems.append(
            Problem("session.toml", "there are no [[captures]]. Expected at least one with folder and role.")
        )
    for capture in captures:
        where = f"capture '{capture.folder}' ({capture.role})"
        if not capture.frames:
            problems.append(Problem(where, "no frame of it can be used: nothing to do in this capture.", fatal=False))
            continue
        if capture.role in ("camera", "axis") and not capture.off_frames:
            problems.append(Problem(where, "it has no laser-off frames, but only those count in this role."))
        if capture.role in ("laser-plane", "artifact", "scan") and not capture.on_frames:
            problems.append(
                Problem(
                    where, "it has no laser-on frames, but this role needs the stripe. Set laser to 'on' in frames.csv."
                )
            )
        counted = capture.off_frames if capture.role == "axis" else capture.on_frames
        if capture.role in ("axis", "artifact", "scan"):
            bare = [f.name for f in counted if f.angle_rad is None]
            if bare:
                problems.append(
                    Problem(
                        where,
                        f"{len(bare)} frame(s) without angle_deg, the first is {bare[0]}. This role needs the table's angle.",
                    )
                )
        if len(counted) == 1 and capture.role in ("axis", "artifact", "scan"):
            problems.append(Problem(where, "it has one frame only; a turn needs many.", fatal=False))
        repeated = [name for name, n in Counter(f.name for f in capture.frames).items() if n > 1]
        if repeated:
            problems.append(Problem(where, f"{repeated[0]} is listed more than once in frames.csv.", fatal=False))
    return problems


def _measurement_problems(content: SessionFile, captures: list[Capture]) -> list[Problem]:
    scanned = {c.folder for c in captures if c.role in ("scan", "artifact")}
    return [
        Problem(
            f"session.toml, measurement of '{m.capture}'",
            f"there is no scan capture '{m.capture}'; there is {', '.join(sorted(scanned)) or 'none'}.",
        )
        for m in content.measurements
        if m.capture not in scanned
    ]
