"""Kills one acquisition again and again: ``python -m tests.unit.pipeline.killed_acquisition FOLDER SEED KILLS``.

Each start is a fork of this process, so that it costs no imports. A start is killed at a moment that is drawn: in front of an operation on a file, in
the middle of a write, or when a frame is taken. What is left is never looked at in between.
"""

import os
import signal
import sys
from pathlib import Path

import numpy as np
from tests.unit.pipeline import small_acquisition as small

from rotaline.hardware.cameras.simulated import SimulatedCamera
from rotaline.hardware.simulated import world as world_module


def _die() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _kill_at(moment: int) -> None:
    """Die at the operation of this number."""
    count = 0

    def counted(function, half=None):
        def call(*args, **kwargs):
            nonlocal count
            count += 1
            if count == moment:
                if half is not None:
                    half(*args)
                _die()
            return function(*args, **kwargs)

        return call

    write = os.write
    os.write = counted(os.write, lambda handle, data: write(handle, bytes(data)[: len(data) // 2]))
    for name in ("fsync", "unlink", "ftruncate"):
        setattr(os, name, counted(getattr(os, name)))
    for name in ("replace", "mkdir", "write_bytes"):
        setattr(Path, name, counted(getattr(Path, name)))
    SimulatedCamera.take = counted(SimulatedCamera.take)


def _forked(out: Path, moment: int | None) -> int:
    pid = os.fork()
    if pid == 0:
        try:
            if moment is not None:
                _kill_at(moment)
            small.start(out)
            os._exit(0)
        except BaseException as error:
            print(repr(error), file=sys.stderr, flush=True)
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


def main(folder: Path, seed: int, n_kills: int) -> None:
    """Write ``folder/whole``, and ``folder/killed`` with so many kills; prints how often it was started."""
    world_module.render_exposure = small.rendered
    small.rig_and_plan()
    assert _forked(folder / "whole", None) == 0
    rng = np.random.default_rng(seed)
    kills = starts = 0
    while kills < n_kills:
        code = _forked(folder / "killed", int(rng.integers(1, 45)))
        starts += 1
        assert code in (0, -signal.SIGKILL), code
        kills += code != 0
        if code == 0:
            break
    if kills == n_kills:
        assert _forked(folder / "killed", None) == 0
    print(kills, "kills", starts, "starts")


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
