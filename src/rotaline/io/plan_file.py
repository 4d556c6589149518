"""Plans of acquisitions (TOML), and the plans that come with the program."""

import math
import re
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

from rotaline.errors import RigError
from rotaline.io.plan_tables import PlanCapture, PlanTables
from rotaline.io.rig_values import angles_deg
from rotaline.io.session_file import SESSION_FILE, parse_session_file
from rotaline.io.toml_file import Place, checked, text_of, toml_of, toml_text, where

PLANS = ("article",)
TURNING = ("axis", "artifact", "scan")

_MOST_STOPS = 100_000  # of a capture; more is a slip of the pen
_KEYS_OF_RIGS = {"preset", "camera", "turntable", "laser", "simulated", "replay"}
_POSES = {"camera": 20, "laser-plane": 10}


@dataclass(frozen=True)
class PlanFile:
    """A plan that was found to be right; ``source`` is its file, or "plan NAME"."""

    source: str
    text: str
    tables: PlanTables


def poses_of(capture: PlanCapture) -> int:
    """Number of poses that a person places, stated or not; 0: the table does it."""
    return 0 if capture.role in TURNING else capture.poses or _POSES[capture.role]


def angles_of(capture: PlanCapture) -> tuple[float, ...]:
    """The angles of a capture that turns, deg; none for others."""
    return angles_deg(capture, seed=1) if capture.role in TURNING else ()


def session_toml(plan: PlanTables, captures: list[PlanCapture]) -> str:
    """The text of ``session.toml`` with these of the plan's captures."""
    used = {c.target for c in captures}
    return _session_text(plan, captures, {name: table for name, table in plan.targets.items() if name in used})


def _session_text(plan: PlanTables, captures: list[PlanCapture], targets: dict[str, dict[str, Any]]) -> str:
    folders = [c.folder for c in captures]
    data: dict[str, Any] = {
        "version": 1,
        "optics": None if plan.optics is None else plan.optics.model_dump(),
        "targets": targets or None,
        "captures": [c.model_dump(include={"folder", "role", "target"}) for c in captures],
        "measurements": [m for m in plan.measurements if m.get("capture") in folders] or None,
    }
    return "# lengths in mm, angles in deg\n" + toml_text(data)


def plan_text(name: str) -> str:
    """The file of a plan that comes with the program.

    Raises
    ------
    RigError
        If there is none of this name.
    """
    if name not in PLANS:
        raise RigError(f"plan '{name}': there is no such plan; expected one of {', '.join(PLANS)}, or a file.")
    return (resources.files("rotaline.io") / "plan_presets" / f"{name}.toml").read_text(encoding="utf-8")


def read_plan(path_or_name: str) -> PlanFile:
    """A plan from a file, or one that comes with the program.

    Raises
    ------
    RigError
        With all that is wrong: file, line, field; found, expected.
    """
    if path_or_name in PLANS:
        return parse_plan(plan_text(path_or_name), f"plan {path_or_name}")
    path = Path(path_or_name)
    text = text_of(
        path,
        "plan",
        f"Give a file, or one of {', '.join(PLANS)}; `rotaline acquire --plan article --toml` prints one to begin with.",
    )
    return parse_plan(text, str(path))


def parse_plan(text: str, source: str) -> PlanFile:
    """Check the text of a plan; ``source`` names it in messages.

    Raises
    ------
    RigError
        With all that is wrong: file, line, field; found, expected.
    """
    data = toml_of(source, text)
    if _KEYS_OF_RIGS & set(data):
        raise RigError(
            f"{source}: this names devices, or a rig to be simulated; expected a plan, which says what is taken. Give both: "
            "`rotaline acquire RIG.toml PLAN.toml OUT`."
        )
    tables = checked(PlanTables, data, source, text)
    problems = [f"{where(source, text, place)}: {what}" for place, what in _contradictions(tables)]
    if not problems:
        problems = _session_problems(tables, source, text)
    if problems:
        raise RigError("\n".join(problems))
    return PlanFile(source, text, tables)


def _contradictions(plan: PlanTables) -> list[tuple[Place, str]]:
    problems: list[tuple[Place, str]] = []
    folders = [capture.folder for capture in plan.captures]
    for index, capture in enumerate(plan.captures):
        place: Place = ("captures", index)
        if capture.folder in folders[:index]:
            problems.append(((*place, "folder"), f"'{capture.folder}' is the folder of an earlier capture; rename it."))
        if capture.folder in ("acquisition", "reference"):
            problems.append(((*place, "folder"), f"'{capture.folder}' is taken by the program; rename it."))
        problems += [((*place, name), what) for name, what in _capture_contradictions(capture)]
    # a setting that stays as the capture before has left it would be another one after an interruption
    for name, concerned in (("gain", lambda _: True), ("laser_power", lambda c: c.role not in ("camera", "axis"))):
        said = [getattr(c, name) is not None for c in plan.captures if concerned(c)]
        if any(said) and not all(said):
            without = next(i for i, c in enumerate(plan.captures) if concerned(c) and getattr(c, name) is None)
            what = "this capture does not state it, but others do; state it in all of them, or in none."
            problems.append((("captures", without, name), what))
    return problems


def _capture_contradictions(capture: PlanCapture) -> list[tuple[str, str]]:
    turning = ("from_deg", "to_deg", "step_deg", "frames", "shuffle", "mode", "speed_deg_s", "reference_every")
    unfit: tuple[str, ...] = {
        "camera": (*turning, "laser_off_frames", "exposure_on_us", "bracket", "laser_power"),
        "laser-plane": (*turning, "laser_off_frames"),
        "axis": ("poses", "laser_off_frames", "exposure_on_us", "bracket", "laser_power"),
    }.get(capture.role, ("poses",))
    said = capture.model_fields_set
    problems = [
        (name, f"this key says nothing for role '{capture.role}'; remove it.") for name in unfit if name in said
    ]
    if capture.mode == "continuous":
        for name in ("laser_off_frames", "reference_every", "shuffle"):
            if getattr(capture, name):
                problems.append((name, 'this needs a table that stands for each frame; expected mode = "step".'))
        if len(capture.bracket) > 1:
            problems.append(("bracket", 'several exposures need a table that stands; expected mode = "step".'))
    elif "speed_deg_s" in said:
        problems.append(("speed_deg_s", 'this key says nothing for mode "step"; remove it.'))
    if capture.frames is not None and capture.step_deg is not None:
        problems.append(("frames", "both frames and step_deg are given; keep one of them."))
    if capture.to_deg is not None and not 0 < abs(capture.to_deg - capture.from_deg) <= 360:
        found = f"found {capture.to_deg:g}, expected another angle than from_deg = {capture.from_deg:g}, up to 360 deg from it."
        problems.append(("to_deg", found))
    span_deg = 360.0 if capture.to_deg is None else abs(capture.to_deg - capture.from_deg)
    if capture.step_deg is not None and span_deg / capture.step_deg > _MOST_STOPS:
        found = f"found {capture.step_deg:g}, expected at least {span_deg / _MOST_STOPS:g}: {_MOST_STOPS} angles."
        problems.append(("step_deg", found))
    if len(set(capture.bracket)) < len(capture.bracket) or not all(math.isfinite(f) for f in capture.bracket):
        problems.append(("bracket", f"found {list(capture.bracket)}, expected different factors."))
    return problems


def _session_problems(plan: PlanTables, source: str, text: str) -> list[str]:
    """What the session.toml of this plan would be refused for; with the places of the plan."""
    _, found = parse_session_file(_session_text(plan, list(plan.captures), plan.targets).encode(), SESSION_FILE)
    problems = [
        f"{where(source, text, _place(at))}: {what if fatal else 'there is no such key; remove it.'}"
        for at, what, fatal in found
    ]
    folders = {c.folder for c in plan.captures if c.role in ("scan", "artifact")}
    for index, m in enumerate(plan.measurements):
        if m.get("capture") not in folders:
            known = ", ".join(sorted(folders)) or "none"
            at = where(source, text, ("measurements", index, "capture"))
            problems.append(
                f"{at}: found {m.get('capture')!r}, expected the folder of a capture with role scan or artifact: {known}."
            )
    return problems


def _place(at: str) -> Place:
    """The place that the last part of "file, line, field" names.

    Examples
    --------
    >>> _place("session.toml, line 3, captures[2].target")
    ('captures', 1, 'target')
    """
    field = at.split(", ")[-1]
    if field == SESSION_FILE or field.startswith("line "):
        return ()
    return tuple(int(index) - 1 if index else name for index, name in re.findall(r"\[(\d+)\]|([^.\[\]]+)", field))
