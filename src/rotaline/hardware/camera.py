"""What a camera is to this program.

Every call blocks until what its description says holds, or raises a :class:`rotaline.errors.DeviceError` that names the device,
the value, its unit, the limit and the next step. After an error other than a lost connection the camera can be used on.
"""

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8, UInt16

Image = UInt8[np.ndarray, "..."] | UInt16[np.ndarray, "..."]


@dataclass(frozen=True)
class Region:
    """The part of the sensor that is read, px of the sensor; (x, y) is its top-left pixel."""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True)
class CameraSettings:
    """How frames are taken.

    ``gain`` is in the camera's own unit (:attr:`CameraInfo.gain_unit`); None leaves it as it is, None for ``region`` reads the whole sensor.
    ``trigger``: what begins an exposure while the camera streams: the camera itself (free), or an edge at its input (line).
    """

    exposure_us: float
    gain: float | None = None
    region: Region | None = None
    trigger: Literal["free", "line"] = "free"


@dataclass(frozen=True)
class CameraInfo:
    """What a camera is and can.

    Attributes
    ----------
    device : how messages name it: maker, model, serial number or port
    sensor_size : width, height, px
    exposure_limits_us : least, most
    gain_limits : least, most, in ``gain_unit``; None: it cannot be set
    gain_unit : "dB", "x" or "device"
    bit_depth : of the sensor, 8 to 16; more than 8 come as uint16 with full scale 65535
    colour : frames are (h, w, 3) red, green, blue instead of (h, w)
    triggers : what can begin an exposure while it streams
    """

    device: str
    sensor_size: tuple[int, int]
    exposure_limits_us: tuple[float, float]
    gain_limits: tuple[float, float] | None = None
    gain_unit: str = "dB"
    bit_depth: int = 8
    colour: bool = False
    triggers: tuple[str, ...] = ("free",)


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """One whole frame.

    Attributes
    ----------
    image : (h, w) or (h, w, 3) red, green, blue; uint8, or uint16 with full scale 65535; owned by the frame
    number : the camera's count of exposures; a gap is a lost frame
    time_s : middle of the exposure, by the clock that the camera was opened with
    u_time_s : standard uncertainty of it
    settings : as they were
    """

    image: Image
    number: int
    time_s: float
    u_time_s: float
    settings: CameraSettings


@runtime_checkable
class Camera(Protocol):
    """A camera that is open."""

    @property
    def info(self) -> CameraInfo:
        """What it is and can."""

    @property
    def settings(self) -> CameraSettings:
        """As they are now, with nothing left out: no None but a gain that cannot be set."""

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Change the settings; returns what the camera made of them (rounded to its steps). They hold for every later exposure.

        Raises
        ------
        DeviceLimitError
            If a value is outside the limits; then nothing has changed.
        DeviceStateError
            While it streams.
        """

    def take(self, timeout_s: float) -> CameraFrame:
        """One frame whose exposure began after this call; frames from before are thrown away. Numbers count on.

        Raises
        ------
        LostFrameError
            If the frame came damaged or not at all, and another ``take`` may bring one.
        DeviceTimeoutError, DeviceConnectionError, DeviceStateError
        """

    def start(self) -> None:
        """Begin to stream: exposures follow one another, and wait in a queue of the driver for :meth:`next_frame`."""

    def next_frame(self, timeout_s: float) -> CameraFrame:
        """The next frame of the stream, in order. A frame that was lost leaves a gap in the numbers, or raises.

        Raises
        ------
        LostFrameError, DeviceTimeoutError, DeviceConnectionError
        DeviceStateError
            If it does not stream.
        """

    def stop(self) -> None:
        """End the stream; frames that nobody has asked for are thrown away. Does nothing if it does not stream."""

    def close(self) -> None:
        """Let the camera go; never raises, and may be called twice."""
