"""A laser with a switch that a person presses when the program asks."""

from contextlib import suppress
from typing import Literal

from rotaline.errors import DeviceStateError
from rotaline.hardware.by_hand import Ask, answer_of, person_of
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import FoundDevice
from rotaline.hardware.laser import LaserInfo
from rotaline.tables import NotNegative, Table, key


class Settings(Table):
    """``[laser]`` of rig.toml."""

    driver: Literal["manual"] = key(..., "manual")
    name: str = key("laser", "how messages call it")
    switching_s: NotNegative = key(1.0, "time after the switch until the light has its strength, or has ended, s")


class ManualLaser:
    """See :class:`~rotaline.hardware.laser.Laser`. A person has no time-out: calls wait for the answer."""

    def __init__(self, settings: Settings, ask: Ask, clock: Clock) -> None:
        """Have it switched off."""
        self._settings = settings
        self._ask = ask
        self._clock = clock
        self._on = True  # until somebody has said that it is off
        self._closed = False
        self._info = LaserInfo(device=settings.name, can_set_power=False, switching_s=settings.switching_s)
        self.off()

    @property
    def info(self) -> LaserInfo:
        """See :class:`~rotaline.hardware.laser.Laser`."""
        return self._info

    @property
    def is_on(self) -> bool:
        """See :class:`~rotaline.hardware.laser.Laser`."""
        return self._on

    def on(self) -> None:
        """See :class:`~rotaline.hardware.laser.Laser`."""
        self._check_open()
        if not self._on:
            self._on = True  # from the question on it may shine
            self._question("on")

    def off(self) -> None:
        """See :class:`~rotaline.hardware.laser.Laser`."""
        self._check_open()
        if self._on:
            self._question("off")
            self._on = False

    def set_power(self, fraction: float) -> None:
        """It cannot."""
        self._check_open()
        raise DeviceStateError(
            f"{self._info.device}: its power cannot be set by the program. Set it by hand, and leave it."
        )

    def close(self) -> None:
        """See :class:`~rotaline.hardware.laser.Laser`."""
        if self._closed:
            return
        with suppress(Exception):  # whatever the terminal does: the rest is closed as well
            self.off()
        self._closed = True

    def _question(self, state: str) -> None:
        text = f"{self._settings.name}: switch it {state}, then press Enter:"
        answer_of(self._ask, self._info.device, text, "Switch it off by hand.")
        self._clock.wait(self._settings.switching_s)

    def _check_open(self) -> None:
        if self._closed:
            raise DeviceStateError(f"{self._info.device}: it has been closed. Open it again.")


def open_device(settings: Settings, clock: Clock, connections: Connections) -> ManualLaser:
    """The laser, off; see :mod:`rotaline.hardware.drivers`. ``prompt`` of the connections asks the person: question in, answer out.

    Raises
    ------
    DeviceStateError
        If there is no terminal.
    """
    return ManualLaser(settings, person_of(settings.name, "switch it", connections), clock)


def find() -> tuple[FoundDevice, ...]:
    """Nothing: whether there is a person with a laser cannot be seen."""
    return ()
