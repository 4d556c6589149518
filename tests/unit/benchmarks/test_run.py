"""A run of the benchmarks: one that fails or is interrupted does not lose the others, and what is there is not measured again."""

import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
sys.path.insert(0, str(ROOT))

from benchmarks import __main__ as runner  # noqa: E402
from benchmarks.harness import Benchmark, Measurement, Setting, read_results  # noqa: E402
from benchmarks.suite import SUITE  # noqa: E402


class Suite:
    """Three benchmarks; each counts its runs, and raises ``errors[name]`` if there is one."""

    def __init__(self) -> None:
        self.runs: list[str] = []
        self.errors: dict[str, BaseException] = {}
        self.benchmarks = tuple(Benchmark(name, name, self._of(name)) for name in ("one", "two", "three"))

    def _of(self, name: str) -> Callable[[Setting], list[Measurement]]:
        def run(setting: Setting) -> list[Measurement]:
            self.runs.append(name)
            if name in self.errors:
                raise self.errors[name]
            print(f"{name}, run {len(self.runs)}")
            return [Measurement(name, "x", "s", (2.0 * n,), n, "frames") for n in (1.0, 2.0, 4.0)]

        return run


@pytest.fixture
def suite(monkeypatch: pytest.MonkeyPatch) -> Suite:
    suite = Suite()
    monkeypatch.setattr(runner, "SUITE", suite.benchmarks)
    return suite


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., int]:
    def start(*options: str) -> int:
        monkeypatch.setattr(sys, "argv", ["benchmarks", "--out", str(tmp_path), *options])
        return runner.main()

    return start


def parts(folder: Path) -> dict[str, str]:
    """The tables of the file of results by name."""
    return {part.name: part.table.splitlines()[0] for part in read_results(folder / runner.RESULTS)[1]}


def test_one_that_fails_does_not_lose_the_others(
    suite: Suite, run: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    suite.errors["two"] = ValueError("no such thing")
    assert run() == 1
    assert list(parts(tmp_path)) == ["one", "three"]
    error = capsys.readouterr().err
    assert "no such thing" in error
    assert "failed: two" in error
    suite.errors.clear()
    assert run("--resume") == 0
    assert suite.runs == ["one", "two", "three", "two"]
    assert parts(tmp_path) == {"one": "one, run 1", "two": "two, run 4", "three": "three, run 3"}
    growth = json.loads((tmp_path / runner.RESULTS).read_text())["growth"]
    assert [(g["benchmark"], round(g["exponent"], 6)) for g in growth] == [(n, 1.0) for n in ("one", "two", "three")]


def test_an_interrupted_run_goes_on(suite: Suite, run: Callable[..., int], tmp_path: Path) -> None:
    suite.errors["two"] = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        run()
    assert list(parts(tmp_path)) == ["one"]
    suite.errors.clear()
    assert run("--resume") == 0
    assert suite.runs == ["one", "two", "two", "three"]


def test_one_is_measured_anew_beside_those_that_are_there(
    suite: Suite, run: Callable[..., int], tmp_path: Path
) -> None:
    assert run() == 0
    assert run("--resume", "--only", "two") == 0
    assert parts(tmp_path) == {"one": "one, run 1", "two": "two, run 4", "three": "three, run 3"}
    assert run("--only", "two") == 0
    assert parts(tmp_path) == {"two": "two, run 5"}


def test_results_of_another_run_are_not_mixed(
    suite: Suite, run: Callable[..., int], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--quick") == 0
    assert run("--resume") == 2
    assert "quick True, now False" in capsys.readouterr().err
    assert run("--quick", "--resume") == 0
    assert suite.runs == ["one", "two", "three"]


def test_the_page_has_what_is_there_after_each(suite: Suite, run: Callable[..., int], tmp_path: Path) -> None:
    (tmp_path / "pictures").mkdir()
    page = tmp_path / "benchmarks.md"
    page.write_text("```text machine\n```\n```text one\n```\n```text two\nas it was\n```\n")
    suite.errors["two"] = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        run("--docs", str(tmp_path))
    text = page.read_text()
    assert "one, run 1\nx: grows with the power 1.00" in text
    assert "seconds that each part took: one 0\n```" in text
    assert "as it was" in text


def test_every_benchmark_has_its_place_on_the_page() -> None:
    page = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    for benchmark in SUITE:
        assert f"```text {benchmark.name}\n" in page
        assert f"`{benchmark.name}`" in page.split("## How to read the figures")[0]
