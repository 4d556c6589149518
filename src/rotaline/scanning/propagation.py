"""What errors of the calibration do to measured points: small changes of the system, same pixels.

All points share the errors of camera, laser sheet, axis and angle read-out, so these do not average out. A point X that the camera
sees at a pixel moves by ``dX = J dp`` when the parameters p of :class:`rotaline.calibration.model.SystemCovariance` change by dp:

- camera: the ray ``(x, y, 1)`` of the pixel turns, and meets the sheet elsewhere;
- sheet, its equation g(X) = 0 changes by dg: the point slides along its ray by ``-dg / (grad g . ray)``;
- axis: the base frame moves, the point stays; its coordinates change by ``-w x (X - pivot) - s``. The x axis of the base frame goes
  on pointing to the camera, which turns the frame about z;
- angle: the point turns about z;
- run-out and wobble: the axis moves away under the point, which is ``-s`` and ``-w x (X - pivot)`` again, turned against the table.

Where z = 0 lies follows from the same scan (the table top). So heights count from the place where the sheet comes nearest to the
origin: what lifts the whole cloud lifts z = 0 with it, and is no error of any point. What the table does lifts and lowers its top over a
turn, and leaves z = 0 in place.

The covariance of a point is ``J C J^T`` [1]_, that of a quantity that depends on many points ``c C c^T`` with ``c = sum_i w_i J_i``.

References
----------
.. [1] JCGM 102:2011, Evaluation of measurement data - Supplement 2 to the GUM, section 6.2
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from rotaline.calibration.model import SystemCalibration
from rotaline.calibration.reprojection import projection_jacobians
from rotaline.errors import GeometryError
from rotaline.geometry.fitting import across
from rotaline.geometry.intersect import intersect_rays_with_sheet, sheet_coordinates, sheet_distance
from rotaline.geometry.primitives import Plane, SheetCurvature
from rotaline.scanning.cloud import read_angles_rad
from rotaline.scanning.table_pose import (
    against_table,
    axis_movement,
    base_from_table,
    directions_base_from_table,
    pivot_base,
)
from rotaline.vision.camera import DISTORTION_NAMES, CameraModel

_CAMERA_NAMES = ("fx", "fy", "cx", "cy", *DISTORTION_NAMES)
_X, _Y, _Z = np.eye(3)
_BLOCK = 8192
"""Points whose derivatives are in memory at a time."""


def point_sensitivities(
    points_table: Float[np.ndarray, "n 3"], angle_rad: Float[np.ndarray, " n"], system: SystemCalibration
) -> Float[np.ndarray, "n 3 p"]:
    """Derivatives of points of a cloud by the parameters that the covariance of the system names.

    Parameters
    ----------
    points_table : (n, 3)   mm
    angle_rad : (n,)   how far the table had turned when the point was taken, as in a cloud
    system : SystemCalibration   the one that the cloud was made with

    Returns
    -------
    (n, 3, p)   mm per unit of the parameter, table frame; columns in the order of ``system.covariance.names``

    Raises
    ------
    GeometryError
        If the system has no covariance.
    """
    if system.covariance is None:
        raise GeometryError("This calibration has no covariance, so that the uncertainty of points is not known.")
    names = system.covariance.names
    points_base = base_from_table(points_table, angle_rad, system)
    in_base = _by_rig(points_base, system) | _by_table(points_base, angle_rad, system)
    table_from_base = np.swapaxes(directions_base_from_table(angle_rad, system).as_matrix(), 1, 2)
    in_table = table_from_base @ np.stack([in_base[name] for name in names], axis=2)
    of_level = _by_rig(_level_base(system), system)
    in_table[:, 2] -= [of_level[name][0, 2] if name in of_level else 0.0 for name in names]
    return np.asarray(in_table)


def calibration_uncertainty(
    points_table: Float[np.ndarray, "n 3"], angle_rad: Float[np.ndarray, " n"], system: SystemCalibration
) -> Float[np.ndarray, " n"]:
    """Standard uncertainty of each point from the calibration: root of the trace of its covariance.

    Returns
    -------
    (n,)   mm; NaN where the system has no covariance
    """
    if system.covariance is None:
        return np.full(len(points_table), np.nan)
    matrix = system.covariance.matrix
    variance = np.empty(len(points_table))
    for start in range(0, len(points_table), _BLOCK):
        block = slice(start, start + _BLOCK)
        jacobian = point_sensitivities(points_table[block], angle_rad[block], system)
        variance[block] = np.sum((jacobian @ matrix) * jacobian, axis=(1, 2))
    return np.sqrt(np.maximum(variance, 0.0))


def combination_uncertainty(
    weights: Float[np.ndarray, "k n 3"],
    points_table: Float[np.ndarray, "n 3"],
    angle_rad: Float[np.ndarray, " n"],
    system: SystemCalibration,
) -> Float[np.ndarray, " k"]:
    """Standard uncertainty from the calibration of k quantities that change by ``sum_i weights[k, i] . dX_i``.

    Returns
    -------
    (k,)   in the unit of weight times mm; NaN where the system has no covariance
    """
    if system.covariance is None:
        return np.full(len(weights), np.nan)
    matrix = system.covariance.matrix
    total = np.zeros((len(weights), len(matrix)))
    for start in range(0, len(points_table), _BLOCK):
        block = slice(start, start + _BLOCK)
        jacobian = point_sensitivities(points_table[block], angle_rad[block], system)
        total += np.tensordot(weights[:, block], jacobian, axes=2)
    return np.sqrt(np.maximum(np.sum((total @ matrix) * total, axis=1), 0.0))


def _level_base(system: SystemCalibration) -> Float[np.ndarray, "1 3"]:
    """The point from which heights count: of the sheet, nearest to the origin of the base frame."""
    plane, origin = system.laser_plane_camera, system.rotation_axis_camera.point
    nearest = origin - plane.signed_distance_to(origin[None])[0] * plane.normal
    on_sheet = intersect_rays_with_sheet(nearest[None], plane, system.laser_curvature)
    return system.base_from_camera.apply(on_sheet)


def _by_rig(points_base: Float[np.ndarray, "n 3"], system: SystemCalibration) -> dict[str, Float[np.ndarray, "n 3"]]:
    """Derivatives of points in the base frame by camera, sheet and axis."""
    covariance = system.covariance
    assert covariance is not None
    base_from_camera = system.base_from_camera
    points_camera = base_from_camera.inv().apply(points_base)
    plane, curvature = system.laser_plane_camera, system.laser_curvature
    in_camera = _by_camera(points_camera, system.camera, plane, curvature, covariance.names)
    in_camera |= _by_sheet(points_camera, plane, curvature, covariance.plane_pivot_camera)
    in_base = _by_axis(
        points_base,
        base_from_camera.apply(np.zeros(3)),
        base_from_camera.apply(covariance.axis_pivot_camera),
    )
    rotation = base_from_camera.rotation.as_matrix()
    return {name: column @ rotation.T for name, column in in_camera.items()} | in_base


def _by_table(
    points_base: Float[np.ndarray, "n 3"], angle_rad: Float[np.ndarray, " n"], system: SystemCalibration
) -> dict[str, Float[np.ndarray, "n 3"]]:
    """Derivatives by the angle read-out, and by run-out and wobble: how points fixed in space move on the table, in directions of the base frame."""
    read_rad = read_angles_rad(angle_rad, system.turn_sense, system.angle_error)
    motion = system.table_motion
    moves = {}
    around = -np.cross(_Z, points_base)
    if motion is not None:
        tilt, shift = axis_movement(angle_rad, motion)
        arms = points_base - pivot_base(system, motion)
        untilted = tilt.inv().apply(arms - shift)
        # the table turns by one angle, shift and tilt turn back by it
        around = np.cross(_Z, arms) - 2.0 * tilt.apply(np.cross(_Z, untilted))
        for name, direction in (("x", (1.0, 0.0)), ("y", (0.0, 1.0))):
            along = against_table(angle_rad, direction)
            turn = along + 0.5 * np.cross(tilt.as_rotvec(), along)  # rotations do not commute
            moves[f"run_out_{name}"] = -along
            moves[f"wobble_{name}"] = -np.cross(turn, arms - shift)
    around = system.turn_sense * around
    return moves | {"angle_cos": around * np.cos(read_rad)[:, None], "angle_sin": around * np.sin(read_rad)[:, None]}


def _by_camera(
    points_camera: Float[np.ndarray, "n 3"],
    camera: CameraModel,
    plane: Plane,
    curvature: SheetCurvature | None,
    names: Sequence[str],
) -> dict[str, Float[np.ndarray, "n 3"]]:
    """The pixel stays, so that d(uv) = (d uv / d p) dp + (d uv / d xy) d(xy) = 0; the ray (x, y, 1) meets the sheet again."""
    known = [name for name in names if name in _CAMERA_NAMES]
    z = points_camera[:, 2:]
    rays = points_camera / z
    _, by_parameter, _ = projection_jacobians(camera, points_camera, known)
    by_xy = np.array([[camera.fx], [camera.fy]]) * camera.distort_jacobian(rays[:, :2])
    xy = -np.linalg.solve(by_xy, by_parameter)
    _, gradient = sheet_distance(points_camera, plane, curvature)
    slope = np.sum(gradient * rays, axis=1, keepdims=True)
    result = {}
    for k, name in enumerate(known):
        aside = np.column_stack([xy[:, :, k], np.zeros(len(xy))]) * z
        result[name] = aside - rays * (np.sum(gradient * aside, axis=1, keepdims=True) / slope)
    return result


def _by_sheet(
    points_camera: Float[np.ndarray, "n 3"],
    plane: Plane,
    curvature: SheetCurvature | None,
    pivot_camera: Float[np.ndarray, "3"],
) -> dict[str, Float[np.ndarray, "n 3"]]:
    """The point slides along its ray until it is on the sheet again."""
    rays = points_camera / points_camera[:, 2:]
    _, gradient = sheet_distance(points_camera, plane, curvature)
    slide = -rays / np.sum(gradient * rays, axis=1, keepdims=True)
    arms = points_camera - pivot_camera
    e1, e2 = across(plane.normal)
    changes = {"plane_turn_1": arms @ e1, "plane_turn_2": arms @ e2, "plane_offset": np.ones(len(arms))}
    if curvature is not None:
        u, v = sheet_coordinates(points_camera, plane, curvature)[0].T
        changes |= {"curvature_uu": u * u / 2, "curvature_uv": u * v, "curvature_vv": v * v / 2}
    return {name: slide * change[:, None] for name, change in changes.items()}


def _by_axis(
    points_base: Float[np.ndarray, "n 3"], eye_base: Float[np.ndarray, "3"], pivot_base: Float[np.ndarray, "3"]
) -> dict[str, Float[np.ndarray, "n 3"]]:
    """The frame moves with the axis, then turns about z until the eye has y = 0 again."""
    result = {}
    for name, turn, shift in (
        ("axis_turn_x", _X, 0.0 * _X),
        ("axis_turn_y", _Y, 0.0 * _Y),
        ("axis_shift_x", 0.0 * _X, _X),
        ("axis_shift_y", 0.0 * _Y, _Y),
    ):
        eye_moves = -np.cross(turn, eye_base - pivot_base) - shift
        moves = -np.cross(turn, points_base - pivot_base) - shift
        result[name] = moves - np.cross(_Z, points_base) * (eye_moves[1] / eye_base[0])
    return result
