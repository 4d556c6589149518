"""``calibration.json``: the calibrated system, for people, for other programs and for further sessions.

Frames: everything in the camera frame (x right, y down, z forward; mm). ``laser_plane_camera`` is normal . X + offset = 0.
``laser_curvature`` adds (uu u^2 + 2 uv u v + vv v^2) / 2 to that, where u, v are the coordinates along ``u_direction`` and
``v_direction`` from ``origin``. ``line_sigma_mm`` is the standard deviation of the laser line across the sheet, ``stripe_blur_px``
that of the image of a line without width; 0 where they are not known. ``turn_sense`` is +1 if ``angle_deg`` is right-handed about ``rotation_axis_camera.direction``;
``angle_error``: the table has turned by read + cos cos(read) + sin sin(read), rad. ``table_motion``: with the table turned by phi, its axis
stands shifted by ``run_out_mm`` and tilted by the rotation vector ``wobble_rad`` about ``pivot_camera``, both turned by -phi about z of the
base frame; null where the table just turns. ``covariance`` is that of small changes of all these, with the words that define each. Stages that were not done are null; ``quality`` has an object for each stage that was.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rotaline.calibration.model import AngleError, SystemCalibration, SystemCovariance, TableMotion
from rotaline.errors import SessionError
from rotaline.geometry.fitting import across
from rotaline.geometry.primitives import Line, Plane, SheetCurvature, unit
from rotaline.io.files import read_json, write_json
from rotaline.vision.camera import DISTORTION_NAMES, CameraModel

FORMAT = "rotaline calibration"
VERSION = 1

_Vector = tuple[float, float, float]
_Missing = tuple[None, None, None]
_Number = Annotated[float, Field(allow_inf_nan=False)]
_Spread = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]

_PLANE_TURN = "normal . X + offset grows by this times (X - plane_pivot) . {} of the plane"
_AXIS_TURN = "the axis and its frame turn about {} of the base frame, right-handed, about axis_pivot"
_AXIS_SHIFT = "the axis and its frame move along {} of the base frame"
_CURVATURE = "coefficient {} of laser_curvature"
_RUN_OUT = "table_motion.run_out_mm along {} of the base frame"
_WOBBLE = "table_motion.wobble_rad about {} of the base frame"
_PARAMETERS: dict[str, tuple[str, str]] = {
    **dict.fromkeys(("fx", "fy", "cx", "cy"), ("px", "as in camera")),
    **dict.fromkeys(DISTORTION_NAMES, ("1", "as in camera.distortion")),
    "plane_turn_1": ("rad", _PLANE_TURN.format("u_direction")),
    "plane_turn_2": ("rad", _PLANE_TURN.format("v_direction")),
    "plane_offset": ("mm", "normal . X + offset grows by this"),
    "curvature_uu": ("1/mm", _CURVATURE.format("uu")),
    "curvature_uv": ("1/mm", _CURVATURE.format("uv")),
    "curvature_vv": ("1/mm", _CURVATURE.format("vv")),
    "axis_turn_x": ("rad", _AXIS_TURN.format("x")),
    "axis_turn_y": ("rad", _AXIS_TURN.format("y")),
    "axis_shift_x": ("mm", _AXIS_SHIFT.format("x")),
    "axis_shift_y": ("mm", _AXIS_SHIFT.format("y")),
    "angle_cos": ("rad", "angle_error.cos"),
    "angle_sin": ("rad", "angle_error.sin"),
    "run_out_x": ("mm", _RUN_OUT.format("x")),
    "run_out_y": ("mm", _RUN_OUT.format("y")),
    "wobble_x": ("rad", _WOBBLE.format("x")),
    "wobble_y": ("rad", _WOBBLE.format("y")),
}
"""Units and meanings of the parameters of a covariance."""


@dataclass(frozen=True, eq=False)
class CalibrationFile:
    """The content of a calibration file; what is not known is None."""

    camera: CameraModel | None
    laser_plane_camera: Plane | None
    rotation_axis_camera: Line | None
    rotation_axis_initial_camera: Line | None
    turn_sense: int
    table_seen: bool
    quality: dict[str, dict[str, Any]]
    session: str = ""
    laser_curvature: SheetCurvature | None = None
    angle_error: AngleError = field(default_factory=AngleError)
    table_motion: TableMotion | None = None
    covariance: SystemCovariance | None = None
    line_sigma_mm: float = 0.0
    stripe_blur_px: float = 0.0

    def system(self, initial_axis: bool = False) -> SystemCalibration | None:
        """What a scan needs, or None if a part is missing. The initial axis knows no errors of the table, and has no covariance."""
        axis = self.rotation_axis_initial_camera if initial_axis else self.rotation_axis_camera
        if self.camera is None or self.laser_plane_camera is None or axis is None:
            return None
        return SystemCalibration(
            self.camera,
            self.laser_plane_camera,
            axis,
            self.turn_sense,
            self.table_seen,
            laser_curvature=self.laser_curvature,
            angle_error=AngleError() if initial_axis else self.angle_error,
            table_motion=None if initial_axis else self.table_motion,
            covariance=None if initial_axis else self.covariance,
            line_sigma_mm=self.line_sigma_mm,
            stripe_blur_px=self.stripe_blur_px,
        )


class _Strict(BaseModel):
    model_config = ConfigDict(extra="ignore")


class _Camera(_Strict):
    image_size: tuple[int, int]
    fx: _Number
    fy: _Number
    cx: _Number
    cy: _Number
    distortion: dict[str, float]


class _Plane(_Strict):
    normal: _Vector
    offset: _Number


class _Axis(_Strict):
    point: _Vector
    direction: _Vector


class _Curvature(_Strict):
    origin: _Vector
    uu: _Number
    uv: _Number
    vv: _Number


class _AngleError(_Strict):
    cos: _Number
    sin: _Number


class _TableMotion(_Strict):
    run_out_mm: tuple[_Number, _Number]
    wobble_rad: tuple[_Number, _Number]
    pivot_camera: tuple[_Number, _Number, _Number]


class _Covariance(_Strict):
    names: tuple[str, ...]
    matrix: tuple[tuple[_Number, ...], ...]
    plane_pivot_camera: _Vector | _Missing
    axis_pivot_camera: _Vector | _Missing


class _Document(_Strict):
    version: int
    camera: _Camera | None
    laser_plane_camera: _Plane | None
    laser_curvature: _Curvature | None = None
    rotation_axis_camera: _Axis | None
    rotation_axis_initial_camera: _Axis | None = None
    angle_error: _AngleError | None = None
    table_motion: _TableMotion | None = None
    covariance: _Covariance | None = None
    line_sigma_mm: _Spread = 0.0
    stripe_blur_px: _Spread = 0.0
    turn_sense: int | None = None
    table_seen: bool = False
    quality: dict[str, dict[str, Any]] = Field(default_factory=dict)
    session: str = ""


def write_calibration(path: Path, content: CalibrationFile) -> None:
    """Write a calibration file, whole or not at all."""
    camera, plane = content.camera, content.laser_plane_camera
    document: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "units": {"length": "mm", "angle": "rad", "image": "px", "pixel (0, 0)": "centre of the top-left pixel"},
        "session": content.session,
        "camera": None
        if camera is None
        else {
            "image_size": list(camera.image_size),
            "fx": camera.fx,
            "fy": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "distortion": {name: getattr(camera, name) for name in DISTORTION_NAMES},
        },
        "laser_plane_camera": None if plane is None else {"normal": plane.normal, "offset": plane.offset},
        "laser_curvature": _curvature_json(plane, content.laser_curvature),
        "line_sigma_mm": content.line_sigma_mm,
        "stripe_blur_px": content.stripe_blur_px,
        "rotation_axis_camera": _axis_json(content.rotation_axis_camera),
        "rotation_axis_initial_camera": _axis_json(content.rotation_axis_initial_camera),
        "turn_sense": None if content.rotation_axis_camera is None else content.turn_sense,
        "angle_error": {"cos": content.angle_error.cos_rad, "sin": content.angle_error.sin_rad},
        "table_motion": _table_motion_json(content.table_motion),
        "table_seen": content.table_seen,
        "covariance": _covariance_json(content.covariance),
        "quality": content.quality,
    }
    write_json(path, document)


def _axis_json(axis: Line | None) -> dict[str, Any] | None:
    return None if axis is None else {"point": axis.point, "direction": axis.direction}


def _curvature_json(plane: Plane | None, curvature: SheetCurvature | None) -> dict[str, Any] | None:
    if plane is None or curvature is None:
        return None
    u_direction, v_direction = across(plane.normal)
    uu, uv, vv = curvature.coefficients
    directions = {"u_direction": u_direction, "v_direction": v_direction}
    return {"origin": curvature.origin, **directions, "uu": uu, "uv": uv, "vv": vv}


def _table_motion_json(motion: TableMotion | None) -> dict[str, Any] | None:
    if motion is None:
        return None
    return {"run_out_mm": motion.run_out_mm, "wobble_rad": motion.wobble_rad, "pivot_camera": motion.pivot_camera}


def _covariance_json(covariance: SystemCovariance | None) -> dict[str, Any] | None:
    if covariance is None:
        return None
    return {
        "names": covariance.names,
        "units": [_PARAMETERS[name][0] for name in covariance.names],
        "meaning": {name: _PARAMETERS[name][1] for name in covariance.names},
        "plane_pivot_camera": covariance.plane_pivot_camera,
        "axis_pivot_camera": covariance.axis_pivot_camera,
        "matrix": covariance.matrix,
    }


def read_calibration(path: Path) -> CalibrationFile:
    """Read a calibration file.

    Raises
    ------
    SessionError
        If it is missing or not like one: file, field, found, expected.
    """
    data = read_json(path, "calibration file")
    try:
        document = _Document.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "document"
        raise SessionError(
            f"{path}, {place}: {first['msg'].lower()}. Expected a calibration.json as `rotaline calibrate` writes it."
        ) from error
    if document.version != VERSION:
        raise SessionError(
            f"{path}, version: found {document.version}, expected {VERSION}. Calibrate the session again."
        )
    camera, plane = document.camera, document.laser_plane_camera
    unknown = set(camera.distortion) - set(DISTORTION_NAMES) if camera else set()
    if unknown:
        raise SessionError(
            f"{path}, camera.distortion: found {', '.join(sorted(unknown))}, expected {', '.join(DISTORTION_NAMES)}."
        )
    if document.rotation_axis_camera is not None and document.turn_sense not in (1, -1):
        raise SessionError(f"{path}, turn_sense: found {document.turn_sense}, expected 1 or -1.")
    return CalibrationFile(
        camera=None
        if camera is None
        else CameraModel(camera.image_size, camera.fx, camera.fy, camera.cx, camera.cy, **camera.distortion),
        laser_plane_camera=None if plane is None else _plane(plane),
        rotation_axis_camera=_line(document.rotation_axis_camera),
        rotation_axis_initial_camera=_line(document.rotation_axis_initial_camera),
        turn_sense=document.turn_sense or 1,
        table_seen=document.table_seen,
        quality=document.quality,
        session=document.session,
        laser_curvature=_curvature(document.laser_curvature),
        angle_error=_angle_error(document.angle_error),
        table_motion=_table_motion(document.table_motion),
        covariance=_covariance(path, document),
        line_sigma_mm=document.line_sigma_mm,
        stripe_blur_px=document.stripe_blur_px,
    )


def _plane(document: _Plane) -> Plane:
    normal = np.array(document.normal)
    return Plane(unit(normal), float(document.offset / np.linalg.norm(normal)))


def _line(document: _Axis | None) -> Line | None:
    return None if document is None else Line(np.array(document.point), unit(np.array(document.direction)))


def _curvature(document: _Curvature | None) -> SheetCurvature | None:
    if document is None:
        return None
    return SheetCurvature(np.array(document.origin), (document.uu, document.uv, document.vv))


def _angle_error(document: _AngleError | None) -> AngleError:
    return AngleError() if document is None else AngleError(document.cos, document.sin)


def _table_motion(document: _TableMotion | None) -> TableMotion | None:
    if document is None:
        return None
    return TableMotion(document.run_out_mm, document.wobble_rad, np.array(document.pivot_camera))


def _covariance(path: Path, document: _Document) -> SystemCovariance | None:
    covariance = document.covariance
    if covariance is None:
        return None
    absent: tuple[str, ...] = () if document.laser_curvature is not None else ("curvature",)
    absent += () if document.table_motion is not None else ("run_out", "wobble")
    known = [name for name in _PARAMETERS if not name.startswith(absent)]
    unknown = set(covariance.names) - set(known)
    if unknown:
        raise SessionError(
            f"{path}, covariance.names: found {', '.join(sorted(unknown))}, expected some of {', '.join(known)}."
        )
    n = len(covariance.names)
    if [len(row) for row in covariance.matrix] != [n] * n:
        raise SessionError(f"{path}, covariance.matrix: expected {n} rows of {n} numbers, one for each of the names.")
    return SystemCovariance(
        covariance.names,
        np.array(covariance.matrix).reshape(n, n),
        np.array(covariance.plane_pivot_camera, dtype=float),
        np.array(covariance.axis_pivot_camera, dtype=float),
    )
