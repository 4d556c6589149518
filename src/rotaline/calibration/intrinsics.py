"""Camera calibration from flat targets (Zhang), robust against bad points and bad views.

Homographies give a start, Levenberg-Marquardt over all views the estimate: first with Cauchy weights, so that no bad
point or view leads it astray, then, with those left out and named, by plain least squares.

References
----------
.. [1] Zhang, IEEE Trans. PAMI 22 (2000) 1330
.. [2] Li et al., Sensors 2026, 26(13), 4275, eq. (1) and (2)
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform

from rotaline.calibration.board_shape import targets_as_found
from rotaline.calibration.camera_warnings import (
    describe_bent_targets,
    describe_offsets,
    describe_weak_parameters,
    describe_weak_views,
)
from rotaline.calibration.capture_consistency import capture_of, describe_conflict, find_conflict
from rotaline.calibration.homography import pose_from_homography
from rotaline.calibration.lens_prior import lens_prior, without_distortion
from rotaline.calibration.model import CameraCalibration, CameraView, TargetView
from rotaline.calibration.pose import estimate_board_pose
from rotaline.calibration.print_offsets import OffsetFit
from rotaline.calibration.reprojection import (
    BundleFit,
    Prior,
    covariance_from_factor,
    refine_bundle,
    reprojection_residuals,
)
from rotaline.calibration.view_rejection import (
    Rules,
    assign_poses,
    let_points_off,
    refine,
    reject,
    reject_bent,
    require_views,
    uncertainty,
)
from rotaline.calibration.view_selection import MIN_VIEWS, RAYLEIGH_MEDIAN, ViewState, start_views
from rotaline.calibration.zhang import start_cameras
from rotaline.errors import CalibrationError, GeometryError
from rotaline.vision.camera import CameraModel

_CAUCHY = 2.4
_ROBUST_ROUNDS = 10
_ROBUST_ITERATIONS = 4
_LENIENT = 4.0
_MANY_POINTS = 0.05
"""Part of a view's points that may be far off without a word: a few are in most images."""
_FAR_PX = 0.25
"""Smaller errors are those of a detector in blur or noise; there is nothing to see in the image."""


@dataclass(frozen=True)
class CameraOptions:
    """Options of the camera calibration."""

    distortion: Literal["none", "k1", "k1k2", "k1k2p1p2", "k1k2p1p2k3"] = field(
        default="k1k2p1p2",
        metadata={"help": "distortion terms to estimate, eq. (2) of the article; k3 only where the lens needs it"},
    )
    weak_parameters: Literal["regularise", "free"] = field(
        default="regularise",
        metadata={
            "help": "what to do where the views do not determine the camera: lean on what real lenses look like, or estimate anyway"
        },
    )
    board: Literal["auto", "flat"] = field(
        default="auto",
        metadata={
            "help": "auto: estimate how the target is bent, and how far its points are off, where the views clearly show it; "
            "flat: take it for flat, and its points for exact"
        },
    )
    outlier_sigma: float = field(
        default=5.0, metadata={"help": "points further off than this many standard deviations are left out"}
    )
    view_outlier_ratio: float = field(
        default=3.0, metadata={"help": "views whose RMS is more than this many times the median are left out"}
    )


def calibrate_camera(
    views: Sequence[TargetView],
    image_size: tuple[int, int],
    options: CameraOptions = CameraOptions(),
    preferred: frozenset[str] = frozenset(),
) -> CameraCalibration:
    """Focal lengths, principal point and distortion from views of flat targets [1]_, [2]_.

    The targets may differ from view to view; a board that is read in a half-turned order is the same geometry.

    Parameters
    ----------
    views : what was detected, one entry an image
    image_size : (width, height) px
    options : CameraOptions
    preferred : captures (folders of the views' names) whose camera counts where captures contradict each other

    Returns
    -------
    CameraCalibration
        ``views`` in the order given; residuals of points that were left out are NaN rows. ``u_parameters`` come from the
        residuals; where single views pull the parameters further than that explains, they are enlarged (see warnings).

    Raises
    ------
    CalibrationError
        If fewer than three views can be used, or if the views leave the focal length open (boards parallel to the
        image): add views with the target turned by 20 to 45 deg about different axes.
    """
    names = _parameter_names(options.distortion)
    rules = Rules(options.outlier_sigma, options.view_outlier_ratio, options.board == "flat")
    state = start_views(views)
    require_views(state, views)
    camera, poses = _find_start([s for s in state if not s.reason], image_size)
    camera = camera if "k1" in names else replace(camera, k1=0.0)
    state = assign_poses(state, poses)
    state, camera = _fit_robust(state, camera, names)
    turned = _without_mirror_poses(state, camera)
    if any(a.pose is not b.pose for a, b in zip(turned, state, strict=True)):
        state, camera = _fit_robust(turned, camera, names)
    state, warnings = _leave_out_other_cameras(state, views, camera, names, rules, preferred)
    stated, stated_fit = reject_bent(state, views, camera, names, rules)
    state, fit = let_points_off(stated, stated_fit, views, names, None, rules)
    u_parameters, sigma_px, spread_ratio = uncertainty(fit, state)
    weak = _describe_weak(fit, state, names)
    if weak and options.weak_parameters == "regularise":
        prior = lens_prior(names, image_size, fit.camera, spread_ratio * sigma_px)
        state, stated_fit = reject(stated, views, without_distortion(fit.camera, image_size), names, prior, rules)
        state, fit = let_points_off(state, stated_fit, views, names, prior, rules)
        u_parameters, sigma_px, spread_ratio = uncertainty(fit, state, spread_ratio)
        warnings.append(
            "The views do not determine the camera by themselves ("
            + "; ".join(weak)
            + "). The principal point was drawn to the image centre, fx / fy to 1 and the distortion to small values, each "
            "within what real lenses show. Add views: target turned by 20 to 45 deg about different axes, some near the corners."
        )
    elif weak:
        warnings.append(
            "Weakly determined: "
            + "; ".join(weak)
            + ". Add views: target turned by 20 to 45 deg about different axes, some near the corners."
        )
    _require_focal_length(fit.camera, u_parameters)
    if spread_ratio > 1.0:
        warnings.append(
            f"Leaving out single views changes the camera {spread_ratio:.1f} times as much as the image noise explains: the "
            "target may not be flat, its points may be off, or it or the camera moved during exposure. The standard "
            "deviations were enlarged by this factor. To do better, use a stiff target of known pitch, hold it still, and "
            "look at the views with the largest residuals."
        )
    results = tuple(_view_result(view, s, fit.camera) for view, s in zip(views, state, strict=True))
    used = [v for v in results if v.used]
    offsets = fit.offsets if isinstance(fit, OffsetFit) else np.zeros((0, 2))
    as_stated, found = targets_as_found([view.detection for view in views], fit.bend, offsets)
    notes = describe_bent_targets(found) + describe_offsets(found, results, fit.camera, sigma_px)
    warnings += describe_weak_views(fit.camera, used)
    warnings += _describe_outliers(views, state, fit.camera)
    lengths = np.concatenate([np.linalg.norm(v.residuals_px, axis=1) for v in used])
    lengths = lengths[np.isfinite(lengths)]
    return CameraCalibration(
        fit.camera,
        names,
        u_parameters,
        results,
        float(np.sqrt(np.mean(lengths**2))),
        float(np.mean(lengths)),
        tuple(warnings),
        as_stated,
        found,
        tuple(notes),
    )


def _parameter_names(distortion: str) -> tuple[str, ...]:
    terms = {"none": "", "k1": "k1", "k1k2": "k1 k2", "k1k2p1p2": "k1 k2 p1 p2", "k1k2p1p2k3": "k1 k2 p1 p2 k3"}
    return ("fx", "fy", "cx", "cy", *terms[distortion].split())


def _find_start(state: Sequence[ViewState], image_size: tuple[int, int]) -> tuple[CameraModel, list[RigidTransform]]:
    """The start camera, and poses, with the smallest median reprojection error after a short refinement."""
    best: tuple[float, CameraModel, list[RigidTransform]] | None = None
    for k, camera in enumerate(start_cameras([s.homography for s in state if s.homography is not None], image_size)):
        poses = [_pose_of(camera, s) for s in state]
        fit = refine_bundle(
            camera, poses, [s.observation for s in state], ("fx", "fy", "k1"), _ONE_FOCAL_LENGTH, max_iterations=8
        )
        errors = [
            float(np.median(np.linalg.norm(reprojection_residuals(fit.camera, p, s.observation), axis=1)))
            for p, s in zip(fit.poses, state, strict=True)
        ]
        score = float(np.median(errors)) if np.isfinite(fit.cost) else np.inf
        if best is None or score < best[0]:
            best = (score, fit.camera, list(fit.poses))
        if k == 0 and score < 2e-3 * max(image_size):
            break  # the closed form has found it
    if best is None or not np.isfinite(best[0]):
        raise CalibrationError(
            "No camera explains the views: no focal length brings the targets in front of it. Check the target's size in "
            "session.toml, and that the views are not edge-on."
        )
    return best[1], best[2]


_ONE_FOCAL_LENGTH = Prior(np.array([[1e3, -1e3, 0.0]]), np.zeros(1))


def _pose_of(camera: CameraModel, state: ViewState) -> RigidTransform:
    assert state.homography is not None
    to_normalised = np.array(
        [[1 / camera.fx, 0.0, -camera.cx / camera.fx], [0.0, 1 / camera.fy, -camera.cy / camera.fy], [0.0, 0.0, 1.0]]
    )
    return pose_from_homography(to_normalised @ state.homography)


def _fit_robust(
    state: Sequence[ViewState], camera: CameraModel, names: tuple[str, ...]
) -> tuple[list[ViewState], CameraModel]:
    """Cauchy weights until they settle; the weights returned are ones again."""
    current = list(state)
    for k in range(_ROBUST_ROUNDS):
        active = [s for s in current if not s.reason]
        lengths = [
            np.linalg.norm(reprojection_residuals(camera, s.pose, s.observation), axis=1)
            for s in active
            if s.pose is not None
        ]
        # at first the scale of the views' medians: a start far off is no reason to ignore the corners of the image
        sigma = max(float(np.median(np.concatenate(lengths))) / RAYLEIGH_MEDIAN, 1e-9)
        weights = [1.0 / np.sqrt(1.0 + (r / (_CAUCHY * sigma)) ** 2) for r in lengths]
        weighted = iter(weights)
        current = [
            s if s.reason else replace(s, observation=s.observation.with_weights(next(weighted))) for s in current
        ]
        fit = refine(current, camera, names, None, _ROBUST_ITERATIONS)
        moved = abs(fit.camera.fx / camera.fx - 1)
        camera, current = fit.camera, assign_poses(current, fit.poses)
        if k > 1 and moved < 1e-5:
            break
    return [replace(s, observation=s.observation.with_weights(np.ones(len(s.observation.uv)))) for s in current], camera


def _without_mirror_poses(state: Sequence[ViewState], camera: CameraModel) -> list[ViewState]:
    """Views that ended in the mirror image of their pose, put right (see :func:`estimate_board_pose`)."""
    errors = {
        k: float(np.median(np.linalg.norm(reprojection_residuals(camera, s.pose, s.observation), axis=1)))
        for k, s in enumerate(state)
        if not s.reason and s.pose is not None
    }
    typical = float(np.median(list(errors.values())))
    turned = list(state)
    for k, error in errors.items():
        if error <= 2 * typical:
            continue
        try:
            found = estimate_board_pose(camera, state[k].observation.points, state[k].observation.uv)
        except GeometryError:
            continue
        if np.median(np.linalg.norm(found.residuals_px, axis=1)) < 0.5 * error:
            turned[k] = replace(state[k], pose=found.camera_from_board)
    return turned


def _describe_weak(fit: BundleFit | OffsetFit, state: Sequence[ViewState], names: tuple[str, ...]) -> list[str]:
    _, sigma_px, spread_ratio = uncertainty(fit, state)
    cov = covariance_from_factor(fit.information, (spread_ratio * sigma_px) ** 2)[: len(names), : len(names)]
    return describe_weak_parameters(fit.camera, names, cov)


def _leave_out_other_cameras(
    state: Sequence[ViewState],
    views: Sequence[TargetView],
    camera: CameraModel,
    names: tuple[str, ...],
    rules: Rules,
    preferred: frozenset[str],
) -> tuple[list[ViewState], list[str]]:
    """Leave out captures that show another camera than a preferred one, if that alone determines its camera; say so."""
    captures = [capture_of(view.name) for view in views]
    current, warnings = list(state), []
    # views of another camera fit badly: they must not be thrown out one by one before they are understood
    lenient = replace(rules, view_outlier_ratio=_LENIENT * rules.view_outlier_ratio)
    for _ in range(len(set(captures)) - 1):
        tried, fit = reject_bent(current, views, camera, names, lenient)
        conflict = find_conflict(fit, [c for c, s in zip(captures, tried, strict=True) if not s.reason])
        if conflict is None:
            break
        others = set(conflict.names) - preferred
        only = [
            replace(s, reason=f"{c} shows another camera than the preferred captures")
            if c in others and not s.reason
            else s
            for c, s in zip(captures, current, strict=True)
        ]
        n_left = sum(not s.reason for s in only)
        kept = len(others) == 1 and n_left >= 2 * MIN_VIEWS
        if kept:
            tried, fit = reject_bent(only, views, camera, names, rules)
            kept = not _describe_weak(fit, tried, names)
        warnings.append(describe_conflict(conflict, next(iter(others)) if kept else None))
        if not kept:
            break
        current, camera = only, fit.camera
    return current, warnings


def _require_focal_length(camera: CameraModel, u_parameters: Float[np.ndarray, " p"]) -> None:
    u_relative = float(min(u_parameters[0] / camera.fx, u_parameters[1] / camera.fy))
    if not u_relative < 0.1:
        raise CalibrationError(
            f"The views leave the focal length open (standard uncertainty {100 * u_relative:.0f} % of {camera.fx:.0f} px): the "
            "boards are nearly parallel to the image, or to each other. Add views with the target turned by 20 to 45 deg about "
            "different axes."
        )


def _view_result(view: TargetView, state: ViewState, camera: CameraModel) -> CameraView:
    detection = view.detection
    missing = np.full((len(detection.uv), 2), np.nan)
    if state.reason:
        try:
            pose = estimate_board_pose(camera, state.observation.points, detection.uv)
        except GeometryError:
            return CameraView(
                view.name, False, state.reason, RigidTransform.identity(), float("nan"), detection.uv, missing
            )
        return CameraView(
            view.name, False, state.reason, pose.camera_from_board, pose.rms_px, detection.uv, pose.residuals_px
        )
    assert state.pose is not None
    used = state.observation.weights > 0
    residuals = np.where(used[:, None], reprojection_residuals(camera, state.pose, state.observation), np.nan)
    rms = float(np.sqrt(np.sum(residuals[used] ** 2) / used.sum()))
    return CameraView(view.name, True, "", state.pose, rms, detection.uv, residuals)


def _describe_outliers(views: Sequence[TargetView], state: Sequence[ViewState], camera: CameraModel) -> list[str]:
    """Views that were left out, and views with many points that are off by more than a detector's error."""
    lines = [f"{v.name} was left out: {s.reason}." for v, s in zip(views, state, strict=True) if s.reason]
    for view, s in zip(views, state, strict=True):
        if s.reason or s.pose is None:
            continue
        lengths = np.linalg.norm(reprojection_residuals(camera, s.pose, s.observation), axis=1)
        n, n_out = len(lengths), int(((s.observation.weights == 0) & (lengths > _FAR_PX)).sum())
        if n_out > max(1, _MANY_POINTS * n):
            lines.append(
                f"{n_out} of {n} points of {view.name} were left out, far off the others: look for glare, dirt, a hidden part "
                "or blur there, and take the image again."
            )
    return lines
