"""Frames of a turning table: the angle of each is that of the table in the middle of its exposure.

The table reports its angle while frames arrive. The reports around a frame give its angle by a parabola in time, which holds while the table
turns evenly, speeds up or slows down. So the uncertainty of a frame's angle has three parts: that of the reports as the table states it, the
speed times the uncertainty of the moments (of the frame, of a report), and what the reports scatter about the parabola.
"""

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass

import numpy as np

from rotaline.errors import DeviceStateError, DeviceTimeoutError, LostFrameError
from rotaline.hardware.camera import Camera, CameraFrame
from rotaline.hardware.clock import Clock
from rotaline.hardware.turntable import Turntable, TurntableInfo

_AROUND = 5
"""Reports on each side of a frame that its angle is found from."""
_RUN_UP_FRAMES = 3
_PATIENCE_S = 10.0
_MISSED_IN_A_ROW = 3
_MOVE_S = 60.0
_NEAR_STEPS = 0.75
_SAME_TIME_S = 2e-3
"""Clocks may disagree so much, beyond the stated uncertainty of a frame's moment."""
_STANDS_S = 0.5
_TURN_IN_EXPOSURE = 0.1
"""Of a step, at most, where the speed is not stated."""


@dataclass(frozen=True, eq=False)
class TurningFrame:
    """A frame of a turning table: angle in the middle of the exposure, deg, and its standard uncertainty."""

    frame: CameraFrame
    angle_deg: float
    u_angle_deg: float


@dataclass(frozen=True)
class Report:
    """What the table said, and the moment that it holds for."""

    time_s: float
    u_time_s: float
    angle_deg: float


def report(turntable: Turntable, clock: Clock) -> Report:
    """The table's angle now; it holds for some moment between question and answer."""
    asked = clock.now_s()
    angle = turntable.angle_deg()
    answered = clock.now_s()
    return Report((asked + answered) / 2, (answered - asked) / math.sqrt(12.0), angle)


def angle_at(frame: CameraFrame, reports: Sequence[Report], u_report_deg: float) -> tuple[float, float]:
    """Angle in the middle of a frame's exposure, deg, and its standard uncertainty, from the reports around it.

    Parameters
    ----------
    frame : CameraFrame   exposed between the first and the last report
    reports : in their order, at least two
    u_report_deg : standard uncertainty of a report
    """
    middle = sum(r.time_s < frame.time_s for r in reports)
    some = reports[max(middle - _AROUND, 0) : middle + _AROUND]
    t = np.array([r.time_s - frame.time_s for r in some])
    angles = np.array([r.angle_deg for r in some])
    scale = float(np.max(np.abs(t))) or 1.0
    degree = 2 if len(some) > 5 else 1
    design = np.vander(t / scale, degree + 1, increasing=True)
    inverse = np.linalg.pinv(design)
    coefficients = inverse @ angles
    off = angles - design @ coefficients
    scatter = float(np.sum(off**2)) / max(len(some) - degree - 1, 1)
    u_fit = math.sqrt(scatter * float(inverse[0] @ inverse[0]))
    u_time = math.hypot(frame.u_time_s, max(r.u_time_s for r in some))
    return float(coefficients[0]), math.hypot(u_report_deg, coefficients[1] / scale * u_time, u_fit)


def uncovered(planned_deg: Sequence[float], taken_deg: Sequence[float]) -> list[tuple[float, ...]]:
    """The planned angles that no frame is near to (three quarters of a step), as runs of neighbours.

    Examples
    --------
    >>> uncovered((0.0, 4.0, 8.0, 12.0, 16.0), (0.3, 8.1))
    [(4.0,), (12.0, 16.0)]
    """
    taken = np.asarray(taken_deg, dtype=float)
    near = _NEAR_STEPS * step_of(planned_deg)
    missing = [not np.any(np.abs(taken - angle) <= near) for angle in planned_deg]
    runs: list[tuple[float, ...]] = []
    for i, angle in enumerate(planned_deg):
        if missing[i]:
            runs[-1:] = [(*runs[-1], angle)] if i > 0 and missing[i - 1] else [*runs[-1:], (angle,)]
    return runs


def step_of(planned_deg: Sequence[float]) -> float:
    """The step of equal steps, deg."""
    return abs(planned_deg[1] - planned_deg[0]) if len(planned_deg) > 1 else 1.0


def is_wanted(angle_deg: float, planned_deg: Sequence[float], spacing_deg: float) -> bool:
    """Whether a frame of a stream is the one of a planned angle: none is nearer to it.

    Parameters
    ----------
    angle_deg : of the frame
    planned_deg : the planned angles
    spacing_deg : from frame to frame; where it is more than a step of the plan, each frame is wanted
    """
    nearest = min(abs(angle_deg - planned) for planned in planned_deg)
    return spacing_deg >= step_of(planned_deg) or nearest <= 0.51 * spacing_deg


def frame_period_s(camera: Camera) -> float:
    """Time from frame to frame while the camera streams, s.

    Raises
    ------
    LostFrameError
        If most frames are lost.
    """
    frames: list[CameraFrame] = []
    camera.start()
    try:
        for _ in range(3 * _AROUND):
            try:
                frames.append(camera.next_frame(_patience_s(camera)))
            except LostFrameError:
                continue
            if len(frames) > _AROUND:
                return (frames[-1].time_s - frames[1].time_s) / (frames[-1].number - frames[1].number)
    finally:
        camera.stop()
    raise LostFrameError(
        f"{camera.info.device}: {len(frames)} of {3 * _AROUND} frames of a stream arrived. Look at its cable, or its bandwidth."
    )


def suitable_speed_deg_s(camera: Camera, info: TurntableInfo, step_deg: float, period_s: float) -> float:
    """The speed for a plan that states none."""
    slow_enough = _TURN_IN_EXPOSURE * step_deg / (camera.settings.exposure_us * 1e-6)
    return min(step_deg / period_s, slow_enough, info.max_speed_deg_s or math.inf)


def turning_frames(
    camera: Camera,
    turntable: Turntable,
    clock: Clock,
    span_deg: tuple[float, float],
    speed_deg_s: float,
    run_up_deg: float,
) -> Generator[TurningFrame | int, None, None]:
    """Frames of a pass over ``span_deg`` (from, to), in order; an int says how many are missing at this place.

    The table stands before and after. It runs up before the span as far as its limits allow; what it passes before it turns evenly is for
    another pass, or for single stops. A camera that sends nothing any more ends the pass. Whatever is raised in here or by who takes the frames,
    the table is stopped; a program that is killed (SIGKILL) or a computer without power cannot do that, so a table with limits is to be preferred:
    its driver turns it no farther than to them.

    Raises
    ------
    DeviceStateError
        If the clocks of camera and machine do not agree, or the table stands though it should turn.
    DeviceError
    """
    first, last = span_deg
    sense = math.copysign(1.0, last - first)
    turntable.move_to(_within(turntable.info, first - sense * run_up_deg), _MOVE_S + 2 * abs(run_up_deg))
    following = _Following(turntable, clock, sense, last, speed_deg_s)
    waiting: list[CameraFrame] = []
    number: int | None = None
    missed = 0
    begun_s = clock.now_s()
    camera.start()
    try:
        turntable.turn(sense * speed_deg_s)
        following.look()
        while missed < _MISSED_IN_A_ROW:
            try:
                frame = camera.next_frame(_patience_s(camera))
            except (LostFrameError, DeviceTimeoutError) as error:
                missed += isinstance(error, DeviceTimeoutError)
                following.look()
                continue  # the gap in the numbers tells it
            missed = 0
            _require_same_clock(camera, frame, begun_s, clock.now_s())
            following.look()
            if number is not None and frame.number > number + 1:
                yield frame.number - number - 1
            number = frame.number
            waiting.append(frame)
            while waiting and following.is_known(waiting[0]):
                done = waiting.pop(0)
                if done.time_s < following.reports[0].time_s:
                    continue  # before the speed was reached
                if done.time_s >= following.end_s:
                    return
                angle, u = following.angle_of(done)
                if sense * (angle - first) >= -1e-9 and sense * (angle - last) <= 1e-9:
                    yield TurningFrame(done, angle, u)
    finally:
        try:
            turntable.stop(_MOVE_S)
        finally:
            camera.stop()


class _Following:
    """Watches the table turn, and stops it behind the span."""

    def __init__(self, turntable: Turntable, clock: Clock, sense: float, last_deg: float, speed_deg_s: float) -> None:
        self._turntable, self._clock, self._sense, self._last_deg = turntable, clock, sense, last_deg
        self._stands_s = _STANDS_S + 5 * turntable.info.resolution_deg / speed_deg_s
        self.reports: list[Report] = []
        self.end_s = math.inf
        """From then on the table was beyond the span, or stood."""
        self._changed: Report | None = None

    def look(self) -> None:
        """Ask where the table is.

        Raises
        ------
        DeviceStateError
            If it stands within the span.
        """
        if self.end_s < math.inf:
            return
        now = report(self._turntable, self._clock)
        self.reports.append(now)
        if self._changed is None or now.angle_deg != self._changed.angle_deg:
            self._changed = now
        if self._sense * (now.angle_deg - self._last_deg) > 0:
            self.end_s = now.time_s
            self._turntable.stop(_MOVE_S)
        elif now.time_s - self._changed.time_s > self._stands_s:
            info = self._turntable.info
            if not _at_limit(info, now.angle_deg):
                raise DeviceStateError(
                    f"{info.device}: it stands at {now.angle_deg:.3f} deg, but was told to turn to {self._last_deg:g} deg. See what holds it."
                )
            self.end_s = now.time_s

    def is_known(self, frame: CameraFrame) -> bool:
        """Whether no further report is needed for a frame."""
        return frame.time_s <= self.reports[-2].time_s or self.end_s < math.inf

    def angle_of(self, frame: CameraFrame) -> tuple[float, float]:
        """As :func:`angle_at`; reports from long before are forgotten, since the next frame is a later one."""
        earlier = sum(r.time_s < frame.time_s for r in self.reports) - 2 * _AROUND
        if earlier > 0:
            del self.reports[:earlier]
        return angle_at(frame, self.reports, self._turntable.info.u_angle_deg)


def _patience_s(camera: Camera) -> float:
    return camera.settings.exposure_us * 1e-6 + _PATIENCE_S


def _within(info: TurntableInfo, angle_deg: float) -> float:
    low, high = info.limits_deg or (-math.inf, math.inf)
    return min(max(angle_deg, low), high)


def _at_limit(info: TurntableInfo, angle_deg: float) -> bool:
    near = 2 * info.resolution_deg + 3 * info.u_angle_deg
    return info.limits_deg is not None and min(abs(angle_deg - limit) for limit in info.limits_deg) <= near


def _require_same_clock(camera: Camera, frame: CameraFrame, begun_s: float, arrived_s: float) -> None:
    spare = _SAME_TIME_S + 4 * frame.u_time_s
    if not begun_s - spare <= frame.time_s <= arrived_s + spare:
        raise DeviceStateError(
            f"{camera.info.device}: frame {frame.number} of a stream that began {arrived_s - begun_s:.3f} s ago says that it was exposed "
            f"{arrived_s - frame.time_s:+.3f} s ago (standard uncertainty {frame.u_time_s:.3g} s): its clock does not agree with that of this "
            'machine, so the angles of a turning table are not known. Use mode = "step", or set the clock of the camera.'
        )


def run_up_deg(speed_deg_s: float, period_s: float, attempt: int) -> float:
    """How far before the first angle a pass begins; farther at each attempt, since how fast a table speeds up is not known."""
    return attempt * _RUN_UP_FRAMES * speed_deg_s * max(period_s, 0.05)
