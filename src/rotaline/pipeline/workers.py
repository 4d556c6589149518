"""Where work is done: threads of this process or processes of this machine (a cluster: :mod:`rotaline.pipeline.cluster`).

All give the results of a function in the order of its tasks, with few tasks under way at a time, so that memory does not grow with their number.
Leaving early, by an error or an interrupt, cancels what has not begun.
"""

import os
import signal
import threading
import traceback
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from itertools import islice
from multiprocessing import get_context, parent_process, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.reduction import ForkingPickler
from typing import Any, Protocol, TypeVar, runtime_checkable

from rotaline.errors import WorkError
from rotaline.pipeline.observer import LOG

A = TypeVar("A")
B = TypeVar("B")

AHEAD = 3
"""Tasks under way for each worker: one is done, the others wait so that no worker waits."""
_END_S = 10.0
"""So long a process that has nothing to do may take to end."""
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
    """Processes of this machine; they start when there is work, stay until :meth:`close`, and end when this process ends.

    Each process has a connection of its own and shares no queue and no lock with the others, so that one that is killed, at whatever moment,
    is noticed by the thread that waits for it and by nobody else.
    """

    def __init__(self, n: int) -> None:
        self._n = n
        self._idle: list[_Process] = []

    def run(self, function: Callable[[A], B], tasks: Iterable[A]) -> Generator[B, None, None]:
        """See :class:`Workers`; when a process dies, another one does again what it was doing."""
        return ThreadWorkers(self._n).run(partial(self._do, function), tasks)

    def close(self) -> None:
        """End the processes."""
        idle, self._idle = self._idle, []
        for process in idle:
            process.close()

    def _do(self, function: Callable[[A], B], task: A) -> B:
        """The result of one task; a thread waits for it."""
        for _ in range(MOST_ATTEMPTS):
            process = self._idle.pop() if self._idle else _Process()
            try:
                done, result = process.do(function, task)
            except _ProcessDiedError:
                process.close()
                LOG.warning("a worker process died; its work is done again")
                continue
            except BaseException:
                process.close()
                raise
            self._idle.append(process)
            if done:
                return result
            raise result
        raise WorkError(
            f"{task}: the process that worked on this died {MOST_ATTEMPTS} times. Memory may be short: "
            f"close other programs, or start the same command again with fewer processes than --workers {self._n}."
        )


class _ProcessDiedError(Exception):
    """The process at the other end is gone."""


class _Process:
    """A process that does one task after the other."""

    _starting = threading.Lock()

    def __init__(self) -> None:
        context = get_context("spawn")  # threads of the linear algebra do not survive a fork
        self._connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
        with self._starting:
            resource_tracker.ensure_running()  # which lets interrupts through when it starts
            with _interrupts_stay_here():
                self._process.start()
        theirs.close()  # or else its end would not be noticed

    def do(self, function: Callable[[A], B], task: A) -> "tuple[bool, Any]":
        """Whether it was done, and the result or else the error."""
        try:
            self._connection.send((function, task))
            answer: tuple[bool, Any] = self._connection.recv()
        except (EOFError, OSError) as error:
            raise _ProcessDiedError from error
        return answer

    def close(self) -> None:
        """End it, which does nothing or is dead."""
        self._connection.close()
        self._process.join(_END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._process.close()


@contextmanager
def _interrupts_stay_here() -> Iterator[None]:
    """Processes that are started meanwhile are not interrupted by Ctrl-C: this process ends them."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(connection: Connection) -> None:
    """Do tasks until there are no more."""
    _end_with_parent()
    while True:
        try:
            function, task = connection.recv()
        except EOFError:
            return
        try:
            answer = ForkingPickler.dumps((True, function(task)))
        except Exception as error:
            error.add_note(traceback.format_exc())
            answer = ForkingPickler.dumps((False, error))
        connection.send_bytes(answer)


def _end_with_parent() -> None:
    """However the parent ends, this process ends with it."""
    parent = parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
