"""Where a key stands in a TOML file."""

import pytest

from rotaline.io.toml_file import line_of, where

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
