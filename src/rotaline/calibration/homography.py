"""Plane-to-image homographies, and the board pose that one contains.

References
----------
.. [1] Hartley, Zisserman, Multiple View Geometry, 2nd ed., algorithm 4.2 (normalised DLT)
.. [2] Zhang, IEEE Trans. PAMI 22 (2000) 1330, section 3.1 and appendix C
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.errors import GeometryError

_DEGENERATE = 1e-7


def fit_homography(plane_xy: Float[np.ndarray, "n 2"], image_xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "3 3"]:
    """Homography from a plane to an image by the normalised direct linear transform [1]_.

    ``s [u v 1]^T = H [x y 1]^T``; H is scaled so that s > 0 at the centre of the points and its norm is 1 there.

    Parameters
    ----------
    plane_xy : (n, 2)   on the plane, mm
    image_xy : (n, 2)   in the image, px or normalised; n >= 4

    Raises
    ------
    GeometryError
        If fewer than four points are given, or if they lie on a line: add points off the line.
    """
    n = len(plane_xy)
    if n < 4:
        raise GeometryError(f"A homography needs at least 4 points, found {n}.")
    to_plane, a = _normalise(plane_xy)
    to_image, b = _normalise(image_xy)
    ones, zeros = np.ones(n), np.zeros((n, 3))
    source = np.column_stack([a, ones])
    system = np.vstack(
        [
            np.hstack([source, zeros, -b[:, :1] * source]),
            np.hstack([zeros, source, -b[:, 1:] * source]),
        ]
    )
    _, singular, vt = np.linalg.svd(system, full_matrices=len(system) < 9)
    if singular[7] < _DEGENERATE * singular[0]:
        raise GeometryError(f"The {n} points lie on a line (or coincide); a homography needs points that span a plane.")
    homography = np.linalg.solve(to_image, vt[-1].reshape(3, 3)) @ to_plane
    scale = homography[2] @ [*plane_xy.mean(axis=0), 1.0]
    if scale == 0.0:
        raise GeometryError("The plane is seen edge-on: its points have no finite image.")
    return np.asarray(homography / scale)


def map_homography(
    homography: Float[np.ndarray, "3 3"], plane_xy: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 2"]:
    """Image of points of the plane."""
    mapped = np.column_stack([plane_xy, np.ones(len(plane_xy))]) @ homography.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])


def pose_from_homography(homography: Float[np.ndarray, "3 3"]) -> RigidTransform:
    """``camera_from_board`` from a homography of the board plane z = 0 to normalised image coordinates [2]_.

    The rotation is the orthogonal matrix nearest to the columns found; noise makes it a start value, not an estimate.

    Raises
    ------
    GeometryError
        If the homography is singular: the board is seen edge-on.
    """
    h1, h2, h3 = homography.T
    length = (np.linalg.norm(h1) + np.linalg.norm(h2)) / 2
    if not np.isfinite(length) or length == 0.0:
        raise GeometryError("The homography is singular: the board is seen edge-on.")
    r1, r2, t = h1 / length, h2 / length, h3 / length
    u, _, vt = np.linalg.svd(np.stack([r1, r2, np.cross(r1, r2)], axis=1))
    rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return RigidTransform.from_components(t, Rotation.from_matrix(rotation))


def _normalise(xy: Float[np.ndarray, "n 2"]) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "n 2"]]:
    """Similarity that moves points to mean 0 and mean distance sqrt(2), and the moved points."""
    centre = xy.mean(axis=0)
    size = float(np.linalg.norm(xy - centre, axis=1).mean())
    if not np.isfinite(size) or size == 0.0:
        raise GeometryError("The points coincide or are not finite; a homography needs points that span a plane.")
    scale = np.sqrt(2.0) / size
    matrix = np.array([[scale, 0.0, -scale * centre[0]], [0.0, scale, -scale * centre[1]], [0.0, 0.0, 1.0]])
    return matrix, (xy - centre) * scale
