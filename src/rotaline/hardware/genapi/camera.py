"""A GenICam camera as this program's :class:`~rotaline.hardware.camera.Camera`, whatever library carries its features and frames.

A single frame is taken by a software trigger. The camera stays armed between two takes; whatever goes wrong disarms it, so that a frame
that comes late is never taken for the next one. A camera without a software trigger begins to run for each frame, and stops after it.
"""

import contextlib
import dataclasses
import math
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

from rotaline.errors import DeviceError, DeviceStateError, DeviceTimeoutError, LostFrameError
from rotaline.hardware.camera import CameraFrame, CameraInfo, CameraSettings, Region
from rotaline.hardware.cameras.checks import check_settings
from rotaline.hardware.cameras.pixel_formats import depth_bits, is_colour, supported, to_image, unsupported
from rotaline.hardware.clock import Clock
from rotaline.hardware.genapi.counting import FrameCounter
from rotaline.hardware.genapi.device_time import FrameTimes
from rotaline.hardware.genapi.features import (
    EXPOSURE,
    GAIN,
    Features,
    Value,
    choose,
    describe,
    first_of,
    is_ready_for_trigger,
    make_manual,
    read_region,
    region_on_steps,
    set_given,
    set_number,
    set_region,
    trigger_sources,
)

_SLICE_S = 0.2
"""A wait for a frame looks so often whether the camera is there yet."""
_POLL_S = 0.001


@dataclass(frozen=True, eq=False)
class RawFrame:
    """What a transport received.

    ``data``: bytes of the image, lines with ``padding_bytes`` behind each; ``ticks``: the camera's time stamp; ``damage``: what is wrong
    with it, None: it is whole; ``frame_id`` None: it has none.
    """

    data: Any
    pixel_format: str
    width: int
    height: int
    padding_bytes: int
    frame_id: int | None
    ticks: int | None
    damage: str | None = None


@runtime_checkable
class Transport(Protocol):
    """Frames of an open camera."""

    wraps: bool
    """Frame ids may be of 16 bit."""

    def start(self) -> None:
        """Begin acquisition, with an empty queue."""

    def receive(self, timeout_s: float) -> RawFrame | None:
        """The next frame; None: there was none in this time."""

    def check(self) -> None:
        """Raise a DeviceConnectionError if the camera is gone, or no longer ours."""

    def stop(self) -> None:
        """End acquisition, and forget what is in the queue."""

    def close(self) -> None:
        """Let the camera go."""


@dataclass(frozen=True)
class Options:
    """What rig.toml says that the camera does not know."""

    exposure_us: float | None = None
    trigger_line: str = "Line1"
    pixel_format: str | None = None
    stamp_at_end: bool = False
    features: dict[str, Value] = dataclasses.field(default_factory=dict)


class GenicamCamera:
    """An open camera."""

    def __init__(self, features: Features, transport: Transport, clock: Clock, options: Options) -> None:
        """Stop everything that adjusts itself, set what the user states.

        Raises
        ------
        DeviceStateError
            If the camera has no such feature, pixel format, or exposure.
        """
        self._features = features
        self._transport = transport
        self._clock = clock
        self._options = options
        self._mode: Literal["idle", "armed", "streaming", "closed"] = "idle"
        make_manual(features)
        choose(features, "TriggerMode", "Off")
        set_given(features, options.features)
        pixel_format = _set_pixel_format(features, options.pixel_format)
        self._info = describe(
            features, options.exposure_us, depth_bits(pixel_format), is_colour(pixel_format), options.trigger_line
        )
        self._software = "Software" in trigger_sources(features) and features.has("TriggerSoftware")
        self._exposure = first_of(features, EXPOSURE)
        self._gain = first_of(features, GAIN)
        self._settings = self._now("free")
        self._counter = FrameCounter(transport.wraps)
        self._times = FrameTimes(features, clock, options.stamp_at_end)

    @property
    def info(self) -> CameraInfo:
        """What it is and can."""
        return self._info

    @property
    def settings(self) -> CameraSettings:
        """As they are now."""
        return self._settings

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Check everything, then set it; see :meth:`rotaline.hardware.camera.Camera.configure`."""
        self._not_streaming("Its settings cannot change while it streams. Stop it first.")
        region = self._checked(settings)
        try:
            self._set(settings, region)
        except DeviceError:
            with contextlib.suppress(DeviceError):
                self._settings = self._now(self._settings.trigger)  # half of it may be set
            raise
        self._settings = self._now(settings.trigger)
        return self._settings

    def take(self, timeout_s: float) -> CameraFrame:
        """One frame that began after this call; see :meth:`rotaline.hardware.camera.Camera.take`."""
        self._not_streaming("It streams: ask for its next frame, or stop it first.")
        try:
            if self._software:
                self._arm(timeout_s)
                self._times.begun()
                self._features.execute("TriggerSoftware")
            else:
                self._start_transport()
            frame = self._next(timeout_s)
        except BaseException:
            self._disarm()  # nothing of this take shall be there for the next one
            raise
        if not self._software:
            self._disarm()
        return frame

    def start(self) -> None:
        """Begin to stream; see :meth:`rotaline.hardware.camera.Camera.start`."""
        self._not_streaming("It streams already.")
        self._disarm()
        try:
            self._set_trigger(self._options.trigger_line if self._settings.trigger == "line" else None)
            self._start_transport()
        except BaseException:
            self._disarm()
            raise
        self._mode = "streaming"

    def next_frame(self, timeout_s: float) -> CameraFrame:
        """The next frame of the stream; see :meth:`rotaline.hardware.camera.Camera.next_frame`."""
        self._not_closed()
        if self._mode != "streaming":
            raise DeviceStateError(f"{self._info.device}: it does not stream. Start it first.")
        return self._next(timeout_s)

    def stop(self) -> None:
        """End the stream; a camera that is gone has ended it by itself."""
        if self._mode == "streaming":
            self._disarm()

    def close(self) -> None:
        """Let the camera go."""
        if self._mode == "closed":
            return
        self._disarm()
        self._mode = "closed"
        with contextlib.suppress(Exception):
            self._set_trigger(None)  # another program may expect a camera that runs
        with contextlib.suppress(Exception):
            self._transport.close()

    def _now(self, trigger: Literal["free", "line"]) -> CameraSettings:
        """The settings as the camera has them."""
        exposure, gain = self._exposure, self._gain
        return CameraSettings(
            exposure_us=(self._options.exposure_us or math.nan)
            if exposure is None
            else float(self._features.get(exposure)),
            gain=None if gain is None else float(self._features.get(gain)),
            region=read_region(self._features),
            trigger=trigger,
        )

    def _set(self, settings: CameraSettings, region: Region) -> None:
        if region != self._settings.region:
            self._disarm()  # the camera locks its region while it acquires
            set_region(self._features, region)
        if self._exposure is not None and settings.exposure_us != self._settings.exposure_us:
            set_number(self._features, self._exposure, settings.exposure_us)
        if self._gain is not None and settings.gain is not None and settings.gain != self._settings.gain:
            set_number(self._features, self._gain, settings.gain)

    def _checked(self, settings: CameraSettings) -> Region:
        """The region on the camera's steps; raises before anything is set."""
        smallest = tuple(int(self._features.limits(name).least) for name in ("Width", "Height"))
        check_settings(self._info, settings, (smallest[0], smallest[1]))
        sensor = self._info.sensor_size
        wanted = Region(0, 0, *sensor) if settings.region is None else settings.region
        return wanted if wanted == self._settings.region else region_on_steps(self._features, wanted, sensor)

    def _not_closed(self) -> None:
        if self._mode == "closed":
            raise DeviceStateError(f"{self._info.device}: it is closed. Open it again.")

    def _not_streaming(self, otherwise: str) -> None:
        self._not_closed()
        if self._mode == "streaming":
            raise DeviceStateError(f"{self._info.device}: {otherwise}")

    def _set_trigger(self, source: str | None) -> None:
        if source is not None:
            choose(self._features, "TriggerSource", source)
        choose(self._features, "TriggerMode", "Off" if source is None else "On")

    def _arm(self, timeout_s: float) -> None:
        """Acquire, each frame by a software trigger; returns when the camera waits for one."""
        if self._mode != "armed":
            self._set_trigger("Software")
            self._start_transport()
        left_s = timeout_s
        while not is_ready_for_trigger(self._features):
            if left_s <= 0:
                raise DeviceTimeoutError(
                    f"{self._info.device}: it is not ready for a trigger after {timeout_s:g} s. Is it exposing yet?"
                )
            self._clock.wait(_POLL_S)
            left_s -= _POLL_S

    def _start_transport(self) -> None:
        self._counter.restart()
        self._times.begun()
        self._mode = "armed"
        self._transport.start()

    def _disarm(self) -> None:
        """Acquire no longer. An error is left to the next call: the camera is not used any more either way."""
        if self._mode not in ("armed", "streaming"):
            return
        self._mode = "idle"
        with contextlib.suppress(DeviceError):
            self._transport.stop()

    def _next(self, timeout_s: float) -> CameraFrame:
        """The next frame that is newer than the last one."""
        while True:
            raw = self._receive(timeout_s)
            number = self._counter.number(raw.frame_id)
            if number is not None:
                break
        device = self._info.device
        if raw.damage is not None:
            raise LostFrameError(f"{device}: frame {number} came damaged: {raw.damage}. Take it again.")
        time_s, u_time_s = self._times.middle_s(raw.ticks, self._settings.exposure_us * 1e-6)
        image = to_image(raw.data, raw.pixel_format, raw.width, raw.height, raw.padding_bytes)
        return CameraFrame(image, number, time_s, u_time_s, self._settings)

    def _receive(self, timeout_s: float) -> RawFrame:
        raw = self._transport.receive(_POLL_S)
        if raw is not None:
            return raw
        self._times.none_waiting()
        left_s = timeout_s
        while left_s > 0:
            slice_s = max(min(left_s, _SLICE_S), _POLL_S)
            raw = self._transport.receive(slice_s)
            if raw is not None:
                return raw
            self._transport.check()
            left_s -= slice_s
        raise DeviceTimeoutError(
            f"{self._info.device}: no frame came within {timeout_s:g} s (exposure {self._settings.exposure_us:g} us). "
            "Give it more time, or look whether its trigger comes."
        )


def _set_pixel_format(features: Features, wanted: str | None) -> str:
    offered = features.entries("PixelFormat")
    if wanted is not None and not choose(features, "PixelFormat", wanted):
        usable = ", ".join(name for name in offered if supported(name)) or "none that can be read"
        raise DeviceStateError(f"{features.device}: it has no pixel format {wanted} now. It has: {usable}.")
    now = str(features.get("PixelFormat"))
    if not supported(now):
        raise unsupported(features.device, now, offered)
    return now
