"""The features of a GenICam camera: numbers, choices and commands with names that the standard (SFNC) gives them."""

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from rotaline.errors import DeviceError, DeviceLimitError, DeviceStateError
from rotaline.hardware.camera import CameraInfo, Region

Value = bool | int | float | str

EXPOSURE = ("ExposureTime", "ExposureTimeAbs")
"""In us; cameras from before SFNC 1.5 have the second."""
GAIN = ("Gain", "GainRaw", "GainAbs")


@dataclass(frozen=True)
class Limits:
    """Least and most of a number now, and its step; None: any number between."""

    least: float
    most: float
    step: float | None = None


@runtime_checkable
class Features(Protocol):
    """Features by name; values are read from the camera, not from a memory of them. Errors are DeviceErrors that name the device."""

    device: str

    def has(self, name: str) -> bool:
        """Whether the camera has it, and it is available now."""

    def get(self, name: str) -> Value:
        """Its value; of a choice, the name of the entry."""

    def set(self, name: str, value: Value) -> None:
        """Change it; an integer takes a float that is whole."""

    def execute(self, name: str) -> None:
        """Execute a command; returns when the camera has acknowledged it."""

    def limits(self, name: str) -> Limits:
        """Of a number."""

    def unit(self, name: str) -> str:
        """Of a number; empty: it says none."""

    def entries(self, name: str) -> tuple[str, ...]:
        """Of a choice, those that can be chosen now."""


def first_of(features: Features, names: tuple[str, ...]) -> str | None:
    """The first of these names that the camera has."""
    return next((name for name in names if features.has(name)), None)


def choose(features: Features, name: str, entry: str) -> bool:
    """Set a choice if the camera has it and the entry; returns whether it has."""
    if not features.has(name) or entry not in features.entries(name):
        return False
    if features.get(name) != entry:
        features.set(name, entry)
    return True


def set_given(features: Features, given: dict[str, Value]) -> None:
    """Set what the user states, in this order.

    Raises
    ------
    DeviceStateError
        If there is no such feature.
    """
    for name, value in given.items():
        if not features.has(name):
            raise DeviceStateError(
                f"{features.device}: it has no feature '{name}' now. Mend it in 'features' of the camera."
            )
        features.set(name, value)


def make_manual(features: Features) -> None:
    """Nothing adjusts itself, and frames follow one another without an end."""
    for name in ("ExposureAuto", "GainAuto", "BalanceWhiteAuto"):
        choose(features, name, "Off")
    choose(features, "ExposureMode", "Timed")
    choose(features, "AcquisitionMode", "Continuous")
    choose(features, "TriggerSelector", "FrameStart")
    choose(features, "GainSelector", "All")


def describe(features: Features, exposure_us: float | None, bit_depth: int, colour: bool, line: str) -> CameraInfo:
    """What the camera is and can.

    Parameters
    ----------
    exposure_us : of a camera whose exposure cannot be set
    line : the input that can begin an exposure

    Raises
    ------
    DeviceStateError
        If its exposure cannot be set, and nobody says what it is.
    """
    exposure, gain = first_of(features, EXPOSURE), first_of(features, GAIN)
    if exposure is None and exposure_us is None:
        raise DeviceStateError(
            f"{features.device}: it has no ExposureTime. State 'exposure_us' of the camera, the time that it exposes by itself."
        )
    limits = Limits(exposure_us or 0.0, exposure_us or 0.0) if exposure is None else features.limits(exposure)
    gain_limits = None if gain is None else features.limits(gain)
    triggers = ("free", "line") if line in trigger_sources(features) else ("free",)
    return CameraInfo(
        device=features.device,
        sensor_size=sensor_size(features),
        exposure_limits_us=(limits.least, limits.most),
        gain_limits=None if gain_limits is None else (gain_limits.least, gain_limits.most),
        gain_unit="dB" if gain is not None and features.unit(gain).lower() == "db" else "device",
        bit_depth=bit_depth,
        colour=colour,
        triggers=triggers,
    )


def trigger_sources(features: Features) -> tuple[str, ...]:
    """What can begin an exposure; none if the camera runs free only."""
    if not (features.has("TriggerMode") and features.has("TriggerSource")):
        return ()
    return features.entries("TriggerSource")


def sensor_size(features: Features) -> tuple[int, int]:
    """Width and height that can be read, with the camera's binning as it is, px. Its region is as before."""
    before = read_region(features)
    _offsets(
        features, Region(0, 0, before.width, before.height)
    )  # many cameras leave less width where there is an offset
    size = int(features.limits("Width").most), int(features.limits("Height").most)
    _offsets(features, before)
    return size


def read_region(features: Features) -> Region:
    """The region that is read."""
    x, y = (int(features.get(name)) if features.has(name) else 0 for name in ("OffsetX", "OffsetY"))
    return Region(x, y, int(features.get("Width")), int(features.get("Height")))


def region_on_steps(features: Features, region: Region, sensor: tuple[int, int]) -> Region:
    """The smallest region on the camera's steps that holds the one that is wanted, as far as the sensor goes.

    Raises
    ------
    DeviceLimitError
        If it begins where the camera cannot begin.
    """
    for name, offset in (("OffsetX", region.x), ("OffsetY", region.y)):
        if offset > 0 and not features.has(name):
            raise DeviceLimitError(
                f"{features.device}: the region at ({region.x}, {region.y}) px cannot be read: this camera has no {name}. Choose 0."
            )
    x, width = _span(features, region.x, region.width, sensor[0], "OffsetX", "Width")
    y, height = _span(features, region.y, region.height, sensor[1], "OffsetY", "Height")
    return Region(x, y, width, height)


def set_region(features: Features, region: Region) -> None:
    """Set a region; the order reaches any region from any other."""
    _offsets(features, Region(0, 0, region.width, region.height))
    features.set("Width", region.width)
    features.set("Height", region.height)
    _offsets(features, region)


def set_number(features: Features, name: str, value: float) -> None:
    """Set a number to the nearest of its steps."""
    limits = features.limits(name)
    if limits.step:
        most = math.floor((limits.most - limits.least) / limits.step + 1e-9)
        value = limits.least + min(max(round((value - limits.least) / limits.step), 0), most) * limits.step
    features.set(name, value)


def is_ready_for_trigger(features: Features) -> bool:
    """Whether the camera waits for a trigger; True where it does not say."""
    try:
        if not features.has("AcquisitionStatus") or not choose(
            features, "AcquisitionStatusSelector", "FrameTriggerWait"
        ):
            return True
        return bool(features.get("AcquisitionStatus"))
    except DeviceError:
        return True


def _offsets(features: Features, region: Region) -> None:
    for name, value in (("OffsetX", region.x), ("OffsetY", region.y)):
        if features.has(name) and int(features.get(name)) != value:
            features.set(name, value)


def _span(features: Features, offset: int, size: int, whole: int, offset_name: str, size_name: str) -> tuple[int, int]:
    offset_step = int((features.limits(offset_name).step or 1) if features.has(offset_name) else 1)
    limits = features.limits(size_name)
    step = int(limits.step or 1)
    begin = offset // offset_step * offset_step
    wanted = max(offset + size - begin, int(limits.least))
    width = int(limits.least) + -(-(wanted - int(limits.least)) // step) * step
    while begin + width > whole:
        width -= step
    return begin, width
