"""The camera of a recorded session: a frame shows what was recorded for the rig as it stands, whatever the exposure."""

import dataclasses
from typing import Literal

import numpy as np

from rotaline.errors import DeviceStateError, SessionError
from rotaline.hardware.camera import CameraFrame, CameraInfo, CameraSettings, Image, Region
from rotaline.hardware.cameras.checks import check_settings
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import FoundDevice
from rotaline.hardware.replay import RecordedFrame, Replay, replay_of
from rotaline.tables import NotNegative, Table, key

EXPOSURE_LIMITS_US = (1.0, 1e7)
_EXPOSURE_US = 10_000.0


class Settings(Table):
    """A table ``[camera]`` of rig.toml with ``driver = "replay"``."""

    driver: Literal["replay"] = key("replay", "which driver")
    angle_tolerance_deg: NotNegative = key(
        0.001, "a recorded frame fits if its angle is so near to that of the table, deg"
    )


class ReplayCamera:
    """A camera whose frames were taken long ago; see :class:`rotaline.hardware.camera.Camera`.

    The exposure is accepted, lets its time go by, and chooses between frames that were taken with several; it does not change their
    brightness. A stream gives the frames of the chosen capture in order, whatever stands where.
    """

    def __init__(self, replay: Replay, tolerance_deg: float, clock: Clock) -> None:
        self._replay = replay
        self._tolerance_deg = tolerance_deg
        self._clock = clock
        self._number = 0
        self._stream: list[RecordedFrame] | None = None
        self._closed = False
        first = next(frame for capture in replay.recording.captures for frame in capture.frames)
        image = self._read(first)
        self.info = CameraInfo(
            device=replay.device,
            sensor_size=(image.shape[1], image.shape[0]),
            exposure_limits_us=EXPOSURE_LIMITS_US,
            bit_depth=8 if image.dtype == np.uint8 else 16,
            colour=image.ndim == 3,
        )
        self._shape, self._type = image.shape, image.dtype
        whole = Region(0, 0, *self.info.sensor_size)
        self.settings = CameraSettings(first.exposure_us or _EXPOSURE_US, region=whole)

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Change the settings."""
        self._ready(streaming=False)
        check_settings(self.info, settings)
        region = settings.region or Region(0, 0, *self.info.sensor_size)
        self.settings = dataclasses.replace(settings, region=region)
        return self.settings

    def take(self, timeout_s: float) -> CameraFrame:
        """The frame that was recorded for where the table stands, the laser, and the pose that is presented."""
        self._ready(streaming=False)
        return self._expose(self._replay.frame(self._tolerance_deg, self.settings.exposure_us))

    def start(self) -> None:
        """Begin to give the frames of the capture that is chosen, in order."""
        self._ready(streaming=False)
        self._stream = list(self._replay.capture.frames)

    def next_frame(self, timeout_s: float) -> CameraFrame:
        """The next frame of the capture; after the last one a DeviceStateError."""
        self._ready(streaming=True)
        assert self._stream is not None
        if not self._stream:
            raise DeviceStateError(
                f"{self.info.device}: the stream has given all {len(self._replay.capture.frames)} frames of its capture. Stop it, or choose another."
            )
        frame = self._expose(self._stream[0])
        del self._stream[0]
        return frame

    def stop(self) -> None:
        """End the stream."""
        self._stream = None

    def close(self) -> None:
        """Let it go."""
        self._stream = None
        self._closed = True

    def _ready(self, *, streaming: bool) -> None:
        if self._closed:
            raise DeviceStateError(f"{self.info.device}: the camera has been closed. Open the rig again.")
        if streaming and self._stream is None:
            raise DeviceStateError(f"{self.info.device}: the camera does not stream. Start it first.")
        if not streaming and self._stream is not None:
            raise DeviceStateError(f"{self.info.device}: the camera streams. Stop it first.")

    def _expose(self, frame: RecordedFrame) -> CameraFrame:
        image = self._read(frame)
        if image.shape != self._shape or image.dtype != self._type:
            raise DeviceStateError(
                f"{self.info.device}: {frame.name} is {image.shape[1]} x {image.shape[0]} px ({image.dtype}), the first frame of the session "
                f"{self._shape[1]} x {self._shape[0]} px ({self._type}). Remove one or the other."
            )
        region = self.settings.region
        assert region is not None
        part = image[region.y : region.y + region.height, region.x : region.x + region.width].copy()
        exposure_s = self.settings.exposure_us * 1e-6
        middle_s = self._clock.now_s() + exposure_s / 2
        self._clock.wait(exposure_s)
        self._number += 1
        return CameraFrame(part, self._number, middle_s, 0.0, self.settings)

    def _read(self, frame: RecordedFrame) -> Image:
        try:
            return frame.read()
        except (SessionError, OSError) as error:
            raise DeviceStateError(f"{self._replay.device}: the recorded frame cannot be read. {error}") from error


def open_device(settings: Settings, clock: Clock, connections: Connections) -> ReplayCamera:
    """Open it. Raises as :func:`rotaline.hardware.drivers.open_camera`."""
    return ReplayCamera(replay_of("camera", connections), settings.angle_tolerance_deg, clock)


def find() -> tuple[FoundDevice, ...]:
    """Recorded sessions are not looked for."""
    return ()
