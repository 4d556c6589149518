"""Basler cameras through pylon (the package pypylon), and pylon's emulated cameras (environment variable PYLON_CAMEMU=1).

What is common to all cameras that describe themselves by GenICam is in :mod:`rotaline.hardware.genapi`. Frames are handed out one by one from a bounded
number of buffers: what the program does not fetch in time is a gap in the camera's block ids, and so in the numbers of frames.
"""

import contextlib
import math
from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import Field

from rotaline.errors import DeviceConnectionError, DeviceStateError
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import FoundDevice, missing_library
from rotaline.hardware.genapi.camera import GenicamCamera, Options, RawFrame
from rotaline.hardware.genapi.features import Limits, Value
from rotaline.tables import Table, key

_NO_BLOCK_ID = 2**64 - 1
_CHUNKS = {"BslChunkTimestampValue": "BslChunkTimestampValue", "Timestamp": "ChunkTimestamp"}
"""Choices of ChunkSelector that say when a frame was exposed, and the feature with the value."""


class Settings(Table):
    """A Basler camera."""

    driver: Literal["pylon"] = key(..., "which driver: pylon")
    serial: str | None = key(None, "serial number of the camera; none: the only one that is connected")
    user_set: str | None = key(
        None, "settings stored in the camera to begin with: Default, UserSet1 ...; none: as it is"
    )
    pixel_format: str | None = key(None, "such as 'Mono8', 'Mono12' or 'BayerRG8'; none: as the camera has it")
    trigger_line: str = key("Line1", "input whose edge begins an exposure where the plan asks for it")
    stamp: Literal["exposure-start", "exposure-end"] = key("exposure-start", "what the camera's time stamps mark")
    buffers: Annotated[int, Field(ge=2)] = key(32, "frames that may wait for the program before one is lost")
    features: dict[str, bool | int | float | str] = key(
        {}, "further features by their GenICam names, set in this order, such as {GevSCPSPacketSize = 8192}"
    )


def open_device(settings: Settings, clock: Clock, connections: Connections) -> GenicamCamera:
    """Open the camera, for this program alone.

    Raises
    ------
    DeviceConnectionError
        If the library or the camera is not there, or another program holds it.
    DeviceStateError
        If it lacks what this program needs.
    """
    camera, device = _connect(settings)
    transport = None
    try:
        features = _Features(camera, device)
        transport = _Transport(camera, features, settings)
        return GenicamCamera(
            features,
            transport,
            clock,
            Options(
                trigger_line=settings.trigger_line,
                pixel_format=settings.pixel_format,
                stamp_at_end=settings.stamp == "exposure-end",
                features=dict(settings.features),
            ),
        )
    except BaseException:
        _close(camera)
        raise


def find() -> tuple[FoundDevice, ...]:
    """The cameras that pylon sees."""
    pylon, _ = _library()
    with _looking():
        found = pylon.TlFactory.GetInstance().EnumerateDevices()
    return tuple(
        FoundDevice("camera", "pylon", _name(one), f'driver = "pylon"\nserial = "{one.GetSerialNumber()}"')
        for one in found
    )


def _library() -> tuple[Any, Any]:
    try:
        from pypylon import genicam, pylon
    except (ImportError, OSError) as error:
        raise missing_library("pylon", "pypylon", "pylon", error) from error
    return pylon, genicam


def _connect(settings: Settings) -> tuple[Any, str]:
    """The camera, open, and how messages name it."""
    pylon, genicam = _library()
    factory = pylon.TlFactory.GetInstance()
    with _looking():
        found = factory.EnumerateDevices()
    fitting = [one for one in found if settings.serial in (None, one.GetSerialNumber())]
    if len(fitting) != 1:
        wanted = "a Basler camera" if settings.serial is None else f"the Basler camera {settings.serial}"
        raise DeviceConnectionError(
            f"pylon: {wanted} was looked for; connected: {', '.join(_name(one) for one in found) or 'none'}. Check cable, power and "
            "network address, or state 'serial' of the camera in rig.toml."
        )
    device = _name(fitting[0])
    try:
        accessible = factory.IsDeviceAccessible(fitting[0])
        if accessible:
            camera = pylon.InstantCamera(factory.CreateDevice(fitting[0]))
            camera.Open()
            return camera, device
        why = "it is there, but cannot be opened"
    except genicam.GenericException as error:
        raise _held(device, _first_line(error)) from error
    raise _held(device, why)


@contextlib.contextmanager
def _looking() -> Iterator[None]:
    """Errors of the library while nothing is open."""
    _, genicam = _library()
    try:
        yield
    except genicam.GenericException as error:
        raise DeviceConnectionError(
            f"pylon: cameras cannot be looked for ({_first_line(error)}). Check cables and network."
        ) from error


class _Features:
    """Features through the library; see :class:`rotaline.hardware.genapi.features.Features`."""

    def __init__(self, camera: Any, device: str) -> None:
        self.device = device
        self._camera = camera
        self._nodes = camera.GetNodeMap()
        _, self._genicam = _library()

    def has(self, name: str) -> bool:
        node = self._node(name)
        if name == "TriggerSoftware":  # cannot be executed before its source is chosen
            return node is not None and bool(self._genicam.IsImplemented(node))
        return node is not None and bool(self._genicam.IsAvailable(node))

    def get(self, name: str) -> Value:
        with self.doing(f"'{name}' cannot be read"):
            return self._there(name).Value

    def set(self, name: str, value: Value) -> None:
        with self.doing(f"'{name}' cannot be set to {value}"):
            node = self._there(name)
            now = node.Value
            if isinstance(now, int) and not isinstance(now, bool):
                node.Value = round(float(value))
            else:
                node.Value = type(now)(value)

    def execute(self, name: str) -> None:
        with self.doing(f"'{name}' cannot be executed"):
            self._there(name).Execute()

    def limits(self, name: str) -> Limits:
        with self.doing(f"'{name}' has no limits"):
            node = self._there(name)
            step = float(node.Inc) if isinstance(node.Value, int) else None
            return Limits(float(node.Min), float(node.Max), step)

    def unit(self, name: str) -> str:
        with self.doing(f"'{name}' has no unit"):
            return str(self._there(name).Unit)

    def entries(self, name: str) -> tuple[str, ...]:
        with self.doing(f"'{name}' has no choices"):
            return tuple(self._there(name).Symbolics)

    def check(self) -> None:
        """Raise if the camera is gone."""
        if not self._camera.IsPylonDeviceAttached() or self._camera.IsCameraDeviceRemoved():
            raise DeviceConnectionError(
                f"{self.device}: it does not answer any more. Look at its cable and power, and open it again."
            )

    @contextlib.contextmanager
    def doing(self, what: str) -> Iterator[None]:
        """Errors of the library become errors of this program."""
        try:
            yield
        except (self._genicam.GenericException, RuntimeError, ValueError, TypeError) as error:
            self.check()  # the cause may be that it is gone
            raise DeviceStateError(f"{self.device}: {what} ({_first_line(error)}).") from error

    def _node(self, name: str) -> Any | None:
        try:
            return self._nodes.GetNode(name)
        except (self._genicam.GenericException, RuntimeError):
            return None

    def _there(self, name: str) -> Any:
        node = self._node(name)
        if node is None or not self._genicam.IsAvailable(node):
            self.check()
            raise DeviceStateError(f"{self.device}: it has no feature '{name}' now. Is it an area camera?")
        return node


class _Transport:
    """Frames through the library; see :class:`rotaline.hardware.genapi.camera.Transport`."""

    def __init__(self, camera: Any, features: _Features, settings: Settings) -> None:
        self._camera = camera
        self._features = features
        self._pylon, self._genicam = _library()
        self._pixel_format = ""
        self._n_without_id = 0
        self.wraps = bool(camera.IsGigE())
        if settings.user_set is not None:
            features.set("UserSetSelector", settings.user_set)
            features.execute("UserSetLoad")
        with features.doing("buffers cannot be set up"):
            camera.MaxNumBuffer.Value = settings.buffers
        self._chunk = self._switch_chunk_on()

    def _switch_chunk_on(self) -> str | None:
        """The feature with the begin of the exposure that comes with each frame; None: there is none, the stamp of the transfer is used."""
        features = self._features
        if not features.has("ChunkModeActive"):
            return None
        features.set("ChunkModeActive", True)
        for choice, feature in _CHUNKS.items():
            if features.has("ChunkSelector") and choice in features.entries("ChunkSelector"):
                features.set("ChunkSelector", choice)
                features.set("ChunkEnable", True)
                if features.has("BslChunkTimestampSelector"):
                    features.set("BslChunkTimestampSelector", "ExposureStart")
                return feature
        features.set("ChunkModeActive", False)
        return None

    def start(self) -> None:
        self._pixel_format = str(self._features.get("PixelFormat"))
        self._n_without_id = 0
        with self._features.doing("acquisition cannot be started"):
            self._camera.StartGrabbing(self._pylon.GrabStrategy_OneByOne)

    def receive(self, timeout_s: float) -> RawFrame | None:
        with self._features.doing("frames cannot be received"):
            result = self._camera.RetrieveResult(math.ceil(1000 * timeout_s), self._pylon.TimeoutHandling_Return)
            if not result.IsValid():
                if not self._camera.IsGrabbing():
                    raise DeviceConnectionError(
                        f"{self._features.device}: the stream ended. Look at its cable and power, and open it again."
                    )
                return None
            try:
                return self._raw(result)
            finally:
                result.Release()

    def _raw(self, result: Any) -> RawFrame:
        whole = bool(result.GrabSucceeded())
        frame_id = int(result.BlockID)
        if frame_id == _NO_BLOCK_ID:  # this interface has none
            self._n_without_id += 1
            frame_id = self._n_without_id
        return RawFrame(
            data=result.GetBuffer() if whole else b"",
            pixel_format=self._pixel_format,
            width=int(result.Width),
            height=int(result.Height),
            padding_bytes=int(result.PaddingX),
            frame_id=frame_id,
            ticks=self._ticks(result) if whole else None,
            damage=None if whole else f"{result.ErrorDescription or 'error'} ({result.ErrorCode:#x})",
        )

    def _ticks(self, result: Any) -> int | None:
        if self._chunk is not None:
            try:
                return int(getattr(result, self._chunk).Value)
            except (self._genicam.GenericException, AttributeError):
                self._chunk = None  # it does not come; then none of the following frames is dated by it either
        return int(result.TimeStamp) or None  # an emulated camera has no time

    def check(self) -> None:
        self._features.check()

    def stop(self) -> None:
        with self._features.doing("acquisition cannot be stopped"):
            self._camera.StopGrabbing()

    def close(self) -> None:
        _close(self._camera)


def _close(camera: Any) -> None:
    for end in (camera.StopGrabbing, camera.Close, camera.DestroyDevice):
        with contextlib.suppress(Exception):
            end()


def _name(info: Any) -> str:
    return f"Basler {info.GetModelName()} {info.GetSerialNumber()}"


def _held(device: str, why: str) -> DeviceConnectionError:
    return DeviceConnectionError(
        f"{device}: {why}. Another program (pylon Viewer?) holds it, or this user may not open it: close the program, or see to the "
        "rights of USB devices (udev rule)."
    )


def _first_line(error: BaseException) -> str:
    return str(error).strip().partition("\n")[0]
