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
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.axis_minimisation import AxisMinimum, Method, axis_uncertainty, minimise_axis
from rotaline.calibration.circle_centre import fit_circles_by_chords
from rotaline.calibration.feature_circles import N_AXIS, CircleModel, circle_model
from rotaline.calibration.model import ArtifactCalibration, ArtifactMount
from rotaline.errors import CalibrationError, GeometryError
from rotaline.geometry.primitives import Line, SteppedCylinder, unit
from rotaline.geometry.transforms import base_from_axis, rotate_about_line

MIN_FRAMES = 6
"""Fewest frames with feature points in a mount."""


SENSE_ASSUMED = (
    "The sense of rotation of the turntable was assumed: without a target on the turntable nothing shows it, and if it is wrong, "
    "scans come out as mirror images. Add an axis capture, or set artifact.assumed_turn_sense."
)
"""Warning that belongs to :func:`find_axis_from_artifact`."""


@dataclass(frozen=True)
class ArtifactOptions:
    """How the rotation axis is optimised with the stepped cylinder."""

    method: Method = field(
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
    assumed_turn_sense: Literal[1, -1] = field(
        default=1,
        metadata={"help": "without an axis capture: 1 if angle_deg grows counterclockwise seen from above, else -1"},
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
    limits = (options.method, options.tolerance, options.max_iterations)
    minimum = minimise_axis(model, start, *limits)
    keep = _inliers(model, minimum.after, options.outlier_factor)
    if not keep.all():
        _check(_without(captures, model, keep))
        start = np.concatenate([np.zeros(N_AXIS), minimum.after[N_AXIS:]])
        minimum = minimise_axis(model.select(keep), start, *limits)
    before, unknowns = minimum.before, minimum.after

    used = model.select(keep)
    u_direction, u_position = axis_uncertainty(used, unknowns, options.method)
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
        mean_distance_before_mm=used.mean_distance_with_slope(before)[0],
        mean_distance_mm=used.mean_distance_with_slope(unknowns)[0],
        n_iterations=minimum.n_iterations,
        converged=minimum.converged,
        history_mm=minimum.history_mm,
        u_direction_rad=u_direction,
        u_position_mm=u_position,
        warnings=_warnings(mounts, keep, minimum, u_position, options),
    )


def find_axis_from_artifact(
    captures: Sequence[ArtifactCapture], artifact: SteppedCylinder, options: ArtifactOptions | None = None
) -> tuple[Line, int]:
    """A start axis from the feature points alone, for sessions without a target on the turntable.

    All feature points lie in the laser plane. In it, the sides of the artefact point up, and the width of the step tells how far
    from the outer edge the cylinder's axis passes; over the turn it swings about the rotation axis. How far the rotation axis lies
    off the laser plane is tried out: the optimisation is run from several distances, and the best result is taken.

    The sense of rotation cannot be found this way: the mirror image of rig and mounts in the laser plane, turning the other way,
    has the same feature points. ``options.assumed_turn_sense`` is returned; see :data:`SENSE_ASSUMED`.

    Returns
    -------
    axis_camera : Line   mm, direction up
    turn_sense : int   the assumed one

    Raises
    ------
    CalibrationError
        If too few frames show all four feature points, or no start leads to an axis.
    """
    options = options or ArtifactOptions()
    _check(captures)
    features = np.concatenate([capture.features_camera for capture in captures])
    whole = np.isfinite(features).all(axis=(1, 2))
    if np.count_nonzero(whole) < MIN_FRAMES:
        raise CalibrationError(
            f"{np.count_nonzero(whole)} frames of the stepped cylinder show all four feature points; without a target on the "
            f"turntable at least {MIN_FRAMES} are needed to find the rotation axis. Add frames, or an axis capture."
        )
    angles = np.concatenate([capture.angles_rad for capture in captures])[whole]
    mount = np.repeat(np.arange(len(captures)), [len(capture.angles_rad) for capture in captures])[whole]
    corners = features[whole]
    normal = np.linalg.svd(corners.reshape(-1, 3) - corners.reshape(-1, 3).mean(axis=0), full_matrices=False)[2][2]
    up = unit(np.median(corners[:, 0] - corners[:, 1] + corners[:, 2] - corners[:, 3], axis=0))
    outward = unit(np.cross(up, normal) * np.sign(np.median((corners[:, 2] - corners[:, 1]) @ np.cross(up, normal))))

    r1, r2 = artifact.diameter_small / 2, artifact.diameter_large / 2
    width = np.maximum((corners[:, 2] - corners[:, 1]) @ outward, 0.5 * (r2 - r1))
    half_chord = np.clip((r2**2 - r1**2 - width**2) / (2 * width), 0.0, r1)
    position = corners[:, 1] @ outward - half_chord  # of the cylinder's axis
    swing = np.column_stack([np.eye(len(captures))[mount] * f(angles)[:, None] for f in (np.cos, np.sin)])
    centre = np.linalg.lstsq(np.column_stack([np.ones(len(angles)), swing]), position, rcond=1e-6)[0][0]
    bottom = float(np.median(corners[:, 3] @ up))
    in_plane = centre * outward + bottom * up + float(np.median(corners.reshape(-1, 3) @ normal)) * normal

    sense = options.assumed_turn_sense
    best: ArtifactCalibration | None = None
    for offset in (0.0, 2.0, -2.0, 5.0, -5.0):
        start = Line(in_plane + offset * normal, up)
        try:
            found = optimise_axis(start, sense, captures, artifact, replace(options, method="least-squares"))
        except (CalibrationError, GeometryError):
            continue
        if best is None or found.mean_distance_mm < best.mean_distance_mm:
            best = found
    if best is None:
        raise CalibrationError(
            "The rotation axis was not found from the stepped cylinder alone. Add an axis capture: a board on the turntable."
        )
    return best.axis_camera, sense


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
            f"{name}: fewer than two feature circles have a centre, so the cylinder has no pose. Take frames over a full turn; "
            "if they cover one, the stated sizes of the artefact do not fit the stripes: check them, and the pitch of every target."
        )
    middle = np.mean(centres, axis=0)
    direction = np.linalg.svd(np.array(centres) - middle)[2][0]
    direction = direction * np.sign(direction[2])
    if direction[2] < 0.9:  # circles too poor for a line: start upright
        direction = np.array([0.0, 0.0, 1.0])
    bottom = middle - np.mean(heights) * direction
    return np.array([*bottom, *(direction[:2] / direction[2] * model.lever)])


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
    minimum: AxisMinimum,
    u_position_mm: float,
    options: ArtifactOptions,
) -> tuple[str, ...]:
    warnings = []
    if not minimum.converged:
        warnings.append(
            f"The optimisation of the rotation axis stopped after {minimum.n_iterations} iterations without converging."
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
