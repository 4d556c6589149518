"""The page of rig.toml names every key of every driver with its default and meaning, as the drivers have them."""

from pathlib import Path

import pytest

from rotaline.hardware.drivers import DRIVERS, KINDS, settings_type
from rotaline.io.device_file import ReplayTable, SimulatedTable, meaning_of, parse_device_file

DOCS = Path(__file__).parents[2] / "docs" / "how-to"
PAGE = (DOCS / "rig-toml.md").read_text(encoding="utf-8")
TABLES = {
    "[simulated]": SimulatedTable,
    "[replay]": ReplayTable,
    **{f'[{kind}] driver = "{name}"': settings_type(kind, name) for kind in KINDS for name in DRIVERS[kind]},
}
HEAD = ["| key | default | meaning |", "|---|---|---|"]


def _default(field):
    if field.is_required():
        return "required"
    value = field.default
    if value is None:
        return "–"
    if isinstance(value, bool):
        return str(value).lower()
    return f'"{value}"' if isinstance(value, str) else str(value)


def section(title):
    """What stands on the page below the heading of a table."""
    table = TABLES[title]
    fields = [(name, field) for name, field in table.model_fields.items() if name != "driver"]
    rows = [f"| `{name}` | {_default(field)} | {meaning_of(field)} |" for name, field in fields]
    return [f"### {title}", "", *([*HEAD, *rows] if rows else ["No further keys."]), ""]


@pytest.mark.parametrize("title", TABLES)
def test_every_key_stands_on_the_page(title):
    wanted = "\n".join(section(title))
    assert wanted in PAGE, f"write this into docs/how-to/rig-toml.md:\n{wanted}"


def test_there_is_no_key_on_the_page_that_no_driver_knows():
    known = {row for title in TABLES for row in section(title)}
    generated = PAGE.split("## Keys")[1]
    assert {line for line in generated.splitlines() if line.startswith(("|", "###"))} - known == set()


def _examples():
    pages = [DOCS / "rig-toml.md", DOCS / "rig-check.md", *sorted((DOCS / "devices").glob("*.md"))]
    for page in pages:
        for i, block in enumerate(page.read_text(encoding="utf-8").split("```toml\n")[1:]):
            yield pytest.param(block.split("```")[0], id=f"{page.stem}-{i}")


@pytest.mark.parametrize("text", list(_examples()))
def test_the_examples_are_files_of_devices(text):
    """Those that show one table are completed."""
    if "version" not in text:
        text = f"version = 1\n{text}"
    if "[camera]" not in text:
        text += '\n[camera]\ndriver = "uvc"\n'
    parse_device_file(text, "example", Path())


def test_every_driver_has_a_page_that_the_list_of_devices_leads_to():
    page = (DOCS / "devices" / "README.md").read_text(encoding="utf-8")
    for names in DRIVERS.values():
        for name in names:
            assert f"`{name}`" in page
    for one in (DOCS / "devices").glob("*.md"):
        assert one.name == "README.md" or f"]({one.name})" in page
