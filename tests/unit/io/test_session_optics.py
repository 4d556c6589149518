"""The optional table ``[optics]`` of ``session.toml``."""

import pytest

from rotaline.calibration.speckle_limit import LaserOptics
from rotaline.io.session_file import parse_session_file
from rotaline.simulation.plan import SessionPlan
from rotaline.simulation.rig import build_rig
from rotaline.simulation.session import session_toml

TABLE = "version = 1\n[optics]\nf_number = 8\npixel_pitch_um = 3.45\nwavelength_nm = 450\n"


def parse(text):
    return parse_session_file(text.encode(), "session.toml")


def test_it_is_read_and_the_contrast_is_that_of_full_speckle_unless_stated():
    content, problems = parse(TABLE)
    assert problems == []
    assert content.optics == LaserOptics(8.0, 3.45, 450.0, 1.0)
    content, _ = parse(TABLE + "speckle_contrast = 0.2\n")
    assert content.optics.speckle_contrast == 0.2


def test_a_session_need_not_state_it():
    content, _ = parse("version = 1\n")
    assert content.optics is None


@pytest.mark.parametrize(
    ("line", "said", "fatal"),
    [
        ("speckle_contrast = 1.5", "expected 1 or less", True),
        ("f_number = 0", "expected more than 0", True),
        ("aperture = 3", "not known", False),
    ],
)
def test_mistakes_are_named_with_their_line(line, said, fatal):
    name = line.split()[0]
    text = "\n".join(row for row in TABLE.splitlines() if not row.startswith(f"{name} ")) + f"\n{line}\n"
    _, [(where, problem, is_fatal)] = parse(text)
    assert f"line {len(text.splitlines())}" in where
    assert said in problem
    assert is_fatal == fatal


def test_rendered_sessions_state_it():
    rig = build_rig()
    content, problems = parse(session_toml(SessionPlan({}, ()), rig))
    assert problems == []
    assert content.optics == LaserOptics(
        rig.optics.f_number, rig.optics.pixel_pitch_um, rig.laser.wavelength_nm, rig.laser.speckle_contrast
    )
