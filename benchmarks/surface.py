"""Time, memory and error of surfaces from scans of a bust of more and more points.

Each is made in a process of its own, whose largest resident memory is that of everything: libraries, cloud, surface.

.venv/bin/python -m benchmarks.surface 1000000
"""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from benchmarks.harness import ROOT, Measurement, Setting
from benchmarks.part_scans import NOISE_MM, scan_part
from rotaline.scanning.surface import reconstruct_surface
from rotaline.simulation.parts.mesh_distance import signed_distances_to_mesh
from rotaline.simulation.parts.sculptures import bust

N_POINTS = (100_000, 300_000, 1_000_000, 5_000_000)
JUDGED = 50_000


def measure(setting: Setting) -> list[Measurement]:
    """The series; memory and error are those of the first repeat."""
    numbers = (20_000, 60_000, 200_000) if setting.quick else N_POINTS
    found = []
    print(f"bust, noise {1e3 * NOISE_MM:g} um; distance of the surface's vertices from the truth")
    print(f"{'points':>9}{'s':>8}{'peak MB':>9}{'triangles':>11}{'rms um':>8}{'95 % um':>9}{'of points, rms um':>19}")
    for n in numbers:
        runs = [_in_own_process(n) for _ in range(setting.repeats if n <= 1e5 else 1)]
        first = runs[0]
        print(
            f"{n:9d}{np.median([r['s'] for r in runs]):8.1f}{first['peak_MB']:9.0f}{first['triangles']:11.0f}"
            f"{1e3 * first['rms_mm']:8.2f}{1e3 * first['q95_mm']:9.2f}{1e3 * first['points_rms_mm']:19.2f}"
        )
        found += [
            Measurement("surface", "making a surface", "s", tuple(r["s"] for r in runs), n, "points"),
            Measurement("surface", "largest memory of the process", "MB", (first["peak_MB"],), n, "points"),
            Measurement("surface", "rms distance from the truth", "mm", (first["rms_mm"],), n, "points"),
            Measurement("surface", "95 % of the distances", "mm", (first["q95_mm"],), n, "points"),
        ]
    return found


def _in_own_process(n_points: int) -> dict[str, float]:
    command = [sys.executable, "-m", "benchmarks.surface", str(n_points)]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    return {key: float(value) for key, value in json.loads(done.stdout).items()}


def one(n_points: int) -> dict[str, float]:
    """One surface, in this process."""
    part = bust().shape
    cloud = scan_part(part, n_points)
    start = time.perf_counter()
    surface = reconstruct_surface(cloud)
    seconds = time.perf_counter() - start
    # not getrusage: what it says begins with the memory of the process that started this one
    status = Path("/proc/self/status").read_text(encoding="ascii")
    peak_mb = int(status.split("VmHWM:")[1].split()[0]) / 1024
    distance, from_points = (
        signed_distances_to_mesh(part, points[:: max(1, len(points) // JUDGED)])
        for points in (surface.vertices_table, cloud.points_table)
    )
    return {
        "s": seconds,
        "peak_MB": peak_mb,
        "triangles": len(surface.triangles),
        "rms_mm": float(np.sqrt(np.mean(distance**2))),
        "q95_mm": float(np.quantile(np.abs(distance), 0.95)),
        "points_rms_mm": float(np.sqrt(np.mean(from_points**2))),
    }


if __name__ == "__main__":
    print(json.dumps(one(int(float(sys.argv[1])))))
