"""Where a key stands in a TOML file."""

import re
from importlib import resources

import pytest

from rotaline.errors import RigError
from rotaline.io.mistakes import _PATTERNS
from rotaline.io.toml_file import line_of, toml_of, where

TEXT = """version = 1
[camera]
  position_mm = [1, 2, 3]
[parts."my ball"]
diameter_mm = 3
[[captures]]
folder = "a"
[[captures]]
folder = "b"
[captures.mount]
tilt_deg = 1
[sensor]
noise.read_e = 3
"""


@pytest.mark.parametrize(
    ("place", "line"),
    [
        (("version",), 1),
        (("camera",), 2),
        (("camera", "position_mm"), 3),
        (("camera", "position_mm", 1), 3),
        (("camera", "roll_deg"), 2),
        (("parts", "my ball", "diameter_mm"), 5),
        (("captures", 0, "folder"), 7),
        (("captures", 0, "mount", "tilt_deg"), 6),
        (("captures", 1), 8),
        (("captures", 1, "folder"), 9),
        (("captures", 1, "mount", "tilt_deg"), 11),
        (("sensor", "noise", "read_e"), 13),
        (("laser",), None),
    ],
)
def test_the_line_of_a_key_or_of_the_table_around_it(place, line):
    assert line_of(TEXT, place) == line


def test_a_place_is_named_as_a_person_would_write_it():
    assert where("r.toml", TEXT, ("captures", 1, "mount"), "turn_deg") == "r.toml, line 10, captures[2].mount.turn_deg"
    assert where("r.toml", TEXT, (), "laser") == "r.toml, laser"


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("rig = my rig  # of the lab", 'found rig = my rig; text stands in quotes: rig = "my rig".'),
        ("port = /dev/ttyUSB0", 'text stands in quotes: port = "/dev/ttyUSB0".'),
        ("port = C:\\rig", "text stands in quotes: port = 'C:\\rig'."),
        ('port = "C:\\data"', "use single quotes: port = 'C:\\data'."),
        ('rig = "demo', 'the quotes do not end: rig = "demo".'),
        ("text = 'it's here'", "text with an apostrophe stands in double quotes"),
        ("step_deg = 2,5", "decimals follow a point: step_deg = 2.5."),
        ("settle_s = 0.2 s", "a number stands alone: settle_s = 0.2; text stands in quotes."),
        ("home = False", "expected home = false, in small letters."),
        ("home =", "the value is missing: expected home = ..., or leave the line out."),
        ("home true", "expected a key and its value: key = value."),
        ("[[captures]", "a table begins with [captures], one of several with [[captures]]."),
        ("version = 2", "found version = 2; this name is there already; keep one of them."),
        ("home = 1_0.", "this is not valid TOML: Expected newline"),  # in the words of the parser
    ],
)
def test_a_line_that_is_no_toml_is_shown_with_what_to_do(line, said):
    with pytest.raises(RigError) as error:
        toml_of("r.toml", f"version = 1\n{line}\n")
    assert str(error.value).startswith("r.toml, line 2: this is not valid TOML: ")
    assert said in str(error.value)


def test_every_form_that_a_table_asks_of_text_has_words():
    tables = (resources.files("rotaline.io") / f"{name}.py" for name in ("rig_tables", "plan_tables", "session_file"))
    forms = {form for table in tables for form in re.findall(r'pattern=r"([^"]+)"', table.read_text(encoding="utf-8"))}
    assert forms == set(_PATTERNS)
