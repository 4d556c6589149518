"""Calibration of a session, stage by stage; a stage that fails is a warning, and what does not need it goes on."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from rotaline.calibration.artifact import SENSE_ASSUMED, ArtifactCapture, find_axis_from_artifact, optimise_axis
from rotaline.calibration.cross_ratio import optimise_plane_cross_ratio
from rotaline.calibration.feature_points import extract_mount_features
from rotaline.calibration.intrinsics import calibrate_camera
from rotaline.calibration.laser_plane import StripeView, calibrate_laser_plane
from rotaline.calibration.model import (
    ArtifactCalibration,
    AxisCalibration,
    CameraCalibration,
    CrossRatioResult,
    LaserPlaneCalibration,
    SystemCalibration,
    TargetView,
)
from rotaline.calibration.rotation_axis import calibrate_axis
from rotaline.errors import CalibrationError, DetectionError, GeometryError
from rotaline.geometry.primitives import Line, Plane, SteppedCylinder
from rotaline.io.report.contents import STAGES, StageWarning
from rotaline.io.session import Capture, Session
from rotaline.pipeline.frames import CaptureStripes, DetectedFrame, detect_frames, extract_capture
from rotaline.pipeline.observer import Observer
from rotaline.pipeline.options import Options
from rotaline.pipeline.store import StageStore, files_key, key_of
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import DotGrid
from rotaline.vision.targets.ordering import order_sequence

T = TypeVar("T")

MIN_DISAGREEMENT_MM = 0.3


@dataclass(frozen=True, eq=False)
class CalibrationParts:
    """What the stages found; None where a stage was not asked for or failed (then ``warnings`` says so)."""

    camera: CameraCalibration | None
    laser_plane: LaserPlaneCalibration | None
    cross_ratio: CrossRatioResult | None
    axis: AxisCalibration | None
    artifact: ArtifactCalibration | None
    system: SystemCalibration | None
    system_initial: SystemCalibration | None
    key: str
    warnings: tuple[StageWarning, ...]

    @property
    def plane_camera(self) -> Plane | None:
        """The laser plane to use: optimised where that was accepted."""
        if self.cross_ratio is not None:
            return self.cross_ratio.plane_camera
        return self.laser_plane.plane_camera if self.laser_plane is not None else None


class Calibrator:
    """Runs the calibration stages of one session, each from the store where it is still valid."""

    def __init__(self, session: Session, options: Options, store: StageStore, observer: Observer) -> None:
        self._session = session
        self._options = options
        self._store = store
        self._observer = observer
        self._warnings: list[StageWarning] = []

    def run(self) -> CalibrationParts:
        """All stages that the session allows."""
        camera, camera_key = self._camera()
        model = camera.camera if camera is not None else None
        laser_plane, cross_ratio, plane_key = self._laser_plane(camera, camera_key)
        plane = cross_ratio.plane_camera if cross_ratio else laser_plane.plane_camera if laser_plane else None
        axis, axis_key = self._axis(camera, camera_key)
        sense, artifact, artifact_key = self._artifact(model, plane, axis, key_of(plane_key, axis_key))
        system, initial = _systems(model, plane, axis, artifact, sense)
        return CalibrationParts(
            camera,
            laser_plane,
            cross_ratio,
            axis,
            artifact,
            system,
            initial,
            key_of(plane_key, axis_key, artifact_key),
            tuple(self._warnings),
        )

    def _attempt(self, stage: str, compute: Callable[[], T]) -> T | None:
        try:
            return compute()
        except (CalibrationError, DetectionError, GeometryError) as error:
            self._warn(stage, str(error), serious=True)
            return None

    def _warn(self, stage: str, text: str, serious: bool = False) -> None:
        self._warnings.append(StageWarning(stage, text, serious))
        self._observer.warning(f"{STAGES[stage]}: {text}")

    def _detections(self, capture: Capture, stage: str) -> tuple[tuple[DetectedFrame, ...], str]:
        """The target in the frames of a capture that give its pose: the laser-off ones, and lone laser-on ones."""
        target = capture.target
        assert target is not None
        assert not isinstance(target, SteppedCylinder)
        frames = capture.off_frames
        if capture.role == "laser-plane":
            posed = {f.pose for f in frames}
            frames = frames + tuple(f for f in capture.on_frames if f.pose is None or f.pose not in posed)
        key = key_of(files_key(f.path for f in frames), target, self._options.targets)
        kind = "off" if len(frames) == len(capture.off_frames) else "all"
        detected = self._store.get(
            f"detect-{capture.folder}-{capture.target_name}-{kind}",
            f"Targets in {capture.folder}",
            key,
            lambda: detect_frames(frames, target, self._options.targets, self._observer, capture.folder),
        )
        lost = [d for d in detected if d.detection is None]
        if lost:
            reasons = "; ".join(f"{d.name}: {d.failure}" for d in lost[:3])
            more = f"; and {len(lost) - 3} more" if len(lost) > 3 else ""
            self._warn(
                stage, f"no target in {len(lost)} of {len(detected)} frames of {capture.folder}: {reasons}{more}"
            )
        return detected, key

    def _camera(self) -> tuple[CameraCalibration | None, str]:
        captures = self._session.in_role("camera")
        if not captures:
            self._warn(
                "camera", "the session has no capture with role 'camera', so nothing can be calibrated.", serious=True
            )
            return None, "none"
        views: list[TargetView] = []
        keys = []
        seen: set[str] = set()
        for capture in captures:
            detected, key = self._detections(capture, "camera")
            keys.append(key)
            views += [
                TargetView(d.name, d.detection) for d in detected if d.detection is not None and d.name not in seen
            ]
            seen |= {d.name for d in detected}
        preferred = frozenset(c.folder for c in self._session.in_role("laser-plane"))  # what sees the stripes
        key = key_of(keys, self._options.camera, self._session.image_size, sorted(preferred))

        def compute() -> CameraCalibration:
            return calibrate_camera(views, self._session.image_size, self._options.camera, preferred)

        result = self._attempt("camera", lambda: self._store.get("camera", "Camera", key, compute))
        if result is not None:
            used = sum(v.used for v in result.views)
            self._observer.note(f"{result.rms_px:.3f} px RMS over {used} of {len(result.views)} views")
            for text in result.warnings:
                self._warn("camera", text)
        return result, key

    def _laser_plane(
        self, calibration: CameraCalibration | None, camera_key: str
    ) -> tuple[LaserPlaneCalibration | None, CrossRatioResult | None, str]:
        captures = self._session.in_role("laser-plane")
        if not captures or calibration is None:
            return None, None, camera_key
        camera = calibration.camera
        views: list[StripeView] = []
        keys = [camera_key]
        for capture in captures:
            detected, key = self._detections(capture, "laser-plane")
            stripes, stripe_key = self.stripes(capture)
            keys += [key, stripe_key]
            views += [
                replace(view, detection=calibration.with_target_as_found(view.detection))
                for view in self._stripe_views(capture, detected, stripes)
            ]
        key = key_of(keys, self._options.laser_plane)

        def compute() -> LaserPlaneCalibration:
            return calibrate_laser_plane(camera, views, self._options.laser_plane)

        plane = self._attempt("laser-plane", lambda: self._store.get("laser-plane", "Laser plane", key, compute))
        if plane is None:
            return None, None, key
        self._observer.note(
            f"{plane.rms_mm:.4f} mm RMS over {sum(v.used for v in plane.views)} of {len(plane.views)} poses"
        )
        for text in plane.warnings:
            self._warn("laser-plane", text)
        cross_ratio, key = self._cross_ratio(camera, plane, views, key)
        return plane, cross_ratio, key

    def _stripe_views(
        self, capture: Capture, detected: tuple[DetectedFrame, ...], stripes: CaptureStripes
    ) -> list[StripeView]:
        by_pose = {d.pose: d for d in detected if d.pose is not None}
        by_name = {d.name: d for d in detected}
        views = []
        for name, pose, stripe in zip(stripes.frame_names, stripes.poses, stripes.stripes(), strict=True):
            match = by_name.get(name) or by_pose.get(pose or "")
            if match is None or match.detection is None:
                continue
            if len(stripe) == 0:
                self._warn("laser-plane", f"no stripe in {name}.")
                continue
            views.append(StripeView(name, match.detection, stripe))
        return views

    def _cross_ratio(
        self, camera: CameraModel, plane: LaserPlaneCalibration, views: list[StripeView], plane_key: str
    ) -> tuple[CrossRatioResult | None, str]:
        dots = [v for v in views if isinstance(v.detection.target, DotGrid)]
        if not dots:
            return None, plane_key
        key = key_of(plane_key, self._options.cross_ratio)

        def compute() -> CrossRatioResult:
            return optimise_plane_cross_ratio(camera, plane, dots, self._options.cross_ratio)

        title = "Laser plane optimisation (cross-ratio)"
        result = self._attempt("cross-ratio", lambda: self._store.get("cross-ratio", title, key, compute))
        if result is not None:
            verdict = "accepted" if result.accepted else f"not used: {result.reason}"
            self._observer.note(
                f"interval RMSE {result.rmse_before_mm:.4f} -> {result.rmse_after_mm:.4f} mm, {verdict}"
            )
            for text in result.warnings:
                self._warn("cross-ratio", text)
        return result, key

    def _axis(self, calibration: CameraCalibration | None, camera_key: str) -> tuple[AxisCalibration | None, str]:
        captures = self._session.in_role("axis")
        if not captures or calibration is None:
            return None, camera_key
        camera = calibration.camera
        if len(captures) > 1:
            self._warn("axis", f"only the first axis capture ({captures[0].folder}) is used of {len(captures)}.")
        detected, key = self._detections(captures[0], "axis")
        angles = [float(d.angle_rad) for d in detected if d.angle_rad is not None]
        ordered = order_sequence([d.detection for d in detected], angles)
        views = [
            TargetView(d.name, calibration.with_target_as_found(detection), d.angle_rad)
            for d, detection in zip(detected, ordered, strict=True)
            if detection is not None
        ]
        options = self._options.axis
        if options.method is None and not self._session.in_role("artifact"):
            options = replace(options, method="joint")  # nothing refines this axis later
        key = key_of(camera_key, key, options)

        def compute() -> AxisCalibration:
            return calibrate_axis(camera, views, options)

        result = self._attempt("axis", lambda: self._store.get("axis", "Initial rotation axis", key, compute))
        if result is not None:
            used = sum(f.used for f in result.frames)
            sense = "right-handed" if result.turn_sense > 0 else "left-handed"
            self._observer.note(
                f"{used} of {len(result.frames)} frames, circles {result.rms_mm:.4f} mm RMS, turns {sense}"
            )
            for text in result.warnings:
                self._warn("axis", text)
        return result, key

    def _artifact(
        self, camera: CameraModel | None, plane: Plane | None, axis: AxisCalibration | None, before_key: str
    ) -> tuple[int, ArtifactCalibration | None, str]:
        captures = self._session.in_role("artifact")
        sense = axis.turn_sense if axis is not None else 1
        if not captures or camera is None or plane is None:
            return sense, None, before_key
        start = (axis.axis_camera, axis.turn_sense) if axis is not None else None
        keys = [before_key]
        mounts: list[ArtifactCapture] = []
        artifacts = [c.target for c in captures if isinstance(c.target, SteppedCylinder)]
        for capture in captures:
            if capture.target != artifacts[0]:
                self._warn("artifact", f"{capture.folder}: another artefact than in {captures[0].folder}; left out.")
                continue
            stripes, stripe_key = self.stripes(capture)
            key = key_of(before_key, stripe_key, artifacts[0], self._options.artifact)
            keys.append(key)
            mounts.append(
                self._store.get(
                    f"features-{capture.folder}",
                    f"Feature points in {capture.folder}",
                    key,
                    partial(_feature_points, stripes, capture.folder, camera, plane, artifacts[0], start),
                )
            )
        key = key_of(keys)

        def compute() -> tuple[int, ArtifactCalibration]:
            axis_start, sense = start or find_axis_from_artifact(mounts, artifacts[0], self._options.artifact)
            return sense, optimise_axis(axis_start, sense, mounts, artifacts[0], self._options.artifact)

        title = "Axis optimisation (stepped cylinder)"
        found = self._attempt("artifact", lambda: self._store.get("artifact", title, key, compute))
        result = None
        if found is not None:
            if start is None:
                self._warn("artifact", SENSE_ASSUMED)
            sense, result = found
            for mount in result.mounts:
                used = sum(mount.frame_used)
                self._observer.note(
                    f"{mount.name}: {used} of {len(mount.frame_used)} frames, mean distance "
                    f"{mount.mean_distance_before_mm:.4f} -> {mount.mean_distance_mm:.4f} mm"
                )
            for text in result.warnings:
                self._warn("artifact", text)
            if axis is not None:
                u_mm = float(np.hypot(axis.u_position_mm, result.u_position_mm))
                if text := axis_disagreement(axis.axis_camera, result.axis_camera, u_mm):
                    self._warn("artifact", text)
        return sense, result, key

    def stripes(self, capture: Capture) -> tuple[CaptureStripes, str]:
        """The stripes of a capture and their key."""
        return stored_stripes(capture, self._options, self._store, self._observer)


def stored_stripes(
    capture: Capture, options: Options, store: StageStore, observer: Observer
) -> tuple[CaptureStripes, str]:
    """The stripes of a capture, from the store or extracted, and their key."""
    key = key_of(files_key(f.path for f in capture.frames), options.stripe, [f.angle_rad for f in capture.frames])
    stripes = store.get(
        f"stripes-{capture.folder}",
        f"Stripes in {capture.folder}",
        key,
        lambda: extract_capture(capture, options.stripe, observer, capture.folder),
    )
    return stripes, key


def _feature_points(
    stripes: CaptureStripes,
    name: str,
    camera: CameraModel,
    plane_camera: Plane,
    artifact: SteppedCylinder,
    start: tuple[Line, int] | None,
) -> ArtifactCapture:
    axis_camera = start[0] if start is not None else None
    found = extract_mount_features(stripes.stripes(), camera, plane_camera, artifact, axis_camera)
    return ArtifactCapture(
        name=name,
        frame_names=stripes.frame_names,
        angles_rad=stripes.angles_rad,
        features_camera=np.array([f.points_camera for f in found]).reshape(-1, 4, 3),
        reasons=tuple(f.reason for f in found),
    )


def axis_disagreement(initial_camera: Line, final_camera: Line, u_mm: float) -> str:
    """What to say where the artefact moved the axis by far more than both can be off (``u_mm``); empty where it did not."""
    moved_mm = float(initial_camera.distance_to(final_camera.point[None])[0])
    if moved_mm < max(MIN_DISAGREEMENT_MM, 10.0 * u_mm):
        return ""
    return (
        f"the artefact puts the axis {moved_mm:.2f} mm from the initial one, but both are known to {u_mm:.2f} mm (k = 1): one of the "
        "two is wrong. Check the pitch of the target on the table, the sizes of the artefact, and that nothing moved between the captures."
    )


def _systems(
    camera: CameraModel | None,
    plane_camera: Plane | None,
    axis: AxisCalibration | None,
    artifact: ArtifactCalibration | None,
    sense: int,
) -> tuple[SystemCalibration | None, SystemCalibration | None]:
    """The system with the final axis, and with the initial one; z = 0 is not on the table yet."""

    def system(axis_camera: Line | None) -> SystemCalibration | None:
        if camera is None or plane_camera is None or axis_camera is None:
            return None
        return SystemCalibration(camera, plane_camera, axis_camera, sense, table_seen=False)

    before = axis.axis_camera if axis is not None else artifact.axis_before_camera if artifact is not None else None
    return system(artifact.axis_camera if artifact is not None else before), system(before)
