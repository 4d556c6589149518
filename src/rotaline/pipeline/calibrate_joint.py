"""The joint estimate, from what the stages before it found."""

from collections.abc import Sequence

import numpy as np

from rotaline.calibration.artifact import SENSE_ASSUMED
from rotaline.calibration.joint.estimate import estimate_jointly
from rotaline.calibration.joint.model import GroupKind, JointCalibration, JointStart, MountStart
from rotaline.calibration.joint.observability import u_of_points
from rotaline.calibration.model import (
    AxisCalibration,
    CameraCalibration,
    LaserPlaneCalibration,
    SystemCalibration,
)
from rotaline.calibration.mount_start import start_from_artifact, start_mounts
from rotaline.calibration.observations import MountObservation, SessionObservations
from rotaline.geometry.primitives import Line, Plane
from rotaline.pipeline.options import Options
from rotaline.pipeline.stage_runner import StageRunner

_GROUPS: dict[GroupKind, str] = {
    "target": "targets",
    "plate-stripe": "stripes on targets",
    "table-target": "target on the table",
    "artifact": "artefact",
}


def start_joint_estimate(
    camera: CameraCalibration,
    laser_plane: LaserPlaneCalibration | None,
    axis: AxisCalibration | None,
    mounts: Sequence[MountObservation],
    options: Options,
    runner: StageRunner,
) -> tuple[JointStart, tuple[str, ...]]:
    """Where the joint estimate starts, and the stages that this comes from."""
    needs = ["camera"]
    axis_camera, sense, starts = None, 1, tuple[MountStart, ...]()
    if axis is not None:
        axis_camera, sense = axis.axis_camera, axis.turn_sense
        needs.append("axis")
    if laser_plane is None:
        return JointStart(camera, None, None, axis, axis_camera, sense, ()), tuple(needs)
    plane_camera = laser_plane.plane_camera
    needs.append("laser-plane")
    if mounts and axis_camera is None:
        assumed = options.artifact.assumed_turn_sense
        found = runner.attempt(
            "axis-from-artifact",
            "Initial rotation axis from the artefact",
            (*needs, "mounts"),
            assumed,
            lambda: start_from_artifact(camera.camera, plane_camera, mounts, assumed),
            stage="joint",
        )
        if found is not None:
            axis_camera, sense = found
            needs.append("axis-from-artifact")
            runner.warn("joint", SENSE_ASSUMED)
    if mounts and axis_camera is not None:
        starts = _mount_starts(camera, plane_camera, axis_camera, sense, mounts, needs, runner)
        needs.append("mount-starts")
    return JointStart(camera, laser_plane, plane_camera, axis, axis_camera, sense, starts), tuple(needs)


def _mount_starts(
    camera: CameraCalibration,
    plane_camera: Plane,
    axis_camera: Line,
    sense: int,
    mounts: Sequence[MountObservation],
    needs: Sequence[str],
    runner: StageRunner,
) -> tuple[MountStart, ...]:
    starts, warnings = runner.run(
        "mount-starts",
        "Where the artefacts stand",
        (*needs, "mounts"),
        None,
        lambda: start_mounts(camera.camera, plane_camera, axis_camera, sense, mounts),
    )
    for text in warnings:
        runner.warn("joint", text, serious=not starts)
    return starts


def estimate(
    observations: SessionObservations,
    start: JointStart,
    needs: Sequence[str],
    options: Options,
    runner: StageRunner,
) -> JointCalibration | None:
    """The joint estimate; None where it failed."""
    result = runner.attempt(
        "joint", "Joint estimate", needs, options.joint, lambda: estimate_jointly(observations, start, options.joint)
    )
    if result is not None:
        for text in _figures(result):
            runner.note(text)
        for text in result.warnings:
            runner.warn("joint", text)
    return result


def joint_system(joint: JointCalibration) -> SystemCalibration | None:
    """The system of the joint estimate, z = 0 not on the table yet; None without a laser plane or an axis."""
    if joint.laser_plane_camera is None or joint.axis_camera is None:
        return None
    return SystemCalibration(
        joint.camera,
        joint.laser_plane_camera,
        joint.axis_camera,
        joint.turn_sense,
        table_seen=False,
        laser_curvature=joint.laser_curvature,
        angle_error=joint.angle_error,
        table_motion=joint.table_motion,
        covariance=joint.covariance,
        line_sigma_mm=joint.line_sigma_mm,
        stripe_blur_px=joint.stripe_blur_px,
    )


def _figures(joint: JointCalibration) -> tuple[str, ...]:
    """Lines for the user: residuals, surfaces of the artefacts, uncertainties."""
    kinds = [kind for kind in _GROUPS if any(g.kind == kind for g in joint.groups)]
    lines = ["RMS " + ", ".join(f"{_GROUPS[kind]} {_rms_px(joint, kind):.3f} px" for kind in kinds)]
    for mount in joint.mounts:
        surfaces = ", ".join(f"{name} {rms:.4f}" for name, rms in zip(mount.surfaces, mount.rms_mm, strict=True))
        lines.append(f"{mount.name}: {surfaces} mm RMS")
    if joint.weak_directions:
        across = next(w for w in joint.weak_directions if w.quantity == "axis position across the laser plane")
        u_points = u_of_points(joint)
        lines.append(
            f"points near the axis to {1e3 * u_points:.2g} um, axis across the laser plane to {1e3 * across.u:.2g} um (k = 1)"
        )
    return tuple(lines)


def _rms_px(joint: JointCalibration, kind: GroupKind) -> float:
    groups = [g for g in joint.groups if g.kind == kind and g.n_used]
    if not groups:
        return float("nan")
    return float(np.sqrt(np.average([g.rms_px**2 for g in groups], weights=[g.n_used for g in groups])))
