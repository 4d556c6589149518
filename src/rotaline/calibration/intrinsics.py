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

from rotaline.calibration.camera_warnings import describe_weak_parameters, describe_weak_views
from rotaline.calibration.homography import fit_homography, map_homography, pose_from_homography
from rotaline.calibration.model import CameraCalibration, CameraView, TargetView
from rotaline.calibration.pose import estimate_board_pose
from rotaline.calibration.reprojection import (
    MAX_ITERATIONS,
    BoardObservation,
    BundleFit,
    Prior,
    covariance_from_factor,
    refine_bundle,
    reprojection_residuals,
)
from rotaline.calibration.zhang import start_cameras
from rotaline.errors import CalibrationError, GeometryError
from rotaline.vision.camera import CameraModel

MIN_VIEWS = 3
_CAUCHY = 2.4
_ROBUST_ROUNDS = 10
_ROBUST_ITERATIONS = 4
_REJECTION_ROUNDS = 6
_RAYLEIGH_MEDIAN = 1.17741
_SPREAD_RATIO = 2.0


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
    outlier_sigma: float = field(
        default=5.0, metadata={"help": "points further off than this many standard deviations are left out"}
    )
    view_outlier_ratio: float = field(
        default=3.0, metadata={"help": "views whose RMS is more than this many times the median are left out"}
    )


def calibrate_camera(
    views: Sequence[TargetView], image_size: tuple[int, int], options: CameraOptions = CameraOptions()
) -> CameraCalibration:
    """Focal lengths, principal point and distortion from views of flat targets [1]_, [2]_.

    The targets may differ from view to view; a board that is read in a half-turned order is the same geometry.

    Parameters
    ----------
    views : what was detected, one entry an image
    image_size : (width, height) px
    options : CameraOptions

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
    state = _start(views)
    _require_views(state, views)
    camera, poses = _find_start([s for s in state if not s.reason], image_size)
    camera = camera if "k1" in names else replace(camera, k1=0.0)
    state = _assign_poses(state, poses)
    state, camera = _fit_robust(state, camera, names)
    turned = _without_mirror_poses(state, camera)
    if any(a.pose is not b.pose for a, b in zip(turned, state, strict=True)):
        state, camera = _fit_robust(turned, camera, names)
    state, fit = _reject(state, views, camera, names, None, options)
    u_parameters, sigma_px, spread_ratio = _uncertainty(fit, state)
    warnings: list[str] = []
    weak = describe_weak_parameters(
        fit.camera, names, covariance_from_factor(fit.information, (spread_ratio * sigma_px) ** 2)
    )
    if weak and options.weak_parameters == "regularise":
        prior = _lens_prior(names, image_size, fit.camera, spread_ratio * sigma_px)
        state, fit = _reject(state, views, _plain(fit.camera, image_size), names, prior, options)
        u_parameters, sigma_px, spread_ratio = _uncertainty(fit, state, spread_ratio)
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
    _require_focal_length(fit.camera, names, u_parameters, options)
    if spread_ratio > 1.0:
        warnings.append(
            f"Leaving out single views changes the camera {spread_ratio:.1f} times as much as the image noise explains: the "
            "target may not be flat, or its points are off. The standard deviations were enlarged by this factor."
        )
    results = tuple(_view_result(view, s, fit.camera) for view, s in zip(views, state, strict=True))
    used = [v for v in results if v.used]
    warnings += describe_weak_views(fit.camera, used)
    warnings += _describe_outliers(views, state)
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
    )


@dataclass(frozen=True, eq=False)
class _ViewState:
    """A view on its way through the estimate; ``reason`` is not empty once it is out."""

    observation: BoardObservation
    homography: Float[np.ndarray, "3 3"] | None
    pose: RigidTransform | None = None
    reason: str = ""


def _parameter_names(distortion: str) -> tuple[str, ...]:
    terms = {"none": "", "k1": "k1", "k1k2": "k1 k2", "k1k2p1p2": "k1 k2 p1 p2", "k1k2p1p2k3": "k1 k2 p1 p2 k3"}
    return ("fx", "fy", "cx", "cy", *terms[distortion].split())


def _start(views: Sequence[TargetView]) -> list[_ViewState]:
    """Homography of every view; views without one are out."""
    state = []
    for view in views:
        detection = view.detection
        n = len(detection.uv)
        observation = BoardObservation(detection.points_board, detection.uv, np.ones(n))
        if n < 4:
            state.append(_ViewState(observation, None, None, f"only {n} points found, at least 4 are needed"))
            continue
        try:
            homography = fit_homography(detection.points_board[:, :2], detection.uv)
            for _ in range(3):
                errors = np.linalg.norm(
                    detection.uv - map_homography(homography, detection.points_board[:, :2]), axis=1
                )
                keep = errors <= 4 * np.median(errors) + 1e-9
                if keep.sum() < 4:
                    break
                homography = fit_homography(detection.points_board[keep, :2], detection.uv[keep])
            state.append(_ViewState(observation, homography))
        except GeometryError as error:
            state.append(_ViewState(observation, None, None, str(error)))
    return state


def _require_views(state: Sequence[_ViewState], views: Sequence[TargetView]) -> None:
    usable = sum(not s.reason for s in state)
    if usable < MIN_VIEWS:
        lost = [f"{v.name}: {s.reason}" for v, s in zip(views, state, strict=True) if s.reason]
        raise CalibrationError(
            f"The camera needs at least {MIN_VIEWS} views of a target in different poses, found {usable}"
            + (f" ({'; '.join(lost[:5])})" if lost else "")
            + ". Add images of the target, turned by 20 to 45 deg about different axes."
        )


def _find_start(state: Sequence[_ViewState], image_size: tuple[int, int]) -> tuple[CameraModel, list[RigidTransform]]:
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


def _pose_of(camera: CameraModel, state: _ViewState) -> RigidTransform:
    assert state.homography is not None
    to_normalised = np.array(
        [[1 / camera.fx, 0.0, -camera.cx / camera.fx], [0.0, 1 / camera.fy, -camera.cy / camera.fy], [0.0, 0.0, 1.0]]
    )
    return pose_from_homography(to_normalised @ state.homography)


def _assign_poses(state: Sequence[_ViewState], poses: Sequence[RigidTransform]) -> list[_ViewState]:
    """Give the views that are still in their new poses, in order."""
    remaining = iter(poses)
    return [s if s.reason else replace(s, pose=next(remaining)) for s in state]


def _refine(
    state: Sequence[_ViewState],
    camera: CameraModel,
    names: tuple[str, ...],
    prior: Prior | None,
    max_iterations: int = MAX_ITERATIONS,
) -> BundleFit:
    active = [s for s in state if not s.reason]
    return refine_bundle(
        camera,
        [s.pose for s in active if s.pose is not None],
        [s.observation for s in active],
        names,
        prior,
        max_iterations,
    )


def _fit_robust(
    state: Sequence[_ViewState], camera: CameraModel, names: tuple[str, ...]
) -> tuple[list[_ViewState], CameraModel]:
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
        sigma = max(float(np.median(np.concatenate(lengths))) / _RAYLEIGH_MEDIAN, 1e-9)
        weights = [1.0 / np.sqrt(1.0 + (r / (_CAUCHY * sigma)) ** 2) for r in lengths]
        weighted = iter(weights)
        current = [
            s if s.reason else replace(s, observation=s.observation.with_weights(next(weighted))) for s in current
        ]
        fit = _refine(current, camera, names, None, _ROBUST_ITERATIONS)
        moved = abs(fit.camera.fx / camera.fx - 1)
        camera, current = fit.camera, _assign_poses(current, fit.poses)
        if k > 1 and moved < 1e-5:
            break
    return [replace(s, observation=s.observation.with_weights(np.ones(len(s.observation.uv)))) for s in current], camera


def _without_mirror_poses(state: Sequence[_ViewState], camera: CameraModel) -> list[_ViewState]:
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
            found = estimate_board_pose(camera, state[k].observation.points_board, state[k].observation.uv)
        except GeometryError:
            continue
        if np.median(np.linalg.norm(found.residuals_px, axis=1)) < 0.5 * error:
            turned[k] = replace(state[k], pose=found.camera_from_board)
    return turned


def _reject(
    state: Sequence[_ViewState],
    views: Sequence[TargetView],
    camera: CameraModel,
    names: tuple[str, ...],
    prior: Prior | None,
    options: CameraOptions,
) -> tuple[list[_ViewState], BundleFit]:
    """Leave out points and views far off the others, and fit by least squares, until nothing changes."""
    current = list(state)
    fit: BundleFit | None = None
    for _ in range(_REJECTION_ROUNDS):
        judged = _judge(current, camera, options)
        if fit is not None and _same(judged, current):
            break
        current = judged
        _require_views(current, views)
        fit = _refine(current, camera, names, prior)
        camera, current = fit.camera, _assign_poses(current, fit.poses)
    assert fit is not None
    return current, fit


def _judge(state: Sequence[_ViewState], camera: CameraModel, options: CameraOptions) -> list[_ViewState]:
    """Mark points and views that do not fit, by robust scales."""
    lengths = {
        k: np.linalg.norm(reprojection_residuals(camera, s.pose, s.observation), axis=1)
        for k, s in enumerate(state)
        if not s.reason and s.pose is not None
    }
    scales = {k: float(np.median(r)) / _RAYLEIGH_MEDIAN for k, r in lengths.items()}
    typical = max(float(np.median(list(scales.values()))), 1e-9)
    judged = list(state)
    candidates: list[tuple[float, int, str]] = []
    for k, r in lengths.items():
        keep = r < options.outlier_sigma * max(typical, scales[k])
        rms = float(np.sqrt(np.mean(r[keep] ** 2))) / np.sqrt(2) if keep.any() else np.inf
        if scales[k] > options.view_outlier_ratio * typical or rms > options.view_outlier_ratio * typical:
            candidates.append(
                (
                    scales[k],
                    k,
                    f"its error is {scales[k] / typical:.1f} times that of the other views (median {np.median(r):.3g} px)",
                )
            )
        elif keep.sum() < max(4, 0.7 * len(keep)):
            candidates.append((scales[k], k, f"{int((~keep).sum())} of {len(keep)} points do not fit"))
        else:
            judged[k] = replace(state[k], observation=state[k].observation.with_weights(keep.astype(float)))
    # never more than the worse half, and never below the number that is needed
    room = min(len(lengths) // 2, len(lengths) - MIN_VIEWS)
    for _, k, reason in sorted(candidates, reverse=True)[: max(room, 0)]:
        judged[k] = replace(state[k], reason=reason)
    return judged


def _same(a: Sequence[_ViewState], b: Sequence[_ViewState]) -> bool:
    return all(
        x.reason == y.reason and np.array_equal(x.observation.weights, y.observation.weights)
        for x, y in zip(a, b, strict=True)
    )


def _uncertainty(
    fit: BundleFit, state: Sequence[_ViewState], least_ratio: float = 1.0
) -> tuple[Float[np.ndarray, " p"], float, float]:
    """Standard deviations of the parameters, sigma of a coordinate (px), and the factor that the views' spread added.

    The residuals say how large the noise is; leaving out each view in turn (one step) says what that noise, and anything
    else, does to the parameters. Independent noise makes both agree within some 30 % for six views and more.
    """
    active = [s for s in state if not s.reason]
    p = fit.information.shape[0]
    squares = sum(
        float(np.sum(reprojection_residuals(fit.camera, pose, s.observation)[s.observation.weights > 0] ** 2))
        for pose, s in zip(fit.poses, active, strict=True)
    )
    n_values = sum(2 * int((s.observation.weights > 0).sum()) for s in active)
    variance = squares / max(n_values - 6 * len(active) - p, 1)
    cov = covariance_from_factor(fit.information, variance)
    u = np.sqrt(np.diag(cov))
    ratio = 1.0
    if len(active) >= 6:
        normal = fit.information.T @ fit.information
        scale = np.sqrt(np.diag(normal))
        changes = [
            np.linalg.lstsq((normal - block) / np.outer(scale, scale), -gradient / scale, rcond=1e-12)[0] / scale
            for block, gradient in zip(fit.blocks, fit.gradients, strict=True)
        ]
        jackknife = np.sqrt((len(active) - 1) / len(active) * np.sum(np.square(changes), axis=0))
        ratio = float(np.median(jackknife / u))
        ratio = ratio if ratio > _SPREAD_RATIO else 1.0
    ratio = max(ratio, least_ratio)
    return u * ratio, float(np.sqrt(variance)), ratio


def _lens_prior(names: tuple[str, ...], image_size: tuple[int, int], camera: CameraModel, sigma_px: float) -> Prior:
    """What real cameras look like: principal point within 3 % of the diagonal of the centre, square pixels to 0.5 %.

    Each radial term moves the corner of the image by no more than some 5 % of its distance from the centre, each tangential
    term by 0.3 %.
    """
    width, height = image_size
    diagonal = float(np.hypot(width, height))
    corner = diagonal / 2 / np.sqrt(camera.fx * camera.fy)
    expected = {"cx": ((width - 1) / 2, 0.03 * diagonal), "cy": ((height - 1) / 2, 0.03 * diagonal)}
    expected |= {name: (0.0, 0.05 / corner ** (2 * power)) for name, power in (("k1", 1), ("k2", 2), ("k3", 3))}
    expected |= dict.fromkeys(("p1", "p2"), (0.0, 0.003 / corner))
    rows, values = [], []
    for k, name in enumerate(names):
        if name in expected:
            value, u = expected[name]
            row = np.zeros(len(names))
            row[k] = sigma_px / u
            rows.append(row)
            values.append(value * sigma_px / u)
    ratio = np.zeros(len(names))
    ratio[[0, 1]] = np.array([1.0, -1.0]) * sigma_px / (0.005 * np.sqrt(camera.fx * camera.fy))
    return Prior(np.array([*rows, ratio]), np.array([*values, 0.0]))


def _plain(camera: CameraModel, image_size: tuple[int, int]) -> CameraModel:
    """The camera with a central principal point and no distortion: a start for the regularised estimate."""
    focal = float(np.sqrt(camera.fx * camera.fy))
    return CameraModel(image_size, focal, focal, (image_size[0] - 1) / 2, (image_size[1] - 1) / 2)


def _require_focal_length(
    camera: CameraModel, names: tuple[str, ...], u_parameters: Float[np.ndarray, " p"], options: CameraOptions
) -> None:
    u_relative = float(min(u_parameters[0] / camera.fx, u_parameters[1] / camera.fy))
    if not u_relative < 0.1:
        raise CalibrationError(
            f"The views leave the focal length open (standard uncertainty {100 * u_relative:.0f} % of {camera.fx:.0f} px): the "
            "boards are nearly parallel to the image, or to each other. Add views with the target turned by 20 to 45 deg about "
            "different axes."
        )


def _view_result(view: TargetView, state: _ViewState, camera: CameraModel) -> CameraView:
    detection = view.detection
    missing = np.full((len(detection.uv), 2), np.nan)
    if state.reason:
        try:
            pose = estimate_board_pose(camera, detection.points_board, detection.uv)
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


def _describe_outliers(views: Sequence[TargetView], state: Sequence[_ViewState]) -> list[str]:
    lines = [f"{v.name} was left out: {s.reason}." for v, s in zip(views, state, strict=True) if s.reason]
    counts = [
        (v.name, int((s.observation.weights == 0).sum())) for v, s in zip(views, state, strict=True) if not s.reason
    ]
    lost = [f"{name} ({n})" for name, n in counts if n]
    if lost:
        lines.append(
            "Points far off the others were left out (glare, dirt, or a bad detection): " + ", ".join(lost) + "."
        )
    return lines
