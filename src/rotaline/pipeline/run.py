"""The main job: calibrate, scan, measure, reconstruct, report; and the parts of it as commands of their own."""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from rotaline.calibration.model import AngleError, SystemCalibration
from rotaline.calibration.verdict.model import Verdict
from rotaline.errors import GeometryError, SessionError
from rotaline.io.calibration_file import CalibrationFile, write_calibration
from rotaline.io.clouds import write_cloud, write_mesh
from rotaline.io.files import write_json
from rotaline.io.records import read_record, write_record
from rotaline.io.report.contents import STAGES, CloudSummary, ReportContents, StageWarning, SurfaceSummary
from rotaline.io.report.write import write_report
from rotaline.io.results import MeasurementEntry
from rotaline.io.session import Capture, Session
from rotaline.io.session_file import MeasurementRequest
from rotaline.io.verdict_file import VERDICT_FILE, write_verdict
from rotaline.pipeline.calibrate import CalibrationParts, calibrate_session
from rotaline.pipeline.judge import judge_measured, judge_parts
from rotaline.pipeline.observe import stored_stripes
from rotaline.pipeline.observer import Observer
from rotaline.pipeline.options import Options
from rotaline.pipeline.parts import (
    make_cloud,
    measure_request,
    measurement_requests,
    place_on_table,
    reference_contradiction,
    system_at_optical_axis,
)
from rotaline.pipeline.quality import quality_figures
from rotaline.pipeline.store import StageStore, check_writable, key_of
from rotaline.pipeline.summary import fitted_points, frame_overlays, report_contents, thinned
from rotaline.scanning.cloud import PointCloud
from rotaline.scanning.surface import reconstruct_surface
from rotaline.scanning.triangulation import move_to_axis

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


def results_folder(session: Path, out: Path | None) -> Path:
    """Where results go: ``<session>-results`` beside the session, unless told otherwise.

    Raises
    ------
    SessionError
        If that lies inside the session: input folders are never written to.
    """
    path = session.resolve()
    folder = (out or path.with_name(path.name + "-results")).resolve()
    if folder == path or path in folder.parents:
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
    ) -> None:
        self._session = session
        self._folder = folder
        self._options = options
        self._observer = observer
        check_writable(folder)
        on_ready()
        self._store = StageStore(folder / "stages", observer, force)
        self._warnings: list[StageWarning] = []
        self._entries: tuple[MeasurementEntry, ...] = ()
        self._initial_entries: tuple[MeasurementEntry, ...] = ()
        self._verdict: Verdict | None = None
        for problem in session.problems:
            self._warn("session", str(problem), serious=True)

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
            session=self._session.path.resolve().name,
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

    def scan(self, calibration: CalibrationFile, captures: Sequence[str] = ()) -> dict[str, PointCloud]:
        """The clouds of the captures (default: all scans and artefacts); writes ``clouds/<capture>.ply``."""
        self._check_size(calibration)
        system = calibration.system()
        chosen = self._scanned() if not captures else self._named(captures)
        if not chosen:
            return {}
        if system is None:
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
            return {}
        clouds = {}
        for capture in chosen:
            clouds[capture.folder] = self._cloud(capture, system)
            write_cloud(self._folder / "clouds" / f"{capture.folder}.ply", clouds[capture.folder])
        return clouds

    def measure(
        self, clouds: dict[str, PointCloud], calibration: CalibrationFile, requests: Sequence[MeasurementRequest] = ()
    ) -> tuple[tuple[MeasurementEntry, ...], tuple[MeasurementEntry, ...]]:
        """The features asked for, with the final and with the initial axis; writes both lists."""
        system, initial = calibration.system(), calibration.system(initial_axis=True)
        wanted = tuple(requests) or measurement_requests(self._session)
        final_entries = self._measure_all(wanted, clouds, system, "measure", "Measurement")
        initial_entries: tuple[MeasurementEntry, ...] = ()
        if system is not None and initial is not None and _differ(system, initial):
            moved = {name: move_to_axis(cloud, system, initial) for name, cloud in clouds.items()}
            title = "Measurement with the initial axis"
            initial_entries = self._measure_all(wanted, moved, initial, "measure-initial-axis", title)
        elif initial is not None:
            initial_entries = final_entries
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

    def surfaces(self, clouds: dict[str, PointCloud], calibration: CalibrationFile) -> tuple[SurfaceSummary, ...]:
        """A surface of every scan of a part; writes ``meshes/<capture>.ply`` and ``.stl``."""
        if not self._options.scan.surface:
            return ()
        scans = [c.folder for c in self._session.in_role("scan") if c.folder in clouds]
        result = []
        for folder in scans:
            cloud = clouds[folder]
            if calibration.table_seen and not self._options.scan.keep_table:
                cloud = cloud.select(cloud.points_table[:, 2] > self._options.scan.table_margin_mm)
            key = key_of(_cloud_key(clouds[folder]), self._options.surface, self._options.scan, calibration.table_seen)
            summary = self._store.get(
                f"surface-{folder}", f"Surface of {folder}", key, partial(self._surface, folder, cloud)
            )
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
        entries, initial_entries = self.measure(clouds, calibration)
        surfaces = self.surfaces(clouds, calibration)
        self.report(parts, calibration, clouds, entries, initial_entries, surfaces)
        return self.result(calibration)

    def report(
        self,
        parts: CalibrationParts | None,
        calibration: CalibrationFile,
        clouds: dict[str, PointCloud],
        entries: tuple[MeasurementEntry, ...],
        initial_entries: tuple[MeasurementEntry, ...],
        surfaces: tuple[SurfaceSummary, ...],
    ) -> None:
        """Write ``report.html``, and what it was made from."""
        self._observer.stage("Report", stored=False)
        summaries = tuple(self._cloud_summary(name, cloud) for name, cloud in clouds.items())
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

    def _cloud(self, capture: Capture, system: SystemCalibration) -> PointCloud:
        stripes, _ = stored_stripes(capture, self._options, self._store, self._observer)
        cloud = make_cloud(stripes, system, self._options.scan)
        empty = len(stripes.frame_names) - len(np.unique(stripes.frame))
        if len(cloud) == 0:
            self._warn(
                "scan",
                f"{capture.folder}: no stripe in any of its {empty} frames: no points. Check that the laser is on, "
                "bright enough and in view.",
                serious=True,
            )
        elif empty:
            names = [n for i, n in enumerate(stripes.frame_names) if not np.any(stripes.frame == i)]
            self._warn(
                "scan",
                f"{capture.folder}: no stripe in {empty} of {len(stripes.frame_names)} frames, the first is {names[0]}. "
                "They add no points. If the part should be seen there, check laser and exposure, and take them again.",
            )
        return cloud

    def _placed(self, system: SystemCalibration) -> SystemCalibration:
        """The system with z = 0 on the table, as the artefacts' captures show it, else the scans."""
        system = system_at_optical_axis(system)
        exact = replace(system, covariance=None)
        for artifacts in (True, False):
            captures = [c for c in self._scanned() if (c.role == "artifact") == artifacts]
            stripes = [stored_stripes(c, self._options, self._store, self._observer)[0] for c in captures]
            system = place_on_table(system, [make_cloud(s, exact, self._options.scan) for s in stripes])
            if system.table_seen:
                break
        return system

    def _measure_all(
        self,
        requests: Sequence[MeasurementRequest],
        clouds: dict[str, PointCloud],
        system: SystemCalibration | None,
        name: str,
        title: str,
    ) -> tuple[MeasurementEntry, ...]:
        def compute() -> tuple[MeasurementEntry, ...]:
            with self._observer.work("features", len(requests)) as count:
                entries = []
                for request in requests:
                    cloud = clouds.get(request.capture)
                    entries.append(measure_request(request, cloud, self._options.measure, system))
                    count()
                return tuple(entries)

        if not requests:
            return ()
        keys = {folder: _cloud_key(cloud) for folder, cloud in clouds.items()}
        covariance = system.covariance.matrix.tolist() if system is not None and system.covariance is not None else None
        spread = (system.line_sigma_mm, system.stripe_blur_px) if system is not None else None
        asked = [r.model_dump(mode="json") for r in requests]
        key = key_of(asked, keys, covariance, spread, self._options.measure)
        return self._store.get(name, title, key, compute)

    def _surface(self, folder: str, cloud: PointCloud) -> SurfaceSummary:
        try:
            surface = reconstruct_surface(cloud, self._options.surface)
        except GeometryError as error:
            return SurfaceSummary(folder, np.empty((0, 3)), np.empty((0, 3), dtype=int), str(error))
        return SurfaceSummary(folder, surface.vertices_table, surface.triangles)

    def _cloud_summary(self, folder: str, cloud: PointCloud) -> CloudSummary:
        capture = next(c for c in self._scanned() if c.folder == folder)
        n_frames = len(capture.on_frames)
        return CloudSummary(folder, thinned(cloud), len(cloud), n_frames, n_frames - len(np.unique(cloud.frame)))


def rewrite_report(folder: Path) -> Path:
    """Write the report again from the stored results of a run.

    Raises
    ------
    SessionError
        If the folder holds no results of a run.
    OutputError
        If the report cannot be written.
    """
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


def _cloud_key(cloud: PointCloud) -> str:
    """A key of the points themselves: they depend on the calibration, which may come from elsewhere."""
    return hashlib.sha256(np.ascontiguousarray(cloud.points_table).tobytes()).hexdigest()[:16]


def _differ(a: SystemCalibration, b: SystemCalibration) -> bool:
    first, second = a.rotation_axis_camera, b.rotation_axis_camera
    return not (np.allclose(first.point, second.point) and np.allclose(first.direction, second.direction))
