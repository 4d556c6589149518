"""The turntable of the simulated rig: it speeds up, turns and slows down by the clock."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Annotated, Literal

from pydantic import Strict

from rotaline.errors import DeviceConnectionError, DeviceLimitError, DeviceStateError, DeviceTimeoutError
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import FoundDevice
from rotaline.hardware.simulated.trajectory import Piece, braking, change_of_speed, move
from rotaline.hardware.simulated.world import SimulatedWorld, world_of
from rotaline.hardware.turntable import TurntableInfo
from rotaline.tables import Number, Positive, Table, key

_DEVICE = "simulated turntable"
_RESOLUTION_DEG = 1e-6
"""Of the angles in a session's files."""


class Settings(Table):
    """The turntable of the simulated rig; its errors are those of the rig that is simulated."""

    driver: Literal["simulated"] = key(..., "simulated")
    speed_deg_s: Positive = key(30.0, "of moves, and the most for turning continuously, deg/s")
    acceleration_deg_s2: Positive = key(120.0, "while it speeds up and slows down, deg/s^2")
    limits_deg: Annotated[tuple[Number, Number], Strict(False)] | None = key(
        None, "least and largest angle, deg; absent: it turns without end"
    )


class SimulatedTurntable:
    """See :class:`rotaline.hardware.turntable.Turntable`. A move while it turns begins with a stop."""

    def __init__(self, settings: Settings, clock: Clock, world: SimulatedWorld) -> None:
        limits = settings.limits_deg
        if limits is not None and not limits[0] < limits[1]:
            raise DeviceLimitError(
                f"{_DEVICE}: limits_deg is {list(limits)} deg, expected the least angle and then a larger one. Correct rig.toml."
            )
        world.claim(_DEVICE)
        self._settings, self._clock, self._world = settings, clock, world
        self._open, self._gone, self._alarm = True, False, False
        errors = world.rig.mechanics
        self.info = TurntableInfo(
            _DEVICE,
            limits,
            resolution_deg=_RESOLUTION_DEG,
            u_angle_deg=math.hypot(errors.angle_noise_deg, errors.angle_eccentricity_deg / math.sqrt(2.0)),
            max_speed_deg_s=settings.speed_deg_s,
            encoder=True,
        )

    def home(self, timeout_s: float) -> None:
        """Turn to the angle 0, without limits to the nearest mark of a whole turn; ends an alarm."""
        self._require_there()
        self._alarm = False
        mark = 0.0 if self.info.limits_deg else 360.0 * round(self._angle_and_speed()[0] / 360.0)
        self._go(mark, timeout_s)
        if mark != 0.0:
            self._world.turn_table(self._world.rest(self._clock.now_s(), 0.0))

    def move_to(self, angle_deg: float, timeout_s: float) -> float:
        """Turn to an angle, and return it, deg, rounded to 1e-6."""
        self._require_there()
        self._require_within(angle_deg)
        if self._alarm:
            raise DeviceStateError(f"{_DEVICE}: it is in alarm and does not move to {angle_deg:g} deg. Home it first.")
        target_deg = round(angle_deg, 6)
        self._go(target_deg, timeout_s)
        return target_deg

    def angle_deg(self) -> float:
        """The angle that is read out now; the table's own errors are not in it."""
        self._require_there()
        return round(self._angle_and_speed()[0], 6)

    def turn(self, speed_deg_s: float) -> None:
        """Turn on at a speed, which has been reached when this returns; at a limit it slows down and stands."""
        self._require_there()
        most = self._settings.speed_deg_s
        if not abs(speed_deg_s) <= most:
            raise DeviceLimitError(
                f"{_DEVICE}: {speed_deg_s:g} deg/s is too fast, it turns at up to {most:g} deg/s. Choose a lower speed."
            )
        if self._alarm:
            raise DeviceStateError(f"{_DEVICE}: it is in alarm and does not turn. Home it first.")
        if speed_deg_s == 0.0:
            self._brake()
            return
        angle, speed = self._angle_and_speed()
        start_s, acceleration = self._clock.now_s(), self._settings.acceleration_deg_s2
        faster, even = change_of_speed(start_s, angle, speed, speed_deg_s, acceleration)
        pieces = [faster, even]
        if self.info.limits_deg is not None:
            limit = self.info.limits_deg[1 if speed_deg_s > 0 else 0]
            brake_deg = math.copysign(speed_deg_s**2 / (2 * acceleration), speed_deg_s)
            even_s = (limit - brake_deg - even.angle_deg) / speed_deg_s
            if even_s < 0:
                raise DeviceLimitError(
                    f"{_DEVICE}: from {angle:g} deg it cannot reach {speed_deg_s:g} deg/s before its limit of {limit:g} deg. "
                    "Begin farther away from the limit, or turn more slowly."
                )
            brake, brake_s = braking(even.start_s + even_s, limit - brake_deg, speed_deg_s, acceleration)
            pieces += [brake, self._world.rest(brake.start_s + brake_s, limit)]
        with self._stopped_on_failure():
            self._world.turn_table(*pieces)
            self._clock.wait(even.start_s - start_s)

    def stop(self, timeout_s: float) -> None:
        """Slow down and stand."""
        self._require_there()
        needed_s = abs(self._angle_and_speed()[1]) / self._settings.acceleration_deg_s2
        self._brake()
        if needed_s > timeout_s:
            raise DeviceTimeoutError(
                f"{_DEVICE}: it took {needed_s:.3g} s to stop, longer than the {timeout_s:g} s that it was given. It stands now; "
                "give it more time."
            )

    def close(self) -> None:
        """Stop, and let it go."""
        if self._open:
            self._brake()
            # only now: where this was interrupted, it can be closed again
            self._open = False
            self._world.release(_DEVICE)

    def _require_there(self) -> None:
        if not self._open:
            raise DeviceStateError(f"{_DEVICE}: it has been closed. Open it again.")
        if self._gone:
            raise self._unplugged()

    def _unplugged(self) -> DeviceConnectionError:
        return DeviceConnectionError(f"{_DEVICE}: it is gone. Plug it in, and open it again.")

    def _require_within(self, angle_deg: float) -> None:
        if not math.isfinite(angle_deg):
            raise DeviceLimitError(f"{_DEVICE}: {angle_deg} deg is no angle; nothing was moved. Give a number.")
        limits = self.info.limits_deg
        if limits is not None and not limits[0] <= angle_deg <= limits[1]:
            raise DeviceLimitError(
                f"{_DEVICE}: {angle_deg:g} deg is outside its limits of {limits[0]:g} to {limits[1]:g} deg; nothing was moved. "
                "Change the plan, or limits_deg in rig.toml."
            )

    def _angle_and_speed(self) -> tuple[float, float]:
        return self._world.table_at(self._clock.now_s())

    def _run(self, *pieces: Piece) -> None:
        """Turn until the last of the pieces begins."""
        self._world.turn_table(*pieces)
        self._clock.wait(pieces[-1].start_s - self._clock.now_s())
        # the time that has gone by may be a rounding error short of it
        self._world.turn_table(replace(pieces[-1], start_s=self._clock.now_s()))

    def _brake(self) -> None:
        if self._world.table_stands():
            return
        angle, speed = self._angle_and_speed()
        piece, duration_s = braking(self._clock.now_s(), angle, speed, self._settings.acceleration_deg_s2)
        end_s = piece.start_s + duration_s
        self._run(piece, self._world.rest(end_s, piece.angle_at(end_s)))

    @contextmanager
    def _stopped_on_failure(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            self._brake()
            raise

    def _go(self, to_deg: float, timeout_s: float) -> None:
        self._brake()
        number, faults = self._world.count("moves"), self._world.faults
        gone, alarm = number in faults.turntable_gone_at_moves, number in faults.alarm_at_moves
        stalled = number in faults.stalled_moves
        angle, start_s = self._angle_and_speed()[0], self._clock.now_s()
        goal_deg = (angle + to_deg) / 2 if gone or alarm or stalled else to_deg
        pieces, needed_s = move(
            start_s, angle, goal_deg, self._settings.speed_deg_s, self._settings.acceleration_deg_s2
        )
        if not (pieces or gone or alarm or stalled):
            return
        with self._stopped_on_failure():
            if needed_s > timeout_s or stalled:
                self._world.turn_table(*pieces, self._world.rest(start_s + needed_s, goal_deg))
                self._clock.wait(timeout_s)
                raise DeviceTimeoutError(
                    f"{_DEVICE}: after {timeout_s:g} s it is at {self._angle_and_speed()[0]:.3f} deg and has not reached {to_deg:g} deg. "
                    "It was told to stop. See what holds it, or give it more time."
                )
            self._run(*pieces, self._world.rest(start_s + needed_s, goal_deg))
        if gone:
            self._gone = True
            raise self._unplugged()
        if alarm:
            self._alarm = True
            raise DeviceStateError(
                f"{_DEVICE}: alarm at {goal_deg:.3f} deg on the way to {to_deg:g} deg; it stands. See what holds it, then home it."
            )


def open_device(settings: Settings, clock: Clock, connections: Connections) -> SimulatedTurntable:
    """The turntable of the world that is provided as "world"."""
    return SimulatedTurntable(settings, clock, world_of(_DEVICE, clock, connections))


def find() -> tuple[FoundDevice, ...]:
    """It is always there."""
    return (FoundDevice("turntable", "simulated", _DEVICE, '[turntable]\ndriver = "simulated"\n'),)
