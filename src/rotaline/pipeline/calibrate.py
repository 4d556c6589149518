"""Calibration from observations, stage by stage; a stage that fails is a warning, and what does not need it goes on.

Both ways begin with camera, laser plane and initial axis. The article's goes on with one refinement after the other
(:mod:`rotaline.pipeline.calibrate_article`), the other with one estimate of everything (:mod:`rotaline.pipeline.calibrate_joint`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from rotaline.calibration.intrinsics import calibrate_camera
from rotaline.calibration.joint.model import JointCalibration
from rotaline.calibration.laser_plane import calibrate_laser_plane
from rotaline.calibration.model import (
    ArtifactCalibration,
    AxisCalibration,
    CameraCalibration,
    CrossRatioResult,
    LaserPlaneCalibration,
    SystemCalibration,
)
from rotaline.calibration.observations import SessionObservations
from rotaline.calibration.rotation_axis import calibrate_axis
from rotaline.calibration.stripe_on_board import StripeView
from rotaline.geometry.primitives import Line, Plane
from rotaline.io.report.contents import StageWarning
from rotaline.io.session import Session
from rotaline.pipeline.calibrate_article import optimise_plane, refine_axis
from rotaline.pipeline.calibrate_joint import estimate, joint_system, start_joint_estimate
from rotaline.pipeline.observe import SessionSource
from rotaline.pipeline.observer import Observer
from rotaline.pipeline.options import Options
from rotaline.pipeline.stage_runner import StageRunner, StoredStageRunner
from rotaline.pipeline.store import StageStore
from rotaline.vision.camera import CameraModel

ObservationSource = SessionObservations | SessionSource
"""All at once, or part by part as the stages ask for them."""


@dataclass(frozen=True, eq=False)
class CalibrationParts:
    """What the stages found; None where a stage was not asked for or failed (then ``warnings`` says so).

    ``observations`` are those that the stages looked at: empty where a stage did not come to it. ``cross_ratio`` and ``artifact``
    belong to the article's way, ``joint`` to the other.
    """

    observations: SessionObservations
    camera: CameraCalibration | None = None
    laser_plane: LaserPlaneCalibration | None = None
    cross_ratio: CrossRatioResult | None = None
    axis: AxisCalibration | None = None
    artifact: ArtifactCalibration | None = None
    joint: JointCalibration | None = None
    system: SystemCalibration | None = None
    system_initial: SystemCalibration | None = None
    warnings: tuple[StageWarning, ...] = ()

    @property
    def camera_model(self) -> CameraModel | None:
        """The camera to use."""
        if self.joint is not None:
            return self.joint.camera
        return self.camera.camera if self.camera is not None else None

    @property
    def plane_camera(self) -> Plane | None:
        """The laser plane to use: of the joint estimate, or optimised where that was accepted."""
        if self.joint is not None:
            return self.joint.laser_plane_camera
        if self.cross_ratio is not None:
            return self.cross_ratio.plane_camera
        return self.laser_plane.plane_camera if self.laser_plane is not None else None


def calibrate_session(session: Session, options: Options, store: StageStore, observer: Observer) -> CalibrationParts:
    """All stages that a session folder allows, each from the store where it is still valid."""
    runner = StoredStageRunner(store, observer)
    return calibrate_observations(SessionSource(session, options, store, observer, runner), options, runner)


def calibrate_observations(
    source: ObservationSource, options: Options | None = None, runner: StageRunner | None = None
) -> CalibrationParts:
    """All stages that the observations allow.

    Parameters
    ----------
    source : SessionObservations, or what gives its parts one by one
    options : Options
    runner : does the stages; by default each is computed, and nobody is told
    """
    options, runner = options or Options(), runner or StageRunner()
    parts = CalibrationParts(
        SessionObservations(source.image_size, (), source.preferred_folders, (), (), ()),
    )
    parts = _camera(parts, source, options, runner)
    parts = _laser_plane(parts, source, options, runner)
    if options.calibration.method == "article":
        parts = _cross_ratio(parts, options, runner)
        parts = _axis(parts, source, options, runner)
        parts = _artifact(parts, source, options, runner)
    else:
        parts = _axis(parts, source, options, runner)
        parts = _joint(parts, source, options, runner)
    return replace(parts, warnings=tuple(runner.warnings))


def _camera(
    parts: CalibrationParts, source: ObservationSource, options: Options, runner: StageRunner
) -> CalibrationParts:
    if "camera" not in source.roles:
        runner.warn(
            "camera", "the session has no capture with role 'camera', so nothing can be calibrated.", serious=True
        )
        return parts
    views, size, preferred = source.camera_views, source.image_size, source.preferred_folders
    result = runner.attempt(
        "camera",
        "Camera",
        ("camera_views",),
        (options.camera, size, sorted(preferred)),
        lambda: calibrate_camera(views, size, options.camera, preferred),
    )
    if result is not None:
        used = sum(v.used for v in result.views)
        runner.note(f"{result.rms_px:.3f} px RMS over {used} of {len(result.views)} views")
        for text in result.notes:
            runner.note(text)
        _pass_on("camera", result.warnings, runner)
    return replace(parts, observations=replace(parts.observations, camera_views=views), camera=result)


def _laser_plane(
    parts: CalibrationParts, source: ObservationSource, options: Options, runner: StageRunner
) -> CalibrationParts:
    camera = parts.camera
    if camera is None or "laser-plane" not in source.roles:
        return parts
    views = source.plate_views
    result = runner.attempt(
        "laser-plane",
        "Laser plane",
        ("camera", "plate_views"),
        options.laser_plane,
        lambda: calibrate_laser_plane(camera.camera, _as_found(camera, views), options.laser_plane),
    )
    if result is not None:
        used = sum(v.used for v in result.views)
        runner.note(f"{result.rms_mm:.4f} mm RMS over {used} of {len(result.views)} poses")
        _pass_on("laser-plane", result.warnings, runner)
    return replace(parts, observations=replace(parts.observations, plate_views=views), laser_plane=result)


def _cross_ratio(parts: CalibrationParts, options: Options, runner: StageRunner) -> CalibrationParts:
    if parts.camera is None or parts.laser_plane is None:
        return parts
    views = _as_found(parts.camera, parts.observations.plate_views)
    return replace(parts, cross_ratio=optimise_plane(parts.camera.camera, parts.laser_plane, views, options, runner))


def _axis(
    parts: CalibrationParts, source: ObservationSource, options: Options, runner: StageRunner
) -> CalibrationParts:
    camera = parts.camera
    if camera is None or "axis" not in source.roles:
        return parts
    views = source.table_views
    on_table = [replace(view, detection=camera.with_target_as_found(view.detection)) for view in views]
    chosen = options.axis
    if chosen.method is None and not (options.calibration.method == "article" and "artifact" in source.roles):
        chosen = replace(chosen, method="joint")  # no later stage of the article's way refines this axis
    result = runner.attempt(
        "axis",
        "Initial rotation axis",
        ("camera", "table_views"),
        chosen,
        lambda: calibrate_axis(camera.camera, on_table, chosen),
    )
    if result is not None:
        used = sum(f.used for f in result.frames)
        sense = "right-handed" if result.turn_sense > 0 else "left-handed"
        runner.note(f"{used} of {len(result.frames)} frames, circles {result.rms_mm:.4f} mm RMS, turns {sense}")
        _pass_on("axis", result.warnings, runner)
    return replace(parts, observations=replace(parts.observations, table_views=views), axis=result)


def _artifact(
    parts: CalibrationParts, source: ObservationSource, options: Options, runner: StageRunner
) -> CalibrationParts:
    """The end of the article's way: the axis by the stepped cylinder, and the systems."""
    camera, plane, axis = parts.camera, parts.plane_camera, parts.axis
    if camera is None or plane is None:
        return parts
    sense, artifact = axis.turn_sense if axis is not None else 1, None
    if "artifact" in source.roles:
        parts = replace(parts, observations=replace(parts.observations, mounts=source.mounts))
        before = [
            "laser-plane" if parts.cross_ratio is None else "cross-ratio",
            *(["axis"] if axis is not None else []),
        ]
        found = refine_axis(camera.camera, plane, axis, source.mounts, before, options, runner)
        sense, artifact = found if found is not None else (sense, None)

    def system(axis_camera: Line | None) -> SystemCalibration | None:
        if axis_camera is None:
            return None
        return SystemCalibration(camera.camera, plane, axis_camera, sense, table_seen=False)

    before_camera = axis.axis_camera if axis is not None else artifact.axis_before_camera if artifact else None
    final = system(artifact.axis_camera if artifact is not None else before_camera)
    return replace(parts, artifact=artifact, system=final, system_initial=system(before_camera))


def _joint(
    parts: CalibrationParts, source: ObservationSource, options: Options, runner: StageRunner
) -> CalibrationParts:
    """The end of the other way: the joint estimate and its system; where it failed, the system of the stages before."""
    camera = parts.camera
    if camera is None:
        return parts
    if parts.laser_plane is not None and "artifact" in source.roles:
        parts = replace(parts, observations=replace(parts.observations, mounts=source.mounts))
    start, needs = start_joint_estimate(
        camera, parts.laser_plane, parts.axis, parts.observations.mounts, options, runner
    )
    joint = estimate(parts.observations, start, needs, options, runner)
    initial = None
    if start.plane_camera is not None and start.axis_camera is not None:
        initial = SystemCalibration(
            camera.camera, start.plane_camera, start.axis_camera, start.turn_sense, table_seen=False
        )
    system = joint_system(joint) if joint is not None else initial
    return replace(parts, joint=joint, system=system, system_initial=initial)


def _as_found(camera: CameraCalibration, views: Sequence[StripeView]) -> list[StripeView]:
    """The views on their targets as the camera calibration found them."""
    return [replace(view, detection=camera.with_target_as_found(view.detection)) for view in views]


def _pass_on(stage: str, warnings: Sequence[str], runner: StageRunner) -> None:
    for text in warnings:
        runner.warn(stage, text)
