"""The turntable of a recorded session: it is at once where it is sent, and stands at the angles at which frames were taken."""

import math
from typing import Literal

from rotaline.errors import DeviceLimitError, DeviceStateError
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import FoundDevice
from rotaline.hardware.replay import Replay, replay_of
from rotaline.hardware.turntable import TurntableInfo
from rotaline.tables import NotNegative, Table, key


class Settings(Table):
    """A table ``[turntable]`` of rig.toml with ``driver = "replay"``."""

    driver: Literal["replay"] = key("replay", "which driver")
    u_angle_deg: NotNegative = key(0.0, "standard uncertainty of the recorded angles, deg")


class ReplayTurntable:
    """A table without limits that takes no time; see :class:`rotaline.hardware.turntable.Turntable`. It does not turn continuously."""

    def __init__(self, replay: Replay, u_angle_deg: float) -> None:
        self._replay = replay
        self._closed = False
        self.info = TurntableInfo(replay.device, None, resolution_deg=1e-6, u_angle_deg=u_angle_deg, continuous=False)

    def home(self, timeout_s: float) -> None:
        """Go to the angle 0 of the recording."""
        self.move_to(0.0, timeout_s)

    def move_to(self, angle_deg: float, timeout_s: float) -> float:
        """Stand at an angle; whether it was recorded shows when a frame is taken."""
        self._ready()
        if not math.isfinite(angle_deg):
            raise DeviceLimitError(f"{self.info.device}: the angle {angle_deg} deg is no finite number. State one.")
        self._replay.angle_deg = angle_deg
        return angle_deg

    def angle_deg(self) -> float:
        """Where it stands."""
        self._ready()
        return self._replay.angle_deg

    def turn(self, speed_deg_s: float) -> None:
        """Not possible."""
        self._ready()
        raise DeviceStateError(
            f"{self.info.device}: the table cannot turn continuously, since only single angles were recorded. Use a plan in steps."
        )

    def stop(self, timeout_s: float) -> None:
        """It stands."""
        self._ready()

    def close(self) -> None:
        """Let it go."""
        self._closed = True

    def _ready(self) -> None:
        if self._closed:
            raise DeviceStateError(f"{self.info.device}: the turntable has been closed. Open the rig again.")


def open_device(settings: Settings, clock: Clock, connections: Connections) -> ReplayTurntable:
    """Open it. Raises as :func:`rotaline.hardware.drivers.open_turntable`."""
    return ReplayTurntable(replay_of("turntable", connections), settings.u_angle_deg)


def find() -> tuple[FoundDevice, ...]:
    """Recorded sessions are not looked for."""
    return ()
