"""MindVision's library MVSDK by ctypes: the part of its C interface that a camera needs here, with its structures and status codes.

The structures are those of the vendor's ``CameraDefine.h``; pointers to lists of descriptions are not followed.
"""

import ctypes
import sys
from ctypes import POINTER, Structure, byref, c_char, c_double, c_float, c_int, c_uint, c_void_p
from typing import Any

from rotaline.errors import (
    DeviceConnectionError,
    DeviceError,
    DeviceLimitError,
    DeviceStateError,
    DeviceTimeoutError,
    LostFrameError,
)

LIBRARY_NAMES = {"win32": "MVCAMSDK_X64.dll", "darwin": "libmvsdk.dylib"}
"""By ``sys.platform``; everywhere else libMVSDK.so."""

MONO8 = 0x01080001
RGB8 = 0x02180014
CUSTOM_RESOLUTION = 0xFF
CONTINUOUS, SOFTWARE_TRIGGER, LINE_TRIGGER = 0, 1, 2

SUCCESS, NOT_SUPPORTED, TIME_OUT = 0, -4, -12

_LOST = {
    -11: "its size is wrong",
    -25: "grabbing failed",
    -26: "data are missing",
    -27: "its end is missing",
    -39: "too few bytes came",
}
_GONE = {
    -13: "input or output failed",
    -14: "communication failed",
    -15: "the bus failed",
    -16: "no camera is connected",
    -17: "no camera is connected",
    -19: "the camera is closed",
    -33: "USB control failed",
    -34: "USB transfer failed",
    -38: "the connection is lost",
}
_HELD = {-18: "it is already open", -45: "access is denied"}
_LIMITS = {-6: "the value is not valid", -7: "the value is out of bounds", -43: "the value is out of range"}


class DeviceInfo(Structure):
    """A camera that is connected (tSdkCameraDevInfo)."""

    _fields_ = [
        ("series", c_char * 32),
        ("product", c_char * 32),
        ("friendly_name", c_char * 32),
        ("link", c_char * 32),
        ("driver_version", c_char * 32),
        ("sensor", c_char * 32),
        ("port", c_char * 32),
        ("serial", c_char * 32),
        ("instance", c_uint),
    ]


class Resolution(Structure):
    """What part of the sensor is read, and how (tSdkImageResolution)."""

    _fields_ = [
        ("index", c_int),
        ("description", c_char * 32),
        ("bin_sum", c_uint),
        ("bin_average", c_uint),
        ("skip", c_uint),
        ("resample", c_uint),
        ("x", c_int),
        ("y", c_int),
        ("width_read", c_int),
        ("height_read", c_int),
        ("width", c_int),
        ("height", c_int),
        ("width_zoom_camera", c_int),
        ("height_zoom_camera", c_int),
        ("width_zoom_program", c_int),
        ("height_zoom_program", c_int),
    ]


class ExposureRange(Structure):
    """Limits of exposure (lines) and analogue gain (steps) (tSdkExpose)."""

    _fields_ = [
        ("target_min", c_uint),
        ("target_max", c_uint),
        ("gain_min", c_uint),
        ("gain_max", c_uint),
        ("gain_step", c_float),
        ("lines_min", c_uint),
        ("lines_max", c_uint),
    ]


class ResolutionRange(Structure):
    """Limits of the region (tSdkResolutionRange)."""

    _fields_ = [
        ("height_max", c_int),
        ("height_min", c_int),
        ("width_max", c_int),
        ("width_min", c_int),
        ("skip", c_uint),
        ("bin_sum", c_uint),
        ("bin_average", c_uint),
        ("resample", c_uint),
    ]


class Processing(Structure):
    """What the camera's image processing can do (tSdkIspCapacity)."""

    _fields_ = [
        (name, c_int)
        for name in (
            "mono",
            "white_balance_once",
            "auto_white_balance",
            "auto_exposure",
            "manual_exposure",
            "anti_flicker",
            "in_camera",
            "only_in_camera",
            "zoom_in_camera",
        )
    ]


class Capability(Structure):
    """What the camera can do (tSdkCameraCapbility, the vendor's spelling): lists with their lengths, then limits."""

    _fields_ = [
        ("triggers", c_void_p),
        ("n_triggers", c_int),
        ("resolutions", c_void_p),
        ("n_resolutions", c_int),
        ("colour_temperatures", c_void_p),
        ("n_colour_temperatures", c_int),
        ("media_types", c_void_p),
        ("n_media_types", c_int),
        ("frame_speeds", c_void_p),
        ("n_frame_speeds", c_int),
        ("packet_lengths", c_void_p),
        ("n_packet_lengths", c_int),
        ("n_outputs", c_int),
        ("n_inputs", c_int),
        ("look_up_tables", c_void_p),
        ("n_look_up_tables", c_int),
        ("user_data_length", c_int),
        ("parameters_in_device", c_int),
        ("exposure_in_program", c_void_p),
        ("n_exposure_in_program", c_int),
        ("exposure_in_camera", c_void_p),
        ("n_exposure_in_camera", c_int),
        ("bayer_in_program", c_void_p),
        ("n_bayer_in_program", c_int),
        ("bayer_in_camera", c_void_p),
        ("n_bayer_in_camera", c_int),
        ("exposure", ExposureRange),
        ("resolution", ResolutionRange),
        ("rgb_gains", c_int * 6),
        ("saturation", c_int * 2),
        ("gamma", c_int * 2),
        ("contrast", c_int * 2),
        ("sharpness", c_int * 2),
        ("processing", Processing),
    ]


class FrameHead(Structure):
    """What comes with a frame (tSdkFrameHead)."""

    _fields_ = [
        ("media_type", c_uint),
        ("n_bytes", c_uint),
        ("width", c_int),
        ("height", c_int),
        ("width_zoom", c_int),
        ("height_zoom", c_int),
        ("is_triggered", c_int),
        ("time_stamp", c_uint),
        ("exposure_us", c_uint),
        ("analog_gain", c_float),
        ("gamma", c_int),
        ("contrast", c_int),
        ("saturation", c_int),
        ("red_gain", c_float),
        ("green_gain", c_float),
        ("blue_gain", c_float),
    ]


class Statistic(Structure):
    """Frames since the camera was opened (tSdkFrameStatistic)."""

    _fields_ = [("total", c_int), ("captured", c_int), ("lost", c_int)]


_HANDLE_FUNCTIONS: dict[str, tuple[Any, ...]] = {
    "CameraGetCapability": (POINTER(Capability),),
    "CameraPlay": (),
    "CameraPause": (),
    "CameraStop": (),
    "CameraUnInit": (),
    "CameraClearBuffer": (),
    "CameraConnectTest": (),
    "CameraSoftTrigger": (),
    "CameraSetTriggerMode": (c_int,),
    "CameraSetTriggerCount": (c_int,),
    "CameraSetAeState": (c_int,),
    "CameraGetAeState": (POINTER(c_int),),
    "CameraSetExposureTime": (c_double,),
    "CameraGetExposureTime": (POINTER(c_double),),
    "CameraGetExposureLineTime": (POINTER(c_double),),
    "CameraSetAnalogGain": (c_int,),
    "CameraGetAnalogGain": (POINTER(c_int),),
    "CameraSetImageResolution": (POINTER(Resolution),),
    "CameraGetImageResolution": (POINTER(Resolution),),
    "CameraSetIspOutFormat": (c_uint,),
    "CameraGetFrameStatistic": (POINTER(Statistic),),
    "CameraGetImageBuffer": (POINTER(FrameHead), POINTER(c_void_p), c_uint),
    "CameraReleaseImageBuffer": (c_void_p,),
    "CameraImageProcess": (c_void_p, c_void_p, POINTER(FrameHead)),
    "CameraSetGamma": (c_int,),
    "CameraSetContrast": (c_int,),
    "CameraSetSharpness": (c_int,),
    "CameraSetSaturation": (c_int,),
    "CameraSetNoiseFilter": (c_int,),
    "CameraSetLutMode": (c_int,),
    "CameraSetMirror": (c_int, c_int),
    "CameraSetWbMode": (c_int,),
    "CameraSetGain": (c_int, c_int, c_int),
    "CameraSetFrameSpeed": (c_int,),
}
"""Functions that take the handle of the camera, then these, and return a status."""

_MAY_BE_MISSING = frozenset(
    {
        "CameraSetGamma",
        "CameraSetContrast",
        "CameraSetSharpness",
        "CameraSetSaturation",
        "CameraSetNoiseFilter",
        "CameraSetLutMode",
        "CameraSetMirror",
        "CameraSetWbMode",
        "CameraSetGain",
        "CameraSetFrameSpeed",
    }
)
"""Older libraries may lack some of these."""


class Library:
    """The library, loaded.

    Raises
    ------
    DeviceConnectionError
        If it cannot be loaded, or is something else.
    """

    def __init__(self, path: str | None) -> None:
        name = path or LIBRARY_NAMES.get(sys.platform, "libMVSDK.so")
        try:
            self._library = ctypes.CDLL(name)
            self._functions = {function: self._declared(function) for function in _HANDLE_FUNCTIONS}
            self._library.CameraSdkInit.argtypes = [c_int]
            self._library.CameraEnumerateDevice.argtypes = [POINTER(DeviceInfo), POINTER(c_int)]
            self._library.CameraInit.argtypes = [POINTER(DeviceInfo), c_int, c_int, POINTER(c_int)]
        except (OSError, AttributeError) as error:
            raise DeviceConnectionError(
                f"MindVision: the vendor's library '{name}' cannot be loaded ({error}). Install MindVision's SDK "
                "(mindvision.com.cn, Linux or Windows, 64 bit), or state where the library is: 'library' in rig.toml."
            ) from error
        check(self._library.CameraSdkInit(0), "MindVision", "starting the library")

    def _declared(self, name: str) -> Any:
        function = getattr(self._library, name, None) if name in _MAY_BE_MISSING else getattr(self._library, name)
        if function is None:
            return None
        function.argtypes = [c_int, *_HANDLE_FUNCTIONS[name]]
        function.restype = c_int
        return function

    def devices(self) -> list[DeviceInfo]:
        """The cameras that are connected."""
        found = (DeviceInfo * 16)()
        n = c_int(len(found))
        status = self._library.CameraEnumerateDevice(found, byref(n))
        if status in (-16, -17):
            return []
        check(status, "MindVision", "looking for cameras")
        return list(found[: n.value])

    def open(self, info: DeviceInfo, device: str) -> int:
        """Open a camera with the parameters of its default group; its handle."""
        handle = c_int()
        check(self._library.CameraInit(byref(info), -1, -1, byref(handle)), device, "opening it")
        return handle.value

    def status(self, function: str, handle: int, *arguments: Any) -> int:
        """Call a function; its status. One that this library lacks is not supported."""
        call = self._functions[function]
        return NOT_SUPPORTED if call is None else int(call(handle, *arguments))


def check(status: int, device: str, what: str) -> None:
    """Raise what a status means.

    Raises
    ------
    DeviceError
        The kind that fits, unless the status is success.
    """
    if status == SUCCESS:
        return
    raise _error(status, f"{device}: {what} failed with status {status}")


def _error(status: int, found: str) -> DeviceError:
    if status == TIME_OUT:
        return DeviceTimeoutError(
            f"{found} (time-out). Is the time-out longer than the exposure, and the trigger connected?"
        )
    if status in _LOST:
        return LostFrameError(
            f"{found} ({_LOST[status]}). Take the frame again; if it happens often, use another USB port or cable."
        )
    if status in _GONE:
        return DeviceConnectionError(f"{found} ({_GONE[status]}). Check cable and power, then open the camera again.")
    if status in _HELD:
        return DeviceConnectionError(f"{found} ({_HELD[status]}): another program holds the camera. Close it there.")
    if status in _LIMITS:
        return DeviceLimitError(f"{found} ({_LIMITS[status]}).")
    if status == NOT_SUPPORTED:
        return DeviceStateError(f"{found}: this model cannot do it.")
    return DeviceStateError(f"{found}. The list of status codes is in CameraStatus.h of MindVision's SDK.")
