"""Rotation about an axis in space, and the base frame that a rotation axis defines.

Poses are ``scipy.spatial.transform.RigidTransform``; ``a_from_b`` maps b to a.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, eq. (11)
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.geometry.primitives import Line, unit


def rotate_about_line(
    points: Float[np.ndarray, "n 3"], line: Line, angle_rad: float | Float[np.ndarray, " n"]
) -> Float[np.ndarray, "n 3"]:
    """Turn points about a line, right-handed about its direction (Rodrigues, eq. (11) of [1]_).

    Parameters
    ----------
    points : (n, 3)   mm
    line : Line   in the frame of the points
    angle_rad : float or (n,)   one angle for all points, or one each

    Returns
    -------
    (n, 3)   mm, same frame

    Examples
    --------
    >>> import numpy as np
    >>> axis = Line(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    >>> rotate_about_line(np.array([[2.0, 0.0, 5.0]]), axis, np.pi / 2).round(12)
    array([[1., 1., 5.]])
    """
    v = points - line.point
    cos = np.broadcast_to(np.cos(angle_rad), len(points))[:, None]
    sin = np.broadcast_to(np.sin(angle_rad), len(points))[:, None]
    along = (v @ line.direction)[:, None] * line.direction
    turned = v * cos + np.cross(line.direction, v) * sin + along * (1.0 - cos)
    return np.asarray(turned + line.point)


def base_from_axis(axis_camera: Line) -> RigidTransform:
    """Base frame of a rotation axis: ``base_from_camera``.

    z runs along the axis; the origin is ``axis_camera.point``; x points from the axis towards the camera's projection
    centre (perpendicular to z), so that x is the same in every calibration of one rig.

    Raises
    ------
    GeometryError
        If the axis runs through the projection centre: then x has no direction.
    """
    rotation = Rotation.from_matrix(base_axes(axis_camera))
    return RigidTransform.from_components(-rotation.apply(axis_camera.point), rotation)


def base_axes(axis_camera: Line) -> Float[np.ndarray, "3 3"]:
    """x, y and z of the base frame of a rotation axis (rows) in the camera frame: the rotation of :func:`base_from_axis`.

    Raises
    ------
    GeometryError
        If the axis runs through the projection centre.
    """
    z = unit(axis_camera.direction)
    towards_camera = -axis_camera.point
    x = unit(towards_camera - (towards_camera @ z) * z)
    return np.stack([x, np.cross(z, x), z])


def table_from_base(angle_rad: float) -> RigidTransform:
    """``table_from_base`` when the table stands at ``angle_rad`` (right-handed about base z).

    A point that is fixed to the table and stands at base angle phi + angle has the table angle phi.
    """
    return RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, -angle_rad]))
