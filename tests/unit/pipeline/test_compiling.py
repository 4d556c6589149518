import logging
import shutil
import subprocess
import sys

import numpy as np
import pytest

from rotaline.pipeline import compiling
from rotaline.pipeline.compiling import TASKS, compile_if_missing, exercise
from rotaline.vision.stripe.extract import StripeOptions


@pytest.mark.parametrize("task", TASKS)
def test_made_up_stripes_are_found_and_measured(task):
    assert exercise(task, "uint8", 2, False, StripeOptions()) > 100


def test_it_is_done_once_and_by_processes_that_succeed(monkeypatch, caplog):
    said, missing = [], [True]
    monkeypatch.setattr(compiling, "machine_code_stored", lambda _: not missing.pop())
    image = np.zeros((1, 1), dtype=np.uint8)
    with caplog.at_level(logging.WARNING):
        compile_if_missing(said.append, image)
    assert "one time" in said[0]
    assert not caplog.records
    missing.append(False)
    compile_if_missing(said.append, image)
    assert len(said) == 1


def test_a_failure_is_logged_and_ends_nothing(monkeypatch, caplog):
    monkeypatch.setattr(compiling, "machine_code_stored", lambda _: False)
    monkeypatch.setattr(compiling.sys, "executable", shutil.which("false"))
    with caplog.at_level(logging.WARNING):
        compile_if_missing(lambda _: None, np.zeros((1, 1), dtype=np.uint8))
    assert "compiling ahead failed" in caplog.text


def test_an_interrupt_leaves_no_process(monkeypatch):
    monkeypatch.setattr(compiling, "machine_code_stored", lambda _: False)
    started = []

    class Interrupted(subprocess.Popen):
        def __init__(self, *args, **kwargs):
            super().__init__([sys.executable, "-c", "import time; time.sleep(60)"], **kwargs)
            started.append(self)

        def communicate(self, *args, **kwargs):
            raise KeyboardInterrupt

    monkeypatch.setattr(compiling.subprocess, "Popen", Interrupted)
    with pytest.raises(KeyboardInterrupt):
        compile_if_missing(lambda _: None, np.zeros((1, 1), dtype=np.uint8))
    assert len(started) == len(TASKS)
    assert all(process.returncode is not None for process in started)
