"""How the stages of a calibration are done: computed at once, or taken from the store where they are still valid."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

from rotaline.errors import CalibrationError, DetectionError, GeometryError
from rotaline.io.report.contents import STAGES, StageWarning
from rotaline.pipeline.observer import Observer
from rotaline.pipeline.store import StageStore, key_of

T = TypeVar("T")


class StageRunner:
    """Computes every stage; ``warnings`` collects what makes results doubtful, in the order in which it was found."""

    def __init__(self) -> None:
        self.warnings: list[StageWarning] = []

    def run(self, name: str, title: str, needs: Sequence[str], options: Any, compute: Callable[[], T]) -> T:
        """The result of a stage.

        Parameters
        ----------
        name : of the stage; other stages name it in their ``needs``
        title : for people
        needs : the stages and the parts of the observations that the result is made from
        options : of the stage, and whatever else the result depends on
        compute : makes the result
        """
        return compute()

    def attempt(
        self, name: str, title: str, needs: Sequence[str], options: Any, compute: Callable[[], T], stage: str = ""
    ) -> T | None:
        """The result of a stage; None if it fails, with a serious warning of ``stage`` (default: ``name``)."""
        try:
            return self.run(name, title, needs, options, compute)
        except (CalibrationError, DetectionError, GeometryError) as error:
            self.warn(stage or name, str(error), serious=True)
            return None

    def warn(self, stage: str, text: str, serious: bool = False) -> None:
        """Something that makes a result doubtful; ``stage`` is one of :data:`rotaline.io.report.contents.STAGES`."""
        self.warnings.append(StageWarning(stage, text, serious))

    def note(self, text: str) -> None:
        """A figure worth showing at once."""


class StoredStageRunner(StageRunner):
    """Takes stages from a store where their inputs did not change, and tells an observer; ``keys`` has a key of every input."""

    def __init__(self, store: StageStore, observer: Observer) -> None:
        super().__init__()
        self._store = store
        self._observer = observer
        self.keys: dict[str, str] = {}

    def run(self, name: str, title: str, needs: Sequence[str], options: Any, compute: Callable[[], T]) -> T:
        """The stored result if everything that it depends on is as it was, else a new one."""
        self.keys[name] = key_of([self.keys[need] for need in needs], options)
        return self._store.get(name, title, self.keys[name], compute)

    def warn(self, stage: str, text: str, serious: bool = False) -> None:
        """Collect the warning and tell the observer."""
        super().warn(stage, text, serious)
        self._observer.warning(f"{STAGES[stage]}: {text}")

    def note(self, text: str) -> None:
        """Tell the observer."""
        self._observer.note(text)
