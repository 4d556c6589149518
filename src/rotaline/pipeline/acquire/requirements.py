"""Whether a rig can do what a plan asks for: asked before anything moves."""

from rotaline.errors import RigError
from rotaline.hardware.rig import OpenRig
from rotaline.io.plan_file import TURNING, PlanFile
from rotaline.io.plan_tables import PlanCapture
from rotaline.pipeline.acquire.person import Person
from rotaline.pipeline.acquire.tasks import Stop, stops_of


def require_devices(plan: PlanFile, rig: OpenRig, person: Person) -> None:
    """Refuse a plan that this rig, or whoever places things in it, cannot carry out, before anything moves.

    Raises
    ------
    RigError
        With all that does not fit: capture, what is needed, what there is.
    """
    problems = []
    for capture in plan.tables.captures:
        stops = stops_of(capture)
        found = _turning(capture, stops, rig) if capture.role in TURNING else []
        if any(task.laser for task in stops[0].tasks):
            found += _laser(capture, rig)
        found += _camera(capture, rig)
        problems += [f"{plan.source}, capture '{capture.folder}': {text}" for text in found]
    problems += [f"{plan.source}, {text}" for text in person.problems(plan.tables.captures)]
    if problems:
        raise RigError("\n".join(problems))


def _turning(capture: PlanCapture, stops: tuple[Stop, ...], rig: OpenRig) -> list[str]:
    if rig.turntable is None:
        return [f"role '{capture.role}' needs a turntable; the rig file has no [turntable]."]
    info = rig.turntable.info
    angles = [stop.angle_deg for stop in stops if stop.angle_deg is not None]
    problems = []
    if info.limits_deg is not None and not info.limits_deg[0] <= min(angles) <= max(angles) <= info.limits_deg[1]:
        low, high = info.limits_deg
        problems.append(f"angles {min(angles):g} to {max(angles):g} deg; {info.device} allows {low:g} to {high:g} deg.")
    if capture.mode == "continuous" and not info.continuous:
        problems.append(f'mode "continuous": {info.device} cannot turn continuously; expected mode = "step".')
    fastest = info.max_speed_deg_s
    if capture.speed_deg_s is not None and fastest is not None and capture.speed_deg_s > fastest:
        problems.append(f"speed_deg_s is {capture.speed_deg_s:g}; {info.device} turns at up to {fastest:g} deg/s.")
    return problems


def _laser(capture: PlanCapture, rig: OpenRig) -> list[str]:
    if rig.laser is None:
        return [f"role '{capture.role}' needs a laser; the rig file has no [laser]."]
    if capture.laser_power is not None and not rig.laser.info.can_set_power:
        return [
            f"laser_power is {capture.laser_power:g}; the power of {rig.laser.info.device} cannot be set. Leave it out."
        ]
    return []


def _camera(capture: PlanCapture, rig: OpenRig) -> list[str]:
    info = rig.camera.info
    problems = []
    low, high = info.exposure_limits_us
    for name, factors in (("exposure_on_us", capture.bracket), ("exposure_off_us", (1.0,))):
        stated = getattr(capture, name)
        for exposure in () if stated == "auto" else [stated * f for f in factors]:
            if not low <= exposure <= high:
                problems.append(f"{name} gives {exposure:g} us; {info.device} allows {low:g} to {high:g} us.")
    if capture.gain is not None and info.gain_limits is None:
        problems.append(f"gain is {capture.gain:g}; the gain of {info.device} cannot be set. Leave it out.")
    elif capture.gain is not None and info.gain_limits is not None:
        low, high = info.gain_limits
        if not low <= capture.gain <= high:
            unit = info.gain_unit
            problems.append(f"gain is {capture.gain:g}; {info.device} allows {low:g} to {high:g} {unit}.")
    return problems
