"""Reprojection errors of boards: analytic derivatives, and least squares over camera and poses at once.

A pose moves by ``p -> exp([w]x) p + t`` in the camera frame, about the board's centre, so that turn and shift hardly
correlate. The poses are eliminated view by view with orthogonal factors (never by normal equations, which would square the
condition number); what is left is a small system in the camera's parameters.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, eq. (1) and (2)
.. [2] Zhang, IEEE Trans. PAMI 22 (2000) 1330, section 3.2
.. [3] Golub, Pereyra, Inverse Problems 19 (2003) R1 (separating variables by orthogonal factors)
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.vision.camera import CameraModel

MAX_ITERATIONS = 60
_DAMPING = 1e-6
_ROUNDING = 1e-10
"""Relative change of the sum of squares that no longer counts: far below a hundredth of a standard deviation."""


@dataclass(frozen=True, eq=False)
class BoardObservation:
    """Points of one board in one image; ``weights`` are square roots of weights, 0 leaves a point out.

    Where the board is not flat, its points lie at ``bend_basis @ bend`` (mm) above ``points_board``, along its z axis.
    """

    points_board: Float[np.ndarray, "n 3"]
    uv: Float[np.ndarray, "n 2"]
    weights: Float[np.ndarray, " n"]
    bend_basis: Float[np.ndarray, "n m"] | None = None
    bend: Float[np.ndarray, " m"] | None = None

    def with_weights(self, weights: Float[np.ndarray, " n"]) -> "BoardObservation":
        """The same points with other weights."""
        return replace(self, weights=weights)

    def with_bend(self, bend: Float[np.ndarray, " m"] | None) -> "BoardObservation":
        """The same points on a board of another shape; None for a flat one."""
        return replace(self, bend=bend)

    def with_offsets(self, offsets: Float[np.ndarray, "n 2"]) -> "BoardObservation":
        """The same points, each shifted in x and y of the board by its offset, mm."""
        return replace(self, points_board=self.points_board + np.pad(offsets, ((0, 0), (0, 1))))

    @property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """The points where they are on the board, bent or flat, mm."""
        if self.bend is None or self.bend_basis is None:
            return self.points_board
        return self.points_board + np.outer(self.bend_basis @ self.bend, [0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Prior:
    """What is known of the camera beforehand: ``rows @ parameters = values``, each to one ``sigma_px`` of the residuals.

    The rows are already divided by the standard uncertainty of what they say (times one pixel).
    """

    rows: Float[np.ndarray, "m p"]
    values: Float[np.ndarray, " m"]


@dataclass(frozen=True, eq=False)
class BundleFit:
    """Camera, poses and, where asked for, the bend of the boards, of least weighted squares.

    ``information`` is the factor R of the camera's parameters, then those of the bend, with the poses eliminated:
    cov = s^2 (R^T R)^-1. ``gradients[v]`` and ``blocks[v]`` are view v's share in R^T r and R^T R.
    """

    camera: CameraModel
    poses: tuple[RigidTransform, ...]
    cost: float
    information: Float[np.ndarray, "p p"]
    gradients: Float[np.ndarray, "v p"]
    blocks: Float[np.ndarray, "v p p"]
    converged: bool
    bend: Float[np.ndarray, " m"]


def projection_jacobians(
    camera: CameraModel, points_camera: Float[np.ndarray, "n 3"], names: Sequence[str] = ()
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2 p"], Float[np.ndarray, "n 2 6"]]:
    """Project points of a board, with the derivatives by camera parameters and by a small motion of the board.

    Parameters
    ----------
    camera : CameraModel
    points_camera : (n, 3)   mm
    names : camera parameters to derive by

    Returns
    -------
    uv : (n, 2)   px; NaN rows for points not in front of the camera
    by_camera : (n, 2, p)   columns in the order of ``names``
    by_pose : (n, 2, 6)   rotation (rad) about the centre of the points, then translation (mm), along the camera's axes
    """
    z = np.where(points_camera[:, 2] > 0, points_camera[:, 2], np.nan)
    xy = points_camera[:, :2] / z[:, None]
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    distorted = camera.distort(xy)
    focal = np.array([camera.fx, camera.fy])
    uv = distorted * focal + (camera.cx, camera.cy)

    zero, one = np.zeros_like(x), np.ones_like(x)
    columns = {
        "fx": (distorted[:, 0], zero),
        "fy": (zero, distorted[:, 1]),
        "cx": (one, zero),
        "cy": (zero, one),
        "k1": (camera.fx * x * r2, camera.fy * y * r2),
        "k2": (camera.fx * x * r2**2, camera.fy * y * r2**2),
        "p1": (camera.fx * 2 * x * y, camera.fy * (r2 + 2 * y * y)),
        "p2": (camera.fx * (r2 + 2 * x * x), camera.fy * 2 * x * y),
        "k3": (camera.fx * x * r2**3, camera.fy * y * r2**3),
    }
    by_camera = np.empty((len(xy), 2, len(names)))
    for k, name in enumerate(names):
        by_camera[:, 0, k], by_camera[:, 1, k] = columns[name]

    by_xy = focal[:, None] * camera.distort_jacobian(xy)
    by_point = np.empty((len(xy), 2, 3))
    by_point[:, :, :2] = by_xy / z[:, None, None]
    by_point[:, :, 2] = -(by_xy[:, :, 0] * x[:, None] + by_xy[:, :, 1] * y[:, None]) / z[:, None]
    arms = points_camera - points_camera.mean(axis=0)
    by_pose = np.empty((len(xy), 2, 6))
    by_pose[:, :, :3] = np.cross(arms[:, None, :], by_point)  # d p / d w = -[arm]x
    by_pose[:, :, 3:] = by_point
    return uv, by_camera, by_pose


def get_parameters(camera: CameraModel, names: Sequence[str]) -> Float[np.ndarray, " p"]:
    """Values of the named parameters."""
    return np.array([getattr(camera, name) for name in names], dtype=float)


def set_parameters(camera: CameraModel, names: Sequence[str], values: Float[np.ndarray, " p"]) -> CameraModel:
    """The camera with the named parameters replaced."""
    changes: dict[str, Any] = {name: float(value) for name, value in zip(names, values, strict=True)}
    return replace(camera, **changes)


def reprojection_residuals(
    camera: CameraModel, camera_from_board: RigidTransform, observation: BoardObservation
) -> Float[np.ndarray, "n 2"]:
    """Observed minus projected, px."""
    return np.asarray(observation.uv - camera.project(camera_from_board.apply(observation.points)))


def linearise_view(
    camera: CameraModel, camera_from_board: RigidTransform, observation: BoardObservation, names: Sequence[str]
) -> tuple[Float[np.ndarray, "n 2 6"], Float[np.ndarray, "n 2 p"], Float[np.ndarray, "n 2"]]:
    """Derivatives by pose and by camera, then by the bend where the observation has one, and the residuals; without weights."""
    pose = _Pose(camera_from_board.rotation.as_matrix(), camera_from_board.translation)
    return _derivatives(camera, pose, observation, names, observation.bend is not None)


def move_pose(
    camera_from_board: RigidTransform, points_board: Float[np.ndarray, "n 3"], step: Float[np.ndarray, "6"]
) -> RigidTransform:
    """The pose after the small motion of :func:`projection_jacobians`."""
    pose = _Pose(camera_from_board.rotation.as_matrix(), camera_from_board.translation)
    return pose.moved(points_board, step).as_transform()


def upper_factor(matrix: Float[np.ndarray, "n q"]) -> Float[np.ndarray, "q q"]:
    """Factor R of an orthogonal factorisation, square also where there are fewer rows than columns."""
    factor = np.asarray(np.linalg.qr(matrix, mode="r"))
    return np.pad(factor, ((0, matrix.shape[1] - len(factor)), (0, 0)))


def refine_pose(
    camera: CameraModel, camera_from_board: RigidTransform, observation: BoardObservation
) -> tuple[RigidTransform, float, Float[np.ndarray, "6 6"]]:
    """Levenberg-Marquardt over one pose with a known camera.

    Returns
    -------
    camera_from_board : RigidTransform
    cost : float   weighted sum of squares, px^2; inf where the start shows points behind the camera
    factor : (6, 6)   R of the derivative by the pose: cov = s^2 (R^T R)^-1, as in :func:`projection_jacobians`
    """
    fit = refine_bundle(camera, [camera_from_board], [observation], ())
    _, _, by_pose = projection_jacobians(camera, fit.poses[0].apply(observation.points))
    weighted = (by_pose * observation.weights[:, None, None])[observation.weights > 0].reshape(-1, 6)
    return fit.poses[0], fit.cost, np.asarray(np.linalg.qr(np.nan_to_num(weighted), mode="r"))


def refine_bundle(
    camera: CameraModel,
    poses: Sequence[RigidTransform],
    observations: Sequence[BoardObservation],
    names: Sequence[str],
    prior: Prior | None = None,
    max_iterations: int = MAX_ITERATIONS,
    with_bend: bool = False,
) -> BundleFit:
    """Levenberg-Marquardt over the named camera parameters and all poses [2]_, and over the bend of the boards.

    Parameters
    ----------
    camera, poses : where to start; parameters that are not named keep their values
    observations : one a pose
    names : parameters to estimate; empty for poses alone
    prior : what is known of the parameters, added to the squares
    with_bend : estimate the bend too, common to all observations, which need a ``bend_basis`` then; otherwise it stays

    Returns
    -------
    BundleFit   ``cost`` is inf (and nothing is refined) where the start shows points behind the camera
    """
    state, boards = camera, list(observations)
    bend = boards[0].bend if with_bend and boards[0].bend is not None else np.zeros(_count_bends(boards, with_bend))
    current_poses = [_Pose(p.rotation.as_matrix(), p.translation) for p in poses]
    p = len(names) + len(bend)
    cost = _cost(state, current_poses, boards, names, prior)
    damping, converged = _DAMPING, False
    for _ in range(max_iterations if np.isfinite(cost) else 0):
        views = [_linearise(state, q, o, names, with_bend) for q, o in zip(current_poses, boards, strict=True)]
        improved = False
        while damping < 1e12:
            step, pose_steps = _solve(views, state, names, prior, damping)
            trial = set_parameters(state, names, get_parameters(state, names) + step[: len(names)])
            trial_bend = bend + step[len(names) :]
            trial_boards = [o.with_bend(trial_bend) for o in boards] if with_bend else boards
            trial_poses = [q.moved(o.points, s) for q, o, s in zip(current_poses, boards, pose_steps, strict=True)]
            trial_cost = (
                _cost(trial, trial_poses, trial_boards, names, prior) if min(trial.fx, trial.fy) > 0 else np.inf
            )
            if trial_cost <= cost:
                improved = True
                break
            if trial_cost - cost <= _ROUNDING * cost:
                break
            damping = max(damping * 10, _DAMPING)
        if not improved:
            converged = True  # the bottom, to rounding
            break
        small = cost - trial_cost <= _ROUNDING * cost
        state, current_poses, bend, boards, cost = trial, trial_poses, trial_bend, trial_boards, trial_cost
        damping = max(damping / 10, 1e-12)
        if small:
            converged = True
            break
    views = [_linearise(state, q, o, names, with_bend) for q, o in zip(current_poses, boards, strict=True)]
    rests = [_eliminate_pose(view, 0.0)[1] for view in views]
    blocks = np.array([rest[:, :p].T @ rest[:, :p] for rest in rests]).reshape(len(views), p, p)
    gradients = np.array([rest[:, :p].T @ rest[:, p] for rest in rests]).reshape(len(views), p)
    stacked = [rest[:, :p] for rest in rests] + ([_widen(prior.rows, p)] if prior is not None else [])
    padded = np.vstack([*stacked, np.zeros((p, p))])
    information = np.asarray(np.linalg.qr(padded, mode="r")) if p else np.zeros((0, 0))
    transforms = tuple(q.as_transform() for q in current_poses)
    return BundleFit(state, transforms, float(cost), information, gradients, blocks, converged, bend)


def covariance_from_factor(factor: Float[np.ndarray, "p p"], variance: float) -> Float[np.ndarray, "p p"]:
    """``variance * (R^T R)^-1``; parameters that nothing determines get a huge, finite variance."""
    if factor.shape[0] == 0:
        return np.zeros((0, 0))
    scale = np.linalg.norm(factor, axis=0)
    scale = np.where(scale > 0, scale, 1e-30)
    _, singular, vt = np.linalg.svd(factor / scale)
    inverse = vt.T / np.maximum(singular, 1e-14 * singular[0])
    return np.asarray(variance * (inverse @ inverse.T) / np.outer(scale, scale))


@dataclass(frozen=True, eq=False)
class _Pose:
    """A pose while it is refined: plain matrices, many times faster than a transform that checks itself."""

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    def apply(self, points_board: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Board points in the camera frame."""
        return points_board @ self.rotation.T + self.translation

    def moved(self, points_board: Float[np.ndarray, "n 3"], step: Float[np.ndarray, "6"]) -> "_Pose":
        """The pose after the small motion of :func:`projection_jacobians`."""
        pivot = self.rotation @ points_board.mean(axis=0) + self.translation
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        return _Pose(turn @ self.rotation, turn @ (self.translation - pivot) + pivot + step[3:])

    def as_transform(self) -> RigidTransform:
        """``camera_from_board``."""
        return RigidTransform.from_components(self.translation, Rotation.from_matrix(self.rotation))


@dataclass(frozen=True, eq=False)
class _View:
    """Weighted derivatives of one view: by pose, by camera (and bend), and the residuals."""

    by_pose: Float[np.ndarray, "m 6"]
    by_camera: Float[np.ndarray, "m p"]
    residuals: Float[np.ndarray, " m"]


def _linearise(
    camera: CameraModel, pose: _Pose, observation: BoardObservation, names: Sequence[str], with_bend: bool
) -> _View:
    used: Bool[np.ndarray, " n"] = observation.weights > 0
    by_pose, by_camera, residuals = _derivatives(camera, pose, observation, names, with_bend)
    weights = observation.weights[used, None]
    return _View(
        (by_pose[used] * weights[:, :, None]).reshape(-1, 6),
        (by_camera[used] * weights[:, :, None]).reshape(2 * len(weights), by_camera.shape[2]),
        (residuals[used] * weights).ravel(),
    )


def _derivatives(
    camera: CameraModel, pose: _Pose, observation: BoardObservation, names: Sequence[str], with_bend: bool
) -> tuple[Float[np.ndarray, "n 2 6"], Float[np.ndarray, "n 2 p"], Float[np.ndarray, "n 2"]]:
    uv, by_camera, by_pose = projection_jacobians(camera, pose.apply(observation.points), names)
    if with_bend and observation.bend_basis is not None:
        by_height = by_pose[:, :, 3:] @ pose.rotation[:, 2]
        by_camera = np.concatenate([by_camera, by_height[:, :, None] * observation.bend_basis[:, None, :]], axis=2)
    return by_pose, by_camera, observation.uv - uv


def _count_bends(observations: Sequence[BoardObservation], with_bend: bool) -> int:
    basis = observations[0].bend_basis if with_bend and observations else None
    return basis.shape[1] if basis is not None else 0


def _widen(rows: Float[np.ndarray, "m q"], n_columns: int) -> Float[np.ndarray, "m p"]:
    """Rows that say nothing about the columns that follow."""
    return np.pad(rows, ((0, 0), (0, n_columns - rows.shape[1])))


def _eliminate_pose(view: _View, damping: float) -> tuple[Float[np.ndarray, "6 q"], Float[np.ndarray, "k r"]]:
    """Orthogonal factor of [pose | camera | residual]: the six rows that hold the pose, and the rows that do not."""
    p = view.by_camera.shape[1]
    system = np.hstack([view.by_pose, view.by_camera, view.residuals[:, None]])
    scale = np.linalg.norm(view.by_pose, axis=0)
    damped = np.hstack([np.diag(np.sqrt(damping) * scale), np.zeros((6, p + 1))])
    factor = np.asarray(np.linalg.qr(np.vstack([system, damped]), mode="r"))
    return factor[:6], factor[6:, 6:]


def _solve(
    views: Sequence[_View], camera: CameraModel, names: Sequence[str], prior: Prior | None, damping: float
) -> tuple[Float[np.ndarray, " p"], list[Float[np.ndarray, "6"]]]:
    """The damped step of camera (and bend) and of the poses."""
    p = views[0].by_camera.shape[1]
    parts = [_eliminate_pose(view, damping) for view in views]
    camera_step = np.zeros(p)
    if p:
        rows = [rest for _, rest in parts]
        if prior is not None:
            misfit = prior.values - prior.rows @ get_parameters(camera, names)
            rows.append(np.column_stack([_widen(prior.rows, p), misfit]))
        system = np.vstack(rows)
        scale = np.linalg.norm(np.vstack([view.by_camera for view in views]), axis=0)
        scale = np.where(scale > 0, scale, 1.0)
        matrix = np.vstack([system[:, :p] / scale, np.sqrt(damping) * np.eye(p)])
        right = np.concatenate([system[:, p], np.zeros(p)])
        camera_step = np.linalg.lstsq(matrix, right, rcond=1e-14)[0] / scale
    steps = []
    for top, _ in parts:
        right = top[:, -1] - top[:, 6:-1] @ camera_step
        steps.append(np.linalg.lstsq(top[:, :6], right, rcond=1e-14)[0])
    return camera_step, steps


def _cost(
    camera: CameraModel,
    poses: Sequence[_Pose],
    observations: Sequence[BoardObservation],
    names: Sequence[str],
    prior: Prior | None,
) -> float:
    """Weighted sum of squares, px^2; inf where a point lies behind the camera."""
    total = 0.0
    for pose, observation in zip(poses, observations, strict=True):
        residuals = observation.uv - camera.project(pose.apply(observation.points))
        residuals = residuals * observation.weights[:, None]
        total += float(np.sum(residuals[observation.weights > 0] ** 2))
    if prior is not None:
        total += float(np.sum((prior.values - prior.rows @ get_parameters(camera, names)) ** 2))
    return total if np.isfinite(total) else float("inf")
