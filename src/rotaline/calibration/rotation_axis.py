"""The initial rotation axis, from a flat target that turns with the table.

The pose of the board in each frame puts its points into the camera frame; each point moves on a circle, whose centre follows
from its chords, eq. (8)-(10) of [1]_; the axis is the line through the centres. The order of the points, the sense of
rotation and frames that do not belong come first: see :mod:`rotaline.calibration.turntable_motion`.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, section 4.1, eq. (8)-(10), figures 9 and 10
.. [2] Efron and Stein, The jackknife estimate of variance, Annals of Statistics 9 (1981) 586
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.circle_centre import CircleFits, fit_circles_by_chords
from rotaline.calibration.joint_axis import JointAxis, TurnedBoard, fit_axis_to_views
from rotaline.calibration.model import AxisCalibration, AxisFrame, TargetView
from rotaline.calibration.pose import estimate_board_pose
from rotaline.calibration.turntable_motion import TurntableMotion, find_turntable_motion
from rotaline.errors import CalibrationError, GeometryError
from rotaline.geometry.primitives import Line
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import Target, TargetDetection
from rotaline.vision.targets.ordering import symmetry_permutations

MIN_FRAMES = 3
"""Three positions make a circle."""

_MAX_GROUPS = 30
_MAX_CHECKED = 1500
"""Points on which frames that do not belong are found."""

_CLEAR_MISFIT_PX = 1.0


@dataclass(frozen=True)
class AxisOptions:
    """How the initial rotation axis is found."""

    method: Literal["circles", "joint"] | None = field(
        default=None,
        metadata={
            "help": "circles: centres of the circles of the corners, as in the article; joint: one axis for the images of all frames; "
            "default: circles where the article's way refines the axis with an artefact afterwards, else joint"
        },
    )
    min_range_deg: float = field(
        default=20.0, metadata={"help": "warn if the target was seen over a smaller range of angles, deg"}
    )
    outlier_factor: float = field(
        default=5.0,
        metadata={
            "help": "frames whose points lie further from the common rotation than this many times the median are left out"
        },
    )
    scale_tolerance: float = field(
        default=0.01, metadata={"help": "warn if measured and read angles differ by more than this fraction"}
    )


def calibrate_axis(
    camera: CameraModel, views: Sequence[TargetView], options: AxisOptions | None = None
) -> AxisCalibration:
    """Rotation axis and sense of the turntable from views of a target that stands on it.

    Parameters
    ----------
    camera : CameraModel
    views : sequence of TargetView   with ``angle_rad``; in any order, unevenly spaced, over any wrap of the angle
    options : AxisOptions

    Returns
    -------
    AxisCalibration   the axis points up (the camera sees the table top from above); its point is the one nearest to the optical
    axis. ``u_direction_rad`` and ``u_position_mm`` (at the middle of the circles' centres) are from a jackknife over the
    frames [2]_, with ``joint`` from the scatter of the frames. The circles are the same with both methods.

    Raises
    ------
    CalibrationError
        If fewer than three frames fit one rotation, or their angles do not differ; the message says what to add.
    """
    options = options or AxisOptions()
    frames = [_pose_frame(camera, view) for view in views]
    _require(frames)
    frames, motion = _settle_order(frames)
    _require(frames)
    frames = _leave_out_misfits(camera, frames, motion.direction_camera, options.outlier_factor)
    _require(frames)
    corners, circles, ids = _fit_circles(frames)

    line = _line_through_centres(circles, motion.direction_camera)
    up, warnings = _upwards(line.axis.direction)
    axis = _nearest_to_optical_axis(Line(line.axis.point, up))
    turn_sense = 1 if float(motion.direction_camera @ up) > 0 else -1
    if options.method == "joint":
        joint = _fit_to_views(camera, [frame for frame in frames if not frame.reason], axis, turn_sense)
        axis = _nearest_to_optical_axis(joint.axis_camera)
        u_direction, u_position = joint.u_direction_rad, joint.u_position_mm
    else:
        u_direction, u_position = _jackknife(corners, circles, motion.direction_camera, axis)
    warnings += _warnings(frames, motion, line, options)

    corners_camera = np.full((len(frames), len(ids), 3), np.nan)
    for f, frame in enumerate(frames):
        corners_camera[f] = frame.corners(ids)
    seen = np.isfinite(corners[..., 0]).sum(axis=0)
    return AxisCalibration(
        axis_camera=axis,
        turn_sense=turn_sense,
        frames=tuple(frame.result() for frame in frames),
        point_ids=ids,
        corners_camera=corners_camera,
        circle_centres_camera=circles.centres,
        circle_radii_mm=circles.radii_mm,
        circle_rms_mm=circles.rms_mm,
        rms_mm=float(np.sqrt(np.sum(circles.rms_mm**2 * seen) / np.sum(seen))),
        centre_line_rms_mm=line.rms_mm,
        u_direction_rad=u_direction,
        u_position_mm=u_position,
        warnings=tuple(warnings),
    )


@dataclass(frozen=True, eq=False)
class _Frame:
    """One view with its board's pose; ``reason`` is empty while the frame is used; ``turned_rad`` is its measured angle."""

    name: str
    angle_rad: float
    target: Target
    point_ids: Int[np.ndarray, " n"]
    uv: Float[np.ndarray, "n 2"]
    camera_from_board: RigidTransform
    rms_px: float
    reason: str
    turned_rad: float = float("nan")

    def corners(self, ids: Int[np.ndarray, " m"]) -> Float[np.ndarray, "m 3"]:
        """The given points of the board in the camera frame; NaN where the frame does not show them."""
        points = self.camera_from_board.apply(self.target.points_board()[ids])
        points[~np.isin(ids, self.point_ids)] = np.nan
        return np.asarray(points)

    def result(self) -> AxisFrame:
        return AxisFrame(self.name, not self.reason, self.reason, self.angle_rad, self.camera_from_board, self.rms_px)


def _pose_frame(camera: CameraModel, view: TargetView) -> _Frame:
    detection: TargetDetection = view.detection
    angle = float("nan") if view.angle_rad is None else view.angle_rad
    try:
        pose = estimate_board_pose(camera, detection.points_board, detection.uv)
    except GeometryError as error:
        nowhere = RigidTransform.identity()
        no_ids, no_uv = detection.point_ids[:0], detection.uv[:0]
        return _Frame(view.name, angle, detection.target, no_ids, no_uv, nowhere, float("nan"), str(error))
    reason = "" if np.isfinite(angle) else "the frame has no turntable angle"
    return _Frame(
        view.name,
        angle,
        detection.target,
        detection.point_ids[pose.used],
        detection.uv[pose.used],
        pose.camera_from_board,
        pose.rms_px,
        reason,
    )


def _require(frames: Sequence[_Frame]) -> None:
    used = [frame for frame in frames if not frame.reason]
    if len(used) >= MIN_FRAMES:
        return
    left_out = "; ".join(f"{frame.name}: {frame.reason}" for frame in frames if frame.reason)
    raise CalibrationError(
        f"The rotation axis needs at least {MIN_FRAMES} frames of the target on the turntable, better 15 over 40 deg or more; "
        f"{len(used)} of {len(frames)} can be used{f' ({left_out})' if left_out else ''}. Add frames at other angles."
    )


def _settle_order(frames: Sequence[_Frame]) -> tuple[list[_Frame], TurntableMotion]:
    """Points of all frames in one order, and frames marked that do not fit the rotation of the others."""
    index = [f for f, frame in enumerate(frames) if not frame.reason]
    orders = [_orders(frames[f]) for f in index]
    motion = find_turntable_motion(
        [Rotation.concatenate([pose.rotation for _, pose in alternatives]) for alternatives in orders],
        np.array([frames[f].angle_rad for f in index]),
    )
    if motion is None:
        raise CalibrationError(
            f"No two of the {len(index)} frames on the turntable show the target turned as far as their angles say. "
            "Check the column angle_deg of the axis capture: it needs different angles, at least 2 deg apart."
        )
    settled = list(frames)
    for k, f in enumerate(index):
        ids, pose = orders[k][motion.order[k]]
        ascending = np.argsort(ids)
        reason = "" if motion.fits[k] else "the board does not stand where its angle says, with any order of its points"
        settled[f] = replace(
            frames[f],
            point_ids=ids[ascending],
            uv=frames[f].uv[ascending],
            camera_from_board=pose,
            reason=reason,
            turned_rad=float(motion.turned_rad[k]),
        )
    return settled, motion


def _orders(frame: _Frame) -> list[tuple[Int[np.ndarray, " n"], RigidTransform]]:
    """The orders in which the points may stand: as read, and after the turns that leave the target as it looks."""
    points = frame.target.points_board()
    middle = points.mean(axis=0)
    orders = []
    for numbers in symmetry_permutations(frame.target):
        turn, _ = Rotation.align_vectors(points - middle, points[numbers] - middle)
        old_from_new = RigidTransform.from_components(middle - turn.apply(middle), turn)
        orders.append((numbers[frame.point_ids], frame.camera_from_board * old_from_new))
    return orders


def _fit_circles(
    frames: Sequence[_Frame],
) -> tuple[Float[np.ndarray, "f m 3"], CircleFits, Int[np.ndarray, " m"]]:
    """Circles of all points that enough frames show; corners in the order of the turn."""
    used = sorted((frame for frame in frames if not frame.reason), key=lambda frame: frame.turned_rad)
    ids, counts = np.unique(np.concatenate([frame.point_ids for frame in used]), return_counts=True)
    ids = ids[counts >= max(MIN_FRAMES, len(used) // 3)]
    if len(ids) == 0:
        raise CalibrationError(
            f"No point of the target is seen in {MIN_FRAMES} frames that fit one rotation. Add frames in which the same part "
            "of the target is in view."
        )
    corners = np.stack([frame.corners(ids) for frame in used])
    fitted = np.isfinite(fit_circles_by_chords(corners).rms_mm)
    if not fitted.any():
        raise CalibrationError("The points of the target hardly move between the frames. Add frames at other angles.")
    return corners[:, fitted], fit_circles_by_chords(corners[:, fitted]), ids[fitted]


def _leave_out_misfits(
    camera: CameraModel, frames: Sequence[_Frame], direction_camera: Float[np.ndarray, "3"], factor: float
) -> list[_Frame]:
    """Frames marked whose points are not where one rotation of the board puts them.

    The joint fit of all images judges: it is robust, and knows better than circles through single poses.
    """
    _, circles, _ = _fit_circles(frames)
    axis = _line_through_centres(circles, direction_camera).axis
    checked = list(frames)
    while True:
        used = [f for f, frame in enumerate(checked) if not frame.reason]
        if len(used) <= MIN_FRAMES:
            return checked
        joint = _fit_to_views(camera, [checked[f] for f in used], axis, 1, _MAX_CHECKED)
        worst = int(np.argmax(joint.frame_rms_px))
        others = float(np.median(np.delete(joint.frame_rms_px, worst)))
        if joint.frame_rms_px[worst] <= max(factor * others, _CLEAR_MISFIT_PX):
            return checked
        checked[used[worst]] = replace(
            checked[used[worst]],
            reason=f"its points lie {joint.frame_rms_px[worst]:.1f} px from where the rotation of the other frames puts them "
            f"(theirs {others:.2f} px)",
        )


@dataclass(frozen=True, eq=False)
class _CentreLine:
    """Line through the circle centres; ``from_centres`` is False where they lie too close together to show a direction."""

    axis: Line
    rms_mm: float
    from_centres: bool


def _line_through_centres(circles: CircleFits, turning_direction: Float[np.ndarray, "3"]) -> _CentreLine:
    """Total least squares; the direction of turning takes over where all points turn at nearly the same height."""
    middle = circles.centres.mean(axis=0)
    _, size, right = np.linalg.svd(circles.centres - middle, full_matrices=True)
    size = np.concatenate([size, np.zeros(3)])[:3]
    from_centres = bool(size[0] > 4.0 * size[1])
    direction = right[0] if from_centres else turning_direction
    direction = direction * np.sign(direction @ turning_direction)
    line = Line(middle, direction)
    return _CentreLine(line, float(np.sqrt(np.mean(line.distance_to(circles.centres) ** 2))), from_centres)


def _upwards(direction: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3"], list[str]]:
    """The direction turned up: against the optical axis of a camera that looks down on the table."""
    if abs(direction[2]) >= 0.1:
        return (direction if direction[2] < 0 else -direction), []
    up = direction if direction[1] < 0 else -direction
    return up, [
        "The camera looks at the table from the side (rotation axis and optical axis are nearly square to each other): "
        "up was taken as up in the image."
    ]


def _nearest_to_optical_axis(axis: Line) -> Line:
    """The same line; its point is the one nearest to the optical axis."""
    across = axis.direction[:2]
    along = float(axis.point[:2] @ across) / float(across @ across) if float(across @ across) > 1e-12 else 0.0
    return Line(axis.point - along * axis.direction, axis.direction)


def _fit_to_views(
    camera: CameraModel, frames: Sequence[_Frame], axis: Line, turn_sense: int, max_points: int | None = None
) -> JointAxis:
    """The axis that explains the images of all frames best; with ``max_points`` from a part of the points."""
    n_points = sum(len(frame.point_ids) for frame in frames)
    some = slice(None, None, 1 if max_points is None else max(1, -(-n_points // max_points)))
    start = sorted(frames, key=lambda frame: frame.turned_rad)[len(frames) // 2]
    boards = [
        TurnedBoard(
            frame.target.points_board()[frame.point_ids[some]],
            frame.uv[some],
            turn_sense * (frame.angle_rad - start.angle_rad),
        )
        for frame in frames
    ]
    return fit_axis_to_views(camera, boards, axis, start.camera_from_board)


def _jackknife(
    corners: Float[np.ndarray, "f m 3"],
    circles: CircleFits,
    turning_direction: Float[np.ndarray, "3"],
    axis: Line,
) -> tuple[float, float]:
    """Standard uncertainties of direction and position, larger component each: the fit repeated without some frames [2]_."""
    n_frames = len(corners)
    if n_frames <= MIN_FRAMES:
        return float("nan"), float("nan")
    n_groups = min(n_frames, _MAX_GROUPS)
    group = np.arange(n_frames) * n_groups // n_frames
    middle = circles.centres.mean(axis=0)
    positions, directions = [], []
    for g in range(n_groups):
        part = fit_circles_by_chords(corners[group != g])
        fitted = np.isfinite(part.rms_mm)
        part = CircleFits(part.centres[fitted], part.normals[fitted], part.radii_mm[fitted], part.rms_mm[fitted])
        line = _line_through_centres(part, turning_direction).axis
        direction = line.direction * np.sign(line.direction @ axis.direction)
        along = float((middle - line.point) @ axis.direction) / float(direction @ axis.direction)
        positions.append(line.point + along * direction)
        directions.append(direction)
    factor = (n_groups - 1) / n_groups
    u_position, u_direction = (
        float(np.sqrt(factor) * np.linalg.svd(np.array(values) - np.mean(values, axis=0))[1][0])
        for values in (positions, directions)
    )
    return u_direction, u_position


def _warnings(frames: Sequence[_Frame], motion: TurntableMotion, line: _CentreLine, options: AxisOptions) -> list[str]:
    warnings = [f"{frame.name} is left out: {frame.reason}." for frame in frames if frame.reason]
    turned = np.array([frame.turned_rad for frame in frames if not frame.reason])
    range_deg = float(np.degrees(np.ptp(turned)))
    if range_deg < options.min_range_deg:
        warnings.append(
            f"The target was seen over {range_deg:.1f} deg of turntable angle only; at least {options.min_range_deg:.0f} deg are "
            "needed for a reliable axis. Add frames at angles further apart."
        )
    if abs(motion.scale - 1.0) > max(options.scale_tolerance, 4.0 * motion.u_scale):
        warnings.append(
            f"The target turned {motion.scale:.3f} times as far as angle_deg says (standard uncertainty {motion.u_scale:.3f}). "
            "Check the gear ratio or the steps per turn of the turntable: every scan is wrong by the same factor."
        )
    if not line.from_centres:
        warnings.append(
            "All points of the target turn at nearly the same height, so the direction of the axis comes from the turns of the "
            "board alone. Stand the board upright on the table."
        )
    elif (off := float(np.degrees(np.arccos(min(abs(line.axis.direction @ motion.direction_camera), 1.0))))) > 3.0:
        warnings.append(
            f"The line through the circle centres and the direction about which the board turns differ by {off:.1f} deg. "
            "Check that the board does not slip, and the calibration of the camera."
        )
    return warnings
