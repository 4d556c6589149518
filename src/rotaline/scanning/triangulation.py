"""From stripe centres to points: viewing ray meets laser sheet, then back about the axis by the table's angle.

Equations (1)-(3) and (11) of [1]_. A point of a frame taken at table angle a (right-handed about base z) has the table
coordinates that it would have in the base frame had the table stayed at angle 0, its axis where it is in the mean
(:mod:`rotaline.scanning.table_pose`).

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, sections 3.1 and 4
"""

from collections.abc import Iterator, Sequence
from dataclasses import fields, replace

import numpy as np
from jaxtyping import Float

from rotaline.calibration.model import SystemCalibration
from rotaline.geometry.intersect import GRAZING_RAD, ON_SHEET_MM, intersect_rays_with_sheet, require_aslant
from rotaline.geometry.primitives import Plane, SheetCurvature
from rotaline.scanning.cloud import PointCloud, read_angles_rad
from rotaline.scanning.propagation import CovarianceFactor, covariance_factor, uncertainty_in_camera
from rotaline.scanning.runs import Runs, camera_values, moved_by_runs, runs_of_equal, sheet_values
from rotaline.scanning.table_pose import inverse_poses, poses_table_from_camera
from rotaline.scanning.triangulation_kernels import meet_sheet
from rotaline.vision.camera import CameraModel
from rotaline.vision.stripe.model import StripePoints

_FRAMES_AT_A_TIME = 64


def triangulate(
    uv: Float[np.ndarray, "n 2"],
    camera: CameraModel,
    laser_plane_camera: Plane,
    curvature: SheetCurvature | None = None,
) -> Float[np.ndarray, "n 3"]:
    """Points of the laser sheet that the camera sees at the pixels ``uv``; ``curvature`` is None for a flat sheet.

    The plain way, which :func:`scan_points` is held against.

    Returns
    -------
    points_camera : (n, 3)   mm; NaN rows where no point exists
    """
    return intersect_rays_with_sheet(camera.rays(uv), laser_plane_camera, curvature)


def scan_points(
    stripes: Sequence[StripePoints],
    angles_rad: Float[np.ndarray, " f"],
    calibration: SystemCalibration,
    first_frame: int = 0,
    u_angles_rad: Float[np.ndarray, " f"] | None = None,
) -> PointCloud:
    """The points of a range of frames in the table frame.

    A point depends on its own frame only: the clouds of the ranges of a capture, one after the other, are that of all its frames to the
    last bit.

    Parameters
    ----------
    stripes : one per frame; frames without a stripe are empty
    angles_rad : (f,)   ``angle_deg`` of the session in rad: sense and error of the read-out are applied here and nowhere else
    calibration : SystemCalibration
    first_frame : the number of the first of these frames in the capture
    u_angles_rad : (f,)   standard uncertainty of each angle, 0 where none is known; None: of all of them

    Returns
    -------
    PointCloud   without the points that no ray fixes; ``frame`` is ``first_frame`` plus the index in ``stripes``. ``u_mm`` is how far
        the point moves in space when the centre moves along the stripe's normal by its standard uncertainty, and the table by that of
        the frame's angle, which is common to the points of the frame

    Raises
    ------
    GeometryError
        If the laser plane holds the projection centre.
    ValueError
        If there are not as many angles as stripes.
    """
    if len(stripes) != len(angles_rad):
        raise ValueError(f"{len(stripes)} stripes, but {len(angles_rad)} angles")
    if u_angles_rad is None:
        u_angles_rad = np.zeros(len(angles_rad))
    require_aslant(calibration.laser_plane_camera)
    turned_rad = calibration.angle_error.turned_rad(angles_rad) * calibration.turn_sense
    if len(stripes) <= _FRAMES_AT_A_TIME:
        return next(_scan_by_blocks(stripes, turned_rad, u_angles_rad, calibration, first_frame))
    n = 0
    columns: dict[str, np.ndarray] = {}
    for piece in _scan_by_blocks(stripes, turned_rad, u_angles_rad, calibration, first_frame):
        for field in fields(piece):
            values = getattr(piece, field.name)
            if field.name not in columns:
                columns[field.name] = np.empty((sum(map(len, stripes)), *values.shape[1:]), values.dtype)
            columns[field.name][n : n + len(piece)] = values
        n += len(piece)
    return PointCloud(**{name: column[:n] for name, column in columns.items()})


def _scan_by_blocks(
    stripes: Sequence[StripePoints],
    turned_rad: Float[np.ndarray, " f"],
    u_angles_rad: Float[np.ndarray, " f"],
    calibration: SystemCalibration,
    first_frame: int,
) -> Iterator[PointCloud]:
    """At least one cloud; each of some frames, so that what is needed in between stays small."""
    camera = camera_values(calibration.camera)
    sheet = sheet_values(calibration.laser_plane_camera, calibration.laser_curvature)
    factor = covariance_factor(calibration)
    for first in range(0, max(len(stripes), 1), _FRAMES_AT_A_TIME):
        block = stripes[first : first + _FRAMES_AT_A_TIME]
        counts = [len(stripe) for stripe in block]
        n = sum(counts)
        uv, normal, u_px, intensity = np.empty((n, 2)), np.empty((n, 2)), np.empty(n), np.empty(n)
        runs = Runs(turned_rad[first : first + len(block)], np.cumsum([0, *counts]))
        for k, stripe in enumerate(block):
            here = slice(runs.starts[k], runs.starts[k + 1])
            uv[here], normal[here] = stripe.uv, stripe.normal
            u_px[here], intensity[here] = stripe.u_normal_px, stripe.intensity
        points_camera, u_mm = np.empty((n, 3)), np.empty(n)
        meet_sheet(uv, normal, u_px, camera, sheet, np.sin(GRAZING_RAD), ON_SHEET_MM, points_camera, u_mm)
        points_table, viewpoints_table, u_calibration_mm = _on_table(points_camera, runs, calibration, factor)
        u_mm = _with_angle_noise(u_mm, points_table, np.repeat(u_angles_rad[first : first + len(block)], counts))
        frame = np.repeat(np.arange(first, first + len(block)) + first_frame, counts)
        angle_rad = np.repeat(runs.turned_rad, counts)
        cloud = PointCloud(points_table, viewpoints_table, intensity, angle_rad, frame, u_mm, u_calibration_mm)
        good = np.isfinite(points_camera[:, 2])
        yield cloud if good.all() else cloud.select(good)


def _with_angle_noise(
    u_mm: Float[np.ndarray, " n"], points_table: Float[np.ndarray, "n 3"], u_angle_rad: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Uncertainties to which that of the frame's angle is added: it moves a point by its distance from the axis, at right angles to that."""
    if not u_angle_rad.any():
        return u_mm
    return np.hypot(u_mm, u_angle_rad * np.hypot(points_table[:, 0], points_table[:, 1]))


def _on_table(
    points_camera: Float[np.ndarray, "n 3"], runs: Runs, system: SystemCalibration, factor: CovarianceFactor | None
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Points in the table frame, where the camera stood then, and the uncertainty from the calibration."""
    poses = poses_table_from_camera(runs.turned_rad, system)
    if factor is None:
        u_calibration_mm = np.full(len(points_camera), np.nan)
    else:
        u_calibration_mm = uncertainty_in_camera(points_camera, runs, poses, system, factor)
    viewpoints_table = np.repeat(poses[:, :, 3], np.diff(runs.starts), axis=0)
    return moved_by_runs(points_camera, runs.starts, poses), viewpoints_table, u_calibration_mm


def move_to_axis(cloud: PointCloud, old: SystemCalibration, new: SystemCalibration) -> PointCloud:
    """The same measurements as another axis would have put them.

    ``new`` has the camera and the laser sheet of ``old``; axis, sense, angle error, run-out and wobble may be others.
    """
    n = len(cloud)
    points_table, viewpoints_table = np.empty((n, 3)), np.empty((n, 3))
    angle_rad, u_calibration_mm = np.empty(n), np.empty(n)
    factor = covariance_factor(new)
    for here, runs in runs_of_equal(cloud.angle_rad):
        camera_from_table = inverse_poses(poses_table_from_camera(runs.turned_rad, old))
        points_camera = moved_by_runs(cloud.points_table[here], runs.starts, camera_from_table)
        read_rad = read_angles_rad(runs.turned_rad, old.turn_sense, old.angle_error)
        runs = Runs(new.angle_error.turned_rad(read_rad) * new.turn_sense, runs.starts)
        points_table[here], viewpoints_table[here], u_calibration_mm[here] = _on_table(points_camera, runs, new, factor)
        angle_rad[here] = np.repeat(runs.turned_rad, np.diff(runs.starts))
    return replace(
        cloud,
        points_table=points_table,
        viewpoints_table=viewpoints_table,
        angle_rad=angle_rad,
        u_calibration_mm=u_calibration_mm,
    )
