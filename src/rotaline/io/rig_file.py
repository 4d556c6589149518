"""Rig files (TOML): a rig and what is to be recorded with it; and the presets, which are such files."""

import tomllib
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from rotaline.errors import RigError
from rotaline.io.mistakes import refused
from rotaline.io.rig_tables import CaptureTable, MeasurementTable, MountTable, PartTable, RigTables, TargetTable
from rotaline.io.rig_values import plan_of, rig_of, step_deg_of, views_of
from rotaline.io.toml_file import Place, text_of, toml_of, where
from rotaline.simulation.plan import SessionPlan
from rotaline.simulation.rig import Rig

T = TypeVar("T")

PRESETS = ("article", "webcam", "high-resolution", "demo")

_TARGET_ROLES = ("camera", "laser-plane", "axis")
_ARTIFACT_KINDS = ("stepped-cylinder", "cylinder", "sphere")


@dataclass(frozen=True, eq=False)
class RigFile:
    """A rig file that was found to be right.

    Attributes
    ----------
    source : the file, or "preset NAME"
    text : of the file, as it was read
    tables : what it says, with what it takes from a preset
    folder : where the files of meshes are
    """

    source: str
    text: str
    tables: RigTables
    folder: Path = Path()

    def rig(self) -> Rig:
        """The rig to be rendered.

        Raises
        ------
        RigError
            For a rig that cannot be; the message names the file.
        """
        return self.named(lambda: rig_of(self.tables))

    def plan(self, seed: int | None = None) -> SessionPlan:
        """The session to be rendered; ``seed`` instead of the file's.

        Raises
        ------
        RigError
            If a part or a target cannot be, or poses of a target do not fit into the view.
        """
        chosen = self.tables.session.seed if seed is None else seed
        return self.named(lambda: plan_of(self.tables, rig_of(self.tables), chosen, self.folder))

    def named(self, make: Callable[[], T]) -> T:
        """What ``make`` gives; each line of a :class:`RigError` that it raises gets the name of this file."""
        try:
            return make()
        except RigError as error:
            raise RigError("\n".join(f"{self.source}: {line}" for line in str(error).splitlines())) from error


def preset_text(name: str) -> str:
    """The file of a preset.

    Raises
    ------
    RigError
        If there is no such preset.
    """
    if name not in PRESETS:
        raise RigError(f"preset '{name}': there is no such preset; expected one of {', '.join(PRESETS)}.")
    return (resources.files("rotaline.io") / "rig_presets" / f"{name}.toml").read_text(encoding="utf-8")


def read_preset(name: str) -> RigFile:
    """A rig that comes with the program.

    Raises
    ------
    RigError
        If there is no such preset.
    """
    return parse_rig(preset_text(name), f"preset {name}")


def read_rig_file(path: Path) -> RigFile:
    """Read and check a rig file.

    Raises
    ------
    RigError
        With all that is wrong: file, line, field; found, expected.
    """
    text = text_of(path, "rig file", "`rotaline simulate --preset article --toml` prints one to begin with.")
    return replace(parse_rig(text, str(path)), folder=path.parent)


def parse_rig(text: str, source: str) -> RigFile:
    """Check the text of a rig file; ``source`` names it in messages.

    Raises
    ------
    RigError
        With all that is wrong: file, line, field; found, expected.
    """
    data = toml_of(source, text)
    try:
        data = _with_preset(data)
    except RigError as error:
        raise RigError(f"{where(source, text, ('preset',))}: {error}") from error
    try:
        tables = RigTables.model_validate(data)
    except ValidationError as error:
        raise RigError("\n".join(_explain(source, text, dict(entry)) for entry in error.errors())) from error
    if problems := [f"{where(source, text, place)}: {what}" for place, what in _contradictions(tables)]:
        raise RigError("\n".join(problems))
    return RigFile(source, text, tables)


def quick_look(file: RigFile) -> RigFile:
    """The same rig with half the pixels along each side, and half the frames: a sixth of the time, or less."""
    camera = file.tables.camera
    width, height = camera.image_size
    right, down = camera.principal_point_offset_px
    halved = camera.model_copy(
        update={
            "image_size": (width // 2, height // 2),
            "pixel_pitch_um": 2 * camera.pixel_pitch_um,
            "principal_point_offset_px": (right / 2, down / 2),
            "blur_px": camera.blur_px / 2,
        }
    )
    captures = [_thinned(capture) for capture in file.tables.captures]
    return replace(file, tables=file.tables.model_copy(update={"camera": halved, "captures": captures}))


def _thinned(capture: CaptureTable) -> CaptureTable:
    if capture.role in ("camera", "laser-plane"):
        return capture.model_copy(update={"views": (views_of(capture) + 1) // 2})
    if capture.frames is not None:
        return capture.model_copy(update={"frames": (capture.frames + 1) // 2})
    return capture.model_copy(update={"step_deg": 2 * step_deg_of(capture)})


def _with_preset(data: dict[str, Any]) -> dict[str, Any]:
    """The content of a file and of the preset that it is based on, which may be based on another."""
    if "preset" not in data:
        return data
    return _merged(_with_preset(tomllib.loads(preset_text(str(data["preset"])))), data)


def _merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Tables of both, key by key; lists, and targets or parts of another kind, are those of ``above``."""
    result = dict(below)
    for name, value in above.items():
        old = below.get(name)
        both = isinstance(old, dict) and isinstance(value, dict) and value.get("kind") in (None, old.get("kind"))
        result[name] = _merged(old, value) if both and old is not None else value
    return result


def _contradictions(tables: RigTables) -> list[tuple[Place, str]]:
    """What no single key tells."""
    problems: list[tuple[Place, str]] = []
    for name in tables.targets.keys() & tables.parts.keys():
        problems.append((("parts", name), f"'{name}' is the name of a target as well; give one of them another name."))
    for name, target in tables.targets.items():
        if target.kind == "charuco" and target.marker_mm >= target.pitch_mm:
            what = f"found {target.marker_mm:g}, expected less than the square's side, pitch_mm = {target.pitch_mm:g}."
            problems.append((("targets", name, "marker_mm"), what))
        if target.kind == "dots" and target.diameter_mm is not None and target.diameter_mm >= target.pitch_mm:
            what = f"found {target.diameter_mm:g}, expected less than pitch_mm = {target.pitch_mm:g}."
            problems.append((("targets", name, "diameter_mm"), what))
    for name, part in tables.parts.items():
        if part.kind == "stepped-cylinder" and part.diameters_mm[0] >= part.diameters_mm[1]:
            what = f"found {list(part.diameters_mm)}, expected [small (upper), large (lower)]."
            problems.append((("parts", name, "diameters_mm"), what))
    if tables.sensor.bit_depth != 8 and tables.session.image_format in ("jpg", "bmp"):
        what = f"'{tables.session.image_format}' holds 8 bit only and the sensor has {tables.sensor.bit_depth}; expected png or tiff."
        problems.append((("session", "image_format"), what))
    folders = [capture.folder for capture in tables.captures]
    for index, capture in enumerate(tables.captures):
        place: Place = ("captures", index)
        if capture.folder in folders[:index]:
            problems.append(((*place, "folder"), f"'{capture.folder}' is the folder of an earlier capture; rename it."))
        problems += [((*place, key), what) for key, what in _capture_contradictions(capture, tables)]
    for index, measurement in enumerate(tables.measurements):
        found = [c for c in tables.captures if c.folder == measurement.capture]
        if not found or found[0].role not in ("scan", "artifact"):
            known = ", ".join(c.folder for c in tables.captures if c.role in ("scan", "artifact")) or "none"
            what = (
                f"found '{measurement.capture}', expected the folder of a capture with role scan or artifact: {known}."
            )
            problems.append((("measurements", index, "capture"), what))
        elif measurement.check and found[0].role == "artifact":
            what = f"'{measurement.capture}' takes part in the calibration, so it cannot check it; expected a capture with role scan."
            problems.append((("measurements", index, "check"), what))
        elif measurement.check and measurement.reference is None and measurement.feature in ("plane", "step"):
            what = f"a check of a {measurement.feature} needs a reference; state it."
            problems.append((("measurements", index, "check"), what))
    return problems


def _capture_contradictions(capture: CaptureTable, tables: RigTables) -> list[tuple[str, str]]:
    problems = []
    needed, other = ("target", "part") if capture.role in _TARGET_ROLES else ("part", "target")
    names = list(getattr(tables, needed + "s"))
    name = getattr(capture, needed)
    if name not in names:
        found = "nothing" if name is None else f"'{name}'"
        problems.append(
            (
                needed,
                f"found {found}; role '{capture.role}' needs a name under [{needed}s]: {', '.join(names) or 'none'}.",
            )
        )
    elif capture.role == "artifact" and tables.parts[name].kind not in _ARTIFACT_KINDS:
        expected = "a stepped-cylinder, cylinder or sphere"
        problems.append((needed, f"'{name}' is a {tables.parts[name].kind}; role 'artifact' needs {expected}."))
    turning = ("from_deg", "to_deg", "step_deg", "frames", "shuffle")
    unfit = {
        "camera": (other, *turning, "laser_off_frames", "mount", "exposure_on_ms", "ambient_on_fraction"),
        "laser-plane": (other, *turning, "laser_off_frames", "mount"),
        "axis": (other, "views", "laser_off_frames", "mount", "exposure_on_ms", "ambient_on_fraction"),
    }.get(capture.role, (other, "views"))
    for key in unfit:
        if key in capture.model_fields_set:
            problems.append((key, f"this key says nothing for role '{capture.role}'; remove it."))
    if capture.frames is not None and capture.step_deg is not None:
        problems.append(("frames", "both frames and step_deg are given; keep one of them."))
    if capture.to_deg is not None and not 0 < abs(capture.to_deg - capture.from_deg) <= 360:
        problems.append(
            ("to_deg", f"found {capture.to_deg:g}, expected up to 360 deg from from_deg = {capture.from_deg:g}.")
        )
    return problems


def _explain(source: str, text: str, error: dict[str, Any]) -> str:
    kind, loc, context = error["type"], error["loc"], error.get("ctx", {})
    with_kind = len(loc) > 2 and loc[0] in ("targets", "parts")
    place: Place = (*loc[:2], *loc[3:]) if with_kind else tuple(loc)  # pydantic names the kind as well
    if kind == "missing" and isinstance(place[-1], int):
        return f"{where(source, text, place[:-1])}: the list is too short, a value is missing."
    if kind == "missing":
        hint = ' Or begin with a preset: preset = "article".' if len(place) == 1 else ""
        return f"{where(source, text, place[:-1], place[-1])}: it is missing; expected a value.{hint}"
    if kind == "extra_forbidden":
        return f"{where(source, text, place)}: there is no such key; expected one of {', '.join(_known_keys(loc))}."
    if kind.startswith("union_tag"):
        tag = f"'{context['tag']}'" if "tag" in context else "nothing"
        expected = ", ".join(_kinds(str(loc[0])))
        return f"{where(source, text, (*place, 'kind'))}: found {tag}, expected one of {expected}."
    return f"{where(source, text, place)}: {refused(error)}"


def _kinds(group: str) -> dict[str, type[BaseModel]]:
    """The tables that there are under ``targets`` or ``parts``, by kind."""
    union = get_args({"targets": TargetTable, "parts": PartTable}[group])[0]
    return {get_args(model.model_fields["kind"].annotation)[0]: model for model in get_args(union)}


def _known_keys(loc: Place) -> list[str]:
    """The keys that there are, where an unknown one was found."""
    group = str(loc[0])
    tables: dict[str, type[BaseModel]] = {"captures": CaptureTable, "measurements": MeasurementTable}
    if len(loc) == 1:
        model: Any = RigTables
    elif group in ("targets", "parts"):
        model = _kinds(group)[str(loc[2])]
    elif "mount" in loc[:-1]:
        model = MountTable
    else:
        model = tables.get(group) or RigTables.model_fields[group].annotation
    return list(model.model_fields)
