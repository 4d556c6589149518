"""Rotation stages on a Standa 8SMC5 controller (USB, or an 8SMC5 on the network), through the maker's library libximc below 3.

The controller counts steps; an encoder beside the motor is read where rig.toml says how it counts. The stage's own settings (currents,
acceleration, homing, limit switches) are those of its profile, which XILab loads into the controller; they are read here, not changed.
"""

import contextlib
import math
from collections.abc import Callable, Iterator
from typing import Annotated, Literal

from pydantic import Strict

from rotaline.errors import DeviceError, DeviceLimitError, DeviceStateError, DeviceTimeoutError
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import FoundDevice, missing_library
from rotaline.hardware.turntable import TurntableInfo
from rotaline.hardware.turntables.standa_controller import (
    MAX_STEPS,
    MAX_STEPS_S,
    PACKAGE,
    Controller,
    Status,
    connected_uris,
    load_library,
)
from rotaline.tables import NotNegative, Number, Positive, Table, key

POLL_S = 0.005
_BEGINS_S = 0.1
"""A command shows in the controller's state at the latest so long after it was given."""
_STOPS_S = 5.0
_LOST = "It may have lost steps: home it by its sensor, or begin anew what was measured with it."


class Settings(Table):
    """A table ``[turntable]`` of rig.toml with ``driver = "standa"``."""

    driver: Literal["standa"] = key("standa", "which driver")
    uri: str = key(
        ..., "address of the controller: xi-com:/dev/ttyACM0, xi-com:\\\\.\\COM3, xi-tcp://HOST:1820, xi-emu:///FILE"
    )
    steps_per_deg: Number = key(
        ..., "full steps of the motor for one degree of the table; negative: angles grow against the steps, steps/deg"
    )
    u_angle_deg: NotNegative = key(..., "standard uncertainty of an angle, from the stage's data sheet, deg")
    microsteps: Literal[1, 2, 4, 8, 16, 32, 64, 128, 256] | None = key(
        None, "microsteps of a full step; absent: as set in the controller"
    )
    encoder_counts_per_deg: Number | None = key(
        None, "counts of the stage's encoder for one degree, signed; absent: no encoder is read, counts/deg"
    )
    limits_deg: Annotated[tuple[Number, Number], Strict(False)] | None = key(
        None, "least and most angle, deg; absent: those of the controller (borders by position), or none"
    )
    speed_deg_s: Positive | None = key(None, "speed of moves, deg/s; absent: as set in the controller")
    home: Literal["count", "sensor", "here"] = key(
        "count",
        "what home does: count: go to 0 of the controller's own count, which outlives this program; "
        "sensor: homing as set in the controller, 0 is where that ends; here: call the present place 0",
    )


class StandaTurntable:
    """A rotation stage; see :class:`rotaline.hardware.turntable.Turntable`."""

    def __init__(self, controller: Controller, settings: Settings, clock: Clock) -> None:
        self._controller = controller
        self._clock = clock
        self._settings = settings
        self._closed = False
        if settings.steps_per_deg == 0 or settings.encoder_counts_per_deg == 0:
            raise DeviceLimitError(
                f"{controller.device}: steps_per_deg and encoder_counts_per_deg cannot be 0. Correct rig.toml."
            )
        self._per_deg = settings.steps_per_deg * controller.microsteps
        self._begin_standing()
        if settings.microsteps is not None and settings.microsteps != controller.microsteps:
            controller.set_microsteps(settings.microsteps)
            self._per_deg = settings.steps_per_deg * controller.microsteps
        motor = controller.motor_settings()
        self._accel = motor.steps_s2
        fastest = min(motor.max_steps_s, MAX_STEPS_S) / abs(settings.steps_per_deg)
        self._own_speed = self._speed = round(motor.steps_s * controller.microsteps)
        self.info = TurntableInfo(
            controller.device,
            self._limits(),
            resolution_deg=1 / abs(self._per_deg),
            u_angle_deg=settings.u_angle_deg,
            max_speed_deg_s=fastest,
            encoder=settings.encoder_counts_per_deg is not None,
            has_reference=settings.home == "sensor",
        )
        self._move_speed = self._own_speed
        if settings.speed_deg_s is not None:
            self._move_speed = self._microsteps_s(settings.speed_deg_s)
        if self._move_speed == 0:
            raise DeviceStateError(
                f"{controller.device}: its speed is set to 0. State speed_deg_s in rig.toml, or load the stage's profile in XILab."
            )

    def home(self, timeout_s: float) -> None:
        """Find the angle 0, as the setting ``home`` says."""
        status = self._ready().status()
        if not status.at_rest:
            self.stop(timeout_s)
        match self._settings.home:
            case "count":
                self.move_to(0.0, timeout_s)
            case "here":
                self._controller.set_position_zero()
            case "sensor":
                self._refuse_alarm(status, "homing")
                with self._stopped_on_failure():
                    self._controller.home()
                    begun = self._clock.now_s()
                    status = self._until(lambda s: s.at_rest and (s.homed or self._since(begun)), timeout_s, "homing")
                    if status.failed:
                        raise DeviceStateError(
                            self._text(
                                status, "homing ended without finding its sensor", "Check the homing settings in XILab."
                            )
                        )
                    self._controller.set_position_zero()

    def move_to(self, angle_deg: float, timeout_s: float) -> float:
        """Turn to an angle."""
        status = self._ready().status()
        target = self._target(angle_deg)
        doing = f"the move to {angle_deg:g} deg"
        self._refuse_alarm(status, doing)
        with self._stopped_on_failure():
            self._set_speed(self._move_speed)
            self._controller.move(target)
            begun = self._clock.now_s()
            status = self._until(lambda s: s.at_rest and (s.position == target or self._since(begun)), timeout_s, doing)
            if status.failed or abs(status.position - target) > self._controller.microsteps:
                raise DeviceStateError(
                    self._text(status, f"{doing} ended early", f"Look for what is in its way. {_LOST}")
                )
        return self._angle(status)

    def angle_deg(self) -> float:
        """The angle now, by the encoder where there is one."""
        return self._angle(self._ready().status())

    def turn(self, speed_deg_s: float) -> None:
        """Turn without end, or up to the limit."""
        status = self._ready().status()
        speed = self._microsteps_s(speed_deg_s)
        right = (speed_deg_s > 0) == (self._per_deg > 0)
        low, high = self.info.limits_deg or (-math.inf, math.inf)
        end = high if speed_deg_s > 0 else low
        until = None if math.isinf(end) else self._target(end)
        doing = f"turning at {speed_deg_s:g} deg/s"
        self._refuse_alarm(status, doing)
        start = status.position
        with self._stopped_on_failure():
            self._set_speed(speed)
            if until is None:
                self._controller.turn(right=right)
            else:
                self._controller.move(until)
            begun = self._clock.now_s()

            def turns(now: Status) -> bool:
                as_asked = now.at_speed or abs(abs(now.speed) - speed) <= max(0.02 * speed, 1)
                if now.at_rest:
                    return self._since(begun)
                return as_asked and (now.position - start) * (1 if right else -1) > 0

            ramp_s = 0.0 if self._accel is None else speed / self._controller.microsteps / self._accel
            status = self._until(turns, _STOPS_S + 2 * ramp_s, doing)
            if status.at_rest and (until is None or abs(status.position - until) > self._controller.microsteps):
                raise DeviceStateError(self._text(status, f"{doing}: it stands", "Look for what is in its way."))

    def stop(self, timeout_s: float) -> None:
        """Slow down and stop."""
        controller = self._ready()
        controller.stop_softly()
        try:
            self._until(lambda s: s.at_rest, timeout_s, "stopping", alarm=False)
        except DeviceTimeoutError as error:
            controller.stop_at_once()
            raise DeviceTimeoutError(f"{error} It was then stopped at once. {_LOST}") from error

    def close(self) -> None:
        """Stop, give the controller its own speed back, let it go."""
        if self._closed:
            return
        with contextlib.suppress(Exception):
            self.stop(_STOPS_S)
            self._set_speed(self._own_speed)
        with contextlib.suppress(Exception):
            self._controller.close()
        self._closed = True

    def _ready(self) -> Controller:
        if self._closed:
            raise DeviceStateError(f"{self.info.device}: it has been closed. Open the rig again.")
        return self._controller

    def _begin_standing(self) -> None:
        """Stop what a program before may have begun; a stop at once also ends an alarm whose cause is gone."""
        status = self._controller.status()
        if not status.at_rest:
            self._controller.stop_softly()
            status = self._until(lambda s: s.at_rest, _STOPS_S, "stopping", alarm=False)
        if status.faults:
            self._controller.stop_at_once()
            status = self._controller.status()
        self._refuse_alarm(status, "opening")
        if self._settings.encoder_counts_per_deg is not None and status.encoder in ("absent", "faulty"):
            raise DeviceStateError(
                f"{self._controller.device}: its encoder is {status.encoder}. Check the encoder's cable and its settings in XILab, or remove "
                "encoder_counts_per_deg from rig.toml."
            )

    def _limits(self) -> tuple[float, float] | None:
        """What rig.toml and the controller both allow."""
        low, high = self._settings.limits_deg or (-math.inf, math.inf)
        left, right = self._controller.borders()
        borders = (
            -math.inf if left is None else left / abs(self._per_deg),
            math.inf if right is None else right / abs(self._per_deg),
        )
        least, most = borders if self._per_deg > 0 else (-borders[1], -borders[0])
        if not max(low, least) < min(high, most):
            raise DeviceLimitError(
                f"{self._controller.device}: limits_deg, {low:g} to {high:g} deg, and the controller's own borders, {least:g} to {most:g} deg, "
                "leave no angle. Correct limits_deg (least, most), or the borders in XILab."
            )
        low, high = max(low, least), min(high, most)
        return None if math.isinf(low) and math.isinf(high) else (low, high)

    def _target(self, angle_deg: float) -> int:
        """Microsteps."""
        low, high = self.info.limits_deg or (-math.inf, math.inf)
        widest = MAX_STEPS / abs(self._settings.steps_per_deg)
        low, high = max(low, -widest), min(high, widest)
        if not low <= angle_deg <= high:
            raise DeviceLimitError(
                f"{self.info.device}: the angle {angle_deg:g} deg is outside its limits, {low:g} to {high:g} deg. Nothing has moved. "
                "Change the plan, or limits_deg in rig.toml if the table can really turn so far."
            )
        return round(angle_deg * self._per_deg)

    def _microsteps_s(self, speed_deg_s: float) -> int:
        fastest = self.info.max_speed_deg_s or 0.0
        slowest = self.info.resolution_deg
        if not slowest <= abs(speed_deg_s) <= fastest:
            raise DeviceLimitError(
                f"{self.info.device}: the speed {speed_deg_s:g} deg/s is outside its limits, {slowest:.3g} to {fastest:g} deg/s in either sense. "
                "Nothing has moved. Choose another speed, or set the motor's nominal speed in XILab."
            )
        return round(abs(speed_deg_s * self._per_deg))

    def _set_speed(self, microsteps_s: int) -> None:
        if microsteps_s != self._speed:
            self._controller.set_speed(microsteps_s)
            self._speed = microsteps_s

    def _angle(self, status: Status) -> float:
        if self._settings.encoder_counts_per_deg is not None:
            return status.encoder_counts / self._settings.encoder_counts_per_deg
        return status.position / self._per_deg

    def _since(self, begun_s: float) -> bool:
        return self._clock.now_s() >= begun_s + _BEGINS_S

    def _until(self, done: Callable[[Status], bool], timeout_s: float, doing: str, *, alarm: bool = True) -> Status:
        end = self._clock.now_s() + timeout_s
        while True:
            status = self._controller.status()
            if alarm:
                self._refuse_alarm(status, doing)
            if done(status):
                return status
            if self._clock.now_s() >= end:
                raise DeviceTimeoutError(
                    self._text(
                        status, f"{doing} was not done within {timeout_s:g} s", "Allow more time, or raise its speed."
                    )
                )
            self._clock.wait(POLL_S)

    def _refuse_alarm(self, status: Status, doing: str) -> None:
        if status.faults:
            raise DeviceStateError(
                f"{self._controller.device}: {doing}: the controller is in alarm: {', '.join(status.faults)}. Mend the cause and open the rig again, "
                f"which clears the alarm. {_LOST}"
            )

    def _text(self, status: Status, what: str, then: str) -> str:
        pressed = f", limit switch pressed: {' and '.join(status.pressed)}" if status.pressed else ""
        turning = "stands" if status.at_rest else "turns"
        return f"{self._controller.device}: {what}: it {turning} at {self._angle(status):g} deg, motor power {status.power}{pressed}. {then}"

    @contextlib.contextmanager
    def _stopped_on_failure(self) -> Iterator[None]:
        try:
            yield
        except BaseException:
            try:
                self._controller.stop_softly()
            except DeviceError:
                with contextlib.suppress(DeviceError):
                    self._controller.stop_at_once()
            raise


def open_device(settings: Settings, clock: Clock, connections: Connections) -> StandaTurntable:
    """Open the stage; it stands. Raises as :func:`rotaline.hardware.drivers.open_turntable`."""
    try:
        ximc = load_library()
    except (ImportError, OSError) as error:
        raise missing_library("Standa turntable", PACKAGE, "standa", error) from error
    controller = Controller(ximc, settings.uri)
    try:
        return StandaTurntable(controller, settings, clock)
    except BaseException:
        controller.close()
        raise


def find() -> tuple[FoundDevice, ...]:
    """Controllers at the USB ports."""
    try:
        ximc = load_library()
    except (ImportError, OSError) as error:
        raise missing_library("Standa turntables", PACKAGE, "standa", error) from error
    return tuple(
        FoundDevice(
            "turntable",
            "standa",
            f"Standa controller at {uri}",
            f"[turntable]\ndriver = \"standa\"\nuri = '{uri}'\nsteps_per_deg = 100.0  # of your stage\nu_angle_deg = 0.01  # of your stage\n",
        )
        for uri in connected_uris(ximc)
    )
