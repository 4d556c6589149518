"""Where something stands in a TOML file: file, line and field for messages."""

import re
from pathlib import Path
from typing import Any

Place = tuple[str | int, ...]
"""Keys and indices that lead to a value, e.g. ``("captures", 2, "mount", "tilt_deg")``."""

_KEY = r"(?:[\w-]+|\"[^\"]*\"|'[^']*')"
_DOTTED = rf"{_KEY}(?:\s*\.\s*{_KEY})*"
_HEADER = re.compile(rf"\s*(\[\[?)\s*({_DOTTED})\s*\]")
_ENTRY = re.compile(rf"\s*({_DOTTED})\s*=")


def where(path: Path | str, text: str, place: Place, missing: Any = None) -> str:
    """File, line and field of a place in a TOML document; ``missing``: a key that should stand there.

    Examples
    --------
    >>> where("rig.toml", "[camera]\\nroll_deg = 'a'", ("camera", "roll_deg"))
    'rig.toml, line 2, camera.roll_deg'
    """
    field = ".".join(str(part) if isinstance(part, str) else f"[{part + 1}]" for part in place).replace(".[", "[")
    if missing is not None:
        field = f"{field}.{missing}" if field else str(missing)
    line = line_of(text, place)
    return ", ".join([str(path), *([f"line {line}"] if line else []), *([field] if field else [])])


def line_of(text: str, place: Place) -> int | None:
    """Number of the line that sets a value, or else opens the innermost table around it; None if neither is found."""
    lines: dict[Place, int] = {}
    counts: dict[Place, int] = {}
    table: Place = ()
    for number, line in enumerate(text.splitlines(), start=1):
        if header := _HEADER.match(line):
            name = _with_indices(_keys(header[2]), counts)
            if header[1] == "[[":
                counts[name] = counts.get(name, -1) + 1
                name = (*name, counts[name])
            table = name
            lines.setdefault(table, number)
        elif entry := _ENTRY.match(line):
            lines.setdefault((*table, *_keys(entry[1])), number)
    for length in range(len(place), 0, -1):
        if place[:length] in lines:
            return lines[place[:length]]
    return None


def _keys(dotted: str) -> Place:
    return tuple(key.strip("\"'") for key in re.findall(_KEY, dotted))


def _with_indices(keys: Place, counts: dict[Place, int]) -> Place:
    """Tables below an array of tables belong to its last entry."""
    name: Place = ()
    for i, key in enumerate(keys):
        name = (*name, key)
        if name in counts and i < len(keys) - 1:
            name = (*name, counts[name])
    return name
