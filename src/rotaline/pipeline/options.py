"""The options of every stage, from one TOML file: ``[stage]`` tables with ``name = value``."""

import dataclasses
import tomllib
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import TypeAdapter, ValidationError

from rotaline.calibration.artifact import ArtifactOptions
from rotaline.calibration.cross_ratio import CrossRatioOptions
from rotaline.calibration.intrinsics import CameraOptions
from rotaline.calibration.joint.estimate import JointOptions
from rotaline.calibration.laser_plane import LaserPlaneOptions
from rotaline.calibration.rotation_axis import AxisOptions
from rotaline.errors import SessionError
from rotaline.metrology.features import MeasureOptions
from rotaline.scanning.surface import SurfaceOptions
from rotaline.vision.stripe.extract import StripeOptions
from rotaline.vision.targets.detect import TargetOptions

Method = Literal["joint", "article"]


@dataclass(frozen=True)
class CalibrationOptions:
    """Options of the calibration as a whole."""

    method: Method = field(
        default="joint",
        metadata={
            "help": "joint: one estimate of camera, laser plane, axis and artefacts from all observations; article: one refinement "
            "after the other, with cross-ratios and feature points"
        },
    )


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
    max_points_in_memory: int = field(
        default=1_000_000,
        metadata={
            "help": "of a capture with more points, features, surface and pictures are made from every n-th; its cloud file holds all"
        },
    )


@dataclass(frozen=True)
class Options:
    """All options; one field a stage."""

    calibration: CalibrationOptions = field(default_factory=CalibrationOptions)
    targets: TargetOptions = field(default_factory=TargetOptions)
    camera: CameraOptions = field(default_factory=CameraOptions)
    stripe: StripeOptions = field(default_factory=StripeOptions)
    laser_plane: LaserPlaneOptions = field(default_factory=LaserPlaneOptions)
    cross_ratio: CrossRatioOptions = field(default_factory=CrossRatioOptions)
    axis: AxisOptions = field(default_factory=AxisOptions)
    artifact: ArtifactOptions = field(default_factory=ArtifactOptions)
    joint: JointOptions = field(default_factory=JointOptions)
    scan: ScanOptions = field(default_factory=ScanOptions)
    measure: MeasureOptions = field(default_factory=MeasureOptions)
    surface: SurfaceOptions = field(default_factory=SurfaceOptions)


ARTICLE_OPTIONS = Options(
    calibration=CalibrationOptions(method="article"),
    camera=CameraOptions(weak_parameters="free", board="flat"),
    stripe=StripeOptions(method="improved-gray-gravity", average_px=0),
    cross_ratio=CrossRatioOptions(method="sqp", tolerance=1e-8, max_iterations=150, dots="triple"),
    axis=AxisOptions(method="circles"),
    artifact=ArtifactOptions(method="sqp", tolerance=1e-8, max_iterations=150),
)
"""The method of the article: Zhang's camera as it is, three dots a row, circles, one mount, SQP on the mean distance."""


@dataclass(frozen=True)
class OptionEntry:
    """One option, for the help."""

    stage: str
    name: str
    kind: str
    default: Any
    help: str


def option_entries(defaults: Options | None = None) -> tuple[OptionEntry, ...]:
    """All options with their defaults and meaning, in the order of the stages."""
    defaults = defaults or Options()
    return tuple(
        OptionEntry(
            stage.name,
            f.name,
            _kind(f.type),
            getattr(getattr(defaults, stage.name), f.name),
            str(f.metadata.get("help", "")),
        )
        for stage in dataclasses.fields(Options)
        for f in dataclasses.fields(stage.type)  # type: ignore[arg-type]
    )


def _kind(annotation: Any) -> str:
    if typing.get_origin(annotation) is typing.Literal:
        return " | ".join(str(choice) for choice in typing.get_args(annotation))
    if typing.get_origin(annotation) in (types.UnionType, typing.Union):
        return " | ".join(_kind(part) for part in typing.get_args(annotation) if part is not type(None))
    return getattr(annotation, "__name__", str(annotation))


def options_toml(method: Method | None = None) -> str:
    """A TOML file with every option at its default (of a method), commented, as ``--options`` reads it."""
    lines = ["# Options of rotaline; every line stands at its default. Give the file with --options FILE."]
    stage = ""
    for entry in option_entries(_defaults(method)):
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


def _defaults(method: Method | None) -> Options:
    """The options of a method; None: where none was chosen."""
    if method is None:
        return Options()
    return ARTICLE_OPTIONS if method == "article" else Options(calibration=CalibrationOptions(method))


def read_options(path: Path | None, settings: tuple[str, ...] = (), method: Method | None = None) -> Options:
    """Options from a TOML file and from single settings ``stage.name=value``, which win over the file.

    ``method`` wins over ``calibration.method`` of both. Options that are not given have the default of the method: those of the article
    are :data:`ARTICLE_OPTIONS`.

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
    if method is not None:
        data = _with_setting(data, f"calibration.method={method}")
    kinds = {f.name: f.type for f in dataclasses.fields(Options)}
    unknown = [stage for stage in data if stage not in kinds]
    if unknown:
        raise SessionError(f"{source}, [{unknown[0]}]: there is no such stage; expected one of {', '.join(kinds)}.")
    defaults = Options()
    if "calibration" in data:
        stated = _stage(source, "calibration", CalibrationOptions, data["calibration"], defaults.calibration)
        defaults = _defaults(stated.method)
    stages = {s: _stage(source, s, kinds[s], table, getattr(defaults, s)) for s, table in data.items()}
    return dataclasses.replace(defaults, **stages)


def _with_setting(data: dict[str, Any], setting: str) -> dict[str, Any]:
    name, equals, text = setting.partition("=")
    stage, dot, key = name.strip().partition(".")
    if not equals or not dot or not key:
        raise SessionError(f"--option {setting}: expected stage.name=value, for example stripe.method=steger.")
    try:
        value = tomllib.loads(f"value = {text.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        value = text.strip()
    table = data.get(stage, {})
    return data | {stage: table | {key: value} if isinstance(table, dict) else table}


def _stage(source: str, stage: str, kind: Any, table: Any, defaults: Any) -> Any:
    names = [f.name for f in dataclasses.fields(kind)]
    if not isinstance(table, dict):
        raise SessionError(f"{source}, {stage}: found {table!r}, expected a table [{stage}] with name = value.")
    unknown = [name for name in table if name not in names]
    if unknown:
        raise SessionError(
            f"{source}, {stage}.{unknown[0]}: there is no such option; expected one of {', '.join(names)}."
        )
    try:
        return TypeAdapter(kind).validate_python(dataclasses.asdict(defaults) | table)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in (stage, *first["loc"]))
        raise SessionError(f"{source}, {place}: found {first['input']!r}; {first['msg'].lower()}.") from error
