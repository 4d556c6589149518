"""MindVision cameras (the article's MV-U300 is one), through the vendor's library MVSDK.

Between streams the camera waits for software triggers, so that :meth:`MindVisionCamera.take` gets an exposure of its own. The library gives no frame
number: frames are counted here, and those that the library counts as lost are added. Image processing by the library is set to do nothing:
gamma and contrast 1, no sharpening, no noise filter, no mirroring.
"""

import contextlib
import math
import sys
from ctypes import byref, c_double, c_int, c_void_p
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from rotaline.errors import DeviceConnectionError, DeviceError, DeviceStateError, DeviceTimeoutError, LostFrameError
from rotaline.hardware.camera import CameraFrame, CameraInfo, CameraSettings, Image, Region
from rotaline.hardware.cameras import mindvision_library as mv
from rotaline.hardware.cameras.checks import check_settings
from rotaline.hardware.cameras.frame_times import ArrivalTimes
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import FoundDevice
from rotaline.tables import NotNegative, Table, key

_SLICE_MS = 200
"""Waiting is cut into slices, so that Ctrl-C is heard."""


class Settings(Table):
    """A MindVision camera."""

    driver: Literal["mindvision"] = key(..., "which driver: mindvision")
    serial: str | None = key(None, "serial number of the camera; none: the only one that is connected")
    library: str | None = key(
        None,
        "path of the vendor's library; none: libMVSDK.so (Linux) or MVCAMSDK_X64.dll (Windows) where the system finds it",
    )
    latency_s: NotNegative = key(0.1, "from the end of an exposure until the frame is here, at most, s")
    rows_from_below: bool | None = key(
        None, "the library gives the lowest row of an image first; none: on Windows it does, elsewhere not"
    )
    frame_speed: Annotated[int, Field(ge=0)] | None = key(
        None, "the camera's frame speed, 0 the slowest; none: as it is"
    )


class MindVisionCamera:
    """A camera that is open; see :class:`rotaline.hardware.camera.Camera`."""

    def __init__(self, library: mv.Library, found: mv.DeviceInfo, settings: Settings, clock: Clock) -> None:
        self._library = library
        self._device = _name(found)
        self._clock = clock
        self._latency_s = settings.latency_s
        from_below = settings.rows_from_below
        self._from_below = sys.platform == "win32" if from_below is None else from_below
        self._number = -1
        self._lost = 0
        self._streams = False
        self._handle: int | None = library.open(found, self._device)
        try:
            self._prepare(settings)
        except BaseException:
            self.close()
            raise

    def _prepare(self, settings: Settings) -> None:
        can = mv.Capability()
        self._call("CameraGetCapability", byref(can))
        self._line_us = self._read_double("CameraGetExposureLineTime")
        self._gain_step = can.exposure.gain_step
        mono = bool(can.processing.mono)
        self._smallest = (max(can.resolution.width_min, 1), max(can.resolution.height_min, 1))
        self._by_software = can.n_triggers >= 2
        self._info = CameraInfo(
            device=self._device,
            sensor_size=(can.resolution.width_max, can.resolution.height_max),
            exposure_limits_us=(can.exposure.lines_min * self._line_us, can.exposure.lines_max * self._line_us),
            gain_limits=(can.exposure.gain_min * self._gain_step, can.exposure.gain_max * self._gain_step),
            gain_unit="x",
            colour=not mono,
            triggers=("free", "line") if can.n_triggers >= 3 else ("free",),
        )
        self._call("CameraSetIspOutFormat", mv.MONO8 if mono else mv.RGB8)
        self._switch_automatics_off(mono)
        if settings.frame_speed is not None:
            self._call("CameraSetFrameSpeed", settings.frame_speed)
        self._set_region(Region(0, 0, *self._info.sensor_size))
        self._settings = self._as_they_are("free")
        self._await_triggers()
        self._call("CameraPlay")
        self._times = ArrivalTimes(self._clock, self._latency_s)
        self._lost = self._lost_frames()

    def _switch_automatics_off(self, mono: bool) -> None:
        self._call("CameraSetAeState", 0)
        state = c_int(1)
        self._call("CameraGetAeState", byref(state))
        if state.value:
            raise DeviceStateError(
                f"{self._device}: automatic exposure stays on. Switch it off in MindVision's own program and save the parameters."
            )
        neutral: list[tuple[Any, ...]] = [
            ("CameraSetLutMode", 0),
            ("CameraSetGamma", 100),
            ("CameraSetContrast", 100),
            ("CameraSetSharpness", 0),
            ("CameraSetNoiseFilter", 0),
            ("CameraSetMirror", 0, 0),
            ("CameraSetMirror", 1, 0),
        ]
        if not mono:
            neutral += [("CameraSetWbMode", 0), ("CameraSetGain", 100, 100, 100), ("CameraSetSaturation", 100)]
        for function, *arguments in neutral:
            status = self._library.status(function, self._open_handle(), *arguments)
            if status != mv.NOT_SUPPORTED:  # a model that cannot do it does not do it
                mv.check(status, self._device, function)

    @property
    def info(self) -> CameraInfo:
        """What it is and can."""
        return self._info

    @property
    def settings(self) -> CameraSettings:
        """As they are now."""
        return self._settings

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Change the settings; see :meth:`rotaline.hardware.camera.Camera.configure`."""
        self._open_handle()
        if self._streams:
            raise DeviceStateError(f"{self._device} streams: stop it before its settings are changed.")
        check_settings(self._info, settings, self._smallest)
        before = self._settings
        try:
            self._set(settings)
            self._settings = self._as_they_are(settings.trigger)
        except DeviceError:
            with contextlib.suppress(DeviceError):
                self._set(before)
            raise
        return self._settings

    def _set(self, settings: CameraSettings) -> None:
        region = settings.region or Region(0, 0, *self._info.sensor_size)
        if region != self._as_they_are("free").region:
            self._call("CameraPause")
            try:
                self._set_region(region)
            finally:
                self._call("CameraClearBuffer")
                self._call("CameraPlay")
        self._call("CameraSetExposureTime", settings.exposure_us)
        if settings.gain is not None:
            self._call("CameraSetAnalogGain", round(settings.gain / self._gain_step))

    def _set_region(self, region: Region) -> None:
        wanted = mv.Resolution(
            index=mv.CUSTOM_RESOLUTION,
            x=region.x,
            y=region.y,
            width_read=region.width,
            height_read=region.height,
            width=region.width,
            height=region.height,
        )
        self._call("CameraSetImageResolution", byref(wanted))

    def _as_they_are(self, trigger: Literal["free", "line"]) -> CameraSettings:
        gain = c_int()
        self._call("CameraGetAnalogGain", byref(gain))
        made = mv.Resolution()
        self._call("CameraGetImageResolution", byref(made))
        return CameraSettings(
            exposure_us=self._read_double("CameraGetExposureTime"),
            gain=gain.value * self._gain_step,
            region=Region(made.x, made.y, made.width, made.height),
            trigger=trigger,
        )

    def take(self, timeout_s: float) -> CameraFrame:
        """One frame of an exposure that is triggered now; see :meth:`rotaline.hardware.camera.Camera.take`.

        A camera without a software trigger runs freely; then frames are thrown away until one certainly began after this call.
        """
        self._open_handle()
        if self._streams:
            raise DeviceStateError(f"{self._device} streams: ask for its next frame, or stop it.")
        self._call("CameraClearBuffer")
        self._times.begun()
        called_s = self._clock.now_s()
        try:
            if self._by_software:
                self._call("CameraSoftTrigger")
                return self._next(timeout_s)
            while True:
                frame = self._next(timeout_s)
                if self._times.began_after(called_s, self._settings.exposure_us):
                    return frame
                if self._clock.now_s() - called_s > timeout_s:
                    raise DeviceTimeoutError(
                        f"{self._device}: no frame began and came within {timeout_s:g} s. Allow more than the exposure and latency_s."
                    )
        except BaseException:
            with contextlib.suppress(DeviceError):
                self._abandon()
            raise

    def _abandon(self) -> None:
        """Whatever is still under way is not mistaken for the next exposure."""
        self._call("CameraPause")
        self._call("CameraClearBuffer")
        self._call("CameraPlay")

    def start(self) -> None:
        """Begin to stream."""
        if self._streams:
            return
        line = self._settings.trigger == "line"
        if line:
            self._call("CameraSetTriggerCount", 1)
        self._call("CameraSetTriggerMode", mv.LINE_TRIGGER if line else mv.CONTINUOUS)
        self._call("CameraClearBuffer")
        self._lost = self._lost_frames()
        self._times.begun()
        self._streams = True

    def next_frame(self, timeout_s: float) -> CameraFrame:
        """The next frame of the stream."""
        self._open_handle()
        if not self._streams:
            raise DeviceStateError(f"{self._device} does not stream: start it first.")
        return self._next(timeout_s)

    def stop(self) -> None:
        """End the stream; a camera that is gone has ended it by itself."""
        if self._streams:
            self._streams = False
            with contextlib.suppress(DeviceConnectionError):
                self._await_triggers()
                self._call("CameraClearBuffer")

    def close(self) -> None:
        """Let the camera go."""
        if self._handle is not None:
            handle, self._handle = self._handle, None
            self._streams = False
            for function in ("CameraStop", "CameraUnInit"):
                with contextlib.suppress(Exception):
                    self._library.status(function, handle)

    def _await_triggers(self) -> None:
        if self._by_software:
            self._call("CameraSetTriggerCount", 1)
        self._call("CameraSetTriggerMode", mv.SOFTWARE_TRIGGER if self._by_software else mv.CONTINUOUS)

    def _next(self, timeout_s: float) -> CameraFrame:
        head, buffer = mv.FrameHead(), c_void_p()
        try:
            self._wait_for_buffer(head, buffer, timeout_s)
        except LostFrameError:
            self._number += 1
            raise
        time_s, u_time_s = self._times.arrived(self._settings.exposure_us)
        try:
            image = self._processed(head, buffer)
        finally:
            self._call("CameraReleaseImageBuffer", buffer)
        lost = self._lost_frames()
        self._number += 1 + max(lost - self._lost, 0)
        self._lost = lost
        region = self._settings.region
        assert region is not None
        if image.shape[:2] != (region.height, region.width):
            raise LostFrameError(
                f"{self._device}: a frame of {image.shape[1]} x {image.shape[0]} px came instead of {region.width} x {region.height} px. "
                "Take it again."
            )
        return CameraFrame(image, self._number, time_s, u_time_s, self._settings)

    def _wait_for_buffer(self, head: mv.FrameHead, buffer: c_void_p, timeout_s: float) -> None:
        """Wait in slices; a frame that waits already does not say when it came."""
        left_ms = max(math.ceil(timeout_s * 1000), 1)
        slice_ms = 1
        while True:
            status = self._library.status(
                "CameraGetImageBuffer", self._open_handle(), byref(head), byref(buffer), slice_ms
            )
            if status != mv.TIME_OUT:
                return mv.check(status, self._device, "getting a frame")
            left_ms -= slice_ms
            if left_ms <= 0:
                break
            self._times.none_waiting()
            slice_ms = min(_SLICE_MS, left_ms)
        if self._library.status("CameraConnectTest", self._open_handle()) != mv.SUCCESS:
            raise DeviceConnectionError(
                f"{self._device} does not answer any more. Check cable and power, then open the camera again."
            )
        raise DeviceTimeoutError(
            f"{self._device}: no frame within {timeout_s:g} s. Is the time-out longer than the exposure of "
            f"{self._settings.exposure_us:g} us, and does the trigger come?"
        )

    def _processed(self, head: mv.FrameHead, buffer: c_void_p) -> Image:
        shape = (head.height, head.width, 3) if self._info.colour else (head.height, head.width)
        image = np.empty(shape, np.uint8)
        self._call("CameraImageProcess", buffer, image.ctypes.data_as(c_void_p), byref(head))
        return np.ascontiguousarray(image[::-1]) if self._from_below else image

    def _lost_frames(self) -> int:
        statistic = mv.Statistic()
        self._call("CameraGetFrameStatistic", byref(statistic))
        return int(statistic.lost)

    def _read_double(self, function: str) -> float:
        value = c_double()
        self._call(function, byref(value))
        return value.value

    def _open_handle(self) -> int:
        if self._handle is None:
            raise DeviceStateError(f"{self._device} is closed: open it again.")
        return self._handle

    def _call(self, function: str, *arguments: Any) -> None:
        mv.check(self._library.status(function, self._open_handle(), *arguments), self._device, function)


def open_device(settings: Settings, clock: Clock, connections: Connections) -> MindVisionCamera:
    """Open the camera.

    Raises
    ------
    DeviceConnectionError
        If the library or the camera is not there, or another program holds it.
    """
    library = mv.Library(settings.library)
    found = library.devices()
    fitting = [one for one in found if settings.serial in (None, one.serial.decode(errors="replace"))]
    if len(fitting) != 1:
        wanted = "a MindVision camera" if settings.serial is None else f"the MindVision camera {settings.serial}"
        there = ", ".join(_name(one) for one in found) or "none"
        raise DeviceConnectionError(
            f"{wanted} was looked for; connected: {there}. Check cable and power, or state 'serial' in rig.toml."
        )
    return MindVisionCamera(library, fitting[0], settings, clock)


def find() -> tuple[FoundDevice, ...]:
    """The cameras that the library sees."""
    return tuple(
        FoundDevice(
            "camera",
            "mindvision",
            _name(one),
            f'driver = "mindvision"\nserial = "{one.serial.decode(errors="replace")}"',
        )
        for one in mv.Library(None).devices()
    )


def _name(info: mv.DeviceInfo) -> str:
    return f"MindVision {info.product.decode(errors='replace')} {info.serial.decode(errors='replace')}"
