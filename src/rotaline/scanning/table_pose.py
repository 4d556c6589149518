"""How the table stands in the base frame when it has turned by an angle: turned about z, and with the movements of its axis once per turn.

Without :class:`rotaline.calibration.model.TableMotion` the table turns about z and nothing else: ``X_base = turn_z(phi) X_table``. With it, counted
from its pivot on the axis, ``X_base = tilt (turn_z(phi) X_table) + shift``.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from rotaline.calibration.model import SystemCalibration, TableMotion
from rotaline.geometry.primitives import Line
from rotaline.geometry.transforms import rotate_about_line

_BASE_Z = Line(np.zeros(3), np.array([0.0, 0.0, 1.0]))


def base_from_table(
    points_table: Float[np.ndarray, "n 3"], angle_rad: float | Float[np.ndarray, " n"], system: SystemCalibration
) -> Float[np.ndarray, "n 3"]:
    """Where points of the table stand in the base frame.

    Parameters
    ----------
    points_table : (n, 3)   mm
    angle_rad : float or (n,)   how far the table has turned, right-handed about base z: as in a cloud
    system : SystemCalibration

    Returns
    -------
    points_base : (n, 3)   mm
    """
    turned = rotate_about_line(points_table, _BASE_Z, angle_rad)
    if system.table_motion is None:
        return turned
    tilt, shift = axis_movement(angle_rad, system.table_motion)
    pivot = pivot_base(system, system.table_motion)
    return np.asarray(tilt.apply(turned - pivot) + pivot + shift)


def table_from_base(
    points_base: Float[np.ndarray, "n 3"], angle_rad: float | Float[np.ndarray, " n"], system: SystemCalibration
) -> Float[np.ndarray, "n 3"]:
    """The inverse of :func:`base_from_table`, with the same parameters: points of the table that stand at ``points_base``, mm."""
    if system.table_motion is not None:
        tilt, shift = axis_movement(angle_rad, system.table_motion)
        pivot = pivot_base(system, system.table_motion)
        points_base = np.asarray(tilt.inv().apply(points_base - pivot - shift) + pivot)
    return rotate_about_line(points_base, _BASE_Z, -angle_rad)


def directions_base_from_table(angle_rad: Float[np.ndarray, " n"], system: SystemCalibration) -> Rotation:
    """The rotations, one for each angle, that take directions on the table to the base frame."""
    turn = Rotation.from_euler("z", angle_rad[:, None])
    return turn if system.table_motion is None else axis_movement(angle_rad, system.table_motion)[0] * turn


def axis_movement(
    angle_rad: float | Float[np.ndarray, " n"], motion: TableMotion
) -> tuple[Rotation, Float[np.ndarray, "*n 3"]]:
    """Tilt and shift (mm) of the axis in the base frame with the table turned by ``angle_rad``."""
    return Rotation.from_rotvec(against_table(angle_rad, motion.wobble_rad)), against_table(
        angle_rad, motion.run_out_mm
    )


def against_table(angle_rad: float | Float[np.ndarray, " n"], vector: tuple[float, float]) -> Float[np.ndarray, "*n 3"]:
    """A vector in the plane of x and y, turned about z by the negative angle."""
    x, y = vector
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.stack([cos * x + sin * y, cos * y - sin * x, np.zeros_like(cos)], axis=-1)


def pivot_base(system: SystemCalibration, motion: TableMotion) -> Float[np.ndarray, "3"]:
    """The point of the axis about which it tilts, mm, base frame."""
    axis = system.rotation_axis_camera
    return np.array([0.0, 0.0, (motion.pivot_camera - axis.point) @ axis.direction])


def poses_table_from_camera(
    turned_rad: Float[np.ndarray, " f"], system: SystemCalibration
) -> Float[np.ndarray, "f 3 4"]:
    """Rigid motions ``[R | t]`` from the camera to the table that has turned by each angle (as in a cloud): columns of points moved."""
    far = 1024.0  # mm: the columns of R are then exact to rounding
    corners_base = system.base_from_camera.apply(np.vstack([np.eye(3) * far, np.zeros(3)]))
    n = len(turned_rad)
    moved = table_from_base(np.tile(corners_base, (n, 1)), np.repeat(turned_rad, 4), system).reshape(n, 4, 3)
    columns = np.concatenate([(moved[:, :3] - moved[:, 3:]) / far, moved[:, 3:]], axis=1)
    return np.ascontiguousarray(np.swapaxes(columns, 1, 2))


def inverse_poses(poses: Float[np.ndarray, "f 3 4"]) -> Float[np.ndarray, "f 3 4"]:
    """Rigid motions ``[R | t]`` the other way."""
    back = np.swapaxes(poses[:, :, :3], 1, 2)
    return np.ascontiguousarray(np.concatenate([back, -back @ poses[:, :, 3:]], axis=2))
