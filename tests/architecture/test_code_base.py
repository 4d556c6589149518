"""What holds for the code base as a whole; the layers themselves are checked by import-linter."""

import ast
import re
import subprocess
from pathlib import Path

import pytest

from rotaline.pipeline.options import option_entries

ROOT = Path(__file__).parents[2]
SOURCES = sorted((ROOT / "src").rglob("*.py"))


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT / "src")))
def test_what_is_public_is_documented(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    if path.name != "__init__.py":
        assert ast.get_docstring(tree), "the module has no docstring"
    nodes = [tree, *(n for n in tree.body if isinstance(n, ast.ClassDef) and not n.name.startswith("_"))]
    for node in nodes:
        for entry in node.body:
            if isinstance(entry, ast.FunctionDef | ast.ClassDef) and not entry.name.startswith("_"):
                assert ast.get_docstring(entry), entry.name


@pytest.mark.parametrize("entry", option_entries(), ids=lambda e: f"{e.stage}.{e.name}")
def test_every_option_says_what_it_does_and_its_unit(entry):
    assert len(entry.help) > 10
    for suffix, unit in (("_mm", "mm"), ("_px", "px"), ("_deg", "deg")):
        if entry.name.endswith(suffix):
            assert unit in entry.help


@pytest.mark.parametrize(
    "path", [p for p in SOURCES if "@compiled" in p.read_text(encoding="utf-8")], ids=lambda p: p.stem
)
def test_kernels_stand_where_the_stored_machine_code_is_watched(path):
    tree = ast.parse(path.read_text(encoding="utf-8"))
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            names = [d.id for d in node.decorator_list if isinstance(d, ast.Name)]
            if "compiled" in names:
                assert path.stem.endswith("kernels"), "the folder of stored machine code is named after *kernels.py"
                assert names == ["compiled", "no_type_check"], f"{node.name}: {names}"


def test_dependencies_are_locked_by_name_and_version_only():
    lines = (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines()
    assert lines
    assert [line for line in lines if not re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+!_-]+", line)] == []


def test_no_file_names_a_place_on_some_machine():
    files = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    pattern = re.compile(r"(?<![\w.])/(home|root|work|Users)/\w")
    found = [
        name
        for name in files
        if (ROOT / name).suffix in (".py", ".md", ".toml", ".jinja", ".css")
        and pattern.search((ROOT / name).read_text(encoding="utf-8"))
    ]
    assert found == []
