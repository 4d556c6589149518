"""What the checks of a rig share: the devices, and what has been found so far."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from rotaline.hardware.camera import CameraFrame
from rotaline.hardware.rig import OpenRig
from rotaline.io.rig_check_file import CheckLine, Level, RigCheck
from rotaline.io.rig_check_pictures import CheckPictures
from rotaline.pipeline.acquire.taking import take_surely

Heard = Callable[[CheckLine | str], None]
"""Hears each line as soon as it is found, and sentences for the person who stands beside the rig."""

LONGEST_US = 1e6
"""Exposures beyond are not tried."""


@dataclass
class Bench:
    """A rig that is being checked; lines and pictures come one after the other.

    ``noise`` is the standard deviation of a pixel, in grey values, and ``exposure_us`` what suits a lit scene; known once the camera
    has been checked.
    """

    rig: OpenRig
    heard: Heard
    lines: list[CheckLine] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    lost: list[str] = field(default_factory=list)
    recommended: dict[str, float] = field(default_factory=dict)
    pictures: dict[str, Any] = field(default_factory=dict)
    n_frames: int = 0
    noise: float = 1.0
    exposure_us: float | None = None

    def take(self) -> CameraFrame:
        """A frame; a lost one is taken again, and counted."""
        frame = take_surely(self.rig.camera, self.lost.append)
        self.n_frames += 1
        return frame

    def line(self, device: str, name: str, level: Level, text: str, mend: str = "", /, **values: float | int) -> None:
        """Write down what was found; ``mend`` is left out where all is well."""
        self._add(CheckLine(device, name, level, text, "" if level == "ok" else mend, values))

    def error(self, device: str, name: str, error: Exception) -> None:
        """Write down what a device raised, once."""
        text = str(error)
        if text not in [line.text for line in self.lines]:
            self._add(CheckLine(device, name, "fails", text, error=True))

    def leave_out(self, text: str) -> None:
        """Say what is not looked at, and why."""
        self.left_out.append(text)
        self.heard(text)

    def found(self) -> RigCheck:
        """All of it."""
        rig = self.rig
        named = {"camera": rig.camera, "turntable": rig.turntable, "laser": rig.laser}
        devices = {kind: thing.info.device for kind, thing in named.items() if thing is not None}
        pictures = CheckPictures(**self.pictures)
        return RigCheck(devices, tuple(self.lines), tuple(self.left_out), dict(self.recommended), pictures)

    def _add(self, line: CheckLine) -> None:
        self.lines.append(line)
        self.heard(line)
