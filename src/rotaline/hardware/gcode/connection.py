"""A serial port that carries lines of text: whole lines out, whole lines in, and a time-out for everything."""

from typing import Any

from rotaline.errors import DeviceConnectionError, DeviceTimeoutError
from rotaline.hardware.clock import Clock
from rotaline.hardware.drivers import FoundDevice, Kind, missing_library

SLICE_S = 0.02
"""So long one attempt to read waits."""

POLL_S = 0.05
"""A board that moves is asked so often whether it still does."""

LONGEST_LINE = 1024
"""More bytes without an end of line are noise."""

_N_REMEMBERED = 4


class Patience:
    """The time that is left, by the clock, or by what was waited in vain: reading takes real time even where the clock stands."""

    def __init__(self, clock: Clock, seconds: float) -> None:
        self._clock = clock
        self._seconds = seconds
        self._begin_s = clock.now_s()
        self._waited_s = 0.0

    def waited(self, seconds: float) -> None:
        """Time went by in vain."""
        self._waited_s += seconds

    @property
    def left_s(self) -> float:
        """What is left; none: 0 or less."""
        return self._seconds - max(self._clock.now_s() - self._begin_s, self._waited_s)


class LinePort:
    """A serial port that is open, and held by this program alone."""

    def __init__(self, port: str, baud: int, clock: Clock) -> None:
        """Open it.

        Raises
        ------
        DeviceConnectionError
            If it is not there, may not be used, is held by another program, or pyserial is missing.
        """
        self.name = port
        self._clock = clock
        self._buffer = b""
        self._gone: str | None = None
        self._strange: list[str] = []
        serial = _pyserial(port)
        try:
            self._serial: Any = serial.Serial(port, baud, timeout=SLICE_S, write_timeout=2.0, exclusive=True)
        except (OSError, ValueError) as error:  # SerialException is an OSError
            raise DeviceConnectionError(_cannot_open(port, error)) from error

    def write(self, data: bytes) -> None:
        """Send bytes.

        Raises
        ------
        DeviceConnectionError
            If the port is gone.
        DeviceTimeoutError
            If it takes nothing for 2 s.
        """
        self._check()
        try:
            self._serial.write(data)
        except OSError as error:
            if "timeout" in type(error).__name__.lower():
                raise DeviceTimeoutError(
                    f"{self.name}: the port took nothing for 2 s. Unplug the board and plug it in again."
                ) from error
            raise self._lost(error) from error

    def read_line(self, patience: Patience) -> str | None:
        """The next line without its end; None: none came in time. A half line waits for its other half.

        Raises
        ------
        DeviceConnectionError
            If the port is gone.
        """
        while patience.left_s > 0:
            line, end, rest = self._buffer.partition(b"\n")
            if end:
                self._buffer = rest
                return line.decode("ascii", "backslashreplace").strip()
            if len(self._buffer) > LONGEST_LINE:
                self.strange(self._buffer.decode("ascii", "backslashreplace"))
                self._buffer = b""
            self._check()
            try:
                came = self._serial.read(max(1, self._serial.in_waiting))
            except (OSError, TypeError) as error:  # pyserial has no descriptor any more: TypeError
                raise self._lost(error) from error
            self._buffer += came
            if not came:
                patience.waited(SLICE_S)
        return None

    def waiting(self) -> bool:
        """Whether there are bytes that nobody has read."""
        self._check()
        try:
            return b"\n" in self._buffer or self._serial.in_waiting > 0
        except (OSError, TypeError) as error:
            raise self._lost(error) from error

    def strange(self, line: str) -> None:
        """Remember a line that nobody understands, for messages."""
        self._strange = [*self._strange, line[:60]][-_N_REMEMBERED:]

    def heard(self) -> str:
        """What came that nobody understood, as the end of a sentence."""
        pending = self._buffer.decode("ascii", "backslashreplace")[:60]
        what = [*self._strange, *([f"{pending} (half a line)"] if pending else [])]
        return (
            "nothing came" if not what else "what came was not understood: " + ", ".join(f"'{line}'" for line in what)
        )

    def close(self) -> None:
        """Let the port go; never raises, and may be called twice."""
        self._gone = self._gone or "it has been closed"
        try:
            self._serial.close()
        except Exception:
            return

    def _check(self) -> None:
        if self._gone is not None:
            raise DeviceConnectionError(f"{self.name}: the port is gone ({self._gone}).")

    def _lost(self, error: Exception) -> DeviceConnectionError:
        self._gone = str(error)
        return DeviceConnectionError(
            f"{self.name}: the port is gone ({error}). What the board drives stays as it is: take its power away if the laser is on"
            " or the table turns. Then mend cable and plug, and start again."
        )


def find_ports(kind: Kind, lines: str) -> tuple[FoundDevice, ...]:
    """The serial ports of USB devices. Which firmware answers there is not tried: opening a port resets many boards.

    Raises
    ------
    DeviceConnectionError
        If pyserial is missing.
    """
    _pyserial("serial ports")
    from serial.tools import list_ports

    ports = [port for port in list_ports.comports() if port.vid is not None]
    return tuple(
        FoundDevice(
            kind,
            "gcode",
            f"{port.device}: {port.description} (a serial port; its firmware has not been asked)",
            f'[{kind}]\ndriver = "gcode"\nport = "{port.device}"\n{lines}',
        )
        for port in ports
    )


def _pyserial(device: str) -> Any:
    try:
        import serial
    except ImportError as error:
        raise missing_library(device, "pyserial", "serial", error) from error
    return serial


def _cannot_open(port: str, error: Exception) -> str:
    text = str(error)
    if "exclusively lock" in text or "Access is denied" in text or "busy" in text.lower():
        return f"{port}: another program holds this port ({text}). End it (a G-code sender, a serial monitor), then start again."
    if "ermission" in text:
        return f"{port}: this user may not open the port ({text}). On Linux join the group of the port, mostly 'dialout', and log in again."
    return f"{port}: the port cannot be opened ({text}). Is the board plugged in? 'rotaline devices' lists the ports that there are."
