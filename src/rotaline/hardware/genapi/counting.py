"""From the frame ids of a transport to one count of exposures."""

_LAST_OF_16_BITS = 65535


class FrameCounter:
    """Counts on over every stream of a camera; a gap in the ids is a gap in the numbers.

    GigE Vision counts blocks from 1 to 65535 and begins again with 1: 0 is left out. Cameras with extended ids, and USB3 Vision, count in
    64 bit. ``wraps``: ids may be of 16 bit; they are taken as such until one is greater.
    """

    def __init__(self, wraps: bool) -> None:
        self._wraps = wraps
        self._last_id: int | None = None
        self._number = -1

    def restart(self) -> None:
        """A stream begins, and its ids with it: the next frame has the next number, whatever its id."""
        self._last_id = None

    def number(self, frame_id: int | None) -> int | None:
        """The number of the frame; None: it is older than the one before, and counted as lost already.

        A camera that gives no ids, or always the same, is counted here: then no gap is seen.
        """
        step = self._step(frame_id)
        if step < 0:
            return None
        self._last_id = frame_id
        self._number += max(step, 1)
        return self._number

    def _step(self, frame_id: int | None) -> int:
        if frame_id is None or self._last_id is None:
            return 1
        if frame_id > _LAST_OF_16_BITS:
            self._wraps = False
        step = frame_id - self._last_id
        if not self._wraps:
            return step
        step %= _LAST_OF_16_BITS
        return step if step <= _LAST_OF_16_BITS // 2 else -1
