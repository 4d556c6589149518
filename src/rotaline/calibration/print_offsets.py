"""Targets whose points are not where they should be: an offset of each point in the plane of the target, common to all views.

An office printer puts corners off by some hundredths of a millimetre. Such errors go with the board, so that all views
share them, and more views of the same poses do not average them out. They are estimated together with camera, poses and
bend, as random effects [2]_: each offset is drawn from a normal distribution whose variance comes from the residuals
themselves (restricted maximum likelihood [3]_). A target that is right gets the variance 0, and nothing changes; a point that is seen
rarely keeps to its stated place. The expected offset of 0 also fixes what views never show, shift, turn and size of the print:
the estimated offsets have no part of them.

References
----------
.. [1] Strobl, Hirzinger, ICCV Workshops 2011, 1068 ("More accurate pinhole camera calibration with imperfect planar target")
.. [2] Harville, Journal of the American Statistical Association 72 (1977) 320
.. [3] Patterson, Thompson, Biometrika 58 (1971) 545
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import linalg, optimize, special
from scipy.spatial.transform import RigidTransform

from rotaline.calibration.reprojection import (
    BoardObservation,
    Prior,
    get_parameters,
    linearise_view,
    move_pose,
    set_parameters,
    upper_factor,
)
from rotaline.vision.camera import CameraModel

_CHANCE = 1e-4
"""How often views of a target without offsets may seem to show some."""
_MAX_ROUNDS = 12
_SETTLED = 1e-4
"""Last change of the camera, in its standard deviations."""
_LAMBDA_RANGE = (1e-6, 1e6)
"""Variance of the noise over what all views of an average point say of its offset times the variance of the offsets."""


@dataclass(frozen=True, eq=False)
class OffsetFit:
    """Camera, poses, bend and offsets of the points of least squares with a normal distribution of the offsets.

    Attributes
    ----------
    camera, poses, bend : as in :class:`rotaline.calibration.reprojection.BundleFit`
    offsets : (k, 2)   mm, along x and y of the board, of each point of the targets
    sigma_px, sigma_mm : standard deviations of a coordinate in the image, and of an offset in x and in y
    information : (p, p)   factor R of the parameters of camera and bend, with poses and offsets eliminated: cov = sigma_px^2 (R^T R)^-1
    changes : (v, p)   what leaving out each view does to the parameters, to first order
    """

    camera: CameraModel
    poses: tuple[RigidTransform, ...]
    bend: Float[np.ndarray, " m"]
    offsets: Float[np.ndarray, "k 2"]
    sigma_px: float
    sigma_mm: float
    information: Float[np.ndarray, "p p"]
    changes: Float[np.ndarray, "v p"]

    def of_rows(self, point_numbers: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 2"]:
        """The offsets of the points with these numbers, mm; 0 for the number -1."""
        return np.vstack([self.offsets, np.zeros(2)])[point_numbers]


def fit_print_offsets(
    camera: CameraModel,
    poses: Sequence[RigidTransform],
    observations: Sequence[BoardObservation],
    point_numbers: Sequence[Int[np.ndarray, "_"]],
    names: Sequence[str],
    prior: Prior | None = None,
) -> OffsetFit | None:
    """Camera, poses, bend and the offsets of the points; None if the views do not show that there are any.

    Parameters
    ----------
    camera, poses, observations : the estimate without offsets; the bend is estimated where the observations have one
    point_numbers : which point of which target, a number for each row of each observation: 0, 1 ...; -1 for a point that
        keeps to its place
    names : camera parameters to estimate
    prior : what is known of them
    """
    bend = observations[0].bend
    offsets = np.zeros((2 + max(int(ids.max()) for ids in point_numbers), 2))  # the last one, of number -1, stays 0
    if len(offsets) == 1:
        return None
    model = _linearise(camera, poses, observations, point_numbers, names, offsets, prior)
    if model is None:
        return None
    weight = _find_weight(model)
    if _criterion(model, np.inf) - _criterion(model, weight) < special.chdtri(1, 2 * _CHANCE):
        return None  # half the probability, as a variance of 0 is at the edge of what may be
    boards, current = list(observations), list(poses)
    for _ in range(_MAX_ROUNDS):
        x, variance, normal = _solve(model, weight)
        offsets = _offsets(model, x, weight)
        step = linalg.solve_triangular(model.factor, x)
        n_poses = 6 * len(current)
        moved = step[n_poses:]
        camera = set_parameters(camera, names, get_parameters(camera, names) + moved[: len(names)])
        bend = None if bend is None else bend + moved[len(names) :]
        current = [
            move_pose(pose, o.points, s)
            for pose, o, s in zip(current, boards, step[:n_poses].reshape(-1, 6), strict=True)
        ]
        boards = [
            o.with_offsets(offsets[ids]).with_bend(bend) for o, ids in zip(observations, point_numbers, strict=True)
        ]
        done = np.linalg.norm(_information(model, normal) @ moved) < _SETTLED * np.sqrt(variance)
        model = _linearise(camera, current, boards, point_numbers, names, offsets, prior)
        if model is None:
            return None
        weight = _find_weight(model)
        if done:
            break
    x, variance, normal = _solve(model, weight)
    return OffsetFit(
        camera,
        tuple(current),
        np.zeros(0) if bend is None else bend,
        offsets[:-1],
        float(np.sqrt(variance)),
        float(np.sqrt(variance / weight)),
        _information(model, normal),
        _leave_one_out_changes(model, x, weight, normal),
    )


@dataclass(frozen=True, eq=False)
class _Model:
    """The linear model ``y = F a + E o + noise`` with a step ``a`` of poses, camera and bend, and the offsets ``o``.

    ``F = Q factor`` with orthonormal columns of Q, and ``x = factor @ a``. Every point has two offsets, along axes (``axes``) for which its
    columns of E are orthogonal, with the squared lengths ``strengths``.
    """

    factor: Float[np.ndarray, "q q"]
    projected: Float[np.ndarray, " q"]
    rest: float
    axes: Float[np.ndarray, "k 2 2"]
    strengths: Float[np.ndarray, " l"]
    by_offset: Float[np.ndarray, "l q"]
    scores: Float[np.ndarray, " l"]
    n_values: int
    views: tuple["_ViewRows", ...]


@dataclass(frozen=True, eq=False)
class _ViewRows:
    """The rows of one view: F (pose, camera and bend), E, y, and the numbers of the points."""

    by_pose: Float[np.ndarray, "n 2 6"]
    by_camera: Float[np.ndarray, "n 2 p"]
    by_offset: Float[np.ndarray, "n 2 2"]
    y: Float[np.ndarray, "n 2"]
    numbers: Int[np.ndarray, " n"]


def _linearise(
    camera: CameraModel,
    poses: Sequence[RigidTransform],
    boards: Sequence[BoardObservation],
    point_numbers: Sequence[Int[np.ndarray, "_"]],
    names: Sequence[str],
    offsets: Float[np.ndarray, "k 2"],
    prior: Prior | None,
) -> _Model | None:
    """None where points lie behind the camera."""
    views = []
    for pose, board, ids in zip(poses, boards, point_numbers, strict=True):
        used = board.weights > 0
        by_pose, by_camera, residuals = linearise_view(camera, pose, board, names)
        by_offset = by_pose[:, :, 3:] @ pose.rotation.as_matrix()[:, :2] * (ids >= 0)[:, None, None]
        y = residuals + (by_offset @ offsets[ids][:, :, None])[:, :, 0]
        w = board.weights[used, None]
        views.append(
            _ViewRows(
                by_pose[used] * w[:, :, None],
                by_camera[used] * w[:, :, None],
                by_offset[used] * w[:, :, None],
                y[used] * w,
                ids[used],
            )
        )
    if not all(np.isfinite(v.y).all() for v in views):
        return None
    p, n_poses = views[0].by_camera.shape[2], 6 * len(views)
    q = n_poses + p
    factor, projected, rests = np.zeros((q, q)), np.zeros(q), []
    k = len(offsets)
    gram, cross, scores = np.zeros((k, 2, 2)), np.zeros((k, 2, q)), np.zeros((k, 2))
    for v, view in enumerate(views):
        at = slice(6 * v, 6 * v + 6)
        rows = np.concatenate([view.by_pose, view.by_camera, view.y[:, :, None]], axis=2).reshape(-1, 7 + p)
        triangle = upper_factor(rows)
        factor[at, at], factor[at, n_poses:], projected[at] = triangle[:6, :6], triangle[:6, 6:-1], triangle[:6, -1]
        rests.append(triangle[6:, 6:])
        transposed = np.swapaxes(view.by_offset, 1, 2)
        gram[view.numbers] += transposed @ view.by_offset
        cross[view.numbers, :, at] += transposed @ view.by_pose
        cross[view.numbers, :, n_poses:] += transposed @ view.by_camera
        scores[view.numbers] += (transposed @ view.y[:, :, None])[:, :, 0]
    if prior is not None:
        misfit = prior.values - prior.rows @ get_parameters(camera, names)
        rests.append(np.column_stack([np.pad(prior.rows, ((0, 0), (0, p - prior.rows.shape[1]))), misfit]))
    triangle = upper_factor(np.vstack(rests))
    factor[n_poses:, n_poses:], projected[n_poses:] = triangle[:p, :p], triangle[:p, p]
    strengths, axes = np.linalg.eigh(gram)
    to_axes = np.swapaxes(axes, 1, 2)
    by_offset = linalg.solve_triangular(factor, (to_axes @ cross).reshape(2 * k, q).T, trans="T").T
    return _Model(
        factor,
        projected,
        float(triangle[p, p] ** 2),
        axes,
        np.maximum(strengths, 0.0).ravel(),
        np.ascontiguousarray(by_offset),
        (to_axes @ scores[:, :, None]).ravel(),
        2 * sum(len(v.y) for v in views) + (0 if prior is None else len(prior.values)),
        tuple(views),
    )


def _solve(model: _Model, weight: float) -> tuple[Float[np.ndarray, " q"], float, Float[np.ndarray, "q q"]]:
    """The step ``x``, the variance of the noise (px^2) and the normal matrix of ``x``.

    ``weight`` is the variance of the noise over that of the offsets, px^2 / mm^2; infinite without offsets.
    """
    shrink = 1.0 / (model.strengths + weight)
    normal = np.eye(len(model.projected)) - (model.by_offset.T * shrink) @ model.by_offset
    right = model.projected - model.by_offset.T @ (shrink * model.scores)
    x = np.linalg.solve(normal, right)
    squares = model.rest + model.projected @ model.projected - shrink @ model.scores**2 - x @ right
    return x, float(squares) / max(model.n_values - len(x), 1), normal


def _criterion(model: _Model, weight: float) -> float:
    """-2 log of the restricted likelihood [3]_, but for a constant."""
    _, variance, normal = _solve(model, weight)
    spread = np.log1p(model.strengths / weight).sum()
    return float((model.n_values - len(normal)) * np.log(variance) + spread + np.linalg.slogdet(normal)[1])


def _find_weight(model: _Model) -> float:
    """The most likely ratio of the variances."""
    typical = float(np.mean(model.strengths[model.strengths > 0]))
    found = optimize.minimize_scalar(
        lambda log: _criterion(model, typical * float(np.exp(log))),
        bounds=tuple(np.log(_LAMBDA_RANGE)),
        method="bounded",
        options={"xatol": 1e-3},
    )
    return typical * float(np.exp(found.x))


def _offsets(model: _Model, x: Float[np.ndarray, " q"], weight: float) -> Float[np.ndarray, "k 2"]:
    along_axes = (model.scores - model.by_offset @ x) / (model.strengths + weight)
    return np.asarray((model.axes @ along_axes.reshape(-1, 2, 1))[:, :, 0])


def _information(model: _Model, normal: Float[np.ndarray, "q q"]) -> Float[np.ndarray, "p p"]:
    """Factor of the parameters of camera and bend, which come last."""
    p = model.views[0].by_camera.shape[2]
    return upper_factor(np.linalg.cholesky(normal).T @ model.factor)[-p:, -p:]


def _leave_one_out_changes(
    model: _Model, x: Float[np.ndarray, " q"], weight: float, normal: Float[np.ndarray, "q q"]
) -> Float[np.ndarray, "v p"]:
    """What leaving out each view does to the parameters of camera and bend.

    With W, the inverse covariance of all values (offsets included), and the rows G = W F of a view, leaving it out takes
    ``G^T (W_vv)^-1 G`` off the normal matrix.
    """
    p, q = model.views[0].by_camera.shape[2], len(x)
    shrink = 1.0 / (model.strengths + weight)
    inner = model.axes * shrink.reshape(-1, 1, 2)
    shrunk = (inner @ model.by_offset.reshape(-1, 2, q)).reshape(-1, 2, q)
    gains = inner @ np.swapaxes(model.axes, 1, 2)
    inverse = linalg.solve_triangular(model.factor, np.eye(q))
    a, offsets = inverse @ x, _offsets(model, x, weight)
    changes = []
    for v, view in enumerate(model.views):
        at = slice(6 * v, 6 * v + 6)
        rows = view.by_pose @ inverse[at] + view.by_camera @ inverse[-p:] - view.by_offset @ shrunk[view.numbers]
        residuals = view.y - view.by_pose @ a[at] - view.by_camera @ a[-p:]
        residuals = residuals - (view.by_offset @ offsets[view.numbers][:, :, None])[:, :, 0]
        precision = np.eye(2) - view.by_offset @ gains[view.numbers] @ np.swapaxes(view.by_offset, 1, 2)
        weighted = np.linalg.solve(precision, np.concatenate([rows, residuals[:, :, None]], axis=2)).reshape(-1, q + 1)
        block = rows.reshape(-1, q).T @ weighted
        change = np.linalg.pinv(normal - block[:, :q], rcond=1e-10, hermitian=True) @ -block[:, q]
        changes.append(inverse[-p:] @ change)
    return np.array(changes)
