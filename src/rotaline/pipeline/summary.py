"""What a run hands to the report: summaries, thinned clouds, frames with what was found in them."""

import dataclasses
import platform
from collections.abc import Mapping, Sequence
from datetime import datetime
from importlib.metadata import version

import numpy as np

from rotaline import __version__
from rotaline.calibration.model import SystemCalibration
from rotaline.calibration.speckle_limit import speckle_limit_at_axis
from rotaline.calibration.verdict.model import Verdict
from rotaline.geometry.primitives import Artifact, KnownCylinder, KnownSphere, SteppedCylinder
from rotaline.io.drift_file import CaptureDrift
from rotaline.io.frame_images import read_source
from rotaline.io.report.contents import (
    CaptureSummary,
    CloudSummary,
    FittedPoints,
    FrameOverlay,
    ReportContents,
    RunInfo,
    StageWarning,
    SurfaceSummary,
)
from rotaline.io.results import MeasurementEntry
from rotaline.io.session import Capture, Frame, Session
from rotaline.pipeline.calibrate import CalibrationParts
from rotaline.pipeline.capture_ranges import ranges_of
from rotaline.pipeline.observer import Observer
from rotaline.pipeline.options import Options
from rotaline.pipeline.scan import ScannedCapture
from rotaline.pipeline.store import StageStore
from rotaline.scanning.cloud import PointCloud
from rotaline.vision.images import small_picture
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid, Target

MAX_DRAWN = 100_000
"""Points of a cloud that a picture needs at the most."""
PICTURE_WIDTH = 640


def thinned(cloud: PointCloud) -> PointCloud:
    """Every n-th point, so that no more than ``MAX_DRAWN`` remain."""
    step = -(-len(cloud) // MAX_DRAWN)
    return cloud if step <= 1 else cloud.select(np.arange(len(cloud)) % step == 0)


def cloud_summary(scanned: ScannedCapture, clouds: Mapping[str, PointCloud]) -> CloudSummary:
    """A scan with the points that are drawn of it."""
    drawn = thinned(clouds[scanned.folder])
    return CloudSummary(scanned.folder, drawn, scanned.n_points, scanned.n_frames, scanned.n_frames_without_points)


def fitted_points(entries: Sequence[MeasurementEntry], clouds: Mapping[str, PointCloud]) -> tuple[FittedPoints, ...]:
    """The points of each measured feature with their residuals, thinned."""
    result = []
    for entry in entries:
        m = entry.measurement
        if m is None or entry.capture not in clouds:
            continue
        step = max(1, -(-len(m.indices) // MAX_DRAWN))
        points = clouds[entry.capture].points_table[m.indices[::step]]
        result.append(FittedPoints(entry.capture, entry.feature, entry.name, points, m.residuals[::step]))
    return tuple(result)


def _without_points(entry: MeasurementEntry) -> MeasurementEntry:
    """The entry without what it holds of every point: the report draws :func:`fitted_points`."""
    m = entry.measurement
    if m is None:
        return entry
    none = np.zeros(0)
    bare = dataclasses.replace(m, indices=none.astype(int), residuals=none, responses={}, normals=np.zeros((0, 3)))
    return dataclasses.replace(entry, measurement=bare)


def frame_overlays(
    session: Session, store: StageStore, options: Options, observer: Observer
) -> tuple[FrameOverlay, ...]:
    """Example frames of each capture with the points that were found in them."""
    overlays = []
    for capture in session.captures:
        if capture.role in ("camera", "axis"):
            overlays += _target_overlays(capture, store)
        else:
            overlays += _stripe_overlays(capture, options, store, observer)
    return tuple(overlays)


def _target_overlays(capture: Capture, store: StageStore) -> list[FrameOverlay]:
    detected = [d for d in store.latest(f"detect-{capture.folder}-{capture.target_name}-off") or () if d.detection]
    if capture.role == "axis":
        detected = sorted(detected, key=lambda d: d.angle_rad)
        chosen = [detected[i] for i in sorted({0, len(detected) // 2, len(detected) - 1}) if detected]
    else:
        chosen = detected[:2]
    paths = {f.name: f for f in capture.frames}
    what = "target with the detected points"
    return [_overlay(capture.role, paths[d.name], what, d.detection.uv) for d in chosen if d.name in paths]


def _stripe_overlays(capture: Capture, options: Options, store: StageStore, observer: Observer) -> list[FrameOverlay]:
    ranges = ranges_of(capture, options, store, observer)
    filled = np.flatnonzero(ranges.points_per_frame()).tolist()
    if not filled:
        return []
    n = len(filled)
    chosen = sorted({filled[0], filled[n // 3], filled[2 * n // 3]})[: 3 if capture.role != "laser-plane" else 2]
    frames = capture.on_frames
    return [_overlay(capture.role, frames[i], "stripe with its extracted centres", ranges.stripe(i).uv) for i in chosen]


_STAGE_OF_ROLE = {
    "camera": "camera",
    "axis": "axis",
    "laser-plane": "laser-plane",
    "artifact": "artifact",
    "scan": "scan",
}


def _overlay(role: str, frame: Frame, what: str, uv: np.ndarray) -> FrameOverlay:
    image, scale = small_picture(read_source(frame.source), PICTURE_WIDTH)
    angle = "" if frame.angle_rad is None else f" at {np.degrees(frame.angle_rad):.2f} deg"
    return FrameOverlay(_STAGE_OF_ROLE[role], frame.name, f"{frame.name}{angle}: {what}", image, scale, uv)


def report_contents(
    session: Session,
    options: Options,
    warnings: tuple[StageWarning, ...],
    seconds: dict[str, float],
    parts: CalibrationParts | None,
    system: SystemCalibration | None,
    clouds: tuple[CloudSummary, ...],
    surfaces: tuple[SurfaceSummary, ...],
    entries: tuple[MeasurementEntry, ...],
    initial_entries: tuple[MeasurementEntry, ...],
    fitted: tuple[FittedPoints, ...],
    overlays: tuple[FrameOverlay, ...],
    verdict: Verdict | None,
    drift: tuple[CaptureDrift, ...] = (),
) -> ReportContents:
    """Everything that the report shows."""
    return ReportContents(
        run=RunInfo(
            session=session.name,
            finished_at=datetime.now().astimezone().isoformat(timespec="seconds"),
            versions=versions(),
            machine=machine(),
            options={
                f"{stage.name}.{f.name}": str(getattr(getattr(options, stage.name), f.name))
                for stage in dataclasses.fields(options)
                for f in dataclasses.fields(getattr(options, stage.name))
            },
            stage_seconds=dict(seconds),
        ),
        captures=tuple(
            CaptureSummary(c.folder, c.role, c.target_name, len(c.frames), len(c.on_frames), session.image_size)
            for c in session.captures
        ),
        targets={name: _describe(target) for name, target in session.targets.items()},
        warnings=warnings,
        camera=parts.camera if parts else None,
        laser_plane=parts.laser_plane if parts else None,
        cross_ratio=parts.cross_ratio if parts else None,
        axis=parts.axis if parts else None,
        artifact=parts.artifact if parts else None,
        calibration=system,
        clouds=clouds,
        surfaces=surfaces,
        measurements=tuple(_without_points(e) for e in entries),
        measurements_initial_axis=tuple(_without_points(e) for e in initial_entries),
        overlays=overlays,
        fitted_points=fitted,
        artifacts={c.folder: c.target for c in session.captures if isinstance(c.target, SteppedCylinder)},
        joint=parts.joint if parts else None,
        verdict=verdict,
        speckle_limit=speckle_limit_at_axis(session.optics, system) if session.optics and system else None,
        drift=drift,
    )


def _describe(target: Target | Artifact) -> str:
    match target:
        case Checkerboard((columns, rows), pitch):
            return f"checkerboard, {columns} x {rows} inner corners, pitch {pitch:g} mm"
        case DotGrid((columns, rows), pitch, diameter):
            size = "not stated" if diameter is None else f"{diameter:g} mm"
            return f"dot plate, {columns} x {rows} dots, pitch {pitch:g} mm, dot diameter {size}"
        case CharucoBoard((columns, rows), pitch, marker, dictionary):
            return (
                f"ChArUco board, {columns} x {rows} squares, pitch {pitch:g} mm, markers {marker:g} mm of {dictionary}"
            )
        case SteppedCylinder(d1, d2, h1, h2, tolerance):
            sizes = f"diameters {d1:g} / {d2:g} mm, heights {h1:g} / {h2:g} mm"
            return f"stepped cylinder, {sizes}{_within(tolerance)}"
        case KnownCylinder(diameter, height, tolerance):
            size = "" if height is None else f", height {height:g} mm"
            return f"cylinder, diameter {diameter:g} mm{size}{_within(tolerance)}"
        case KnownSphere(diameter, tolerance):
            return f"sphere, diameter {diameter:g} mm{_within(tolerance)}"


def _within(tolerance: float) -> str:
    return f", each within {tolerance:g} mm" if tolerance else ""


def versions() -> dict[str, str]:
    """Versions of the program and of the libraries that its numbers depend on."""
    names = ("numpy", "scipy", "opencv-python-headless", "open3d-cpu")
    return {"rotaline": __version__, "python": platform.python_version()} | {name: version(name) for name in names}


def machine() -> str:
    """The machine in one line."""
    import os

    return f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
