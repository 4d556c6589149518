"""Memory of a scan against the number of its frames: it should not grow.

``python -m benchmarks.memory [--quick]``. The session is a turn of rendered frames whose files are linked under other names and angles. The
highest resident memory of ``rotaline scan`` (no surface, which works on a limited number of points in memory) is read by the process itself when it ends.
"""

import argparse
import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from benchmarks.session import make_session, packed

NUMBERS = (100, 360, 1000, 3600)
_PROGRAM = """
import sys, time
from rotaline.cli.app import main
start = time.perf_counter()
code = main(sys.argv[1:])
seconds = time.perf_counter() - start
status = open("/proc/self/status").read()
peak = int(status.split("VmHWM:")[1].split()[0])
print(f"{peak} {seconds}", file=sys.stderr)
sys.exit(code)
"""


@dataclass(frozen=True)
class MemoryRow:
    """One scan: highest resident memory of its process, size of the cloud file, and wall time."""

    source: str
    n_frames: int
    peak_mb: float
    cloud_mb: float
    seconds: float


def scan_peak(session: Path, source: str, n_frames: int, *options: str) -> MemoryRow:
    """``rotaline scan`` in a process of its own, nothing stored from before."""
    out = session.parent / "memory-results"
    shutil.rmtree(out, ignore_errors=True)
    calibration = session.parent / "calibration.json"
    arguments = ("scan", session, "--calibration", calibration, "--out", out, "--option", "scan.surface=false", "-q")
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, *map(str, arguments), *options], capture_output=True, text=True, check=True
    )
    peak_kb, seconds = done.stderr.splitlines()[-1].split()
    cloud_mb = (out / "clouds" / "scan.ply").stat().st_size / 1e6
    shutil.rmtree(out)
    return MemoryRow(source, n_frames, int(peak_kb) * 1.024e-3, cloud_mb, float(seconds))


def memory_curve(folder: Path, numbers: tuple[int, ...] = NUMBERS) -> list[MemoryRow]:
    """Peak memory for each number of frames, from PNG files and from a packed session."""
    scan_peak(
        make_session(folder, 12), "warm-up", 12
    )  # kernels are compiled in another process than those that are measured
    rows = []
    for n in numbers:
        session = make_session(folder, n)
        rows.append(scan_peak(session, "PNG", n))
        rows.append(scan_peak(packed(session), "packed", n))
    return rows


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="up to 360 frames only")
    quick = parser.parse_args().quick
    with tempfile.TemporaryDirectory() as folder:
        rows = memory_curve(Path(folder), NUMBERS[:2] if quick else NUMBERS)
    show(rows)


def show(rows: list[MemoryRow]) -> None:
    """Print the curve as a table."""
    print(f"{'source':8}{'frames':>8}{'cloud file, MB':>16}{'peak resident, MB':>19}{'s':>8}")
    for row in rows:
        print(f"{row.source:8}{row.n_frames:8d}{row.cloud_mb:16.1f}{row.peak_mb:19.1f}{row.seconds:8.1f}")


if __name__ == "__main__":
    main()
