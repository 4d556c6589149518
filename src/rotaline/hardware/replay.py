"""A recorded session as a rig: camera, turntable and laser share which capture is chosen, where the table stands, and whether the laser is on.

The session is read by whoever opens the rig, who provides it as the connection ``"recording"`` before the devices are opened. The shared state
is the connection ``"replay"``, there once one of the devices is open.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

from rotaline.errors import DeviceConnectionError, DeviceStateError
from rotaline.hardware.camera import Image
from rotaline.hardware.connections import Connections

RECORDING = "recording"
REPLAY = "replay"


@dataclass(frozen=True, eq=False)
class RecordedFrame:
    """A frame of a recording.

    Attributes
    ----------
    name : for messages, e.g. "camera/0003.png"
    angle_deg : of the table, as read; None: the table played no part
    pose : which frames show the same pose of a target; None: it played no part
    read : the image, as it was stored; raises SessionError or OSError if it cannot be read
    exposure_us : None: not known
    """

    name: str
    angle_deg: float | None
    laser_on: bool
    pose: str | None
    read: Callable[[], Image]
    exposure_us: float | None = None


@dataclass(frozen=True, eq=False)
class RecordedCapture:
    """A capture of a recording: its folder, its role, its frames in the order in which they were taken."""

    name: str
    role: str
    frames: tuple[RecordedFrame, ...]

    @property
    def poses(self) -> tuple[str, ...]:
        """The poses of its frames, each once, in the order in which they were taken."""
        return tuple(dict.fromkeys(frame.pose for frame in self.frames if frame.pose is not None))


@dataclass(frozen=True, eq=False)
class Recording:
    """A recorded session: where it is, for messages, and its captures in order."""

    session: str
    captures: tuple[RecordedCapture, ...]


class Replay:
    """The state that the devices of a recording share.

    Attributes
    ----------
    recording : what was recorded
    capture : the capture that is chosen; at first the first one
    pose : the pose that is presented; None: none is
    angle_deg : where the table stands, not wrapped
    laser_on : whether the laser is on
    """

    def __init__(self, recording: Recording) -> None:
        if not any(capture.frames for capture in recording.captures):
            raise DeviceStateError(
                f"replay of {recording.session}: the session has no frames. State another session in rig.toml."
            )
        self.recording = recording
        self.capture = recording.captures[0]
        self.pose: str | None = None
        self.angle_deg = 0.0
        self.laser_on = False

    @property
    def device(self) -> str:
        """How messages name it."""
        return f"replay of {self.recording.session}"

    def select(self, folder: str) -> None:
        """Choose the capture whose frames are given from now on; no pose is presented then.

        Raises
        ------
        DeviceStateError
            If the recording has no such capture.
        """
        for capture in self.recording.captures:
            if capture.name == folder:
                self.capture, self.pose = capture, None
                return
        there = ", ".join(capture.name for capture in self.recording.captures)
        raise DeviceStateError(f"{self.device}: it has no capture '{folder}'. There is {there}: choose one of these.")

    def present(self, pose: str | None) -> None:
        """Hold the target of the chosen capture in one of its poses; None: take it away.

        Raises
        ------
        DeviceStateError
            If the capture has no such pose.
        """
        if pose is not None and pose not in self.capture.poses:
            raise DeviceStateError(
                f"{self._chosen}: it has no pose '{pose}'. There is {self._poses()}: present one of these."
            )
        self.pose = pose

    def frame(self, tolerance_deg: float, exposure_us: float) -> RecordedFrame:
        """The recorded frame that shows the rig as it stands now.

        Where frames differ in exposure only, the one whose exposure is nearest, as a ratio. Angles may differ by whole turns. Without a pose that
        is presented, frames that have an angle need none.

        Raises
        ------
        DeviceStateError
            If there is none; the message says what there is.
        """
        lit = [f for f in self.capture.frames if f.laser_on == self.laser_on]
        posed = [
            f for f in lit if f.pose == self.pose or f.pose is None or (self.pose is None and f.angle_deg is not None)
        ]
        fitting = [f for f in posed if self._off_by(f) <= tolerance_deg]
        if fitting:
            return min(fitting, key=lambda f: (_ratio(f.exposure_us, exposure_us), self._off_by(f)))
        light = f"the laser {'on' if self.laser_on else 'off'}"
        if not lit:
            raise DeviceStateError(
                f"{self._chosen}: it has no frame with {light}. Switch the laser, or choose another capture."
            )
        if not posed:
            shown = "no pose is presented" if self.pose is None else f"no frame with {light} shows pose '{self.pose}'"
            raise DeviceStateError(f"{self._chosen}: {shown}. There is {self._poses()}: present one of these.")
        angles = sorted({f.angle_deg for f in posed if f.angle_deg is not None})
        nearest = min(posed, key=self._off_by).angle_deg
        raise DeviceStateError(
            f"{self._chosen}: it has no frame at {self.angle_deg:g} deg with {light} (within {tolerance_deg:g} deg). There are {len(angles)} angles "
            f"from {angles[0]:g} to {angles[-1]:g} deg, the nearest is {nearest:g} deg: move there, or widen angle_tolerance_deg."
        )

    @property
    def _chosen(self) -> str:
        return f"{self.device}, capture '{self.capture.name}'"

    def _off_by(self, frame: RecordedFrame) -> float:
        return 0.0 if frame.angle_deg is None else abs(math.remainder(frame.angle_deg - self.angle_deg, 360.0))

    def _poses(self) -> str:
        return f"pose {', '.join(self.capture.poses)}" if self.capture.poses else "no pose"


def _ratio(recorded_us: float | None, wanted_us: float) -> float:
    """How far two exposures are from each other; 0 where it is not known."""
    return 0.0 if not recorded_us else abs(math.log(recorded_us / wanted_us))


def replay_of(device: str, connections: Connections) -> Replay:
    """The state that the devices share.

    Raises
    ------
    DeviceConnectionError
        If no recording was provided.
    """
    recording = connections.get(RECORDING)
    if not isinstance(recording, Recording):
        raise DeviceConnectionError(
            f"{device} (replay): no recorded session has been opened for it. State its folder as session in the table [replay] of rig.toml."
        )
    return connections.shared(REPLAY, lambda: Replay(recording))
