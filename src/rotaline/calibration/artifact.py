"""The rotation axis optimised with a stepped cylinder.

The feature points of a full turn, turned back to angle 0 about the right axis, lie on the four ideal circles of the cylinder.
``sqp`` is the method of the article: the coordinates of two points of the axis change until the mean distance of the points
from the circles, eq. (14), is least. Each mount has its own pose of the cylinder; it starts from the line through the four
circle centres (coarse alignment) and is part of the same minimisation (fine alignment), with exact derivatives.
``least-squares`` minimises the squares of the radial and axial distances instead, robustly. Several mounts share one axis.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, section 4.2, eq. (11)-(14)
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.circle_centre import fit_circles_by_chords
from rotaline.calibration.feature_circles import N_AXIS, CircleModel, circle_model
from rotaline.calibration.model import ArtifactCalibration, ArtifactMount
from rotaline.errors import CalibrationError
from rotaline.geometry.primitives import Line, SteppedCylinder, unit
from rotaline.geometry.robust import CAUCHY, mad_scale
from rotaline.geometry.transforms import base_from_axis, rotate_about_line

MIN_FRAMES = 6
"""Fewest frames with feature points in a mount."""


@dataclass(frozen=True)
class ArtifactOptions:
    """How the rotation axis is optimised with the stepped cylinder."""

    method: Literal["sqp", "least-squares"] = field(
        default="sqp",
        metadata={
            "help": "sqp: mean distance, as in the article; least-squares: robust squares of radial and axial distance"
        },
    )
    tolerance: float = field(
        default=1e-8, metadata={"help": "the SQP stops when the mean distance changes by less, mm"}
    )
    max_iterations: int = field(default=150, metadata={"help": "most iterations of the optimisation"})
    outlier_factor: float = field(
        default=8.0,
        metadata={"help": "feature points further from their circle than this many median distances are left out"},
    )
    u_position_warning_mm: float = field(
        default=0.010, metadata={"help": "warn if the standard uncertainty of the axis position is larger, mm"}
    )


@dataclass(frozen=True, eq=False)
class ArtifactCapture:
    """The feature points of one mount of the stepped cylinder.

    Attributes
    ----------
    name : str
    frame_names : (f,) names
    angles_rad : (f,)   of the turntable, as read
    features_camera : (f, 4, 3)   mm; NaN where a feature point was not found
    reasons : (f,) texts   why feature points are missing in a frame (empty if all are there)
    """

    name: str
    frame_names: tuple[str, ...]
    angles_rad: Float[np.ndarray, " f"]
    features_camera: Float[np.ndarray, "f 4 3"]
    reasons: tuple[str, ...]


def optimise_axis(
    axis_start_camera: Line,
    turn_sense: int,
    captures: Sequence[ArtifactCapture],
    artifact: SteppedCylinder,
    options: ArtifactOptions | None = None,
) -> ArtifactCalibration:
    """Optimise the rotation axis over all mounts of the stepped cylinder together.

    Parameters
    ----------
    axis_start_camera : Line   initial axis, mm, direction upwards
    turn_sense : int   +1 if the turntable's angle is right-handed about the axis, else -1
    captures : sequence of ArtifactCapture   one a mount
    artifact : SteppedCylinder   its known sizes
    options : ArtifactOptions

    Returns
    -------
    ArtifactCalibration   the points of ``axis_camera`` and ``axis_before_camera`` lie at the bottom of the artefact, the table
    top: z = 0 of the base frame

    Raises
    ------
    CalibrationError
        If too few feature points remain to determine the axis; the message says how many and what to add.
    """
    options = options or ArtifactOptions()
    captures = tuple(captures)
    _check(captures)
    base_from_camera = base_from_axis(axis_start_camera)
    model = _model(captures, turn_sense, artifact, base_from_camera)

    start = np.concatenate(
        [np.zeros(N_AXIS), *(_coarse_pose(model, k, captures[k].name) for k in range(len(captures)))]
    )
    unknowns, run = _solve(model, start, options)
    keep = _inliers(model, unknowns, options.outlier_factor)
    if not keep.all():
        _check(_without(captures, model, keep))
        start_kept = unknowns.copy()
        start_kept[:N_AXIS] = 0.0
        unknowns, run = _solve(model.select(keep), start_kept, options)
        keep = _inliers(model, unknowns, options.outlier_factor)
    before = run.start

    used = model.select(keep)
    u_direction, u_position = _axis_uncertainty(used, unknowns, options.method)
    camera_from_base = base_from_camera.inv()
    axis_camera = _to_camera(model, unknowns, camera_from_base)
    axis_before_camera = _to_camera(model, before, camera_from_base)
    mounts = tuple(
        _mount(
            k,
            capture,
            first,
            model,
            keep,
            before,
            unknowns,
            turn_sense,
            base_from_camera,
            axis_before_camera,
            axis_camera,
        )
        for k, (capture, first) in enumerate(zip(captures, _first_frames(captures), strict=True))
    )
    return ArtifactCalibration(
        method=options.method,
        axis_camera=axis_camera,
        axis_before_camera=axis_before_camera,
        mounts=mounts,
        mean_distance_before_mm=run.history[0],
        mean_distance_mm=used.mean_distance_with_slope(unknowns)[0],
        n_iterations=run.n_iterations,
        converged=run.converged,
        history_mm=np.array(run.history),
        u_direction_rad=u_direction,
        u_position_mm=u_position,
        warnings=_warnings(mounts, keep, run, u_position, options),
    )


@dataclass(frozen=True, eq=False)
class _Run:
    """Course of one optimisation; ``start``: the unknowns with the start axis and the poses that suit it best."""

    start: Float[np.ndarray, " p"]
    history: list[float]
    n_iterations: int
    converged: bool


def _check(captures: Sequence[ArtifactCapture]) -> None:
    """Each mount needs frames enough to show a circle."""
    if not captures:
        raise CalibrationError("No capture of the stepped cylinder is left; at least one mount is needed.")
    for capture in captures:
        found = np.isfinite(capture.features_camera).all(axis=2)
        n_frames = int(np.count_nonzero(found.any(axis=1)))
        n_circles = int(np.count_nonzero(found.sum(axis=0) >= MIN_FRAMES))
        if n_circles < 2:
            raise CalibrationError(
                f"{capture.name}: feature points of the stepped cylinder were found in {n_frames} of {len(found)} frames "
                f"({', '.join(f'B{h + 1}: {n}' for h, n in enumerate(found.sum(axis=0)))}); at least {MIN_FRAMES} frames "
                "for two of the four edges are needed. Take more angles over a full turn, or check exposure and the "
                "sizes of the artefact."
            )
    angles = np.concatenate([capture.angles_rad for capture in captures])
    directions = np.exp(1j * angles)
    if abs(directions.mean()) > 0.999:
        raise CalibrationError(
            f"The stepped cylinder was seen over {np.degrees(np.ptp(np.angle(directions / directions[0]))):.1f} deg of "
            "turntable angle only; that does not determine the axis. Take frames over a full turn."
        )


def _model(
    captures: Sequence[ArtifactCapture],
    turn_sense: int,
    artifact: SteppedCylinder,
    base_from_camera: RigidTransform,
) -> CircleModel:
    points, turn, mount, frame, circle = [], [], [], [], []
    n_frames = 0
    for k, capture in enumerate(captures):
        f, h = np.nonzero(np.isfinite(capture.features_camera).all(axis=2))
        points.append(base_from_camera.apply(capture.features_camera[f, h]))
        turn.append(-turn_sense * capture.angles_rad[f])
        mount.append(np.full(len(f), k))
        frame.append(f + n_frames)
        circle.append(h)
        n_frames += len(capture.angles_rad)
    return circle_model(
        np.concatenate(points),
        np.concatenate(turn),
        np.concatenate(mount),
        np.concatenate(frame),
        np.concatenate(circle),
        artifact,
    )


def _coarse_pose(model: CircleModel, mount: int, name: str) -> Float[np.ndarray, "5"]:
    """Pose of the cylinder from the line through the centres of the four circles (coarse alignment)."""
    turned = model.turned(np.zeros(model.n_unknowns))
    centres, heights = [], []
    for h in range(4):
        mine = (model.mount == mount) & (model.circle == h)
        if np.count_nonzero(mine) < 3:
            continue
        order = np.argsort(np.mod(-model.turn_rad[mine], 2 * np.pi))
        centre = fit_circles_by_chords(turned[mine][order][:, None]).centres[0]
        if np.isfinite(centre).all():
            centres.append(centre)
            heights.append(model.heights[h])
    if len(centres) < 2 or np.ptp(heights) == 0:
        raise CalibrationError(
            f"{name}: fewer than two feature circles have a centre, so the cylinder has no pose. Take frames over a full turn."
        )
    middle = np.mean(centres, axis=0)
    direction = np.linalg.svd(np.array(centres) - middle)[2][0]
    direction = direction * np.sign(direction[2])
    if direction[2] < 0.9:  # circles too poor for a line: start upright
        direction = np.array([0.0, 0.0, 1.0])
    bottom = middle - np.mean(heights) * direction
    return np.array([*bottom, *(direction[:2] / direction[2] * model.lever)])


def _solve(
    model: CircleModel, start: Float[np.ndarray, " p"], options: ArtifactOptions
) -> tuple[Float[np.ndarray, " p"], _Run]:
    """First the poses with the axis as it is, then axis and poses."""
    if options.method == "sqp":
        poses = _pose_of_least_mean_distance(model, start)
        unknowns, history, converged = _minimise_mean_distance(model, poses, options)
    else:
        poses = _minimise_squares(model, start, options, free=slice(N_AXIS, None))[0]
        unknowns, history, converged = _minimise_squares(model, poses, options, free=slice(0, None))
    return unknowns, _Run(poses, history, len(history) - 1, converged)


def _minimise_mean_distance(
    model: CircleModel, start: Float[np.ndarray, " p"], options: ArtifactOptions
) -> tuple[Float[np.ndarray, " p"], list[float], bool]:
    """SQP on eq. (14) over the six changes of Pa and Pb; the cylinders' poses are fitted anew for each axis.

    At the best poses the objective does not change with them to first order, so its gradient is the one at fixed poses.
    """
    poses = start

    def objective(axis_changes: Float[np.ndarray, "6"]) -> tuple[float, Float[np.ndarray, "6"]]:
        nonlocal poses
        poses = _pose_of_least_mean_distance(model, np.concatenate([axis_changes, poses[N_AXIS:]]))
        value, slope = model.mean_distance_with_slope(poses)
        return value, slope[:N_AXIS]

    history = [objective(start[:N_AXIS])[0]]
    result = minimize(
        objective,
        start[:N_AXIS],
        jac=True,
        method="SLSQP",
        callback=lambda intermediate_result: history.append(float(intermediate_result.fun)),
        options={"ftol": options.tolerance, "maxiter": options.max_iterations},
    )
    # mode 8: no step lowers the objective any more, which is the end of what floating point allows at a kink
    converged = bool(result.success) or (result.status == 8 and result.fun <= history[0])
    return _pose_of_least_mean_distance(model, np.concatenate([result.x, poses[N_AXIS:]])), history, converged


def _pose_of_least_mean_distance(model: CircleModel, unknowns: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Fine alignment: the poses that make the mean distance least while the axis stays.

    Least squares with the weights 1 / distance, repeated until they settle (Weiszfeld's iteration).
    """
    best = unknowns.copy()
    for _ in range(60):
        residuals, slopes = model.residuals_with_slopes(best)
        distance = np.linalg.norm(residuals, axis=1)
        typical = float(np.median(distance))
        root = np.repeat(1.0 / np.sqrt(np.maximum(distance, 1e-3 * typical + 1e-9)), 2)
        system = slopes[:, :, N_AXIS:].reshape(root.size, -1) * root[:, None]
        step = np.linalg.lstsq(system, -root * residuals.ravel(), rcond=None)[0]
        best[N_AXIS:] += step
        if np.abs(step).max() <= 1e-4 * typical + 1e-12:
            break
    return best


def _minimise_squares(
    model: CircleModel, start: Float[np.ndarray, " p"], options: ArtifactOptions, free: slice
) -> tuple[Float[np.ndarray, " p"], list[float], bool]:
    """Gauss-Newton on the radial and axial distances, with Cauchy weights on the scale of the residuals.

    The weights come in when the plain squares have settled; each step solves the linear problem by orthogonal factorisation
    and takes the shortest solution, which leaves the idle sliding of Pa and Pb at rest.
    """
    unknowns = start.copy()
    history = [model.mean_distance_with_slope(unknowns)[0]]
    scale = np.inf
    for _ in range(options.max_iterations):
        residuals, slopes = model.residuals_with_slopes(unknowns)
        root = 1.0 / np.sqrt(1.0 + (residuals / scale) ** 2).ravel()
        system = slopes.reshape(root.size, -1)[:, free] * root[:, None]
        step = np.linalg.lstsq(system, -root * residuals.ravel(), rcond=1e-12)[0]
        unknowns[free] += step
        history.append(model.mean_distance_with_slope(unknowns)[0])
        size = float(np.abs(step).max())
        if np.isinf(scale) and size < 1e-3:
            scale = _cauchy_scale(model.residuals(unknowns))
        elif size < 1e-11:
            return unknowns, history, True
    return unknowns, history, False


def _cauchy_scale(residuals: Float[np.ndarray, "n 2"]) -> float:
    """Where the Cauchy weights fall to a half, mm; never so small that rounding errors count as residuals."""
    return max(CAUCHY * mad_scale(residuals.ravel()), 1e-9)


def _inliers(model: CircleModel, unknowns: Float[np.ndarray, " p"], factor: float) -> Bool[np.ndarray, " n"]:
    """Feature points whose distance is like that of the others (median over the same circle of the same mount)."""
    distance = np.linalg.norm(model.residuals(unknowns), axis=1)
    group = model.mount * 4 + model.circle
    typical = np.array([np.median(distance[group == g]) if np.any(group == g) else 0.0 for g in range(group.max() + 1)])
    # exact data leave distances of rounding errors; 0.1 um is below any measurement
    return distance <= np.maximum(factor * typical[group], 1e-4)


def _first_frames(captures: Sequence[ArtifactCapture]) -> list[int]:
    """Number of the first frame of each mount in the model."""
    return [sum(len(capture.angles_rad) for capture in captures[:k]) for k in range(len(captures))]


def _without(
    captures: Sequence[ArtifactCapture], model: CircleModel, keep: Bool[np.ndarray, " n"]
) -> tuple[ArtifactCapture, ...]:
    """The captures with only the feature points that are kept."""
    kept = []
    for k, (capture, first) in enumerate(zip(captures, _first_frames(captures), strict=True)):
        mine = keep & (model.mount == k)
        rows = (model.frame[mine] - first, model.circle[mine])
        features = np.full_like(capture.features_camera, np.nan)
        features[rows] = capture.features_camera[rows]
        kept.append(replace(capture, features_camera=features))
    return tuple(kept)


def _axis_uncertainty(model: CircleModel, unknowns: Float[np.ndarray, " p"], method: str) -> tuple[float, float]:
    """Larger standard uncertainties of direction (rad) and of position at mid height (mm), from the residuals.

    The sandwich of an M-estimator: slopes of the estimating equations outside, their scatter inside. The scatter is summed
    frame by frame, because the four points of a frame share the error of its angle and of the table's run-out.
    """
    residuals, slopes = model.residuals_with_slopes(unknowns)
    free = np.r_[0:2, 3:5, N_AXIS : model.n_unknowns]  # without the sliding of Pa and Pb along the axis
    slopes = slopes[:, :, free]
    if method == "sqp":
        distance = np.linalg.norm(residuals, axis=1)
        soft = np.sqrt(distance**2 + (0.1 * np.median(distance)) ** 2) + 1e-15
        pull = residuals / soft[:, None]
        stiffness = (np.eye(2) - pull[:, :, None] * pull[:, None, :]) / soft[:, None, None]
    else:
        scale = _cauchy_scale(residuals)
        weight = 1.0 / (1.0 + (residuals / scale) ** 2)
        pull = weight * residuals
        stiffness = np.eye(2) * (weight**2 * (1 - (residuals / scale) ** 2))[:, :, None]
    outside = np.einsum("nap,nab,nbq->pq", slopes, stiffness, slopes)
    frames, index = np.unique(model.frame, return_inverse=True)
    sums = np.zeros((len(frames), len(free)))
    np.add.at(sums, index, np.einsum("nap,na->np", slopes, pull))
    few = len(frames) / max(len(frames) - 1, 1) * residuals.size / max(residuals.size - len(free), 1)
    inverse = np.linalg.pinv(outside, hermitian=True)
    cov = (few * inverse @ (sums.T @ sums) @ inverse)[:4, :4]

    middle = float(np.median(model.points[:, 2])) / model.lever
    at_middle = np.hstack([np.eye(2) * (1 - middle), np.eye(2) * middle])
    slope = np.hstack([-np.eye(2), np.eye(2)]) / model.lever
    u_position = float(np.sqrt(max(np.linalg.eigvalsh(at_middle @ cov @ at_middle.T).max(), 0.0)))
    u_direction = float(np.sqrt(max(np.linalg.eigvalsh(slope @ cov @ slope.T).max(), 0.0)))
    return u_direction, u_position


def _to_camera(model: CircleModel, unknowns: Float[np.ndarray, " p"], camera_from_base: RigidTransform) -> Line:
    """The axis in the camera frame; its point at the height of the bottoms of the mounts."""
    axis = model.axis(unknowns)
    bottoms = np.array([model.pose(unknowns, k).point for k in range(model.n_mounts)])
    point = axis.closest_to(bottoms.mean(axis=0)[None])[0]
    return Line(camera_from_base.apply(point), unit(camera_from_base.rotation.apply(axis.direction)))


def _mount(
    mount: int,
    capture: ArtifactCapture,
    first_frame: int,
    model: CircleModel,
    keep: Bool[np.ndarray, " n"],
    before: Float[np.ndarray, " p"],
    after: Float[np.ndarray, " p"],
    turn_sense: int,
    start_from_camera: RigidTransform,
    axis_before_camera: Line,
    axis_camera: Line,
) -> ArtifactMount:
    mine = model.mount == mount
    rows = (model.frame[mine] - first_frame, model.circle[mine])
    kept = np.zeros((len(capture.angles_rad), 4), dtype=bool)
    kept[rows] = keep[mine]

    def distances(unknowns: Float[np.ndarray, " p"]) -> Float[np.ndarray, "f 4"]:
        table = np.full(kept.shape, np.nan)
        table[rows] = np.linalg.norm(model.residuals(unknowns)[mine], axis=1)
        return np.where(kept, table, np.nan)

    d_before, d_after = distances(before), distances(after)
    reasons = list(capture.reasons)
    found = np.isfinite(capture.features_camera).all(axis=2)
    for f in np.flatnonzero((found & ~kept).any(axis=1)):
        left_out = ", ".join(f"B{h + 1}" for h in np.nonzero(found[f] & ~kept[f])[0])
        reasons[f] = "; ".join(filter(None, [reasons[f], f"{left_out} far from the ideal circle"]))
    pose_before = _base_from_part(model.pose(before, mount), start_from_camera, axis_before_camera)
    pose_after = _base_from_part(model.pose(after, mount), start_from_camera, axis_camera)
    mid_height = (model.heights[0] + model.heights[3]) / 2
    centre = pose_after.apply(np.array([0.0, 0.0, mid_height]))
    return ArtifactMount(
        name=capture.name,
        frame_names=capture.frame_names,
        angles_rad=capture.angles_rad,
        frame_used=tuple(bool(row.any()) for row in kept),
        frame_reasons=tuple(reasons),
        features_camera=capture.features_camera,
        features_before_base=_turn_back(capture, axis_before_camera, turn_sense),
        features_base=_turn_back(capture, axis_camera, turn_sense),
        distances_before_mm=d_before,
        distances_mm=d_after,
        base_from_part_before=pose_before,
        base_from_part=pose_after,
        mean_distance_before_mm=float(np.nanmean(d_before)),
        mean_distance_mm=float(np.nanmean(d_after)),
        eccentricity_mm=float(np.linalg.norm(centre[:2])),
    )


def _turn_back(capture: ArtifactCapture, axis_camera: Line, turn_sense: int) -> Float[np.ndarray, "f 4 3"]:
    """Feature points turned back to angle 0, in the base frame of the axis, eq. (11)."""
    angles = np.repeat(-turn_sense * capture.angles_rad, 4)
    turned = rotate_about_line(capture.features_camera.reshape(-1, 3), axis_camera, angles)
    return base_from_axis(axis_camera).apply(turned).reshape(-1, 4, 3)


def _base_from_part(axis_start_base: Line, start_from_camera: RigidTransform, axis_camera: Line) -> RigidTransform:
    """Pose of a cylinder in the base frame of an axis; the cylinder's turn about itself, which nothing shows, is the least."""
    to_base = base_from_axis(axis_camera) * start_from_camera.inv()
    direction = to_base.rotation.apply(axis_start_base.direction)
    across = np.cross([0.0, 0.0, 1.0], direction)
    sine = float(np.linalg.norm(across))
    turn = across / sine * np.arctan2(sine, direction[2]) if sine > 0 else across
    return RigidTransform.from_components(to_base.apply(axis_start_base.point), Rotation.from_rotvec(turn))


def _warnings(
    mounts: Sequence[ArtifactMount],
    keep: Bool[np.ndarray, " n"],
    run: _Run,
    u_position_mm: float,
    options: ArtifactOptions,
) -> tuple[str, ...]:
    warnings = []
    if not run.converged:
        warnings.append(
            f"The optimisation of the rotation axis stopped after {run.n_iterations} iterations without converging."
        )
    left_out = int(np.count_nonzero(~keep))
    if left_out > 0.05 * len(keep):
        warnings.append(
            f"{left_out} of {len(keep)} feature points were left out: they lie far from the ideal circles. "
            "Check the sizes of the artefact, and the stripes of the frames named."
        )
    largest = max(mount.eccentricity_mm for mount in mounts)
    if u_position_mm > options.u_position_warning_mm and largest < 3.0:
        warnings.append(
            f"The mounts of the stepped cylinder stand at most {largest:.1f} mm off the rotation axis, so they say little about "
            f"it: standard uncertainty of its position {u_position_mm * 1000:.0f} um. Add a mount 5 to 8 mm off centre."
        )
    elif u_position_mm > options.u_position_warning_mm:
        warnings.append(
            f"The standard uncertainty of the rotation axis is {u_position_mm * 1000:.0f} um. Take more angles over a full turn, "
            "or add a mount 5 to 8 mm off centre."
        )
    elif largest < 2.0:
        warnings.append(
            f"All mounts of the stepped cylinder are nearly centred (at most {largest:.1f} mm off the rotation axis): errors of the "
            "laser plane and of the artefact's sizes then go into the axis. Add a mount 5 to 8 mm off centre."
        )
    return tuple(warnings)
