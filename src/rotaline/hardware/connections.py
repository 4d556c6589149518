"""What several devices of a rig have in common: one serial port, one simulated world. Opened once, closed last."""

from collections.abc import Callable, Hashable
from typing import Any, TypeVar

T = TypeVar("T")


class Connections:
    """Things that are opened by the first device that needs them, and closed together, the last one first."""

    def __init__(self) -> None:
        self._open: dict[Hashable, Any] = {}

    def provide(self, name: Hashable, thing: Any) -> None:
        """Put something there under a name, for the devices that are opened later."""
        self._open[name] = thing

    def get(self, name: Hashable) -> Any:
        """What was provided or opened under this name; None: nothing was."""
        return self._open.get(name)

    def shared(self, name: Hashable, make: Callable[[], T]) -> T:
        """What the first caller made, for everybody who asks by the same name."""
        if name not in self._open:
            self._open[name] = make()
        return self._open[name]

    def close(self) -> None:
        """Close all that has a ``close``, the last one first; never raises."""
        for thing in reversed(list(self._open.values())):
            try:
                close = getattr(thing, "close", None)
                if close is not None:
                    close()
            except Exception:
                continue  # the others shall be closed as well
        self._open.clear()
