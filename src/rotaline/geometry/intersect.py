"""Intersections of rays, planes and lines.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, eq. (1) and (3)
"""

import numpy as np
from jaxtyping import Float

from rotaline.errors import GeometryError
from rotaline.geometry.primitives import Plane

GRAZING_RAD = np.deg2rad(1.0)
"""A ray that runs closer than this to a plane does not fix a point on it."""

PLANE_THROUGH_CENTRE_MM = 1e-9
"""A plane nearer to the projection centre than this is seen edge-on by every ray."""


def intersect_rays_with_plane(rays_camera: Float[np.ndarray, "n 3"], plane_camera: Plane) -> Float[np.ndarray, "n 3"]:
    """Intersect viewing rays from the projection centre with a plane.

    ``p = s * ray`` meets ``normal . p + offset = 0`` at ``s = -offset / (normal . ray)`` [1]_.

    Parameters
    ----------
    rays_camera : (n, 3)   directions in the camera frame, any length
    plane_camera : Plane   in the camera frame, offset in mm

    Returns
    -------
    points_camera : (n, 3)   mm, in the order of the rays; NaN rows where a ray runs within 1 deg of the plane, meets it
        behind the camera, or is not finite

    Raises
    ------
    GeometryError
        If the plane holds the projection centre: then no pixel fixes a point.

    Examples
    --------
    >>> import numpy as np
    >>> wall = Plane(np.array([0.0, 0.0, 1.0]), -300.0)
    >>> intersect_rays_with_plane(np.array([[0.1, 0.0, 1.0], [1.0, 0.0, 0.0]]), wall)
    array([[ 30.,   0., 300.],
           [ nan,  nan,  nan]])
    """
    if not abs(plane_camera.offset) > PLANE_THROUGH_CENTRE_MM:
        raise GeometryError(
            f"The plane passes {abs(plane_camera.offset):.3g} mm from the projection centre, so the camera sees it "
            "edge-on and no pixel fixes a point on it. Move the laser away from the camera, or check the calibrated plane."
        )
    lengths = np.linalg.norm(rays_camera, axis=1)
    across = rays_camera @ plane_camera.normal
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = -plane_camera.offset / across
        usable = (np.abs(across) > np.sin(GRAZING_RAD) * lengths) & (scale > 0) & np.isfinite(scale)
    return np.where(usable[:, None], np.where(usable, scale, 0.0)[:, None] * rays_camera, np.nan)
