"""``rig.toml`` of a live rig: which devices it has, and how they are connected."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin

from pydantic import Field
from pydantic.fields import FieldInfo

from rotaline.errors import RigError
from rotaline.hardware.drivers import DRIVERS, KINDS, FoundDevice, Kind, settings_type
from rotaline.hardware.rig import DeviceTables
from rotaline.io.toml_file import checked, text_of, toml_of, where
from rotaline.tables import Table, key


class SimulatedTable(Table):
    """The rig behind devices with driver "simulated"."""

    rig: str = key("article", "a preset (article, webcam, high-resolution, demo) or a rig file of `rotaline simulate`")
    seed: Annotated[int, Field(ge=0)] | None = key(None, "of noise and drawn poses; absent: the rig file's")
    real_time: bool = key(False, "exposures, moves and rests take their time; false: no time goes by")


class ReplayTable(Table):
    """The session behind devices with driver "replay"."""

    session: str = key(..., "a session folder, or a packed session")


@dataclass(frozen=True)
class DeviceFile:
    """A ``rig.toml`` that was found to be right; ``folder`` is where its relative paths begin."""

    source: str
    text: str
    devices: DeviceTables
    simulated: SimulatedTable
    replay: ReplayTable | None
    folder: Path

    @property
    def drivers(self) -> set[str]:
        """Names of the drivers in use."""
        tables = (self.devices.camera, self.devices.turntable, self.devices.laser)
        return {t.driver for t in tables if t is not None}  # type: ignore[attr-defined]


SIMULATED_RIG = """\
# A rig that is simulated: everything can be tried with it.
version = 1

[simulated]
rig = "article"        # or webcam, high-resolution, demo, or a rig file of `rotaline simulate`

[camera]
driver = "simulated"

[turntable]
driver = "simulated"

[laser]
driver = "simulated"
"""


_BEGIN = "`rotaline devices` lists what is connected and how to write it down; `rotaline devices --toml simulated` prints one to begin with."


def read_device_file(path: Path) -> DeviceFile:
    """Read and check a ``rig.toml``.

    Raises
    ------
    RigError
        With all that is wrong: file, line, field; found, expected.
    """
    text = text_of(path, "rig file", _BEGIN)
    return parse_device_file(text, str(path), path.parent)


def parse_device_file(text: str, source: str, folder: Path) -> DeviceFile:
    """Check the text of a ``rig.toml``; ``source`` names it in messages.

    Raises
    ------
    RigError
        With all that is wrong: file, line, field; found, expected.
    """
    data = toml_of(source, text)
    camera = data.get("camera")
    if "captures" in data and "version" in data and not {"preset", "camera"} & set(data):
        raise RigError(f"{source}: this is a plan: what is taken, not with which devices. {_BEGIN}")
    if "preset" in data or "captures" in data or (isinstance(camera, dict) and "position_mm" in camera):
        raise RigError(
            f"{source}: this describes a rig to be simulated, not devices. Name it in a file of devices:\n{SIMULATED_RIG}"
        )
    problems: list[str] = []
    known = ("version", *KINDS, "simulated", "replay")
    for name in data:
        if name not in known:
            problems.append(
                f"{where(source, text, (name,))}: there is no such key; expected one of {', '.join(known)}."
            )
    if data.get("version") != 1:
        found = repr(data["version"]) if "version" in data else "nothing"
        problems.append(f"{where(source, text, ('version',))}: found {found}, expected version = 1.")
    if "camera" not in data:
        problems.append(f"{source}, camera: it is missing; expected a table [camera] with a driver.")
    tables: dict[str, Table | None] = {}
    for kind in KINDS:
        tables[kind] = _collected(problems, lambda kind=kind: _device(kind, data, source, text))
    simulated = _collected(
        problems, lambda: checked(SimulatedTable, data.get("simulated", {}), source, text, ("simulated",))
    )
    replay = None
    if "replay" in data:
        replay = _collected(problems, lambda: checked(ReplayTable, data["replay"], source, text, ("replay",)))
    elif any(getattr(t, "driver", "") == "replay" for t in tables.values()):
        problems.append(f'{source}, replay: it is missing; expected a table [replay] with session = "...".')
    if problems:
        raise RigError("\n".join(problems))
    assert tables["camera"] is not None
    assert isinstance(simulated, SimulatedTable)
    devices = DeviceTables(tables["camera"], tables["turntable"], tables["laser"])
    return DeviceFile(source, text, devices, simulated, replay, folder)  # type: ignore[arg-type]


def _collected(problems: list[str], make: Any) -> Table | None:
    try:
        return make()
    except RigError as error:
        problems.append(str(error))
        return None


def _device(kind: Kind, data: dict[str, Any], source: str, text: str) -> Table | None:
    if kind not in data:
        return None
    table = data[kind]
    if not isinstance(table, dict):
        raise RigError(f"{where(source, text, (kind,))}: found {table!r}, expected a table [{kind}] with a driver.")
    driver = table.get("driver")
    if driver not in DRIVERS[kind]:
        found = "nothing" if driver is None else repr(driver)
        raise RigError(
            f"{where(source, text, (kind, 'driver'))}: found {found}, expected one of {', '.join(DRIVERS[kind])}."
        )
    return checked(settings_type(kind, driver), table, source, text, (kind,))


def lines_of(found: FoundDevice) -> str:
    """The lines of rig.toml that choose a device, with the table that they stand in."""
    header = f"[{found.kind}]"
    text = found.toml.strip()
    return text if text.startswith(header) else f"{header}\n{text}"


def driver_lines(driver: str) -> str:
    """A rig.toml to be completed: all keys of a driver, each with its meaning; those with a default are commented out.

    Raises
    ------
    RigError
        If there is no such driver.
    """
    if driver == "simulated":
        return SIMULATED_RIG
    kinds = [kind for kind in KINDS if driver in DRIVERS[kind]]
    if not kinds:
        names = dict.fromkeys(name for kind in KINDS for name in DRIVERS[kind])
        raise RigError(f"--toml {driver}: there is no such driver; expected one of {', '.join(names)}.")
    tables: list[tuple[str, type[Table]]] = [(kind, settings_type(kind, driver)) for kind in kinds]
    if driver == "replay":
        tables.insert(0, ("replay", ReplayTable))
    parts = ["version = 1\n"]
    for name, table in tables:
        lines = [f"[{name}]", *([] if name == "replay" else [f'driver = "{driver}"'])]
        for entry, field in table.model_fields.items():
            if entry != "driver":
                begin = (
                    f"{entry} =    # to be filled in:"
                    if field.is_required()
                    else f"# {_written(entry, field.default)}    #"
                )
                lines.append(f"{begin} {meaning_of(field)}")
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def meaning_of(field: FieldInfo) -> str:
    """The description of a key, with its values where it has a few."""
    annotation = field.annotation
    inner = [annotation, *get_args(annotation)]
    values = next((get_args(a) for a in inner if get_origin(a) is Literal), ())
    text = str(field.description)
    told = len(values) > 1 and not all(str(value) in text for value in values)
    return f"{text}; one of {', '.join(str(value) for value in values)}" if told else text


def _written(name: str, default: Any) -> str:
    """A key with its default as it is written; nothing where there is none."""
    return f"{name} =" if default is None else f"{name} = {json.dumps(default)}"
