"""What a turntable is to this program.

Angles are those of the device, deg, with the device's own sense, not wrapped: 360 is one turn on from 0. Every call blocks until
what its description says holds, or raises a :class:`rotaline.errors.DeviceError`. A move outside the limits raises before
anything moves; nothing is ever clipped.
"""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable


@dataclass(frozen=True)
class TurntableInfo:
    """What a turntable is and can.

    Attributes
    ----------
    device : how messages name it
    limits_deg : least, most; None: it turns without end
    resolution_deg : the smallest step
    u_angle_deg : standard uncertainty of an angle that it reports, as stated by its maker or in rig.toml
    max_speed_deg_s : None: unknown
    encoder : the angle is measured, not counted in steps that were commanded
    has_reference : :meth:`Turntable.home` finds the same place each time; False: it calls the present place 0
    continuous : :meth:`Turntable.turn` works, and :meth:`Turntable.angle_deg` while it turns
    """

    device: str
    limits_deg: tuple[float, float] | None
    resolution_deg: float
    u_angle_deg: float
    max_speed_deg_s: float | None = None
    encoder: bool = False
    has_reference: bool = True
    continuous: bool = True


@runtime_checkable
class Turntable(Protocol):
    """A turntable that is open; it stands."""

    @property
    def info(self) -> TurntableInfo:
        """What it is and can."""

    def home(self, timeout_s: float) -> None:
        """Find the angle 0; the table stands there when this returns. A table without a reference calls its present place 0.

        Raises
        ------
        DeviceTimeoutError, DeviceStateError, DeviceConnectionError
            The table has been told to stop.
        """

    def move_to(self, angle_deg: float, timeout_s: float) -> float:
        """Turn to an angle; returns the angle that the device reports, deg, once the table stands.

        Raises
        ------
        DeviceLimitError
            If the angle is outside the limits; nothing has moved.
        DeviceTimeoutError, DeviceStateError, DeviceConnectionError
            The table has been told to stop where it is.
        """

    def angle_deg(self) -> float:
        """The angle that the device reports now."""

    def turn(self, speed_deg_s: float) -> None:
        """Turn without end (or up to the limits); the speed (negative: backwards) has been reached when this returns.

        Raises
        ------
        DeviceLimitError
            If it cannot turn so fast.
        DeviceStateError
            If it cannot turn continuously at all.
        """

    def stop(self, timeout_s: float) -> None:
        """Stop; the table stands when this returns, and still knows its angle. May be called at any time, also when it stands."""

    def close(self) -> None:
        """Stop the table and let it go; never raises, and may be called twice."""
