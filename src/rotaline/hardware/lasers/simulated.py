"""The laser of the simulated rig."""

from typing import Literal

from rotaline.errors import DeviceError, DeviceLimitError, DeviceStateError, DeviceTimeoutError
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import FoundDevice
from rotaline.hardware.laser import LaserInfo
from rotaline.hardware.simulated.world import SimulatedWorld, world_of
from rotaline.tables import NotNegative, Table, key

_DEVICE = "simulated laser"


class Settings(Table):
    """The laser of the simulated rig; its light is that of the rig that is simulated."""

    driver: Literal["simulated"] = key(..., "simulated")
    switching_ms: NotNegative = key(2.0, "from the command until the light is there, or gone, ms")


class SimulatedLaser:
    """See :class:`rotaline.hardware.laser.Laser`. The light of the room changes with it, as the rig says."""

    def __init__(self, settings: Settings, clock: Clock, world: SimulatedWorld) -> None:
        world.claim(_DEVICE)
        self._clock, self._world = clock, world
        self._open, self._on, self._power = True, False, 1.0
        self.info = LaserInfo(_DEVICE, can_set_power=True, switching_s=settings.switching_ms * 1e-3)
        world.switch_laser(None)

    @property
    def is_on(self) -> bool:
        """Whether it was last switched on; at power 0 it is dark all the same."""
        return self._on

    def on(self) -> None:
        """Switch it on, at its set power."""
        self._require_open()
        if self._on:
            return
        fails = self._world.count("switchings on") in self._world.faults.laser_dark_at_switchings
        if not fails:
            self._world.switch_laser(self._power)
            self._on = True
        self._clock.wait(self.info.switching_s)
        if fails:
            raise DeviceTimeoutError(f"{_DEVICE}: it was switched on and is still dark. See whether it has power.")

    def off(self) -> None:
        """Switch it off."""
        self._require_open()
        self._switch_off()

    def set_power(self, fraction: float) -> None:
        """Share of full power."""
        self._require_open()
        if not 0.0 <= fraction <= 1.0:
            raise DeviceLimitError(
                f"{_DEVICE}: the power {fraction:g} is outside 0 to 1 of full power. Choose another one."
            )
        self._power = fraction
        if self._on:
            self._world.switch_laser(fraction)

    def close(self) -> None:
        """Switch it off, where that fails once more, and let it go."""
        if not self._open:
            return
        for _ in range(2):
            try:
                self._switch_off()
                break
            except DeviceError:
                continue
        # only now: where this was interrupted, it can be closed again
        self._open = False
        self._world.release(_DEVICE)

    def _switch_off(self) -> None:
        if not self._on:
            return
        fails = self._world.count("switchings off") in self._world.faults.laser_lit_at_switchings
        if not fails:
            self._world.switch_laser(None)
            self._on = False
        self._clock.wait(self.info.switching_s)
        if fails:
            raise DeviceTimeoutError(
                f"{_DEVICE}: it was switched off and still shines. Pull its plug, then see what holds the switch."
            )

    def _require_open(self) -> None:
        if not self._open:
            raise DeviceStateError(f"{_DEVICE}: it has been closed. Open it again.")


def open_device(settings: Settings, clock: Clock, connections: Connections) -> SimulatedLaser:
    """The laser of the world that is provided as "world"; it is off."""
    return SimulatedLaser(settings, clock, world_of(_DEVICE, clock, connections))


def find() -> tuple[FoundDevice, ...]:
    """It is always there."""
    return (FoundDevice("laser", "simulated", _DEVICE, '[laser]\ndriver = "simulated"\n'),)
