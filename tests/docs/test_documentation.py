"""Links, commands and option names in the documentation exist; examples in docstrings run."""

import doctest
import importlib
import pkgutil
import re
from pathlib import Path

import pytest

import rotaline
from rotaline.cli.app import app
from rotaline.pipeline.options import option_entries

ROOT = Path(__file__).parents[2]
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")])
COMMANDS = {command.name or command.callback.__name__ for command in app.registered_commands}
COMMANDS |= {group.name for group in app.registered_groups}
STAGES = {entry.stage for entry in option_entries()}
OPTIONS = {f"{entry.stage}.{entry.name}" for entry in option_entries()}


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    for link in re.findall(r"\]\(([^)#]+)[^)]*\)", page.read_text(encoding="utf-8")):
        if "://" not in link:
            assert (page.parent / link).exists(), link


@pytest.mark.parametrize("page", PAGES, ids=lambda p: str(p.relative_to(ROOT)))
def test_commands_and_options_that_are_named_exist(page):
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"`rotaline ([a-z][a-z-]+)", text):
        assert name.rstrip("-") in COMMANDS or name == "verify-", name
    for stage, name in re.findall(r"`([a-z_]+)\.([a-z_]+)(?: ?=[^`]*)?`", text):
        if stage in STAGES and name not in ("py", "json"):
            assert f"{stage}.{name}" in OPTIONS, f"{stage}.{name}"


def _modules():
    return sorted(
        m.name for m in pkgutil.walk_packages(rotaline.__path__, "rotaline.") if not m.name.endswith("__main__")
    )


@pytest.mark.parametrize("name", _modules())
def test_examples_in_docstrings_run(name):
    result = doctest.testmod(importlib.import_module(name), optionflags=doctest.NORMALIZE_WHITESPACE)
    assert result.failed == 0
