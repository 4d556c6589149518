"""Comparing two runs of the benchmarks: what became slower by more than the noise, and only that."""

import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[3]
sys.path.insert(0, str(ROOT))

from benchmarks.compare import compare, main  # noqa: E402
from benchmarks.harness import Measurement, Part, filled, growth, growths, in_rounds, read_results, write_results  # noqa: E402


def times(name: str, middle: float, spread: float, n: int = 9) -> Measurement:
    """Repeats whose median absolute deviation is known."""
    return Measurement("b", name, "s", tuple(middle + spread * np.linspace(-1, 1, n) * 2 / 1.4826))


def test_the_spread_is_the_standard_deviation_of_normal_noise() -> None:
    assert times("x", 3.0, 0.1).spread == pytest.approx(0.1)
    values = np.random.default_rng(0).normal(5.0, 0.2, 4001)
    assert Measurement("b", "x", "s", tuple(values)).spread == pytest.approx(0.2, rel=0.05)


def part(name: str, *measurements: Measurement) -> Part:
    return Part(name, 7.0, f"table of {name}", measurements)


@pytest.mark.parametrize(
    ("spread", "factor", "verdict"),
    [
        (0.001, 1.04, "same"),  # below the least change that counts
        (0.001, 1.06, "slower"),
        (0.001, 1 / 1.06, "faster"),
        (0.10, 1.25, "same"),  # two spreads, of both runs: 28 %
        (0.10, 1.35, "slower"),
        (0.10, 1 / 1.35, "faster"),
    ],
)
def test_a_change_counts_beyond_the_combined_spread(spread: float, factor: float, verdict: str) -> None:
    (change,) = compare([times("x", 1.0, spread)], [times("x", factor, factor * spread)])
    assert change.verdict == verdict
    assert change.ratio == pytest.approx(factor)


def test_single_values_are_taken_for_noisy() -> None:
    old, new = (Measurement("b", "x", "s", (value,)) for value in (1.0, 1.5))
    assert compare([old], [new])[0].verdict == "same"
    assert compare([old], [Measurement("b", "x", "s", (1.8,))])[0].verdict == "slower"


def test_only_times_that_both_runs_have_are_compared() -> None:
    old = [times("x", 1.0, 0.01), Measurement("b", "error", "px", (0.01,) * 5), times("gone", 1.0, 0.01)]
    new = [times("x", 1.0, 0.01), Measurement("b", "error", "px", (9.0,) * 5), times("fresh", 9.0, 0.01)]
    assert [c.name for c in compare(old, new)] == ["b: x"]
    sizes = [Measurement("b", "x", "s", (1.0,) * 5, n, "frames") for n in (10, 20)]
    assert [c.verdict for c in compare(sizes[:1], sizes[1:])] == []


def test_files_are_written_read_and_compared(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    old, new = tmp_path / "old.json", tmp_path / "new.json"
    write_results(old, [part("b", times("x", 1.0, 0.01), Measurement("b", "y", "px", (np.nan,)))], quick=True)
    write_results(new, [part("b", times("x", 2.0, 0.01)), part("other")], quick=True)
    _, (only,) = read_results(old)
    assert (only.name, only.seconds, only.table) == ("b", 7.0, "table of b")
    assert only.measurements[0] == times("x", 1.0, 0.01)
    assert np.isnan(only.measurements[1].values[0])
    assert main([str(old), str(new)]) == 0
    out = capsys.readouterr().out
    assert "1 of 1 times became slower" in out
    assert "x 2.00" in out
    assert "0 of 1 times became faster" in out


def test_what_is_no_file_of_results_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "other.json"
    other.write_text('{"schema": "something else"}')
    assert main([str(other), str(tmp_path / "missing.json")]) == 2
    assert "expected a file that `python -m benchmarks` wrote" in capsys.readouterr().err
    assert main([str(other)]) == 2


def test_growth_finds_the_power() -> None:
    series = [Measurement("b", "x", "s", (3e-6 * n**1.5,), n, "points") for n in (1e3, 1e4, 1e5)]
    g = growth(series)
    assert g.exponent == pytest.approx(1.5)
    assert g.factor == pytest.approx(3e-6)
    assert [one.name for one in growths(series)] == ["x"]
    assert growths(series[:2]) == []


def test_functions_take_turns_and_go_through_their_frames() -> None:
    calls: list[tuple[str, int]] = []
    seconds = in_rounds(
        {"a": lambda i: calls.append(("a", i)), "b": lambda i: calls.append(("b", i))}, 3, budget_s=1.0, most_calls=2
    )
    assert {name: len(values) for name, values in seconds.items()} == {"a": 3, "b": 3}
    turns = calls[4:]  # after the first two of each, which warm up
    assert [name for name, _ in turns] == ["a", "a", "b", "b"] * 3
    assert [i for name, i in turns if name == "a"] == list(range(6))


def test_tables_take_the_places_that_are_marked_for_them() -> None:
    page = "# T\n\n```text a\nold\nmore\n```\n\n```text ab\n```\n\n```\nkept\n```\n"
    new = filled(page, {"a": r"1 \d", "ab": "2\n3", "elsewhere": "x"})
    assert new == "# T\n\n```text a\n1 \\d\n```\n\n```text ab\n2\n3\n```\n\n```\nkept\n```\n"
    assert filled(new, {"ab": "2\n3"}) == new
