"""What a value was at any time in the past: a camera that streams hands out frames long after they were exposed."""

from bisect import bisect_right
from typing import Generic, TypeVar

T = TypeVar("T")


class History(Generic[T]):
    """A value that changes at moments; nothing is forgotten."""

    def __init__(self, value: T) -> None:
        self._times_s: list[float] = [float("-inf")]
        self._values: list[T] = [value]

    def put(self, time_s: float, value: T) -> None:
        """From this moment on it is so; what was said of later moments no longer holds."""
        keep = bisect_right(self._times_s, time_s)
        self._times_s[keep:] = [time_s]
        self._values[keep:] = [value]

    def at(self, time_s: float) -> T:
        """The value at a moment."""
        return self._values[bisect_right(self._times_s, time_s) - 1]
