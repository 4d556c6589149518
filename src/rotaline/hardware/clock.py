"""The time that devices go by: handed to them, so that tests and the simulated rig need not wait."""

import time
from typing import Protocol, runtime_checkable


@runtime_checkable
class Clock(Protocol):
    """Time that only goes forward."""

    def now_s(self) -> float:
        """Seconds since some moment in the past; differences count."""

    def wait(self, seconds: float) -> None:
        """Return when so much time has gone by."""


class SystemClock:
    """The time of this machine."""

    def now_s(self) -> float:
        """Seconds, monotonic."""
        return time.monotonic()

    def wait(self, seconds: float) -> None:
        """Sleep."""
        time.sleep(max(seconds, 0.0))


class VirtualClock:
    """Time that goes by only where somebody waits: waiting costs nothing."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = start_s

    def now_s(self) -> float:
        """Seconds since it was made, and the start."""
        return self._now_s

    def wait(self, seconds: float) -> None:
        """Let the time go by at once."""
        self._now_s += max(seconds, 0.0)
