"""Threads, processes and a dask cluster do the same work with the same result, also when some of those who work are killed."""

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from multiprocessing import active_children
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest

from rotaline.cli.base import BAD_INPUT, INCOMPLETE, INTERRUPTED, OK
from rotaline.cli.console import ConsoleObserver
from rotaline.io.calibration_file import CalibrationFile, write_calibration
from rotaline.simulation.rig import build_rig
from rotaline.simulation.session import write_session
from rotaline.simulation.small_session import small_plan

N_FRAMES = 300
N_RANGES = 10
DEADLINE_S = 60.0


@dataclass(frozen=True)
class Scene:
    """A session with one long scan, and the calibration of its rig."""

    session: Path
    calibration: Path

    def arguments(self, results, *more):
        return (
            "scan",
            self.session,
            "--calibration",
            self.calibration,
            "--out",
            results,
            "--option",
            "scan.surface=false",
            *more,
        )


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """The frames of a ball, each several times at other angles."""
    folder = tmp_path_factory.mktemp("ways")
    rig = build_rig((320, 240))
    write_session(folder / "rendered", rig, small_plan(rig, captures=("ball",)))
    rendered = sorted((folder / "rendered" / "ball").glob("*.png"))
    capture = folder / "session" / "ball"
    capture.mkdir(parents=True)
    (folder / "session" / "session.toml").write_text('version = 1\n\n[[captures]]\nfolder = "ball"\nrole = "scan"\n')
    rows = ["image,angle_deg,laser,pose"]
    for i in range(N_FRAMES):
        os.link(rendered[i % len(rendered)], capture / f"{i:04d}.png")
        rows.append(f"{i:04d}.png,{360 * i / N_FRAMES:.6f},on,")
    (capture / "frames.csv").write_text("\n".join(rows) + "\n")
    calibration = CalibrationFile(
        camera=rig.camera,
        laser_plane_camera=rig.laser_plane_camera,
        rotation_axis_camera=rig.rotation_axis_camera,
        rotation_axis_initial_camera=None,
        turn_sense=rig.turn_sense,
        table_seen=True,
        quality={},
    )
    write_calibration(folder / "calibration.json", calibration)
    return Scene(folder / "session", folder / "calibration.json")


@dataclass
class Cluster:
    """A scheduler and its workers, each a process."""

    port: int
    scheduler: subprocess.Popen
    workers: list

    @property
    def address(self):
        return f"tcp://127.0.0.1:{self.port}"


def _free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def start_cluster(tmp_path):
    """Start a scheduler and workers, which end with the test."""
    with ExitStack() as stack:

        def start(words, command, *arguments):
            said = (
                tmp_path / f"{command}-{uuid4().hex}.txt"
            )  # a file: a pipe that nobody reads would stop who writes into it
            with said.open("w") as file:
                process = subprocess.Popen(
                    [sys.executable, "-m", f"distributed.cli.dask_{command}", *arguments, "--no-dashboard"],
                    stdout=subprocess.DEVNULL,
                    stderr=file,
                )
            stack.callback(_end, process)
            _wait_until(lambda: words in said.read_text() or process.poll() is not None)
            assert words in said.read_text()
            return process

        def start_all(n_workers):
            port = _free_port()
            scheduler = start("Scheduler at", "scheduler", "--host", "127.0.0.1", "--port", str(port))
            one = ("--nthreads", "1", "--no-nanny", "--host", "127.0.0.1")
            workers = [start("Registered to", "worker", f"tcp://127.0.0.1:{port}", *one) for _ in range(n_workers)]
            return Cluster(port, scheduler, workers)

        yield start_all


def _end(process):
    process.kill()
    process.wait(DEADLINE_S)


def _wait_until(condition):
    end = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < end, "it did not come to that in time"
        time.sleep(0.02)


def _at_frame(monkeypatch, number, action):
    """Do something when so many frames were counted."""
    counted = iter(range(1, 100000))

    def count():
        if next(counted) == number:
            action()

    monkeypatch.setattr(ConsoleObserver, "work", lambda self, label, total: nullcontext(count))


def _ranges(results):
    return {path.name: path for path in results.glob("stages/stripes-ball.*/[0-9]*.npz")}


def _arrays(path):
    with np.load(path) as file:
        return {name: file[name].tobytes() for name in file.files if name != "tree"}


def assert_same(results, expected):
    """All points and all stored stripes have the same bits."""
    assert (results / "clouds" / "ball.ply").read_bytes() == (expected / "clouds" / "ball.ply").read_bytes()
    ours, theirs = _ranges(results), _ranges(expected)
    assert ours.keys() == theirs.keys()
    assert len(ours) == N_RANGES
    for name in ours:
        assert _arrays(ours[name]) == _arrays(theirs[name]), name


@pytest.fixture(scope="module")
def by_threads(scene, tmp_path_factory):
    """What threads make of it; not to be changed."""
    from rotaline.cli.app import main

    results = tmp_path_factory.mktemp("by-threads") / "results"
    assert main([str(a) for a in scene.arguments(results, "--quiet")]) == OK
    return results


def test_two_processes_give_the_same_bits_also_when_one_is_killed(scene, by_threads, tmp_path, call, monkeypatch):
    killed = []

    def kill():
        killed.extend(p.pid for p in active_children()[:1])
        os.kill(killed[0], signal.SIGKILL)

    _at_frame(monkeypatch, 33, kill)
    outcome = call(*scene.arguments(tmp_path / "results", "--workers", "2"))
    assert outcome.code == OK, outcome.err
    assert len(killed) == 1
    assert_same(tmp_path / "results", by_threads)
    assert not active_children()
    assert "done again" in (tmp_path / "results" / "log.txt").read_text()


def test_a_cluster_gives_the_same_bits_also_when_a_worker_is_killed(
    scene, by_threads, tmp_path, call, monkeypatch, start_cluster
):
    cluster = start_cluster(2)
    _at_frame(monkeypatch, 33, cluster.workers[0].kill)
    outcome = call(*scene.arguments(tmp_path / "results", "--cluster", cluster.address))
    assert outcome.code == OK, outcome.err
    assert cluster.workers[0].wait(DEADLINE_S) == -signal.SIGKILL
    assert cluster.workers[1].poll() is None
    assert_same(tmp_path / "results", by_threads)


def test_when_the_scheduler_is_killed_what_was_done_stays_and_the_run_goes_on(
    scene, by_threads, tmp_path, call, monkeypatch, start_cluster
):
    cluster = start_cluster(1)
    with monkeypatch.context() as patch:
        _at_frame(patch, 64, cluster.scheduler.kill)
        outcome = call(*scene.arguments(tmp_path / "results", "--cluster", cluster.address))
    assert outcome.code == INCOMPLETE
    assert cluster.address in outcome.err
    assert "scheduler" in outcome.err
    done = _ranges(tmp_path / "results")
    assert 2 <= len(done) < N_RANGES
    assert f"{len(done)} of {N_RANGES} ranges of frames of ball are done and stay" in outcome.err
    assert not (tmp_path / "results" / "clouds" / "ball.ply").exists()
    before = {name: path.stat().st_mtime_ns for name, path in done.items()}

    again = call(*scene.arguments(tmp_path / "results"))
    assert again.code == OK
    assert f"{len(done)} of {N_RANGES} ranges of frames are there from before" in again.err
    assert_same(tmp_path / "results", by_threads)
    after = {name: path.stat().st_mtime_ns for name, path in _ranges(tmp_path / "results").items()}
    assert {name: after[name] for name in before} == before


def test_where_no_scheduler_or_no_worker_is_it_is_said(start_cluster):
    from rotaline.errors import WorkError
    from rotaline.pipeline.cluster import ClusterWorkers

    with pytest.raises(WorkError, match=r"no dask scheduler answers at tcp://127\.0\.0\.1"):
        ClusterWorkers(f"tcp://127.0.0.1:{_free_port()}", connect_s=0.3)
    cluster = start_cluster(0)
    workers = ClusterWorkers(cluster.address, no_worker_s=0.3)
    with pytest.raises(WorkError, match="has had no worker"):
        next(workers.run(abs, [-1]))
    workers.close()


def test_an_interrupt_leaves_no_process_behind(scene, by_threads, tmp_path):
    arguments = [str(a) for a in scene.arguments(tmp_path / "results", "--workers", "2")]
    with subprocess.Popen(
        [sys.executable, "-m", "rotaline.cli", *arguments],
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a background shell has it ignored
    ) as process:
        try:
            _wait_until(lambda: _ranges(tmp_path / "results") or process.poll() is not None)
            os.killpg(process.pid, signal.SIGINT)  # as a terminal does it
            _, said = process.communicate(timeout=DEADLINE_S)
            assert process.returncode == INTERRUPTED, said
            _wait_until(lambda: not _alive(process.pid))
        finally:
            if _alive(process.pid):
                os.killpg(process.pid, signal.SIGKILL)
    assert "Traceback" not in said
    assert "interrupted" in said
    assert 1 <= len(_ranges(tmp_path / "results")) <= N_RANGES
    assert not list((tmp_path / "results").rglob(".*"))


def _alive(group):
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_frame_that_cannot_be_decoded_is_named_and_the_ranges_before_it_stay(scene, tmp_path, call):
    shutil.copytree(scene.session, tmp_path / "session")
    broken = tmp_path / "session" / "ball" / "0070.png"
    data = bytearray(broken.read_bytes())
    broken.unlink()
    middle = len(data) // 2
    data[middle : middle + 400] = bytes(400)
    broken.write_bytes(data)
    damaged = Scene(tmp_path / "session", scene.calibration)
    outcome = call(*damaged.arguments(tmp_path / "results"))
    assert outcome.code == BAD_INPUT
    assert "ball/0070.png: the image is damaged" in outcome.err
    assert "00000032.npz" in _ranges(tmp_path / "results")


def test_a_damaged_range_is_done_again(scene, by_threads, tmp_path, call):
    shutil.copytree(by_threads, tmp_path / "results")
    _ranges(tmp_path / "results")["00000064.npz"].write_bytes(b"half")
    outcome = call(*scene.arguments(tmp_path / "results", "--json"))
    assert outcome.code == OK
    assert_same(tmp_path / "results", by_threads)
    assert json.loads(outcome.out)["ball"]["points"] > 1000


def test_workers_and_cluster_exclude_each_other(scene, tmp_path, call):
    outcome = call(*scene.arguments(tmp_path / "results", "--workers", "2", "--cluster", "tcp://127.0.0.1:1"))
    assert outcome.code == BAD_INPUT
    assert "choose one" in outcome.err
