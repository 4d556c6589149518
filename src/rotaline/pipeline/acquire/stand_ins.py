"""Who places targets in a simulated rig and in a recorded session: the world itself."""

from contextlib import AbstractContextManager, nullcontext

from rotaline.errors import RigError
from rotaline.hardware.camera import CameraFrame
from rotaline.hardware.replay import Replay
from rotaline.hardware.simulated.world import SimulatedWorld
from rotaline.io.plan_tables import PlanCapture
from rotaline.pipeline.acquire.person import Preview


class SimulatedPerson:
    """Puts into a simulated world what its own plan says about the capture of this name."""

    def __init__(self, world: SimulatedWorld) -> None:
        self._world = world

    def place(self, capture: PlanCapture, n_done: int) -> None:
        """Set the capture up.

        Raises
        ------
        RigError
            If the simulated rig has no such capture.
        """
        try:
            self._world.set_up(capture.folder)
        except KeyError as error:
            raise RigError(
                f"Capture '{capture.folder}': {error.args[0]} Rename it in the plan, or add it to the rig file."
            ) from error

    def pose(self, capture: PlanCapture, index: int, preview: Preview) -> None:
        """Hold the plate in this pose.

        Raises
        ------
        RigError
            If the simulated rig has fewer poses of it.
        """
        try:
            self._world.hold(index)
        except IndexError as error:
            raise RigError(
                f"Capture '{capture.folder}': {error.args[0]} Ask for fewer poses, or add views to the rig file."
            ) from error

    def judge(self, capture: PlanCapture, index: int, frame: CameraFrame) -> str | None:
        """Every pose is good."""
        return None

    def aside(self, name: str) -> AbstractContextManager[None]:
        """Keep the noise of the planned frames for them."""
        return self._world.aside(name)


class RecordedPerson:
    """Presents what was recorded in the capture of this name."""

    def __init__(self, replay: Replay) -> None:
        self._replay = replay

    def place(self, capture: PlanCapture, n_done: int) -> None:
        """Choose the capture."""
        self._replay.select(capture.folder)

    def pose(self, capture: PlanCapture, index: int, preview: Preview) -> None:
        """Present the pose of this index; there is none beyond the last."""
        poses = self._replay.capture.poses
        self._replay.present(poses[index] if index < len(poses) else str(index))

    def judge(self, capture: PlanCapture, index: int, frame: CameraFrame) -> str | None:
        """Every pose is as it was recorded."""
        return None

    def aside(self, name: str) -> AbstractContextManager[None]:
        """Nothing to tell apart."""
        return nullcontext()
