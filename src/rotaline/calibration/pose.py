"""Pose of a flat board in one image, with a known camera.

References
----------
.. [1] Zhang, IEEE Trans. PAMI 22 (2000) 1330, section 3.1 (start from a homography)
.. [2] Schweighofer, Pinz, IEEE Trans. PAMI 28 (2006) 2024 (the two poses that explain a small board)
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.homography import fit_homography, pose_from_homography
from rotaline.calibration.reprojection import (
    BoardObservation,
    covariance_from_factor,
    refine_pose,
    reprojection_residuals,
)
from rotaline.errors import GeometryError
from rotaline.vision.camera import CameraModel

_OUTLIER = 6.0
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class BoardPose:
    """Where a board stands in the camera frame.

    Attributes
    ----------
    camera_from_board : RigidTransform   mm; the board's z points away from a camera that sees its front
    residuals_px : (n, 2)   observed minus projected, for every point given
    rms_px : float   sqrt(mean |residual|^2) over the points used
    used : (n,)   False for points that do not fit the others (glare, a dot under the stripe)
    cov_pose : (6, 6)   covariance of a small motion of the board: rotation (rad) about the centre of its points, then
        translation (mm), along the camera's axes
    """

    camera_from_board: RigidTransform
    residuals_px: Float[np.ndarray, "n 2"]
    rms_px: float
    used: Bool[np.ndarray, " n"]
    cov_pose: Float[np.ndarray, "6 6"]


def estimate_board_pose(
    camera: CameraModel, points_board: Float[np.ndarray, "n 3"], uv: Float[np.ndarray, "n 2"]
) -> BoardPose:
    """Pose of a flat board from the images of its points.

    The homography of the undistorted points gives a start [1]_; the same board, with its normal mirrored in the viewing ray,
    gives the second start that a small or distant board may have [2]_. Both are refined (reprojection error, in the
    distorted image) and the better one is kept. Points far off the others are then left out and the pose refined again.

    Parameters
    ----------
    camera : CameraModel
    points_board : (n, 3)   mm, in the ``board`` frame, z = 0; n >= 4
    uv : (n, 2)   px, same order; NaN rows are left out

    Raises
    ------
    GeometryError
        If fewer than four points can be used, or if they lie on a line: then the pose is open. Use another image.
    """
    xy = camera.rays(uv)[:, :2]
    used = np.isfinite(xy).all(axis=1) & np.isfinite(uv).all(axis=1)
    if used.sum() < 4:
        raise GeometryError(f"A board pose needs at least 4 points, found {int(used.sum())}.")
    observation = BoardObservation(points_board, uv, used.astype(float))
    start = pose_from_homography(fit_homography(points_board[used, :2], xy[used]))
    pose, _, factor = min(
        (refine_pose(camera, s, observation) for s in (start, _mirrored(start, points_board[used]))),
        key=lambda refined: refined[1],
    )
    residuals = reprojection_residuals(camera, pose, observation)
    for _ in range(_ROUNDS):
        lengths = np.linalg.norm(residuals, axis=1)
        sigma = np.median(lengths[used]) / 1.1774  # median of a Rayleigh distribution
        keep = used & (lengths < _OUTLIER * max(sigma, 1e-9))
        if (keep == used).all() or keep.sum() < max(4, 0.6 * used.sum()):
            break
        try:
            fit_homography(points_board[keep, :2], uv[keep])
        except GeometryError:
            break  # what is left lies on a line
        used = keep
        observation = observation.with_weights(used.astype(float))
        pose, _, factor = refine_pose(camera, pose, observation)
        residuals = reprojection_residuals(camera, pose, observation)
    squares = float(np.sum(residuals[used] ** 2))
    variance = squares / max(2 * int(used.sum()) - 6, 1)
    return BoardPose(
        pose, residuals, float(np.sqrt(squares / used.sum())), used, covariance_from_factor(factor, variance)
    )


def _mirrored(camera_from_board: RigidTransform, points_board: Float[np.ndarray, "n 3"]) -> RigidTransform:
    """The board with its normal mirrored in the viewing ray to its centre: nearly the same picture from afar [2]_."""
    centre_board = points_board.mean(axis=0)
    centre = camera_from_board.apply(centre_board)
    ray = centre / np.linalg.norm(centre)
    normal = camera_from_board.rotation.apply([0.0, 0.0, 1.0])
    axis = np.cross(normal, ray)
    angle = np.arctan2(np.linalg.norm(axis), normal @ ray)
    length = np.linalg.norm(axis)
    if length < 1e-9:
        return camera_from_board
    turn = Rotation.from_rotvec(2 * angle * axis / length)
    rotation = turn * camera_from_board.rotation
    return RigidTransform.from_components(centre - rotation.apply(centre_board), rotation)
