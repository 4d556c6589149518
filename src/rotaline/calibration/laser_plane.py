"""The laser plane from stripes on flat targets in several poses.

A stripe on a flat target is a straight line, so a view says two things about the laser plane: how far off it is in the middle
of the stripe, and how it is tilted along it. Both are spoilt together by the pose of the target, far more than by the noise of
single points. So each view counts by these two numbers, with the covariance that its pose and its points give them and with
the scatter between the views [2]_; a stripe of 2000 points has no more say than its pose allows.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, section 3.1, eq. (3)
.. [2] Paule, Mandel, J. Res. NBS 87 (1982) 377 (scatter between groups)
.. [3] Rissanen, Automatica 14 (1978) 465 (shortest description)
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import brentq
from scipy.spatial.transform import RigidTransform

from rotaline.calibration.model import LaserPlaneCalibration, StripeOnBoard
from rotaline.calibration.stripe_on_board import PlacedStripe, StripeView, place_stripe_on_board
from rotaline.errors import CalibrationError, DetectionError
from rotaline.geometry.primitives import Plane, unit
from rotaline.vision.camera import CameraModel

__all__ = ["LaserPlaneOptions", "StripeView", "calibrate_laser_plane"]

MIN_VIEWS = 2
_FEW_VIEWS = 5
_MAX_TURN_RAD = 0.03
_THIN = 0.1


@dataclass(frozen=True)
class LaserPlaneOptions:
    """Options of the laser plane."""

    clearance_widths: float = field(
        default=2.5,
        metadata={
            "help": "distance that stripe points keep from printed edges, in standard deviations of the stripe's profile"
        },
    )


def calibrate_laser_plane(
    camera: CameraModel, views: Sequence[StripeView], options: LaserPlaneOptions = LaserPlaneOptions()
) -> LaserPlaneCalibration:
    """Plane through the stripes on all targets, eq. (3) of [1]_.

    Parameters
    ----------
    camera : CameraModel
    views : target and stripe of each pose
    options : LaserPlaneOptions

    Returns
    -------
    LaserPlaneCalibration
        The normal points away from the camera (offset <= 0). Of each view the points that were used are kept. The standard
        uncertainties hold for this camera; its own errors move all views together and are not in them.

    Raises
    ------
    CalibrationError
        If fewer than two views can be used, or if all stripes lie on one line: the plane can turn about it.
    """
    placed: list[PlacedStripe | None] = []
    reasons: list[str] = []
    for view in views:
        try:
            placed.append(place_stripe_on_board(camera, view, options.clearance_widths))
            reasons.append("")
        except DetectionError as error:
            placed.append(None)
            reasons.append(str(error))
    present = [k for k, p in enumerate(placed) if p is not None]
    if len(present) < MIN_VIEWS:
        lost = [f"{view.name}: {reason}" for view, reason in zip(views, reasons, strict=True) if reason]
        raise CalibrationError(
            f"The laser plane needs the stripe on at least {MIN_VIEWS} poses of a target, found {len(present)}"
            + (f" ({'; '.join(lost[:5])})" if lost else "")
            + ". Add poses at different distances, each with the laser off and on."
        )
    stripes = [p for p in placed if p is not None]
    used = _select_views(stripes)
    chosen = [s for s, keep in zip(stripes, used, strict=True) if keep]
    estimate = _fit_views(chosen, _plane_through(np.concatenate([_ends(s) for s in chosen])))
    _require_spread(stripes, used, estimate)
    results = []
    flags = dict(zip(present, used, strict=True))
    for k, view in enumerate(views):
        stripe = placed[k]
        if stripe is None:
            results.append(_missing(view.name, reasons[k]))
            continue
        residuals = estimate.plane.signed_distance_to(stripe.points_camera)
        reason = "" if flags[k] else _misfit_reason(residuals, stripes, used, estimate.plane)
        results.append(
            StripeOnBoard(
                view.name,
                bool(flags[k]),
                reason,
                stripe.pose.camera_from_board,
                stripe.uv,
                stripe.points_camera,
                residuals,
            )
        )
    residuals = np.concatenate([r.residuals_mm for r in results if r.used])
    calibration = LaserPlaneCalibration(
        estimate.plane,
        tuple(results),
        float(np.sqrt(np.mean(residuals**2))),
        estimate.u_normal_rad,
        estimate.u_offset_mm,
        (),
    )
    return replace(calibration, warnings=tuple(_warnings(calibration, estimate)))


@dataclass(frozen=True, eq=False)
class _Estimate:
    """A plane with its uncertainties; ``extents_mm`` are the rms extents of the points along the plane, larger first."""

    plane: Plane
    u_normal_rad: tuple[float, float]
    u_offset_mm: float
    extents_mm: tuple[float, float]
    along: Float[np.ndarray, "3"]
    between_mm: float


@dataclass(frozen=True, eq=False)
class _Summary:
    """What one view says: residual in the middle and slope times rms length (mm), and how they depend on the plane."""

    values: Float[np.ndarray, "2"]
    cov: Float[np.ndarray, "2 2"]
    by_plane: Float[np.ndarray, "2 3"]


def _select_views(stripes: Sequence[PlacedStripe]) -> Bool[np.ndarray, " v"]:
    """The views that belong together: the shortest description of all views by a plane, a scatter and some strays [3]_.

    A view that belongs costs ``2 log(scatter)``, a stray one ``2 log(extent)``, since it may lie anywhere. So a view is left
    out when it is far off compared with what the others agree to, and when these are enough to say so: of three views none
    is, of eight one that is ten times as far off as the others.
    """
    ends = np.stack([_ends(stripe) for stripe in stripes])
    n_views = len(stripes)
    extent = float(np.sqrt(np.mean(np.sum((ends - ends.mean(axis=(0, 1))) ** 2, axis=2))))
    least = 0.1 * float(np.median([stripe.line_board.rms for stripe in stripes])) + 1e-9
    plane = _consensus_plane(ends)
    best, best_length = np.ones(n_views, dtype=bool), np.inf
    for n in range(n_views, max(MIN_VIEWS, n_views // 2 + 1) - 1, -1):
        current = plane
        for _ in range(5):
            chosen = np.zeros(n_views, dtype=bool)
            chosen[np.argsort(_view_distances(ends, current), kind="stable")[:n]] = True
            current = _plane_through(ends[chosen].reshape(-1, 3))
        squares = float(np.sum(current.signed_distance_to(ends[chosen].reshape(-1, 3)) ** 2))
        dof = 2 * n - 3
        scatter = max(np.sqrt(squares / dof), least)
        length = dof * np.log(scatter) + 2 * (n_views - n) * np.log(extent)
        if length < best_length:
            best, best_length = chosen, length
    return best


def _ends(stripe: PlacedStripe) -> Float[np.ndarray, "2 3"]:
    """Two points that stand for the stripe: on its line, at its rms length on either side of its middle."""
    line = stripe.line_board
    along = (stripe.xy_board - line.point) @ line.direction
    xy = line.point + np.array([[-1.0], [1.0]]) * float(np.std(along)) * line.direction
    return np.asarray(stripe.pose.camera_from_board.apply(np.column_stack([xy, np.zeros(2)])))


def _view_distances(ends: Float[np.ndarray, "v 2 3"], plane: Plane) -> Float[np.ndarray, " v"]:
    """RMS distance of each view's stripe from a plane, mm."""
    return np.asarray(np.sqrt(np.mean((ends @ plane.normal + plane.offset) ** 2, axis=1)))


def _plane_through(points: Float[np.ndarray, "n 3"]) -> Plane:
    """Least-squares plane, also where the points lie on a line (then any plane through it)."""
    centroid = points.mean(axis=0)
    normal = np.linalg.svd(points - centroid, full_matrices=True)[2][2]
    return _oriented(Plane(normal, -float(normal @ centroid)))


def _consensus_plane(ends: Float[np.ndarray, "v 2 3"]) -> Plane:
    """The plane through two stripes from which the views' rms distance has the least median."""
    first, second = np.triu_indices(len(ends), 1)
    points = np.concatenate([ends[first], ends[second]], axis=1)
    centroids = points.mean(axis=1)
    _, singular, axes = np.linalg.svd(points - centroids[:, None])
    normals = axes[:, 2]
    distances = np.einsum("vij,kj->kvi", ends, normals) - np.einsum("ki,ki->k", centroids, normals)[:, None, None]
    medians = np.median(np.sqrt(np.mean(distances**2, axis=2)), axis=1)
    # two stripes on (nearly) one line determine no plane: rather take another pair
    score = np.where(singular[:, 1] > 0.02 * singular[:, 0], medians, np.inf)
    best = int(np.argmin(score if np.isfinite(score).any() else medians))
    return _oriented(Plane(unit(normals[best]), -float(normals[best] @ centroids[best])))


def _fit_views(stripes: Sequence[PlacedStripe], start: Plane) -> _Estimate:
    """Generalised least squares of the views' summaries, with the scatter between the views as a further variance."""
    plane = start
    for _ in range(4):
        centroid = np.mean([s.points_camera.mean(axis=0) for s in stripes], axis=0)
        centroid = centroid - plane.signed_distance_to(centroid[None])[0] * plane.normal
        axes, extents = _principal(stripes, plane.normal, centroid)
        summaries = [_summarise(s, plane, centroid, axes, extents) for s in stripes]
        between = _between_variance(summaries)
        step, cov = _solve(summaries, between)
        normal = unit(plane.normal + axes.T @ (step[:2] / extents))
        plane = _oriented(Plane(normal, -float(normal @ centroid) + float(step[2])))
    u = np.sqrt(np.diag(cov))
    turn = sorted((float(u[0] / extents[0]), float(u[1] / extents[1])), reverse=True)
    return _Estimate(
        plane,
        (turn[0], turn[1]),
        float(u[2]),
        (float(extents[0]), float(extents[1])),
        axes[0],
        float(np.sqrt(between)),
    )


def _principal(
    stripes: Sequence[PlacedStripe], normal: Float[np.ndarray, "3"], centroid: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, "2 3"], Float[np.ndarray, "2"]]:
    """Directions in the plane along which the points extend most and least, and the rms extents (mm)."""
    scatter = np.mean(
        [(s.points_camera - centroid).T @ (s.points_camera - centroid) / len(s.points_camera) for s in stripes], axis=0
    )
    across = np.eye(3) - np.outer(normal, normal)
    values, vectors = np.linalg.eigh(across @ scatter @ across)
    first = unit(across @ vectors[:, 2])
    second = np.cross(normal, first)
    extents = np.sqrt(np.maximum([values[2], second @ scatter @ second], 1e-12 * values[2]))
    return np.stack([first, second]), extents


def _summarise(
    stripe: PlacedStripe,
    plane: Plane,
    centroid: Float[np.ndarray, "3"],
    axes: Float[np.ndarray, "2 3"],
    extents: Float[np.ndarray, "2"],
) -> _Summary:
    """Middle and slope of one stripe's distances from the plane, with covariance from the pose and the points."""
    points = stripe.points_camera
    along = (stripe.xy_board - stripe.line_board.point) @ stripe.line_board.direction
    along = along - along.mean()
    length = float(np.sqrt(np.mean(along**2)))
    operator = np.stack([np.full(len(along), 1.0), along / length]) / len(along)
    residuals = plane.signed_distance_to(points)

    rays = points / np.linalg.norm(points, axis=1)[:, None]
    board = stripe.plane_camera.normal
    lever = (rays @ plane.normal) / (
        rays @ board
    )  # a board that moves by h along its normal moves the point by h * lever
    arms = points - stripe.pivot_camera
    by_pose = lever[:, None] * np.hstack([np.cross(arms, board), np.broadcast_to(board, arms.shape)])
    pose_part = operator @ by_pose
    rest = residuals - operator[0] @ residuals - along / length * (operator[1] @ residuals)
    noise = float(np.sum(rest**2) / max(len(rest) - 2, 1)) * _correlation_length(rest) / len(rest)
    cov = pose_part @ stripe.pose.cov_pose @ pose_part.T + noise * np.eye(2)

    offsets = points - centroid
    by_plane = operator @ np.column_stack([offsets @ axes.T / extents, np.ones(len(points))])
    return _Summary(operator @ residuals, cov, by_plane)


def _correlation_length(residuals: Float[np.ndarray, " n"]) -> float:
    """Number of neighbouring points that count as one, from the autocorrelation of what is left after a line."""
    n = len(residuals)
    power = float(residuals @ residuals)
    if n < 10 or power == 0.0:
        return 1.0
    length = 1.0
    for lag in range(1, n // 4):
        correlation = float(residuals[lag:] @ residuals[:-lag]) / power
        if correlation < 2 / np.sqrt(n):
            break
        length += 2 * correlation
    return length


def _between_variance(summaries: Sequence[_Summary]) -> float:
    """Variance (mm^2) between the views that their own covariances leave unexplained [2]_."""
    dof = 2 * len(summaries) - 3

    def excess(variance: float) -> float:
        step, _ = _solve(summaries, variance)
        total = 0.0
        for s in summaries:
            rest = s.values + s.by_plane @ step
            total += float(rest @ np.linalg.solve(s.cov + variance * np.eye(2), rest))
        return total - dof

    if excess(0.0) <= 0:
        return 0.0
    upper = max(float(np.mean([s.values @ s.values for s in summaries])), 1e-12)
    while excess(upper) > 0:
        upper *= 4
    return float(brentq(excess, 0.0, upper, rtol=1e-6))


def _solve(summaries: Sequence[_Summary], between: float) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Change of the plane (mm at the rms extents; offset) that the summaries ask for, and its covariance."""
    rows, right = [], []
    for s in summaries:
        whiten = np.linalg.inv(np.linalg.cholesky(s.cov + between * np.eye(2) + 1e-18 * np.eye(2)))
        rows.append(whiten @ s.by_plane)
        right.append(-whiten @ s.values)
    u, singular, vt = np.linalg.svd(np.vstack(rows), full_matrices=False)
    inverse = vt.T / np.maximum(singular, 1e-12 * singular[0])
    return inverse @ (u.T @ np.concatenate(right)), inverse @ inverse.T


def _oriented(plane: Plane) -> Plane:
    return plane if plane.offset <= 0 else plane.flipped()


def _require_spread(stripes: Sequence[PlacedStripe], used: Bool[np.ndarray, " v"], estimate: _Estimate) -> None:
    if estimate.u_normal_rad[0] < _MAX_TURN_RAD and estimate.extents_mm[1] > 1e-3 * estimate.extents_mm[0]:
        return
    x, y, z = estimate.along
    raise CalibrationError(
        f"The {int(used.sum())} stripes lie on one line in space (direction {x:.2f}, {y:.2f}, {z:.2f} in the camera frame; they "
        f"spread {estimate.extents_mm[0]:.3g} mm along it, {estimate.extents_mm[1]:.3g} mm across), so the laser plane can turn "
        "about it. Add poses of the target nearer to the camera and farther away."
    )


def _missing(name: str, reason: str) -> StripeOnBoard:
    return StripeOnBoard(
        name, False, reason, RigidTransform.identity(), np.empty((0, 2)), np.empty((0, 3)), np.empty(0)
    )


def _misfit_reason(
    residuals: Float[np.ndarray, " n"], stripes: Sequence[PlacedStripe], used: Bool[np.ndarray, " v"], plane: Plane
) -> str:
    others = [
        float(np.sqrt(np.mean(plane.signed_distance_to(s.points_camera) ** 2)))
        for s, keep in zip(stripes, used, strict=True)
        if keep
    ]
    return (
        f"its stripe lies {np.sqrt(np.mean(residuals**2)):.3g} mm RMS from the plane of the others "
        f"(their median: {np.median(others):.3g} mm)"
    )


def _warnings(calibration: LaserPlaneCalibration, estimate: _Estimate) -> list[str]:
    used = [v for v in calibration.views if v.used]
    warnings = [f"{v.name} was left out: {v.reason}." for v in calibration.views if not v.used]
    if len(used) < _FEW_VIEWS:
        warnings.append(
            f"Only {len(used)} poses carry the laser plane, so a bad one can hardly be told. Add poses, nearer and farther."
        )
    thin = estimate.extents_mm[1] / estimate.extents_mm[0]
    if thin < _THIN:
        warnings.append(
            f"The stripes spread only {estimate.extents_mm[1]:.3g} mm RMS across their common direction "
            f"({estimate.extents_mm[0]:.3g} mm along it): the plane's tilt about it is known to "
            f"{1e3 * calibration.u_normal_rad[0]:.2g} mrad. Add poses nearer and farther."
        )
    return warnings
