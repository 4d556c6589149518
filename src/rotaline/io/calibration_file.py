"""``calibration.json``: the calibrated system, for people, for other programs and for further sessions.

Frames: everything in the camera frame (x right, y down, z forward; mm). ``laser_plane_camera`` is normal . X + offset = 0.
``turn_sense`` is +1 if ``angle_deg`` is right-handed about ``rotation_axis_camera.direction``. Stages that were not done are
null; ``quality`` has an object for each stage that was.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from rotaline.calibration.model import SystemCalibration
from rotaline.errors import SessionError
from rotaline.geometry.primitives import Line, Plane, unit
from rotaline.io.files import read_json, write_json
from rotaline.vision.camera import DISTORTION_NAMES, CameraModel

FORMAT = "rotaline calibration"
VERSION = 1

_Vector = tuple[float, float, float]
_Number = Annotated[float, Field(allow_inf_nan=False)]


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

    def system(self, initial_axis: bool = False) -> SystemCalibration | None:
        """What a scan needs, or None if a part is missing."""
        axis = self.rotation_axis_initial_camera if initial_axis else self.rotation_axis_camera
        if self.camera is None or self.laser_plane_camera is None or axis is None:
            return None
        return SystemCalibration(self.camera, self.laser_plane_camera, axis, self.turn_sense, self.table_seen)


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


class _Document(_Strict):
    version: int
    camera: _Camera | None
    laser_plane_camera: _Plane | None
    rotation_axis_camera: _Axis | None
    rotation_axis_initial_camera: _Axis | None = None
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
        "rotation_axis_camera": _axis_json(content.rotation_axis_camera),
        "rotation_axis_initial_camera": _axis_json(content.rotation_axis_initial_camera),
        "turn_sense": None if content.rotation_axis_camera is None else content.turn_sense,
        "table_seen": content.table_seen,
        "quality": content.quality,
    }
    write_json(path, document)


def _axis_json(axis: Line | None) -> dict[str, Any] | None:
    return None if axis is None else {"point": axis.point, "direction": axis.direction}


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
    )


def _plane(document: _Plane) -> Plane:
    normal = np.array(document.normal)
    return Plane(unit(normal), float(document.offset / np.linalg.norm(normal)))


def _line(document: _Axis | None) -> Line | None:
    return None if document is None else Line(np.array(document.point), unit(np.array(document.direction)))
