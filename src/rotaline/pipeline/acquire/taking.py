"""One frame, surely: lit, exposed, whole, and not one from before; taken again where it was lost or came late."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Any

from rotaline.errors import DeviceStateError, DeviceTimeoutError, LostFrameError
from rotaline.hardware.camera import Camera, CameraFrame, Image
from rotaline.hardware.rig import OpenRig
from rotaline.io.acquired_session import AcquiredSession
from rotaline.io.plan_tables import PlanCapture
from rotaline.pipeline.acquire.exposure import FoundExposure, better_exposure, expose_scene, expose_stripe
from rotaline.pipeline.acquire.person import Person
from rotaline.pipeline.acquire.tasks import FrameTask
from rotaline.pipeline.observer import Observer

ATTEMPTS = 5
_SPARE_S = 5.0
"""Beyond the exposure, until a frame counts as missing."""
_FIRST_US = 10_000.0
"""Where the search for an exposure begins, whatever was before: an interruption changes nothing of what comes after it."""


@dataclass(frozen=True, eq=False)
class FrameTaken:
    """A frame that has just been taken, and how far the capture is; for those who watch.

    ``n_waiting``: frames on their way to the disk; ``n_retaken``: frames that were lost and taken again, in all.
    """

    capture: PlanCapture
    n_done: int
    n_planned: int
    image: Image
    angle_deg: float | None
    laser: bool
    exposure_us: float
    n_waiting: int
    n_retaken: int


Watch = Callable[[FrameTaken], None]


def take_surely(camera: Camera, lost: Callable[[str], None], after: int | None = None) -> CameraFrame:
    """A frame whose exposure began after this call; a lost or late one is taken again, and ``lost`` hears of it.

    Parameters
    ----------
    camera : Camera
    lost : hears what went wrong
    after : number of the frame before; one that is not later has been seen already

    Raises
    ------
    LostFrameError, DeviceTimeoutError
        If that did not help.
    DeviceConnectionError, DeviceStateError
    """
    timeout_s = camera.settings.exposure_us * 1e-6 + _SPARE_S
    for attempt in range(1, ATTEMPTS + 1):
        try:
            frame = camera.take(timeout_s)
            if after is not None and frame.number <= after:
                raise LostFrameError(
                    f"{camera.info.device}: frame {frame.number} came, but frame {after} was there already: an old one."
                )
            return frame
        except (LostFrameError, DeviceTimeoutError) as error:
            if attempt == ATTEMPTS:
                raise type(error)(f"{error} It was tried {ATTEMPTS} times.") from error
            lost(f"{error} Taken again ({attempt} of {ATTEMPTS - 1}).")
    raise AssertionError("unreachable")


class Taker:
    """Takes the frames of a plan: switches the laser, sets the camera, finds exposures and keeps to them.

    Parameters
    ----------
    rig : OpenRig
    session : AcquiredSession   remembers what another start has to keep to
    person : Person   is told what is taken aside
    observer : Observer
    warm_up_s : the laser is on for so long before the first frame with it
    """

    def __init__(
        self, rig: OpenRig, session: AcquiredSession, person: Person, observer: Observer, warm_up_s: float
    ) -> None:
        self.rig, self._session, self._person, self._observer = rig, session, person, observer
        self.n_retaken = 0
        self._warm_up_s = warm_up_s
        self._kept: dict[str, Any] = session.remembered()
        self._gain = self._keep("gain", rig.camera.settings.gain)
        self._wanted = rig.camera.settings
        self._preview_us = self._clipped(_FIRST_US)
        self._number: int | None = None
        self._began = datetime.now(UTC), rig.clock.now_s()

    def time_of(self, frame: CameraFrame) -> str:
        """UTC of the middle of its exposure."""
        utc, clock_s = self._began
        return _text(utc + timedelta(seconds=frame.time_s - clock_s))

    def event(self, kind: str, text: str, **figures: Any) -> None:
        """Record what happened."""
        self._session.event(_text(datetime.now(UTC)), kind, text, **figures)

    def lost(self, text: str) -> None:
        """A frame was lost and is taken again."""
        self.n_retaken += 1
        self._observer.note(text)
        self.event("retaken", text)

    def take(self, capture: PlanCapture, task: FrameTask) -> CameraFrame:
        """The frame of a task, now."""
        self.light(task.laser)
        self.expose(capture, self.exposure_us(capture, task.laser) * task.factor)
        return self._take()

    def preview(self, capture: PlanCapture) -> CameraFrame:
        """A frame of now without the laser; until the exposure has been found, it follows the light."""
        with self._person.aside("preview"):
            if capture.exposure_off_us != "auto" or _name(capture, laser=False) in self._kept:
                return self.take(capture, FrameTask("", laser=False))
            self.light(False)
            self.expose(capture, self._preview_us)
            frame = self._take()
            limits_us = self.rig.camera.info.exposure_limits_us
            self._preview_us = better_exposure(frame.image, frame.settings.exposure_us, limits_us)
            return frame

    def light(self, on: bool) -> None:
        """Laser on or off."""
        laser = self.rig.laser
        if laser is None or laser.is_on == on:
            return
        if not on:
            laser.off()
            return
        laser.on()
        if self._warm_up_s > 0:
            self._observer.note(f"The laser warms up for {self._warm_up_s:g} s.")
            self.rig.clock.wait(self._warm_up_s)
            self._warm_up_s = 0.0

    def expose(self, capture: PlanCapture, exposure_us: float) -> None:
        """Set the camera."""
        camera = self.rig.camera
        gain = self._gain if capture.gain is None else capture.gain
        wanted = replace(self._wanted, exposure_us=exposure_us, gain=gain)
        if wanted != self._wanted:
            camera.configure(wanted)
            self._wanted = wanted

    def exposure_us(self, capture: PlanCapture, laser: bool) -> float:
        """As the plan states it, or as it was found for this capture."""
        stated = capture.exposure_on_us if laser else capture.exposure_off_us
        if stated != "auto":
            return stated
        name = _name(capture, laser)
        if name not in self._kept:
            with self._person.aside("exposure"):
                found = self._find_exposure(capture, laser)
            self._say(capture, laser, found)
            self._keep(name, found.exposure_us)
        return float(self._kept[name])

    def require_same_images(self, frame: CameraFrame) -> None:
        """All frames of a session are of one size and depth.

        Raises
        ------
        DeviceStateError
            If this one is of another.
        """
        found = [*frame.image.shape[1::-1], 8 * frame.image.itemsize, "colour" if frame.image.ndim == 3 else "grey"]
        first = self._kept.get("images") or self._keep("images", found)
        if found != first:
            raise DeviceStateError(
                f"{self.rig.camera.info.device}: its frames are {_images(found)}; the session was begun with {_images(first)}. Set the camera "
                "as it was, or acquire into another folder."
            )

    def _take(self) -> CameraFrame:
        frame = take_surely(self.rig.camera, self.lost, self._number)
        self._number = frame.number
        return frame

    def _find_exposure(self, capture: PlanCapture, laser: bool) -> FoundExposure:
        def take_at(exposure_us: float) -> CameraFrame:
            self.expose(capture, exposure_us)
            return self._take()

        low, high = self.rig.camera.info.exposure_limits_us
        if not laser:
            return expose_scene(take_at, self._preview_us, (low, high))
        factors = (1.0, *capture.bracket)
        return expose_stripe(take_at, _FIRST_US, (low / min(factors), high / max(factors)))

    def _say(self, capture: PlanCapture, laser: bool, found: FoundExposure) -> None:
        what = "stripe" if laser else "scene"
        text = (
            f"Exposure of laser-{'on' if laser else 'off'} frames: {found.exposure_us:.0f} us; the {what} reaches "
            f"{100 * found.level:.0f} % of full scale, {100 * found.saturated:.1f} % of it is saturated."
        )
        self._observer.note(text)
        self.event("exposure", text, folder=capture.folder, exposure_us=found.exposure_us)
        if found.note:
            self._observer.warning(f"Capture '{capture.folder}': {found.note}.")

    def _keep(self, name: str, value: Any) -> Any:
        """What was remembered under this name; from now on this value, where nothing was."""
        if name not in self._kept:
            self._session.remember(name, value)
            self._kept[name] = value
        return self._kept[name]

    def _clipped(self, exposure_us: float) -> float:
        low, high = self.rig.camera.info.exposure_limits_us
        return min(max(exposure_us, low), high)


def _name(capture: PlanCapture, laser: bool) -> str:
    return f"{capture.folder}.exposure_{'on' if laser else 'off'}_us"


def _images(what: list[Any]) -> str:
    width, height, bits, colour = what
    return f"{width} x {height} px, {bits} bit, {colour}"


def _text(time: datetime) -> str:
    return time.isoformat(timespec="milliseconds").replace("+00:00", "Z")
