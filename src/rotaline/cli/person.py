"""The person at the terminal, who places targets and parts, and is guided from pose to pose."""

import contextlib
import os
import select
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Float

from rotaline.cli.acquisition_screen import AcquisitionScreen, placing
from rotaline.cli.acquisition_screen import ask as ask
from rotaline.cli.pose_screen import PoseScreen, pose_line
from rotaline.errors import DeviceStateError, RigError
from rotaline.hardware.camera import CameraFrame
from rotaline.io.plan_file import poses_of
from rotaline.io.plan_tables import PlanCapture, PlanTables
from rotaline.pipeline.acquire.earlier_poses import earlier_views, target_of
from rotaline.pipeline.acquire.guidance import (
    REST_PX,
    Advice,
    Guide,
    Rest,
    followed,
    full_look,
    judged,
    moved_meanwhile,
    stripe_seen,
)
from rotaline.pipeline.acquire.person import Preview
from rotaline.pipeline.acquire.sighting import Sighting, look, motion_px, view_of
from rotaline.pipeline.acquire.tasks import n_frames


class Keys(Protocol):
    """The keyboard while something is shown."""

    def enter_pressed(self) -> bool:
        """Whether Enter has been pressed since the last call."""


@contextlib.contextmanager
def keyboard(file: int | None = None) -> Iterator[Keys]:
    """Keys without waiting for them, while this context lasts; what was typed in it is not left for the next question.

    Parameters
    ----------
    file : of the terminal; None: standard input
    """
    if os.name == "nt":
        yield _WindowsKeys()
        return
    import termios
    import tty

    number = sys.stdin.fileno() if file is None else file
    before = termios.tcgetattr(number)
    try:
        tty.setcbreak(number)  # Ctrl-C stays what it is
        yield _TerminalKeys(number)
    finally:
        termios.tcsetattr(number, termios.TCSAFLUSH, before)


class _TerminalKeys:
    def __init__(self, file: int) -> None:
        self._file = file

    def enter_pressed(self) -> bool:
        typed = b""
        while select.select([self._file], [], [], 0)[0]:
            got = os.read(self._file, 1024)
            if not got:
                raise DeviceStateError("The terminal is gone. Start the same command again to go on.")
            typed += got
        return b"\n" in typed or b"\r" in typed


class _WindowsKeys:
    def enter_pressed(self) -> bool:
        import msvcrt

        typed = ""
        while msvcrt.kbhit():  # type: ignore[attr-defined]
            typed += msvcrt.getwch()  # type: ignore[attr-defined]
        return "\r" in typed


def require_person(plan: PlanTables, source: str = "The plan") -> None:
    """Refuse a plan that needs somebody at a terminal where there is none.

    Raises
    ------
    RigError
        If poses have to be held, or things have to be changed on the table.
    """
    guided = [c.folder for c in plan.captures if poses_of(c)]
    what = f"poses to be placed by a person (capture {', '.join(guided)})" if guided else ""
    if not guided and len(plan.captures) > 1:
        what = f"{len(plan.captures)} captures, between which a person changes what stands on the table"
    if what:
        raise RigError(
            f"{source} has {what}, and there is no terminal to guide them on. Start the command in a terminal; without one, a plan of one "
            "capture that the table turns can be taken."
        )


class TerminalPerson:
    """Asks the person at the terminal to place things, and guides from pose to pose.

    Parameters
    ----------
    plan : PlanTables
    session : Path   where the session grows: poses of an earlier start count
    screen : AcquisitionScreen   what shows the acquisition, and asks
    lit : a frame with the laser on for a moment (:func:`rotaline.pipeline.acquire.guidance.lit_preview`); None: there is no laser
    keys : the keyboard; None: there is no terminal

    Raises
    ------
    RigError
        If there is no terminal, and the plan needs one.
    """

    def __init__(
        self,
        plan: PlanTables,
        session: Path,
        screen: AcquisitionScreen,
        lit: Callable[[], CameraFrame] | None = None,
        keys: Callable[[], AbstractContextManager[Keys]] | None = keyboard,
    ) -> None:
        if keys is keyboard and not (sys.stdin.isatty() and screen.console.is_terminal):
            keys = None
        if keys is None:
            require_person(plan)
        self._plan, self._session, self._screen, self._lit = plan, session, screen, lit
        self._keys = keys
        self._guides: dict[str, Guide] = {}
        self._stripe_uv: Float[np.ndarray, "m 2"] | None = None

    def problems(self, captures: Sequence[PlanCapture]) -> list[str]:
        """None: a person can place everything."""
        return []

    def place(self, capture: PlanCapture, n_done: int) -> None:
        """Ask for the target or part; without a terminal it is taken to be there."""
        self._screen.console.print(placing(capture, n_done, n_frames(capture)))
        if self._keys is not None:
            self._screen.ask("Press Enter when you are ready." if poses_of(capture) else "Press Enter when it stands.")

    def pose(self, capture: PlanCapture, index: int, preview: Preview) -> None:
        """Guide the person to a pose that is worth taking; returns when it is at rest, or the person presses Enter."""
        if self._keys is None:
            return
        target = target_of(self._plan, capture)
        title = f"{capture.folder}, {capture.target}"
        rest: Rest | None = None
        missed: Sighting | None = None
        self._stripe_uv = None
        with self._keys() as keys, self._screen.showing() as show:
            while True:
                frame = preview()
                seen = look(frame.image, target, frame.time_s)
                guide = self._guide(capture, seen.image_size)
                rest = followed(rest, seen)
                if missed is not None and motion_px(missed, seen) > 5 * REST_PX:
                    missed = None
                advice = guide.advise(seen, rest, missed is not None)
                if advice.level == "take" and not self._crossed(capture, seen, frame):
                    missed, advice = seen, guide.advise(seen, rest, True)
                entered = keys.enter_pressed()
                if entered:
                    advice = Advice("take", "It is taken as it is.")
                show(PoseScreen(title, index, guide, frame.image, seen, rest, advice))
                if advice.level == "take":
                    if entered:
                        self._crossed(capture, seen, frame)
                    return

    def judge(self, capture: PlanCapture, index: int, frame: CameraFrame, preview: Preview) -> str | None:
        """Refuse a frame in which the target is not found or that is blurred by motion, and a pair of frames between which it moved."""
        if self._keys is None:
            return None
        target = target_of(self._plan, capture)
        seen = full_look(frame, target)
        why = judged(seen)
        if why is None and capture.role == "laser-plane":
            why = moved_meanwhile(seen, full_look(preview(), target))
        if why is not None:
            return why
        assert seen.detection is not None
        guide = self._guide(capture, seen.image_size)
        view = view_of(seen.detection)
        if view is not None:
            self._guides[capture.folder] = guide.with_view(view.with_stripe(self._stripe_uv))
        self._screen.note(pose_line(guide, index, seen))
        self._screen.console.bell()
        return None

    def aside(self, name: str) -> AbstractContextManager[None]:
        """Nothing to tell apart."""
        return nullcontext()

    def _guide(self, capture: PlanCapture, image_size: tuple[int, int]) -> Guide:
        if capture.folder not in self._guides:
            views = earlier_views(self._session, capture, target_of(self._plan, capture))
            self._guides[capture.folder] = Guide(capture.role, image_size, poses_of(capture), views)
        return self._guides[capture.folder]

    def _crossed(self, capture: PlanCapture, seen: Sighting, off: CameraFrame) -> bool:
        """Whether the stripe runs over the target, where that matters and there is a laser."""
        if capture.role != "laser-plane" or self._lit is None or seen.detection is None:
            return True
        crossed, self._stripe_uv = stripe_seen(seen, off, self._lit())
        return crossed
