"""The devices of a rig, open together; whatever ends their use, the laser is off and the table stands."""

from dataclasses import dataclass
from types import TracebackType

from rotaline.hardware.camera import Camera
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import open_camera, open_laser, open_turntable
from rotaline.hardware.laser import Laser
from rotaline.hardware.turntable import Turntable
from rotaline.tables import Table


@dataclass(frozen=True)
class DeviceTables:
    """The devices that rig.toml names; None: the rig has none."""

    camera: Table
    turntable: Table | None = None
    laser: Table | None = None


@dataclass(frozen=True, eq=False)
class OpenRig:
    """Camera, turntable and laser, open; a context that closes them."""

    camera: Camera
    turntable: Turntable | None
    laser: Laser | None
    clock: Clock
    connections: Connections

    def __enter__(self) -> "OpenRig":
        """The rig itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close everything."""
        self.close()

    def close(self) -> None:
        """Laser off, table stopped, camera let go, in this order; each is tried whatever happens to the others."""
        _close([self.laser, self.turntable, self.camera, self.connections])


def _close(things: list[Laser | Turntable | Camera | Connections | None]) -> None:
    interrupted: BaseException | None = None
    for thing in things:
        for _ in range(2):  # an interruption in the middle of it does not leave the laser on
            try:
                if thing is not None:
                    thing.close()
                break
            except (KeyboardInterrupt, SystemExit) as error:
                interrupted = error
            except Exception:
                break
    if interrupted is not None:
        raise interrupted


def open_rig(tables: DeviceTables, clock: Clock, connections: Connections | None = None) -> OpenRig:
    """Open the devices: the laser first, since it has to be off before anything else happens.

    Raises
    ------
    DeviceError
        If one cannot be opened; the others have been closed.
    """
    shared = connections or Connections()
    opened: list[Laser | Turntable | Camera | Connections | None] = [shared]
    try:
        laser = None if tables.laser is None else open_laser(tables.laser, clock, shared)
        opened.insert(0, laser)
        turntable = None if tables.turntable is None else open_turntable(tables.turntable, clock, shared)
        opened.insert(1, turntable)
        camera = open_camera(tables.camera, clock, shared)
    except BaseException:
        _close(opened)
        raise
    return OpenRig(camera, turntable, laser, clock, shared)
