"""Intersections of viewing rays with planes and with slightly curved sheets of light.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, eq. (1) and (3)
"""

import numpy as np
from jaxtyping import Float

from rotaline.errors import GeometryError
from rotaline.geometry.fitting import across
from rotaline.geometry.primitives import Plane, SheetCurvature

GRAZING_RAD = np.deg2rad(1.0)
"""A ray that runs closer than this to a plane does not fix a point on it."""

PLANE_THROUGH_CENTRE_MM = 1e-9
"""A plane nearer to the projection centre than this is seen edge-on by every ray."""

ON_SHEET_MM = 1e-9
"""A point found on a curved sheet is this near to it."""

_NEWTON_STEPS = 4


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
    require_aslant(plane_camera)
    lengths = np.linalg.norm(rays_camera, axis=1)
    across = rays_camera @ plane_camera.normal
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = -plane_camera.offset / across
        usable = (np.abs(across) > np.sin(GRAZING_RAD) * lengths) & (scale > 0) & np.isfinite(scale)
    return np.where(usable[:, None], np.where(usable, scale, 0.0)[:, None] * rays_camera, np.nan)


def require_aslant(plane_camera: Plane) -> None:
    """Refuse a plane that holds the projection centre.

    Raises
    ------
    GeometryError
        If it does: then no pixel fixes a point.
    """
    if not abs(plane_camera.offset) > PLANE_THROUGH_CENTRE_MM:
        raise GeometryError(
            f"The plane passes {abs(plane_camera.offset):.3g} mm from the projection centre, so the camera sees it "
            "edge-on and no pixel fixes a point on it. Move the laser away from the camera, or check the calibrated plane."
        )


def intersect_rays_with_sheet(
    rays_camera: Float[np.ndarray, "n 3"], plane_camera: Plane, curvature: SheetCurvature | None
) -> Float[np.ndarray, "n 3"]:
    """Intersect viewing rays from the projection centre with a sheet of light: Newton's method from the plane's point.

    Parameters
    ----------
    rays_camera : (n, 3)   directions in the camera frame, any length
    plane_camera : Plane   in the camera frame, offset in mm
    curvature : how the sheet leaves the plane; None for a flat one

    Returns
    -------
    points_camera : (n, 3)   mm; NaN rows as in :func:`intersect_rays_with_plane`, and where the sheet bends so much that the plane's
        point does not lead to it

    Raises
    ------
    GeometryError
        If the plane holds the projection centre.
    """
    points = intersect_rays_with_plane(rays_camera, plane_camera)
    if curvature is None:
        return points
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(_NEWTON_STEPS):
            distance, gradient = sheet_distance(points, plane_camera, curvature)
            along = np.sum(gradient * rays_camera, axis=1)
            points = points - (distance / along)[:, None] * rays_camera
        distance, _ = sheet_distance(points, plane_camera, curvature)
        settled = (np.abs(distance) < ON_SHEET_MM) & (np.sum(points * rays_camera, axis=1) > 0)
    return np.where(settled[:, None], points, np.nan)


def sheet_distance(
    points: Float[np.ndarray, "n 3"], plane: Plane, curvature: SheetCurvature | None
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 3"]]:
    """The equation of a sheet of light at points, and its gradient.

    Returns
    -------
    distance : (n,)   ``normal . X + offset + (a u^2 + 2 b u v + c v^2) / 2``, mm: 0 on the sheet
    gradient : (n, 3)   its derivative by X
    """
    distance = plane.signed_distance_to(points)
    if curvature is None:
        return distance, np.broadcast_to(plane.normal, points.shape)
    a, b, c = curvature.coefficients
    uv, directions = sheet_coordinates(points, plane, curvature)
    slope = uv @ np.array([[a, b], [b, c]])
    return distance + np.sum(slope * uv, axis=1) / 2, plane.normal + slope @ directions


def sheet_coordinates(
    points: Float[np.ndarray, "n 3"], plane: Plane, curvature: SheetCurvature
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "2 3"]]:
    """``u, v`` of :class:`rotaline.geometry.primitives.SheetCurvature` at points, mm, and the directions along which they run."""
    directions = np.stack(across(plane.normal))
    return (points - curvature.origin) @ directions.T, directions
