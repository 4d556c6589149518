"""Cameras through a GenTL producer: the library (``*.cti``) that comes with the maker's software, driven by ``harvesters``."""

import contextlib
import logging
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal

from rotaline.errors import DeviceConnectionError, DeviceStateError, LostFrameError
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import FoundDevice, missing_library
from rotaline.hardware.genapi.camera import GenicamCamera, RawFrame
from rotaline.hardware.genapi.features import Limits, Value
from rotaline.hardware.genapi.settings import GenapiSettings
from rotaline.tables import key

_PATHS = "GENICAM_GENTL64_PATH"
_READABLE, _NOT_AVAILABLE = (3, 4), (0, 1)
"""Access modes of GenApi: not implemented 0, not available 1, write only 2, read only 3, read and write 4."""


class Settings(GenapiSettings):
    """A camera of rig.toml. With neither serial nor id it is the only one that the producer sees."""

    driver: Literal["gentl"] = key(..., "gentl")
    producer: str | None = key(
        None, "path of the GenTL producer (.cti); none: those in the folders of GENICAM_GENTL64_PATH"
    )
    serial: str | None = key(None, "serial number of the camera")
    id: str | None = key(None, "the producer's name for the camera, where serial numbers are not unique")
    buffers: int = key(16, "frames that wait for the program before one is lost")


def open_device(settings: Settings, clock: Clock, connections: Connections) -> GenicamCamera:
    """Load the producer and open the camera.

    Raises
    ------
    DeviceConnectionError
        If there is no producer or camera, another program holds it, or the library is missing.
    DeviceStateError
        If it lacks what this program needs.
    """
    paths = _producers(settings.producer)
    producers: _Producers = connections.shared(("gentl", *paths), lambda: _Producers(paths))
    acquirer = _create(producers.harvester, settings)
    features = _Features(acquirer)
    transport = _Transport(acquirer, features, settings.buffers)
    try:
        return GenicamCamera(features, transport, clock, settings.options())
    except BaseException:
        transport.close()
        raise


def find() -> list[FoundDevice]:
    """The cameras that the producers in the folders of GENICAM_GENTL64_PATH see; without a producer there is none."""
    _library()
    found = []
    for path in _installed():
        producers = _Producers((path,))
        try:
            for device in producers.harvester.device_info_list:
                chosen_by, value = ("serial", device.serial_number) if device.serial_number else ("id", device.id_)
                toml = f'driver = "gentl"\nproducer = \'{path}\'\n{chosen_by} = "{value}"'  # a path of Windows as it is
                found.append(FoundDevice("camera", "gentl", f"{device.display_name} ({Path(path).name})", toml))
        finally:
            producers.close()
    return found


def _library() -> Any:
    try:
        import harvesters.core
    except (ImportError, OSError) as error:
        raise missing_library("gentl", "harvesters", "gentl", error) from error
    return harvesters.core


def _library_errors() -> tuple[type[Exception], ...]:
    from genicam import genapi, gentl

    return (gentl.GenericException, genapi.GenericException, ValueError, AttributeError, OSError)


def _installed() -> tuple[str, ...]:
    folders = [Path(folder) for folder in os.environ.get(_PATHS, "").split(os.pathsep) if folder]
    return tuple(str(path) for folder in folders for path in sorted(folder.glob("*.cti")))


def _producers(path: str | None) -> tuple[str, ...]:
    if path is not None:
        if not Path(path).is_file():
            raise DeviceConnectionError(
                f"gentl: there is no producer {path}. State the .cti file of the camera's maker as 'producer'."
            )
        return (path,)
    paths = _installed()
    if not paths:
        raise DeviceConnectionError(
            f"gentl: no GenTL producer (.cti) is in the folders of {_PATHS} ({os.environ.get(_PATHS) or 'not set'}). Install the "
            "software of the camera's maker, or state 'producer' of the camera in rig.toml."
        )
    return paths


class _Producers:
    """Loaded producers; a process can load each of them only once."""

    def __init__(self, paths: tuple[str, ...]) -> None:
        self.harvester = _library().Harvester(
            logger=logging.Logger("harvesters", logging.CRITICAL + 1)
        )  # errors are raised
        try:
            for path in paths:
                self.harvester.add_file(path)
            self.harvester.update()
        except _library_errors() as error:
            self.close()
            raise DeviceConnectionError(f"gentl: {', '.join(paths)} cannot be loaded ({error}).") from error

    def close(self) -> None:
        """Unload them."""
        self.harvester.reset()


def _create(harvester: Any, settings: Settings) -> Any:
    cameras = [
        camera
        for camera in harvester.device_info_list
        if settings.serial in (None, camera.serial_number) and settings.id in (None, camera.id_)
    ]
    which = settings.serial or settings.id
    if not cameras:
        raise DeviceConnectionError(
            f"gentl: no camera{f' {which}' if which else ''} is seen through {', '.join(harvester.files)}. Is it powered and plugged in, "
            "does the maker's own program see it, is this a producer for this computer, and used by this program only once?"
        )
    if len(cameras) > 1:
        names = ", ".join(f"{camera.id_} (serial {camera.serial_number})" for camera in cameras)
        raise DeviceConnectionError(
            f"gentl: there are several cameras: {names}. State serial or id of the camera in rig.toml."
        )
    try:
        return harvester.create(cameras[0])
    except _library_errors() as error:
        name = f"gentl {cameras[0].display_name}"
        if type(error).__name__ in ("ResourceInUseException", "AccessDeniedException"):
            raise DeviceConnectionError(f"{name}: another program holds it ({error}). Close that program.") from error
        raise DeviceConnectionError(f"{name}: it cannot be opened ({error}). Is it held by another program?") from error


class _Features:
    """Features through the library; see :class:`rotaline.hardware.genapi.features.Features`."""

    def __init__(self, acquirer: Any) -> None:
        self._nodes = acquirer.remote_device.node_map
        self._errors = _library_errors()
        self._gone: str | None = None
        device = acquirer.device.module
        self.device = f"gentl {device.vendor} {device.model} {device.serial_number or device.id_}"

    def has(self, name: str) -> bool:
        node = getattr(self._nodes, name, None)
        if node is None:
            return False
        with self.doing(f"'{name}' cannot be read"):
            return int(node.get_access_mode()) not in _NOT_AVAILABLE

    def get(self, name: str) -> Value:
        node = self._node(name)
        with self.doing(f"'{name}' cannot be read"):
            node.node.invalidate_node()
            value: Value = node.value
            return value

    def set(self, name: str, value: Value) -> None:
        node = self._node(name)
        with self.doing(f"'{name}' cannot be set to {value}"):
            if type(node).__name__ == "IInteger":
                node.value = round(float(value))
            elif type(node).__name__ == "IFloat":
                node.value = float(value)
            else:
                node.value = value

    def execute(self, name: str) -> None:
        node = self._node(name)
        with self.doing(f"'{name}' cannot be executed"):
            node.execute()

    def limits(self, name: str) -> Limits:
        node = self._node(name)
        with self.doing(f"'{name}' has no limits"):
            step = float(node.inc) if type(node).__name__ == "IInteger" or node.has_inc() else None
            return Limits(float(node.min), float(node.max), step)

    def unit(self, name: str) -> str:
        return str(self._node(name).unit or "")

    def entries(self, name: str) -> tuple[str, ...]:
        node = self._node(name)
        with self.doing(f"'{name}' cannot be read"):
            return tuple(str(entry) for entry in node.symbolics)

    def check(self) -> None:
        """Raise if the camera does not answer."""
        self._not_gone()
        try:
            node = next(
                n for n in (getattr(self._nodes, name, None) for name in ("DeviceModelName", "Width")) if n is not None
            )
            node.node.invalidate_node()
            if int(node.get_access_mode()) in _READABLE:
                _ = node.value
        except self._errors as error:
            self._gone = (
                f"{self.device}: it does not answer any more ({error}). Look at its cable and power, and open it again."
            )
            raise DeviceConnectionError(self._gone) from error

    @contextlib.contextmanager
    def doing(self, what: str) -> Iterator[None]:
        """Errors of the library become ours; a camera that is gone is not asked again."""
        self._not_gone()
        try:
            yield
        except self._errors as error:
            self.check()  # the cause may be that it is gone
            raise DeviceStateError(f"{self.device}: {what} ({error}).") from error

    def _not_gone(self) -> None:
        if self._gone is not None:
            raise DeviceConnectionError(self._gone)

    def _node(self, name: str) -> Any:
        node = getattr(self._nodes, name, None)
        if node is None:
            raise DeviceStateError(f"{self.device}: it has no feature '{name}'.")
        return node


def _calling(function: Callable[[], None]) -> Any:
    """A callback as the library wants it."""
    base: Any = _library().Callback

    class Calling(base):
        def emit(self, context: object | None = None) -> None:
            function()

    return Calling()


class _Transport:
    """Frames through the library; see :class:`rotaline.hardware.genapi.camera.Transport`."""

    def __init__(self, acquirer: Any, features: _Features, n_buffers: int) -> None:
        from harvesters.util.pfnc import symbolics

        self._acquirer = acquirer
        self._features = features
        self._errors = _library_errors()
        self._incomplete = 0
        self._names_of_formats: dict[int, str] = symbolics
        self.wraps = acquirer.device.module.tl_type == "GEV"
        acquirer.num_buffers = n_buffers
        acquirer.add_callback(acquirer.Events.INCOMPLETE_BUFFER, _calling(self._count))

    def start(self) -> None:
        with self._features.doing("frames cannot be received"):
            self._acquirer.start()

    def receive(self, timeout_s: float) -> RawFrame | None:
        before = self._incomplete
        with self._features.doing("the stream ended"):
            buffer = self._acquirer.try_fetch(timeout=timeout_s, is_raw=True)
            if buffer is None:
                if self._incomplete > before:
                    raise LostFrameError(f"{self._features.device}: a frame came incomplete. Take it again.")
                return None
            try:
                return self._raw(buffer)
            finally:
                buffer.parent.queue_buffer(buffer)

    def check(self) -> None:
        self._features.check()

    def stop(self) -> None:
        with self._features.doing("acquisition cannot be stopped"):
            self._acquirer.stop()

    def close(self) -> None:
        with contextlib.suppress(*self._errors):
            self._acquirer.destroy()

    def _count(self) -> None:
        self._incomplete += 1

    def _raw(self, buffer: Any) -> RawFrame:
        code, width, height = int(buffer.pixel_format), int(buffer.width), int(buffer.height)
        padding_bytes = int(self._optional(lambda: buffer.padding_x) or 0)
        offset = int(self._optional(lambda: buffer.image_offset) or 0)
        bits = code >> 16 & 0xFF  # a pixel, as the naming convention codes it
        n_bytes = ((width * bits + 7) // 8 + padding_bytes) * height
        return RawFrame(
            data=bytes(memoryview(buffer.raw_buffer)[offset : offset + n_bytes]),  # the producer will write over it
            pixel_format=self._names_of_formats.get(code, f"{code:#010x}"),
            width=width,
            height=height,
            padding_bytes=padding_bytes,
            frame_id=self._optional(lambda: int(buffer.frame_id)),
            ticks=self._optional(lambda: int(buffer.timestamp)),
        )

    def _optional(self, read: Callable[[], Any]) -> Any:
        """What a producer need not know."""
        try:
            return read()
        except self._errors:
            return None
