"""Results of stages in the results folder, so that a run goes on where it stopped.

The file name holds a key of everything that the result depends on: the program itself, the input files (name, size, time of
change), the options of the stage and the keys of the stages before it. A stage that is done piece by piece has a folder of such a name, with a
file for each piece.
"""

import hashlib
import json
import shutil
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from rotaline import __version__
from rotaline.errors import SessionError
from rotaline.io.files import make_folder, output_error
from rotaline.io.frame_images import ImageSource, source_state
from rotaline.io.records import read_record, write_record
from rotaline.pipeline.observer import LOG, Observer
from rotaline.pipeline.workers import ThreadWorkers, Workers

T = TypeVar("T")


@cache
def program_key() -> str:
    """A key of the program's own source: another version, or a changed line, makes stored results void."""
    digest = hashlib.sha256(__version__.encode())
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def key_of(*parts: Any) -> str:
    """A key of values: text, numbers, tuples, arrays, dataclasses of those."""
    text = json.dumps([program_key(), *parts], default=_plain, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _plain(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else str(value)


def sources_key(sources: Iterable[ImageSource]) -> str:
    """A key of images: their names, sizes and times of change."""
    return key_of([source_state(source) for source in sources])


@dataclass(frozen=True, eq=False)
class StageResult:
    """What is stored of a stage."""

    seconds: float
    value: Any


class StageStore:
    """Stored stage results in ``folder``; with ``force`` they are made again.

    A new result of a stage takes the place of an older one, unless ``keep_variants``: then results of the same stage with other
    inputs or options stay until :meth:`forget_unused`. ``workers`` do the stages that are made of pieces; ``opened`` holds what lives as long
    as the store.
    """

    def __init__(
        self,
        folder: Path,
        observer: Observer,
        force: bool = False,
        keep_variants: bool = False,
        workers: Workers | None = None,
    ) -> None:
        self.workers = workers or ThreadWorkers()
        self._folder = folder
        self._observer = observer
        self._force = force
        self._keep_variants = keep_variants
        self._used: set[Path] = set()
        self._known: dict[str, tuple[str, Any]] = {}
        self.opened: dict[Any, Any] = {}
        self.seconds: dict[str, float] = {}
        make_folder(folder)

    def get(self, name: str, title: str, key: str, compute: Callable[[], T]) -> T:
        """The stored result of a stage, or a new one, which is stored before it is given back."""
        known = self._known.get(name)
        if known is not None and known[0] == key:
            return known[1]
        return self.keep(name, key, self._stored_or_new(self._path(name, key), title, compute))

    def latest(self, name: str) -> Any:
        """The result that this run has of a stage, or None."""
        return self._known.get(name, (None, None))[1]

    def keep(self, name: str, key: str, value: T) -> T:
        """Make ``value`` the result that this run has of a stage."""
        self._known[name] = (key, value)
        return value

    def pieces(self, name: str, key: str) -> "StoredPieces":
        """The pieces of a stage that are stored."""
        folder = self._path(name, key, "")
        if self._force and folder not in self._used and folder.is_dir():
            self._remove([folder])
        self._used.add(folder)
        return StoredPieces(folder)

    def pieces_complete(self, name: str, key: str) -> None:
        """All pieces of a stage are there: they take the place of older ones."""
        self._replace_older(self._path(name, key, ""))

    @contextmanager
    def timed(self, title: str) -> Iterator[None]:
        """Keep and log the time of what is done in the block."""
        start = time.perf_counter()
        yield
        self.took(title, time.perf_counter() - start)

    def took(self, title: str, seconds: float, earlier: float = 0.0) -> None:
        """Log the time that a stage took, and keep it together with what pieces of it took in an ``earlier`` run."""
        LOG.info("%s took %.2f s", title, seconds)
        self.seconds[title] = earlier + seconds

    def forget_unused(self) -> None:
        """Remove results that nothing has asked for since the store was opened.

        Raises
        ------
        OutputError
            If they cannot be removed.
        """
        self._remove(path for path in self._folder.iterdir() if _stage_of(path) and path not in self._used)

    def _path(self, name: str, key: str, suffix: str = ".npz") -> Path:
        return self._folder / f"{name.replace('/', '_')}.{key}{suffix}"

    def _stored_or_new(self, path: Path, title: str, compute: Callable[[], T]) -> T:
        self._used.add(path)
        if path.is_file() and not self._force:
            try:
                stored: StageResult = read_record(path)
            except SessionError as error:
                LOG.warning("%s", error)
            else:
                self._observer.stage(title, stored=True)
                self.seconds[title] = stored.seconds
                return stored.value
        self._observer.stage(title, stored=False)
        with self.timed(title):
            value = compute()
        write_record(path, StageResult(self.seconds[title], value))
        self._replace_older(path)
        return value

    def _replace_older(self, path: Path) -> None:
        if not self._keep_variants:
            stage = _stage_of(path)
            self._remove(other for other in self._folder.iterdir() if other != path and _stage_of(other) == stage)

    def _remove(self, paths: Iterable[Path]) -> None:
        try:
            for path in list(paths):
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink()
        except OSError as error:
            raise output_error(self._folder, error) from error


def _stage_of(path: Path) -> str:
    """The name of the stage of a stored result; empty for other files."""
    if path.suffix != ".npz" and not path.is_dir():
        return ""
    return path.name.removesuffix(".npz").rpartition(".")[0]


@dataclass(frozen=True)
class StoredPieces:
    """The pieces of a stage in ``folder``, numbered; each is there as a whole or not at all."""

    folder: Path

    def has(self, number: int) -> bool:
        """The piece is there."""
        return self._path(number).is_file()

    def read(self, number: int) -> StageResult:
        """The piece and the seconds that it took.

        Raises
        ------
        SessionError
            If it is damaged.
        """
        result = read_record(self._path(number))
        assert isinstance(result, StageResult)
        return result

    def write(self, number: int, result: StageResult) -> None:
        """Store a piece."""
        write_record(self._path(number), result)

    def _path(self, number: int) -> Path:
        return self.folder / f"{number:08d}.npz"


def check_writable(folder: Path) -> None:
    """Fail at once, not after an hour's work, if results cannot be written.

    Raises
    ------
    OutputError
        If a file cannot be written in ``folder``.
    """
    make_folder(folder)
    probe = folder / ".write-test"
    try:
        probe.write_bytes(b"0" * 4096)
    except OSError as error:
        raise output_error(folder, error) from error
    finally:
        probe.unlink(missing_ok=True)
