"""What a material may be."""

import pytest

from rotaline.simulation.parts.material import Material


def test_the_limits_are_allowed():
    assert Material(0.0, 0.0, 90.0) != Material(1.0, 1.0, 90.0)


@pytest.mark.parametrize(
    ("values", "match"),
    [
        ({"albedo": 1.01}, "albedo of a material must be 0 to 1, not 1.01"),
        ({"albedo": float("nan")}, "albedo"),
        ({"gloss": -0.1}, "gloss"),
        ({"gloss_width_deg": 0.0}, "gloss_width_deg"),
        ({"gloss_width_deg": 91.0}, "gloss_width_deg"),
    ],
)
def test_other_values_are_refused(values, match):
    with pytest.raises(ValueError, match=match):
        Material(**values)
