"""A stand-in for the firmware of an 8SMC5 on a pseudo-terminal: as much of its serial protocol as the turntable uses; moves are done at once.

A request is four letters, for some followed by data and a checksum (CRC-16/MODBUS); the answer begins with the same letters. A zero byte asks
for a zero byte: so the library finds its place again after garbage.
"""

import os
import select
import struct
import threading
import tty

_RUNNING = 0x80
_COMMANDS = {b"move": 0x01, b"left": 0x03, b"rigt": 0x04, b"stop": 0x05, b"home": 0x06, b"sstp": 0x08}
_WITH_DATA = {b"move": 14, b"smov": 26, b"seng": 30}
"""Bytes after the letters."""


def crc16(data: bytes) -> bytes:
    """CRC-16/MODBUS, low byte first."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return struct.pack("<H", crc)


class Firmware:
    """The controller; ``said`` lists the requests but for those that only read.

    ``flags`` are or-ed to its state; ``silent``: it answers no more; ``garbled``: so many of the next states have a wrong checksum.
    """

    def __init__(self) -> None:
        self.said: list[str] = []
        self.flags = 0
        self.silent = False
        self.garbled = 0
        self.microsteps = 256
        self.position, self.speed = 0, 0
        self.command = 0
        self._move = bytearray(struct.pack("<IBHHIBB9x", 1000, 0, 2000, 2000, 50, 0, 0))
        self._host, self._port = os.openpty()
        tty.setraw(self._port)
        self.name = os.ttyname(self._port)
        self._wake, self._waker = os.pipe()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def unplug(self) -> None:
        """The port is gone."""
        if self._thread.is_alive():
            os.write(self._waker, b"x")
            self._thread.join()
            for descriptor in (self._port, self._host, self._wake, self._waker):
                os.close(descriptor)

    def _serve(self) -> None:
        pending = b""
        while self._wake not in select.select([self._host, self._wake], [], [])[0]:
            pending += os.read(self._host, 256)
            while pending:
                if pending[0] == 0:
                    self._send(b"\0")
                    pending = pending[1:]
                    continue
                length = 4 + _WITH_DATA.get(pending[:4], 0)
                if len(pending) < length:
                    break
                request, pending = pending[:length], pending[length:]
                letters, data = request[:4], request[4:-2]
                self._answer(letters if not data or crc16(data) == request[-2:] else b"errd", data)

    def _send(self, data: bytes) -> None:
        if not self.silent:
            os.write(self._host, data)

    def _answer(self, letters: bytes, data: bytes) -> None:
        table = self._table(letters)
        if table is not None:
            check = crc16(table)
            if letters == b"gets" and self.garbled:
                self.garbled -= 1
                check = bytes(255 - b for b in check)
            self._send(letters + table + check)
            return
        self.said.append(letters.decode())
        if not (letters in _COMMANDS or letters in (b"zero", b"smov", b"seng")):
            self._send(b"errc")
            return
        self._do(letters, data)
        self._send(letters)

    def _do(self, letters: bytes, data: bytes) -> None:
        whole, part = struct.unpack_from("<IB", self._move)
        speed = whole * self.microsteps + part
        if letters == b"smov":
            self._move[:] = data
        elif letters == b"zero":
            self.position = 0
        elif letters == b"move":
            steps, microsteps = struct.unpack_from("<ih", data)
            self.position, self.speed = steps * self.microsteps + microsteps, 0
        elif letters == b"seng":
            self.microsteps = 1 << (data[13] - 1)
        elif letters in (b"left", b"rigt"):
            self.speed = speed if letters == b"rigt" else -speed
        elif letters in (b"stop", b"sstp"):
            self.speed = 0
            self.flags &= ~0x40 if letters == b"stop" else -1
        if letters in _COMMANDS:
            self.command = _COMMANDS[letters] | (_RUNNING if self.speed else 0)

    def _split(self, microsteps: int) -> tuple[int, int]:
        steps, part = divmod(abs(microsteps), self.microsteps)
        return (steps, part) if microsteps >= 0 else (-steps, -part)

    def _table(self, letters: bytes) -> bytes | None:
        """What is answered to a request that only reads."""
        if letters == b"gets":
            self.position += self.speed // 100
            steps, microsteps = self._split(self.position)
            speed, part = self._split(self.speed)
            moving = 0x03 if self.speed else 0
            return struct.pack(
                "<5BihqihhhhhhIIB4x",
                *(moving, self.command, 3, 0, 0x33),
                *(steps, microsteps, 0, speed, part),
                *(0, 1200, 0, 500, 300, self.flags, 0, 1),
            )
        if letters == b"gmov":
            return bytes(self._move)
        return {
            b"gent": struct.pack("<BB6x", 3, 2),
            b"gfbs": struct.pack("<HBBI4x", 4000, 5, 0, 4000),
            b"geng": struct.pack("<HHIBHHBH12x", 1200, 500, 5000, 0, 0xF0, 50, self.microsteps.bit_length(), 200),
            b"geds": struct.pack("<BBihih6x", 6, 6, 0, 0, 0, 0),
        }.get(letters)
