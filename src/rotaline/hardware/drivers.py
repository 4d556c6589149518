"""The drivers by name. An adapter is imported when it is needed, a vendor's library only when a device is opened or looked for.

A driver NAME of a camera is the module ``hardware/cameras/NAME.py`` (``-`` becomes ``_``); turntables and lasers likewise. It has

``Settings``
    a :class:`rotaline.tables.Table` with a key ``driver: Literal["NAME"]``: what stands in rig.toml
``open_device(settings, clock, connections)``
    the open device: a :class:`~rotaline.hardware.camera.Camera`, :class:`~rotaline.hardware.turntable.Turntable` or
    :class:`~rotaline.hardware.laser.Laser`
``find()``
    the devices that are connected, as :class:`FoundDevice`; raises :class:`~rotaline.errors.DeviceConnectionError` if the library is missing
"""

import importlib
from dataclasses import dataclass
from typing import Any, Literal, cast

from rotaline.errors import DeviceConnectionError
from rotaline.hardware.camera import Camera
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.laser import Laser
from rotaline.hardware.turntable import Turntable
from rotaline.tables import Table

Kind = Literal["camera", "turntable", "laser"]

KINDS: tuple[Kind, ...] = ("camera", "turntable", "laser")

DRIVERS: dict[Kind, tuple[str, ...]] = {
    "camera": ("genicam", "gentl", "pylon", "uvc", "mindvision", "simulated", "replay"),
    "turntable": ("gcode", "standa", "manual", "simulated", "replay"),
    "laser": ("gcode", "manual", "simulated", "replay"),
}

_FOLDERS = {"camera": "cameras", "turntable": "turntables", "laser": "lasers"}


@dataclass(frozen=True)
class FoundDevice:
    """A device that is connected: what it is, and the lines of rig.toml that choose it."""

    kind: Kind
    driver: str
    name: str
    toml: str


def missing_library(device: str, package: str, extra: str, error: ImportError | OSError) -> DeviceConnectionError:
    """The error for a driver whose library is not installed."""
    return DeviceConnectionError(
        f"{device}: the library '{package}' cannot be loaded ({error}). Install it: pip install 'rotaline[{extra}]'."
    )


def _module(kind: Kind, driver: str) -> Any:
    return importlib.import_module(f"rotaline.hardware.{_FOLDERS[kind]}.{driver.replace('-', '_')}")


def settings_type(kind: Kind, driver: str) -> type[Table]:
    """What rig.toml may state about a device of this driver.

    Raises
    ------
    KeyError
        If there is no such driver.
    """
    if driver not in DRIVERS[kind]:
        raise KeyError(driver)
    return cast(type[Table], _module(kind, driver).Settings)


def find_devices(kind: Kind, driver: str) -> tuple[FoundDevice, ...]:
    """The devices that a driver sees.

    Raises
    ------
    DeviceConnectionError
        If its library is not installed.
    """
    return tuple(_module(kind, driver).find())


def open_camera(settings: Table, clock: Clock, connections: Connections) -> Camera:
    """Open the camera that a table of rig.toml describes.

    Raises
    ------
    DeviceError
        If it is not there, held by another program, or its library is missing.
    """
    return cast(Camera, _module("camera", settings.driver).open_device(settings, clock, connections))  # type: ignore[attr-defined]


def open_turntable(settings: Table, clock: Clock, connections: Connections) -> Turntable:
    """Open the turntable that a table of rig.toml describes; raises as :func:`open_camera`."""
    return cast(Turntable, _module("turntable", settings.driver).open_device(settings, clock, connections))  # type: ignore[attr-defined]


def open_laser(settings: Table, clock: Clock, connections: Connections) -> Laser:
    """Open the laser that a table of rig.toml describes; it is off. Raises as :func:`open_camera`."""
    return cast(Laser, _module("laser", settings.driver).open_device(settings, clock, connections))  # type: ignore[attr-defined]
