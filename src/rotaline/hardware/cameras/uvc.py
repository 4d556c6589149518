"""Webcams and other UVC cameras, through OpenCV.

They run all the time and have no trigger: :meth:`UvcCamera.take` throws frames away until one certainly began after the call. They count nothing:
frames are numbered here, and a frame that was lost is seen only by a gap in the time stamps, which Linux (V4L2) gives and others do not.
The camera's settings count as taken only if they are read back.
"""

import contextlib
import dataclasses
import math
import os
import sys
from collections import deque
from collections.abc import Callable
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from pydantic import Field

from rotaline.errors import (
    DeviceConnectionError,
    DeviceError,
    DeviceStateError,
    DeviceTimeoutError,
    LostFrameError,
)
from rotaline.hardware.camera import CameraFrame, CameraInfo, CameraSettings, Region
from rotaline.hardware.cameras.checks import check_settings
from rotaline.hardware.cameras.frame_times import ArrivalTimes, StampGaps
from rotaline.hardware.cameras.uvc_controls import EXPOSURE, GAIN, Range, control_range, webcams
from rotaline.hardware.cameras.uvc_properties import MEDIA_FOUNDATION, V4L2, Backend, Properties
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import FoundDevice
from rotaline.tables import NotNegative, Positive, Table, key

_SLICE_S = 0.2
"""Waiting is cut into slices, so that Ctrl-C is heard."""
_TRIES = 5
"""A wait that ends at once without a frame may be a signal to the program; so many in a row mean that the camera is gone."""
_OLDEST_S = 30.0
"""A time stamp that is older than this is not of the program's clock."""


class Settings(Table):
    """A UVC camera."""

    driver: Literal["uvc"] = key(..., "which driver: uvc")
    device: str | int = key(
        0, "path such as '/dev/v4l/by-id/usb-...-index0' (Linux), or the number of the camera, 0 the first"
    )
    width: Annotated[int, Field(gt=0)] | None = key(None, "width of the image, px; none: as the camera has it")
    height: Annotated[int, Field(gt=0)] | None = key(None, "height of the image, px; none: as the camera has it")
    frame_rate_hz: Positive | None = key(None, "frames a second, Hz; none: as the camera has it")
    fourcc: Annotated[str, Field(min_length=4, max_length=4)] | None = key(
        None, "how pixels come: 'YUYV' (whole), 'MJPG' (compressed, loses detail); none: as the camera has it"
    )
    colour: bool = key(True, "images are red, green, blue; false: a camera without colours")
    focus: NotNegative | None = key(None, "focus in the camera's own unit; none: it stays where it is")
    white_balance_k: Positive | None = key(None, "colour temperature, K; none: it stays where it is")
    exposure_min_us: Positive | None = key(None, "least exposure, us; none: what Linux says")
    exposure_max_us: Positive | None = key(None, "greatest exposure, us; none: what Linux says")
    latency_s: NotNegative = key(0.05, "from the end of an exposure until its frame begins to come, at most, s")
    queue_frames: Annotated[int, Field(ge=1)] = key(
        4, "without time stamps: frames that may wait for the program in the computer, at most"
    )
    settle_frames: Annotated[int, Field(ge=0)] = key(
        3, "frames thrown away after a change of exposure or gain, which cameras make late"
    )


class UvcCamera:
    """A camera that is open; see :class:`rotaline.hardware.camera.Camera`.

    Parameters
    ----------
    capture : ``cv2.VideoCapture``, open
    wait : waits for a frame so many seconds, and says whether one is grabbed
    limits_of : limits of a control
    """

    def __init__(
        self,
        capture: Any,
        settings: Settings,
        clock: Clock,
        backend: Backend,
        wait: Callable[[float], bool],
        limits_of: Callable[[int], Range | None],
    ) -> None:
        self._capture = capture
        self._options = settings
        self._clock = clock
        self._backend = backend
        self._wait = wait
        self._device = f"webcam {settings.device} ({backend.name})"
        self._state: Literal["idle", "streams", "closed"] = "idle"
        self._number = -1
        self._throw_away = settings.settle_frames
        self._got_s: deque[float] = deque(maxlen=settings.queue_frames + 1)
        self._properties = Properties(capture, backend, self._device)
        size = self._properties.set_format(settings.fourcc, settings.width, settings.height, settings.frame_rate_hz)
        self._properties.switch_automatics_off(settings.focus, settings.white_balance_k)
        self._gaps = StampGaps(self._properties.frame_period_s())
        self._times = ArrivalTimes(clock, settings.latency_s)
        self._gain_range = limits_of(GAIN)
        self._info = CameraInfo(
            device=self._device,
            sensor_size=size,
            exposure_limits_us=self._exposure_limits(limits_of(EXPOSURE)),
            gain_limits=None
            if self._gain_range is None
            else (float(self._gain_range.least), float(self._gain_range.most)),
            gain_unit="device",
            colour=settings.colour,
        )
        self._settings = self._as_they_are(Region(0, 0, *size))
        low, high = self._info.exposure_limits_us
        if not low <= self._settings.exposure_us <= high:
            self.configure(dataclasses.replace(self._settings, exposure_us=min(max(10_000.0, low), high)))
        self._first_frame()

    def _exposure_limits(self, known: Range | None) -> tuple[float, float]:
        to_us, options = self._backend.to_us, self._options
        low = options.exposure_min_us or (None if known is None else to_us(max(known.least, 1)))
        high = options.exposure_max_us or (None if known is None else to_us(known.most))
        if low is None or high is None:
            raise DeviceStateError(
                f"{self._device}: nobody says what exposures it can. State exposure_min_us and exposure_max_us in rig.toml "
                "(its exposure must be adjustable)."
            )
        return float(low), float(high)

    @property
    def info(self) -> CameraInfo:
        """What it is and can."""
        return self._info

    @property
    def settings(self) -> CameraSettings:
        """As they are now."""
        return self._settings

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Change the settings; see :meth:`rotaline.hardware.camera.Camera.configure`. The region is cut out of the whole image."""
        self._ensure_open()
        if self._state == "streams":
            raise DeviceStateError(f"{self._device} streams: stop it before its settings are changed.")
        check_settings(self._info, settings)
        before = self._settings
        whole = Region(0, 0, *self._info.sensor_size)
        try:
            self._set(settings)
            self._settings = self._as_they_are(settings.region or whole)
        except DeviceError:
            with contextlib.suppress(DeviceError):
                self._set(before)
            raise
        if (before.exposure_us, before.gain) != (self._settings.exposure_us, self._settings.gain):
            self._throw_away = self._options.settle_frames
        return self._settings

    def _set(self, settings: CameraSettings) -> None:
        self._properties.set_exposure_us(settings.exposure_us)
        if settings.gain is not None and self._gain_range is not None:
            self._properties.set_gain(settings.gain, self._gain_range)

    def _as_they_are(self, region: Region) -> CameraSettings:
        gain = None if self._gain_range is None else self._properties.gain()
        return CameraSettings(exposure_us=self._properties.exposure_us(), gain=gain, region=region)

    def _first_frame(self) -> None:
        try:
            self._grab(10.0)
        except (DeviceTimeoutError, DeviceConnectionError) as error:
            raise DeviceConnectionError(
                f"{self._device}: it can be opened, but gives no frame. Another program may hold it: close it there. ({error})"
            ) from error

    def take(self, timeout_s: float) -> CameraFrame:
        """One frame that began after this call; see :meth:`rotaline.hardware.camera.Camera.take`."""
        self._ensure_open()
        if self._state == "streams":
            raise DeviceStateError(f"{self._device} streams: ask for its next frame, or stop it.")
        return self._frame_since(self._clock.now_s(), timeout_s)

    def start(self) -> None:
        """Begin to stream."""
        self._ensure_open()
        if self._state != "streams":
            self._state = "streams"
            self._since_s = self._clock.now_s()
            self._gaps.restart()

    def next_frame(self, timeout_s: float) -> CameraFrame:
        """The next frame of the stream."""
        self._ensure_open()
        if self._state != "streams":
            raise DeviceStateError(f"{self._device} does not stream: start it first.")
        return self._frame_since(self._since_s, timeout_s)

    def stop(self) -> None:
        """End the stream."""
        if self._state == "streams":
            self._state = "idle"

    def close(self) -> None:
        """Let the camera go."""
        if self._state != "closed":
            self._state = "closed"
            with contextlib.suppress(Exception):
                self._capture.release()

    def _frame_since(self, since_s: float, timeout_s: float) -> CameraFrame:
        """The next frame whose exposure certainly began after a moment."""
        called_s = self._clock.now_s()
        while True:
            left_s = timeout_s - (self._clock.now_s() - called_s)
            if left_s <= 0:
                raise self._timed_out(timeout_s)
            stamp_s = self._grab(left_s)
            exposure_us = self._settings.exposure_us
            if stamp_s is None:
                fresh = self._times.began_after(since_s, exposure_us)
                time_s, u_time_s = self._times.arrived(exposure_us)
            else:
                latency_s = self._options.latency_s
                fresh = stamp_s - latency_s - exposure_us * 1e-6 >= since_s
                time_s, u_time_s = stamp_s - latency_s / 2 - exposure_us * 0.5e-6, latency_s / math.sqrt(12.0)
            if fresh and self._throw_away > 0:
                self._throw_away -= 1
            elif fresh:
                return CameraFrame(self._image(), self._number, time_s, u_time_s, self._settings)

    def _grab(self, timeout_s: float) -> float | None:
        """Get the next frame and count it; its time stamp, if it has one, s."""
        end_s = self._clock.now_s() + timeout_s
        in_vain = 0
        while True:
            before_s = self._clock.now_s()
            asked_s = min(max(end_s - before_s, 1e-3), _SLICE_S)
            if self._waited(asked_s):
                break
            now_s = self._clock.now_s()
            in_vain = in_vain + 1 if now_s - before_s < asked_s / 2 else 0
            if in_vain >= _TRIES or not self._there():
                raise self._went_away()
            if now_s >= end_s:
                raise self._timed_out(timeout_s)
        try:
            self._retrieved = self._capture.retrieve()  # also what nobody wants: OpenCV grabs no other before
        except cv2.error:
            self._retrieved = False, None
        stamp_s = self._stamp_s()
        self._number += self._gaps.step(stamp_s) if self._state == "streams" else 1
        return stamp_s

    def _waited(self, seconds: float) -> bool:
        before_s = self._clock.now_s()
        try:
            came = self._wait(seconds)
        except cv2.error as error:
            raise self._went_away() from error
        if not came:
            self._times.none_waiting(before_s)
        else:
            if len(self._got_s) == self._got_s.maxlen:  # then the queue held all the frames since: this one came later
                self._times.none_waiting(self._got_s[0])
            self._got_s.append(self._clock.now_s())
        return came

    def _stamp_s(self) -> float | None:
        stamp_s = float(self._capture.get(cv2.CAP_PROP_POS_MSEC)) * 1e-3
        age_s = self._clock.now_s() - stamp_s
        return stamp_s if self._backend is V4L2 and stamp_s > 0 and -1e-3 <= age_s < _OLDEST_S else None

    def _image(self) -> np.ndarray:
        read, image = self._retrieved
        width, height = self._info.sensor_size
        if not read or image is None or image.shape[:2] != (height, width):
            raise LostFrameError(
                f"{self._device}: frame {self._number} cannot be decoded. Take it again; use 'YUYV' if it comes often."
            )
        region = self._settings.region
        assert region is not None
        cut = image[region.y : region.y + region.height, region.x : region.x + region.width]
        if cut.ndim == 3:
            cut = cut[:, :, ::-1] if self._info.colour else cut[:, :, 1]
        elif self._info.colour:
            cut = np.repeat(cut[:, :, None], 3, axis=2)
        return np.array(cut, dtype=np.uint8, order="C")

    def _there(self) -> bool:
        device = self._options.device
        return bool(self._capture.isOpened()) and (self._backend is not V4L2 or os.path.exists(_path(device)))

    def _ensure_open(self) -> None:
        if self._state == "closed":
            raise DeviceStateError(f"{self._device} is closed: open it again.")

    def _went_away(self) -> DeviceConnectionError:
        return DeviceConnectionError(
            f"{self._device} does not answer any more. Check its cable, then open the camera again."
        )

    def _timed_out(self, timeout_s: float) -> DeviceTimeoutError:
        return DeviceTimeoutError(
            f"{self._device}: no frame that began after the call came within {timeout_s:g} s. Allow some frame periods, the exposure of "
            f"{self._settings.exposure_us:g} us, latency_s and settle_frames."
        )


def open_device(settings: Settings, clock: Clock, connections: Connections) -> UvcCamera:
    """Open the camera.

    Raises
    ------
    DeviceConnectionError
        If it is not there, or another program holds it.
    DeviceStateError
        If its exposure cannot be set, or what adjusts itself cannot be switched off.
    """
    if sys.platform == "darwin":
        raise DeviceStateError(
            f"webcam {settings.device}: macOS does not let programs set the exposure of webcams. Use Linux, Windows, or another camera."
        )
    backend = MEDIA_FOUNDATION if sys.platform == "win32" else V4L2
    if backend is V4L2 and not os.path.exists(_path(settings.device)):
        raise DeviceConnectionError(
            f"webcam {settings.device}: there is no {_path(settings.device)}. 'rotaline devices' lists the webcams."
        )
    capture = cv2.VideoCapture(settings.device, backend.number)
    if not capture.isOpened():
        raise DeviceConnectionError(
            f"webcam {settings.device}: it cannot be opened. Is it connected, may this user open it (Linux: group 'video'), and does no "
            "other program hold it?"
        )

    def wait(seconds: float) -> bool:
        if backend is V4L2:
            _, ready = cv2.VideoCapture.waitAny([capture], max(int(seconds * 1e9), 1))
            return len(ready) > 0  # a camera that is gone ends the wait as well
        return bool(capture.grab())

    try:
        return UvcCamera(
            capture, settings, clock, backend, wait, lambda control: control_range(_path(settings.device), control)
        )
    except BaseException:
        capture.release()
        raise


def find() -> tuple[FoundDevice, ...]:
    """The webcams that Linux knows; none elsewhere (there: try 'device = 0', 1 ...)."""
    return tuple(
        FoundDevice("camera", "uvc", f"webcam {name} ({path})", f'driver = "uvc"\ndevice = "{path}"')
        for name, path in webcams()
    )


def _path(device: str | int) -> str:
    return f"/dev/video{device}" if isinstance(device, int) else device
