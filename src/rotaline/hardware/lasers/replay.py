"""The laser of a recorded session: it chooses between the frames that were taken with the laser on and those without."""

from typing import Literal

from rotaline.errors import DeviceStateError
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import FoundDevice
from rotaline.hardware.laser import LaserInfo
from rotaline.hardware.replay import Replay, replay_of
from rotaline.tables import Table, key


class Settings(Table):
    """A table ``[laser]`` of rig.toml with ``driver = "replay"``."""

    driver: Literal["replay"] = key("replay", "which driver")


class ReplayLaser:
    """A laser that can be on or off; see :class:`rotaline.hardware.laser.Laser`."""

    def __init__(self, replay: Replay) -> None:
        self._replay = replay
        self._closed = False
        self.info = LaserInfo(replay.device)
        replay.laser_on = False

    @property
    def is_on(self) -> bool:
        """Whether it is on."""
        return self._replay.laser_on

    def on(self) -> None:
        """Switch it on."""
        self._ready()
        self._replay.laser_on = True

    def off(self) -> None:
        """Switch it off."""
        self._ready()
        self._replay.laser_on = False

    def set_power(self, fraction: float) -> None:
        """Not possible."""
        self._ready()
        raise DeviceStateError(
            f"{self.info.device}: the power of a recorded laser cannot be set. Leave the power out of the plan."
        )

    def close(self) -> None:
        """Switch it off and let it go."""
        self._replay.laser_on = False
        self._closed = True

    def _ready(self) -> None:
        if self._closed:
            raise DeviceStateError(f"{self.info.device}: the laser has been closed. Open the rig again.")


def open_device(settings: Settings, clock: Clock, connections: Connections) -> ReplayLaser:
    """Open it; it is off. Raises as :func:`rotaline.hardware.drivers.open_laser`."""
    return ReplayLaser(replay_of("laser", connections))


def find() -> tuple[FoundDevice, ...]:
    """Recorded sessions are not looked for."""
    return ()
