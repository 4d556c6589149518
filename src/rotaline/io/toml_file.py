"""TOML files that people write: checked with file, line and field in the messages; and written."""

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, get_args

from pydantic import BaseModel, ValidationError

from rotaline.errors import RigError
from rotaline.io.mistakes import expected_text, found_text, no_toml, refused

M = TypeVar("M", bound=BaseModel)

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


def text_of(path: Path, what: str, begin: str) -> str:
    """The text of a file that a person writes; ``what`` names its kind, ``begin`` says how to get one.

    Raises
    ------
    RigError
        If it cannot be read, or is no UTF-8.
    """
    try:
        return path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise RigError(f"{path}: the {what} cannot be read ({error.strerror}). {begin}") from error
    except UnicodeDecodeError as error:
        raise RigError(f"{path}: the file is not UTF-8 text (byte {error.start}). Save it as UTF-8.") from error


def toml_of(path: Path | str, text: str) -> dict[str, Any]:
    """The content of a TOML document.

    Raises
    ------
    RigError
        With file and line, if it is no TOML.
    """
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        line, what = no_toml(text, error)
        raise RigError(f"{path}{f', line {line}' if line else ''}: {what}") from error


def checked(model: type[M], data: Any, source: Path | str, text: str, place: Place = ()) -> M:
    """A table of a document, checked; ``place``: where it stands.

    Raises
    ------
    RigError
        With all that is wrong: file, line, field; found, expected.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        found = error.errors()
        by_place: dict[Place, list[dict[str, Any]]] = {}
        for entry in found:
            if not _follows(entry, found):
                by_place.setdefault(_place_in_file(place, entry["loc"]), []).append(dict(entry))
        lines = [_explain(model, source, text, at, entries) for at, entries in by_place.items()]
        raise RigError("\n".join(lines)) from error


def _follows(entry: Any, found: Sequence[Any]) -> bool:
    """Whether a list counts as too short only because what is in it is wrong."""
    loc = entry["loc"]
    return entry["type"] == "too_short" and any(len(e["loc"]) > len(loc) and e["loc"][: len(loc)] == loc for e in found)


def _place_in_file(place: Place, loc: Sequence[str | int]) -> Place:
    """Without what pydantic adds to name one of several types that a value may have."""
    return (*place, *(part for part in loc if not (isinstance(part, str) and re.search(r"[\[(]|^constrained-", part))))


def _explain(
    model: type[BaseModel], source: Path | str, text: str, at: Place, errors: Sequence[Mapping[str, Any]]
) -> str:
    """What is wrong at one place; there are several errors where a value may have one of several types."""
    error = errors[0]
    kind = error["type"]
    if kind == "missing" and isinstance(at[-1], int):
        return f"{where(source, text, at[:-1])}: the list is too short, a value is missing."
    if kind == "missing":
        return f"{where(source, text, at[:-1], at[-1])}: it is missing; expected a value."
    if kind == "extra_forbidden":
        inner = _model_at(model, error["loc"][:-1])
        known = "" if inner is None else f"; expected one of {', '.join(inner.model_fields)}"
        return f"{where(source, text, at)}: there is no such key{known}."
    expected = [expected_text(e) for e in errors]
    if len(errors) > 1 and all(expected):
        words = [f'"{e}"' if entry["type"] == "literal_error" else e for e, entry in zip(expected, errors, strict=True)]
        either = ", or ".join(str(word) for word in words)
        return f"{where(source, text, at)}: found {found_text(error.get('input'))}, expected {either}."
    return f"{where(source, text, at)}: {refused(error)}"


def _model_at(model: Any, loc: Place) -> type[BaseModel] | None:
    """The table that stands at a place of another one; None: it is one of several, or no table."""
    for part in loc:
        if isinstance(part, str):
            fields = getattr(model, "model_fields", {})
            if part in fields:
                model = fields[part].annotation
        while not hasattr(model, "model_fields"):
            inner = [t for t in get_args(model) if get_args(t) or hasattr(t, "model_fields")]
            if len(inner) != 1:
                return None
            (model,) = inner
    return model


def toml_text(data: Mapping[str, Any], name: str = "") -> str:
    """A document of tables, arrays of tables, strings, numbers and lists of them; what is None is left out.

    Examples
    --------
    >>> print(toml_text({"version": 1, "captures": [{"folder": "ball"}]}))
    version = 1
    <BLANKLINE>
    [[captures]]
    folder = "ball"
    <BLANKLINE>
    """
    lines, tables = [], []
    for entry, value in data.items():
        full = f"{name}.{entry}" if name else entry
        if value is None:
            continue
        if isinstance(value, Mapping):
            tables.append(f"[{full}]\n{toml_text(value, full)}")
        elif isinstance(value, list | tuple) and value and all(isinstance(v, Mapping) for v in value):
            tables += [f"[[{full}]]\n{toml_text(v, full)}" for v in value]
        else:
            lines.append(
                f"{entry} = {json.dumps(value)}"
            )  # strings, numbers and lists are written alike in JSON and TOML
    return "\n".join([*lines, "", *tables]) if lines or tables else ""
