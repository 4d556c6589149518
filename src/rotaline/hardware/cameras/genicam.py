"""GigE Vision and USB3 Vision cameras, through the library ``viva-genicam``: no driver of the maker is needed."""

import contextlib
import queue
import threading
from collections.abc import Callable, Iterator
from typing import Any, Literal

from rotaline.errors import DeviceConnectionError, DeviceStateError
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import FoundDevice, missing_library
from rotaline.hardware.genapi.camera import GenicamCamera, RawFrame
from rotaline.hardware.genapi.features import Limits, Value
from rotaline.hardware.genapi.settings import GenapiSettings
from rotaline.tables import key

_FIND_MS = 400
_READ_MS = 20
_OPEN_MS = (50, 250, 1000)
"""A camera that is there answers at once; the later times are for a network that sleeps."""


class Settings(GenapiSettings):
    """A camera of rig.toml. With none of ip, mac and serial it is the only one that is connected."""

    driver: Literal["genicam"] = key(..., "genicam")
    ip: str | None = key(None, "address of a GigE camera, such as '192.168.1.20'")
    mac: str | None = key(None, "hardware address of a GigE camera, such as '00:11:22:33:44:55'")
    serial: str | None = key(None, "serial number of a USB3 camera")
    interface: str | None = key(
        None, "network interface of this computer that the camera is at: its address or name; none: all"
    )
    packet_bytes: int | None = key(
        None, "GigE packet size, byte; none: as the camera has it. Jumbo frames: 8000 or more"
    )
    packet_delay_us: float | None = key(
        None, "pause of a GigE camera between two packets, us; none: as the camera has it"
    )
    buffers: int = key(64, "frames that wait for the program before one is lost")


def open_device(settings: Settings, clock: Clock, connections: Connections) -> GenicamCamera:
    """Find the camera and take control of it.

    Raises
    ------
    DeviceConnectionError
        If it is not there, another program controls it, or the library is missing.
    DeviceStateError
        If it lacks what this program needs.
    """
    return use_camera(_connect(settings), settings, clock)


def use_camera(camera: Any, settings: Settings, clock: Clock) -> GenicamCamera:
    """A camera that ``viva_genicam`` has open; it is closed if it cannot be used."""
    features = _Features(camera)
    transport = _Transport(camera, features, settings)
    try:
        return GenicamCamera(features, transport, clock, settings.options())
    except BaseException:
        transport.close()
        raise


def find() -> list[FoundDevice]:
    """The cameras that answer, on every network interface and USB port."""
    library = _library()
    gige = _answering(library, lambda: library.discover(timeout_ms=_FIND_MS, all=True))
    usb = _answering(library, library.discover_u3v)
    found = [("ip", camera.ip, f"{camera.manufacturer} {camera.model} (GigE, {camera.ip})") for camera in gige]
    found += [
        ("serial", camera.serial, f"{camera.manufacturer} {camera.model} (USB3, {camera.serial})") for camera in usb
    ]
    return [
        FoundDevice("camera", "genicam", name, f'driver = "genicam"\n{chosen_by} = "{value}"')
        for chosen_by, value, name in found
    ]


def _library() -> Any:
    try:
        import viva_genicam
    except (ImportError, OSError) as error:
        raise missing_library("genicam", "viva-genicam", "genicam", error) from error
    return viva_genicam


def _connect(settings: Settings) -> Any:
    library = _library()
    usb = [] if settings.ip or settings.mac else _usb(library, settings.serial)
    gige = [] if settings.serial or usb else _gige(library, settings)
    which = settings.ip or settings.mac or settings.serial
    if not usb and not gige:
        raise DeviceConnectionError(
            f"genicam: {f'camera {which} does not answer' if which else 'no camera answers'}. Is it powered, and for GigE: is the computer's address in the camera's "
            "network, and does the firewall let UDP port 3956 through? 'rotaline devices' lists what is there."
        )
    if len(usb) + len(gige) > 1:
        names = ", ".join(camera.ip for camera in gige) or ", ".join(str(camera.serial) for camera in usb)
        raise DeviceConnectionError(
            f"genicam: there are several cameras ({names}). State ip or serial of the camera in rig.toml."
        )
    camera = (usb or gige)[0]
    device = f"genicam {camera.manufacturer} {camera.model} {which or (camera.serial if usb else camera.ip)}"
    try:
        return library.connect_u3v(camera) if usb else library.connect_gige(camera, iface=settings.interface)
    except library.GenicamError as error:
        if "ACCESS_DENIED" in str(error) or "busy" in str(error).lower():
            raise DeviceConnectionError(
                f"{device}: another program controls it ({error}). Close that program."
            ) from error
        raise DeviceConnectionError(
            f"{device}: it cannot be opened ({error}). Is it held by another program? For USB: may this user open it (udev rule)?"
        ) from error


def _answering(library: Any, look: Callable[[], list[Any]]) -> list[Any]:
    """What is found; nothing where the computer has no such ports."""
    try:
        return look()
    except library.GenicamError:
        return []


def _usb(library: Any, serial: str | None) -> list[Any]:
    return [camera for camera in _answering(library, library.discover_u3v) if serial is None or camera.serial == serial]


def _gige(library: Any, settings: Settings) -> list[Any]:
    fits: list[Any] = []
    for timeout_ms in _OPEN_MS:
        try:
            cameras = library.discover(timeout_ms=timeout_ms, iface=settings.interface, all=settings.interface is None)
        except library.GenicamError as error:
            raise DeviceConnectionError(
                f"genicam: the network cannot be searched for cameras ({error}). Is 'interface' one of this computer's?"
            ) from error
        fits = [
            camera
            for camera in cameras
            if (settings.ip is None or camera.ip == settings.ip)
            and (settings.mac is None or camera.mac.lower() == settings.mac.lower().replace("-", ":"))
        ]
        if fits:
            break
    return fits


class _Features:
    """Features through the library; see :class:`rotaline.hardware.genapi.features.Features`."""

    def __init__(self, camera: Any) -> None:
        self._camera = camera
        self._names = frozenset(camera.nodes())
        self._error = _library().GenicamError
        self._gone: str | None = None
        self.device = "genicam"
        parts = [
            str(self.get(name))
            for name in ("DeviceVendorName", "DeviceModelName", "DeviceSerialNumber", "DeviceID")
            if self.has(name)
        ]
        self.device = " ".join(["genicam", *parts[:3]])

    def has(self, name: str) -> bool:
        if name not in self._names:
            return False
        state = self._state(name)
        return bool(state.is_implemented and state.is_available)

    def get(self, name: str) -> Value:
        with self.doing(f"'{name}' cannot be read"):
            self._camera.invalidate(name)
        value: Value | None = self._state(name).value
        if value is None:
            raise DeviceStateError(f"{self.device}: '{name}' cannot be read now.")
        return value

    def set(self, name: str, value: Value) -> None:
        kind = self._state(name).kind
        with self.doing(f"'{name}' cannot be set to {value}"):
            if kind == "Boolean":
                self._camera.set_bool(name, bool(value))
            elif kind == "Enumeration":
                self._camera.set_enum(name, str(value))
            elif kind in ("Integer", "IntConverter"):
                self._camera.set_integer(name, round(float(value)))
            elif kind in ("Float", "Converter", "SwissKnife"):
                self._camera.set_float(name, float(value))
            else:
                self._camera.set(name, str(value))

    def execute(self, name: str) -> None:
        if self._lost():  # a camera may still send frames, but whose settings they have is not known
            self.check()
        with self.doing(f"'{name}' cannot be executed"):
            self._camera.execute(name, wait=False)

    def limits(self, name: str) -> Limits:
        state = self._state(name)
        if state.range is None:
            raise DeviceStateError(f"{self.device}: '{name}' has no limits; this camera's description is not usable.")
        least, most, step = state.range.min, state.range.max, state.range.inc
        return Limits(least, most, 1.0 if step is None and state.kind == "Integer" else step)

    def unit(self, name: str) -> str:
        return str(self._state(name).unit or "")

    def entries(self, name: str) -> tuple[str, ...]:
        return tuple(self._state(name).enum_entries or ())

    def check(self) -> None:
        """Raise if the camera does not answer, or is no longer ours."""
        self._not_gone()
        if self._lost():
            raise self._control_lost()
        try:
            self._camera.read_register(0)
        except self._error as error:
            raise self._now_gone(error) from error

    @contextlib.contextmanager
    def doing(self, what: str) -> Iterator[None]:
        """Errors of the library become ours; a camera that is gone is not asked again: each question to it takes seconds."""
        self._not_gone()
        try:
            yield
        except (self._error, ValueError, OverflowError) as error:
            if self._lost() or "ACCESS_DENIED" in str(error):
                raise self._control_lost() from error
            if "register I/O failed" in str(error) and "status" not in str(error):
                raise self._now_gone(error) from error
            self.check()  # the cause may still be that it is gone
            raise DeviceStateError(f"{self.device}: {what} ({error}).") from error

    def _not_gone(self) -> None:
        if self._gone is not None:
            raise DeviceConnectionError(self._gone)

    def _control_lost(self) -> DeviceConnectionError:
        return DeviceConnectionError(
            f"{self.device}: control of the camera is lost: another program took it, or the camera heard nothing of this one for "
            "too long (a cable, a sleeping computer). Open it again."
        )

    def _now_gone(self, error: Exception) -> DeviceConnectionError:
        self._gone = (
            f"{self.device}: it does not answer any more ({error}). Look at its cable and power, and open it again."
        )
        return DeviceConnectionError(self._gone)

    def _lost(self) -> bool:
        if self._camera.transport != "gige":
            return False
        return str(self._camera.control_state.value) != "Held"

    def _state(self, name: str) -> Any:
        with self.doing(f"'{name}' cannot be read"):
            return self._camera.feature_state(name)


class _Transport:
    """Frames through the library; see :class:`rotaline.hardware.genapi.camera.Transport`."""

    def __init__(self, camera: Any, features: _Features, settings: Settings) -> None:
        self._camera = camera
        self._features = features
        self._settings = settings
        self._reader: _Reader | None = None
        self._error = _library().GenicamError
        self.wraps = camera.transport == "gige"

    def start(self) -> None:
        delay_us = self._settings.packet_delay_us
        with self._features.doing("frames cannot be received"):
            stream = self._camera.stream(
                iface=self._settings.interface,
                packet_size=self._settings.packet_bytes,
                packet_delay_ns=None if delay_us is None else round(1000 * delay_us),
                deliver_incomplete=True,
            )
            self._reader = _Reader(stream, self._settings.buffers)
            self._camera.acquisition_start()

    def receive(self, timeout_s: float) -> RawFrame | None:
        try:
            frame = None if self._reader is None else self._reader.next_frame(timeout_s)
        except self._error as error:
            raise DeviceConnectionError(
                f"{self._features.device}: the stream ended ({error}). Open the camera again."
            ) from error
        if frame is None:
            return None
        return RawFrame(
            data=frame.payload(),
            pixel_format=frame.pixel_format,
            width=frame.width,
            height=frame.height,
            padding_bytes=frame.padding_x,
            frame_id=frame.block_id,
            ticks=frame.ts_dev,
            damage=None if frame.is_complete else _damage(frame),
        )

    def check(self) -> None:
        self._features.check()

    def stop(self) -> None:
        reader, self._reader = self._reader, None
        try:
            with self._features.doing("acquisition cannot be stopped"):
                self._camera.acquisition_stop()
        finally:
            if reader is not None:
                reader.close()

    def close(self) -> None:
        with contextlib.suppress(self._error):
            self._camera.close()


class _Reader:
    """A thread that fetches frames: the library itself keeps eight of them, and then throws the oldest away."""

    def __init__(self, stream: Any, n_frames: int) -> None:
        self._stream = stream
        self._frames: queue.Queue[Any] = queue.Queue(n_frames)
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._read, name="genicam frames", daemon=True)
        self._thread.start()

    def next_frame(self, timeout_s: float) -> Any:
        """The next frame; None: there was none in this time. Raises the library's error that ended the stream."""
        try:
            frame = self._frames.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if isinstance(frame, Exception):
            raise frame
        return frame

    def close(self) -> None:
        """End the stream."""
        self._ended.set()
        self._thread.join()  # the library lends a stream to one thread at a time
        self._stream.close()

    def _read(self) -> None:
        error = _library().GenicamError
        while not self._ended.is_set():
            try:
                frame = self._stream.next_frame(_READ_MS)
                if frame is None:
                    raise error("no more frames")
            except error as ended:
                if "timeout" in str(ended):
                    continue
                frame = ended
            with contextlib.suppress(queue.Full):  # a gap in the numbers says so
                self._frames.put_nowait(frame)
            if isinstance(frame, Exception):
                return


def _damage(frame: Any) -> str:
    if frame.missing_packets is not None:
        return f"{frame.missing_packets} packets are missing"
    if frame.device_status is not None:
        return f"the camera reports error {frame.device_status:#06x}"
    return "its end is missing"
