"""Figures of the rig that follow from its calibration: distances, angles, and what one pixel means on the part."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rotaline.calibration.model import SystemCalibration


@dataclass(frozen=True, eq=False)
class RigGeometry:
    """The rig about the point where the laser plane comes nearest to the axis in the middle of the image.

    Attributes
    ----------
    meeting_camera : (3,)   the point of the axis nearest to the optical axis, put into the laser plane, camera frame, mm
    camera_to_axis_mm : shortest distance from the projection centre to the rotation axis
    plane_to_optical_axis_deg : angle between the laser plane and the optical axis
    plane_to_rotation_axis_deg : angle between the laser plane and the rotation axis
    axis_to_plane_mm : distance of that point of the axis from the laser plane
    mm_per_px_across : size of a pixel on the part, at that point, perpendicular to the ray
    mm_per_px_triangulation : how far a point of the stripe moves in the laser plane when the stripe shifts by one pixel
    """

    meeting_camera: Float[np.ndarray, "3"]
    camera_to_axis_mm: float
    plane_to_optical_axis_deg: float
    plane_to_rotation_axis_deg: float
    axis_to_plane_mm: float
    mm_per_px_across: float
    mm_per_px_triangulation: float


def describe_rig(calibration: SystemCalibration) -> RigGeometry:
    """Distances, angles and resolution of a rig.

    The shift of one pixel is taken across the stripe, in the direction in the image that moves the point most.
    """
    axis, plane, camera = calibration.rotation_axis_camera, calibration.laser_plane_camera, calibration.camera
    foot = axis.closest_to(np.zeros((1, 3)))[0]
    optical = np.array([0.0, 0.0, 1.0])
    cross = np.cross(axis.direction, optical)
    nearest = foot
    if float(cross @ cross) > 1e-6:
        # the point of the axis nearest to the optical axis
        s = float(np.cross(-axis.point, optical) @ cross / (cross @ cross))
        nearest = axis.point + s * axis.direction
    distance = float(plane.signed_distance_to(nearest[None])[0])
    meeting = nearest - distance * plane.normal
    depth = float(meeting[2])
    # X = -offset / (n . ray) * ray, so a shift dx of the normalised coordinates moves X by depth (dx - ray (n . dx) / (n . ray))
    steps = np.array([[1.0 / camera.fx, 0.0, 0.0], [0.0, 1.0 / camera.fy, 0.0]])
    with np.errstate(all="ignore"):
        ray = meeting / np.float64(depth)
        moved = depth * (steps - (steps @ plane.normal / (plane.normal @ ray))[:, None] * ray)
    shift = float(np.linalg.svd(moved, compute_uv=False)[0]) if np.isfinite(moved).all() else float("nan")
    return RigGeometry(
        meeting_camera=meeting,
        camera_to_axis_mm=float(np.linalg.norm(foot)),
        plane_to_optical_axis_deg=_angle_deg(plane.normal, optical),
        plane_to_rotation_axis_deg=_angle_deg(plane.normal, axis.direction),
        axis_to_plane_mm=abs(distance),
        mm_per_px_across=depth / float(np.sqrt(camera.fx * camera.fy)),
        mm_per_px_triangulation=shift,
    )


def _angle_deg(normal: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]) -> float:
    """Angle between a plane with this normal and a direction, deg."""
    return float(np.rad2deg(np.arcsin(min(1.0, abs(float(normal @ direction))))))
