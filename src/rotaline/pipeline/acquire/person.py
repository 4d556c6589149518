"""Who puts targets and parts where they belong, and turns to the next pose: a person, or a stand-in of a simulated or recorded rig."""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol, runtime_checkable

from rotaline.hardware.camera import CameraFrame
from rotaline.io.plan_tables import PlanCapture

Preview = Callable[[], CameraFrame]
"""A frame of now, with the laser off, that is not kept."""


@runtime_checkable
class Person(Protocol):
    """Does what devices cannot do."""

    def problems(self, captures: Sequence[PlanCapture]) -> list[str]:
        """What of these captures cannot be placed; asked before anything moves."""

    def place(self, capture: PlanCapture, n_done: int) -> None:
        """Put the target or part of a capture in its place; returns when it is there.

        ``n_done``: frames of this capture that an earlier start has taken; then everything has to stand as it stood.
        """

    def pose(self, capture: PlanCapture, index: int, preview: Preview) -> None:
        """Hold the target in a pose (the first has index 0); returns when the frames of this pose may be taken."""

    def judge(self, capture: PlanCapture, index: int, frame: CameraFrame, preview: Preview) -> str | None:
        """Look at the first frame that was taken of a pose: None, or why the pose is to be taken again.

        ``preview`` shows what there is after the last frame of the pose: whether the target still is where it was.
        """

    def aside(self, name: str) -> AbstractContextManager[None]:
        """What is taken within is none of the plan's frames: a preview, the search for an exposure, a reference."""


class Nobody:
    """For plans in which the table does everything, and for programs: everything is in its place already."""

    def problems(self, captures: Sequence[PlanCapture]) -> list[str]:
        """None."""
        return []

    def place(self, capture: PlanCapture, n_done: int) -> None:
        """Nothing to do."""

    def pose(self, capture: PlanCapture, index: int, preview: Preview) -> None:
        """Nothing to do."""

    def judge(self, capture: PlanCapture, index: int, frame: CameraFrame, preview: Preview) -> str | None:
        """Every frame is taken as it is."""
        return None

    def aside(self, name: str) -> AbstractContextManager[None]:
        """Nothing to tell apart."""
        return nullcontext()
