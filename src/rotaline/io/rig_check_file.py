"""What `rotaline rig check` found: the lines that it prints, ``check.json`` and a picture."""

import datetime
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from rotaline.io.files import write_json
from rotaline.io.rig_check_pictures import CheckPictures

Level = Literal["ok", "doubtful", "fails"]

LEVELS: tuple[Level, ...] = ("ok", "doubtful", "fails")


@dataclass(frozen=True)
class CheckLine:
    """One thing that was looked at.

    Attributes
    ----------
    device : "camera", "laser" or "turntable"
    name : what was looked at
    level : how it is
    text : what was found, with units
    mend : what to do; empty where nothing is to be done
    values : the figures, for programs; the unit is in the name
    error : a device raised it
    """

    device: str
    name: str
    level: Level
    text: str
    mend: str = ""
    values: Mapping[str, float | int] = field(default_factory=dict)
    error: bool = False


@dataclass(frozen=True, eq=False)
class RigCheck:
    """All that was found.

    ``devices`` names them by kind; ``left_out`` says what was not looked at, and why; ``recommended`` are values for plan and rig.toml.
    """

    devices: Mapping[str, str]
    lines: tuple[CheckLine, ...]
    left_out: tuple[str, ...]
    recommended: Mapping[str, float]
    pictures: CheckPictures

    @property
    def level(self) -> Level:
        """That of the worst line."""
        return LEVELS[max((LEVELS.index(line.level) for line in self.lines), default=0)]

    @property
    def broken(self) -> bool:
        """Whether a device raised an error."""
        return any(line.error for line in self.lines)


def check_document(check: RigCheck) -> dict[str, Any]:
    """What ``check.json`` holds."""
    return {
        "version": 1,
        "taken": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "level": check.level,
        "devices": dict(check.devices),
        "lines": [
            {
                "device": x.device,
                "check": x.name,
                "level": x.level,
                "found": x.text,
                "mend": x.mend,
                "values": dict(x.values),
            }
            for x in check.lines
        ],
        "left_out": list(check.left_out),
        "recommended": dict(check.recommended),
    }


def write_rig_check(check: RigCheck, folder: Path) -> None:
    """Write ``check.json`` and ``check.png``.

    Raises
    ------
    OutputError
        If they cannot be written.
    """
    from rotaline.io.report import style
    from rotaline.io.report.figures.rig_check import rig_check_figure

    write_json(folder / "check.json", check_document(check))
    style.save_png(rig_check_figure(check.pictures), folder / "check.png", dpi=100.0)
