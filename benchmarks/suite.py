"""The parts of the suite, in the order in which they run."""

import cv2

from benchmarks import (
    acquisition,
    features,
    joint,
    memory,
    per_frame,
    points,
    renderer,
    resolution,
    session,
    surface,
    targets,
)
from benchmarks.harness import Benchmark, Measurement, Setting


def _points(setting: Setting) -> list[Measurement]:
    """One table for all numbers of points."""
    numbers = (30_000, 100_000, 300_000) if setting.quick else (100_000, 300_000, 1_000_000, 3_000_000, 10_000_000)
    found = []
    for n in numbers:
        for name, seconds in points.measure(n, 3 if setting.quick or n > 1e6 else 7).items():
            found.append(Measurement("points", name, "s/point", (seconds,), n, "points"))
            if not name.startswith("plain"):
                found.append(Measurement("points", f"{name}, in all", "s", (n * seconds,), n, "points"))
    names = dict.fromkeys(m.name for m in found if m.unit == "s/point")
    print(f"{'ns a point':48}" + "".join(f"{n:>12,}" for n in numbers))
    for name in names:
        row = [1e9 * m.median for m in found if m.name == name]
        print(f"{name:48}" + "".join(f"{value:12.1f}" for value in row))
    return found


def _memory(setting: Setting) -> list[Measurement]:
    rows = memory.memory_curve(setting.folder / "session", (50, 200) if setting.quick else memory.NUMBERS)
    memory.show(rows)
    return [Measurement("memory", r.source, "MB", (r.peak_mb,), r.n_frames, "frames") for r in rows]


def _joint(rows: list[joint.Estimated], benchmark: str) -> list[Measurement]:
    found = []
    for r in rows:
        size, what = (r.n_frames, "frames") if benchmark == "joint" else (r.n_mounts, "mounts")
        each = tuple(s / r.n_iterations for s in r.seconds)
        found.append(Measurement(benchmark, "joint estimate", "s", r.seconds, size, what))
        found.append(Measurement(benchmark, "joint estimate, an iteration", "s", each, size, what))
        if r.general_evaluations:
            found.append(
                Measurement(benchmark, "scipy's least_squares on the same rows", "s", (r.general_s,), size, what)
            )
    return found


def _joint_frames(setting: Setting) -> list[Measurement]:
    return _joint(
        joint.measure_frames((16.0, 8.0, 4.0) if setting.quick else joint.STEPS_DEG, setting.repeats), "joint"
    )


def _mounts(setting: Setting) -> list[Measurement]:
    return _joint(joint.measure_mounts((1, 2, 3) if setting.quick else joint.MOUNTS, setting.repeats), "mounts")


def _features(setting: Setting) -> list[Measurement]:
    found = []
    for row in features.measure():
        name = f"{row.feature}, {row.scan}"
        found.append(Measurement("features", name, "s", (row.seconds,)))
        found += [Measurement("features", f"{name}: error of {k}", "mm", (e,)) for k, e in row.errors_mm.items()]
    return found


def _targets(setting: Setting) -> list[Measurement]:
    found = []
    for row in targets.measure():
        found.append(Measurement("targets", f"{row.target}: {row.way}", "s/view", row.seconds))
        found.append(Measurement("targets", f"{row.target}: {row.way}, rms error", "px", (row.rms_px,)))
    targets.measure_bias()
    return found


def _renderer(setting: Setting) -> list[Measurement]:
    seconds = renderer.measure((640, 480) if setting.quick else (1280, 960), 2 if setting.quick else renderer.FRAMES)
    return [Measurement("renderer", name, "s/frame", values) for name, values in seconds.items()]


def _per_frame(setting: Setting) -> list[Measurement]:
    """One thread for all: OpenCV would take every core otherwise, and the others one."""
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        return per_frame.measure(setting)
    finally:
        cv2.setNumThreads(threads)


SUITE = (
    Benchmark("per-frame", "stripe extraction: time and error of each method", _per_frame),
    Benchmark("resolution", "stripe extraction, 0.3 to 12 megapixels", resolution.measure),
    Benchmark("session", "scanning against decoding, folder and packed", session.measure),
    Benchmark("frames", "scanning, 100 to 3200 frames", session.measure_frames),
    Benchmark("workers", "threads and processes", session.measure_workers),
    Benchmark("memory", "resident memory of a scan, 100 to 3600 frames", _memory),
    Benchmark("points", "triangulation and uncertainties, 1e5 to 1e7 points", _points),
    Benchmark("surface", "surfaces of 1e5 to 5e6 points", surface.measure),
    Benchmark("joint", "joint estimate, 46 to 362 frames", _joint_frames),
    Benchmark("mounts", "joint estimate, 1 to 10 mounts", _mounts),
    Benchmark("features", "measured features of ideal solids", _features),
    Benchmark("targets", "detection of targets, beside OpenCV", _targets),
    Benchmark("renderer", "rendering", _renderer),
    Benchmark("acquisition", "streaming to disk, and a scan step by step", acquisition.measure),
)
