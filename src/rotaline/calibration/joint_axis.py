"""The rotation axis from all views of a board at once.

One board pose and one axis must explain where every corner is seen in every frame: least squares of the reprojection errors.
The pose of a board in a single frame is uncertain most of all along the line of sight, and circles through such poses inherit
that, the more the shorter the arc; here the known angles between the frames carry the depth.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, eq. (1), (2) and (11)
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.axis_minimisation import solve_in_blocks
from rotaline.geometry.primitives import Line
from rotaline.geometry.robust import CAUCHY, mad_scale
from rotaline.geometry.transforms import rotate_about_line
from rotaline.vision.camera import CameraModel

_MAX_ITERATIONS = 40


@dataclass(frozen=True, eq=False)
class TurnedBoard:
    """Points of the board seen in one frame: in the board frame (mm), in the image (px), and the turn about the axis (rad)."""

    points_board: Float[np.ndarray, "n 3"]
    uv: Float[np.ndarray, "n 2"]
    turn_rad: float


@dataclass(frozen=True, eq=False)
class JointAxis:
    """The axis, its standard uncertainties (larger component; position at the board), and the reprojection error."""

    axis_camera: Line
    u_direction_rad: float
    u_position_mm: float
    rms_px: float
    frame_rms_px: Float[np.ndarray, " f"]


def fit_axis_to_views(
    camera: CameraModel, frames: Sequence[TurnedBoard], axis_start: Line, camera_from_board_start: RigidTransform
) -> JointAxis:
    """Robust least squares over the axis (4 parameters) and the board's pose at turn 0 (6).

    Parameters
    ----------
    camera : CameraModel
    frames : sequence of TurnedBoard
    axis_start : Line   in the camera frame; the turns are right-handed about it
    camera_from_board_start : RigidTransform   at turn 0
    """
    points = np.concatenate([frame.points_board for frame in frames])
    uv = np.concatenate([frame.uv for frame in frames])
    turn = np.concatenate([np.full(len(frame.uv), frame.turn_rad) for frame in frames])
    of_frame = np.concatenate([np.full(len(frame.uv), f) for f, frame in enumerate(frames)])
    middle = points.mean(axis=0)
    centre = axis_start.closest_to(camera_from_board_start.apply(middle)[None])[0]
    size = max(float(np.linalg.norm(points - middle, axis=1).max()), 1.0)
    across = np.linalg.svd(axis_start.direction[None])[2][1:]
    start_centre = camera_from_board_start.apply(middle)

    def axis(x: Float[np.ndarray, "10"]) -> Line:
        direction = axis_start.direction + (x[2:4] / size) @ across
        return Line(centre + x[:2] @ across, direction / np.linalg.norm(direction))

    def residuals(x: Float[np.ndarray, "10"]) -> Float[np.ndarray, " m"]:
        turned = Rotation.from_rotvec(x[4:7] / size) * camera_from_board_start.rotation
        points_camera = turned.apply(points - middle) + start_centre + x[7:10]
        return (camera.project(rotate_about_line(points_camera, axis(x), turn)) - uv).ravel()

    x = np.zeros(10)
    for _ in range(_MAX_ITERATIONS):
        errors = residuals(x).reshape(-1, 2)
        jacobian = _slopes(residuals, x).reshape(-1, 2, 10)
        scale = CAUCHY * max(mad_scale(errors.ravel()), 1e-9)
        weight = 1.0 / (1.0 + (errors / scale) ** 2)
        root = np.sqrt(weight)
        step = solve_in_blocks((jacobian * root[..., None]).reshape(-1, 10), -(errors * root).ravel())
        x = x + step
        if np.abs(step).max() < 1e-6:
            break

    stiffness = weight**2 * (1.0 - (errors / scale) ** 2)
    inverse = np.linalg.pinv(np.einsum("nap,na,naq->pq", jacobian, stiffness, jacobian), hermitian=True)
    sums = np.zeros((len(frames), 10))
    np.add.at(sums, of_frame, np.einsum("nap,na->np", jacobian, weight * errors))
    few = len(frames) / max(
        len(frames) - 2, 1
    )  # each frame brings its own angle and pose errors; few frames, few errors seen
    cov = few * inverse @ (sums.T @ sums) @ inverse
    squares = np.sum(errors**2, axis=1)
    frame_rms = np.array([float(np.sqrt(squares[of_frame == f].mean())) for f in range(len(frames))])
    return JointAxis(
        axis(x),
        float(np.sqrt(max(np.linalg.eigvalsh(cov[2:4, 2:4]).max(), 0.0))) / size,
        float(np.sqrt(max(np.linalg.eigvalsh(cov[:2, :2]).max(), 0.0))),
        float(np.sqrt(squares.mean())),
        frame_rms,
    )


def _slopes(
    function: Callable[[Float[np.ndarray, " p"]], Float[np.ndarray, " m"]], x: Float[np.ndarray, " p"]
) -> Float[np.ndarray, "m p"]:
    """Central differences, step 1e-5 (mm)."""
    steps = 1e-5 * np.eye(len(x))
    return np.stack([(function(x + step) - function(x - step)) / 2e-5 for step in steps], axis=1)
