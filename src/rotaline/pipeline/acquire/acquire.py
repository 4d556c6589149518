"""Taking a session: capture by capture, stop by stop, frame by frame; what is complete already is not taken again."""

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from rotaline.errors import DeviceError, DeviceStateError, LostFrameError
from rotaline.hardware.camera import CameraFrame
from rotaline.hardware.rig import OpenRig
from rotaline.io.acquired_session import REFERENCE, AcquiredSession, FrameRow
from rotaline.io.frame_writer import FrameWriter
from rotaline.io.plan_file import TURNING, PlanFile, angles_of, session_toml
from rotaline.io.plan_tables import PlanCapture
from rotaline.pipeline.acquire.continuous import (
    frame_period_s,
    is_wanted,
    run_up_deg,
    step_of,
    suitable_speed_deg_s,
    turning_frames,
    uncovered,
)
from rotaline.pipeline.acquire.person import Person
from rotaline.pipeline.acquire.requirements import require_devices
from rotaline.pipeline.acquire.taking import FrameTaken, Taker, Watch
from rotaline.pipeline.acquire.tasks import (
    FrameTask,
    Stop,
    missing_stops,
    n_frames,
    stops_of,
    unfinished_pose,
    wanted_images,
)
from rotaline.pipeline.compiling import compile_if_missing
from rotaline.pipeline.observer import Observer

HOMING_S = 300.0
MOVE_S = 120.0
_POSE_ATTEMPTS = 20
_PASSES = 6
_WORTH_A_PASS = 4
"""Fewer neighbouring angles than this are taken while the table stands."""

_Row = Mapping[str, str]
_Keep = Callable[[CameraFrame, float, float | None], None]


@dataclass(frozen=True)
class Acquired:
    """What an acquisition has come to: ``n_frames`` of the plan are there, ``n_before`` of them by earlier starts."""

    path: Path
    n_frames: int
    n_before: int
    n_retaken: int


def _nobody_watches(_: FrameTaken) -> None:
    return


def acquire(
    plan: PlanFile,
    rig_text: str,
    rig: OpenRig,
    out: Path,
    person: Person,
    observer: Observer,
    watch: Watch = _nobody_watches,
) -> Acquired:
    """Take what a plan asks for, or what is missing of it, into a session folder.

    Parameters
    ----------
    plan : PlanFile
    rig_text : of the file that names the devices; kept with the session
    rig : OpenRig   stays open; its laser is off and its table stands when this returns or raises
    out : Path   the session folder
    person : who places targets and parts
    observer : hears of captures, frames, and what had to be taken again
    watch : sees each frame

    Raises
    ------
    RigError
        If the rig cannot do what the plan asks for.
    DeviceError
        If a device fails for good; frames until then are kept.
    DetectionError
        If no exposure shows the stripe.
    OutputError
        If frames cannot be written.
    """
    require_devices(plan, rig, person)
    compile_if_missing(observer.note, np.zeros((1, 1), dtype=np.uint8))  # not while the laser is on
    with AcquiredSession(out, plan.text, rig_text) as session, FrameWriter(session) as writer:
        try:
            acquired = _Run(plan, rig, session, writer, person, observer, watch).all_captures()
        except BaseException:
            _at_rest(rig, observer)
            raise
        _at_rest(rig, None)
        return acquired


def _at_rest(rig: OpenRig, observer: Observer | None) -> None:
    """Laser off, table still; where there is an observer, an error is on its way already, and further ones are told to it."""
    rest: list[Callable[[], None]] = []
    if rig.laser is not None:
        rest.append(rig.laser.off)
    if rig.turntable is not None:
        table = rig.turntable
        rest.append(lambda: table.stop(MOVE_S))
    failures: list[DeviceError] = []
    for end in rest:
        try:
            end()
        except DeviceError as error:
            failures.append(error)
    for failure in failures:
        if observer is None:
            raise failure
        observer.warning(str(failure))


class _Run:
    """One start of an acquisition."""

    def __init__(
        self,
        plan: PlanFile,
        rig: OpenRig,
        session: AcquiredSession,
        writer: FrameWriter,
        person: Person,
        observer: Observer,
        watch: Watch,
    ) -> None:
        self._plan, self._rig, self._session, self._writer = plan, rig, session, writer
        self._person, self._observer, self._watch = person, observer, watch
        self._captures = plan.tables.captures
        self._found = session.found([*(c.folder for c in self._captures), REFERENCE])
        self._taker = Taker(rig, session, person, observer, plan.tables.warm_up_s)
        self._references = set(self._found.listed[REFERENCE])
        self._begun = {c.folder for c in self._captures if self._found.rows[c.folder]}
        self._homed = False
        self._n_taken = 0

    def all_captures(self) -> Acquired:
        """Take what is missing."""
        n_before = self._say_found()
        for capture in self._captures:
            rows, listed = self._left(capture)
            todo = missing_stops(capture, listed, {row["image"] for row in rows})
            if capture.mode == "continuous":
                missing = bool(uncovered(angles_of(capture), _angles(rows)))
            else:
                missing = bool(todo) or self._reference_is_due(capture, len(stops_of(capture)), last=True)
            self._observer.stage(_title(capture), stored=not missing)
            if missing:
                self._prepare(capture, len(rows))
                if capture.mode == "continuous":
                    self._turning(capture, rows, len(listed))
                else:
                    self._standing(capture, todo, len(rows))
                self._taker.light(False)
                self._writer.flush()
        self._list_captures()
        return Acquired(self._session.path, n_before + self._n_taken, n_before, self._taker.n_retaken)

    def _say_found(self) -> int:
        found = self._found
        n_before = sum(len(self._wanted(c)) for c in self._captures)
        for text in found.repaired:
            self._observer.note(text)
            self._taker.event("repaired", text)
        if not self._session.same_rig:
            text = (
                "The rig file is not the one that this session was begun with; the devices are taken as they are now."
            )
            self._observer.warning(text)
            self._taker.event("rig", text)
        if any(found.listed.values()):
            total = sum(n_frames(c) for c in self._captures)
            text = f"All {total} frames are there already."
            if n_before < total:
                text = f"{n_before} of {total} frames are there already; it goes on with the first that is missing."
            self._observer.note(text)
            self._taker.event("resumed", text)
        return n_before

    def _left(self, capture: PlanCapture) -> tuple[tuple[_Row, ...], tuple[str, ...]]:
        """What an earlier start has left: rows of frames that need not be taken again, names of all; of a pose that was not finished, none."""
        rows, listed = self._found.rows[capture.folder], self._found.listed[capture.folder]
        index, n_rows = unfinished_pose(capture, listed)
        if n_rows:
            self._session.take_back(capture.folder, n_rows)
            text = f"{capture.folder}: pose {index + 1} was not finished; all its frames are taken again."
            self._observer.note(text)
            self._taker.event("repaired", text)
            listed = listed[:-n_rows]
        wanted = self._wanted(capture)
        return tuple(row for row in rows if row["image"] in wanted), listed

    def _wanted(self, capture: PlanCapture) -> set[str]:
        rows = self._found.rows[capture.folder]
        return wanted_images(capture, self._found.listed[capture.folder], {row["image"] for row in rows})

    def _prepare(self, capture: PlanCapture, n_done: int) -> None:
        """Everything stands where it should when this returns; nobody works in the light of the laser."""
        self._taker.light(False)
        asked = self._home() if capture.role in TURNING else None
        if asked is not None:
            text = capture.text or f"Place {capture.target or capture.folder}."
            capture = capture.model_copy(update={"text": f"{text} {asked}"})
        self._person.place(capture, n_done)
        if capture.laser_power is not None and self._rig.laser is not None:
            self._rig.laser.set_power(capture.laser_power)

    def _home(self) -> str | None:
        """Find the table's angle 0, once; what a person has to make sure of where it cannot be found again."""
        table = self._rig.turntable
        assert table is not None
        if self._homed:
            return None
        self._homed = True
        n_angles = sum(len(_angles(self._found.rows[c.folder])) for c in self._captures)
        if n_angles and not table.info.has_reference:
            try:
                angle = table.angle_deg()
            except DeviceStateError as error:
                raise DeviceStateError(
                    f"{error} The session has {n_angles} frames with angles that count from a 0 which this table cannot find again. Acquire "
                    "into another folder; `home` in [turntable] of the rig file can be set so that the next session can be resumed."
                ) from error
            return (
                f"The turntable has no reference: it says {angle:.3f} deg, and has to stand where it stood at that angle. If it was without "
                "power, or was turned by hand, end here (Ctrl-C) and acquire into another folder."
            )
        if self._plan.tables.home:
            table.home(HOMING_S)
        return None

    def _standing(self, capture: PlanCapture, todo: list[Stop], n_done: int) -> None:
        """A capture in which nothing moves while frames are taken."""
        n_planned = n_done + sum(len(stop.tasks) for stop in todo)
        with self._observer.work(capture.folder, n_planned) as count:
            for _ in range(n_done):
                count()
            for stop in todo:
                self._reference(capture, stop.index)
                for task, frame, angle in self._at_stop(capture, stop):
                    self._keep(capture, task, frame, angle)
                    n_done += 1
                    count()
                    self._show(capture, task, frame, angle, n_done, n_planned)
            self._reference(capture, len(stops_of(capture)), last=True)

    def _at_stop(self, capture: PlanCapture, stop: Stop) -> Iterator[tuple[FrameTask, CameraFrame, float | None]]:
        if stop.angle_deg is not None:
            angle = self._move(capture, stop.angle_deg)
            yield from ((task, self._taker.take(capture, task), angle) for task in stop.tasks)
            return
        preview = partial(self._taker.preview, capture)
        for attempt in range(_POSE_ATTEMPTS):
            self._taker.light(False)
            self._person.pose(capture, stop.index, preview)
            frames = [(task, self._taker.take(capture, task), None) for task in stop.tasks]
            why = self._person.judge(capture, stop.index, frames[0][1], preview)
            if why is None:
                break
            kept = attempt == _POSE_ATTEMPTS - 1
            self._observer.note(f"Pose {stop.index + 1}: {why} It is {'kept all the same' if kept else 'taken again'}.")
        yield from frames

    def _move(self, capture: PlanCapture, angle_deg: float) -> float:
        assert self._rig.turntable is not None
        reached = self._rig.turntable.move_to(angle_deg, MOVE_S)
        self._rig.clock.wait(capture.settle_s)
        return reached

    def _reference_is_due(self, capture: PlanCapture, index: int, last: bool = False) -> bool:
        every = capture.reference_every
        return bool(every) and (last or index % every == 0) and _reference_image(capture, index) not in self._references

    def _reference(self, capture: PlanCapture, index: int, last: bool = False) -> None:
        """A frame at the first angle, every so many stops and after the last one: what has changed since the first is drift."""
        if not self._reference_is_due(capture, index, last):
            return
        image = _reference_image(capture, index)
        angle = self._move(capture, capture.from_deg)
        task = FrameTask(image, capture.role != "axis", capture.from_deg, capture.folder)
        with self._person.aside(f"reference {index}"):
            frame = self._taker.take(capture, task)
        self._keep(capture, task, frame, angle, folder=REFERENCE)
        self._references.add(image)

    def _turning(self, capture: PlanCapture, rows: tuple[_Row, ...], n_listed: int) -> None:
        """A capture with a turning table: passes over what is missing, and single stops where little is."""
        planned, taken = angles_of(capture), _angles(rows)
        numbers = itertools.count(n_listed)
        laser = capture.role != "axis"

        def keep(frame: CameraFrame, angle: float, u_angle: float | None) -> None:
            task = FrameTask(f"{next(numbers):04d}.png", laser)
            self._keep(capture, task, frame, angle, u_angle)
            taken.append(angle)
            count()
            self._show(capture, task, frame, angle, len(taken), len(planned))

        with self._observer.work(capture.folder, len(planned)) as count:
            for _ in taken:
                count()
            for attempt in range(1, _PASSES + 1):
                runs = uncovered(planned, taken)
                for run in runs:
                    if len(run) >= _WORTH_A_PASS:
                        self._pass(capture, run, attempt, keep)
                        continue
                    for angle_deg in run:
                        angle = self._move(capture, angle_deg)
                        keep(self._taker.take(capture, FrameTask("", laser)), angle, None)
                if not runs:
                    return
        left = sum(len(run) for run in uncovered(planned, taken))
        if left:
            raise LostFrameError(
                f"{self._rig.camera.info.device}: {left} of {len(planned)} angles of capture '{capture.folder}' are still missing after "
                f'{_PASSES} passes. Turn slower (speed_deg_s), or use mode = "step"; what was taken is kept.'
            )

    def _pass(self, capture: PlanCapture, run: tuple[float, ...], attempt: int, keep: _Keep) -> None:
        """Keep the frames nearest to some neighbouring angles, while the table turns over them once."""
        camera, table, laser = self._rig.camera, self._rig.turntable, capture.role != "axis"
        assert table is not None
        self._move(capture, run[0])  # the exposure is found while it stands
        self._taker.light(laser)
        self._taker.expose(capture, self._taker.exposure_us(capture, laser))
        period_s = frame_period_s(camera)
        speed = capture.speed_deg_s or suitable_speed_deg_s(camera, table.info, step_of(run), period_s)
        run_up = run_up_deg(speed, period_s, attempt)
        spacing, kept_deg = speed * period_s, math.inf
        with closing(turning_frames(camera, table, self._rig.clock, (run[0], run[-1]), speed, run_up)) as frames:
            for got in frames:
                if isinstance(got, int):
                    self._taker.lost(f"{got} frame(s) of the stream were lost; their angles are taken again.")
                elif is_wanted(got.angle_deg, run, spacing) and abs(got.angle_deg - kept_deg) > spacing / 4:
                    keep(got.frame, got.angle_deg, got.u_angle_deg)
                    kept_deg = got.angle_deg

    def _keep(
        self,
        capture: PlanCapture,
        task: FrameTask,
        frame: CameraFrame,
        angle: float | None,
        u_angle: float | None = None,
        folder: str | None = None,
    ) -> None:
        self._taker.require_same_images(frame)
        if u_angle is None and angle is not None and self._rig.turntable is not None:
            u_angle = self._rig.turntable.info.u_angle_deg
        settings, time = frame.settings, self._taker.time_of(frame)
        row = FrameRow(
            task.image, angle, task.laser, task.pose, settings.exposure_us, settings.gain, time, u_angle, frame.number
        )
        self._writer.put(folder or capture.folder, row, frame.image)
        if folder is None:
            self._n_taken += 1
            if capture.folder not in self._begun:
                self._writer.flush()
                self._begun.add(capture.folder)
                self._list_captures()

    def _list_captures(self) -> None:
        """The captures that have frames go into session.toml: what is there can be used, also before all is done."""
        captures = [c for c in self._captures if c.folder in self._begun]
        if captures:
            self._session.write_session_file(session_toml(self._plan.tables, captures))

    def _show(
        self,
        capture: PlanCapture,
        task: FrameTask,
        frame: CameraFrame,
        angle: float | None,
        n_done: int,
        n_planned: int,
    ) -> None:
        us, waiting, retaken = frame.settings.exposure_us, self._writer.n_waiting, self._taker.n_retaken
        self._watch(FrameTaken(capture, n_done, n_planned, frame.image, angle, task.laser, us, waiting, retaken))


def _reference_image(capture: PlanCapture, index: int) -> str:
    return f"{capture.folder}-{index:04d}.png"


def _angles(rows: tuple[_Row, ...]) -> list[float]:
    return [float(row["angle_deg"]) for row in rows if row["angle_deg"]]


def _title(capture: PlanCapture) -> str:
    return f"Capture {capture.folder} ({capture.role}{f', {capture.target}' if capture.target else ''})"
