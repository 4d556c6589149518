"""What a line laser is to this program. A laser that has been opened is off, and one that is closed is off."""

from dataclasses import dataclass
from typing import Protocol, runtime_checkable


@dataclass(frozen=True)
class LaserInfo:
    """What a laser is and can.

    Attributes
    ----------
    device : how messages name it
    can_set_power : :meth:`Laser.set_power` works
    switching_s : the light has reached its strength, or ended, so long after the command; the driver waits for it
    """

    device: str
    can_set_power: bool = False
    switching_s: float = 0.0


@runtime_checkable
class Laser(Protocol):
    """A laser that is open."""

    @property
    def info(self) -> LaserInfo:
        """What it is and can."""

    @property
    def is_on(self) -> bool:
        """Whether it was last switched on."""

    def on(self) -> None:
        """Switch it on; it shines at its set power when this returns.

        Raises
        ------
        DeviceTimeoutError, DeviceStateError, DeviceConnectionError
        """

    def off(self) -> None:
        """Switch it off; it is dark when this returns. Raises as :meth:`on`."""

    def set_power(self, fraction: float) -> None:
        """Share of full power, 0 to 1; holds from now on, whether it is on or off.

        Raises
        ------
        DeviceLimitError
            Outside 0 to 1.
        DeviceStateError
            If its power cannot be set.
        """

    def close(self) -> None:
        """Switch it off and let it go; never raises, and may be called twice."""
