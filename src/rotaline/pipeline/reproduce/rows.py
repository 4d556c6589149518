"""Comparisons with the article: the rule of the verdicts, and tables made of them."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from rotaline.io.report.reproduction import Comparison, ComparisonTable, TableRow, Verdict
from rotaline.pipeline.options import Options

EQUAL_WITHIN = 0.2

RULE = (
    "A figure is equal to the article's if it lies within 20 % of it, better below that, worse above: errors count without sign. "
    "Where more is better (a reduction in per cent), what is left of the error counts (100 % minus the reduction)."
)


def verdict(article: float | None, ours: float | None, more_is_better: bool = False) -> Verdict:
    """How a figure compares with the article's, see :data:`RULE`; ``more_is_better``: both are reductions in per cent."""
    if article is None or ours is None or not np.isfinite(ours):
        return "none"
    if more_is_better:
        article, ours = 100.0 - article, max(100.0 - ours, 0.0)
    if abs(ours) < (1.0 - EQUAL_WITHIN) * abs(article):
        return "better"
    return "equal" if abs(ours) <= (1.0 + EQUAL_WITHIN) * abs(article) else "worse"


def error_figure(
    quantity: str,
    unit: str,
    article: float | None,
    by_article_method: float | None,
    by_default_method: float | None,
    *,
    digits: int | None = 4,
    more_is_better: bool = False,
    note: str = "",
) -> Comparison:
    """A figure that is the better the smaller it is (or the larger), with its verdicts."""
    return Comparison(
        quantity,
        unit,
        article,
        _number(by_article_method),
        _number(by_default_method),
        verdict(article, by_article_method, more_is_better),
        verdict(article, by_default_method, more_is_better),
        digits,
        note,
    )


def plain_figure(
    quantity: str,
    unit: str,
    article: float | None,
    by_article_method: float | None,
    by_default_method: float | None,
    *,
    digits: int | None = 4,
) -> Comparison:
    """A figure that is neither good nor bad: a size, a count, or one that is judged in another column."""
    return Comparison(
        quantity, unit, article, _number(by_article_method), _number(by_default_method), "none", "none", digits
    )


def _number(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)


def list_table(place: str, title: str, comparisons: Sequence[Comparison], text: str = "") -> ComparisonTable:
    """A table of one column, one row a figure."""
    rows = tuple(TableRow(f"{c.quantity} / {c.unit}" if c.unit else c.quantity, (c,)) for c in comparisons)
    return ComparisonTable(place, title, ("",), rows, text)


def average(
    comparisons: Sequence[Comparison], article: float | None = None, more_is_better: bool = False
) -> Comparison:
    """The mean of a column of errors or sizes; ``article`` is what the article prints for it, None: the mean of its column."""
    first = comparisons[0]

    def mean(values: Sequence[float | None]) -> float | None:
        known = [v for v in values if v is not None]
        return float(np.mean(known)) if known and len(known) == len(values) else None

    theirs = article if article is not None else mean([c.article for c in comparisons])
    ours = [mean([getattr(c, name) for c in comparisons]) for name in ("by_article_method", "by_default_method")]
    if any(c.verdict_default_method != "none" or c.verdict_article_method != "none" for c in comparisons):
        return error_figure(first.quantity, first.unit, theirs, *ours, digits=first.digits)
    return plain_figure(first.quantity, first.unit, theirs, *ours, digits=first.digits)


def reduction_percent(before_mm: float | None, after_mm: float | None) -> float | None:
    """By how many per cent an error became smaller; None where there was none before."""
    if before_mm is None or after_mm is None or not before_mm:
        return None
    return 100.0 * (1.0 - abs(after_mm) / abs(before_mm))


def changed_options(options: Options, defaults: Options) -> dict[str, tuple[str, str]]:
    """``stage.name`` to (here, by default), where they differ."""
    changed = {}
    for stage in dataclasses.fields(Options):
        for field in dataclasses.fields(getattr(options, stage.name)):
            here = getattr(getattr(options, stage.name), field.name)
            default = getattr(getattr(defaults, stage.name), field.name)
            if here != default:
                changed[f"{stage.name}.{field.name}"] = (str(here), str(default))
    return changed
