"""All checks of a rig, one after the other; whatever happens, the laser is off and the table stands afterwards."""

from collections.abc import Callable
from dataclasses import replace

from rotaline.errors import DeviceError, RigError
from rotaline.hardware.replay import REPLAY
from rotaline.hardware.rig import OpenRig
from rotaline.hardware.simulated.world import SimulatedWorld
from rotaline.io.rig_check_file import RigCheck
from rotaline.pipeline.rig_check.bench import Bench, Heard
from rotaline.pipeline.rig_check.camera import check_camera, check_lost, check_stream
from rotaline.pipeline.rig_check.laser import check_laser
from rotaline.pipeline.rig_check.turntable import check_turning, check_turntable

_STOP_S = 30.0


def check_rig(rig: OpenRig, heard: Heard) -> RigCheck:
    """Test the devices of an open rig, with something that has a pattern on its table.

    An error of one device ends what is done with it; the others are looked at all the same.

    Parameters
    ----------
    rig : OpenRig
        Afterwards the laser is off, and the table stands.
    heard : gets each line when it is found, and sentences for the person at the rig

    Raises
    ------
    RigError
        If it is a recorded session.
    """
    if rig.connections.get(REPLAY) is not None:
        raise RigError(
            "A recorded session is no rig: there is nothing to move or to switch. `rotaline check SESSION` looks at one."
        )
    _furnish(rig)
    bench = Bench(rig, heard)
    _introduce(rig, heard)
    try:
        _attempt(bench, "camera", "frames", check_camera)
        if bench.exposure_us is None:
            bench.leave_out("Nothing else is looked at: all of it needs frames.")
            return bench.found()
        if rig.laser is None:
            bench.leave_out("rig.toml has no [laser]: nothing is switched.")
        else:
            _attempt(bench, "laser", "on and off", check_laser)
            _dark(bench)
        if rig.turntable is None:
            bench.leave_out("rig.toml has no [turntable]: nothing is moved.")
        else:
            _scene_exposure(bench)
            moved = _attempt(bench, "turntable", "moves", check_turntable)
            if moved and rig.turntable.info.continuous:
                _attempt(bench, "turntable", "turning", check_turning)
            elif moved:
                bench.leave_out("The table does not turn continuously: that is not looked at.")
            _still(bench)
        _attempt(bench, "camera", "stream", check_stream)
        check_lost(bench)
    finally:
        _dark(bench)
        _still(bench)
    return bench.found()


def _introduce(rig: OpenRig, heard: Heard) -> None:
    """Say what the devices are and can."""
    low, high = rig.camera.info.exposure_limits_us
    heard(f"Camera: {rig.camera.info.device}; exposures from {low:.3g} us to {high * 1e-6:.3g} s.")
    if rig.turntable is not None:
        info = rig.turntable.info
        limits = "no limits" if info.limits_deg is None else f"{info.limits_deg[0]:g} to {info.limits_deg[1]:g} deg"
        speed = "" if info.max_speed_deg_s is None else f", up to {info.max_speed_deg_s:.3g} deg/s"
        heard(f"Turntable: {info.device}; {limits}{speed}; {'with' if info.encoder else 'no'} encoder.")
    if rig.laser is not None:
        power = "its power can be set" if rig.laser.info.can_set_power else "its power cannot be set"
        heard(f"Laser: {rig.laser.info.device}; {power}.")


def _furnish(rig: OpenRig) -> None:
    """Put the first thing that turns on a simulated table; on a real one a person has done so."""
    world = rig.connections.get("world")
    if isinstance(world, SimulatedWorld):
        turning = [c for c in world.plan.captures if all(shot.angle_deg is not None for shot in c.shots)]
        if turning:
            world.set_up(turning[0].folder)


def _attempt(bench: Bench, device: str, name: str, check: Callable[[Bench], None]) -> bool:
    """Whether a check came to its end."""
    try:
        check(bench)
    except DeviceError as error:
        bench.error(device, name, error)
        return False
    return True


def _scene_exposure(bench: Bench) -> None:
    def configure(bench: Bench) -> None:
        camera = bench.rig.camera
        assert bench.exposure_us is not None
        camera.configure(replace(camera.settings, exposure_us=bench.exposure_us))

    _attempt(bench, "camera", "exposure", configure)


def _dark(bench: Bench) -> None:
    laser = bench.rig.laser
    if laser is not None and laser.is_on:
        _attempt(bench, "laser", "off", lambda _: laser.off())


def _still(bench: Bench) -> None:
    table = bench.rig.turntable
    if table is not None:
        _attempt(bench, "turntable", "stop", lambda _: table.stop(_STOP_S))
