"""Boards with GRBL, grblHAL or Marlin, as far as a turntable and a laser need them, on a pseudo-terminal.

A thread answers what is written to the port. What moves, moves by the clock of the test; nothing here waits for time to go by.
"""

import os
import re
import select
import threading
import tty
from collections.abc import Callable

Action = Callable[[], None]


class Firmware:
    """A pseudo-terminal with a thread that answers; a context that ends it.

    ``received``: the lines and real-time bytes that came, in order. ``laser_s``: the S word of the output, 0 is off; ``laser_log``: all that
    it was set to. ``at(n, what, action)`` does something when ``what`` comes the n-th time from now, before it is answered.
    """

    def __init__(self) -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.received: list[bytes] = []
        self.laser_s = 0.0
        self.laser_log: list[float] = []
        self.mute = False
        self._garbling: list[Callable[[bytes], bytes]] = []
        self._planned: list[tuple[int, bytes, Action]] = []
        self._wake_read, self._wake_write = os.pipe()
        self._thread = threading.Thread(target=self._serve, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        os.write(self._wake_write, b".")
        self._thread.join(5.0)
        for descriptor in (self._master, self._slave, self._wake_read, self._wake_write):
            try:
                os.close(descriptor)
            except OSError:
                continue  # it has been unplugged

    def at(self, n: int, what: bytes, action: Action) -> None:
        """Do something when a line with this in it, or this byte, comes the n-th time from now."""
        self._planned.append((n, what, action))

    def garble(self, change: Callable[[bytes], bytes]) -> None:
        """Change the next thing that is said."""
        self._garbling.append(change)

    def unplug(self) -> None:
        """The port is gone. To be called by :meth:`at` only: the thread itself has to end."""
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1

    def say(self, text: str | bytes) -> None:
        """Write to the program."""
        if self.mute:
            return
        data = text if isinstance(text, bytes) else text.encode("ascii")
        if self._garbling:
            data = self._garbling.pop(0)(data)
        os.write(self._master, data)

    def light(self, s: float) -> None:
        """Set the output."""
        self.laser_s = s
        self.laser_log.append(s)

    def _serve(self) -> None:
        try:
            while True:
                ready, _, _ = select.select([self._master, self._wake_read], [], [])
                if self._master in ready:  # what was written before the end is taken before the end
                    self.take(os.read(self._master, 4096))
                else:
                    return
        except (OSError, ValueError):
            return  # it has been unplugged

    def _came(self, what: bytes) -> None:
        self.received.append(what)
        due = []
        later = []
        for n, part, action in self._planned:
            hit = part in what
            (due if hit and n == 1 else later).append((n - hit, part, action))
        self._planned = later
        for _, _, action in due:
            action()

    def take(self, data: bytes) -> None:
        """Bytes came."""
        raise NotImplementedError


class GrblFirmware(Firmware):
    """GRBL 1.1 (or grblHAL) with the axes X Y Z A, units and steps of 0.001.

    ``homing``: limit switches are there, and it begins in alarm. ``travel``: soft limits, units. ``clock``: what moves, moves by it.
    """

    GREETING = "\r\nGrbl 1.1h ['$' for help]\r\n"
    RAMP_S = 0.1

    def __init__(self, clock, homing=False, travel=None, settings=None, accessory="", n_axes=4) -> None:
        super().__init__()
        self.clock = clock
        self.homing = homing
        self.travel = travel
        self.settings = {13: 0, 20: 0 if travel is None else 1, 22: int(homing), 30: 1000, 32: 0}
        self.settings |= {110 + i: 6000.0 for i in range(n_axes)} | {120 + i: 1000.0 for i in range(n_axes)}
        self.settings |= settings or {}
        self.n_axes = n_axes
        self.accessory = accessory
        self.state = "Alarm" if homing else "Idle"
        self.critical = False
        self.position = [0.0] * n_axes
        self.hold_reports = 0
        self._move: tuple[int, float, float, float, float] | None = None  # axis, from, to, units/s, begin
        self._line = b""

    # --------------------------------------------------------------------------------------------- what the test does to it

    def begin_program_move(self, axis: int, target: float, feed: float) -> None:
        """As if a program before had begun a G1."""
        self._begin(axis, target, feed, "Run")

    def reset_by_itself(self) -> None:
        """Power was short: all is forgotten."""
        self._stand()
        self.position = [0.0] * self.n_axes
        self.light(0.0)
        self.state, self.critical, self._line = "Alarm" if self.homing else "Idle", False, b""
        self._greet()

    def alarm(self, code: int) -> None:
        """Stop at once, outputs off, and say so."""
        self._stand()
        self.light(0.0)
        self.state = "Alarm"
        self.critical = code in (1, 2, 10)
        self.say(f"ALARM:{code}\r\n" + ("[MSG:Reset to continue]\r\n" if self.critical else ""))

    # ------------------------------------------------------------------------------------------------------------- protocol

    def take(self, data: bytes) -> None:
        for byte in data:
            if byte in b"?!~\x18\x85":
                self._realtime(bytes([byte]))
            elif byte in b"\r\n":
                line, self._line = self._line, b""
                self._came(line)
                if not self.critical and not self.mute:
                    self._answer(line.decode("ascii", "replace").replace(" ", ""))
            else:
                self._line += bytes([byte])

    def _realtime(self, byte: bytes) -> None:
        self._came(byte)
        if byte == b"\x18":
            self._reset()
        elif self.critical:
            return
        elif byte == b"?":
            if self.state != "Home":
                self._report()
        elif byte == b"\x85" and self.state == "Jog":
            self._stand()
            self.hold_reports = 1
        elif byte == b"!" and self.state in ("Run", "Idle"):
            self._stand()
            self.state = "Hold"
            self.hold_reports = 1

    def _reset(self) -> None:
        self.mute = False
        moving = self._move is not None
        self._stand()
        self.light(0.0)
        self._line = b""
        if self.state == "Home":
            self.say("ALARM:6\r\n")
        elif moving:
            self.say("ALARM:3\r\n")
        self.critical = False
        if moving or self.state in ("Alarm", "Home"):
            self.state = "Alarm"
        else:
            self.state = "Idle"
        self._greet()

    def _greet(self) -> None:
        self.say(self.GREETING + ("[MSG:'$H'|'$X' to unlock]\r\n" if self.state == "Alarm" else ""))

    def _report(self) -> None:
        now_s = self.clock.now_s()
        feed = 0.0
        detail = ""
        state = self.state
        if self._move is not None:
            axis, begin, end, speed, begin_s = self._move
            gone_s = now_s - begin_s
            ramp_s = min(self.RAMP_S, max(gone_s, 0.0))
            way = speed * (gone_s - ramp_s + ramp_s**2 / (2 * self.RAMP_S))
            if way >= abs(end - begin):
                self.position[axis], self._move, self.state = end, None, "Idle"
            else:
                self.position[axis] = begin + (way if end > begin else -way)
                feed = 60.0 * speed * ramp_s / self.RAMP_S
            state = self.state
        elif self.hold_reports > 0:  # decelerating for one report
            self.hold_reports -= 1
            state = "Jog" if self.state == "Jog" else self.state
            detail = ":1" if self.state == "Hold" else ""
            if self.state == "Jog":
                self.state = "Idle"
        elif self.state == "Hold":
            detail = ":0"
        where = ",".join(f"{p:.3f}" for p in self.position)
        self.say(f"<{state}{detail}|MPos:{where}|FS:{feed:.0f},{self.laser_s:.0f}{self.accessory}>\r\n")

    def _stand(self) -> None:
        if self._move is not None:
            self.mute, mute = True, self.mute
            self._report()
            self.mute = mute
        self._move = None

    def _begin(self, axis: int, target: float, feed: float, state: str) -> None:
        if target != self.position[axis]:
            self._move = (axis, self.position[axis], target, feed / 60.0, self.clock.now_s())
            self.state = state

    def _answer(self, line: str) -> None:
        refused = self._carry_out(line)
        if refused is None:
            return
        self.say("ok\r\n" if refused == 0 else f"error:{refused}\r\n")

    def _carry_out(self, line: str) -> int | None:
        if line == "":
            return 0
        if line == "$$":
            self.say(
                "".join(f"${n}={value:{'g' if n < 100 else '.3f'}}\r\n" for n, value in sorted(self.settings.items()))
            )
            return 0
        if line == "$X":
            if self.state == "Alarm":
                self.state = "Idle"
                self.say("[MSG:Caution: Unlocked]\r\n")
            return 0
        if line == "$H":
            return self._home()
        if line.startswith("$J="):
            return self._jog(line[3:]) if self.state in ("Idle", "Jog") else 8
        if line.startswith("$"):
            return 3
        if self.state in ("Alarm", "Jog"):
            return 9
        return self._gcode(line)

    def _home(self) -> int | None:
        if not self.homing:
            return 5
        self.position = [-1.0] * self.n_axes
        self.state = "Idle"
        return 0

    def _jog(self, words: str) -> int:
        found = re.fullmatch(r"G21(G53|G91)([XYZABCUV])(-?[\d.]+)F([\d.]+)", words)
        if found is None:
            return 16
        axis = "XYZABCUV".index(found[2])
        if axis >= self.n_axes:
            return 36
        target = float(found[3]) + (self.position[axis] if found[1] == "G91" else 0.0)
        if self.travel is not None and not self.travel[0] <= target <= self.travel[1]:
            return 15
        self._begin(axis, target, min(float(found[4]), self.settings[110 + axis]), "Jog")
        return 0

    def _gcode(self, line: str) -> int:
        on = re.fullmatch(r"M3(?:S([\d.]+))?|M106P\d+S([\d.]+)", line)
        if on is not None:
            self.light(float(on[1] or on[2] or self.settings[30]))
        elif line == "M5" or re.fullmatch(r"M107P\d+", line):
            self.light(0.0)
        else:
            return 20
        return 0


class MarlinFirmware(Firmware):
    """Marlin 2 with the axes X Y Z, units and steps of 0.01; it moves at once, and reports ``echo:busy`` once while it does.

    ``stalls``: the next move does not end before M410. ``endstops``: software endstops, at which Marlin clips targets.
    """

    def __init__(self, emergency_parser=True, endstops=None, knows_m3=True) -> None:
        super().__init__()
        self.emergency_parser = emergency_parser
        self.endstops = endstops
        self.knows_m3 = knows_m3
        self.position = {"X": 0.0, "Y": 0.0, "Z": 0.0, "E": 0.0}
        self.stalls = False
        self.damage = 0
        """So many of the next lines with a number arrive damaged."""
        self._stalled = False
        self._waiting: list[bytes] = []
        self._moved = False
        self._last = 0
        self._line = b""

    def reset_by_itself(self) -> None:
        """Power was short: all is forgotten."""
        self.light(0.0)
        self.position = dict.fromkeys(self.position, 0.0)
        self._last, self._stalled, self._waiting, self._moved = 0, False, [], False
        self.say("start\necho:Marlin 2.1.2\n")

    def take(self, data: bytes) -> None:
        *lines, self._line = (self._line + data).split(b"\n")
        for line in lines:
            if line:
                self._came(line)
                if not self.mute:
                    self._queue(line)

    def _queue(self, line: bytes) -> None:
        if self._stalled:
            self._waiting.append(line)
            if line == b"M410" and self.emergency_parser:
                self._stalled = False
                self.say("ok\n")  # the M400 that waited
                waiting, self._waiting = self._waiting, []
                for one in waiting:
                    self._queue(one)
            return
        text = self._checked(line)
        if text is not None:
            self._answer(text)

    def _checked(self, line: bytes) -> str | None:
        """The command; None: it is asked for again."""
        if not line.startswith(b"N"):
            return line.decode("ascii", "replace")
        if self.damage > 0:
            self.damage -= 1
            line = line.replace(b"G", b"g").replace(b"M", b"m")
        body, _, checksum = line.rpartition(b"*")
        expected = 0
        for byte in body:
            expected ^= byte
        number, _, command = body[1:].decode("ascii", "replace").partition(" ")
        if str(expected) != checksum.decode("ascii", "replace"):
            self.say(f"Error:checksum mismatch, Last Line: {self._last}\nResend: {self._last + 1}\nok\n")
            return None
        if int(number) != self._last + 1:
            self.say(
                f"Error:Line Number is not Last Line Number+1, Last Line: {self._last}\nResend: {self._last + 1}\nok\n"
            )
            return None
        self._last += 1
        return command

    def _answer(self, text: str) -> None:
        words = text.split()
        numbers = {word[0]: float(word[1:]) for word in words[1:] if len(word) > 1}
        what = words[0]
        if what == "M110":
            self._last = int(numbers["N"])
        elif what == "M115":
            self.say(
                "FIRMWARE_NAME:Marlin 2.1.2 SOURCE_CODE_URL:github.com/MarlinFirmware/Marlin PROTOCOL_VERSION:1.0\n"
                f"Cap:EMERGENCY_PARSER:{int(self.emergency_parser)}\n"
            )
        elif what == "M114":
            where = " ".join(f"{axis}:{value:.2f}" for axis, value in self.position.items())
            self.say(f"{where} Count X:0 Y:0 Z:0\n")
        elif what == "G1":
            for axis in set(numbers) & set(self.position):
                low, high = self.endstops or (-1e9, 1e9)
                self.position[axis] = min(max(numbers[axis], low), high)
            self._moved = True
        elif what == "M400":
            if self._moved:
                self._moved = False
                self.say("echo:busy: processing\n")
                if self.stalls:
                    self.stalls, self._stalled = False, True
                    return
        elif what == "G28":
            self.position[words[1]] = 0.0
        elif what == "M410" or what in ("G21", "G90"):
            pass
        elif what in ("M3", "M106") and (what == "M106" or self.knows_m3):
            self.light(numbers.get("S", 255.0))
        elif what in ("M5", "M107") and (what == "M107" or self.knows_m3):
            self.light(0.0)
        else:
            self.say(f'echo:Unknown command: "{text}"\n')
        self.say("ok\n")


class Transcript(Firmware):
    """Plays a transcript: ``> `` lines have to come byte for byte, then the ``< `` lines after them are said.

    ``wrong``: the first difference, None: none so far; ``left``: what has not been played.
    """

    def __init__(self, text: str) -> None:
        super().__init__()
        lines = [line for line in text.splitlines() if line and not line.startswith("#")]
        self.left = [(line[0], line[2:].encode("ascii").decode("unicode_escape").encode("latin-1")) for line in lines]
        self.wrong: str | None = None
        self._came_so_far = b""

    def take(self, data: bytes) -> None:
        self._came_so_far += data
        while self.left and self.wrong is None:
            side, expected = self.left[0]
            if side == "<":
                self.say(expected)
            elif len(self._came_so_far) < len(expected):
                if not expected.startswith(self._came_so_far):
                    self.wrong = f"expected {expected!r}, came {self._came_so_far!r}"
                return
            elif self._came_so_far.startswith(expected):
                self._came_so_far = self._came_so_far[len(expected) :]
            else:
                self.wrong = f"expected {expected!r}, came {self._came_so_far!r}"
                return
            self.left.pop(0)
        if self._came_so_far and not self.left:
            self.wrong = f"after the end came {self._came_so_far!r}"
