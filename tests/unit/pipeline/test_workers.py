"""Order, bounded numbers, errors and deaths, with tasks that are expressions: ``eval`` is a function that every process knows."""

import os
import signal
import sys
import threading
from multiprocessing import active_children

import numpy as np
import pytest

from rotaline.errors import SessionError, WorkError
from rotaline.pipeline.cluster import ClusterWorkers
from rotaline.pipeline.workers import AHEAD, ProcessWorkers, ThreadWorkers

DIE = "__import__('os')._exit(1)"


def _counted(n, taken):
    for i in range(n):
        taken.append(i)
        yield i


def test_threads_give_results_in_order_with_few_tasks_under_way():
    taken = []
    for i, result in enumerate(ThreadWorkers(2).run(lambda x: x * x, _counted(50, taken))):
        assert result == i * i
        assert len(taken) <= i + 2 * AHEAD
    assert len(taken) == 50


def test_an_error_ends_the_work_and_what_was_not_under_way_never_begins():
    begun = []

    def work(x):
        begun.append(x)
        if x == 0:
            raise SessionError("x")

    with pytest.raises(SessionError):
        list(ThreadWorkers(1).run(work, range(50)))
    assert begun == list(range(len(begun)))
    assert len(begun) <= AHEAD


def test_processes_give_results_in_order_and_pass_errors_on():
    workers = ProcessWorkers(2)
    assert list(workers.run(eval, [f"{i}**2" for i in range(20)])) == [i**2 for i in range(20)]
    with pytest.raises(ZeroDivisionError):
        list(workers.run(eval, ["1", "1/0", "2"]))
    assert list(workers.run(eval, ["3"])) == [3]
    workers.close()
    assert not active_children()


def test_the_task_that_ends_its_process_each_time_is_the_one_that_is_named():
    workers = ProcessWorkers(2)
    results = workers.run(eval, ["1", "2", DIE, "3", "4"])
    assert [next(results), next(results)] == [1, 2]
    with pytest.raises(WorkError, match="_exit") as caught:
        next(results)
    assert "3 times" in str(caught.value)
    assert "Memory may be short" in str(caught.value)
    workers.close()


def test_a_task_whose_process_died_once_is_done_again(tmp_path):
    mark = tmp_path / "died"
    once = f"__import__('os').path.exists({str(mark)!r}) or (open({str(mark)!r}, 'w').close(), {DIE})"
    workers = ProcessWorkers(2)
    assert list(workers.run(eval, [*"0123", once, *"5678"])) == [0, 1, 2, 3, True, 5, 6, 7, 8]
    workers.close()


@pytest.mark.parametrize("which", [0, 1])
def test_a_process_that_is_killed_while_it_has_nothing_to_do_harms_nothing(which):
    workers = ProcessWorkers(2)
    assert list(workers.run(eval, [*"01234567"])) == list(range(8))
    children = active_children()
    os.kill(children[which % len(children)].pid, signal.SIGKILL)
    assert list(workers.run(eval, [*"01234567"])) == list(range(8))
    os.kill(active_children()[0].pid, signal.SIGKILL)
    workers.close()
    assert not active_children()


def test_processes_that_are_killed_at_whatever_moment_change_nothing():
    """At the start, while a task or a result is on its way, at work, between tasks, at the end."""
    expected = [i * b"x" * 1000 for i in range(60)]
    tasks = [f"__import__('time').sleep({i % 3} / 50) or {i} * b'x' * 1000" for i in range(60)]
    random = np.random.default_rng(5)
    killed = []
    for _ in range(3):
        workers = ProcessWorkers(2)
        ended = threading.Event()

        def kill_now_and_then(ended=ended):
            # more than a process takes to start: no task meets three deaths
            while not ended.wait(0.3 + 0.2 * random.random()):
                for child in active_children()[:1]:
                    os.kill(child.pid, signal.SIGKILL)
                    killed.append(child.pid)

        killer = threading.Thread(target=kill_now_and_then)
        killer.start()
        assert list(workers.run(eval, tasks)) == expected
        assert list(workers.run(eval, tasks)) == expected
        ended.set()
        killer.join()
        workers.close()
        assert not active_children()
    assert len(killed) > 3


def test_what_cannot_be_sent_is_an_error_and_no_death():
    workers = ProcessWorkers(1)
    with pytest.raises(Exception, match="lambda"):
        list(workers.run(eval, ["lambda: 0"]))
    with pytest.raises(Exception, match="lambda"):
        list(workers.run(lambda x: x, ["0"]))
    assert list(workers.run(eval, ["3"])) == [3]
    workers.close()
    assert not active_children()


def test_without_dask_the_line_that_installs_it_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(WorkError, match=r"pip install 'rotaline\[cluster\]'"):
        ClusterWorkers("tcp://127.0.0.1:8786")
