"""Time of a scan against decoding its frames, from a folder of PNG files and from a packed session; and its growth with frames and workers.

The session is a turn of rendered frames, as many as wanted: the files of a few dozen are linked under other names and angles. Everything is
read from a warm disk cache, with two threads.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from benchmarks.harness import Measurement, Setting, timed
from benchmarks.rendered_frames import rendered_frames
from rotaline.calibration.model import SystemCalibration
from rotaline.io.calibration_file import CalibrationFile, write_calibration
from rotaline.io.frame_images import read_sources
from rotaline.io.session import read_session
from rotaline.pipeline.ranges import RangeTask, backgrounds_of, process_range, program, spans
from rotaline.pipeline.workers import ProcessWorkers, ThreadWorkers, Workers
from rotaline.simulation.rig import Rig, build_rig
from rotaline.vision.images import one_thread_per_image
from rotaline.vision.stripe.extract import StripeOptions

THREADS = 2
N_IMAGES = 48
ROTALINE = (sys.executable, "-m", "rotaline.cli")


def make_session(folder: Path, n_frames: int, n_images: int = N_IMAGES) -> Path:
    """A session with one scan, and ``calibration.json`` beside it, as the rig truly is."""
    images = folder / "images"
    if not images.is_dir():
        images.mkdir(parents=True)
        for i, frame in enumerate(rendered_frames(n_images)):
            cv2.imwrite(str(images / f"{i}.png"), frame.image)
        write_calibration(folder / "calibration.json", _calibration(build_rig((1280, 960))))
    session = folder / f"session-{n_frames}"
    if not session.is_dir():
        scan = session / "scan"
        scan.mkdir(parents=True)
        rows = ["image,angle_deg,laser,pose"]
        for i in range(n_frames):
            os.link(images / f"{i % n_images}.png", scan / f"{i:05d}.png")
            rows.append(f"{i:05d}.png,{360.0 * i / n_frames:.6f},on,")
        (scan / "frames.csv").write_text("\n".join(rows) + "\n")
        (session / "session.toml").write_text('version = 1\n\n[[captures]]\nfolder = "scan"\nrole = "scan"\n')
    return session


def packed(session: Path) -> Path:
    """The same session in one container."""
    path = session.with_name(session.name + ".rotaline.zarr")
    if not path.exists():
        _rotaline("pack", session, path, "-q")
    return path


def _calibration(rig: Rig) -> CalibrationFile:
    axis = rig.rotation_axis_camera
    return CalibrationFile(
        rig.camera, rig.laser_plane_camera, axis, axis, rig.turn_sense, table_seen=True, quality={}, session="rendered"
    )


def _system() -> SystemCalibration:
    rig = build_rig((1280, 960))
    return SystemCalibration(
        rig.camera, rig.laser_plane_camera, rig.rotation_axis_camera, rig.turn_sense, table_seen=True
    )


def tasks(session: Path) -> Iterator[RangeTask]:
    """The ranges of frames of the scan, with points."""
    capture = read_session(session).captures[0]
    frames, backgrounds = capture.on_frames, backgrounds_of(capture.frames)
    for a, b in spans(len(frames)):
        yield RangeTask("scan", a, frames[a:b], backgrounds[a:b], StripeOptions(), _system(), None, program())


def decode(task: RangeTask) -> int:
    """The images of a range, decoded and let go; the largest pixel of the last."""
    one_thread_per_image()
    last = 0
    for image in read_sources([frame.source for frame in task.frames]):
        last = int(image[-1, -1])
    return last


def all_of(function: object, work: Sequence[RangeTask], workers: Workers) -> None:
    """Every range, nothing kept."""
    for _ in workers.run(function, work):  # type: ignore[arg-type]
        pass


def scan(session: Path, *options: str) -> None:
    """``rotaline scan`` with the true calibration and without a surface, nothing stored from before."""
    out = session.with_name("scan-results")
    shutil.rmtree(out, ignore_errors=True)
    calibration = session.parent / "calibration.json"
    _rotaline(
        "scan", session, "--calibration", calibration, "--out", out, "--option", "scan.surface=false", "-q", *options
    )
    shutil.rmtree(out, ignore_errors=True)


def _warm_up(folder: Path) -> None:
    """Kernels are compiled, and loaded in this process; files are in the disk cache."""
    session = make_session(folder, 12)
    scan(session)
    all_of(process_range, tuple(tasks(session)), ThreadWorkers(THREADS))


def _rotaline(*arguments: object) -> None:
    done = subprocess.run([*ROTALINE, *map(str, arguments)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"rotaline {' '.join(map(str, arguments))} ended with {done.returncode}:\n{done.stderr}")


def measure(setting: Setting) -> list[Measurement]:
    """Decoding and scanning the same files, in turns; ``rotaline scan`` checks and lists the frames too, the others have their list."""
    n_frames = 96 if setting.quick else 960
    folder = setting.folder / "session"
    session = make_session(folder, n_frames)
    workers = ThreadWorkers(THREADS)
    _warm_up(folder)
    sources = {"PNG folder": session, "packed": packed(session)}
    steps = {}
    for source, path in sources.items():
        work = tuple(tasks(path))
        steps[f"{source}: decoding"] = partial(all_of, decode, work, workers)
        steps[f"{source}: decoding, extraction, triangulation"] = partial(all_of, process_range, work, workers)
        steps[f"{source}: rotaline scan"] = partial(scan, path)
    steps["rotaline scan, 12 frames"] = partial(scan, make_session(folder, 12))
    seconds: dict[str, list[float]] = {name: [] for name in steps}
    for _ in range(3 if setting.quick else 7):
        for name, step in steps.items():
            seconds[name] += timed(step, 1)

    each = {source: _megabytes(path) / n_frames for source, path in sources.items()}
    print(
        f"{n_frames} frames of 1280 x 960, {THREADS} threads; on disk {', '.join(f'{v:.3f} MB a frame as {k}' for k, v in each.items())}"
    )
    print(f"{'':50}{'s':>8}{'spread':>8}{'frames/s':>10}{'x decoding':>12}{'without start-up':>18}")
    found, startup = [], np.array(seconds["rotaline scan, 12 frames"])
    for name, values in seconds.items():
        m = Measurement("session", name, "s", tuple(values))
        found.append(m)
        line = f"{name:50}{m.median:8.2f}{m.spread:8.2f}"
        source, _, what = name.partition(": ")
        if source in sources:
            decoding = np.array(seconds[f"{source}: decoding"])
            ratios = {"over decoding": np.array(values) / decoding}
            if what == "rotaline scan":
                ratios["without start-up, over decoding"] = (np.array(values) - startup) / decoding
            for label, ratio in ratios.items():
                found.append(Measurement("session", f"{name}, {label}", "1", tuple(map(float, ratio))))
            medians = [float(np.median(ratio)) for ratio in ratios.values()]
            line += f"{n_frames / m.median:10.0f}{medians[0]:12.2f}" + (
                f"{medians[1]:18.2f}" if len(medians) > 1 else ""
            )
        print(line)
    return found


def _megabytes(path: Path) -> float:
    files = [path] if path.is_file() else [p for p in path.rglob("*") if p.is_file()]
    return sum(p.stat().st_size for p in files) / 1e6


def measure_frames(setting: Setting) -> list[Measurement]:
    """``rotaline scan`` of more and more frames."""
    numbers = (50, 100, 200) if setting.quick else (100, 200, 400, 800, 1600, 3200)
    folder, found = setting.folder / "session", []
    _warm_up(folder)
    print(f"{'frames':>8}{'rotaline scan, s':>18}{'extraction and triangulation, s':>34}")
    workers = ThreadWorkers(THREADS)
    for n in numbers:
        session = make_session(folder, n)
        inner = Measurement(
            "frames", "decoding, extraction, triangulation", "s",
            timed(partial(all_of, process_range, tuple(tasks(session)), workers), setting.repeats), n, "frames",
        )  # fmt: skip
        whole = Measurement(
            "frames",
            "rotaline scan, start-up included",
            "s",
            timed(partial(scan, session), setting.repeats),
            n,
            "frames",
        )
        print(f"{n:8d}{whole.median:18.2f}{inner.median:34.2f}")
        found += [inner, whole]
    return found


def measure_workers(setting: Setting) -> list[Measurement]:
    """The same frames by threads and by processes; processes start before the clock does."""
    n_frames = 96 if setting.quick else 960
    work = tuple(tasks(make_session(setting.folder / "session", n_frames)))
    warm = tuple(tasks(make_session(setting.folder / "session", 12)))
    found = []
    print(f"{n_frames} PNG frames")
    for kind, make in (("threads", ThreadWorkers), ("processes", ProcessWorkers)):
        for n in (1, 2):
            workers = make(n)
            for _ in range(n):
                all_of(process_range, warm, workers)
            all_of(process_range, work, workers)
            seconds = timed(partial(all_of, process_range, work, workers), 2 if setting.quick else 3)
            workers.close()
            found.append(Measurement("workers", kind, "s", seconds, n, kind))
            print(f"{kind:10} {n}: {found[-1].median:7.2f} s, {n_frames / found[-1].median:6.0f} frames/s")
    return found
