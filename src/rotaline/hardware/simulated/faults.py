"""What goes wrong with the simulated rig, and when: events of a script, for tests of what works with devices.

Everything counts from 1 and as long as the world is there, also when a device is closed and opened again: so each event happens
once. Frames go by :attr:`rotaline.hardware.camera.CameraFrame.number`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Faults:
    """Numbers of the frames, moves and switchings at which something goes wrong.

    Attributes
    ----------
    lost_frames : they never arrive. ``take`` raises LostFrameError, a stream has a gap in its numbers
    damaged_frames : they arrive in pieces: LostFrameError from ``take`` and ``next_frame``
    late_frames : they arrive so many seconds too late; DeviceTimeoutError if that is longer than the caller waits. ``take`` never hands them
        out afterwards, a stream does
    camera_gone_at_frames : the cable is pulled before this frame arrives: DeviceConnectionError, at every call until the camera is opened anew
    stalled_moves : the table gets stuck half-way; the time that the caller gives passes, then DeviceTimeoutError
    alarm_at_moves : the table's controller stops half-way: DeviceStateError, at every move until it is homed
    turntable_gone_at_moves : it stands half-way: DeviceConnectionError, at every call until the table is opened anew
    laser_dark_at_switchings : it stays dark when it is switched on: DeviceTimeoutError
    laser_lit_at_switchings : it stays lit when it is switched off: DeviceTimeoutError

    Notes
    -----
    Moves are calls of ``move_to`` and ``home`` that are within the limits. Switchings are calls of ``on`` while it is dark, and of ``off``
    while it is lit; each counted for itself.
    """

    lost_frames: frozenset[int] = frozenset()
    damaged_frames: frozenset[int] = frozenset()
    late_frames: Mapping[int, float] = field(default_factory=dict)
    camera_gone_at_frames: frozenset[int] = frozenset()
    stalled_moves: frozenset[int] = frozenset()
    alarm_at_moves: frozenset[int] = frozenset()
    turntable_gone_at_moves: frozenset[int] = frozenset()
    laser_dark_at_switchings: frozenset[int] = frozenset()
    laser_lit_at_switchings: frozenset[int] = frozenset()
