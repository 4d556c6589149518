"""GRBL 1.1 and grblHAL: moves are jogs, which can be cancelled without losing the position; `?` says whether the board is at rest.

The protocol: a line is answered by ``ok`` or ``error:n``; ``?`` is answered by a report ``<State|MPos:...|FS:...>`` at any time but in
a homing cycle; ``ALARM:n`` and the greeting after a reset come unasked [1]_.

References
----------
.. [1] Grbl v1.1 Interface, Jogging and Realtime commands, github.com/gnea/grbl/wiki
"""

import re
from typing import Literal

from rotaline.errors import DeviceConnectionError, DeviceError, DeviceLimitError, DeviceStateError, DeviceTimeoutError
from rotaline.hardware.clock import Clock
from rotaline.hardware.gcode.codes import STATES, alarm_words, error_words
from rotaline.hardware.gcode.connection import POLL_S, LinePort, Patience
from rotaline.hardware.gcode.grbl_report import Report, parse_report

AXES = "XYZABCUV"

RESET = b"\x18"
CANCEL_JOG = b"\x85"
FEED_HOLD = b"!"
ASK = b"?"

_GREETING = re.compile(r"Grbl(HAL)? \d", re.IGNORECASE)
_ALARM = re.compile(r"ALARM:(\d+)")
_ERROR = re.compile(r"error:(\d+)")
_SETTING = re.compile(r"\$(\d+)=(-?[\d.]+)")
_CRITICAL_ALARMS = (1, 2, 10)
_ATTEMPTS = 4
_FIRST_WORDS = (ASK, ASK, ASK, ASK, RESET, ASK)  # a board that is mute may have been halted by an alarm
_REACHED = 0.99
_GRACE_S = 0.5
_NEAR = 0.002  # units: reports are rounded to 0.001


class _RefusedError(DeviceStateError):
    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class GrblBoard:
    """A board with GRBL or grblHAL."""

    can_jog = True
    decimals = 3

    def __init__(
        self, port: LinePort, clock: Clock, answer_s: float, start_s: float, dialect: Literal["grbl", "grblhal"]
    ) -> None:
        """Wait until it answers, stop it if it moves, and read its settings."""
        self.device = f"{'GRBL' if dialect == 'grbl' else 'grblHAL'} at {port.name}"
        self.lost: str | None = None
        self.n_resets = 0
        self._port = port
        self._clock = clock
        self._answer_s = answer_s
        self._critical = False
        self._owed = False
        self._greet(start_s)
        self.stop(start_s)
        report = self._report()
        if report.state == "Alarm":
            self.lost = "it is in alarm, or has not been homed since it was switched on"
        self._settings = self._read_settings()
        if self._settings.get(13):
            raise DeviceStateError(f"{self.device}: it reports inches ($13=1); mm are needed: send $13=0.")

    def read(self, axis: str) -> float:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        self._drain()
        return self._axis(self._report(), axis)

    def ready(self) -> None:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        self._drain()
        if self.lost is not None:
            raise DeviceStateError(f"{self.device}: not homed: {self.lost}. Home the table, then go on.")
        report = self._report()
        if report.state != "Idle":
            raise DeviceStateError(
                f"{self.device}: it cannot move now: {STATES.get(report.state, 'its state is ' + report.state)}. It has to be idle."
            )

    def move(self, axis: str, target: float, feed: float, timeout_s: float) -> float:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        patience = Patience(self._clock, timeout_s)
        self._jog(f"G53{axis}{target:.4f}", feed)
        return self._rest(axis, patience, timeout_s, target)

    def run(self, axis: str, distance: float, feed: float) -> None:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        self._jog(f"G91{axis}{distance:.4f}", feed)
        acceleration = self._settings.get(120 + AXES.index(axis), 0.0)
        ramp_s = feed / 60.0 / acceleration if acceleration > 0 else 1.0
        patience = Patience(self._clock, 2.0 * ramp_s + 2.0)
        while True:
            report = self._report()
            if report.state == "Idle":
                raise DeviceStateError(
                    f"{self.device}: the way to the limit ended before {feed:g} units/min were reached. Begin farther away from it."
                )
            if report.feed is None:
                raise DeviceStateError(
                    f"{self.device}: its reports carry no feed (F or FS), so that nobody knows when the speed is reached."
                    " Build the firmware with it."
                )
            if report.feed >= _REACHED * feed:
                return
            if patience.left_s <= 0:
                raise DeviceTimeoutError(
                    f"{self.device}: reached {report.feed:g} instead of {feed:g} units/min. Is a feed override active, or $11n lower?"
                )
            self._clock.wait(POLL_S)

    def stop(self, timeout_s: float) -> None:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        patience = Patience(self._clock, timeout_s)
        self._drain()
        if self._critical:  # halted by an alarm, it stands, and answers to nothing but a reset
            self._reset()
            return
        self._port.write(CANCEL_JOG)
        held = False
        while True:
            try:
                report = self._report()
            except DeviceTimeoutError:  # it is mute: homing, halted by an alarm, or hung; a reset stops it in any case
                self.lost = self.lost or "it did not answer any more and had to be reset"
                self._reset()
                return
            if report.state == "Home" or (report.state == "Hold" and report.detail == 0):
                self._reset()  # in Hold:0 it stands, and keeps its position
                return
            if report.state == "Run" and not held:
                self._port.write(FEED_HOLD)
                held = True
            elif report.state not in ("Run", "Jog", "Hold") and not report.decelerates:
                return
            if patience.left_s <= 0:
                self.lost = f"it was not at rest {timeout_s:g} s after it had been told to stop, and was reset"
                self._reset()
                raise DeviceTimeoutError(
                    f"{self.device}: {self.lost}. Home it before it moves again; a longer time-out, or a greater acceleration"
                    " ($12n), helps."
                )
            self._clock.wait(POLL_S)

    def home(self, axis: str, timeout_s: float) -> float:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        self._wake()
        patience = Patience(self._clock, timeout_s)
        self._command("$H", timeout_s)
        position = self._rest(axis, patience, timeout_s)
        self.lost = None
        return position

    def unlock(self) -> None:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        self._wake()
        if self._report().state == "Alarm":
            self._command("$X")
        self.lost = None

    def max_feed(self, axis: str) -> float | None:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        return self._settings.get(110 + AXES.index(axis))

    def check_laser(self, device: str, full_s: float | None) -> None:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        if self._settings.get(32) == 1:
            raise DeviceStateError(
                f"{device}: laser mode is on ($32=1), in which the light goes out while nothing moves. Send $32=0."
            )
        greatest = self._settings.get(30)
        if full_s is not None and greatest is not None and full_s > greatest:
            raise DeviceLimitError(
                f"{device}: power_range ends at S{full_s:g}, but the board gives full power at S{greatest:g} already ($30)."
                " Make both the same."
            )

    def switch(self, line: str, off: bool) -> None:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        try:
            self._switch(line, off)
        except DeviceConnectionError:
            raise
        except DeviceError:
            if not off:
                raise
            self._reset()  # it switches the outputs off, whatever state the board is in

    def close(self) -> None:
        """See :class:`~rotaline.hardware.gcode.board.Board`."""
        self._port.close()

    # ------------------------------------------------------------------------------------------------------- what is said

    def _switch(self, line: str, off: bool) -> None:
        self._drain()
        if off and self._critical:
            self._reset()
            return
        try:
            self._command(line)
        except _RefusedError as error:
            if error.code != 9 or self._report().state != "Jog":
                raise
            if not off:
                raise DeviceStateError(
                    f"{self.device}: it takes '{line}' only while the table stands. Switch first, then turn."
                ) from error
            self.stop(self._answer_s)
            self._command(line)

    def _jog(self, words: str, feed: float) -> None:
        try:
            self._command(f"$J=G21{words}F{feed:.2f}")
        except _RefusedError as error:
            if error.code == 15:
                raise DeviceLimitError(
                    f"{error} Nothing has moved. Set limits_deg in rig.toml within the board's own travel ($13n, in the units of the"
                    " axis), or its soft limits off ($20=0)."
                ) from error
            raise

    def _rest(self, axis: str, patience: Patience, timeout_s: float, target: float | None = None) -> float:
        """Wait until it is idle, and has left for the target: some firmwares begin a little after their ``ok``."""
        grace = Patience(self._clock, _GRACE_S)
        moved = target is None
        while True:
            report = self._report()
            if report.state == "Idle":
                position = self._axis(report, axis)
                if moved or grace.left_s <= 0 or (target is not None and abs(position - target) < _NEAR):
                    return position
            elif report.state not in ("Jog", "Run", "Home"):
                raise DeviceStateError(
                    f"{self.device}: it stopped on its way: {STATES.get(report.state, 'its state is ' + report.state)}."
                )
            else:
                moved = True
            if patience.left_s <= 0:
                raise DeviceTimeoutError(
                    f"{self.device}: it still moved after {timeout_s:g} s and was told to stop. Give it more time, or more speed."
                )
            self._clock.wait(POLL_S)

    def _axis(self, report: Report, axis: str) -> float:
        index = AXES.index(axis)
        if index >= len(report.position):
            raise DeviceStateError(
                f"{self.device}: it reports {len(report.position)} axes ({' '.join(AXES[: len(report.position)])}), none of them is"
                f" {axis}. Correct 'axis' in rig.toml."
            )
        return report.position[index]

    def _report(self) -> Report:
        """Ask for a report, up to four times: one may be lost or garbled."""
        for _ in range(_ATTEMPTS):
            self._port.write(ASK)
            patience = Patience(self._clock, self._answer_s / _ATTEMPTS)
            while (line := self._port.read_line(patience)) is not None:
                self._take(line)
                report = parse_report(line, self.device)
                if report is not None:
                    return report
                if line:
                    self._port.strange(line)
        raise DeviceTimeoutError(
            f"{self.device}: no status report within {self._answer_s:g} s; {self._port.heard()}. Look at cable, baud rate and dialect."
        )

    def _command(self, text: str, timeout_s: float | None = None) -> list[str]:
        """Send a line and wait for its answer; returns the lines of data before it."""
        self._drain()
        self._port.write(text.encode("ascii") + b"\n")
        wait_s = self._answer_s if timeout_s is None else timeout_s
        patience = Patience(self._clock, wait_s)
        self._owed = True
        data: list[str] = []
        while (line := self._port.read_line(patience)) is not None:
            self._take(line)
            refused = _ERROR.fullmatch(line)
            if line == "ok" or refused is not None:
                self._owed = False
            if line == "ok":
                return data
            if refused is not None:
                code = int(refused[1])
                raise _RefusedError(f"{self.device}: it refused '{text}': {error_words(code)}.", code)
            if line.startswith(("[", "$", ">", "<")):
                data.append(line)
            elif line:
                self._port.strange(line)
        raise DeviceTimeoutError(
            f"{self.device}: no answer to '{text}' within {wait_s:g} s; {self._port.heard()}. Look at cable, baud rate and dialect."
        )

    # ---------------------------------------------------------------------------------------------------- what comes unasked

    def _take(self, line: str, expected: bool = False) -> None:
        """Look for what comes unasked: alarms and resets, which raise unless a reset is expected."""
        alarm = _ALARM.search(line)
        if alarm is not None:
            code = int(alarm[1])
            self._critical = code in _CRITICAL_ALARMS
            self.lost = f"alarm, {alarm_words(code)}"
            if not expected:
                raise DeviceStateError(f"{self.device}: {self.lost}. Put right what caused it, then home the table.")
        elif _GREETING.search(line) is not None:
            self._owed = self._critical = False
            self.n_resets += 1
            if not expected:
                self.lost = self.lost or "it was reset (its greeting came), so that the position is lost"
                raise DeviceStateError(
                    f"{self.device}: {self.lost} and the outputs are off. Look at power supply and USB cable, then home the table."
                )
        elif "Reset to continue" in line:
            self._critical = True

    def _drain(self) -> None:
        """Read what came meanwhile; what it says about alarms and resets is remembered. Answers that are owed are waited for."""
        while self._port.waiting() or self._owed:
            line = self._port.read_line(Patience(self._clock, self._answer_s / _ATTEMPTS))
            if line is None:
                self._owed = False
                return
            try:
                self._take(line)
            except DeviceStateError:
                continue

    def _reset(self) -> None:
        """Reset it: the outputs are off and it stands. The position is kept unless an alarm says otherwise."""
        self._port.write(RESET)
        patience = Patience(self._clock, self._answer_s)
        before = self.n_resets
        while (line := self._port.read_line(patience)) is not None:
            self._take(line, expected=True)
            if self.n_resets > before:
                self._clear()
                return
        self.lost = self.lost or "it was told to reset and did not answer"
        raise DeviceTimeoutError(
            f"{self.device}: no greeting within {self._answer_s:g} s after a reset; {self._port.heard()}. Whether table and laser"
            " are off is not known: take their power away, then look at cable and board."
        )

    def _clear(self) -> None:
        """Wait until the answer to an empty line has come: nothing that was said before is left."""
        self._port.write(b"\n")
        patience = Patience(self._clock, self._answer_s)
        while (line := self._port.read_line(patience)) is not None:
            self._take(line, expected=True)
            if line == "ok" or _ERROR.fullmatch(line):
                return
        raise DeviceTimeoutError(f"{self.device}: no answer to an empty line; {self._port.heard()}.")

    def _wake(self) -> None:
        self._drain()
        if self._critical:
            self._reset()

    def _greet(self, start_s: float) -> None:
        for demand in _FIRST_WORDS:
            self._port.write(demand)
            patience = Patience(self._clock, start_s / len(_FIRST_WORDS))
            while (line := self._port.read_line(patience)) is not None:
                self._take(line, expected=True)
                if line.startswith("<") or _GREETING.search(line):
                    self._clear()
                    self.n_resets, self.lost = 0, None
                    return
                self._port.strange(line)
        raise DeviceTimeoutError(
            f"{self.device}: no answer within {start_s:g} s after the port was opened; {self._port.heard()}. Are port, baud rate and"
            " dialect right, and has the board power?"
        )

    def _read_settings(self) -> dict[int, float]:
        found = [_SETTING.match(line) for line in self._command("$$")]
        return {int(match[1]): float(match[2]) for match in found if match is not None}
