"""The article's refinements: the laser plane by cross-ratios, then the axis by feature points of the stepped cylinder."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from rotaline.calibration.artifact import SENSE_ASSUMED, ArtifactCapture, find_axis_from_artifact, optimise_axis
from rotaline.calibration.cross_ratio import optimise_plane_cross_ratio
from rotaline.calibration.feature_points import extract_mount_features
from rotaline.calibration.model import (
    ArtifactCalibration,
    AxisCalibration,
    CrossRatioResult,
    LaserPlaneCalibration,
)
from rotaline.calibration.observations import MountObservation
from rotaline.calibration.stripe_on_board import StripeView
from rotaline.geometry.primitives import Line, Plane, SteppedCylinder
from rotaline.pipeline.options import Options
from rotaline.pipeline.stage_runner import StageRunner
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import DotGrid

MIN_DISAGREEMENT_MM = 0.3


def optimise_plane(
    camera: CameraModel,
    plane: LaserPlaneCalibration,
    views: Sequence[StripeView],
    options: Options,
    runner: StageRunner,
) -> CrossRatioResult | None:
    """The laser plane after stage "cross-ratio"; None without dot plates, or where it failed."""
    dots = [v for v in views if isinstance(v.detection.target, DotGrid)]
    if not dots:
        return None
    result = runner.attempt(
        "cross-ratio",
        "Laser plane optimisation (cross-ratio)",
        ("laser-plane",),
        options.cross_ratio,
        lambda: optimise_plane_cross_ratio(camera, plane, dots, options.cross_ratio),
    )
    if result is not None:
        verdict = "accepted" if result.accepted else f"not used: {result.reason}"
        runner.note(f"interval RMSE {result.rmse_before_mm:.4f} -> {result.rmse_after_mm:.4f} mm, {verdict}")
        for text in result.warnings:
            runner.warn("cross-ratio", text)
    return result


def refine_axis(
    camera: CameraModel,
    plane_camera: Plane,
    axis: AxisCalibration | None,
    mounts: Sequence[MountObservation],
    before: Sequence[str],
    options: Options,
    runner: StageRunner,
) -> tuple[int, ArtifactCalibration] | None:
    """Sense of the turn and axis after stage "artifact"; None without a stepped cylinder, or where it failed.

    ``before`` are the stages that plane and axis come from. Without an axis, one is looked for with the cylinder alone.
    """
    stepped = [m for m in mounts if isinstance(m.artifact, SteppedCylinder)]
    if not stepped:
        runner.warn(
            "artifact", "there is no stepped cylinder among the artefacts, which the article's way needs.", True
        )
        return None
    artifact = stepped[0].artifact
    assert isinstance(artifact, SteppedCylinder)
    start = (axis.axis_camera, axis.turn_sense) if axis is not None else None
    captures: list[ArtifactCapture] = []
    for mount in mounts:
        if mount.artifact != artifact:
            runner.warn("artifact", f"{mount.name}: another artefact than in {stepped[0].name}; left out.")
            continue
        captures.append(
            runner.run(
                f"features-{mount.name}",
                f"Feature points in {mount.name}",
                (*before, f"mounts/{mount.name}"),
                None,
                partial(_feature_points, mount, camera, plane_camera, artifact, axis),
            )
        )

    def compute() -> tuple[int, ArtifactCalibration]:
        axis_start, sense = start or find_axis_from_artifact(captures, artifact, options.artifact)
        return sense, optimise_axis(axis_start, sense, captures, artifact, options.artifact)

    needs = (*before, *(f"features-{c.name}" for c in captures))
    found = runner.attempt("artifact", "Axis optimisation (stepped cylinder)", needs, options.artifact, compute)
    if found is None:
        return None
    if axis is None:
        runner.warn("artifact", SENSE_ASSUMED)
    _tell(found[1], axis, runner)
    return found


def _feature_points(
    mount: MountObservation,
    camera: CameraModel,
    plane_camera: Plane,
    artifact: SteppedCylinder,
    axis: AxisCalibration | None,
) -> ArtifactCapture:
    axis_camera = axis.axis_camera if axis is not None else None
    found = extract_mount_features(mount.stripes, camera, plane_camera, artifact, axis_camera)
    return ArtifactCapture(
        name=mount.name,
        frame_names=mount.frame_names,
        angles_rad=mount.angles_rad,
        features_camera=np.array([f.points_camera for f in found]).reshape(-1, 4, 3),
        reasons=tuple(f.reason for f in found),
    )


def _tell(result: ArtifactCalibration, axis: AxisCalibration | None, runner: StageRunner) -> None:
    for mount in result.mounts:
        used = sum(mount.frame_used)
        runner.note(
            f"{mount.name}: {used} of {len(mount.frame_used)} frames, mean distance "
            f"{mount.mean_distance_before_mm:.4f} -> {mount.mean_distance_mm:.4f} mm"
        )
    for text in result.warnings:
        runner.warn("artifact", text)
    if axis is not None:
        u_mm = float(np.hypot(axis.u_position_mm, result.u_position_mm))
        if text := axis_disagreement(axis.axis_camera, result.axis_camera, u_mm):
            runner.warn("artifact", text)


def axis_disagreement(initial_camera: Line, final_camera: Line, u_mm: float) -> str:
    """What to say where the artefact moved the axis by far more than both can be off (``u_mm``); empty where it did not."""
    moved_mm = float(initial_camera.distance_to(final_camera.point[None])[0])
    if moved_mm < max(MIN_DISAGREEMENT_MM, 10.0 * u_mm):
        return ""
    return (
        f"the artefact puts the axis {moved_mm:.2f} mm from the initial one, but both are known to {u_mm:.2f} mm (k = 1): one of the "
        "two is wrong. Check the pitch of the target on the table, the sizes of the artefact, and that nothing moved between the captures."
    )
