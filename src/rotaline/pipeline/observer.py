"""How the pipeline tells what it is doing, without knowing who listens."""

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol, runtime_checkable

LOG = logging.getLogger("rotaline")


@runtime_checkable
class Observer(Protocol):
    """Listens to a run."""

    def stage(self, title: str, stored: bool) -> None:
        """A stage begins, or (``stored``) its result from an earlier run is taken."""

    def work(self, label: str, total: int) -> AbstractContextManager[Callable[[], None]]:
        """Work on ``total`` elements begins; the callable that the context gives counts one."""

    def note(self, text: str) -> None:
        """A figure worth showing at once."""

    def warning(self, text: str) -> None:
        """Something that makes a result doubtful."""


class Silent:
    """An observer for programs: everything goes to the log only."""

    def stage(self, title: str, stored: bool) -> None:
        """Log the stage."""
        LOG.info("%s%s", title, " (stored result)" if stored else "")

    def work(self, label: str, total: int) -> AbstractContextManager[Callable[[], None]]:
        """Log nothing."""
        return nullcontext(lambda: None)

    def note(self, text: str) -> None:
        """Log the figure."""
        LOG.info("%s", text)

    def warning(self, text: str) -> None:
        """Log the warning."""
        LOG.warning("%s", text)
