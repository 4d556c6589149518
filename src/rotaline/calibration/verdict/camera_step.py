"""The camera: views left out, patterns in the residuals, tilt of the boards, and what its uncertainty does to a point."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy import special

from rotaline.calibration.homography import fit_homography, pose_from_homography
from rotaline.calibration.model import CameraCalibration, TargetView
from rotaline.calibration.verdict.evidence import Evidence, Judged, Scale, gain_of, level_of, rms_of, um, worst
from rotaline.calibration.verdict.model import Figure, Finding, Level, StepVerdict
from rotaline.errors import GeometryError

_PARALLEL_DEG = 20.0
"""Boards whose normals lie within this angle trade focal length against distance."""
_CHANCE = 1e-7
_RINGS = 8
_PATTERN_PART = 0.3
"""A pattern common to all views matters from this part of the RMS."""
_MANY_LEFT_OUT = 0.25


def judge_camera(evidence: Evidence, scale: Scale) -> Judged:
    """The step "camera"."""
    views = evidence.observations.camera_views
    if evidence.camera is None:
        return _failed(evidence, views)
    camera = evidence.camera
    used = [v for v in camera.views if v.used]
    normals = np.array([v.camera_from_board.rotation.apply([0.0, 0.0, 1.0]) for v in used])
    spread = _spread_deg(normals)
    u_focal = float(np.max(camera.u_parameters[:2]) / camera.camera.fx)
    size = u_focal * scale.reach_mm
    figures = [
        Figure("reprojection error", camera.rms_px, "px RMS"),
        Figure("views used", float(len(used)), "views", f"of {len(camera.views)}"),
        Figure("angle between boards", spread, "deg", f"at least {_PARALLEL_DEG:g}"),
        Figure("uncertainty of the focal length", 1e6 * u_focal, "ppm", f"{um(size)} at the edge of the part"),
    ]
    findings = []
    held_out = _held_out(evidence)
    if np.isfinite(held_out):
        figures.append(Figure("views held out", held_out, "px RMS"))
    matters = scale.matters_mm if np.isfinite(scale.u_noise_mm) else 2e-4 * scale.reach_mm
    parallel = spread < _PARALLEL_DEG
    if not (2 if parallel else 1) * size < matters:
        why = f"the focal length is known to {1e6 * u_focal:.0f} ppm (k = 1), {um(size)} at the edge of a part"
        findings.append(_parallel(spread, why, size, scale) if parallel else _uncertain(why, size, scale))
    ring = _radial_pattern(camera)
    figures.append(Figure("radial pattern of the residuals", ring[0], "px"))
    if ring[1]:
        findings.append(
            Finding(
                "lens model",
                "camera",
                "doubtful",
                f"The residuals of all views point {'out of' if ring[2] > 0 else 'to'} the middle of the image in a ring around it, by "
                f"{ring[0]:.2g} px on average: the distortion model does not follow this lens.",
                'Calibrate with camera.distortion = "k1k2p1p2k3", and take views with the target near the corners of the image.',
                1.5,
            )
        )
    lost = [v for v in camera.views if not v.used]
    if len(lost) > max(1, _MANY_LEFT_OUT * len(camera.views)):
        findings.append(
            Finding(
                "views disagree",
                "camera",
                "doubtful",
                f"{len(lost)} of {len(camera.views)} views do not fit the others: {lost[0].name}: {lost[0].reason}"
                + ("; ..." if len(lost) > 1 else "."),
                "Hold target and camera still during the exposure, use a stiff flat target, and take these views again.",
                1.5,
            )
        )
    level: Level = worst(["pass", *(f.level for f in findings)])
    text = f"{camera.rms_px:.3f} px RMS over {len(used)} of {len(camera.views)} views"
    text += f", boards up to {spread:.0f} deg apart" + (
        f"; {'; '.join(f.cause for f in findings)}." if findings else "."
    )
    return Judged(StepVerdict("camera", level, text, tuple(figures)), tuple(findings))


def _parallel(spread: float, why: str, size: float, scale: Scale) -> Finding:
    known = np.isfinite(size) and np.isfinite(scale.u_noise_mm)
    return Finding(
        "boards nearly parallel",
        "camera",
        level_of(2 * size, scale) if known else "fail",
        f"All boards of the camera capture are parallel to within {spread:.0f} deg, so the focal length trades against the distance: {why}.",
        "Add 5 to 10 views with the target turned by 20 to 45 deg about different axes, near and far, also in the corners of the image.",
        gain_of(2 * size, scale) if known else 10.0,
    )


def _uncertain(why: str, size: float, scale: Scale) -> Finding:
    known = np.isfinite(scale.u_noise_mm)
    return Finding(
        "camera uncertain",
        "camera",
        "doubtful",
        f"The views do not determine the camera as well as the stripe could use it: {why}; views that contradict each other count in this.",
        "Take 10 to 20 views of a stiff, flat target of known pitch, held still, turned by 20 to 45 deg, also near the corners of the image.",
        gain_of(size, scale) if known else 2.0,
    )


def _failed(evidence: Evidence, views: Sequence[TargetView]) -> Judged:
    reason = evidence.failures.get("camera", "")
    if not views:
        text = "No view of a target in role camera: without a camera nothing can be calibrated."
        finding = Finding(
            "stage failed", "camera", "fail", text, "Add a capture with role camera: 10 to 20 views of a target.", 100.0
        )
        return Judged(StepVerdict("camera", "fail", text), (finding,))
    spread = _spread_deg(_rough_normals(views, evidence.observations.image_size))
    if spread < _PARALLEL_DEG:
        finding = _parallel(
            spread, f"no camera was found ({reason})", float("nan"), Scale(float("nan"), float("nan"), float("nan"))
        )
    else:
        text = f"The camera was not found: {reason}"
        action = "Check the target's size in session.toml and the sharpness of the views; take 10 to 20 views in different poses."
        finding = Finding("stage failed", "camera", "fail", text, action, 100.0)
    return Judged(StepVerdict("camera", "fail", finding.text), (finding,))


def _rough_normals(views: Sequence[TargetView], image_size: tuple[int, int]) -> Float[np.ndarray, "v 3"]:
    """Normals of the boards for a lens of usual focal length: good enough to tell parallel boards."""
    focal = 1.3 * max(image_size)
    normals = []
    for view in views:
        xy = (view.detection.uv - (np.array(image_size) - 1) / 2) / focal
        try:
            pose = pose_from_homography(fit_homography(view.detection.points_board[:, :2], xy))
        except GeometryError:
            continue
        normals.append(pose.rotation.apply([0.0, 0.0, 1.0]))
    return np.array(normals).reshape(-1, 3)


def _spread_deg(normals: Float[np.ndarray, "v 3"]) -> float:
    """Largest angle between two boards, deg."""
    if len(normals) < 2:
        return 0.0
    facing = normals * np.where(normals[:, 2:] < 0, -1.0, 1.0)
    return float(np.degrees(np.arccos(np.clip((facing @ facing.T).min(), -1.0, 1.0))))


def _held_out(evidence: Evidence) -> float:
    """RMS over target groups of the joint estimate when views take no part, px; NaN if that was not tried."""
    if evidence.joint is None:
        return float("nan")
    return rms_of(np.array([v.held_out_rms_px for g in evidence.joint.groups if g.kind == "target" for v in g.views]))


def _radial_pattern(camera: CameraCalibration) -> tuple[float, bool, float]:
    """Largest mean radial residual of a ring of the image, whether it is clear and large, and its sign.

    Residuals of one view are averaged in each ring first: the views are the independent witnesses.
    """
    middle = np.array([camera.camera.cx, camera.camera.cy])
    reach = float(np.linalg.norm(np.array(camera.camera.image_size) / 2))
    means = np.full((len(camera.views), _RINGS), np.nan)
    for k, view in enumerate(camera.views):
        good = np.isfinite(view.residuals_px).all(axis=1)
        if not view.used or not good.any():
            continue
        arm = view.uv[good] - middle
        radius = np.linalg.norm(arm, axis=1)
        radial = np.sum(arm * view.residuals_px[good], axis=1) / np.maximum(radius, 1e-9)
        ring = np.minimum((radius / reach * _RINGS).astype(int), _RINGS - 1)
        count = np.bincount(ring, minlength=_RINGS)
        means[k] = np.where(count >= 5, np.bincount(ring, radial, minlength=_RINGS) / np.maximum(count, 1), np.nan)
    best = (0.0, False, 1.0)
    for column in means.T:
        own = column[np.isfinite(column)]
        if len(own) < 4:
            continue
        mean, u = float(own.mean()), float(own.std(ddof=1) / np.sqrt(len(own)))
        clear = bool(2 * special.stdtr(len(own) - 1, -abs(mean) / max(u, 1e-12)) * _RINGS < _CHANCE * 1e3)
        if (clear, abs(mean)) > (best[1], best[0]):
            best = (abs(mean), clear and abs(mean) > _PATTERN_PART * camera.rms_px, float(np.sign(mean)))
    return best
