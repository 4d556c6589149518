"""Least squares over camera, poses and targets, with what does not fit the others left out.

The targets are taken as stated, or bent, or bent and with points that are off their places; the richer model only where the views
show that it is needed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import RigidTransform

from rotaline.calibration.board_shape import bend_bases, is_bend_shown, leave_one_out_changes, point_numbers
from rotaline.calibration.model import TargetView
from rotaline.calibration.print_offsets import OffsetFit, fit_print_offsets
from rotaline.calibration.reprojection import (
    MAX_ITERATIONS,
    BundleFit,
    Prior,
    covariance_from_factor,
    refine_bundle,
    reprojection_residuals,
)
from rotaline.calibration.view_selection import MIN_VIEWS, ViewState, judge_views, same_selection
from rotaline.errors import CalibrationError
from rotaline.vision.camera import CameraModel

_REJECTION_ROUNDS = 6
_SPREAD_RATIO = 2.0


@dataclass(frozen=True)
class Rules:
    """How the estimate goes.

    Attributes
    ----------
    outlier_sigma : points further off than this many standard deviations are left out
    view_outlier_ratio : views whose RMS is more than this many times the median are left out
    as_stated : take the targets for flat, and their points for exact
    """

    outlier_sigma: float
    view_outlier_ratio: float
    as_stated: bool


def reject(
    state: Sequence[ViewState],
    views: Sequence[TargetView],
    camera: CameraModel,
    names: tuple[str, ...],
    prior: Prior | None,
    rules: Rules,
) -> tuple[list[ViewState], BundleFit]:
    """Leave out points and views far off the others, and fit by least squares, until nothing changes."""
    current = list(state)
    fit: BundleFit | None = None
    for _ in range(_REJECTION_ROUNDS):
        judged = judge_views(current, camera, rules.outlier_sigma, rules.view_outlier_ratio)
        if fit is not None and same_selection(judged, current):
            break
        current = judged
        require_views(current, views)
        with_bend = current[0].observation.bend is not None
        fit = refine(current, camera, names, prior, with_bend=with_bend)
        camera, current = fit.camera, assign_poses(current, fit.poses)
        if with_bend:
            current = [replace(s, observation=s.observation.with_bend(fit.bend)) for s in current]
    assert fit is not None
    return current, fit


def reject_bent(
    state: Sequence[ViewState],
    views: Sequence[TargetView],
    camera: CameraModel,
    names: tuple[str, ...],
    rules: Rules,
) -> tuple[list[ViewState], BundleFit]:
    """As :func:`reject`, with targets that are bent where the views show that they are."""
    flat, flat_fit = reject(state, views, camera, names, None, rules)
    if rules.as_stated:
        return flat, flat_fit
    bases = bend_bases([view.detection for view in views])
    no_bend = np.zeros(bases[0].shape[1])
    bent_start = [
        replace(s, observation=replace(s.observation, bend_basis=basis, bend=no_bend))
        for s, basis in zip(flat, bases, strict=True)
    ]
    bent, bent_fit = reject(bent_start, views, flat_fit.camera, names, None, rules)
    _, sigma_px, _ = uncertainty(bent_fit, bent)
    return (bent, bent_fit) if is_bend_shown(bent_fit, sigma_px**2) else (flat, flat_fit)


def let_points_off(
    state: Sequence[ViewState],
    fit: BundleFit,
    views: Sequence[TargetView],
    names: tuple[str, ...],
    prior: Prior | None,
    rules: Rules,
) -> tuple[list[ViewState], BundleFit | OffsetFit]:
    """With targets whose points are off their places, where the views show that they are; otherwise as before.

    The bend is estimated then, shown or not: a target with such errors is rarely flat, and offsets would make up for a bend in part.
    """
    if rules.as_stated:
        return list(state), fit
    detections = [view.detection for view in views]
    bent = [
        replace(s, observation=replace(s.observation, bend_basis=b, bend=np.zeros(b.shape[1])))
        for s, b in zip(state, bend_bases(detections), strict=True)
    ]
    loose = _reject_with_offsets(bent, fit.camera, views, point_numbers(detections), names, prior, rules)
    return (list(state), fit) if loose is None else loose


def _reject_with_offsets(
    state: Sequence[ViewState],
    camera: CameraModel,
    views: Sequence[TargetView],
    numbers: Sequence[Int[np.ndarray, "_"]],
    names: tuple[str, ...],
    prior: Prior | None,
    rules: Rules,
) -> tuple[list[ViewState], OffsetFit] | None:
    """With offsets of the points, those far off left out until nothing changes; None if there are no offsets to be seen.

    No view is left out for its error here: without the errors of the target, the noise of single views stands out.
    """
    current, found = list(state), None
    for _ in range(_REJECTION_ROUNDS):
        active = [k for k, s in enumerate(current) if not s.reason]
        fit = fit_print_offsets(
            camera,
            [s.pose for s in current if not s.reason and s.pose is not None],
            [replace(current[k].observation, points_board=state[k].observation.points_board) for k in active],
            [numbers[k] for k in active],
            names,
            prior,
        )
        if fit is None:
            return None
        camera = fit.camera
        current = [
            replace(
                now,
                observation=s.observation.with_weights(now.observation.weights)
                .with_offsets(fit.of_rows(n))
                .with_bend(fit.bend),
            )
            for now, s, n in zip(assign_poses(current, fit.poses), state, numbers, strict=True)
        ]
        found = current, fit
        judged = judge_views(current, camera, rules.outlier_sigma, np.inf)
        if same_selection(judged, current):
            break
        require_views(judged, views)
        current = judged
    return found


def uncertainty(
    fit: BundleFit | OffsetFit, state: Sequence[ViewState], least_ratio: float = 1.0
) -> tuple[Float[np.ndarray, " p"], float, float]:
    """Standard deviations of the parameters, sigma of a coordinate (px), and the factor that the views' spread added.

    The residuals say how large the noise is; leaving out each view in turn (one step) says what that noise, and anything
    else, does to the parameters. Independent noise makes both agree within some 30 % for six views and more.
    """
    active = [s for s in state if not s.reason]
    p = fit.information.shape[0]
    if isinstance(fit, OffsetFit):
        variance = fit.sigma_px**2
    else:
        squares = sum(
            float(np.sum(reprojection_residuals(fit.camera, pose, s.observation)[s.observation.weights > 0] ** 2))
            for pose, s in zip(fit.poses, active, strict=True)
        )
        n_values = sum(2 * int((s.observation.weights > 0).sum()) for s in active)
        variance = squares / max(n_values - 6 * len(active) - p, 1)
    cov = covariance_from_factor(fit.information, variance)
    n_camera = p - len(fit.bend)
    u = np.sqrt(np.diag(cov))[:n_camera]
    ratio = 1.0
    if len(active) >= 6:
        changes = _leave_one_out(fit)
        jackknife = np.sqrt((len(active) - 1) / len(active) * np.sum(np.square(changes), axis=0))[:n_camera]
        ratio = float(np.median(jackknife / u))
        ratio = ratio if ratio > _SPREAD_RATIO else 1.0
    ratio = max(ratio, least_ratio)
    return u * ratio, float(np.sqrt(variance)), ratio


def _leave_one_out(fit: BundleFit | OffsetFit) -> Float[np.ndarray, "v p"]:
    return fit.changes if isinstance(fit, OffsetFit) else leave_one_out_changes(fit)


def refine(
    state: Sequence[ViewState],
    camera: CameraModel,
    names: tuple[str, ...],
    prior: Prior | None,
    max_iterations: int = MAX_ITERATIONS,
    with_bend: bool = False,
) -> BundleFit:
    """Camera and poses, and the bend if asked for, of least squares over the views that are still in."""
    active = [s for s in state if not s.reason]
    return refine_bundle(
        camera,
        [s.pose for s in active if s.pose is not None],
        [s.observation for s in active],
        names,
        prior,
        max_iterations,
        with_bend,
    )


def assign_poses(state: Sequence[ViewState], poses: Sequence[RigidTransform]) -> list[ViewState]:
    """Give the views that are still in their new poses, in order."""
    remaining = iter(poses)
    return [s if s.reason else replace(s, pose=next(remaining)) for s in state]


def require_views(state: Sequence[ViewState], views: Sequence[TargetView]) -> None:
    """Refuse fewer than three views, and say what happened to the others."""
    usable = sum(not s.reason for s in state)
    if usable < MIN_VIEWS:
        lost = [f"{v.name}: {s.reason}" for v, s in zip(views, state, strict=True) if s.reason]
        raise CalibrationError(
            f"The camera needs at least {MIN_VIEWS} views of a target in different poses, found {usable}"
            + (f" ({'; '.join(lost[:5])})" if lost else "")
            + ". Add images of the target, turned by 20 to 45 deg about different axes."
        )
