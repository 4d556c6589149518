"""Many independent units of work in a few processes; what is done is kept, so that the same command goes on where it stopped."""

import signal
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

from rotaline.errors import SessionError
from rotaline.io.records import read_record, write_record
from rotaline.pipeline.observer import LOG, Observer
from rotaline.pipeline.store import key_of

T = TypeVar("T")


@dataclass(frozen=True)
class WorkPlan:
    """How units of work are done.

    Attributes
    ----------
    jobs : processes; 1: in this one
    folder : where results of units are kept; None: nowhere
    observer : counts the units
    """

    jobs: int
    folder: Path | None
    observer: Observer

    def do(self, label: str, work: Callable[[Any], T], units: Mapping[str, Any]) -> list[T]:
        """The result of every unit, in their order.

        Parameters
        ----------
        label : for the progress bar; results are kept under it
        work : a function of a module, so that another process can call it; its results are trees of dataclasses that a record holds
        units : its arguments by name; a kept result counts as long as program, label and argument are the same
        """
        paths = {name: self._path(label, name, unit) for name, unit in units.items()}
        done = {name: _stored(path) for name, path in paths.items() if path is not None and path.is_file()}
        done = {name: result for name, result in done.items() if result is not None}
        missing = {name: unit for name, unit in units.items() if name not in done}
        with self.observer.work(label, len(units)) as count:
            for _ in done:
                count()
            for name, result in _results(work, missing, self.jobs):
                path = paths[name]
                if path is not None:
                    _keep(path, result)
                done[name] = result
                count()
        return [done[name] for name in units]

    def _path(self, label: str, name: str, unit: Any) -> Path | None:
        if self.folder is None:
            return None
        stem = f"{label}-{name}".replace(" ", "-").replace(".", "_")
        return self.folder / "realisations" / f"{stem}.{key_of(label, unit)}.npz"


def _stored(path: Path) -> Any:
    try:
        return read_record(path)
    except SessionError as error:
        LOG.warning("%s", error)
        return None


def _keep(path: Path, result: Any) -> None:
    """In place of what other versions of the program left."""
    write_record(path, result)
    for other in path.parent.glob(f"{path.name.split('.')[0]}.*.npz"):
        if other != path:
            other.unlink()


def _results(work: Callable[[Any], T], units: Mapping[str, Any], jobs: int) -> Iterator[tuple[str, T]]:
    """Results as they come, in any order; leaving early ends the processes."""
    tasks = [(name, work, unit) for name, unit in units.items()]
    if jobs == 1 or len(tasks) < 2:
        yield from map(_named, tasks)
        return
    # a new process each: threads of the linear algebra do not survive a fork
    with get_context("spawn").Pool(min(jobs, len(tasks)), initializer=_leave_interrupts_to_parent) as pool:
        yield from pool.imap_unordered(_named, tasks)


def _named(task: tuple[str, Callable[[Any], T], Any]) -> tuple[str, T]:
    name, work, unit = task
    return name, work(unit)


def _leave_interrupts_to_parent() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
