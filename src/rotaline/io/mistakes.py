"""What is wrong in a TOML file, in words: lines that are no TOML, and values that a table refuses."""

import re
from collections.abc import Mapping
from typing import Any

_PATTERNS = {
    r"^[\w][\w.-]*$": "a name without blanks and slashes: letters, digits, _ - . (the first one a letter, a digit or _)",
    r"^DICT_\w+$": "the name of a dictionary of OpenCV, such as DICT_5X5_100",
    r"^\w+_mm$": "a name that ends in _mm",
}
_KINDS = {
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a number",
    "int_type": "a whole number",
    "int_from_float": "a whole number",
    "int_parsing": "a whole number",
    "bool_type": "true or false",
    "string_type": "text in quotes",
    "tuple_type": "a list in brackets: [..., ...]",
    "dict_type": "a table",
    "model_type": "a table",
}
_MOST_SHOWN = 60


def found_text(found: Any) -> str:
    """A value as a message shows it.

    Examples
    --------
    >>> found_text("a b"), found_text({"folder": "a"})
    ("'a b'", 'a table')
    """
    if isinstance(found, Mapping):
        return "a table"
    text = repr(found)
    return text if len(text) <= _MOST_SHOWN else f"{text[: _MOST_SHOWN - 4]} ..."


def expected_text(error: Mapping[str, Any]) -> str | None:
    """What is expected in place of a value that pydantic refused; ``error``: an entry of its list. None: there are no words for it.

    Examples
    --------
    >>> expected_text({"type": "greater_than", "ctx": {"gt": 0.0}})
    'more than 0'
    """
    kind, found, context = error["type"], error.get("input"), error.get("ctx", {})
    if kind == "literal_error":
        return str(context["expected"]).replace("'", "")
    if kind == "string_pattern_mismatch":
        return _PATTERNS.get(context["pattern"], f"text of the form {context['pattern']}")
    if kind == "tuple_type" and isinstance(found, Mapping):
        return f"tables, each opened by [[{error['loc'][-1]}]] in double brackets"
    for name, bound, words in (
        ("greater_than", "gt", "more than {:g}"),
        ("greater_than_equal", "ge", "{:g} or more"),
        ("less_than", "lt", "less than {:g}"),
        ("less_than_equal", "le", "{:g} or less"),
        ("too_short", "min_length", "at least {:g} of them"),
        ("too_long", "max_length", "at most {:g} of them"),
    ):
        if kind == name:
            return words.format(context[bound])
    expected = _KINDS.get(kind)
    if expected in ("a number", "a whole number", "true or false") and isinstance(found, str):
        return f"{expected} without quotes"
    return expected


def refused(error: Mapping[str, Any]) -> str:
    """What was found and expected of a value that pydantic refused, as a sentence without its place."""
    expected = expected_text(error)
    if expected is not None:
        return f"found {found_text(error.get('input'))}, expected {expected}."
    message = str(error["msg"])
    if error["type"] == "value_error":  # a sentence of a table's own check, which names what it found
        return f"{message.removeprefix('Value error, ')}."
    return f"found {found_text(error.get('input'))}; {message[:1].lower()}{message[1:]}."


_ENTRY = re.compile(r"\s*(?P<key>[^=#]+?)\s*=\s*(?P<value>.*?)\s*")
_WORD = re.compile(r"[A-Za-z_/~.\\][^\"'\[\]{}#]*")
_QUANTITY = re.compile(r"([-+]?\d[\d_]*(?:\.\d+)?)\s*[^\d\s.,#eE:_-].*")


def no_toml(text: str, error: Exception) -> tuple[int | None, str]:
    """The number of the line at which a document ceases to be TOML, as the parser's error states it, and a sentence on what to do.

    Examples
    --------
    >>> import tomllib
    >>> try:
    ...     tomllib.loads("rig = article")
    ... except tomllib.TOMLDecodeError as error:
    ...     no_toml("rig = article", error)
    (1, 'this is not valid TOML: found rig = article; text stands in quotes: rig = "article".')
    """
    at = re.search(r"at line (\d+)", str(error))
    number = int(at[1]) if at else None
    lines = text.splitlines()
    line = lines[number - 1].strip() if number is not None and number <= len(lines) else ""
    advice = _advice(line, str(error))
    what = f"found {line.split(' #')[0].strip()}; {advice}" if advice else str(error)
    return number, f"this is not valid TOML: {what}."


def _advice(line: str, message: str) -> str:
    if message.startswith(("Cannot overwrite", "Cannot declare")):
        return "this name is there already; keep one of them"
    if line.startswith("["):
        name = line.split("#")[0].strip("[] ")
        return f"a table begins with [{name}], one of several with [[{name}]]" if re.fullmatch(r"[\w.-]+", name) else ""
    entry = _ENTRY.fullmatch(line)
    if entry is None:
        return "" if not line or "=" in line else "expected a key and its value: key = value"
    return _advice_on_value(entry["key"], entry["value"])


def _advice_on_value(key: str, value: str) -> str:
    bare = value.split("#")[0].strip()
    if not bare:
        return f"the value is missing: expected {key} = ..., or leave the line out"
    if bare.lower() in ("true", "false"):
        return f"expected {key} = {bare.lower()}, in small letters"
    if _WORD.fullmatch(bare):
        quote = "'" if "\\" in bare else '"'
        return f"text stands in quotes: {key} = {quote}{bare}{quote}"
    if re.fullmatch(r"[-+]?\d+,\d+", bare):
        return f"decimals follow a point: {key} = {bare.replace(',', '.')}"
    if quantity := _QUANTITY.fullmatch(bare):
        return f"a number stands alone: {key} = {quantity[1]}; text stands in quotes"
    if value[0] == '"' and "\\" in value:
        return f"in double quotes a \\ begins a special character; write / or use single quotes: {key} = {value.replace(chr(34), chr(39))}"
    if value[0] in "\"'" and value.count(value[0]) == 1:
        return f"the quotes do not end: {key} = {bare}{value[0]}"
    if value[0] == "'" and value.count("'") > 2:
        return 'text with an apostrophe stands in double quotes: "..."'
    return ""
