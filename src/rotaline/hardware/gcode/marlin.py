"""Marlin: each line has a number and a checksum and is answered by ``ok``; ``M400`` is answered once nothing moves any more.

A line that arrived damaged is asked for again (``Resend: n``). While a long command works, ``echo:busy`` says that the board lives [1]_.
A move can only be ended by ``M410``, without deceleration, so that steps may be lost; and at once only with EMERGENCY_PARSER.

References
----------
.. [1] Marlin documentation, M110, M114, M115, M400, M410 and host keepalive, marlinfw.org
"""

import re

from rotaline.errors import DeviceConnectionError, DeviceError, DeviceStateError, DeviceTimeoutError
from rotaline.hardware.clock import Clock
from rotaline.hardware.gcode.connection import LinePort, Patience

_OK = re.compile(r"ok\b.*")
_RESEND = re.compile(r"(?:Resend|rs)[: ]+N?(\d+)", re.IGNORECASE)
_POSITION = re.compile(r"([A-Z]):\s*(-?\d+\.?\d*)")
_GREETING = re.compile(r"(?<![\w:])start$")
_UNKNOWN = re.compile(r'Unknown command: "(.*)"', re.IGNORECASE)
_DAMAGED = ("checksum", "line number", "last line")
_RESENDS = 3
_ATTEMPTS = 6


class MarlinBoard:
    """A board with Marlin 2."""

    can_jog = False
    decimals = 2

    def __init__(self, port: LinePort, clock: Clock, answer_s: float, start_s: float) -> None:
        """Wait until it answers and stands; mm and absolute positions from now on."""
        self.device = f"Marlin at {port.name}"
        self.lost: str | None = None
        self.n_resets = 0
        self._port = port
        self._clock = clock
        self._answer_s = answer_s
        self._number = 0
        self._owed = 0
        self.stops_at_once = self._greet(start_s)
        self._command("M400", start_s)
        self._command("G21")
        self._command("G90")

    def read(self, axis: str) -> float:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        for line in self._command("M114"):
            found = dict(_POSITION.findall(line.split("Count")[0]))
            if axis in found:
                return float(found[axis])
            if "X" in found:
                raise DeviceStateError(
                    f"{self.device}: it reports the axes {' '.join(found)}, none of them is {axis}. Correct 'axis' in rig.toml."
                )
        raise DeviceTimeoutError(f"{self.device}: M114 brought no position; {self._port.heard()}. Ask again.")

    def ready(self) -> None:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        self._drain()
        if self.lost is not None:
            raise DeviceStateError(f"{self.device}: not homed: {self.lost}. Home the table, then go on.")

    def move(self, axis: str, target: float, feed: float, timeout_s: float) -> float:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        self._command(f"G1 {axis}{target:.4f} F{feed:.2f}")
        self._command("M400", timeout_s)
        return self.read(axis)

    def run(self, axis: str, distance: float, feed: float) -> None:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        raise DeviceStateError(
            f"{self.device}: it cannot turn continuously: it says where a move will end, not where it is, and stops only by losing steps."
            " Step and shoot, or use GRBL or grblHAL."
        )

    def stop(self, timeout_s: float) -> None:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        if self._owed == 0:  # every move is waited for: nothing moves
            self._command("M400", timeout_s)
            return
        self.lost = self.lost or "it was stopped in the middle of a move, without deceleration, and may have lost steps"
        self._port.write(b"M410\n")
        self._owed += 1
        patience = Patience(self._clock, timeout_s)
        while self._owed > 0:
            line = self._port.read_line(patience)
            if line is None:
                why = (
                    ""
                    if self.stops_at_once
                    else " Its firmware has no EMERGENCY_PARSER: it stops only once its move is done."
                )
                raise DeviceTimeoutError(
                    f"{self.device}: it did not say within {timeout_s:g} s that it stands; {self._port.heard()}.{why} Take its power away"
                    " if it still turns."
                )
            self._take(line)

    def home(self, axis: str, timeout_s: float) -> float:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        patience = Patience(self._clock, timeout_s)
        self._command(f"G28 {axis}", timeout_s)
        self._command("M400", max(patience.left_s, self._answer_s))
        self.lost = None
        return self.read(axis)

    def unlock(self) -> None:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        self._command("M400")
        self.lost = None

    def max_feed(self, axis: str) -> float | None:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        return None

    def check_laser(self, device: str, full_s: float | None) -> None:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""

    def switch(self, line: str, off: bool) -> None:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        try:
            self._command(line)
            self._command("M400")  # outputs may wait for the planner
        except DeviceConnectionError:
            raise
        except DeviceError:
            if not off:
                raise
            self._command(line)  # a second time, after what disturbed the first
            self._command("M400")

    def close(self) -> None:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        self._port.close()

    # ------------------------------------------------------------------------------------------------------- what is said

    def _command(self, text: str, timeout_s: float | None = None) -> list[str]:
        """Send a line, again where it is asked for again, and wait for its ``ok``; returns the lines before it."""
        self._drain()
        self._number += 1
        wait_s = self._answer_s if timeout_s is None else timeout_s
        patience = Patience(self._clock, wait_s)
        self._say(text)
        data: list[str] = []
        resend = False
        resends = 0
        while (line := self._port.read_line(patience)) is not None:
            self._take(line)
            again = _RESEND.match(line)
            unknown = _UNKNOWN.search(line)
            if again is not None:
                resend, self._number = True, int(again[1])
            elif unknown is not None:
                self._drain()
                raise DeviceStateError(
                    f"{self.device}: the firmware does not know '{text}'. Build it with that feature, or choose another output."
                )
            elif _OK.fullmatch(line) and resend:
                resend = False
                resends += 1
                if resends > _RESENDS:
                    raise DeviceConnectionError(
                        f"{self.device}: '{text}' arrived damaged {resends} times. Use a shorter, shielded cable, away from motor cables."
                    )
                self._say(text)
            elif _OK.fullmatch(line):
                return data
            else:
                data.append(line)
                if not line.startswith(("echo:", "X:", "FIRMWARE", "Cap:", "Error:", "//")):
                    self._port.strange(line)
        raise DeviceTimeoutError(
            f"{self.device}: no answer to '{text}' within {wait_s:g} s; {self._port.heard()}. If it still worked, give it more time;"
            " else look at cable and baud rate."
        )

    def _say(self, text: str) -> None:
        body = f"N{self._number} {text}".encode("ascii")
        checksum = 0
        for byte in body:
            checksum ^= byte
        self._port.write(body + b"*%d\n" % checksum)
        self._owed += 1

    # ---------------------------------------------------------------------------------------------------- what comes unasked

    def _take(self, line: str) -> None:
        """Count answers; errors and resets raise."""
        if _OK.fullmatch(line):
            self._owed = max(0, self._owed - 1)
        elif _GREETING.search(line):
            self._owed = 0
            self._number = 0
            self.n_resets += 1
            self.lost = "it was reset (its 'start' came), so that the position is lost"
            raise DeviceStateError(
                f"{self.device}: {self.lost} and the outputs are off. Look at power supply and USB cable, then home the table."
            )
        elif line.startswith("Error:") and not any(word in line.lower() for word in _DAMAGED):
            self.lost = f"it said '{line}'"
            halted = " It has halted: switch it off and on." if "halt" in line.lower() or "kill" in line.lower() else ""
            raise DeviceStateError(
                f"{self.device}: {self.lost}.{halted} Put right what caused it, then home the table."
            )

    def _drain(self) -> None:
        """Read what came meanwhile; answers that are owed are waited for a moment, then given up."""
        while self._port.waiting() or self._owed > 0:
            line = self._port.read_line(Patience(self._clock, self._answer_s / 4))
            if line is None:
                self._owed = 0
                return
            try:
                self._take(line)
            except DeviceStateError:
                continue

    def _greet(self, start_s: float) -> bool:
        """Wait until it tells its name, and whether it has an emergency parser; what it says before is left from other programs."""
        emergency_parser = named = False
        for attempt in range(_ATTEMPTS):
            self._port.write(b"\nM110 N0\nM115\n")
            patience = Patience(self._clock, start_s / _ATTEMPTS)
            while (line := self._port.read_line(patience)) is not None:
                emergency_parser |= "Cap:EMERGENCY_PARSER:1" in line
                named |= line.startswith("FIRMWARE_NAME")
                if named and _OK.fullmatch(line):
                    self._owed = attempt  # answers to earlier attempts may follow: read until it is quiet
                    self._drain()
                    self._number, self._owed, self.lost, self.n_resets = 0, 0, None, 0
                    return emergency_parser
                if not named and not _OK.fullmatch(line):
                    self._port.strange(line)
        raise DeviceTimeoutError(
            f"{self.device}: no answer within {start_s:g} s after the port was opened; {self._port.heard()}. Are port, baud rate and"
            " dialect right, has the board power, and does it not move for another program still?"
        )
