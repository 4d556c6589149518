"""The properties of a webcam as OpenCV has them: set, and read back to see whether it took."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2

from rotaline.errors import DeviceStateError
from rotaline.hardware.cameras.uvc_controls import Range


@dataclass(frozen=True)
class Backend:
    """What the values of an interface of OpenCV mean.

    Attributes
    ----------
    name : how messages name it
    number : of OpenCV
    manual : value of automatic exposure that says: by hand
    to_us, from_us : exposure
    """

    name: str
    number: int
    manual: float
    to_us: Callable[[float], float]
    from_us: Callable[[float], float]


V4L2 = Backend("V4L2", cv2.CAP_V4L2, 1.0, lambda value: 100.0 * value, lambda us: float(round(us / 100.0)))
MEDIA_FOUNDATION = Backend(
    "Media Foundation", cv2.CAP_MSMF, 0.0, lambda value: 1e6 * 2.0**value, lambda us: float(round(math.log2(us * 1e-6)))
)


class Properties:
    """The properties of a camera that is open.

    Parameters
    ----------
    capture : ``cv2.VideoCapture``
    device : how messages name the camera
    """

    def __init__(self, capture: Any, backend: Backend, device: str) -> None:
        self._capture = capture
        self._backend = backend
        self._device = device

    def set_format(
        self, fourcc: str | None, width: int | None, height: int | None, frame_rate_hz: float | None
    ) -> tuple[int, int]:
        """Set what is given; width and height of the image, px.

        Raises
        ------
        DeviceStateError
            If the camera does not make it so.
        """
        if fourcc is not None:
            code = float(cv2.VideoWriter.fourcc(*fourcc))
            self._must_take(cv2.CAP_PROP_FOURCC, code, f"fourcc = '{fourcc}'", "Choose another, or leave it out.")
        if width is not None and height is not None:
            self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, float(width))
            self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, float(height))
        made = tuple(int(self._capture.get(prop)) for prop in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
        if (width, height) not in ((None, None), made):
            raise DeviceStateError(
                f"{self._device}: images of {width} x {height} px were asked for, it gives {made[0]} x {made[1]} px. State width and "
                "height (both) that it has ('v4l2-ctl --list-formats-ext' lists them)."
            )
        if frame_rate_hz is not None:
            self._must_take(
                cv2.CAP_PROP_FPS, frame_rate_hz, f"frame_rate_hz = {frame_rate_hz:g} Hz", "State one that it has."
            )
        return made[0], made[1]

    def frame_period_s(self) -> float:
        """Time between two frames as the camera says it, s; 0: it does not."""
        rate_hz = float(self._capture.get(cv2.CAP_PROP_FPS))
        return 1.0 / rate_hz if rate_hz > 0 else 0.0

    def switch_automatics_off(self, focus: float | None, white_balance_k: float | None) -> None:
        """Exposure, white balance and focus by hand, with these values; None: as they are.

        Raises
        ------
        DeviceStateError
            If one stays automatic, or the value is not taken.
        """
        advice = "Switch it off with another program ('v4l2-ctl', the maker's), or use another camera."
        self._must_take(cv2.CAP_PROP_AUTO_EXPOSURE, self._backend.manual, "automatic exposure off", advice)
        for automatic, name, value, wanted in (
            (cv2.CAP_PROP_AUTO_WB, "white balance", cv2.CAP_PROP_WB_TEMPERATURE, white_balance_k),
            (cv2.CAP_PROP_AUTOFOCUS, "focus", cv2.CAP_PROP_FOCUS, focus),
        ):
            if self._capture.get(automatic) > 0:  # 0: off already, -1: it has none
                self._must_take(automatic, 0.0, f"automatic {name} off", advice)
            if wanted is not None:
                self._must_take(value, wanted, f"{name} {wanted:g}", "State a value that it has, or leave it out.")

    def exposure_us(self) -> float:
        """The exposure."""
        return self._backend.to_us(float(self._capture.get(cv2.CAP_PROP_EXPOSURE)))

    def set_exposure_us(self, exposure_us: float) -> None:
        """Set the exposure to the nearest step; raises DeviceStateError if it is not taken."""
        value = self._backend.from_us(exposure_us)
        what = f"exposure {exposure_us:g} us (control {value:g})"
        self._must_take(cv2.CAP_PROP_EXPOSURE, value, what, "Does its manual say that the exposure can be set?")

    def gain(self) -> float:
        """The gain, in the camera's own unit."""
        return float(self._capture.get(cv2.CAP_PROP_GAIN))

    def set_gain(self, gain: float, limits: Range) -> None:
        """Set the gain to the nearest step; raises DeviceStateError if it is not taken."""
        made = float(min(limits.least + round((gain - limits.least) / limits.step) * limits.step, limits.most))
        self._must_take(
            cv2.CAP_PROP_GAIN, made, f"gain {made:g}", "Can its gain be set while automatic exposure is off?"
        )

    def _must_take(self, prop: int, value: float, what: str, advice: str) -> None:
        self._capture.set(prop, value)
        made = self._capture.get(prop)
        if abs(made - value) > 0.5:  # cameras take whole numbers
            raise DeviceStateError(f"{self._device}: {what} was asked for, it has {made:g} instead. {advice}")
