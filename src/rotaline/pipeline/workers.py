"""Where work is done: threads of this process or processes of this machine (a cluster: :mod:`rotaline.pipeline.cluster`).

All give the results of a function in the order of its tasks, with few tasks under way at a time, so that memory does not grow with their number.
Leaving early, by an error or an interrupt, cancels what has not begun.
"""

import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from multiprocessing import get_context, parent_process
from typing import Any, Protocol, TypeVar, runtime_checkable

from rotaline.errors import WorkError
from rotaline.pipeline.observer import LOG

A = TypeVar("A")
B = TypeVar("B")

AHEAD = 3
"""Tasks under way for each worker: one is done, the others wait so that no worker waits."""
_LOOK_S = 0.05
"""While processes end, they are looked at so often."""
MOST_ATTEMPTS = 3
"""A task whose worker dies so many times is given up."""


@runtime_checkable
class Workers(Protocol):
    """Work on tasks; the same results in the same order, whoever does it."""

    def run(self, function: Callable[[A], B], tasks: Iterable[A]) -> Generator[B, None, None]:
        """``function`` of every task, in order.

        Parameters
        ----------
        function : of a module, so that other processes can call it
        tasks : taken when there is room for them; ``str(task)`` names one in messages

        Raises
        ------
        WorkError
            If those who work are gone, and the task cannot be done.
        """

    def close(self) -> None:
        """Let go of processes and connections."""


class ThreadWorkers:
    """Threads of this process: images are decoded and kernels run without its lock."""

    def __init__(self, n: int | None = None) -> None:
        self._n = n or os.cpu_count() or 1

    def run(self, function: Callable[[A], B], tasks: Iterable[A]) -> Generator[B, None, None]:
        """See :class:`Workers`."""
        waiting: deque[Future[B]] = deque()
        remaining = iter(tasks)
        with ThreadPoolExecutor(self._n) as pool:
            try:
                while True:
                    waiting.extend(
                        pool.submit(function, task) for task in islice(remaining, AHEAD * self._n - len(waiting))
                    )
                    if not waiting:
                        return
                    yield waiting.popleft().result()
            finally:
                for future in waiting:
                    future.cancel()

    def close(self) -> None:
        """Nothing is left open between runs."""


class ProcessWorkers:
    """Processes of this machine; they start with the first task, stay until :meth:`close`, and end when this process ends."""

    def __init__(self, n: int) -> None:
        self._n = n
        self._pool: ProcessPoolExecutor | None = None

    def run(self, function: Callable[[A], B], tasks: Iterable[A]) -> Generator[B, None, None]:
        """See :class:`Workers`; when a process dies, all are made anew and what was under way is done again."""
        remaining = iter(tasks)
        waiting: deque[_Attempt] = deque()
        try:
            while True:
                waiting.extend(_Attempt(task) for task in islice(remaining, AHEAD * self._n - len(waiting)))
                if not waiting:
                    return
                # once a task saw two deaths, it is alone under way: a third one is its own
                careful = max(attempt.deaths for attempt in waiting) >= MOST_ATTEMPTS - 1
                for attempt in islice(waiting, 1 if careful else len(waiting)):
                    if attempt.future is None:
                        attempt.future = self._submit(function, attempt.task)
                first = waiting[0]
                assert first.future is not None
                try:
                    result = first.future.result()
                except BrokenProcessPool:
                    self._start_again(waiting)
                    continue
                waiting.popleft()
                yield result
        finally:
            for attempt in waiting:
                if attempt.future is not None:
                    attempt.future.cancel()

    def close(self) -> None:
        """End the processes, after what they are doing; at once if one of them has died."""
        pool, self._pool = self._pool, None
        if pool is None:
            return
        processes = list(dict(pool._processes or {}).values())
        pool.shutdown(wait=False)
        while alive := [process for process in processes if process.is_alive()]:
            if any(process.exitcode for process in processes):
                # one that was killed may hold the lock of the queue: the others would wait for it for ever
                for process in alive:
                    process.terminate()
            alive[0].join(_LOOK_S)

    def _submit(self, function: Callable[[A], B], task: A) -> "Future[B]":
        if self._pool is None:
            # a new process each: threads of the linear algebra do not survive a fork
            self._pool = ProcessPoolExecutor(self._n, get_context("spawn"), initializer=_end_with_parent)
        with _interrupts_stay_here():
            try:
                return self._pool.submit(function, task)
            except BrokenProcessPool as error:
                broken: Future[B] = Future()
                broken.set_exception(error)
                return broken

    def _start_again(self, waiting: "Iterable[_Attempt]") -> None:
        self.close()
        for attempt in waiting:
            if attempt.future is None or not isinstance(attempt.future.exception(), BrokenProcessPool):
                continue
            attempt.future = None
            attempt.deaths += 1
            if attempt.deaths >= MOST_ATTEMPTS:
                raise WorkError(
                    f"{attempt.task}: the process that worked on this died {attempt.deaths} times. Memory may be short: "
                    f"close other programs, or start the same command again with fewer processes than --workers {self._n}."
                )
        LOG.warning("a worker process died; its work is done again")


class _Attempt:
    """A task under way."""

    def __init__(self, task: Any) -> None:
        self.task = task
        self.future: Future[Any] | None = None
        self.deaths = 0


@contextmanager
def _interrupts_stay_here() -> Iterator[None]:
    """Processes that are started meanwhile are not interrupted by Ctrl-C: this process ends them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _end_with_parent() -> None:
    """However the parent ends, this process ends with it."""
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
