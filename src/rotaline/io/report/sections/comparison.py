"""Tables of the article with ours beside it, and the tables of the budget, as rows of text."""

import math
from collections.abc import Sequence
from typing import Literal

from rotaline.io.report import numbers
from rotaline.io.report.page import Block, Column, Paragraph, Row, Table
from rotaline.io.report.reproduction import Budget, BudgetSource, Comparison, ComparisonTable

_SOURCES = ("article", "its method", "default")
_MOST_BESIDE = 9
"""Columns of figures that a page has room for."""
NOT_DONE = "This experiment was not done: see the warnings."


def table_blocks(table: ComparisonTable) -> tuple[Block, ...]:
    """What the table is about, and the table."""
    text: tuple[Block, ...] = (Paragraph(table.text),) if table.text else ()
    return (*text, comparison_table(table))


def comparison_table(table: ComparisonTable) -> Table:
    """The article's table with ours beside each figure, or below each row where the table is wide.

    A table of one column gets a line for each figure, with its unit.
    """
    caption = f"{table.title.rstrip('.')} (the article's {table.place[:1].lower()}{table.place[1:]})."
    notes = dict.fromkeys(f"{c.quantity}: {c.note}" for c in table.comparisons() if c.note)
    note = " ".join(_sentence(n) for n in notes)
    if len(table.columns) <= 1:
        return _list(table, caption, note)
    kept = _filled(table)
    return _beside(table, kept, caption, note) if len(kept) <= _MOST_BESIDE else _below(table, caption, note)


def _values(c: Comparison) -> tuple[float | None, float | None, float | None]:
    return c.article, c.by_article_method, c.by_default_method


def _marks(c: Comparison) -> tuple[str, str, str]:
    return "", c.verdict_article_method, c.verdict_default_method


def _list(table: ComparisonTable, caption: str, note: str) -> Table:
    columns = (
        Column("Quantity", numeric=False),
        Column("Unit", numeric=False),
        *(Column(title, group="" if i == 0 else "ours") for i, title in enumerate(_SOURCES)),
    )
    rows = tuple(
        Row(
            (_bare(row.name or c.quantity, c.unit), c.unit, *(figure(c, v) for v in _values(c))),
            marks=("", "", *_marks(c)),
        )
        for row in table.rows
        for c in row.cells
    )
    return Table(caption, columns, rows, note)


def _filled(table: ComparisonTable) -> list[tuple[int, int]]:
    """Columns of the article and sources (see ``_SOURCES``) that have a value in some row."""
    return [
        (i, k)
        for i in range(len(table.columns))
        for k in range(len(_SOURCES))
        if any(i < len(row.cells) and _values(row.cells[i])[k] is not None for row in table.rows)
    ]


def _beside(table: ComparisonTable, kept: list[tuple[int, int]], caption: str, note: str) -> Table:
    """Up to three columns for each of the article's."""
    units = _units(table)
    columns = (
        Column("No.", numeric=False),
        *(Column(_SOURCES[k], units[i], group=_bare(table.columns[i], units[i])) for i, k in kept),
    )
    rows = []
    for row in table.rows:
        cells = [(row.cells[i], k) if i < len(row.cells) else None for i, k in kept]
        texts = (figure(c[0], _values(c[0])[c[1]]) if c else "" for c in cells)
        marks = (_marks(c[0])[c[1]] if c else "" for c in cells)
        rows.append(Row((row.name, *texts), "total" if row.name == "Average" else "plain", ("", *marks)))
    return Table(caption, columns, tuple(rows), note)


def _below(table: ComparisonTable, caption: str, note: str) -> Table:
    """Up to three lines for each row of the article."""
    units = _units(table)
    parted = [_bare(title, unit).rpartition(", ") for title, unit in zip(table.columns, units, strict=True)]
    columns = (
        Column("No.", numeric=False),
        Column("", numeric=False),
        *(Column(label, unit, group=group) for (group, _, label), unit in zip(parted, units, strict=True)),
    )
    rows: list[Row] = []
    for row in table.rows:
        first = True
        for k, source in enumerate(_SOURCES):
            values = [_values(c)[k] for c in row.cells]
            if all(v is None for v in values):
                continue
            padding = [""] * (len(table.columns) - len(values))
            texts = [figure(c, v) for c, v in zip(row.cells, values, strict=True)]
            name = row.name if first else ""
            kind: Literal["plain", "continued"] = "plain" if first else "continued"
            marks = ("", "", *(_marks(c)[k] for c in row.cells), *padding)
            rows.append(Row((name, source, *texts, *padding), kind, marks))
            first = False
    return Table(caption, columns, tuple(rows), note)


def _units(table: ComparisonTable) -> list[str]:
    """The unit of each column; empty where its cells differ."""
    found = [{row.cells[i].unit for row in table.rows if i < len(row.cells)} for i in range(len(table.columns))]
    return [next(iter(units)) if len(units) == 1 else "" for units in found]


def figure(comparison: Comparison, value: float | None) -> str:
    """A value as the comparison wants it written."""
    if comparison.digits is None:
        return numbers.significant(value, 4)
    return numbers.fixed(value, comparison.digits)


def _bare(title: str, unit: str) -> str:
    """A title without the unit that it ends with; the unit stands in a place of its own."""
    return title.removesuffix(f" / {unit}") if unit else title


def _sentence(text: str) -> str:
    return text if text.endswith(".") else f"{text}."


def reproducing_table(budget: Budget) -> Table:
    """At which setting each error alone gives the article's figure."""
    keys = [k for k in budget.article if k in budget.titles]
    columns = (
        Column("Error of the rig", numeric=False),
        Column("Tried"),
        Column("Seen in", numeric=False),
        *(
            Column(budget.titles[k], f"{numbers.um(budget.article[k])} µm", group="alone gives the article's")
            for k in keys
        ),
    )
    rows = []
    for source in budget.sources:
        settings = [level.setting for level in source.levels]
        rows.append(
            Row(
                (
                    source.title,
                    f"{min(settings):g} to {max(settings):g} {source.unit}".rstrip() if settings else numbers.MISSING,
                    "images" if source.from_images else "observations",
                    *(_reproducing(source, k) for k in keys),
                )
            )
        )
    return Table(
        "The setting at which one error alone gives the article's figure, by interpolation between the settings that were tried.",
        columns,
        tuple(rows),
        "“never”: not at any setting that was tried. Images: frames were rendered and processed; observations: the stripe's centres were "
        "computed without images.",
    )


def _reproducing(source: BudgetSource, key: str) -> str:
    setting = source.reproducing.get(key)
    return "never" if setting is None else f"{numbers.significant(setting, 2)} {source.unit}".rstrip()


def levels_table(budget: Budget) -> Table:
    """All settings of all errors with the resulting figures."""
    keys = list(budget.titles)
    rows = []
    for source in budget.sources:
        for i, level in enumerate(source.levels):
            cells = (
                source.title if i == 0 else "",
                f"{level.setting:g} {source.unit}".rstrip(),
                *(numbers.um(level.figures.get(k, math.nan)) for k in keys),
            )
            rows.append(Row(cells, "plain" if i == 0 else "continued"))
    article = ("The article", "", *(numbers.um(budget.article.get(k)) for k in keys))
    return Table(
        "All settings that were tried, and the resulting figures.",
        (
            Column("Error of the rig, alone", numeric=False),
            Column("Setting"),
            *(Column(budget.titles[k], "µm") for k in keys),
        ),
        (*rows, Row(article, "total")),
    )


def seeds_table(seeds: dict[str, int]) -> Table:
    """The seeds, by what they fix."""
    return _pairs("Seeds: with them, the same program draws the same images.", "Fixes", "Seed", list(seeds.items()))


def _pairs(caption: str, left: str, right: str, rows: Sequence[tuple[str, object]]) -> Table:
    return Table(
        caption,
        (Column(left, numeric=False), Column(right)),
        tuple(Row((a, str(b))) for a, b in rows),
        stacks=2 if len(rows) > 8 else 1,
    )
