"""The camera of the simulated rig: it exposes by the clock and sees what the world shows."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Literal

from pydantic import Field

from rotaline.errors import DeviceConnectionError, DeviceStateError, DeviceTimeoutError, LostFrameError
from rotaline.hardware.camera import CameraFrame, CameraInfo, CameraSettings, Image, Region
from rotaline.hardware.cameras.checks import check_settings
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import FoundDevice
from rotaline.hardware.simulated.world import SimulatedWorld, world_of
from rotaline.tables import NotNegative, Table, key

_DEVICE = "simulated camera"
_EXPOSURES_US = (1.0, 10e6)
_GAINS = (0.125, 16.0)


class Settings(Table):
    """The camera of the simulated rig; lens and sensor are those of the rig that is simulated."""

    driver: Literal["simulated"] = key(..., "simulated")
    readout_ms: NotNegative = key(
        4.0, "from the end of an exposure until the frame is there, and the shortest period of a stream, ms"
    )
    queue_frames: Annotated[int, Field(ge=1)] | None = key(
        None, "frames of a stream that wait until they are asked for; further ones are lost; absent: without end"
    )


@dataclass
class _Stream:
    """A stream since ``start_s``; ``next``: which of its exposures, from 0 on, is handed out next."""

    start_s: float
    period_s: float
    first_number: int
    next: int = 0


class _RenderedFrame(CameraFrame):
    """A frame whose image may be a callable that renders the whole sensor, once the image is looked at; most frames of a stream never are."""

    _render: Callable[[], Image]

    def __init__(
        self,
        image: Image | Callable[[], Image],
        number: int,
        time_s: float,
        u_time_s: float,
        settings: CameraSettings,
    ) -> None:
        vars(self).update(number=number, time_s=time_s, u_time_s=u_time_s, settings=settings)
        vars(self)["_render" if callable(image) else "image"] = image

    @cached_property
    def image(self) -> Image:
        """The part of the sensor that is read."""
        region = self.settings.region
        assert region is not None
        x, y = region.x, region.y
        return self._render()[y : y + region.height, x : x + region.width].copy()


class SimulatedCamera:
    """See :class:`rotaline.hardware.camera.Camera`. Gain is a factor of the gain that the rig states."""

    def __init__(self, settings: Settings, clock: Clock, world: SimulatedWorld) -> None:
        world.claim(_DEVICE)
        self._clock, self._world = clock, world
        self._readout_s, self._queue_frames = settings.readout_ms * 1e-3, settings.queue_frames
        self._open, self._gone = True, False
        self._stream: _Stream | None = None
        sensor, (width, height) = world.rig.sensor, world.rig.camera.image_size
        self.info = CameraInfo(
            _DEVICE,
            (width, height),
            _EXPOSURES_US,
            _GAINS,
            gain_unit="x",
            bit_depth=sensor.bit_depth,
            colour=sensor.colour,
        )
        self.settings = CameraSettings(world.rig.light.exposure_off_ms * 1e3, 1.0, Region(0, 0, width, height))

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Change the settings; nothing is rounded."""
        self._require_there()
        if self._stream is not None:
            raise DeviceStateError(f"{_DEVICE}: its settings cannot change while it streams. Stop the stream first.")
        check_settings(self.info, settings)
        self.settings = replace(
            settings,
            gain=self.settings.gain if settings.gain is None else settings.gain,
            region=settings.region or Region(0, 0, *self.info.sensor_size),
        )
        return self.settings

    def take(self, timeout_s: float) -> CameraFrame:
        """Expose, read out, and hand over."""
        self._require_there()
        if self._stream is not None:
            raise DeviceStateError(f"{_DEVICE}: it takes no single frame while it streams. Stop the stream first.")
        number, start_s = self._world.count("frames"), self._clock.now_s()
        self._wait_for(number, start_s + self._exposure_s + self._readout_s, timeout_s)
        if number in self._world.faults.lost_frames:
            raise LostFrameError(f"{_DEVICE}: frame {number} did not arrive. Take it again.")
        return self._frame(number, start_s, streamed=False)

    def start(self) -> None:
        """Begin to stream: the first exposure begins now, each further one a period later."""
        self._require_there()
        if self._stream is not None:
            raise DeviceStateError(f"{_DEVICE}: it streams already. Stop the stream first.")
        period_s = max(self._exposure_s, self._readout_s)
        self._stream = _Stream(self._clock.now_s(), period_s, self._world.counts["frames"] + 1)

    def next_frame(self, timeout_s: float) -> CameraFrame:
        """The next frame of the stream."""
        self._require_there()
        stream = self._stream
        if stream is None:
            raise DeviceStateError(f"{_DEVICE}: it does not stream. Start it first.")
        begun_s, faults = self._clock.now_s(), self._world.faults
        if self._queue_frames is not None:
            delay_s = self._exposure_s + self._readout_s
            n_arrived = int((begun_s - delay_s - stream.start_s) // stream.period_s) + 1
            stream.next = max(stream.next, n_arrived - self._queue_frames)
        while stream.first_number + stream.next in faults.lost_frames:
            stream.next += 1
        number, start_s = stream.first_number + stream.next, stream.start_s + stream.next * stream.period_s
        self._wait_for(number, start_s + self._exposure_s + self._readout_s, timeout_s)
        stream.next += 1
        self._world.counts["frames"] = number
        return self._frame(number, start_s, streamed=True)

    def stop(self) -> None:
        """End the stream; exposures that have begun count."""
        stream = self._stream
        if self._open and stream is not None:
            n_begun = int((self._clock.now_s() - stream.start_s) // stream.period_s) + 1
            self._world.counts["frames"] = stream.first_number + max(n_begun, stream.next) - 1
        self._stream = None

    def close(self) -> None:
        """Let it go."""
        if self._open:
            self.stop()
            self._open = False
            self._world.release(_DEVICE)

    @property
    def _exposure_s(self) -> float:
        return self.settings.exposure_us * 1e-6

    def _require_there(self) -> None:
        if not self._open:
            raise DeviceStateError(f"{_DEVICE}: it has been closed. Open it again.")
        if self._gone:
            raise self._unplugged()

    def _unplugged(self) -> DeviceConnectionError:
        return DeviceConnectionError(f"{_DEVICE}: it is gone. Plug it in, and open it again.")

    def _wait_for(self, number: int, arrives_s: float, timeout_s: float) -> None:
        """Wait until a frame is there, up to the time-out; or until it turns out that it does not come."""
        wait_s = arrives_s + self._world.faults.late_frames.get(number, 0.0) - self._clock.now_s()
        if wait_s > timeout_s:
            self._clock.wait(timeout_s)
            raise DeviceTimeoutError(
                f"{_DEVICE}: frame {number} did not arrive within {timeout_s:g} s; exposure and read-out take "
                f"{self._exposure_s + self._readout_s:g} s. Give it more time, or see whether the camera is overloaded."
            )
        self._clock.wait(wait_s)
        if number in self._world.faults.camera_gone_at_frames:
            self._world.counts["frames"] = number
            self._gone, self._stream = True, None
            raise self._unplugged()

    def _frame(self, number: int, start_s: float, *, streamed: bool) -> CameraFrame:
        if number in self._world.faults.damaged_frames:
            raise LostFrameError(f"{_DEVICE}: frame {number} arrived in pieces. Take it again.")
        settings = self.settings
        assert settings.gain is not None
        render = self._world.expose(start_s, settings.exposure_us, settings.gain, streamed=streamed)
        return _RenderedFrame(render, number, start_s + self._exposure_s / 2, 0.0, settings)


def open_device(settings: Settings, clock: Clock, connections: Connections) -> SimulatedCamera:
    """The camera of the world that is provided as "world"."""
    return SimulatedCamera(settings, clock, world_of(_DEVICE, clock, connections))


def find() -> tuple[FoundDevice, ...]:
    """It is always there."""
    return (FoundDevice("camera", "simulated", _DEVICE, '[camera]\ndriver = "simulated"\n'),)
