"""When a frame was exposed, from what a camera and its library tell about it.

Uncertainties are standard uncertainties of rectangular distributions: a moment that lies anywhere in an interval of width w has w / sqrt(12).
"""

import math

from rotaline.hardware.clock import Clock

_U_OF_WIDTH = 1.0 / math.sqrt(12.0)


class ArrivalTimes:
    """Times of frames that carry no time stamp that the clock can be compared with.

    The end of an exposure lies between the last moment at which the frame was certainly not yet exposed, or at most ``latency_s`` before the last
    moment at which it had certainly not yet arrived, and the moment at which the program got it. A frame that waited in the queue of the driver
    has a wider interval for it.

    Parameters
    ----------
    clock : the clock
    latency_s : from the end of an exposure until the frame is here (read-out, transfer, processing), at most, s
    """

    def __init__(self, clock: Clock, latency_s: float) -> None:
        self._clock = clock
        self._latency_s = latency_s
        self._not_arrived_s = clock.now_s()
        self._not_begun_s = -math.inf

    def begun(self) -> None:
        """The next exposure begins after this moment: the camera is triggered, or begins to stream."""
        self._not_begun_s = self._not_arrived_s = self._clock.now_s()

    def none_waiting(self, since_s: float | None = None) -> None:
        """The queue is empty, or was at an earlier moment: the next frame arrives after that."""
        self._not_arrived_s = max(self._not_arrived_s, self._clock.now_s() if since_s is None else since_s)

    def arrived(self, exposure_us: float) -> tuple[float, float]:
        """The program has got a frame: middle of its exposure and standard uncertainty, s."""
        now_s = self._clock.now_s()
        exposure_s = exposure_us * 1e-6
        arrived_early_s = self._not_arrived_s - self._latency_s
        earliest_s = max(arrived_early_s, self._not_begun_s + exposure_s)
        if earliest_s > now_s:  # an emulated camera that does not take the time of an exposure
            earliest_s = max(arrived_early_s, self._not_begun_s)
        return (earliest_s + now_s) / 2 - exposure_s / 2, (now_s - earliest_s) * _U_OF_WIDTH

    def began_after(self, moment_s: float, exposure_us: float) -> bool:
        """Whether the frame that the program has just got certainly began to be exposed after this moment."""
        return self._not_arrived_s - self._latency_s - exposure_us * 1e-6 >= moment_s


class StampGaps:
    """How many frames are missing between two, by their time stamps: all that is known of a camera that counts nothing.

    Parameters
    ----------
    nominal_s : the time between two frames as the camera says it, s; 0: it does not
    """

    def __init__(self, nominal_s: float) -> None:
        self._nominal_s = nominal_s
        self.restart()

    def restart(self) -> None:
        """The next frame follows no other."""
        self._last_s: float | None = None
        self._period_s = math.inf

    def step(self, stamp_s: float | None) -> int:
        """1, or more if frames were lost between the last one and this one; also 1 if the frame has no stamp.

        The shortest time between two frames so far counts as that between neighbours, unless the camera says a longer one.
        """
        last_s, self._last_s = self._last_s, stamp_s
        if stamp_s is None or last_s is None or stamp_s <= last_s:
            return 1
        self._period_s = max(min(self._period_s, stamp_s - last_s), self._nominal_s)
        return max(round((stamp_s - last_s) / self._period_s), 1)
