"""The page of the rig file names every table and key with its default and meaning, as the models have them."""

from pathlib import Path

import pytest

from rotaline.io import rig_tables
from rotaline.io.rig_file import parse_rig, read_preset

HOW_TO = Path(__file__).parents[2] / "docs" / "how-to"
PAGE = (HOW_TO / "rig-file.md").read_text(encoding="utf-8")
TUTORIAL = (HOW_TO / "simulate.md").read_text(encoding="utf-8")
TABLES = [
    value
    for name, value in vars(rig_tables).items()
    if name.endswith("Table") and isinstance(value, type) and not name.startswith("_") and value is not rig_tables.Table
]


def _default(field):
    if field.is_required():
        return "required"
    value = field.default
    if value is None:
        return "–"
    if isinstance(value, rig_tables.Table):
        return "{}"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple):
        return str(list(value))
    return f'"{value}"' if isinstance(value, str) else str(value)


def rows(table):
    """The lines of a table of keys."""
    return [
        f"| `{name}` | {_default(field)} | {field.description} |"
        for name, field in table.model_fields.items()
        if not (name == "kind" and field.is_required())
    ]


@pytest.mark.parametrize("table", TABLES, ids=lambda t: t.__name__)
def test_every_key_stands_on_the_page(table):
    assert table.__doc__.strip() in PAGE
    for row in rows(table):
        assert row in PAGE.splitlines(), f"write this line into docs/how-to/rig-file.md:\n{row}"


def test_there_is_no_key_on_the_page_that_the_program_does_not_know():
    known = {row for table in [rig_tables.RigTables, *TABLES] for row in rows(table)} | {
        "| key | default | meaning |",
        "|---|---|---|",
    }
    stated = {line for line in PAGE.splitlines() if line.startswith("|")}
    assert stated - known == set()


def _examples(page):
    return [block.split("```")[0] for block in page.split("```toml\n")[1:]]


@pytest.mark.parametrize("example", [*_examples(PAGE), *_examples(TUTORIAL)])
def test_the_examples_are_rig_files(example):
    file = parse_rig(example, "example")
    if "mesh" not in {part.kind for part in file.tables.parts.values()}:
        assert file.plan().n_frames > 0


def test_a_rig_file_of_the_page_changes_what_it_says():
    changed = parse_rig(next(text for text in _examples(PAGE) if "preset" in text), "example")
    assert changed.rig().mechanics.angle_noise_deg == 0.01
    assert changed.rig().camera == read_preset("article").rig().camera
