"""Laser plane optimisation by cross-ratio invariance (CRI), eq. (4)-(7).

Where the stripe crosses the rows of a dot plate, the dots of each row say, without any pose, how far along the row the crossing
is (module ``row_crossings``). Two neighbouring crossings are then a known distance apart, eq. (6); the distance that camera and
laser plane give, should be the same. The plane is moved until it is, eq. (7).

The plane has three degrees of freedom. They are counted as displacements of the stripe points in mm: at the rms extents along
the two principal directions, and of the centroid. Directions that the intervals leave open keep the value of the fit to the
points, and a plane that does not do better on poses that it was not made from is not accepted.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, section 3.2, eq. (4)-(7), figures 3 and 8
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import least_squares, minimize

from rotaline.calibration.model import CrossRatioResult, LaserPlaneCalibration
from rotaline.calibration.row_crossings import find_intervals
from rotaline.calibration.stripe_on_board import StripeView, place_stripe_on_board
from rotaline.errors import CalibrationError, DetectionError
from rotaline.geometry.primitives import Plane, unit
from rotaline.geometry.robust import mad_scale
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import DotGrid

MIN_INTERVALS = 6
_OUTLIER = 6.0
_HELPS = 0.95
_POINTS_MAY_GROW = 1.1


@dataclass(frozen=True)
class CrossRatioOptions:
    """Options of the laser plane optimisation."""

    method: Literal["sqp", "least-squares"] = field(
        default="sqp",
        metadata={"help": "sqp: the article's sequential quadratic programming; least-squares: same minimum, faster"},
    )
    tolerance: float = field(default=1e-8, metadata={"help": "smallest change of the objective that counts, mm"})
    max_iterations: int = field(default=150, metadata={"help": "most iterations"})
    dots: Literal["row", "triple"] = field(
        default="row", metadata={"help": "dots that place a crossing: the whole row, or three dots as in the article"}
    )
    window_pitches: float | None = field(
        default=None,
        metadata={
            "help": "stripe points this many dot pitches around a row place the crossing; unset: the whole stripe"
        },
    )
    clearance_widths: float = field(
        default=2.5,
        metadata={"help": "distance that stripe points keep from dots, in standard deviations of the stripe's profile"},
    )


def optimise_plane_cross_ratio(
    camera: CameraModel,
    calibration: LaserPlaneCalibration,
    views: Sequence[StripeView],
    options: CrossRatioOptions = CrossRatioOptions(),
) -> CrossRatioResult:
    """Move the laser plane so that the intervals between dot rows come out right, eq. (7) of [1]_.

    Parameters
    ----------
    camera : CameraModel
    calibration : LaserPlaneCalibration   where to start; views that it left out are left out here
    views : dot plate and stripe of each pose; views of other targets are ignored
    options : CrossRatioOptions

    Returns
    -------
    CrossRatioResult
        ``measured_after_mm`` and ``rmse_after_mm`` are those of the optimised plane, also where it was not accepted.

    Raises
    ------
    CalibrationError
        If there are too few intervals: the stripe must cross neighbouring rows of the dot plate. Add poses.
    """
    intervals, lost = _collect(camera, calibration, views, options)
    if len(intervals.reference_mm) < MIN_INTERVALS:
        raise CalibrationError(
            f"The optimisation by cross-ratios needs at least {MIN_INTERVALS} intervals between neighbouring rows of a dot plate, "
            f"found {len(intervals.reference_mm)}"
            + (f" ({'; '.join(lost[:5])})" if lost else "")
            + ". Add poses in which the "
            "stripe crosses several rows, or leave the step out."
        )
    moved = _movable(calibration)
    before = intervals.measure(moved(np.zeros(3)))[0]
    kept = intervals.select(_inliers(before - intervals.reference_mm))
    basis, open_warning = _determined(kept, moved, calibration)
    shift, history, n_iterations, converged = _minimise(kept, moved, basis, options)
    plane = moved(shift)[0]

    error_before = kept.measure(moved(np.zeros(3)))[0] - kept.reference_mm
    measured_after = kept.measure(moved(shift))[0]
    rmse_before, rmse_after = _rms(error_before), _rms(measured_after - kept.reference_mm)
    held_out = _held_out_rmse(kept, moved, basis)
    points_before, points_after = _points_rms(calibration, calibration.plane_camera), _points_rms(calibration, plane)
    reason = _judge(rmse_before, rmse_after, held_out, points_before, points_after)
    warnings = [f"{text}." for text in lost] + ([open_warning] if open_warning else [])
    n_outliers = len(intervals.reference_mm) - len(kept.reference_mm)
    if n_outliers:
        warnings.append(
            f"{n_outliers} of {len(intervals.reference_mm)} intervals were far off the others and left out."
        )
    if not converged:
        warnings.append(f"The optimisation did not converge within {options.max_iterations} iterations.")
    return CrossRatioResult(
        calibration.plane_camera if reason else plane,
        calibration.plane_camera,
        not reason,
        reason,
        kept.names,
        kept.view,
        kept.row,
        kept.reference_mm,
        error_before + kept.reference_mm,
        measured_after,
        rmse_before,
        rmse_after,
        n_iterations,
        converged,
        history,
        tuple(warnings),
    )


_MovedPlane = tuple[Plane, Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]
"""A plane, and the derivatives of its (not normalised) normal and offset by the three displacements."""


@dataclass(frozen=True, eq=False)
class _Intervals:
    """All intervals of all views."""

    names: tuple[str, ...]
    view: Int[np.ndarray, " m"]
    row: Int[np.ndarray, " m"]
    reference_mm: Float[np.ndarray, " m"]
    first: Float[np.ndarray, "m 3"]
    second: Float[np.ndarray, "m 3"]

    def select(self, keep: Bool[np.ndarray, " m"]) -> "_Intervals":
        """The intervals for which ``keep`` is true."""
        return _Intervals(
            self.names, self.view[keep], self.row[keep], self.reference_mm[keep], self.first[keep], self.second[keep]
        )

    def measure(self, moved: _MovedPlane) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 3"]]:
        """Distances of the crossings as camera and plane give them, mm, with their derivatives by the displacements."""
        plane, by_normal, by_offset = moved

        def depths(rays: Float[np.ndarray, "m 3"]) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m 3"]]:
            across = rays @ plane.normal
            s = -plane.offset / across
            return s, -(by_offset + s[:, None] * (rays @ by_normal)) / across[:, None]

        (s1, ds1), (s2, ds2) = depths(self.first), depths(self.second)
        chord = s1[:, None] * self.first - s2[:, None] * self.second
        length = np.linalg.norm(chord, axis=1)
        direction = chord / length[:, None]
        along_first, along_second = np.sum(direction * self.first, axis=1), np.sum(direction * self.second, axis=1)
        return length, along_first[:, None] * ds1 - along_second[:, None] * ds2


def _collect(
    camera: CameraModel,
    calibration: LaserPlaneCalibration,
    views: Sequence[StripeView],
    options: CrossRatioOptions,
) -> tuple[_Intervals, list[str]]:
    """Intervals of the views that the plane was made from; and the views that gave none, with the reason."""
    left_out = {view.name for view in calibration.views if not view.used}
    names, lost = [], []
    found = []
    for view in views:
        if view.name in left_out or not isinstance(view.detection.target, DotGrid):
            continue
        try:
            placed = place_stripe_on_board(camera, view, options.clearance_widths)
        except DetectionError as error:
            lost.append(f"{view.name} gave no intervals: {error}")
            continue
        intervals = find_intervals(camera, view.detection, placed, options.dots, options.window_pitches)
        if len(intervals.row) == 0:
            lost.append(f"{view.name} gave no intervals: its stripe does not cross two neighbouring rows of dots")
            continue
        names.append(view.name)
        found.append(intervals)
    counts = [len(i.row) for i in found]

    def rays(xy: list[Float[np.ndarray, "_ 2"]]) -> Float[np.ndarray, "m 3"]:
        return np.column_stack([np.concatenate([np.empty((0, 2)), *xy]), np.ones(sum(counts))])

    return (
        _Intervals(
            tuple(names),
            np.repeat(np.arange(len(found)), counts),
            np.concatenate([np.empty(0, dtype=int), *(i.row for i in found)]),
            np.concatenate([np.empty(0), *(i.reference_mm for i in found)]),
            rays([i.first for i in found]),
            rays([i.second for i in found]),
        ),
        lost,
    )


def _movable(calibration: LaserPlaneCalibration) -> Callable[[Float[np.ndarray, "3"]], _MovedPlane]:
    """The plane as a function of three displacements of its points, mm (see the head of this module)."""
    centroid, axes, extents = _frame(calibration)
    start = calibration.plane_camera
    by_normal = np.column_stack([axes.T / extents, np.zeros(3)])

    def move(shift: Float[np.ndarray, "3"]) -> _MovedPlane:
        normal = start.normal + by_normal @ shift
        length = float(np.linalg.norm(normal))
        offset = -float(normal @ centroid) + float(shift[2])
        by_offset = -centroid @ by_normal + np.array([0.0, 0.0, 1.0])
        return Plane(unit(normal), offset / length), by_normal / length, by_offset / length

    return move


def _frame(
    calibration: LaserPlaneCalibration,
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "2 3"], Float[np.ndarray, "2"]]:
    """Centroid of the stripe points, on the plane; principal directions along it; rms extents, mm."""
    plane = calibration.plane_camera
    points = np.concatenate([view.points_camera for view in calibration.views if view.used])
    points = points - plane.signed_distance_to(points)[:, None] * plane.normal
    centroid = points.mean(axis=0)
    _, singular, vt = np.linalg.svd(points - centroid, full_matrices=False)
    return centroid, vt[:2], singular[:2] / np.sqrt(len(points))


def _inliers(errors: Float[np.ndarray, " m"]) -> Bool[np.ndarray, " m"]:
    scale = max(mad_scale(errors), 1e-9)
    return np.asarray(np.abs(errors - np.median(errors)) <= _OUTLIER * scale)


def _determined(
    intervals: _Intervals, moved: Callable[[Float[np.ndarray, "3"]], _MovedPlane], calibration: LaserPlaneCalibration
) -> tuple[Float[np.ndarray, "3 k"], str]:
    """Directions of displacement that the intervals determine; and a warning where they leave some open.

    A direction is open where its standard uncertainty from the intervals exceeds three times both the scatter of the stripe
    points and what these know of it.
    """
    measured, jacobian = intervals.measure(moved(np.zeros(3)))
    errors = measured - intervals.reference_mm
    _, singular, vt = np.linalg.svd(jacobian, full_matrices=False)
    rest = errors - jacobian @ np.linalg.lstsq(jacobian, errors, rcond=1e-9)[0]
    sigma = np.sqrt(rest @ rest / max(len(rest) - 3, 1))
    u_intervals = sigma / np.maximum(singular, 1e-12 * singular[0])
    _, _, extents = _frame(calibration)
    u_points = np.array(
        [calibration.u_normal_rad[1] * extents[0], calibration.u_normal_rad[0] * extents[1], calibration.u_offset_mm]
    )
    limit = 3 * np.maximum(np.sqrt(vt**2 @ u_points**2), calibration.rms_mm)
    keep = (u_intervals <= limit) | (singular > 0.3 * singular[0])
    if keep.all():
        return vt.T, ""
    return vt[keep].T, (
        f"The intervals leave {int((~keep).sum())} of the 3 degrees of freedom of the laser plane open (to "
        f"{u_intervals[~keep].max():.2g} mm at the stripes; the scatter of the stripe points is {calibration.rms_mm:.2g} mm): there the fit "
        "to the points was kept. Poses at different distances and tilts make the intervals tell more."
    )


def _minimise(
    intervals: _Intervals,
    moved: Callable[[Float[np.ndarray, "3"]], _MovedPlane],
    basis: Float[np.ndarray, "3 k"],
    options: CrossRatioOptions,
) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, " h"], int, bool]:
    """Displacement of least interval RMS; the objective at the start and after each iteration; iterations; converged."""

    def errors(y: Float[np.ndarray, " k"]) -> tuple[Float[np.ndarray, " m"], Float[np.ndarray, "m k"]]:
        measured, jacobian = intervals.measure(moved(basis @ y))
        return measured - intervals.reference_mm, jacobian @ basis

    def objective(y: Float[np.ndarray, " k"]) -> tuple[float, Float[np.ndarray, " k"]]:
        rest, jacobian = errors(y)
        value = _rms(rest)
        return value, jacobian.T @ rest / (len(rest) * max(value, 1e-15))

    start = np.zeros(basis.shape[1])
    history = [objective(start)[0]]

    def record(y: Float[np.ndarray, " k"]) -> None:
        history.append(objective(np.asarray(y))[0])

    if options.method == "sqp":
        solution = minimize(
            objective,
            start,
            jac=True,
            method="SLSQP",
            callback=record,
            options={"ftol": options.tolerance, "maxiter": options.max_iterations},
        )
        n_iterations = int(solution.nit)
    else:
        solution = least_squares(
            lambda y: errors(y)[0],
            start,
            jac=lambda y: errors(y)[1],
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
            max_nfev=options.max_iterations,
            callback=lambda intermediate_result: record(intermediate_result.x),
        )
        n_iterations = int(solution.njev)
    return basis @ solution.x, np.array(history), n_iterations, bool(solution.success)


def _held_out_rmse(
    intervals: _Intervals, moved: Callable[[Float[np.ndarray, "3"]], _MovedPlane], basis: Float[np.ndarray, "3 k"]
) -> float:
    """Interval RMSE of each view on the plane made from the other views; NaN with fewer than three views."""
    present = np.unique(intervals.view)
    if len(present) < 3:
        return float("nan")
    errors = []
    for k in present:
        others, own = intervals.select(intervals.view != k), intervals.select(intervals.view == k)
        shift = np.zeros(3)
        for _ in range(3):
            measured, jacobian = others.measure(moved(shift))
            step = np.linalg.lstsq(jacobian @ basis, others.reference_mm - measured, rcond=1e-9)[0]
            shift = shift + basis @ step
        errors.append(own.measure(moved(shift))[0] - own.reference_mm)
    return _rms(np.concatenate(errors))


def _points_rms(calibration: LaserPlaneCalibration, plane: Plane) -> float:
    """RMS distance of the stripe points, every view with the same weight, mm."""
    views = [np.mean(plane.signed_distance_to(v.points_camera) ** 2) for v in calibration.views if v.used]
    return float(np.sqrt(np.mean(views)))


def _judge(before: float, after: float, held_out: float, points_before: float, points_after: float) -> str:
    """Why the optimised plane is not taken; empty if it is."""
    if not after < before:
        return f"the interval RMSE does not go down ({before:.4g} mm before, {after:.4g} mm after)"
    if np.isnan(held_out):
        return "fewer than three poses have intervals, so the optimised plane cannot be tested on poses that it was not made from"
    if not held_out < _HELPS * before:
        return (
            f"on poses that it was not made from, the optimised plane is not clearly better (interval RMSE {held_out:.4g} mm, "
            f"that of the fit to the points {before:.4g} mm): what is left is noise of the intervals"
        )
    if not points_after < _POINTS_MAY_GROW * points_before:
        return (
            f"the optimised plane contradicts the stripe points (RMS distance {points_before:.4g} mm before, {points_after:.4g} mm "
            "after): the intervals pull it elsewhere, as a wrong pitch or distortion does"
        )
    return ""


def _rms(values: Float[np.ndarray, " n"]) -> float:
    return float(np.sqrt(np.mean(values**2)))
