import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.pipeline.reproduce.rows import (
    average,
    error_figure,
    list_table,
    plain_figure,
    reduction_percent,
    verdict,
)

errors = st.floats(1e-6, 1e3)


@pytest.mark.parametrize(
    ("ours", "expected"),
    [(0.079, "better"), (-0.079, "better"), (0.081, "equal"), (-0.119, "equal"), (0.121, "worse"), (-0.2, "worse")],
)
def test_an_error_within_a_fifth_is_equal(ours, expected):
    assert verdict(0.1, ours) == expected


@pytest.mark.parametrize(("ours", "expected"), [(95.0, "better"), (91.0, "equal"), (85.0, "worse"), (-20.0, "worse")])
def test_of_a_reduction_what_is_left_counts(ours, expected):
    assert verdict(90.0, ours, more_is_better=True) == expected


@pytest.mark.parametrize(("article", "ours"), [(None, 1.0), (1.0, None), (1.0, float("nan"))])
def test_without_a_figure_there_is_no_verdict(article, ours):
    assert verdict(article, ours) == "none"


@settings(deadline=None, max_examples=50)
@given(errors, errors, st.floats(1e-3, 1e3))
def test_the_verdict_does_not_depend_on_the_unit(article, ours, factor):
    ratio = ours / article
    if min(abs(ratio - 0.8), abs(ratio - 1.2)) > 1e-9:
        assert verdict(article, ours) == verdict(factor * article, factor * ours)


def test_a_figure_that_was_not_found_is_none():
    cell = error_figure("error", "mm", 0.01, float("nan"), 0.02)
    assert cell.by_article_method is None
    assert (cell.verdict_article_method, cell.verdict_default_method) == ("none", "worse")


def test_the_average_is_judged_only_where_its_column_is():
    column = [error_figure("error", "mm", 0.01 * k, 0.005 * k, 0.02 * k) for k in (1, 2, 3)]
    mean = average(column)
    assert (mean.article, mean.by_article_method, mean.by_default_method) == pytest.approx((0.02, 0.01, 0.04))
    assert (mean.verdict_article_method, mean.verdict_default_method) == ("better", "worse")
    assert average(column, 0.04).verdict_default_method == "equal"
    sizes = average([plain_figure("diameter", "mm", 1.0, 1.1, None), plain_figure("diameter", "mm", 2.0, 1.9, 2.0)])
    assert sizes.verdict_article_method == "none"
    assert sizes.by_default_method is None  # one of them was not found


def test_a_reduction_needs_an_error_before():
    assert reduction_percent(0.4, -0.1) == pytest.approx(75.0)
    assert reduction_percent(0.0, 0.1) is None
    assert reduction_percent(None, 0.1) is None


def test_rows_of_a_list_carry_their_units():
    table = list_table(
        "Section 1", "Title", [plain_figure("length", "mm", 1.0, 1.0, 1.0), plain_figure("n", "", 1.0, 1.0, 1.0)]
    )
    assert [row.name for row in table.rows] == ["length / mm", "n"]
    assert len(list(table.comparisons())) == 2
