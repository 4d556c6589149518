"""The commands on sessions: check, run, calibrate, scan, measure, report, demo."""

import json
import logging
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rotaline.cli.base import (
    BAD_INPUT,
    INCOMPLETE,
    NOT_POSSIBLE,
    CalibrationOption,
    Force,
    Json,
    Method,
    OptionsFile,
    Out,
    Quiet,
    Session,
    Setting,
    Verbose,
    app,
)
from rotaline.cli.options_help import StageCommand
from rotaline.errors import MeasurementError, OutputError, SessionError

if TYPE_CHECKING:
    from rotaline.io.calibration_file import CalibrationFile
    from rotaline.pipeline.run import Run, RunResult
    from rotaline.pipeline.workers import Workers


WorkerProcesses = Annotated[
    int | None,
    typer.Option(
        "--workers",
        min=1,
        metavar="N",
        help="Work on the frames with stripes in so many processes of this machine; default: threads on all cores.",
    ),
]
Cluster = Annotated[
    str | None,
    typer.Option(
        "--cluster",
        metavar="ADDRESS",
        help="Work on the frames with stripes on a dask cluster, for example tcp://10.0.0.5:8786. Needs rotaline[cluster].",
    ),
]


@app.command()
def check(session: Session, as_json: Json = False) -> None:
    """What is in a session folder, which stages it allows, and everything that is wrong with it.

    Reads only; nothing is processed. Exit code 2 if something must be mended before `rotaline run`.
    """
    from rotaline.io.session import inspect_session
    from rotaline.pipeline.stages import planned_stages

    found, problems = inspect_session(session)
    stages = planned_stages(found) if found is not None else ()
    if as_json:
        print_json(
            {
                "session": session,
                "usable": found is not None,
                "image_size": found.image_size if found else None,
                "captures": [
                    {
                        "folder": c.folder,
                        "role": c.role,
                        "target": c.target_name or None,
                        "frames": len(c.frames),
                        "laser_on": len(c.on_frames),
                    }
                    for c in (found.captures if found else ())
                ],
                "stages": [{"stage": s.name, "possible": s.possible, "text": s.text} for s in stages],
                "problems": [{"where": p.where, "text": p.text, "fatal": p.fatal} for p in problems],
            }
        )
    else:
        from rotaline.cli.console import show_check

        show_check(session, found, stages, problems)
    if found is None:
        raise typer.Exit(BAD_INPUT)
    if problems:
        raise typer.Exit(INCOMPLETE)


@app.command(cls=StageCommand)
def run(
    session: Session,
    out: Out = None,
    options: OptionsFile = None,
    option: Setting = None,
    method: Method = None,
    calibration: CalibrationOption = None,
    force: Force = False,
    workers: WorkerProcesses = None,
    cluster: Cluster = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """The main job: calibrate, scan every capture, measure, reconstruct surfaces, report.

    Writes calibration.json, measurements.json, clouds/, meshes/, report.html and log.txt into the results folder. A run that
    was interrupted goes on where it stopped; stages whose inputs and options did not change are not done again.
    """
    from rotaline.io.calibration_file import read_calibration

    given = read_calibration(calibration) if calibration is not None else None
    with open_run(session, out, options, option, method, force, quiet, verbose, workers, cluster) as job:
        _finish(job.everything(given), as_json)


@app.command(cls=StageCommand)
def calibrate(
    session: Session,
    out: Out = None,
    options: OptionsFile = None,
    option: Setting = None,
    method: Method = None,
    force: Force = False,
    workers: WorkerProcesses = None,
    cluster: Cluster = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Calibrate only: camera, laser plane, rotation axis; writes calibration.json."""
    with open_run(session, out, options, option, method, force, quiet, verbose, workers, cluster) as job:
        _, content = job.calibrate()
    path = job.folder / "calibration.json"
    if as_json:
        sys.stdout.write(path.read_text(encoding="utf-8"))
    else:
        from rotaline.cli.console import show_calibration

        show_calibration(content, path)
    _exit_by_warnings(job)


@app.command(cls=StageCommand)
def scan(
    session: Session,
    captures: Annotated[
        list[str] | None, typer.Argument(metavar="[CAPTURE]...", help="Folders to scan; default: all.")
    ] = None,
    calibration: CalibrationOption = None,
    out: Out = None,
    options: OptionsFile = None,
    option: Setting = None,
    method: Method = None,
    force: Force = False,
    workers: WorkerProcesses = None,
    cluster: Cluster = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Scan captures with a calibration: writes clouds/<capture>.ply and meshes/<capture>.ply and .stl."""
    with open_run(session, out, options, option, method, force, quiet, verbose, workers, cluster) as job:
        content = _calibration_of(job, calibration)
        clouds = job.scan(content, captures or ())
        job.surfaces(clouds, content)
    files = {name: str(job.folder / "clouds" / f"{name}.ply") for name in clouds}
    if as_json:
        print_json({name: {"points": s.n_points, "file": files[name]} for name, s in clouds.scanned.items()})
    else:
        for name, scanned in clouds.scanned.items():
            typer.echo(f"{name}: {scanned.n_points} points in {files[name]}")
    _exit_by_warnings(job)


@app.command(cls=StageCommand)
def measure(
    source: Annotated[
        str, typer.Argument(metavar="SESSION|CLOUD", help="A session, or a cloud (PLY, OBJ, STL, XYZ; mm).")
    ],
    feature: Annotated[
        str | None,
        typer.Option(help="sphere, cylinder, plane, step, groove or stepped-cylinder. Needed for a cloud."),
    ] = None,
    capture: Annotated[str | None, typer.Option(help="Of a session: the scan in which to measure --feature.")] = None,
    reference: Annotated[
        list[str] | None,
        typer.Option(metavar="QUANTITY=MM", help="What a better instrument found, e.g. diameter=38.004."),
    ] = None,
    nominal: Annotated[
        list[str] | None, typer.Option(metavar="QUANTITY=MM", help="About how large the feature is; helps to find it.")
    ] = None,
    region: Annotated[
        list[str] | None,
        typer.Option(
            metavar="x|y|z|radius=FROM:TO", help="Look only there, mm, in the frame of the cloud; repeatable."
        ),
    ] = None,
    calibration: CalibrationOption = None,
    out: Out = None,
    options: OptionsFile = None,
    option: Setting = None,
    method: Method = None,
    force: Force = False,
    workers: WorkerProcesses = None,
    cluster: Cluster = None,
    as_json: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Fit features in the scans of a session, or in a cloud that any program wrote.

    For a session without --feature, measures what its session.toml asks for.
    """
    from rotaline.cli.arguments import lengths, region_of
    from rotaline.io.locations import locate
    from rotaline.io.session_file import measurement_request

    request = None
    from_session = not locate(source).is_local or Path(source).is_dir()
    if feature is not None:
        name = capture or ("" if from_session else Path(source).stem)
        request = measurement_request(
            name, feature, lengths("--reference", reference), lengths("--nominal", nominal), region_of(region)
        )
    if from_session:
        if request is not None and not capture:
            raise SessionError("--feature needs --capture FOLDER for a session.")
        with open_run(source, out, options, option, method, force, quiet, verbose, workers, cluster) as job:
            content = _calibration_of(job, calibration)
            clouds = job.scan(content, (capture,) if capture else ())
            entries, initial = job.measure(clouds, content, (request,) if request is not None else ())
        _show_entries(entries, initial, as_json)
        _exit_by_warnings(job)
        return
    if request is None:
        raise SessionError(
            f"{source}: to measure in a cloud, say what: --feature sphere, cylinder, plane, step or groove."
        )
    from rotaline.pipeline.options import read_options
    from rotaline.pipeline.parts import measure_points

    entry = measure_points(Path(source), request, read_options(options, tuple(option or ()), method).measure)
    if entry.measurement is None:
        raise MeasurementError(f"{source}: {entry.failure}")
    _show_entries((entry,), (), as_json)


@app.command()
def report(
    results: Annotated[Path, typer.Argument(metavar="DIR", help="Results folder that `rotaline run` wrote.")],
) -> None:
    """Write report.html again from the stored results of a run."""
    from rotaline.pipeline.run import rewrite_report

    typer.echo(str(rewrite_report(results)))


@app.command()
def demo(
    folder: Annotated[Path, typer.Option("--folder", help="Where the demo session is rendered.")] = Path(
        "demo-session"
    ),
    quiet: Quiet = False,
) -> None:
    """Render a small session of the article's rig and run the main job on it.

    The rig is `rotaline simulate --preset demo --toml`; what is true of it stands in the .truth.json beside the session.
    """
    from rotaline.cli.console import ConsoleObserver
    from rotaline.io.rig_file import read_preset
    from rotaline.pipeline.simulate import simulate

    observer = ConsoleObserver(0 if quiet else 1)
    if (folder / "session.toml").is_file():
        observer.stage(f"Session in {folder}", stored=True)
    else:
        simulate(read_preset("demo"), folder, observer)
    with open_run(str(folder), None, None, None, None, False, quiet, False) as job:
        _finish(job.everything(), False)


def open_run(
    session: str,
    out: Path | None,
    options: Path | None,
    settings: list[str] | None,
    method: Method,
    force: bool,
    quiet: bool,
    verbose: bool,
    workers: int | None = None,
    cluster: str | None = None,
) -> "Run":
    """A run over a session with the options of the command line, to be closed; its log stands in the folder of results."""
    from rotaline.cli.console import ConsoleObserver
    from rotaline.io.session import read_session
    from rotaline.pipeline.options import read_options
    from rotaline.pipeline.run import Run, results_folder

    content = read_session(session)
    chosen = read_options(options, tuple(settings or ()), method)
    folder = results_folder(session, out)
    observer = ConsoleObserver(0 if quiet else 1)
    team = _workers(workers, cluster)
    try:
        return Run(content, folder, chosen, observer, force, lambda: open_log(folder, verbose), team)
    except BaseException:
        team.close()
        raise


def _workers(processes: int | None, cluster: str | None) -> "Workers":
    """Who works on the frames: threads, processes or a cluster."""
    from rotaline.pipeline.workers import ProcessWorkers, ThreadWorkers

    if processes is not None and cluster is not None:
        raise SessionError("--workers and --cluster: choose one; a cluster has its own workers.")
    if cluster is not None:
        from rotaline.pipeline.cluster import ClusterWorkers

        return ClusterWorkers(cluster)
    return ThreadWorkers() if processes is None else ProcessWorkers(processes)


def open_log(folder: Path, verbose: bool = False) -> None:
    """Write the log into the folder of the results, with ``verbose`` to the terminal as well."""
    log = logging.getLogger("rotaline")
    log.setLevel(logging.INFO)
    log.propagate = False
    try:
        handlers: list[logging.Handler] = [logging.FileHandler(folder / "log.txt", encoding="utf-8")]
    except OSError as error:
        raise OutputError(f"{folder / 'log.txt'}: cannot be written ({error.strerror}).") from error
    if verbose:
        handlers.append(logging.StreamHandler(sys.stderr))
    for handler in handlers:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s"))
        log.addHandler(handler)
    log.info("rotaline %s", " ".join(sys.argv[1:]))


def _calibration_of(job: "Run", path: Path | None) -> "CalibrationFile":
    from rotaline.io.calibration_file import read_calibration

    return read_calibration(path) if path is not None else job.calibrate()[1]


def _finish(result: "RunResult", as_json: bool) -> None:
    _show_entries(result.measurements, result.measurements_initial_axis, as_json, result.warnings)
    if not as_json:
        typer.echo(f"Results: {result.folder}")
        typer.echo(f"Report:  {result.folder / 'report.html'}")
    if result.calibration_failed:
        raise typer.Exit(NOT_POSSIBLE)
    if not result.complete:
        raise typer.Exit(INCOMPLETE)


def _exit_by_warnings(job: "Run") -> None:
    result = job.result()
    if result.calibration_failed:
        raise typer.Exit(NOT_POSSIBLE)
    if not result.complete:
        raise typer.Exit(INCOMPLETE)


def _show_entries(entries: Any, initial: Any, as_json: bool, warnings: Any = ()) -> None:
    if as_json:
        document: dict[str, Any] = {"measurements": [e.to_json() for e in entries]}
        if warnings:
            document["warnings"] = [{"stage": w.stage, "text": w.text, "serious": w.serious} for w in warnings]
        print_json(document)
    elif entries:
        from rich.console import Console

        from rotaline.cli.console import measurement_table

        Console(width=max(120, shutil.get_terminal_size().columns)).print(measurement_table(entries, initial))


def print_json(value: Any) -> None:
    """Print a value as JSON on standard output."""
    from rotaline.io.files import plain

    sys.stdout.write(json.dumps(plain(value), indent=1, allow_nan=False) + "\n")
