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
:func:`point_sensitivities` gives J; the uncertainties come from a compiled kernel that never holds it, with the same derivatives.

References
----------
.. [1] JCGM 102:2011, Evaluation of measurement data - Supplement 2 to the GUM, section 6.2
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from rotaline.calibration.model import SystemCalibration
from rotaline.calibration.reprojection import projection_jacobians
from rotaline.errors import GeometryError
from rotaline.geometry.fitting import across
from rotaline.geometry.intersect import intersect_rays_with_sheet, sheet_coordinates, sheet_distance
from rotaline.geometry.primitives import Plane, SheetCurvature
from rotaline.scanning.cloud import read_angles_rad
from rotaline.scanning.propagation_kernels import sum_moves
from rotaline.scanning.runs import Runs, camera_values, moved_by_runs, runs_of_equal, sheet_values
from rotaline.scanning.table_pose import (
    against_table,
    axis_movement,
    base_from_table,
    directions_base_from_table,
    inverse_poses,
    pivot_base,
    poses_table_from_camera,
)
from rotaline.vision.camera import DISTORTION_NAMES, CameraModel

_CAMERA_NAMES = ("fx", "fy", "cx", "cy", *DISTORTION_NAMES)
_SHEET_NAMES = ("plane_turn_1", "plane_turn_2", "plane_offset", "curvature_uu", "curvature_uv", "curvature_vv")
_AXIS_NAMES = ("axis_turn_x", "axis_turn_y", "axis_shift_x", "axis_shift_y")
_X, _Y, _Z = np.eye(3)
_FAR_MM = 1024.0
"""Where a linear function of the place is looked up: its slopes are then exact to rounding."""


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


@dataclass(frozen=True, eq=False)
class CovarianceFactor:
    """A factor F of the covariance, ``C = F F^T``: q independent changes of the system, each as large as its standard deviation.

    Attributes
    ----------
    by_camera : (9, q)   what they do to ``fx, fy, cx, cy, k1, k2, p1, p2, k3``
    by_sheet : (6, q)   to the turns, the offset and the curvatures of the sheet
    by_table : (r, q)   to what the table does, named in ``table_names``
    by_axis : (q, 3, 4)   how points move with the axis, camera frame: ``A X + b`` as ``[A | b]``
    level : (q,)   how far each lifts the place from which heights count, mm
    """

    by_camera: Float[np.ndarray, "9 q"]
    by_sheet: Float[np.ndarray, "6 q"]
    by_table: Float[np.ndarray, "r q"]
    table_names: tuple[str, ...]
    by_axis: Float[np.ndarray, "q 3 4"]
    level: Float[np.ndarray, " q"]


@lru_cache(maxsize=4)
def covariance_factor(system: SystemCalibration) -> CovarianceFactor | None:
    """The factor of the covariance of a system; None where it has none."""
    covariance = system.covariance
    if covariance is None:
        return None
    names, matrix = covariance.names, covariance.matrix
    # parameters differ by many orders of magnitude: of their correlations, the eigenvalues are exact to rounding
    scale = np.sqrt(np.diag(matrix))
    safe = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(matrix / np.outer(safe, safe))
    factor = scale[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
    of_level = _by_rig(_level_base(system), system)
    rises = np.array([of_level[name][0, 2] if name in of_level else 0.0 for name in names])

    def rows(wanted: Sequence[str]) -> Float[np.ndarray, "w q"]:
        chosen = np.zeros((len(wanted), len(names)))
        for row, name in zip(chosen, wanted, strict=True):
            if name in names:
                row[:] = factor[names.index(name)]
        return chosen

    base_from_camera = system.base_from_camera
    eye, pivot = base_from_camera.apply(np.stack([np.zeros(3), covariance.axis_pivot_camera]))
    of_axis = _by_axis(_corners_base(system), eye, pivot)
    axis_moves = _linear_in_camera(np.stack([of_axis[name] for name in _AXIS_NAMES]), system)
    table_names = tuple(name for name in names if name not in _CAMERA_NAMES + _SHEET_NAMES + _AXIS_NAMES)
    return CovarianceFactor(
        by_camera=rows(_CAMERA_NAMES),
        by_sheet=rows(_SHEET_NAMES),
        by_table=rows(table_names),
        table_names=table_names,
        by_axis=np.tensordot(rows(_AXIS_NAMES), axis_moves, axes=(0, 0)),
        level=rises @ factor,
    )


def calibration_uncertainty(
    points_table: Float[np.ndarray, "n 3"], angle_rad: Float[np.ndarray, " n"], system: SystemCalibration
) -> Float[np.ndarray, " n"]:
    """Standard uncertainty of each point from the calibration: root of the trace of its covariance.

    Returns
    -------
    (n,)   mm; NaN where the system has no covariance
    """
    factor = covariance_factor(system)
    u_mm = np.full(len(points_table), np.nan)
    if factor is None:
        return u_mm
    for here, runs in runs_of_equal(angle_rad):
        poses = poses_table_from_camera(runs.turned_rad, system)
        points_camera = moved_by_runs(points_table[here], runs.starts, inverse_poses(poses))
        u_mm[here] = uncertainty_in_camera(points_camera, runs, poses, system, factor)
    return u_mm


def uncertainty_in_camera(
    points_camera: Float[np.ndarray, "n 3"],
    runs: Runs,
    poses: Float[np.ndarray, "f 3 4"],
    system: SystemCalibration,
    factor: CovarianceFactor,
) -> Float[np.ndarray, " n"]:
    """:func:`calibration_uncertainty` of points where the camera saw them, mm; ``poses`` are table from camera, one a run."""
    no_weights = np.empty((0, *points_camera.shape))
    return np.sqrt(_sum_moves(points_camera, runs, poses, system, factor, no_weights)[0])


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
    factor = covariance_factor(system)
    if factor is None:
        return np.full(len(weights), np.nan)
    total = np.zeros((len(weights), len(factor.level)))
    for here, runs in runs_of_equal(angle_rad):
        poses = poses_table_from_camera(runs.turned_rad, system)
        camera_from_table = inverse_poses(poses)
        points_camera = moved_by_runs(points_table[here], runs.starts, camera_from_table)
        camera_from_table[:, :, 3] = 0.0
        weights_camera = np.stack([moved_by_runs(w[here], runs.starts, camera_from_table) for w in weights])
        total += _sum_moves(points_camera, runs, poses, system, factor, weights_camera)[1]
    return np.asarray(np.linalg.norm(total, axis=1))


def _sum_moves(
    points_camera: Float[np.ndarray, "n 3"],
    runs: Runs,
    poses: Float[np.ndarray, "f 3 4"],
    system: SystemCalibration,
    factor: CovarianceFactor,
    weights_camera: Float[np.ndarray, "k n 3"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "k q"]]:
    """The variance of each point, and the moves of k weighted sums of points under the q changes of the factor."""
    assert system.covariance is not None
    variance = np.empty(len(points_camera))
    totals = np.zeros((len(weights_camera), len(factor.level)))
    sum_moves(
        points_camera,
        runs.starts,
        camera_values(system.camera),
        sheet_values(system.laser_plane_camera, system.laser_curvature),
        tuple(float(value) for value in system.covariance.plane_pivot_camera),
        factor.by_camera,
        factor.by_sheet,
        _linear_moves(runs.turned_rad, poses, system, factor),
        weights_camera,
        variance,
        totals,
    )
    return variance, totals


def _linear_moves(
    turned_rad: Float[np.ndarray, " f"],
    poses: Float[np.ndarray, "f 3 4"],
    system: SystemCalibration,
    factor: CovarianceFactor,
) -> Float[np.ndarray, "f q 3 4"]:
    """What axis, table and level do: under each change of the factor the points of a run move by ``A X + b``, in the camera frame."""
    n, n_columns = len(turned_rad), len(factor.level)
    linear = np.tile(factor.by_axis, (n, 1, 1, 1))
    if n > 0 and factor.table_names:
        by_name = _by_table(np.tile(_corners_base(system), (n, 1)), np.repeat(turned_rad, 4), system)
        corners = np.stack([by_name[name] for name in factor.table_names]).reshape(-1, 4, 3)
        moves = np.moveaxis(_linear_in_camera(corners, system).reshape(-1, n, 12), 0, 2)
        of_table = np.ascontiguousarray(moves) @ factor.by_table
        linear += np.swapaxes(of_table, 1, 2).reshape(n, n_columns, 3, 4)
    linear[:, :, :, 3] -= factor.level[:, None] * poses[:, 2, None, :3]
    return linear


def _corners_base(system: SystemCalibration) -> Float[np.ndarray, "4 3"]:
    """Three points far along the axes of the camera frame, and its origin."""
    return system.base_from_camera.apply(np.vstack([_FAR_MM * np.eye(3), np.zeros(3)]))


def _linear_in_camera(moves_base: Float[np.ndarray, "r 4 3"], system: SystemCalibration) -> Float[np.ndarray, "r 3 4"]:
    """Moves that are linear functions of the place, from those of the corners: ``[A | b]`` in the camera frame."""
    moves = np.swapaxes(moves_base @ system.base_from_camera.rotation.as_matrix(), 1, 2)
    return np.concatenate([(moves[:, :, :3] - moves[:, :, 3:]) / _FAR_MM, moves[:, :, 3:]], axis=2)


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
