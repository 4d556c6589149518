"""The page of the reproduced article: complete, self-contained, and honest about what was not done."""

import dataclasses

import numpy as np
import pytest

from rotaline.geometry.primitives import Line
from rotaline.io.report.figures import comparison, complex_parts
from rotaline.io.report.figures.axis import across
from rotaline.io.report.raster import View, hidden, picture_position, render_mesh, view_rotation
from rotaline.io.report.reproduction import Comparison, ComparisonTable, TableRow
from rotaline.io.report.reproduction_page import render_reproduction, write_reproduction
from rotaline.io.report.sections.comparison import comparison_table, levels_table, reproducing_table

FRONT = View(view_rotation(0.0, 0.0), np.zeros(3), 0.1, (120, 100))


@pytest.fixture(scope="module")
def full_page(full_reproduction):
    return render_reproduction(full_reproduction)


def bare(reproduction):
    """Only what needs no images."""
    return dataclasses.replace(
        reproduction,
        sensor=None,
        initial_axis=None,
        mounts=None,
        stepped=None,
        stepped_disturbed=None,
        parts=None,
        complex_parts=None,
        budget=None,
    )


def cell(article, faithful, default, **more):
    settings = {"unit": "mm", "digits": 4} | more
    return Comparison("error", settings.pop("unit"), article, faithful, default, "worse", "better", **settings)


def test_everything_is_drawn_and_nothing_comes_from_outside(full_page):
    assert "could not be drawn" not in full_page
    assert full_page.count('<img src="data:image/') == full_page.count("<img") > 25
    assert "<script" not in full_page
    assert 'href="http' not in full_page
    assert "was not done" not in full_page


def test_the_first_page_says_how_it_was_made(full_page, full_reproduction):
    first = full_page[: full_page.index('id="sensor"')]
    for text in ("frames 7, noise 11", "Linux x86_64, 2 cores", "0.1.0", "quick", "within 20 %", "W3 is only 1.2 mm"):
        assert text in first
    for n in full_reproduction.verdicts().values():
        assert f"<strong>{n} <small>of {sum(full_reproduction.verdicts().values())} figures" in first


def test_what_was_not_done_is_named(full_reproduction):
    page = render_reproduction(bare(full_reproduction))
    assert page.count("This experiment was not done: see the warnings.") == 7
    assert "could not be drawn" not in page


def test_text_is_escaped_and_the_page_is_a_file(full_reproduction, tmp_path):
    info = dataclasses.replace(full_reproduction.info, warnings=("a <b> & c",), quick=False)
    write_reproduction(dataclasses.replace(bare(full_reproduction), info=info), tmp_path / "reproduction.html")
    text = (tmp_path / "reproduction.html").read_text(encoding="utf-8")
    assert "a &lt;b&gt; &amp; c" in text
    assert [p.name for p in tmp_path.iterdir()] == ["reproduction.html"]


def test_a_table_of_one_column_has_a_line_for_each_figure():
    rows = (
        TableRow("error / mm", (cell(0.02, 0.03, 0.01),)),
        TableRow("share / %", (cell(None, 5.0, 4.0, unit="%", digits=1),)),
    )
    table = comparison_table(ComparisonTable("Section 5.2, figure 8", "Sensor", ("",), rows))
    assert [r.cells for r in table.rows] == [
        ("error", "mm", "0.0200", "0.0300", "0.0100"),
        ("share", "%", "–", "5.0", "4.0"),
    ]
    assert table.rows[0].marks == ("", "", "", "worse", "better")
    assert table.caption == "Sensor (the article's section 5.2, figure 8)."


def test_a_narrow_table_has_ours_beside_the_article_without_empty_columns():
    row = TableRow("W1", (cell(None, 0.3, 0.2), cell(0.02, 0.03, 1e-12, digits=None)))
    table = comparison_table(ComparisonTable("Table 3", "Ball", ("size / mm", "error / mm"), (row,)))
    assert [(c.group, c.label, c.unit) for c in table.columns[1:]] == [
        ("size", "its method", "mm"),
        ("size", "default", "mm"),
        ("error", "article", "mm"),
        ("error", "its method", "mm"),
        ("error", "default", "mm"),
    ]
    assert table.rows[0].cells == ("W1", "0.3000", "0.2000", "0.02000", "0.03000", "1.000e−12")
    assert table.rows[0].marks == ("", "worse", "better", "", "worse", "better")
    assert table.column_groups() == [("", 1), ("size", 2), ("error", 3)]


def test_a_wide_table_has_ours_below_the_article():
    cells = tuple(cell(0.01 * i, 0.02, None) for i in range(5))
    columns = tuple(f"small, error {i} / mm" for i in range(5))
    table = comparison_table(ComparisonTable("Table 2", "Stepped", columns, (TableRow("W1", cells),)))
    assert [(r.cells[:3], r.kind) for r in table.rows] == [
        (("W1", "article", "0.0000"), "plain"),
        (("", "its method", "0.0200"), "continued"),
    ]
    assert (table.columns[2].group, table.columns[2].label) == ("small", "error 0")
    assert table.rows[1].marks == ("", "", *["worse"] * 5)


def test_the_budget_says_where_one_error_gives_the_articles_figure(full_reproduction):
    budget = full_reproduction.budget
    table = reproducing_table(budget)
    assert [r.cells[3] for r in table.rows] == ["never", "0.015 deg", "0.010 mm", "0.0075", "0.0060 %"]
    assert {r.cells[4] for r in table.rows} == {"never"}
    assert [r.cells[1:3] for r in table.rows][2:4] == [("0 to 0.02 mm", "observations"), ("0 to 0.02", "images")]
    levels = levels_table(budget)
    assert len(levels.rows) == 4 * 5 + 1
    assert levels.rows[-1].cells[2:4] == ("11.0", "28.9")
    assert levels.rows[9].cells[-1] == "–"


@pytest.mark.parametrize("sense", [1.0, -1.0])
def test_the_initial_axis_is_drawn_where_it_is_beside_the_true_one(full_reproduction, sense):
    section = full_reproduction.initial_axis
    fitted = section.axis.axis_camera
    shift = 0.05 * across(fitted)[0]
    moved = Line(fitted.point + shift - 17.0 * fitted.direction, sense * fitted.direction)
    ax, ax_height, _ = comparison.centres_and_truth(dataclasses.replace(section, true_axis_camera=moved)).axes
    (line,) = [one for one in ax.lines if str(one.get_label()).startswith("initial axis")]
    np.testing.assert_allclose(np.hypot(*line.get_data()), 50.0, rtol=1e-9)
    heights = ax_height.lines[0].get_xdata()
    assert heights.min() == 0.0
    assert heights.max() == pytest.approx(np.ptp(section.axis.circle_centres_camera @ fitted.direction))


def test_details_are_marked_where_they_face_the_viewer(full_reproduction):
    part = full_reproduction.complex_parts.parts[0]
    for detail, index in zip(part.details, range(3), strict=True):
        azimuth = float(np.rad2deg(np.arctan2(detail.direction_table[1], detail.direction_table[0])))
        towards = View(view_rotation(azimuth, 0.0), np.array([0.0, 0.0, 25.0]), 0.2, (300, 300))
        away = View(view_rotation(azimuth + 180.0, 0.0), np.array([0.0, 0.0, 25.0]), 0.2, (300, 300))
        assert index in complex_parts.seen_details(part, towards)
        assert index not in complex_parts.seen_details(part, away)
        open_part = dataclasses.replace(part, triangles=part.triangles[:1])  # nothing is left to hide it
        assert index not in complex_parts.seen_details(open_part, away)


def test_a_close_view_looks_at_the_detail_from_outside(full_reproduction):
    detail = full_reproduction.complex_parts.parts[0].details[0]
    view = complex_parts.close_view(detail)
    assert view.rotation[2] @ detail.direction_table > 0.9
    np.testing.assert_allclose(picture_position(detail.position_table[None], view)[0], (149.5, 149.5, 0.0), atol=1e-9)
    assert view.mm_per_px * view.size_px[0] == pytest.approx(5.0 * detail.radius_mm)


@pytest.mark.parametrize("tip", [(150.0, 150.0), (290.0, 150.0), (150.0, 2.0), (3.0, 297.0)])
def test_the_number_of_an_arrow_stands_in_the_picture_and_away_from_its_tip(tip):
    at = complex_parts._place_beside(np.array(tip), np.array([300.0, 300.0]))
    assert ((at >= 20.0) & (at <= 280.0)).all()
    assert np.linalg.norm(at - tip) > 25.0


def test_a_point_behind_the_mesh_is_hidden_and_one_in_front_is_not():
    y, z = np.meshgrid(np.linspace(-3, 3, 25), np.linspace(-3, 3, 25))
    wall = np.stack([np.zeros(y.size), y.ravel(), z.ravel()], axis=1)
    points = np.array([[-4.0, 0.0, 0.0], [4.0, 0.0, 0.0], [-4.0, 5.0, 0.0], [-0.5, 0.0, 0.0]])
    assert hidden(points, wall, FRONT).tolist() == [True, False, False, False]


def test_picture_positions_are_where_the_mesh_is_drawn():
    square = np.array([[0, 1.0, 1.0], [0, 2.0, 1.0], [0, 2.0, 2.0], [0, 1.0, 2.0]])
    picture = render_mesh(square, np.array([[0, 1, 2], [0, 2, 3]]), [FRONT])[0]
    v, u = np.nonzero((picture < 250).any(axis=2))
    middle = picture_position(square, FRONT).mean(axis=0)
    assert u.mean() == pytest.approx(middle[0], abs=0.6)
    assert v.mean() == pytest.approx(middle[1], abs=0.6)


def test_a_mesh_keeps_the_colours_of_its_vertices():
    square = np.array([[0, -3.0, -3.0], [0, 3.0, -3.0], [0, 3.0, 3.0], [0, -3.0, 3.0]])
    colours = np.array([[0.8, 0.0, 0.0], [0.0, 0.0, 0.8], [0.0, 0.0, 0.8], [0.8, 0.0, 0.0]])
    picture = render_mesh(square, np.array([[0, 1, 2], [0, 2, 3]]), [FRONT], colours)[0].astype(int)
    left, right = picture[50, 35], picture[50, 85]
    assert left[0] > 150 > 60 > left[2]
    assert right[2] > 150 > 60 > right[0]
