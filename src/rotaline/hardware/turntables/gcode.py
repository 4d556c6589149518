"""A turntable at an axis of a board with GRBL, grblHAL or Marlin."""

import math
from typing import Annotated, Literal

from pydantic import Strict, model_validator

from rotaline.errors import DeviceError, DeviceLimitError, DeviceStateError
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import FoundDevice
from rotaline.hardware.gcode.board import Board, BoardSettings, open_board
from rotaline.hardware.turntable import TurntableInfo
from rotaline.tables import NotNegative, Number, Positive, key

FARTHEST_DEG = 360_000.0
"""1000 turns: beyond, the single precision of the firmware is coarser than a turntable."""

MOST_STEPS = 1e9
"""The firmware counts steps in 32 bits."""


class Settings(BoardSettings):
    """``[turntable]`` of rig.toml."""

    driver: Literal["gcode"] = key(..., "gcode")
    axis: Literal["X", "Y", "Z", "A", "B", "C", "U", "V"] = key(..., "letter of the axis that turns the table")
    units_per_deg: Number = key(
        ...,
        "units of the axis (mm, or deg of a rotary one) that turn the table by 1 deg; negative: the other way round",
    )
    speed_deg_s: Positive = key(..., "speed of moves, deg/s")
    limits_deg: Annotated[tuple[Number, Number], Strict(False)] | None = key(
        None, "least and greatest angle, deg; left out: it turns without end"
    )
    resolution_deg: Positive = key(..., "smallest step of the table, deg")
    u_angle_deg: NotNegative = key(..., "standard uncertainty of an angle, deg: steps, gear, run-out of the worm")
    home: Literal["none", "$H", "G28", "here"] = key(
        "here",
        "what home does: search the switch ($H with GRBL, G28 with Marlin); call the present place 0 (here); turn to the board's"
        " own 0, where it was switched on (none)",
    )
    settle_s: NotNegative = key(0.2, "wait after each move until nothing swings any more, s")

    @model_validator(mode="after")
    def _fits(self) -> "Settings":
        if self.units_per_deg == 0:
            raise ValueError("units_per_deg is 0; say how far the axis moves for 1 deg of the table")
        if self.limits_deg is not None and not self.limits_deg[0] < self.limits_deg[1]:
            raise ValueError(f"limits_deg are {list(self.limits_deg)}; the first has to be the smaller one")
        if self.home == ("$H" if self.dialect == "marlin" else "G28"):
            raise ValueError(
                f"home = '{self.home}' is not how {self.dialect} homes; $H is for grbl and grblhal, G28 for marlin"
            )
        return self


class GcodeTurntable:
    """See :class:`~rotaline.hardware.turntable.Turntable`."""

    def __init__(self, settings: Settings, board: Board, clock: Clock) -> None:
        """The board is open; nothing moves."""
        self._settings = settings
        self._board = board
        self._clock = clock
        self._closed = False
        self._turning_deg_s = 0.0
        self._zero: float | None = None if settings.home in ("$H", "G28") or board.lost is not None else 0.0
        greatest = board.max_feed(settings.axis)
        self._info = TurntableInfo(
            device=f"{board.device}, axis {settings.axis}",
            limits_deg=settings.limits_deg,
            resolution_deg=settings.resolution_deg,
            u_angle_deg=settings.u_angle_deg,
            max_speed_deg_s=None if greatest is None else greatest / 60.0 / abs(settings.units_per_deg),
            encoder=False,
            has_reference=settings.home in ("$H", "G28"),
            continuous=board.can_jog,
        )
        self._check_speed(settings.speed_deg_s)
        board.read(settings.axis)  # is there such an axis?

    @property
    def info(self) -> TurntableInfo:
        """See :class:`~rotaline.hardware.turntable.Turntable`."""
        return self._info

    def home(self, timeout_s: float) -> None:
        """See :class:`~rotaline.hardware.turntable.Turntable`. With ``home = "none"``, a position that was lost begins anew at 0 here."""
        self._check_open()
        self._check_standing()
        axis, how = self._settings.axis, self._settings.home
        try:
            if how in ("$H", "G28"):
                self._zero = None
                self._zero = self._board.home(axis, timeout_s)
            elif how == "here" or self._zero is None or self._board.lost is not None:
                self._board.unlock()
                self._zero = self._board.read(axis)
            else:
                self._board.ready()
                self._move(0.0, timeout_s)
        except BaseException:
            self._halt()
            raise
        self._clock.wait(self._settings.settle_s)

    def move_to(self, angle_deg: float, timeout_s: float) -> float:
        """See :class:`~rotaline.hardware.turntable.Turntable`."""
        self._check_open()
        self._check_angle(angle_deg)
        self._check_standing()
        self._homed()
        self._board.ready()
        try:
            reached = self._move(angle_deg, timeout_s)
        except BaseException:
            self._halt()
            raise
        self._clock.wait(self._settings.settle_s)
        return reached

    def angle_deg(self) -> float:
        """See :class:`~rotaline.hardware.turntable.Turntable`."""
        self._check_open()
        self._homed()
        position = self._board.read(self._settings.axis)
        return (position - self._homed()) / self._settings.units_per_deg  # it may have been lost while it was read

    def turn(self, speed_deg_s: float) -> None:
        """See :class:`~rotaline.hardware.turntable.Turntable`. Without limits it ends after 1000 turns."""
        self._check_open()
        if not math.isfinite(speed_deg_s) or speed_deg_s == 0:
            raise DeviceLimitError(
                f"{self._info.device}: it cannot turn with {speed_deg_s} deg/s. Give a speed that is not 0; stop() stops it."
            )
        if not self._board.can_jog:
            self._board.run(self._settings.axis, 0.0, 0.0)
        self._check_speed(speed_deg_s)
        self._check_standing()
        per_deg = self._settings.units_per_deg
        angle = self.angle_deg()
        self._board.ready()
        farthest = min(FARTHEST_DEG, MOST_STEPS * self._settings.resolution_deg)
        limits = self._settings.limits_deg or (angle - farthest, angle + farthest)
        way_deg = (limits[1] if speed_deg_s > 0 else limits[0]) - angle
        if way_deg * speed_deg_s <= 0:
            raise DeviceLimitError(
                f"{self._info.device}: it stands at {angle:.3f} deg, at the limit {limits[speed_deg_s > 0]:g} deg: there is no way left."
                " Turn the other way."
            )
        try:
            self._turning_deg_s = speed_deg_s
            self._board.run(self._settings.axis, way_deg * per_deg, abs(speed_deg_s * per_deg) * 60.0)
        except BaseException:
            self._halt()
            raise

    def stop(self, timeout_s: float) -> None:
        """See :class:`~rotaline.hardware.turntable.Turntable`.

        Raises
        ------
        DeviceStateError
            If it stands, but no longer knows its angle.
        """
        self._check_open()
        lost = self._board.lost
        self._board.stop(timeout_s)
        self._turning_deg_s = 0.0
        if self._board.lost is not None and lost is None:
            raise DeviceStateError(
                f"{self._info.device}: it stands, but does not know its angle: {self._board.lost}. Home it before it moves again."
            )

    def close(self) -> None:
        """See :class:`~rotaline.hardware.turntable.Turntable`."""
        if not self._closed:
            self._halt()
            self._closed = True

    def _move(self, angle_deg: float, timeout_s: float) -> float:
        per_deg = self._settings.units_per_deg
        zero = self._homed()
        feed = self._settings.speed_deg_s * abs(per_deg) * 60.0
        position = self._board.move(self._settings.axis, zero + angle_deg * per_deg, feed, timeout_s)
        reached = (position - zero) / per_deg
        allowed = self._settings.resolution_deg + 10.0**-self._board.decimals / abs(per_deg)
        if abs(reached - angle_deg) > allowed:
            raise DeviceStateError(
                f"{self._info.device}: it stands at {reached:.3f} deg instead of {angle_deg:.3f} deg. Somebody stopped it, or the firmware"
                " ended the move at a limit of its own: set limits_deg within that one."
            )
        return reached

    def _halt(self) -> None:
        """Tell it to stop, whatever state it is in; what goes wrong there is not what the user has to hear about first."""
        try:
            self._board.stop(2.0 * self._settings.answer_s)
        except DeviceError:
            return
        finally:
            self._turning_deg_s = 0.0

    def _homed(self) -> float:
        if self._board.lost is not None or self._zero is None:
            self._zero = None
            why = f": {self._board.lost}" if self._board.lost is not None else ""
            raise DeviceStateError(f"{self._info.device}: not homed{why}. Home it, then go on.")
        return self._zero

    def _check_open(self) -> None:
        if self._closed:
            raise DeviceStateError(f"{self._info.device}: it has been closed. Open it again.")

    def _check_standing(self) -> None:
        if self._turning_deg_s != 0:
            raise DeviceStateError(
                f"{self._info.device}: it still turns with {self._turning_deg_s:g} deg/s. Stop it first."
            )

    def _check_angle(self, angle_deg: float) -> None:
        least, most = self._settings.limits_deg or (-FARTHEST_DEG, FARTHEST_DEG)
        if not least <= angle_deg <= most:
            raise DeviceLimitError(
                f"{self._info.device}: {angle_deg:g} deg is outside of its limits, {least:g} to {most:g} deg; nothing has moved. Choose"
                " an angle within, or correct limits_deg in rig.toml."
            )

    def _check_speed(self, speed_deg_s: float) -> None:
        most = self._info.max_speed_deg_s
        if most is not None and abs(speed_deg_s) > most * (1 + 1e-9):
            raise DeviceLimitError(
                f"{self._info.device}: {speed_deg_s:g} deg/s is faster than the board allows, {most:g} deg/s ($11n). Choose a lower speed."
            )


def open_device(settings: Settings, clock: Clock, connections: Connections) -> GcodeTurntable:
    """The turntable, standing; see :mod:`rotaline.hardware.drivers`."""
    return GcodeTurntable(settings, open_board(settings, clock, connections), clock)


def find() -> tuple[FoundDevice, ...]:
    """The serial ports of USB devices; see :mod:`rotaline.hardware.drivers`."""
    from rotaline.hardware.gcode.connection import find_ports

    return find_ports(
        "turntable",
        'dialect = "grbl"        # or "grblhal", "marlin"\naxis = "X"\nunits_per_deg = 1.0\nspeed_deg_s = 20.0\nresolution_deg = 0.01\n'
        "u_angle_deg = 0.02\n",
    )
