"""Feature points of an ideal stepped cylinder on a turntable: the simulation of the article, section 5.4.

Four ideal circles turn about the rotation axis; at each angle the laser plane cuts them, and the cuts, in the camera frame,
are what an ideal sensor would measure.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, section 5.4, figure 11 and table 1
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.geometry.primitives import Line, Plane, SteppedCylinder, unit
from rotaline.geometry.transforms import base_from_axis

TABLE_1 = {
    "T1": ((-0.3, -0.2, -0.1), (-0.3, -0.2, -0.1)),
    "T2": ((+0.3, +0.2, +0.1), (+0.3, +0.2, +0.1)),
    "T3": ((-0.8, -0.2, +0.3), (-0.3, +0.2, +0.3)),
    "T4": ((+0.6, +0.4, +0.2), (+0.5, +0.3, +0.2)),
    "T5": ((-0.4, -0.7, -0.2), (-0.3, -0.4, +0.5)),
}
"""Deviations of Pa and Pb (mm) in the five cases of table 1."""


@dataclass(frozen=True, eq=False)
class TurntableRig:
    """A rig as far as feature points go: rotation axis (``point`` on the table top), laser plane, sense of rotation."""

    axis_camera: Line
    laser_plane_camera: Plane
    turn_sense: int

    @property
    def base_from_camera(self) -> RigidTransform:
        """Camera to base frame."""
        return base_from_axis(self.axis_camera)


def ideal_rig(
    distance_mm: float = 300.0,
    elevation_deg: float = 35.0,
    roll_deg: float = 0.0,
    laser_azimuth_deg: float = 40.0,
    laser_offset_mm: float = 0.0,
    laser_tilt_deg: float = 0.0,
    turn_sense: int = 1,
) -> TurntableRig:
    """A rig whose camera looks down on the axis, 20 mm above the table.

    Parameters
    ----------
    distance_mm, elevation_deg, roll_deg : float   of the camera: from the axis, above the table, about the optical axis
    laser_azimuth_deg : float   angle between the laser plane and the vertical plane of the camera, about the rotation axis
    laser_offset_mm, laser_tilt_deg : float   distance of the laser plane from the axis at the table; angle between plane and axis
    turn_sense : int   +1 or -1
    """
    elevation, roll = np.radians([elevation_deg, roll_deg])
    # base frame: z up, the camera stands over +x
    forward = np.array([-np.cos(elevation), 0.0, -np.sin(elevation)])
    right = np.array([0.0, 1.0, 0.0])
    down = np.cross(forward, right)
    base_from_camera = Rotation.from_matrix(
        np.stack(
            [np.cos(roll) * right + np.sin(roll) * down, np.cos(roll) * down - np.sin(roll) * right, forward], axis=1
        )
    )
    centre_base = np.array([0.0, 0.0, 20.0]) - distance_mm * forward
    camera_from_base = base_from_camera.inv()
    axis = Line(camera_from_base.apply(-centre_base), unit(camera_from_base.apply([0.0, 0.0, 1.0])))

    azimuth, tilt = np.radians([laser_azimuth_deg, laser_tilt_deg])
    normal_base = np.array([-np.sin(azimuth) * np.cos(tilt), np.cos(azimuth) * np.cos(tilt), np.sin(tilt)])
    normal = unit(camera_from_base.apply(normal_base))
    return TurntableRig(axis, Plane(normal, -float(normal @ axis.point) - laser_offset_mm), turn_sense)


def pose_on_table(
    shift_mm: tuple[float, float] = (0.0, 0.0), tilt_deg: tuple[float, float] = (0.0, 0.0)
) -> RigidTransform:
    """``base_from_part`` of a part at angle 0: shifted from the rotation axis and tilted about base x and y."""
    return RigidTransform.from_components(
        [shift_mm[0], shift_mm[1], 0.0], Rotation.from_euler("xy", tilt_deg, degrees=True)
    )


def ideal_feature_points(
    artifact: SteppedCylinder,
    rig: TurntableRig,
    base_from_part: RigidTransform,
    angles_rad: Float[np.ndarray, " f"],
) -> Float[np.ndarray, "f 4 3"]:
    """Where the laser plane cuts the four edges of a stepped cylinder at each angle of the table.

    Of the two cuts of a circle the one nearer to the camera is taken.

    Parameters
    ----------
    artifact : SteppedCylinder
    rig : TurntableRig
    base_from_part : RigidTransform   pose of the cylinder at angle 0
    angles_rad : (f,)   as the turntable shows them; the rig's sense is applied here

    Returns
    -------
    (f, 4, 3)   mm, camera frame; NaN where the plane misses the circle
    """
    camera_from_base = rig.base_from_camera.inv()
    points = np.full((len(angles_rad), 4, 3), np.nan)
    for f, angle in enumerate(angles_rad):
        turn = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, rig.turn_sense * angle]))
        camera_from_part = camera_from_base * turn * base_from_part
        for h, circle in enumerate(artifact.edge_circles_part()):
            cuts = _cut_circle(
                camera_from_part.apply(circle.centre),
                camera_from_part.rotation.apply(circle.normal),
                circle.radius,
                rig.laser_plane_camera,
            )
            points[f, h] = min(cuts, key=lambda point: float(np.linalg.norm(point)))
    return points


def _cut_circle(
    centre: Float[np.ndarray, "3"], normal: Float[np.ndarray, "3"], radius: float, plane: Plane
) -> Float[np.ndarray, "2 3"]:
    """The two points where a plane cuts a circle; NaN if it misses it."""
    along = np.cross(normal, plane.normal)
    sine = float(np.linalg.norm(along))
    towards = (
        np.cross(along, normal) / sine
    )  # in the circle's plane, across the cut; its slope against the plane is the sine
    foot = -float(plane.normal @ centre + plane.offset) / sine
    half = np.sqrt(radius**2 - foot**2) if abs(foot) <= radius else np.nan
    return centre + foot * towards + np.array([[-half], [half]]) * along / sine
