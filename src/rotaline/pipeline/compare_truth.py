"""Results of a rendered session against its truth: how far off the camera, the laser plane, the axis and the sizes are."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rotaline.errors import SessionError
from rotaline.geometry.primitives import Line, Plane, unit
from rotaline.io.calibration_file import read_calibration
from rotaline.io.files import read_json
from rotaline.io.truth_file import Truth, read_truth
from rotaline.vision.camera import CameraModel

VOLUME_RADIUS_MM, VOLUME_HEIGHT_MM = 25.0, 50.0
"""The measuring volume in which planes and axes are compared: about the rotation axis, from the table top up."""


@dataclass(frozen=True)
class CalibrationErrors:
    """Calibrated minus true, or the distance from the truth; None where the calibration lacks it.

    A wrong principal point turns the camera frame, and all that was calibrated in it alike; measured parts do not change.
    So plane and axes are compared after the rotation that brings the calibrated viewing rays closest to the true ones.

    Attributes
    ----------
    fx_px, fy_px, cx_px, cy_px : of the camera
    rays_px : RMS angle between calibrated and true viewing rays all over the image after the best rotation, times the focal
        length: what of the camera's error no pose can take up
    plane_rms_mm, plane_max_mm : distance of the true plane's points in the measuring volume from the calibrated plane
    plane_urad : angle between the planes
    axis_low_mm, axis_high_mm : distance of the axis from the true one at the table top, and ``VOLUME_HEIGHT_MM`` above
    axis_urad : angle between the axes
    initial_axis_low_mm, initial_axis_high_mm, initial_axis_urad : the same for the initial axis
    sense_right : whether the turntable's sense is right
    """

    fx_px: float | None = None
    fy_px: float | None = None
    cx_px: float | None = None
    cy_px: float | None = None
    rays_px: float | None = None
    plane_rms_mm: float | None = None
    plane_max_mm: float | None = None
    plane_urad: float | None = None
    axis_low_mm: float | None = None
    axis_high_mm: float | None = None
    axis_urad: float | None = None
    initial_axis_low_mm: float | None = None
    initial_axis_high_mm: float | None = None
    initial_axis_urad: float | None = None
    sense_right: bool | None = None


@dataclass(frozen=True)
class SizeError:
    """One measured size; mm. ``initial`` is the value with the axis before optimisation."""

    capture: str
    quantity: str
    true: float
    value: float
    uncertainty: float | None
    initial: float | None

    @property
    def error(self) -> float:
        """Measured less true, mm."""
        return self.value - self.true


@dataclass(frozen=True)
class Comparison:
    """All errors of a results folder."""

    calibration: CalibrationErrors
    sizes: tuple[SizeError, ...]


def truth_beside(results: Path) -> Path:
    """Where the truth of the session stands whose results folder has the default name."""
    name = results.resolve().name
    if not name.endswith("-results"):
        raise SessionError(
            f"{results}: the session of this folder is not known from its name. Name the truth with --truth FILE."
        )
    return results.resolve().with_name(name.removesuffix("-results") + ".truth.json")


def compare_with_truth(results: Path, truth_file: Path) -> Comparison:
    """Hold a results folder against the truth of its session.

    Raises
    ------
    SessionError
        If a file is missing or not what it should be.
    """
    truth = read_truth(truth_file)
    content = read_calibration(results / "calibration.json")
    return Comparison(
        calibration_errors(
            truth,
            content.camera,
            content.laser_plane_camera,
            content.rotation_axis_camera,
            content.rotation_axis_initial_camera,
            content.turn_sense,
        ),
        _size_errors(results, truth),
    )


def calibration_errors(
    truth: Truth,
    camera: CameraModel | None,
    plane: Plane | None,
    axis: Line | None,
    initial: Line | None,
    turn_sense: int,
) -> CalibrationErrors:
    """Errors of the parts of a calibration; None where a part is missing.

    Raises
    ------
    SessionError
        If the camera is for images of another size.
    """
    errors = CalibrationErrors()
    if camera is not None:
        if tuple(camera.image_size) != tuple(truth.camera.image_size):
            raise SessionError(
                f"the calibration is for images of {camera.image_size} px, the truth for {truth.camera.image_size}. "
                "They belong to different sessions; name the right truth with --truth FILE."
            )
        rotation, rays_px = best_rotation(camera, truth.camera)
        plane = None if plane is None else Plane(rotation.apply(plane.normal), plane.offset)
        axis, initial = (None if line is None else _rotated(line, rotation) for line in (axis, initial))
        errors = dataclasses.replace(
            errors,
            fx_px=camera.fx - truth.camera.fx,
            fy_px=camera.fy - truth.camera.fy,
            cx_px=camera.cx - truth.camera.cx,
            cy_px=camera.cy - truth.camera.cy,
            rays_px=rays_px,
        )
    if plane is not None:
        true = truth.laser_plane_camera
        distances = plane.signed_distance_to(_points_in_volume(truth))
        errors = dataclasses.replace(
            errors,
            plane_rms_mm=float(np.sqrt(np.mean(distances**2))),
            plane_max_mm=float(np.abs(distances).max()),
            plane_urad=_angle_urad(plane.normal, true.normal),
        )
    if axis is not None:
        low, high, angle = _axis_difference(axis, truth.rotation_axis_camera)
        same_direction = float(axis.direction @ truth.rotation_axis_camera.direction) > 0
        errors = dataclasses.replace(
            errors,
            axis_low_mm=low,
            axis_high_mm=high,
            axis_urad=angle,
            sense_right=(turn_sense == truth.turn_sense) == same_direction,
        )
    if initial is not None:
        low, high, angle = _axis_difference(initial, truth.rotation_axis_camera)
        errors = dataclasses.replace(
            errors, initial_axis_low_mm=low, initial_axis_high_mm=high, initial_axis_urad=angle
        )
    return errors


def _angle_urad(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two directions, whichever way they point."""
    return float(1e6 * np.arctan2(np.linalg.norm(np.cross(a, b)), abs(a @ b)))


def best_rotation(camera: CameraModel, true: CameraModel) -> tuple[Rotation, float]:
    """The rotation that brings the calibrated viewing rays closest to the true ones, and what is left, RMS, px.

    A wrong principal point turns the camera frame; no image tells. So this comes before any comparison in that frame.
    """
    width, height = true.image_size
    u, v = np.meshgrid(np.linspace(0.0, width - 1.0, 13), np.linspace(0.0, height - 1.0, 10))
    uv = np.column_stack([u.ravel(), v.ravel()])
    found, expected = (rays / np.linalg.norm(rays, axis=1)[:, None] for rays in (camera.rays(uv), true.rays(uv)))
    rotation, _ = Rotation.align_vectors(expected, found)
    left = np.sum((rotation.apply(found) - expected) ** 2, axis=1)
    return rotation, float(true.fx * np.sqrt(np.mean(left)))


def _rotated(line: Line, rotation: Rotation) -> Line:
    return Line(rotation.apply(line.point), rotation.apply(line.direction))


def _points_in_volume(truth: Truth) -> np.ndarray:
    """Points of the true laser plane in the measuring volume, camera frame."""
    axis, plane = truth.rotation_axis_camera, truth.laser_plane_camera
    along = unit(np.cross(axis.direction, plane.normal))
    across = np.cross(plane.normal, along)
    across = across if across @ axis.direction > 0 else -across
    start = axis.point - plane.signed_distance_to(axis.point[None])[0] * plane.normal
    x, z = np.meshgrid(np.linspace(-1, 1, 11) * VOLUME_RADIUS_MM, np.linspace(0, 1, 11) * VOLUME_HEIGHT_MM)
    return np.asarray(start + x.ravel()[:, None] * along + z.ravel()[:, None] * across)


def _axis_difference(axis: Line, true: Line) -> tuple[float, float, float]:
    """Distance at the table top and at the top of the measuring volume, mm; angle, urad."""
    ends = true.point + np.array([[0.0], [VOLUME_HEIGHT_MM]]) * true.direction
    low, high = axis.distance_to(ends)
    return float(low), float(high), _angle_urad(axis.direction, true.direction)


def _size_errors(results: Path, truth: Truth) -> tuple[SizeError, ...]:
    entries = read_json(results / "measurements.json", "list of measurements")
    initial = read_json(results / "measurements-initial-axis.json", "list of measurements")
    before = {
        (entry["capture"], entry["feature"], entry["name"], quantity): value
        for entry in initial
        for quantity, value in entry["value"].items()
    }
    rows = []
    for entry in entries:
        for quantity, true in truth.sizes.get(entry["capture"], {}).items():
            if (value := entry["value"].get(quantity)) is not None:
                key = (entry["capture"], entry["feature"], entry["name"], quantity)
                stated = entry.get("uncertainty", {}).get(quantity)
                rows.append(SizeError(entry["capture"], quantity, true, value, stated, before.get(key)))
    return tuple(rows)
