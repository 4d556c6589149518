"""The initial rotation axis: frames that fit one rotation, how far the target turned against what was read, and the axis' uncertainty."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from rotaline.calibration.model import AxisCalibration, CameraCalibration, TargetView
from rotaline.calibration.rotation_axis import AxisOptions, calibrate_axis
from rotaline.calibration.verdict.evidence import Evidence, Judged, Scale, gain_of, level_of, um, worst
from rotaline.calibration.verdict.model import Figure, Finding, Level, StepVerdict
from rotaline.errors import CalibrationError, GeometryError

_CLEAR = 6.0
_UNITS = (
    (0.9, "gon (400 a turn) read as degrees"),
    (10.0 / 9.0, "degrees read as gon (400 a turn)"),
    (np.degrees(1.0), "radians read as degrees"),
    (np.radians(1.0), "degrees read as radians"),
    (2.0, "half of the steps counted"),
    (0.5, "steps counted twice"),
)


def angle_scale(axis: AxisCalibration, camera: CameraCalibration | None) -> tuple[float, float]:
    """Measured turn of the target for a unit of the read angle; standard uncertainty from the scatter of the frames, and the focal length.

    A wrong focal length makes poses turn too much or too little, by about its own relative error.
    """
    frames = [f for f in axis.frames if f.used]
    if len(frames) < 3:
        return 1.0, float("nan")
    rotations = Rotation.concatenate([f.camera_from_board.rotation for f in frames])
    read = axis.turn_sense * np.array([f.angle_rad for f in frames])
    middle = len(frames) // 2
    turned = (rotations * rotations[middle].inv()).as_rotvec() @ axis.axis_camera.direction
    expected = read - read[middle]
    turned = expected + np.angle(np.exp(1j * (turned - expected)))
    slope, u_slope = _slope(expected, turned)
    u_focal = 0.0 if camera is None else float(np.max(camera.u_parameters[:2])) / camera.camera.fx
    return slope, float(np.hypot(u_slope, u_focal))


def _slope(x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> tuple[float, float]:
    x, y = x - x.mean(), y - y.mean()
    power = float(x @ x)
    if power == 0:
        return 1.0, float("nan")
    slope = float(x @ y) / power
    return slope, float(np.sqrt(np.sum((y - slope * x) ** 2) / (len(x) - 2) / power))


def with_true_angles(evidence: Evidence, factor: float) -> Evidence:
    """The evidence with all angles multiplied, and the axis of the target on the table found anew."""
    observations = evidence.observations
    camera = evidence.camera
    assert camera is not None
    table: tuple[TargetView, ...] = tuple(
        replace(v, angle_rad=None if v.angle_rad is None else factor * v.angle_rad) for v in observations.table_views
    )
    mounts = tuple(replace(m, angles_rad=factor * m.angles_rad) for m in observations.mounts)
    found = [replace(v, detection=camera.with_target_as_found(v.detection)) for v in table]
    axis = evidence.axis
    with suppress(CalibrationError, GeometryError):  # then the axis stays as it was
        axis = calibrate_axis(camera.camera, found, AxisOptions(method="joint"))
    return replace(evidence, observations=replace(observations, table_views=table, mounts=mounts), axis=axis)


def judge_axis(evidence: Evidence, scale: Scale) -> Judged:
    """The step "axis"."""
    observations, axis = evidence.observations, evidence.axis
    if not observations.table_views:
        return _without_target(evidence)
    if axis is None:
        reason = evidence.failures.get("axis", "there is no camera")
        if evidence.camera is None:
            return Judged(StepVerdict("axis", "fail", "Without a camera there is no axis."))
        return Judged(StepVerdict("axis", "fail", f"The axis was not found: {reason}"), (_failure(reason),))
    used = [f for f in axis.frames if f.used]
    factor, u_factor = angle_scale(axis, evidence.camera)
    figures = [
        Figure("corners from their circles", axis.rms_mm, "mm RMS"),
        Figure("frames used", float(len(used)), "frames", f"of {len(axis.frames)}"),
        Figure("uncertainty of the position", axis.u_position_mm, "mm"),
        Figure("uncertainty of the direction", axis.u_direction_rad, "rad"),
        Figure("turned against read angle", factor, "", f"1 within {_CLEAR * u_factor:.1g}"),
    ]
    findings = []
    size = abs(factor - 1) * np.pi * scale.reach_mm
    if abs(factor - 1) > _CLEAR * u_factor and size > scale.matters_mm:
        findings.append(wrong_angle_scale("axis", factor, u_factor, size, scale, "the target on the table"))
    lost = [f for f in axis.frames if not f.used]
    if len(lost) > 0.25 * len(axis.frames) and not findings:
        findings.append(
            Finding(
                "views disagree",
                "axis",
                "doubtful",
                f"{len(lost)} of {len(axis.frames)} frames of the target on the table do not fit one rotation: {lost[0].name}: {lost[0].reason}.",
                "Fix the target to the table, check angle_deg of these frames, and take the capture again.",
                2.0,
            )
        )
    level: Level = worst(["pass", *(f.level for f in findings)])
    text = f"{len(used)} of {len(axis.frames)} frames fit one rotation, axis known to {um(axis.u_position_mm)}"
    text += f"; {'; '.join(f.cause for f in findings)}." if findings else "."
    return Judged(StepVerdict("axis", level, text, tuple(figures)), tuple(findings))


def wrong_angle_scale(step: str, factor: float, u_factor: float, size: float, scale: Scale, who: str) -> Finding:
    """Finding of angles that are wrong by a factor."""
    guess = next((f" That would be {words}." for ratio, words in _UNITS if abs(factor / ratio - 1) < 0.01), "")
    return Finding(
        "wrong angle scale",
        step,
        level_of(size, scale),
        f"By {who}, the table turned {factor:.4f} (+- {2 * u_factor:.1g}) times as far as angle_deg says.{guess} After half a turn that is "
        f"{np.degrees(abs(factor - 1) * np.pi):.2g} deg, or {um(size)} at the edge of a part.",
        "Correct steps per turn, gear ratio or unit of angle_deg (degrees), check that the drive loses no steps, and calibrate again.",
        gain_of(size, scale),
    )


def _failure(reason: str) -> Finding:
    return Finding(
        "stage failed",
        "axis",
        "fail",
        f"The rotation axis was not found from the target on the table: {reason}",
        "Check that angle_deg of the axis capture is right and differs, and that the target does not slip; take 15 frames over 40 deg.",
        100.0,
    )


def _without_target(evidence: Evidence) -> Judged:
    if not evidence.observations.mounts:
        return Judged(StepVerdict("axis", "none", "The session has no capture with role axis."))
    text = (
        "No target on the turntable: the axis comes from the artefact alone, and the sense of rotation was assumed. If it is wrong, scans come "
        "out as mirror images."
    )
    finding = Finding(
        "sense assumed",
        "axis",
        "doubtful",
        text,
        "Add a capture with role axis: a target standing on the table, 10 to 20 angles over 40 deg.",
        1.5,
    )
    return Judged(StepVerdict("axis", "doubtful", text), (finding,))
