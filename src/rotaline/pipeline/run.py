"""The main job: calibrate, scan, measure, reconstruct, report; and the parts of it as commands of their own."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from rotaline.calibration.model import AngleError, SystemCalibration
from rotaline.calibration.verdict.model import Verdict
from rotaline.errors import SessionError
from rotaline.io.calibration_file import CalibrationFile, write_calibration
from rotaline.io.clouds import write_mesh
from rotaline.io.drift_file import CaptureDrift
from rotaline.io.files import write_json
from rotaline.io.locations import locate
from rotaline.io.records import read_record, write_record
from rotaline.io.report.contents import STAGES, ReportContents, StageWarning, SurfaceSummary
from rotaline.io.results import MeasurementEntry
from rotaline.io.session import Capture, Session
from rotaline.io.session_file import MeasurementRequest
from rotaline.io.verdict_file import VERDICT_FILE, write_verdict
from rotaline.pipeline.calibrate import CalibrationParts, calibrate_session
from rotaline.pipeline.capture_ranges import CaptureRanges, ranges_of
from rotaline.pipeline.drift import find_drift, keep_drift
from rotaline.pipeline.judge import judge_measured, judge_parts
from rotaline.pipeline.measure import measure_captures
from rotaline.pipeline.observer import Observer
from rotaline.pipeline.options import Options
from rotaline.pipeline.parts import (
    measurement_requests,
    place_on_table,
    reference_contradiction,
    system_at_optical_axis,
)
from rotaline.pipeline.quality import quality_figures
from rotaline.pipeline.scan import KEPT_CLOUDS, Clouds, ScannedCapture, scan_capture
from rotaline.pipeline.store import StageStore, check_writable
from rotaline.pipeline.summary import cloud_summary, fitted_points, frame_overlays, report_contents
from rotaline.pipeline.surfaces import stored_surface
from rotaline.pipeline.workers import Workers
from rotaline.scanning.cloud import PointCloud

REPORT_RECORD = "report.npz"


@dataclass(frozen=True, eq=False)
class RunResult:
    """What a run found; ``failures`` lists what was asked for and could not be done."""

    folder: Path
    calibration: CalibrationFile | None
    measurements: tuple[MeasurementEntry, ...]
    measurements_initial_axis: tuple[MeasurementEntry, ...]
    warnings: tuple[StageWarning, ...]

    @property
    def calibration_failed(self) -> bool:
        """A calibration stage failed, so that what needs it is missing."""
        return any(
            w.serious and w.stage in ("camera", "laser-plane", "axis", "artifact", "joint") for w in self.warnings
        )

    @property
    def complete(self) -> bool:
        """Everything that was asked for was done."""
        return not any(w.serious for w in self.warnings) and all(e.measurement is not None for e in self.measurements)


def results_folder(session: str | os.PathLike[str], out: Path | None) -> Path:
    """Where results go: ``<session>-results`` beside the session, in this folder for one at an address, unless told otherwise.

    Raises
    ------
    SessionError
        If that lies inside the session: input folders are never written to.
    """
    location = locate(session)
    path = Path(location.address) if location.is_local else None
    folder = (out or (path.parent if path else Path()) / f"{location.name}-results").resolve()
    if path is not None and (folder == path or path in folder.parents):
        raise SessionError(f"{folder}: results never go into the session ({path}). Choose another place with --out.")
    return folder


class Run:
    """One run over a session; stages whose inputs and options did not change are taken from the results folder."""

    def __init__(
        self,
        session: Session,
        folder: Path,
        options: Options,
        observer: Observer,
        force: bool = False,
        on_ready: Callable[[], None] = lambda: None,
        workers: Workers | None = None,
    ) -> None:
        self._session = session
        self._folder = folder
        self._options = options
        self._observer = observer
        check_writable(folder)
        on_ready()
        self._store = StageStore(folder / "stages", observer, force, workers=workers)
        self._warnings: list[StageWarning] = []
        self._entries: tuple[MeasurementEntry, ...] = ()
        self._initial_entries: tuple[MeasurementEntry, ...] = ()
        self._verdict: Verdict | None = None
        self._drift: tuple[CaptureDrift, ...] = ()
        for problem in session.problems:
            self._warn("session", str(problem), serious=True)

    def __enter__(self) -> "Run":
        """The run; leaving the block closes it."""
        return self

    def __exit__(self, *_: object) -> None:
        """See :meth:`close`."""
        self.close()

    def close(self) -> None:
        """Let go of the processes or the cluster that worked on it."""
        self._store.workers.close()

    def calibrate(self) -> tuple[CalibrationParts, CalibrationFile]:
        """The calibration stages; writes ``calibration.json`` and ``verdict.json``."""
        parts = calibrate_session(self._session, self._options, self._store, self._observer)
        self._warnings += parts.warnings
        system, initial = parts.system, parts.system_initial
        if system is not None:
            system = self._placed(system)
            initial = self._placed(initial) if initial is not None else None
            if not system.table_seen:
                self._warn(
                    "scan",
                    "no capture shows the table top; z = 0 is the point of the axis nearest to the optical axis.",
                )
        joint = parts.joint
        content = CalibrationFile(
            camera=parts.camera_model,
            laser_plane_camera=parts.plane_camera,
            rotation_axis_camera=system.rotation_axis_camera if system else None,
            rotation_axis_initial_camera=initial.rotation_axis_camera if initial else None,
            turn_sense=system.turn_sense if system else 1,
            table_seen=system.table_seen if system else False,
            quality=quality_figures(parts),
            session=self._session.name,
            laser_curvature=joint.laser_curvature if joint else None,
            angle_error=joint.angle_error if joint else AngleError(),
            table_motion=joint.table_motion if joint else None,
            covariance=joint.covariance if joint else None,
            line_sigma_mm=joint.line_sigma_mm if joint else 0.0,
            stripe_blur_px=joint.stripe_blur_px if joint else 0.0,
        )
        write_calibration(self._folder / "calibration.json", content)
        self._keep_verdict(judge_parts(parts))
        return parts, content

    def scan(self, calibration: CalibrationFile, captures: Sequence[str] = ()) -> Clouds:
        """The clouds of the captures (default: all scans and artefacts); writes ``clouds/<capture>.ply``."""
        self._check_size(calibration)
        system = calibration.system()
        chosen = self._scanned() if not captures else self._named(captures)
        scanned: dict[str, ScannedCapture] = {}
        if chosen and system is None:
            missing = ", ".join(
                name
                for name, value in (
                    ("camera", calibration.camera),
                    ("laser plane", calibration.laser_plane_camera),
                    ("rotation axis", calibration.rotation_axis_camera),
                )
                if value is None
            )
            names = ", ".join(c.folder for c in chosen)
            self._warn(
                "scan",
                f"{names}: not scanned, because the calibration lacks: {missing}. See the warnings of that step, "
                "or give a calibration of this rig with --calibration FILE.",
                serious=True,
            )
        elif system is not None:
            scanned = {c.folder: self._scan(c, system) for c in chosen}

        def load(folder: str) -> PointCloud:
            assert system is not None
            return ranges[folder].cloud(system)

        ranges = {c.folder: self._ranges(c) for c in chosen if c.folder in scanned}
        return Clouds(scanned, load, KEPT_CLOUDS * self._options.scan.max_points_in_memory)

    def measure(
        self, clouds: Clouds, calibration: CalibrationFile, requests: Sequence[MeasurementRequest] = ()
    ) -> tuple[tuple[MeasurementEntry, ...], tuple[MeasurementEntry, ...]]:
        """The features asked for, with the final and with the initial axis; writes both lists."""
        system, initial = calibration.system(), calibration.system(initial_axis=True)
        wanted = tuple(requests) or measurement_requests(self._session)
        final_entries, initial_entries = measure_captures(
            wanted, clouds, system, initial, self._options, self._store, self._observer
        )
        for entry in final_entries:
            if entry.measurement is None:
                self._warn("measure", f"{entry.capture}, {entry.feature}: {entry.failure}", serious=True)
            else:
                for text in entry.measurement.warnings:
                    self._warn("measure", f"{entry.capture}, {entry.feature}: {text}")
                if text := reference_contradiction(entry):
                    self._warn("measure", text, serious=True)
        write_json(self._folder / "measurements.json", [e.to_json() for e in final_entries])
        write_json(self._folder / "measurements-initial-axis.json", [e.to_json() for e in initial_entries])
        self._entries, self._initial_entries = final_entries, initial_entries
        if self._verdict is not None:
            self._keep_verdict(judge_measured(self._verdict, final_entries, wanted))
        return final_entries, initial_entries

    def surfaces(self, clouds: Clouds, calibration: CalibrationFile) -> tuple[SurfaceSummary, ...]:
        """A surface of every scan of a part; writes ``meshes/<capture>.ply`` and ``.stl``."""
        if not self._options.scan.surface:
            return ()
        scans = [c.folder for c in self._session.in_role("scan") if c.folder in clouds]
        result = []
        for folder in scans:
            summary = stored_surface(folder, clouds, calibration.table_seen, self._options, self._store)
            if summary.failure:
                self._warn("surface", f"{folder}: {summary.failure}", serious=True)
            else:
                for suffix in (".ply", ".stl"):
                    path = self._folder / "meshes" / f"{folder}{suffix}"
                    write_mesh(path, summary.vertices_table, summary.triangles)
            result.append(summary)
        return tuple(result)

    def everything(self, calibration: CalibrationFile | None = None) -> RunResult:
        """The main job, with a calibration of another session if one is given."""
        parts: CalibrationParts | None = None
        if calibration is None:
            parts, calibration = self.calibrate()
        else:
            write_calibration(self._folder / "calibration.json", calibration)
            self._keep_verdict(None)
        clouds = self.scan(calibration)
        self.drift(calibration)
        entries, initial_entries = self.measure(clouds, calibration)
        surfaces = self.surfaces(clouds, calibration)
        self.report(parts, calibration, clouds, entries, initial_entries, surfaces)
        return self.result(calibration)

    def drift(self, calibration: CalibrationFile) -> None:
        """Whether the rig stood still, where reference frames were taken; writes ``drift.json``."""
        system, options = calibration.system(), self._options.stripe
        self._drift = find_drift(self._session, system, options, self._store, self._observer)
        for text in (text for capture in self._drift for text in capture.warnings):
            self._warn("drift", text)
        keep_drift(self._folder, self._drift)

    def report(
        self,
        parts: CalibrationParts | None,
        calibration: CalibrationFile,
        clouds: Clouds,
        entries: tuple[MeasurementEntry, ...],
        initial_entries: tuple[MeasurementEntry, ...],
        surfaces: tuple[SurfaceSummary, ...],
    ) -> None:
        """Write ``report.html``, and what it was made from."""
        from rotaline.io.report.write import write_report  # with all that draws, which other commands do without

        self._observer.stage("Report", stored=False)
        with self._store.timed("Report"):
            summaries = tuple(cloud_summary(scanned, clouds) for scanned in clouds.scanned.values())
            contents = report_contents(
                self._session,
                self._options,
                tuple(self._warnings),
                self._store.seconds,
                parts,
                calibration.system(),
                summaries,
                surfaces,
                entries,
                initial_entries,
                fitted_points(entries, clouds),
                frame_overlays(self._session, self._store, self._options, self._observer),
                self._verdict if self._options.calibration.method == "joint" else None,
                self._drift,
            )
            write_record(self._folder / "stages" / REPORT_RECORD, contents, compressed=True)
            write_report(contents, self._folder / "report.html")

    @property
    def folder(self) -> Path:
        """Where results go."""
        return self._folder

    def result(self, calibration: CalibrationFile | None = None) -> RunResult:
        """What was found so far."""
        return RunResult(self._folder, calibration, self._entries, self._initial_entries, tuple(self._warnings))

    @property
    def verdict(self) -> Verdict | None:
        """Whether the calibration is good; None if it came from elsewhere."""
        return self._verdict

    def _keep_verdict(self, verdict: Verdict | None) -> None:
        """Write the verdict; one of an earlier calibration must not stay."""
        self._verdict = verdict
        path = self._folder / VERDICT_FILE
        if verdict is not None:
            write_verdict(path, verdict)
        else:
            path.unlink(missing_ok=True)

    def _warn(self, stage: str, text: str, serious: bool = False) -> None:
        self._warnings.append(StageWarning(stage, text, serious))
        self._observer.warning(f"{STAGES[stage]}: {text}")

    def _scanned(self) -> tuple[Capture, ...]:
        chosen: dict[str, Capture] = {}
        for capture in (*self._session.in_role("artifact"), *self._session.in_role("scan")):
            chosen.setdefault(capture.folder, capture)
        return tuple(c for c in chosen.values() if c.on_frames)

    def _named(self, names: Sequence[str]) -> tuple[Capture, ...]:
        known = {c.folder: c for c in self._session.captures if c.role in ("artifact", "scan")}
        for name in names:
            if name not in known:
                raise SessionError(f"there is no scan capture '{name}'; there is {', '.join(known) or 'none'}.")
        return tuple(known[name] for name in names)

    def _check_size(self, calibration: CalibrationFile) -> None:
        camera, size = calibration.camera, self._session.image_size
        if camera is not None and tuple(camera.image_size) != tuple(size):
            raise SessionError(
                f"the calibration is for images of {camera.image_size[0]} x {camera.image_size[1]} pixels, the session has "
                f"{size[0]} x {size[1]}. Calibrate with images of the same camera and resolution."
            )

    def _ranges(self, capture: Capture) -> CaptureRanges:
        return ranges_of(capture, self._options, self._store, self._observer)

    def _scan(self, capture: Capture, system: SystemCalibration) -> ScannedCapture:
        path = self._folder / "clouds" / f"{capture.folder}.ply"
        scanned = scan_capture(capture.folder, self._ranges(capture), system, path)
        n_empty = len(scanned.frames_without_stripe)
        if scanned.n_points == 0:
            self._warn(
                "scan",
                f"{capture.folder}: no stripe in any of its {n_empty} frames: no points. Check that the laser is on, "
                "bright enough and in view.",
                serious=True,
            )
        elif n_empty:
            self._warn(
                "scan",
                f"{capture.folder}: no stripe in {n_empty} of {scanned.n_frames} frames, the first is {scanned.frames_without_stripe[0]}. "
                "They add no points. If the part should be seen there, check laser and exposure, and take them again.",
            )
        if scanned.thinning > 1:
            self._warn(
                "scan",
                f"{capture.folder}: its {scanned.n_points} points are more than the {self._options.scan.max_points_in_memory} of "
                f"scan.max_points_in_memory: features, surface and pictures are made from one in {scanned.thinning} along the "
                "stripes; the cloud file holds all.",
            )
        return scanned

    def _placed(self, system: SystemCalibration) -> SystemCalibration:
        """The system with z = 0 on the table, as the artefacts' captures show it, else the scans."""
        system = system_at_optical_axis(system)
        exact = replace(system, covariance=None)
        for artifacts in (True, False):
            captures = [c for c in self._scanned() if (c.role == "artifact") == artifacts]
            system = place_on_table(system, (self._ranges(c).cloud(exact) for c in captures))
            if system.table_seen:
                break
        return system


def rewrite_report(folder: Path) -> Path:
    """Write the report again from the stored results of a run.

    Raises
    ------
    SessionError
        If the folder holds no results of a run.
    OutputError
        If the report cannot be written.
    """
    from rotaline.io.report.write import write_report

    record = folder / "stages" / REPORT_RECORD
    if not record.is_file():
        raise SessionError(
            f"{folder}: there are no results of a run here. Expected the folder that `rotaline run` wrote."
        )
    contents = read_record(record)
    if not isinstance(contents, ReportContents):
        raise SessionError(f"{record}: this is not what a report is made from. Start `rotaline run` again.")
    write_report(contents, folder / "report.html")
    return folder / "report.html"
