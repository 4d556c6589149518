"""Scales, ranges and the way figures become images."""

import base64
import io

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from rotaline.io.report import style


@settings(deadline=None, max_examples=100)
@given(st.floats(1e-6, 1e6))
def test_rounding_down_gives_1_2_5_and_never_more(value):
    rounded = style.round_down_125(value)
    assert value / 2.51 < rounded <= value * (1 + 1e-9)
    assert f"{rounded:e}"[0] in "125"


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(-10, 10) | st.just(np.nan), min_size=0, max_size=30), st.floats(0.1, 100))
def test_exaggeration_is_at_least_1_and_keeps_the_larger_deviations_short(values, length):
    deviations = np.array(values)
    factor = style.exaggeration(deviations, length)
    assert factor >= 1.0
    finite = np.abs(deviations[np.isfinite(deviations)])
    if len(finite) and factor > 1.0:
        assert factor * np.percentile(finite, 98) <= length * 1.001


@pytest.mark.parametrize("values", [[], [np.nan], [2.0, 2.0], [0.0]])
def test_ranges_are_never_empty(values):
    array = np.array(values)
    low, high = style.robust_range(array)
    assert high > low
    assert style.symmetric_limit(array) > 0.0


def _figure():
    figure = style.new_figure(2.0, 1.0)
    ax = figure.add_subplot()
    ax.plot([0, 1], [1, 5])
    style.style_axes(ax, "title", "x [mm]", "y [mm]")
    style.log_axis(ax, np.array([1.0, 5.0]))
    return figure


def test_a_figure_becomes_an_image_of_its_size_on_white():
    _, data = style.png_uri(_figure(), dpi=100.0).split("base64,")
    image = Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB")
    assert image.size == (200, 100)
    assert image.getpixel((1, 1)) == (255, 255, 255)


def test_an_svg_holds_no_link_and_no_date():
    _, data = style.svg_uri(_figure()).split("base64,")
    text = base64.b64decode(data).decode()
    assert "dc:date" not in text
    assert 'href="http' not in text


def test_a_figure_can_be_written_alone(tmp_path):
    style.save_png(_figure(), tmp_path / "one.png")
    assert [p.name for p in tmp_path.iterdir()] == ["one.png"]
    with Image.open(tmp_path / "one.png") as image:
        assert image.size == (320, 160)


def test_the_palette_is_told_apart_in_grey_and_without_red_or_green():
    """Neighbouring series differ for viewers without one of the cone types (Viénot 1999, linear RGB)."""
    colours = np.array([[int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)] for c in style.SERIES]) ** 2.2
    protan = np.array([[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]])
    deutan = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]])
    for matrix in (np.eye(3), protan, deutan):
        seen = np.clip(colours @ matrix.T, 0, 1) ** (1 / 2.2)
        assert min(np.linalg.norm(a - b) for i, a in enumerate(seen) for b in seen[:i]) > 0.1
