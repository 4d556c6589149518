"""What the width of the laser line takes off the diameters of balls and rods.

The centre of a stripe on a curved surface is not the image of the middle of the sheet (:mod:`rotaline.calibration.joint.line_width`): it lies off
by ``sigma^2 shift`` px along the stripe's normal. So every point of the fit is moved back: its pixel by that much, its viewing ray to the sheet
again. What these moves ``dX_i`` add to a value follows from its responses: ``sum_i responses_i normals_i . dX_i``.

The stripe's normal in the image follows from the surface: the stripe runs along the line in which surface and sheet meet.
"""

import numpy as np
from jaxtyping import Float

from rotaline.calibration.joint.line_width import crossing
from rotaline.calibration.joint.rays import RayBundle
from rotaline.calibration.model import SystemCalibration
from rotaline.calibration.stripe_shift import stripe_shift
from rotaline.geometry.intersect import sheet_distance
from rotaline.metrology.model import FeatureMeasurement
from rotaline.scanning.cloud import PointCloud
from rotaline.scanning.table_pose import base_from_table, directions_base_from_table

DIAMETER = "diameter"
"""How the keys of values begin that hang on a curved surface."""


def line_width_correction(
    measurement: FeatureMeasurement, cloud: PointCloud, system: SystemCalibration
) -> dict[str, float]:
    """What must be added to each diameter of a feature because the laser line has a width, mm; empty where the width is not known.

    Parameters
    ----------
    measurement : FeatureMeasurement   in this cloud, with its responses; values of planes need no correction and get none
    cloud : PointCloud
    system : SystemCalibration   the one that the cloud was made with
    """
    if system.line_sigma_mm == 0.0:
        return {}
    corrections = {}
    for key, response in measurement.responses.items():
        if not key.startswith(DIAMETER):
            continue
        on = np.flatnonzero(response)  # a diameter does not depend on the points of other surfaces
        normals, used = measurement.normals[on], measurement.indices[on]
        suffix = key.removeprefix(DIAMETER)
        curvature = np.full(len(on), 1.0 / np.asarray(measurement.geometry[f"radius{suffix}"]))
        axis = np.asarray(measurement.geometry.get(f"axis_direction{suffix}", np.zeros(3)))
        straight = np.tile(axis, (len(on), 1))
        moves = moves_back(cloud.points_table[used], cloud.angle_rad[used], normals, curvature, straight, system)
        corrections[key] = float(response[on] @ np.sum(normals * moves, axis=1))
    return corrections


def moves_back(
    points_table: Float[np.ndarray, "n 3"],
    angle_rad: Float[np.ndarray, " n"],
    normals_table: Float[np.ndarray, "n 3"],
    curvature: Float[np.ndarray, " n"],
    straight_table: Float[np.ndarray, "n 3"],
    system: SystemCalibration,
) -> Float[np.ndarray, "n 3"]:
    """How far points are from where a line without width would have put them.

    Parameters
    ----------
    points_table : (n, 3)   mm, on the sheet
    angle_rad : (n,)   how far the table had turned when the point was taken
    normals_table : (n, 3)   unit normals of the surface
    curvature, straight_table : (n,), (n, 3)   how it is bent (1/mm), and the unit direction in which it is straight (0: none)
    system : SystemCalibration   ``line_sigma_mm`` is the standard deviation of the line

    Returns
    -------
    (n, 3)   mm, table frame: to be added to the points
    """
    camera_from_base = system.base_from_camera.inv()
    camera_from_table = camera_from_base.rotation * directions_base_from_table(angle_rad, system)
    points = camera_from_base.apply(base_from_table(points_table, angle_rad, system))
    normals = camera_from_table.apply(normals_table)
    _, gradient = sheet_distance(points, system.laser_plane_camera, system.laser_curvature)
    sheet = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
    depth = points[:, 2]
    bundle = RayBundle.of(system.camera, system.camera.project(points))
    rays = bundle.directions
    along = _stripe_directions(bundle, np.cross(sheet, normals))
    along_px = np.einsum("nij,nj->ni", bundle.by_pixel, along)
    by_px = np.einsum("nij,nj->ni", bundle.by_pixel, np.column_stack([-along[:, 1], along[:, 0]]))
    surface = (depth, normals, curvature, camera_from_table.apply(straight_table), sheet)
    a, b = crossing(rays, by_px, *surface)
    _, d = crossing(rays, along_px, *surface)
    back_px = -stripe_shift(a, b, d, system.line_sigma_mm, system.stripe_blur_px)
    aside = np.column_stack([by_px * depth[:, None], np.zeros(len(depth))])
    along_ray = np.sum(sheet * aside, axis=1) / np.sum(sheet * rays, axis=1)
    return np.asarray(camera_from_table.inv().apply((aside - rays * along_ray[:, None]) * back_px[:, None]))


def _stripe_directions(bundle: RayBundle, tangents_camera: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 2"]:
    """Unit directions in the image of curves with these tangents in space."""
    by_xy = tangents_camera[:, :2] - bundle.directions[:, :2] * tangents_camera[:, 2:]
    along = np.linalg.solve(bundle.by_pixel, by_xy[:, :, None])[:, :, 0]
    return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True))
