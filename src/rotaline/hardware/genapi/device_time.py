"""The camera's clock against the program's.

Each thing that both clocks see bounds the offset between them: a latch of the camera's time happened between the question and the answer,
an exposure began after its trigger was sent, and ended before its frame arrived. The bounds are intersected; they widen with time, since
the clocks drift apart. What contradicts all that is known replaces it.
"""

import math

from rotaline.hardware.cameras.frame_times import ArrivalTimes
from rotaline.hardware.clock import Clock
from rotaline.hardware.genapi.features import Features, first_of

_DRIFT = 1e-4
"""Two quartz clocks differ by less, s/s."""
_LATCHES = ("GevTimestampControlLatch", "TimestampLatch")
_VALUES = ("GevTimestampValue", "TimestampLatchValue", "Timestamp")
_N_LATCHES = 4
_LATCH_AGAIN_S = 1.0
_LATENCY_S = 0.1
"""From the end of an exposure until its frame is here, at most, where there are no time stamps."""


class DeviceTime:
    """Bounds of ``program's time - camera's time``, s.

    Parameters
    ----------
    tick_hz : ticks of the camera's clock in a second
    """

    def __init__(self, tick_hz: float) -> None:
        self._tick_hz = tick_hz
        self._bounds: tuple[float, float] | None = None
        self._offset_s: float | None = None
        self._ticks = 0

    def observe(self, ticks: int, earliest_s: float, latest_s: float) -> bool:
        """The camera's clock showed ``ticks`` between two times of the program; False: that contradicts what was known, and replaces it."""
        low, high = (self._since_observed(ticks, t) for t in (earliest_s, latest_s))
        known = self._bounds_at(ticks)
        both = (max(low, known[0]), min(high, known[1]))
        fits = both[0] <= both[1]
        low, high = self._bounds = both if fits else (low, high)
        # it moves no further than it has to, or else one frame would seem to come before the one before
        self._offset_s = min(max((low + high) / 2 if self._offset_s is None else self._offset_s, low), high)
        self._ticks = ticks
        return fits

    def time_s(self, ticks: int) -> tuple[float, float]:
        """The program's time at a time of the camera, and its standard uncertainty: of a uniform distribution between the bounds, and how far from their middle the time is."""
        low, high = self._bounds_at(ticks)
        offset_s = (low + high) / 2 if self._offset_s is None else self._offset_s
        return self._seconds(ticks) + offset_s, math.hypot((high - low) / math.sqrt(12), offset_s - (low + high) / 2)

    def _seconds(self, ticks: int) -> float:
        return ticks / self._tick_hz

    def _since_observed(self, ticks: int, time_s: float) -> float:
        return time_s - self._seconds(ticks)

    def _bounds_at(self, ticks: int) -> tuple[float, float]:
        if self._bounds is None:
            return -math.inf, math.inf
        drift_s = _DRIFT * abs(ticks - self._ticks) / self._tick_hz
        return self._bounds[0] - drift_s, self._bounds[1] + drift_s


def tick_hz(features: Features) -> float:
    """Ticks of the camera's clock in a second; where it does not say, nanoseconds, as the standard has it since version 2."""
    if features.has("GevTimestampTickFrequency"):
        return float(features.get("GevTimestampTickFrequency")) or 1e9
    return 1e9


def read_latch(features: Features, clock: Clock) -> tuple[int, float, float] | None:
    """The camera's time, and the program's before and after it was latched: the narrowest of some; None: it has no latch."""
    latch, value = first_of(features, _LATCHES), first_of(features, _VALUES)
    if latch is None or value is None:
        return None
    best: tuple[int, float, float] | None = None
    for _ in range(_N_LATCHES):
        before_s = clock.now_s()
        features.execute(latch)
        after_s = clock.now_s()
        ticks = int(features.get(value))
        if best is None or after_s - before_s < best[2] - best[1]:
            best = ticks, before_s, after_s
    return best


class FrameTimes:
    """Times of frames by the program's clock: from the camera's stamps where it gives some, else from when they arrive.

    A camera whose latch counts otherwise than the stamps of its frames is taken by the stamps, the triggers and the arrivals alone.

    Parameters
    ----------
    stamp_at_end : the stamp is that of the end of the exposure, not of its begin
    """

    def __init__(self, features: Features, clock: Clock, stamp_at_end: bool) -> None:
        self._features = features
        self._clock = clock
        self._at_end = stamp_at_end
        self._device_time: DeviceTime | None = None
        self._latched_s = -math.inf
        self._use_latch = True
        self._begun_s = clock.now_s()
        self._arrivals = ArrivalTimes(clock, _LATENCY_S)

    def begun(self) -> None:
        """The next exposure begins after this moment: the camera is triggered, or begins to stream."""
        self._begun_s = self._clock.now_s()
        self._arrivals.begun()

    def none_waiting(self) -> None:
        """The queue is empty: the next frame arrives after this moment."""
        self._arrivals.none_waiting()

    def middle_s(self, ticks: int | None, exposure_s: float) -> tuple[float, float]:
        """The middle of the exposure of a frame that was received just now, and its standard uncertainty, s.

        ``ticks``: its stamp; None: it has none.
        """
        if ticks is None:
            return self._arrivals.arrived(exposure_s * 1e6)
        received_s = self._clock.now_s()
        if self._device_time is None:
            self._device_time = DeviceTime(tick_hz(self._features))
        self._latch(self._device_time)
        earliest_s = self._begun_s
        latest_s = received_s - exposure_s
        if latest_s < earliest_s:  # an emulator that does not take the time of an exposure
            latest_s = received_s
        to_stamp_s = exposure_s if self._at_end else 0.0
        if not self._device_time.observe(ticks, earliest_s + to_stamp_s, latest_s + to_stamp_s):
            self._use_latch = False
        time_s, u_s = self._device_time.time_s(ticks)
        return time_s - to_stamp_s + exposure_s / 2, u_s

    def _latch(self, device_time: DeviceTime) -> None:
        if not self._use_latch or self._clock.now_s() - self._latched_s < _LATCH_AGAIN_S:
            return
        latch = read_latch(self._features, self._clock)
        if latch is None:
            self._use_latch = False
            return
        device_time.observe(*latch)
        self._latched_s = latch[2]
