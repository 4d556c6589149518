"""Who places targets in a simulated rig and in a recorded session: the world itself."""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext

from rotaline.hardware.camera import CameraFrame
from rotaline.hardware.replay import Replay
from rotaline.hardware.simulated.world import SimulatedWorld
from rotaline.io.plan_file import poses_of
from rotaline.io.plan_tables import PlanCapture
from rotaline.pipeline.acquire.person import Preview


class SimulatedPerson:
    """Puts into a simulated world what its own plan says about the capture of this name."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world

    def problems(self, captures: Sequence[PlanCapture]) -> list[str]:
        """Captures that the simulated rig has not, or not with so many poses."""
        there = [capture.folder for capture in self._world.plan.captures]
        found = []
        for capture in captures:
            if capture.folder not in there:
                found.append(
                    f"capture '{capture.folder}': the simulated rig has no capture of this name; it has {', '.join(there)}. Rename it in "
                    "the plan, or add it to the rig file."
                )
            elif poses_of(capture) > self._world.n_poses(capture.folder):
                found.append(
                    f"capture '{capture.folder}': {poses_of(capture)} poses; the simulated rig has {self._world.n_poses(capture.folder)}. Ask for "
                    "fewer, or add views to the rig file."
                )
        return found

    def place(self, capture: PlanCapture, n_done: int) -> None:
        """Set the capture up."""
        self._world.set_up(capture.folder)

    def pose(self, capture: PlanCapture, index: int, preview: Preview) -> None:
        """Hold the plate in this pose."""
        self._world.hold(index)

    def judge(self, capture: PlanCapture, index: int, frame: CameraFrame, preview: Preview) -> str | None:
        """Every pose is good."""
        return None

    def aside(self, name: str) -> AbstractContextManager[None]:
        """Keep the noise of the planned frames for them."""
        return self._world.aside(name)


class RecordedPerson:
    """Presents what was recorded in the capture of this name."""

    def __init__(self, replay: Replay) -> None:
        self._replay = replay

    def problems(self, captures: Sequence[PlanCapture]) -> list[str]:
        """Captures that were not recorded, or not in so many poses."""
        there = {capture.name: len(capture.poses) for capture in self._replay.recording.captures}
        found = []
        for capture in captures:
            if capture.folder not in there:
                found.append(
                    f"capture '{capture.folder}': it was not recorded; there is {', '.join(there)}. Rename it in the plan."
                )
            elif poses_of(capture) > there[capture.folder]:
                found.append(
                    f"capture '{capture.folder}': {poses_of(capture)} poses; {there[capture.folder]} were recorded. Ask for fewer."
                )
        return found

    def place(self, capture: PlanCapture, n_done: int) -> None:
        """Choose the capture."""
        self._replay.select(capture.folder)

    def pose(self, capture: PlanCapture, index: int, preview: Preview) -> None:
        """Present the pose of this index."""
        self._replay.present(self._replay.capture.poses[index])

    def judge(self, capture: PlanCapture, index: int, frame: CameraFrame, preview: Preview) -> str | None:
        """Every pose is as it was recorded."""
        return None

    def aside(self, name: str) -> AbstractContextManager[None]:
        """Nothing to tell apart."""
        return nullcontext()
