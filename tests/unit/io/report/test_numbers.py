"""How numbers are written."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.io.report import numbers

finite = st.floats(-1e6, 1e6)


@pytest.mark.parametrize("missing", [None, math.nan, math.inf, -math.inf])
def test_missing_numbers_are_an_en_dash(missing):
    assert numbers.mm(missing) == numbers.um(missing) == numbers.percent(missing) == "–"
    assert numbers.significant(missing) == numbers.seconds(missing) == numbers.parameter(missing, 0.1) == "–"


@settings(deadline=None, max_examples=100)
@given(finite)
def test_lengths_read_back_to_a_tenth_of_a_micrometre(value):
    text = numbers.mm(value).replace("\N{MINUS SIGN}", "-")
    assert abs(float(text) - value) <= 0.5001e-4
    assert len(text.split(".")[1]) == 4


@settings(deadline=None, max_examples=100)
@given(finite, st.integers(0, 6))
def test_a_sign_stands_before_every_number_but_zero(value, decimals):
    text = numbers.fixed(value, decimals, signed=True)
    is_zero = float(text.strip("+\N{MINUS SIGN}")) == 0.0
    assert text[0].isdigit() if is_zero else text[0] == ("+" if value > 0 else "\N{MINUS SIGN}")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (numbers.um(0.0123), "12.3"),
        (numbers.um(-0.00012), "−0.12"),
        (numbers.percent(0.9036, 2), "90.36"),
        (numbers.parameter(2450.1234, 0.61), "2450.12"),
        (numbers.parameter(2450.1234, math.nan), "2450.12"),
        (numbers.significant(0.00071, 2), "0.00071"),
        (numbers.significant(-2.3e-9, 2), "−2.3e−9"),
        (numbers.count(1234567), "1\u202f234\u202f567"),
        (numbers.seconds(0.42), "0.42 s"),
        (numbers.seconds(185.0), "3 min 05 s"),
        (numbers.plural(1, "vertex", "vertices"), "1 vertex"),
        (numbers.plural(2, "vertex", "vertices"), "2 vertices"),
    ],
)
def test_examples(text, expected):
    assert text == expected
