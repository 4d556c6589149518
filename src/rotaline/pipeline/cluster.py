"""Work on a dask cluster: the only place that knows dask.

A worker that dies is the scheduler's affair: what it had is done again by others. Everything else ends in a sentence: no scheduler, no worker,
a scheduler that is gone, a program that is not installed there.
"""

import asyncio
import logging
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import CancelledError
from contextlib import suppress
from itertools import islice
from typing import Any, TypeVar
from uuid import uuid4

from rotaline import __version__
from rotaline.errors import RotalineError, SessionError, WorkError
from rotaline.pipeline.workers import AHEAD, MOST_ATTEMPTS

A = TypeVar("A")
B = TypeVar("B")

CONNECT_S = 20.0
"""So long the scheduler may take to answer."""
NO_WORKER_S = 60.0
"""So long there may be no worker: one that died may be started anew."""
_CHECK_S = 5.0


class ClusterWorkers:
    """The workers of a dask scheduler at ``address``, for example ``tcp://10.0.0.5:8786``.

    Raises
    ------
    WorkError
        If dask is not installed here, or no scheduler answers there.
    """

    def __init__(self, address: str, connect_s: float = CONNECT_S, no_worker_s: float = NO_WORKER_S) -> None:
        try:
            from distributed import Client
            from distributed.comm import connect
        except ImportError as error:
            raise WorkError("--cluster needs dask, which is not installed: pip install 'rotaline[cluster]'.") from error
        for name in list(logging.root.manager.loggerDict):
            if name.startswith(("distributed", "tornado")):  # what they would print is said in sentences below
                logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        self._address = address
        self._connect_s = connect_s
        self._no_worker_s = no_worker_s
        try:
            asyncio.run(_reach(connect, address, connect_s))  # a client that fails to connect lingers
            self._client: Any = Client(
                address, timeout=connect_s, set_as_default=False, direct_to_workers=True, name="rotaline"
            )
        except (OSError, ValueError, TypeError) as error:
            raise WorkError(
                f"no dask scheduler answers at {address} ({error or type(error).__name__}). Expected an address such as "
                "tcp://10.0.0.5:8786, as `dask scheduler` prints it when it starts."
            ) from error

    def run(self, function: Callable[[A], B], tasks: Iterable[A]) -> Generator[B, None, None]:
        """See :class:`rotaline.pipeline.workers.Workers`."""
        remaining = iter(tasks)
        waiting: deque[tuple[A, Any]] = deque()
        n_threads = 0
        try:
            while True:
                for task in islice(remaining, AHEAD * max(n_threads, 1) - len(waiting)):
                    n_threads = n_threads or self._wait_for_threads()
                    waiting.append((task, self._submit(function, task)))
                if not waiting:
                    return
                result = self._result(*waiting[0])
                waiting.popleft()[1].release()
                yield result
        finally:
            for _, future in waiting:
                future.release()

    def close(self) -> None:
        """Leave the cluster."""
        self._client.close(timeout=2)

    def _submit(self, function: Callable[[A], B], task: A) -> Any:
        # a key of its own: a scheduler that knows the result of an equal call would give it back without work
        return self._client.submit(function, task, key=f"rotaline-{uuid4().hex}", retries=MOST_ATTEMPTS - 1)

    def _wait_for_threads(self) -> int:
        """Threads of all workers, as soon as there is one."""
        start = time.monotonic()
        while True:
            threads = sum(self._ask_threads().values())
            if threads:
                return threads
            if time.monotonic() - start > self._no_worker_s:
                raise self._no_worker()
            with suppress(TimeoutError):
                self._client.wait_for_workers(1, timeout=min(_CHECK_S, self._no_worker_s))

    def _ask_threads(self) -> dict[str, int]:
        """Threads of each worker, as the scheduler knows them now."""
        if self._client.status != "running":
            raise self._lost()
        try:
            threads: dict[str, int] = self._client.sync(self._client.scheduler.ncores, callback_timeout=self._connect_s)
        except (OSError, TimeoutError, CancelledError) as error:
            raise self._lost() from error
        return threads

    def _result(self, task: A, future: Any) -> Any:
        """The result of a task; while there is none, whether there may still be one is looked at again and again."""
        from distributed.scheduler import KilledWorker

        worked = time.monotonic()
        while True:
            try:
                return future.result(timeout=_CHECK_S)
            except TimeoutError as error:
                if future.status == "error":
                    raise WorkError(f"{task}: {error} (on a worker of {self._address})") from error
            except CancelledError as error:
                raise self._lost() from error
            except KilledWorker as error:
                raise WorkError(
                    f"{task}: the workers of {self._address} that worked on this died, again and again. Memory may be short "
                    "there: give each worker more of it, or fewer threads. Their log may say more."
                ) from error
            except SessionError as error:
                raise SessionError(
                    f"{error}\nThis was on a worker of {self._address}: does it see the same files?"
                ) from error
            except RotalineError:
                raise
            except (ImportError, AttributeError, RuntimeError) as error:
                if isinstance(error, RuntimeError) and "deserialization" not in str(error):
                    raise
                raise WorkError(
                    f"{task}: scheduler or workers of {self._address} cannot load this program ({error}). Install rotaline {__version__} "
                    "on all machines, the same as here, and start them again."
                ) from error
            if self._ask_threads():
                worked = time.monotonic()
            elif time.monotonic() - worked > self._no_worker_s:
                raise self._no_worker()

    def _lost(self) -> WorkError:
        return WorkError(
            f"the dask scheduler at {self._address} is gone: the connection was lost. Start it and its workers again, or work without --cluster."
        )

    def _no_worker(self) -> WorkError:
        return WorkError(
            f"the dask scheduler at {self._address} has had no worker for {self._no_worker_s:.0f} s. "
            f"Start some: dask worker {self._address}"
        )


async def _reach(connect: Callable[..., Any], address: str, timeout: float) -> None:
    comm = await connect(address, timeout=timeout)
    await comm.close()
