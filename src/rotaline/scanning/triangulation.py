"""From stripe centres to points: viewing ray meets laser sheet, then back about the axis by the table's angle.

Equations (1)-(3) and (11) of [1]_. A point of a frame taken at table angle a (right-handed about base z) has the table
coordinates that it would have in the base frame had the table stayed at angle 0, its axis where it is in the mean
(:mod:`rotaline.scanning.table_pose`).

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, sections 3.1 and 4
"""

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
from jaxtyping import Float

from rotaline.calibration.model import SystemCalibration
from rotaline.geometry.intersect import intersect_rays_with_sheet
from rotaline.geometry.primitives import Plane, SheetCurvature
from rotaline.scanning.cloud import PointCloud, read_angles_rad
from rotaline.scanning.propagation import calibration_uncertainty
from rotaline.scanning.table_pose import base_from_table, table_from_base
from rotaline.vision.camera import CameraModel
from rotaline.vision.stripe.model import StripePoints

_STEP_PX = 0.5


def triangulate(
    uv: Float[np.ndarray, "n 2"],
    camera: CameraModel,
    laser_plane_camera: Plane,
    curvature: SheetCurvature | None = None,
) -> Float[np.ndarray, "n 3"]:
    """Points of the laser sheet that the camera sees at the pixels ``uv``; ``curvature`` is None for a flat sheet.

    Returns
    -------
    points_camera : (n, 3)   mm; NaN rows where no point exists
    """
    return intersect_rays_with_sheet(camera.rays(uv), laser_plane_camera, curvature)


def stripe_uncertainty(
    stripe: StripePoints, camera: CameraModel, laser_plane_camera: Plane, curvature: SheetCurvature | None = None
) -> Float[np.ndarray, " n"]:
    """Standard uncertainty of each point from the stripe's own noise, mm: how far it moves in space when the centre
    moves along the stripe's normal by its standard uncertainty.
    """
    ahead = triangulate(stripe.uv + _STEP_PX * stripe.normal, camera, laser_plane_camera, curvature)
    behind = triangulate(stripe.uv - _STEP_PX * stripe.normal, camera, laser_plane_camera, curvature)
    return np.linalg.norm(ahead - behind, axis=1) / (2 * _STEP_PX) * stripe.u_normal_px


def scan_cloud(
    stripes: Sequence[StripePoints], angles_rad: Float[np.ndarray, " f"], calibration: SystemCalibration
) -> PointCloud:
    """One cloud in the table frame from the stripes of all frames.

    Parameters
    ----------
    stripes : one per frame; frames without a stripe are empty
    angles_rad : (f,)   ``angle_deg`` of the session in rad: sense and error of the read-out are applied here and nowhere else
    calibration : SystemCalibration

    Returns
    -------
    PointCloud   without the points that no ray fixes; ``frame`` indexes ``stripes``
    """
    turned_rad = calibration.angle_error.turned_rad(angles_rad) * calibration.turn_sense
    sheet = (calibration.camera, calibration.laser_plane_camera, calibration.laser_curvature)
    base_from_camera = calibration.base_from_camera
    eye_base = base_from_camera.apply(np.zeros(3))
    pieces: list[PointCloud] = []
    for frame, (stripe, angle) in enumerate(zip(stripes, turned_rad, strict=True)):
        points_camera = triangulate(stripe.uv, *sheet)
        good = np.isfinite(points_camera).all(axis=1)
        if not good.any():
            continue
        kept = stripe.select(good)
        n = len(kept)
        eye_table = table_from_base(eye_base[None], float(angle), calibration)
        pieces.append(
            PointCloud(
                points_table=table_from_base(base_from_camera.apply(points_camera[good]), float(angle), calibration),
                viewpoints_table=np.broadcast_to(eye_table, (n, 3)),
                intensity=kept.intensity.astype(float),
                angle_rad=np.full(n, float(angle)),
                frame=np.full(n, frame),
                u_mm=stripe_uncertainty(kept, *sheet),
                u_calibration_mm=np.full(n, np.nan),
            )
        )
    if not pieces:
        nothing = np.empty((0, 3))
        empty = np.empty(0)
        return PointCloud(nothing, nothing, empty, empty, np.empty(0, dtype=int), empty, empty)
    names = [field.name for field in fields(PointCloud)]
    cloud = PointCloud(*(np.concatenate([getattr(piece, name) for piece in pieces]) for name in names))
    return _with_calibration(cloud, calibration)


def _with_calibration(cloud: PointCloud, calibration: SystemCalibration) -> PointCloud:
    u_calibration_mm = calibration_uncertainty(cloud.points_table, cloud.angle_rad, calibration)
    return replace(cloud, u_calibration_mm=u_calibration_mm)


def move_to_axis(cloud: PointCloud, old: SystemCalibration, new: SystemCalibration) -> PointCloud:
    """The same measurements as another axis would have put them.

    ``new`` has the camera and the laser sheet of ``old``; axis, sense, angle error, run-out and wobble may be others.
    """
    new_from_old = new.base_from_camera * old.base_from_camera.inv()
    read_rad = read_angles_rad(cloud.angle_rad, old.turn_sense, old.angle_error)
    angle_new = new.angle_error.turned_rad(read_rad) * new.turn_sense

    def move(points_table: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        points_base = base_from_table(points_table, cloud.angle_rad, old)
        return table_from_base(new_from_old.apply(points_base), angle_new, new)

    moved = replace(
        cloud,
        points_table=move(cloud.points_table),
        viewpoints_table=move(np.asarray(cloud.viewpoints_table)),
        angle_rad=angle_new,
    )
    return _with_calibration(moved, new)
