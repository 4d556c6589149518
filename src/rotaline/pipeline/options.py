"""The options of every stage, from one TOML file: ``[stage]`` tables with ``name = value``."""

import dataclasses
import tomllib
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from rotaline.calibration.artifact import ArtifactOptions
from rotaline.calibration.cross_ratio import CrossRatioOptions
from rotaline.calibration.intrinsics import CameraOptions
from rotaline.calibration.laser_plane import LaserPlaneOptions
from rotaline.calibration.rotation_axis import AxisOptions
from rotaline.errors import SessionError
from rotaline.metrology.features import MeasureOptions
from rotaline.scanning.surface import SurfaceOptions
from rotaline.vision.stripe.extract import StripeOptions
from rotaline.vision.targets.detect import TargetOptions


@dataclass(frozen=True)
class ScanOptions:
    """Options of the scan and of what is made from it."""

    surface: bool = field(default=True, metadata={"help": "reconstruct a surface from every scan"})
    keep_table: bool = field(default=False, metadata={"help": "keep the table top in the surface"})
    table_margin_mm: float = field(
        default=0.3, metadata={"help": "points lower than this above the table top do not enter the surface, mm"}
    )
    max_u_mm: float | None = field(
        default=None, metadata={"help": "leave out points with a larger standard uncertainty, mm; default: keep all"}
    )


@dataclass(frozen=True)
class Options:
    """All options; one field a stage."""

    targets: TargetOptions = field(default_factory=TargetOptions)
    camera: CameraOptions = field(default_factory=CameraOptions)
    stripe: StripeOptions = field(default_factory=StripeOptions)
    laser_plane: LaserPlaneOptions = field(default_factory=LaserPlaneOptions)
    cross_ratio: CrossRatioOptions = field(default_factory=CrossRatioOptions)
    axis: AxisOptions = field(default_factory=AxisOptions)
    artifact: ArtifactOptions = field(default_factory=ArtifactOptions)
    scan: ScanOptions = field(default_factory=ScanOptions)
    measure: MeasureOptions = field(default_factory=MeasureOptions)
    surface: SurfaceOptions = field(default_factory=SurfaceOptions)


@dataclass(frozen=True)
class OptionEntry:
    """One option, for the help."""

    stage: str
    name: str
    kind: str
    default: Any
    help: str


def option_entries() -> tuple[OptionEntry, ...]:
    """All options with their defaults and meaning, in the order of the stages."""
    return tuple(
        OptionEntry(stage.name, f.name, _kind(f.type), f.default, str(f.metadata.get("help", "")))
        for stage in dataclasses.fields(Options)
        for f in dataclasses.fields(stage.type)  # type: ignore[arg-type]
    )


def _kind(annotation: Any) -> str:
    if typing.get_origin(annotation) is typing.Literal:
        return " | ".join(str(choice) for choice in typing.get_args(annotation))
    if typing.get_origin(annotation) in (types.UnionType, typing.Union):
        return " | ".join(_kind(part) for part in typing.get_args(annotation) if part is not type(None))
    return getattr(annotation, "__name__", str(annotation))


def options_toml() -> str:
    """A TOML file with every option at its default, commented, as ``--options`` reads it."""
    lines = ["# Options of rotaline; every line stands at its default. Give the file with --options FILE."]
    stage = ""
    for entry in option_entries():
        if entry.stage != stage:
            stage = entry.stage
            lines += ["", f"[{stage}]"]
        value = _toml_value(entry.default)
        setting = f"{entry.name} = {value}" if value is not None else f"# {entry.name} ="
        lines += [f"# {entry.help} ({entry.kind})", setting]
    return "\n".join(lines) + "\n"


def _toml_value(value: Any) -> str | None:
    if value is None:
        return None
    if isinstance(value, bool):
        return "true" if value else "false"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def read_options(path: Path | None, settings: tuple[str, ...] = ()) -> Options:
    """Options from a TOML file and from single settings ``stage.name=value``, which win.

    Raises
    ------
    SessionError
        With the file, the stage and the name of what is wrong, and what was expected.
    """
    data: dict[str, Any] = {}
    source = "--option"
    if path is not None:
        source = str(path)
        try:
            data = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise SessionError(f"{path}: the options cannot be read ({error.strerror}).") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise SessionError(f"{path}: this is not valid TOML: {error}.") from error
    for setting in settings:
        data = _with_setting(data, setting)
    kinds = {f.name: f.type for f in dataclasses.fields(Options)}
    stages: dict[str, Any] = {}
    for stage, table in data.items():
        if stage not in kinds:
            raise SessionError(f"{source}, [{stage}]: there is no such stage; expected one of {', '.join(kinds)}.")
        stages[stage] = _stage(source, stage, kinds[stage], table)
    return Options(**stages)


def _with_setting(data: dict[str, Any], setting: str) -> dict[str, Any]:
    name, equals, text = setting.partition("=")
    stage, dot, key = name.strip().partition(".")
    if not equals or not dot or not key:
        raise SessionError(f"--option {setting}: expected stage.name=value, for example stripe.method=steger.")
    try:
        value = tomllib.loads(f"value = {text.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()
    return data | {stage: dict(data.get(stage, {})) | {key: value}}


def _stage(source: str, stage: str, kind: Any, table: Any) -> Any:
    names = [f.name for f in dataclasses.fields(kind)]
    if not isinstance(table, dict):
        raise SessionError(f"{source}, {stage}: found {table!r}, expected a table [{stage}] with name = value.")
    unknown = [name for name in table if name not in names]
    if unknown:
        raise SessionError(
            f"{source}, {stage}.{unknown[0]}: there is no such option; expected one of {', '.join(names)}."
        )
    try:
        return TypeAdapter(kind).validate_python(table)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in (stage, *first["loc"]))
        raise SessionError(f"{source}, {place}: found {first['input']!r}; {first['msg'].lower()}.") from error
