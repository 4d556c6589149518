"""``session.toml``: its fields, checked, with the line of each mistake."""

import tomllib
from dataclasses import asdict
from typing import Annotated, Any, Literal, cast, get_args

from pydantic import BaseModel, ConfigDict, Field, StrictBool, ValidationError

from rotaline.calibration.speckle_limit import LaserOptics
from rotaline.errors import SessionError
from rotaline.geometry.primitives import Artifact, KnownCylinder, KnownSphere, SteppedCylinder
from rotaline.io.mistakes import no_toml, refused
from rotaline.io.toml_file import where
from rotaline.metrology.model import Region
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid, Target

SESSION_FILE = "session.toml"

Length = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Tolerance = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Count = Annotated[int, Field(ge=2)]
Feature = Literal["sphere", "cylinder", "plane", "step", "groove", "stepped-cylinder"]


class _Table(BaseModel):
    model_config = ConfigDict(extra="allow", frozen=True)


class _CheckerboardTable(_Table):
    kind: Literal["checkerboard"]
    inner_corners: tuple[Count, Count]
    pitch: Length

    def value(self) -> Checkerboard:
        return Checkerboard(self.inner_corners, self.pitch)


class _DotsTable(_Table):
    kind: Literal["dots"]
    dots: tuple[Count, Count]
    pitch: Length
    diameter: Length | None = None

    def value(self) -> DotGrid:
        return DotGrid(self.dots, self.pitch, self.diameter)


class _CharucoTable(_Table):
    kind: Literal["charuco"]
    squares: tuple[Count, Count]
    pitch: Length
    marker: Length
    dictionary: str = Field(pattern=r"^DICT_\w+$")

    def value(self) -> CharucoBoard:
        return CharucoBoard(self.squares, self.pitch, self.marker, self.dictionary)


class _SteppedCylinderTable(_Table):
    kind: Literal["stepped-cylinder"]
    diameters: tuple[Length, Length]
    heights: tuple[Length, Length]
    tolerance: Tolerance = 0.0

    def value(self) -> SteppedCylinder:
        return SteppedCylinder(*self.diameters, *self.heights, self.tolerance)


class _CylinderTable(_Table):
    kind: Literal["cylinder"]
    diameter: Length
    height: Length | None = None
    tolerance: Tolerance = 0.0

    def value(self) -> KnownCylinder:
        return KnownCylinder(self.diameter, self.height, self.tolerance)


class _SphereTable(_Table):
    kind: Literal["sphere"]
    diameter: Length
    tolerance: Tolerance = 0.0

    def value(self) -> KnownSphere:
        return KnownSphere(self.diameter, self.tolerance)


_KINDS = ("checkerboard", "dots", "charuco", "stepped-cylinder", "cylinder", "sphere")
TargetTable = Annotated[
    _CheckerboardTable | _DotsTable | _CharucoTable | _SteppedCylinderTable | _CylinderTable | _SphereTable,
    Field(discriminator="kind"),
]


class CaptureRequest(_Table):
    """A folder of frames and its role; ``target`` names a table under ``targets``, or any word for a scan."""

    folder: str = Field(min_length=1)
    role: Literal["camera", "laser-plane", "axis", "artifact", "scan"]
    target: str | None = None


class MeasurementRequest(_Table):
    """What to measure in a scan; ``nominal`` and ``region`` (mm, table frame) help to find it.

    ``check``: the part is known, and ``reference`` judges the calibration; it never takes part in one.
    """

    capture: str
    feature: Feature
    name: str = ""
    reference: dict[str, float] = Field(default_factory=dict)
    nominal: dict[str, float] = Field(default_factory=dict)
    region: Region | None = None
    check: StrictBool = False


class _OpticsTable(_Table):
    f_number: Length
    pixel_pitch_um: Length
    wavelength_nm: Length
    speckle_contrast: Annotated[float, Field(ge=0, le=1)] = 1.0

    def value(self) -> LaserOptics:
        return LaserOptics(self.f_number, self.pixel_pitch_um, self.wavelength_nm, self.speckle_contrast)


class _File(_Table):
    version: Literal[1]
    targets: dict[str, TargetTable] = Field(default_factory=dict)
    captures: list[CaptureRequest] = Field(default_factory=list)
    measurements: list[MeasurementRequest] = Field(default_factory=list)
    optics: _OpticsTable | None = None


def measurement_request(
    capture: str, feature: str, reference: dict[str, float], nominal: dict[str, float], region: Region | None
) -> MeasurementRequest:
    """A request from the command line.

    Raises
    ------
    SessionError
        If there is no such feature.
    """
    if feature not in get_args(Feature):
        raise SessionError(f"feature '{feature}': expected one of {', '.join(get_args(Feature))}.")
    return MeasurementRequest(
        capture=capture,
        feature=cast(Feature, feature),
        reference=reference,
        nominal=nominal,
        region=region,
    )


class SessionFile:
    """The content of a ``session.toml`` that was found to be right."""

    def __init__(self, content: _File) -> None:
        self.targets: dict[str, Target | Artifact] = {n: t.value() for n, t in content.targets.items()}
        self.captures = tuple(content.captures)
        self.measurements = tuple(content.measurements)
        self.optics = content.optics.value() if content.optics is not None else None


def parse_session_file(data: bytes, label: str) -> tuple[SessionFile | None, list[tuple[str, str, bool]]]:
    """Check the content of a ``session.toml``; ``label`` is the file's name for messages.

    Returns
    -------
    content : SessionFile or None
        None if something fatal was found
    problems : list of (where, text, fatal)
        All that is wrong: file, line, field; found, expected
    """
    try:
        text = data.decode("utf-8-sig")
        parsed = tomllib.loads(text)
    except UnicodeDecodeError as error:
        return None, [(label, f"the file is not UTF-8 text (byte {error.start}). Save it as UTF-8.", True)]
    except tomllib.TOMLDecodeError as error:
        line, what = no_toml(text, error)
        return None, [(f"{label}, line {line}" if line else label, what, True)]
    try:
        content = _File.model_validate(parsed)
    except ValidationError as error:
        return None, [_explain(label, text, dict(entry)) for entry in error.errors()]
    result = SessionFile(content)
    problems = _target_problems(label, text, result)
    problems += _tolerance_problems(label, text, result) + _check_problems(label, text, result)
    problems += _unknown_keys(label, text, content)
    return (None if any(fatal for _, _, fatal in problems) else result), problems


def _target_problems(path: str, text: str, content: SessionFile) -> list[tuple[str, str, bool]]:
    problems = []
    for index, capture in enumerate(content.captures):
        at = where(path, text, ("captures", index, "target"))
        target = content.targets.get(capture.target or "")
        known = ", ".join(content.targets) or "none"
        if capture.role == "scan":
            continue
        if capture.target is None:
            problems.append((at, f"role '{capture.role}' needs a target; there is {known}.", True))
        elif target is None:
            problems.append(
                (at, f"found '{capture.target}', expected the name of a table under [targets]: {known}.", True)
            )
        elif (capture.role == "artifact") != isinstance(target, Artifact):
            expected = (
                "a stepped-cylinder, cylinder or sphere"
                if capture.role == "artifact"
                else "a checkerboard, dots or charuco"
            )
            problems.append((at, f"'{capture.target}' does not suit role '{capture.role}'; expected {expected}.", True))
    for name, target in content.targets.items():
        if isinstance(target, SteppedCylinder) and target.diameter_small >= target.diameter_large:
            problems.append(
                (
                    where(path, text, ("targets", name, "diameters")),
                    f"found [{target.diameter_small}, {target.diameter_large}], expected [small (upper), large (lower)].",
                    True,
                )
            )
        if isinstance(target, CharucoBoard) and target.marker >= target.pitch:
            at = where(path, text, ("targets", name, "marker"))
            problems.append(
                (at, f"the marker ({target.marker} mm) must be smaller than its square ({target.pitch} mm).", True)
            )
        if isinstance(target, DotGrid) and target.diameter is not None and target.diameter >= target.pitch:
            at = where(path, text, ("targets", name, "diameter"))
            problems.append(
                (at, f"the dots ({target.diameter} mm) must be smaller than their pitch ({target.pitch} mm).", True)
            )
    return problems


def _tolerance_problems(path: str, text: str, content: SessionFile) -> list[tuple[str, str, bool]]:
    """Sizes that their tolerance leaves nothing of."""
    problems = []
    for name, target in content.targets.items():
        if isinstance(target, Artifact):
            sizes = [v for k, v in asdict(target).items() if k != "tolerance" and v is not None]
            if target.tolerance >= 0.1 * min(sizes):
                at = where(path, text, ("targets", name, "tolerance"))
                what = (
                    f"found {target.tolerance} mm, expected less than a tenth of the smallest size ({min(sizes)} mm)."
                )
                problems.append((at, f"{what} It is how far each size may be from what is stated.", True))
    return problems


def _check_problems(path: str, text: str, content: SessionFile) -> list[tuple[str, str, bool]]:
    """A check needs a reference, and a scan that the calibration does not use."""
    fitted = {capture.folder for capture in content.captures if capture.role == "artifact"}
    problems = []
    for index, measurement in enumerate(content.measurements):
        if not measurement.check:
            continue
        at = where(path, text, ("measurements", index, "check"))
        if not measurement.reference:
            what = "a check compares with known sizes, but there are none; expected [measurements.reference]."
            problems.append((at, what, True))
        if measurement.capture in fitted:
            what = f"'{measurement.capture}' is an artefact and takes part in the calibration, so it cannot check it; expected a scan."
            problems.append((at, what, True))
    return problems


def _unknown_keys(path: str, text: str, content: _File) -> list[tuple[str, str, bool]]:
    tables: list[tuple[tuple[Any, ...], _Table]] = [((), content)]
    tables += [(("targets", name), table) for name, table in content.targets.items()]
    tables += [(("captures", i), table) for i, table in enumerate(content.captures)]
    tables += [(("measurements", i), table) for i, table in enumerate(content.measurements)]
    tables += [(("optics",), content.optics)] if content.optics is not None else []
    return [
        (where(path, text, (*place, key)), "this key is not known and is ignored.", False)
        for place, table in tables
        for key in table.model_extra or {}
    ]


def _explain(path: str, text: str, error: dict[str, Any]) -> tuple[str, str, bool]:
    place = tuple(part for i, part in enumerate(error["loc"]) if not (i == 2 and part in _KINDS))
    kind, context = error["type"], error.get("ctx", {})
    if kind == "missing":
        if isinstance(place[-1], int):
            return where(path, text, place[:-1]), "the list is too short; expected two values.", True
        expected = "version = 1" if place == ("version",) else f"a value for '{place[-1]}'"
        return where(path, text, place[:-1], place[-1]), f"it is missing; expected {expected}.", True
    if kind.startswith("union_tag"):
        place = (*place, "kind")
        found = context.get("tag", "nothing")
        return where(path, text, place), f"found '{found}', expected one of {', '.join(_KINDS)}.", True
    if kind == "literal_error":
        hint = " This program reads version 1." if place == ("version",) else ""
        return where(path, text, place), refused(error) + hint, True
    return where(path, text, place), refused(error), True
