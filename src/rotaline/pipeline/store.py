"""Results of stages in the results folder, so that a run goes on where it stopped.

The file name holds a key of everything that the result depends on: the program itself, the input files (name, size, time of
change), the options of the stage and the keys of the stages before it.
"""

import hashlib
import json
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

from rotaline import __version__
from rotaline.errors import SessionError
from rotaline.io.files import make_folder, output_error
from rotaline.io.frame_images import ImageSource, source_state
from rotaline.io.records import read_record, write_record
from rotaline.pipeline.observer import LOG, Observer

T = TypeVar("T")


@cache
def _program_key() -> str:
    """A key of the program's own source: another version, or a changed line, makes stored results void."""
    digest = hashlib.sha256(__version__.encode())
    for path in sorted(Path(__file__).parents[1].rglob("*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()


def key_of(*parts: Any) -> str:
    """A key of values: text, numbers, tuples, dataclasses of those."""
    text = json.dumps(
        [_program_key(), *parts],
        default=lambda v: asdict(v) if is_dataclass(v) and not isinstance(v, type) else str(v),
        sort_keys=True,
    )
    return hashlib.sha256(text.encode()).hexdigest()[:16]


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
    inputs or options stay until :meth:`forget_unused`.
    """

    def __init__(self, folder: Path, observer: Observer, force: bool = False, keep_variants: bool = False) -> None:
        self._folder = folder
        self._observer = observer
        self._force = force
        self._keep_variants = keep_variants
        self._used: set[Path] = set()
        self._known: dict[str, tuple[str, Any]] = {}
        self.seconds: dict[str, float] = {}
        make_folder(folder)

    def get(self, name: str, title: str, key: str, compute: Callable[[], T]) -> T:
        """The stored result of a stage, or a new one, which is stored before it is given back."""
        known = self._known.get(name)
        if known is not None and known[0] == key:
            return known[1]
        value = self._stored_or_new(self._folder / f"{name.replace('/', '_')}.{key}.npz", title, compute)
        self._known[name] = (key, value)
        return value

    def latest(self, name: str) -> Any:
        """The result that this run has of a stage, or None."""
        return self._known.get(name, (None, None))[1]

    def forget_unused(self) -> None:
        """Remove results that nothing has asked for since the store was opened.

        Raises
        ------
        OutputError
            If they cannot be removed.
        """
        self._remove(path for path in self._folder.glob("*.npz") if path not in self._used)

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
        start = time.perf_counter()
        value = compute()
        self.seconds[title] = time.perf_counter() - start
        LOG.info("%s took %.2f s", title, self.seconds[title])
        write_record(path, StageResult(self.seconds[title], value))
        if not self._keep_variants:
            name = path.name.split(".")[0]
            self._remove(other for other in self._folder.glob(f"{name}.*.npz") if other != path)
        return value

    def _remove(self, paths: Iterable[Path]) -> None:
        try:
            for path in list(paths):
                path.unlink()
        except OSError as error:
            raise output_error(self._folder, error) from error


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
