"""A laser at the spindle output or a fan output of a board with GRBL, grblHAL or Marlin."""

from contextlib import suppress
from typing import Annotated, Literal

from pydantic import Strict, model_validator

from rotaline.errors import DeviceError, DeviceLimitError, DeviceStateError
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import FoundDevice
from rotaline.hardware.gcode.board import Board, BoardSettings, open_board
from rotaline.hardware.laser import LaserInfo
from rotaline.tables import NotNegative, key


class Settings(BoardSettings):
    """``[laser]`` of rig.toml."""

    driver: Literal["gcode"] = key(..., "gcode")
    output: Literal["M3", "M106"] = key("M3", "commands that switch it: M3 and M5 (spindle), or M106 and M107 (fan)")
    fan: Annotated[int, Strict()] = key(0, "number of the fan output, for M106")
    power_range: Annotated[tuple[NotNegative, NotNegative], Strict(False)] | None = key(
        None, "S word of no and of full power, as [0, 1000]; left out: it is switched only (M3 without S, M106 S255)"
    )
    switching_s: NotNegative = key(0.05, "time after the command until the light has its strength, or has ended, s")

    @model_validator(mode="after")
    def _fits(self) -> "Settings":
        if self.power_range is not None and not self.power_range[0] < self.power_range[1]:
            raise ValueError(f"power_range is {list(self.power_range)}; the first has to be the smaller one")
        if self.output == "M106" and self.dialect == "grbl":
            raise ValueError("GRBL has no fan outputs; use the spindle output, output = 'M3'")
        if self.output == "M106" and self.power_range is not None and self.power_range[1] > 255:
            raise ValueError(f"power_range ends at {self.power_range[1]:g}; a fan output has its full power at S255")
        if self.fan < 0:
            raise ValueError(f"fan is {self.fan}; outputs are counted from 0")
        return self


class GcodeLaser:
    """See :class:`~rotaline.hardware.laser.Laser`."""

    def __init__(self, settings: Settings, board: Board, clock: Clock) -> None:
        """Switch it off."""
        self._settings = settings
        self._board = board
        self._clock = clock
        self._closed = False
        self._fraction = 1.0
        self._on_since_reset: int | None = None
        """Which reset of the board it was switched on after; a later one has switched it off."""
        output = "spindle output" if settings.output == "M3" else f"fan output {settings.fan}"
        self._info = LaserInfo(
            device=f"{board.device}, {output}",
            can_set_power=settings.power_range is not None,
            switching_s=settings.switching_s,
        )
        self.off()
        if settings.output == "M3":
            board.check_laser(self._info.device, None if settings.power_range is None else settings.power_range[1])

    @property
    def info(self) -> LaserInfo:
        """See :class:`~rotaline.hardware.laser.Laser`."""
        return self._info

    @property
    def is_on(self) -> bool:
        """See :class:`~rotaline.hardware.laser.Laser`. A reset of the board has switched it off."""
        return self._on_since_reset is not None and self._on_since_reset == self._board.n_resets

    def on(self) -> None:
        """See :class:`~rotaline.hardware.laser.Laser`. While the table turns at the same board it cannot be switched on."""
        self._check_open()
        self._shine()
        self._clock.wait(self._settings.switching_s)

    def off(self) -> None:
        """See :class:`~rotaline.hardware.laser.Laser`. A table that turns at the same board is stopped first."""
        self._check_open()
        line = "M5" if self._settings.output == "M3" else f"M107 P{self._settings.fan}"
        self._board.switch(line, off=True)
        self._on_since_reset = None
        self._clock.wait(self._settings.switching_s)

    def set_power(self, fraction: float) -> None:
        """See :class:`~rotaline.hardware.laser.Laser`."""
        self._check_open()
        if self._settings.power_range is None:
            raise DeviceStateError(
                f"{self._info.device}: its power cannot be set. State power_range in rig.toml if the driver of the laser takes a PWM signal."
            )
        if not 0.0 <= fraction <= 1.0:
            raise DeviceLimitError(f"{self._info.device}: a power of {fraction:g} is outside of its limits, 0 to 1.")
        self._fraction = fraction
        if self.is_on:
            self._shine()
            self._clock.wait(self._settings.switching_s)

    def close(self) -> None:
        """See :class:`~rotaline.hardware.laser.Laser`."""
        if self._closed:
            return
        self._dark()
        self._closed = True

    def _shine(self) -> None:
        fan = self._settings.output == "M106"
        words = f"M106 P{self._settings.fan}" if fan else "M3"
        if self._settings.power_range is not None:
            least, most = self._settings.power_range
            words += f" S{least + self._fraction * (most - least):.{0 if fan else 1}f}"
        elif fan:
            words += " S255"
        self._on_since_reset = self._board.n_resets  # from here on it may shine
        try:
            self._board.switch(words, off=False)
        except BaseException:
            self._dark()
            raise

    def _dark(self) -> None:
        """Switch it off, whatever state the board is in; what goes wrong there is not what the user has to hear about first."""
        with suppress(DeviceError):
            self.off()

    def _check_open(self) -> None:
        if self._closed:
            raise DeviceStateError(f"{self._info.device}: it has been closed. Open it again.")


def open_device(settings: Settings, clock: Clock, connections: Connections) -> GcodeLaser:
    """The laser, off; see :mod:`rotaline.hardware.drivers`."""
    return GcodeLaser(settings, open_board(settings, clock, connections), clock)


def find() -> tuple[FoundDevice, ...]:
    """The serial ports of USB devices; see :mod:`rotaline.hardware.drivers`."""
    from rotaline.hardware.gcode.connection import find_ports

    return find_ports("laser", 'dialect = "grbl"        # or "grblhal", "marlin"\n')
