"""The Standa 8SMC5 controller as its library libximc (below 3) knows it: commands, one snapshot of its state, and what its codes mean in words.

The library's ``highlevel`` binding raises on state bits that it does not know, which newer firmware sets; here its ``lowlevel`` structures are read.
Positions are whole microsteps, speeds microsteps/s. What is set here is lost when the controller is switched off; nothing is written to its memory.
"""

import ctypes
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from rotaline.errors import DeviceConnectionError, DeviceStateError

PACKAGE = "libximc<3"
MAX_STEPS = 2**31 - 1
"""The controller counts full steps in 32 bits."""
MAX_STEPS_S = 100_000
"""Speeds are up to so many full steps/s."""

_RUNNING, _COMMAND_FAILED = 0x80, 0x40
_MOVING, _TARGET_SPEED = 0x01, 0x02
_ALARM, _POSITION_LOST, _HOMED = 0x40, 0x80, 0x20
_FAULTS = {
    0x0000080: "steps and encoder disagree (position lost)",
    0x0000100: "the motor driver is too hot",
    0x0000200: "the controller is too hot",
    0x0000400: "the supply voltage is too high",
    0x0000800: "the supply current is too high",
    0x0001000: "the USB voltage is too high",
    0x0002000: "the USB voltage is too low",
    0x0004000: "the USB current is too high",
    0x0008000: "the limit switches are swapped or set wrongly",
    0x0010000: "the supply voltage is too low",
    0x0020000: "the H bridge has a fault (motor or its cable shorted)",
    0x0100000: "the windings differ in resistance",
    0x0200000: "the encoder has a fault",
    0x0800000: "the motor does not answer as it should",
    0x1000000: "the external input calls for alarm",
}
_POWER = {0: "unknown", 1: "off", 3: "normal", 4: "reduced", 5: "full"}
_BORDERS_ARE_POSITIONS, _STOP_LEFT, _STOP_RIGHT = 0x01, 0x02, 0x04
_STEPPER = 0x03
_LED_BY_ENCODER = (0x01, 0x06)  # then the controller counts in encoder counts, and speeds are in rpm
_ENCODER_STATES = {0: "absent", 1: "unknown", 2: "faulty", 3: "counting backwards", 4: "working"}
_RESULT_NO_DEVICE, _RESULT_VALUE, _RESULT_NOT_IMPLEMENTED, _RESULT_ERROR = -4, -3, -2, -1
_READS = 3
"""An answer that came damaged is asked for again."""
USB_IDS = ("1cbe", "0007")


@dataclass(frozen=True)
class Status:
    """What the controller said of itself at one moment.

    Attributes
    ----------
    at_rest : no command runs and the motor is not driven
    at_speed : the speed that was asked for has been reached
    failed : the last command ended with an error
    homed : its zero comes from a sensor
    position : microsteps
    speed : microsteps/s, signed
    encoder_counts : of the encoder beside the motor
    encoder : its state, in words
    faults : why it is in alarm, in words; empty: it is not
    power : of the motor, in words
    pressed : limit switches that are pressed: "left", "right"
    """

    at_rest: bool
    at_speed: bool
    failed: bool
    homed: bool
    position: int
    speed: int
    encoder_counts: int
    encoder: str
    faults: tuple[str, ...]
    power: str
    pressed: tuple[str, ...]


@dataclass(frozen=True)
class MotorSettings:
    """How the motor is driven: microsteps of a step, greatest speed and acceleration (None: at once) in full steps/s and steps/s^2."""

    microsteps: int
    max_steps_s: float
    steps_s: float
    steps_s2: float | None


def load_library() -> ModuleType:
    """The library's lowest binding.

    Raises
    ------
    ImportError, OSError
        If it is not there, or cannot be loaded on this machine.
    """
    try:
        import libximc.lowlevel as ximc
    except RuntimeError as error:  # so it calls a shared library that cannot be loaded
        raise OSError(str(error).splitlines()[0]) from error
    return ximc


class Controller:
    """A controller that is open; nobody else can open it. Calls on a dead line return after up to 8 s, with an error."""

    def __init__(self, ximc: ModuleType, uri: str) -> None:
        self._ximc = ximc
        self.device = f"Standa controller at {uri}"
        self._id: int | None = None
        identifier = ximc.lib.open_device(uri.encode())
        if identifier < 0:
            raise DeviceConnectionError(f"{self.device}: {_why_not_open(uri)}")
        self._id = identifier
        self.microsteps = 1
        try:
            self.microsteps = self.motor_settings().microsteps
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Let it go; may be called twice."""
        if self._id is not None:
            identifier, self._id = ctypes.c_int(self._id), None
            self._ximc.lib.close_device(ctypes.byref(identifier))

    def status(self) -> Status:
        """What it is doing now."""
        raw = self._get("status")
        faults = tuple(words for bit, words in _FAULTS.items() if raw.Flags & bit)
        in_alarm = raw.Flags & (_ALARM | _POSITION_LOST)
        return Status(
            at_rest=not (raw.MvCmdSts & _RUNNING or raw.MoveSts & _MOVING),
            at_speed=bool(raw.MoveSts & _TARGET_SPEED),
            failed=bool(raw.MvCmdSts & _COMMAND_FAILED),
            homed=bool(raw.Flags & _HOMED),
            position=raw.CurPosition * self.microsteps + raw.uCurPosition,
            speed=raw.CurSpeed * self.microsteps + raw.uCurSpeed,
            encoder_counts=raw.EncPosition,
            encoder=_ENCODER_STATES.get(raw.EncSts, f"in a state that is not known ({raw.EncSts})"),
            faults=(faults or ("no cause is given",)) if in_alarm else (),
            power=_POWER.get(raw.PWRSts, f"code {raw.PWRSts}"),
            pressed=tuple(name for bit, name in ((0x02, "left"), (0x01, "right")) if raw.GPIOFlags & bit),
        )

    def motor_settings(self) -> MotorSettings:
        """How the motor is driven.

        Raises
        ------
        DeviceStateError
            If it is no stepper motor that is counted in steps.
        """
        if self._get("entype_settings").EngineType != _STEPPER:
            raise DeviceStateError(
                f"{self.device}: it is set to another motor than a stepper. Load the profile of your stage in XILab."
            )
        if self._get("feedback_settings").FeedbackType in _LED_BY_ENCODER:
            raise DeviceStateError(
                f"{self.device}: its feedback is 'encoder', so it counts encoder counts instead of steps. Set the feedback to 'none' in "
                "XILab; the encoder is then read beside the steps (encoder_counts_per_deg)."
            )
        engine, move = self._get("engine_settings"), self._get("move_settings")
        microsteps = 1 << (max(engine.MicrostepMode, 1) - 1)
        return MotorSettings(
            microsteps=microsteps,
            max_steps_s=engine.NomSpeed + engine.uNomSpeed / microsteps,
            steps_s=move.Speed + move.uSpeed / microsteps,
            steps_s2=float(move.Accel) if engine.EngineFlags & 0x10 else None,
        )

    def borders(self) -> tuple[int | None, int | None]:
        """Least and most position at which the controller itself stops, microsteps; None: there is none."""
        raw = self._get("edges_settings")
        if not raw.BorderFlags & _BORDERS_ARE_POSITIONS:
            return None, None
        left = raw.LeftBorder * self.microsteps + raw.uLeftBorder if raw.BorderFlags & _STOP_LEFT else None
        right = raw.RightBorder * self.microsteps + raw.uRightBorder if raw.BorderFlags & _STOP_RIGHT else None
        return left, right

    def set_microsteps(self, microsteps: int) -> None:
        """Microsteps of a full step: 1, 2, 4 ... 256."""
        raw = self._get("engine_settings")
        raw.MicrostepMode = microsteps.bit_length()
        self._set("engine_settings", raw)
        self.microsteps = microsteps

    def set_speed(self, microsteps_s: int) -> None:
        """The speed of the next command."""
        raw = self._get("move_settings")
        raw.Speed, raw.uSpeed = divmod(microsteps_s, self.microsteps)
        self._set("move_settings", raw)

    def set_position_zero(self) -> None:
        """Call the present position 0, of steps and of the encoder."""
        self._do("command_zero")

    def move(self, position: int) -> None:
        """Begin to move to a position, microsteps."""
        steps, rest = divmod(abs(position), self.microsteps)
        sign = 1 if position >= 0 else -1
        self._do("command_move", sign * steps, sign * rest)

    def turn(self, *, right: bool) -> None:
        """Begin to move without end; to the right positions grow."""
        self._do("command_right" if right else "command_left")

    def home(self) -> None:
        """Begin to look for the sensor, as it is set in the controller."""
        self._do("command_home")

    def stop_softly(self) -> None:
        """Begin to slow down."""
        self._do("command_sstp")

    def stop_at_once(self) -> None:
        """Stop without slowing down, and leave the alarm state if its cause is gone."""
        self._do("command_stop")

    def _get(self, what: str) -> Any:
        raw = getattr(self._ximc, f"{what}_t")()
        result = _RESULT_ERROR
        for _ in range(_READS):
            result = self._call(f"get_{what}", ctypes.byref(raw))
            if result != _RESULT_ERROR:
                break
        self._check(f"get_{what}", result)
        return raw

    def _set(self, what: str, raw: Any) -> None:
        self._check(f"set_{what}", self._call(f"set_{what}", ctypes.byref(raw)))

    def _do(self, command: str, *values: int) -> None:
        self._check(command, self._call(command, *values))

    def _call(self, name: str, *values: Any) -> int:
        if self._id is None:
            raise DeviceStateError(f"{self.device}: it has been closed. Open the rig again.")
        function: Callable[..., int] = getattr(self._ximc.lib, name)
        return function(self._id, *values)

    def _check(self, command: str, result: int) -> None:
        if result == 0:
            return
        if result == _RESULT_VALUE:
            raise DeviceStateError(
                f"{self.device}: it refused the values of {command}. Check the stage's profile in XILab."
            )
        if result == _RESULT_NOT_IMPLEMENTED:
            raise DeviceStateError(
                f"{self.device}: its firmware does not know {command}. Update the firmware in XILab."
            )
        found = "it is gone or does not answer" if result == _RESULT_NO_DEVICE else "its answer cannot be understood"
        raise DeviceConnectionError(
            f"{self.device}: {command}: {found}. Check its power and cable, and that the port is that of an 8SMC5, then open the rig again."
        )


def _why_not_open(uri: str) -> str:
    """The library says only that it could not."""
    kind, _, place = uri.partition(":")
    if kind not in ("xi-com", "xi-emu", "xi-tcp", "xi-udp", "xi-net"):
        return "this is no address of a controller. Expected e.g. xi-com:/dev/ttyACM0, xi-com:\\\\.\\COM3 or xi-tcp://192.168.0.2:1820."
    if kind == "xi-emu":
        return "the file of the virtual controller cannot be made. Its folder must exist and be writable."
    if kind != "xi-com":
        return "nothing answers at this address. Check that controller and network are on, address and port."
    if sys.platform == "win32":
        return "it cannot be opened. Check that it is connected and on, and that no other program (XILab) uses it."
    port = Path(place)
    if not port.exists():
        return "there is no such port. Check that the controller is connected and on; rotaline devices lists what is there."
    if not os.access(port, os.R_OK | os.W_OK):
        return "this user may not use the port. Add the user to the group 'dialout', log in again."
    if _is_locked(port):
        return "another program holds it. Close that program (XILab, a second rotaline), then try again."
    return "it cannot be opened as a serial port."


def _is_locked(port: Path) -> bool:
    """Whether another program has locked a serial port, as the library does."""
    import fcntl

    try:
        descriptor = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(descriptor)
    return False


def connected_uris(ximc: ModuleType) -> tuple[str, ...]:
    """Addresses of controllers at the USB ports. Ports are not asked, since that may disturb other devices; USB ids tell them apart (Linux)."""
    listing = ximc.lib.enumerate_devices(0, b"")
    try:
        count = ximc.lib.get_device_count(listing)
        uris = [ximc.lib.get_device_name(listing, i).decode() for i in range(count)]
    finally:
        ximc.lib.free_enumerate_devices(listing)
    return tuple(uri for uri in uris if _may_be_standa(Path(uri.partition(":")[2])))


def _may_be_standa(port: Path, listing: Path = Path("/sys/class/tty")) -> bool:
    if not listing.is_dir():
        return True
    usb = listing / port.resolve().name / "device" / ".."
    try:
        ids = tuple((usb / name).read_text().strip() for name in ("idVendor", "idProduct"))
    except OSError:
        return True
    return ids == USB_IDS
