"""What a million frames in object storage cost on a cluster: an estimate from what each part costs here.

``python -m benchmarks.cluster [--quick] [--docs docs]`` measures, on this machine, seconds of CPU for reading a frame, for extraction and
triangulation, for the client's share (storing, writing the cloud), bytes in and out of a worker, and what dask takes of the client and of the
scheduler for a range, with two local workers; then prints the table of the estimate, and puts it into ``how-to/cluster.md`` of the folder of
``--docs``. CPU time is counted, so that other work on the machine disturbs little. Assumed, not measured, are the cores of a node and the network
(``CORES``, ``GIGABIT``), and that a core there is as fast as one here.
"""

import argparse
import os
import pickle
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import as_lines, filled, machine, versions
from benchmarks.session import decode, make_session, packed, tasks
from rotaline.io.calibration_file import read_calibration
from rotaline.io.session import read_session
from rotaline.pipeline.capture_ranges import ranges_of
from rotaline.pipeline.cluster import ClusterWorkers
from rotaline.pipeline.observer import Silent
from rotaline.pipeline.options import Options
from rotaline.pipeline.ranges import FRAMES_A_RANGE, RangeResult, RangeTask, process_range
from rotaline.pipeline.scan import scan_capture
from rotaline.pipeline.store import StageStore

CORES = 16
"""Of a node."""
GIGABIT = 10.0
"""Network of each node and of the client, Gbit/s."""
N_FRAMES = 1_000_000
NODES = (1, 10, 100)


@dataclass(frozen=True)
class Costs:
    """Of one frame, unless the name says otherwise; seconds are of one core.

    ``bytes_in`` is what a worker reads, ``bytes_out`` what the client receives; ``client_s`` is the client's own work; ``dask_range_s`` what dask takes
    of the client for a range without a result, ``dask_s_per_byte`` for each byte of one; ``scheduler_s`` what a range takes of the scheduler.
    """

    source: str
    read_s: float
    work_s: float
    bytes_in: float
    bytes_out: float
    client_s: float
    dask_range_s: float
    dask_s_per_byte: float
    scheduler_s: float


@dataclass(frozen=True)
class Estimate:
    """Minutes for :data:`N_FRAMES`, by what is busy; all are at the same time, so that the longest limits."""

    source: str
    nodes: int
    busy_min: dict[str, float]

    @property
    def limit(self) -> str:
        """What is busy longest."""
        return max(self.busy_min, key=lambda name: self.busy_min[name])


def estimate(costs: Costs, nodes: int) -> Estimate:
    """How long each part of a cluster is busy."""
    bytes_per_s = GIGABIT * 1e9 / 8
    client_s = costs.client_s + costs.dask_range_s / FRAMES_A_RANGE + costs.bytes_out * costs.dask_s_per_byte
    seconds = {
        "workers": (costs.read_s + costs.work_s) / (CORES * nodes),
        "their network": costs.bytes_in / (bytes_per_s * nodes),
        "scheduler": costs.scheduler_s / FRAMES_A_RANGE,
        "client": client_s,
        "its network": costs.bytes_out / bytes_per_s,
    }
    return Estimate(costs.source, nodes, {name: N_FRAMES * s / 60.0 for name, s in seconds.items()})


class _Replay:
    """Workers whose results are there already, as bytes: what is left is the client's share."""

    def __init__(self, results: dict[int, bytes]) -> None:
        self._results = results

    def run(self, function: Callable[..., Any], some: Iterable[RangeTask]) -> Generator[RangeResult, None, None]:
        """Each result, unpacked as one that comes from elsewhere."""
        for task in some:
            yield pickle.loads(self._results[task.first_frame])

    def close(self) -> None:
        """Nothing is open."""


def measure(folder: Path, n_frames: int, repeats: int) -> list[Costs]:
    """The costs from PNG files and from a packed session; medians of the repeats."""
    session = make_session(folder, n_frames)
    empty_s, byte_s, scheduler_s = _dask_overhead(repeats)
    found = []
    for source, path in (("PNG", session), ("packed", packed(session))):
        work = list(tasks(path))
        results = {task.first_frame: pickle.dumps(process_range(task), protocol=5) for task in work}
        turns = [(_cpu(decode, work), _cpu(process_range, work), _client(path, results)) for _ in range(repeats)]
        read_s, both_s, client_s = np.median(np.array(turns), axis=0) / n_frames
        found.append(
            Costs(
                source,
                read_s=float(read_s),
                work_s=float(both_s - read_s),
                bytes_in=_file_bytes(path) / n_frames,
                bytes_out=sum(map(len, results.values())) / n_frames,
                client_s=float(client_s),
                dask_range_s=empty_s,
                dask_s_per_byte=byte_s,
                scheduler_s=scheduler_s,
            )
        )
    return found


def _cpu(function: Callable[[RangeTask], object], work: list[RangeTask]) -> float:
    start = time.process_time()
    for task in work:
        function(task)
    return time.process_time() - start


def _client(session: Path, results: dict[int, bytes]) -> float:
    calibration = read_calibration(session.parent / "calibration.json").system()
    assert calibration is not None
    with tempfile.TemporaryDirectory(dir=session.parent) as folder:
        store = StageStore(Path(folder) / "stages", Silent(), workers=_Replay(results))
        ranges = ranges_of(read_session(session).captures[0], Options(), store, Silent())
        start = time.process_time()
        scan_capture("scan", ranges, calibration, Path(folder) / "scan.ply")
        return time.process_time() - start


def _file_bytes(path: Path) -> float:
    return float(sum(p.stat().st_size for p in path.rglob("*") if p.is_file()))


@contextmanager
def local_cluster(n_workers: int) -> Iterator[tuple[str, int]]:
    """The address and the process number of a scheduler with workers, each a process of its own."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    command = [sys.executable, "-m"]
    quiet = ["--no-dashboard", "--host", "127.0.0.1"]
    scheduler = [*command, "distributed.cli.dask_scheduler", "--port", str(port), *quiet]
    worker = [*command, "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny", *quiet]
    processes = [subprocess.Popen(c, stderr=subprocess.DEVNULL) for c in [scheduler, *[worker] * n_workers]]
    try:
        yield address, processes[0].pid
    finally:
        for process in processes:
            process.kill()
            process.wait()


def _dask_overhead(repeats: int) -> tuple[float, float, float]:
    """CPU seconds of the client for a range without work or result, and for each byte of a result; of the scheduler for a range."""
    n_empty, n_large, size = 400, 60, 4_000_000
    with local_cluster(2) as (address, scheduler):
        workers = ClusterWorkers(address)

        def turn(n: int, n_bytes: int) -> tuple[float, float]:
            client, other = time.process_time(), _cpu_of(scheduler)
            for _ in workers.run(bytes, [n_bytes] * n):
                pass
            return (time.process_time() - client) / n, (_cpu_of(scheduler) - other) / n

        turn(20, 0)
        turns = [(*turn(n_empty, 0), turn(n_large, size)[0]) for _ in range(repeats)]
        workers.close()
    empty, of_scheduler, large = np.median(np.array(turns), axis=0)
    return float(empty), float(max(large - empty, 0.0) / size), float(of_scheduler)


def _cpu_of(process: int) -> float:
    """CPU seconds of another process so far."""
    user, system = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def table(found: list[Costs]) -> str:
    """What a frame costs, and the estimate."""
    rows: tuple[tuple[str, Callable[[Costs], float]], ...] = (
        ("worker: reading, ms", lambda c: 1e3 * c.read_s),
        ("worker: extraction and triangulation, ms", lambda c: 1e3 * c.work_s),
        ("into a worker, kB", lambda c: 1e-3 * c.bytes_in),
        ("from a worker to the client, kB", lambda c: 1e-3 * c.bytes_out),
        ("client: unpacking, storing, writing, ms", lambda c: 1e3 * c.client_s),
        ("client: dask, for the bytes of a frame, ms", lambda c: 1e3 * c.dask_s_per_byte * c.bytes_out),
        (f"client: dask, for a range of {FRAMES_A_RANGE} frames, ms", lambda c: 1e3 * c.dask_range_s),
        (f"scheduler: for a range of {FRAMES_A_RANGE} frames, ms", lambda c: 1e3 * c.scheduler_s),
    )
    estimates = [estimate(costs, nodes) for costs in found for nodes in NODES]
    names = tuple(estimates[0].busy_min)
    lines = [
        "One frame of 1280 x 960, seconds of one core of this machine:",
        "",
        f"{'':48}" + "".join(f"{c.source:>10}" for c in found),
        *(f"{title:48}" + "".join(f"{value(c):10.2f}" for c in found) for title, value in rows),
        "",
        f"{N_FRAMES} frames; nodes of {CORES} cores, {GIGABIT:g} Gbit/s; minutes:",
        "",
        f"{'source':8}{'nodes':>6}" + "".join(f"{name:>15}" for name in (*names, "all")) + "   limited by",
    ]
    for e in estimates:
        minutes = (*e.busy_min.values(), e.busy_min[e.limit])
        lines.append(f"{e.source:8}{e.nodes:6d}" + "".join(f"{m:15.2f}" for m in minutes) + f"   {e.limit}")
    return "\n".join(lines)


def main() -> None:
    """Measure, and print the table of the estimate."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.cluster", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="fewer frames and repeats")
    parser.add_argument("--docs", type=Path, metavar="DIR", help="also put the table into how-to/cluster.md there")
    arguments = parser.parse_args()
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        found = measure(Path(folder), 96 if arguments.quick else 480, 3 if arguments.quick else 5)
    text = f"{as_lines(machine())}\n{as_lines(versions())}\n\n{table(found)}"
    print(text)
    if arguments.docs:
        page = arguments.docs / "how-to" / "cluster.md"
        page.write_text(filled(page.read_text(encoding="utf-8"), {"cluster": text}), encoding="utf-8")
    print(f"({time.perf_counter() - start:.0f} s)")


if __name__ == "__main__":
    main()
