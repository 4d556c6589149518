"""In which keys two plans differ: what is said to somebody who goes on with a session under a plan that was changed."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rotaline.errors import SessionError
from rotaline.io.mistakes import found_text
from rotaline.io.toml_file import text_of, toml_of

_MOST_DIFFERENCES = 8


def require_same_plan(session: Path, begun_with: Path, plan_text: str) -> None:
    """Refuse to go on with a session under another plan. Comments and blanks may differ; what is taken may not.

    Parameters
    ----------
    session : its folder
    begun_with : the plan that is kept in it
    plan_text : the plan of now, a right one

    Raises
    ------
    SessionError
        With what differs.
    """
    before = text_of(begun_with, "plan of the session", "Acquire into another folder.")
    differences = plan_differences(toml_of(begun_with, before), toml_of("the plan", plan_text))
    if not differences:
        return
    more = len(differences) - _MOST_DIFFERENCES
    shown = [*differences[:_MOST_DIFFERENCES], *([f"and {more} more"] if more > 0 else [])]
    raise SessionError(
        "\n".join(
            [
                f"{session}: this session was begun with another plan. What differs:",
                *(f"  {line}" for line in shown),
                f"To go on with the session, give the plan that it was begun with: {begun_with}",
                "To take what the new plan says, choose another folder for it.",
            ]
        )
    )


def plan_differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    """The keys of two plans that differ, each with both values; captures are told apart by their folders.

    Parameters
    ----------
    before, now : the content of the files; ``now`` is a right one

    Examples
    --------
    >>> before = {"captures": [{"folder": "ball", "step_deg": 2.0}]}
    >>> plan_differences(before, {"captures": [{"folder": "ball", "step_deg": 4.0, "gain": 1}]})
    ["capture 'ball', step_deg: 2.0 then, 4.0 now", "capture 'ball', gain: not stated then, 1 now"]
    """
    found = _differences(_without_captures(before), _without_captures(now))
    then, today = _captures(before), _captures(now)
    for folder in dict.fromkeys([*then, *today]):
        if folder not in then:
            found.append(f"capture '{folder}': only in the new plan")
        elif folder not in today:
            found.append(f"capture '{folder}': not in the new plan")
        else:
            found += [f"capture '{folder}', {what}" for what in _differences(then[folder], today[folder])]
    if [folder for folder in then if folder in today] != [folder for folder in today if folder in then]:
        found.append("the order of the captures")
    return found


def _without_captures(plan: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in plan.items() if key != "captures"}


def _captures(plan: Mapping[str, Any]) -> dict[str, Mapping[str, Any]]:
    return {str(capture.get("folder")): capture for capture in plan.get("captures", [])}


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> list[str]:
    then, today = _values(before), _values(now)
    names = [name for name in dict.fromkeys([*then, *today]) if then.get(name) != today.get(name)]
    return [f"{name}: {_words(then.get(name))} then, {_words(today.get(name))} now" for name in names]


def _values(value: Any, name: str = "") -> dict[str, Any]:
    """The values in a table by their names as messages write them, e.g. ``targets.board.pitch`` or ``measurements[1].feature``."""
    entries: list[tuple[str, Any]] = []
    if isinstance(value, Mapping):
        entries = [(f"{name}.{key}" if name else key, inner) for key, inner in value.items()]
    elif isinstance(value, list) and any(isinstance(inner, Mapping) for inner in value):
        entries = [(f"{name}[{i}]", inner) for i, inner in enumerate(value, start=1)]
    else:
        return {name: value}
    return {key: found for inner_name, inner in entries for key, found in _values(inner, inner_name).items()}


def _words(value: Any) -> str:
    return "not stated" if value is None else found_text(value)
