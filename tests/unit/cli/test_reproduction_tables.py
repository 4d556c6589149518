import json
from types import MappingProxyType

import pytest

from rotaline.cli.reproduction_tables import figure_text, show_reproduction
from rotaline.io.files import plain
from rotaline.io.report.reproduction import (
    Budget,
    BudgetLevel,
    BudgetSource,
    Reproduction,
    ReproductionInfo,
    SimulationSection,
    reproduction_document,
)
from rotaline.pipeline.reproduce.rows import RULE, error_figure, list_table, plain_figure

FIGURES = MappingProxyType({0.0: 0.001, 50.0: float("nan")})


@pytest.fixture
def reproduction():
    info = ReproductionInfo(
        quick=True,
        rig="article",
        image_size=(640, 480),
        seeds={"noise": 7},
        rule=RULE,
        changed_options={},
        finished_at="2026-07-05T12:00:00+00:00",
        seconds=12.0,
        versions={},
        machine="a machine",
        n_frames=10,
        warnings=("Figure 16: no surface.",),
    )
    figures = [error_figure("interval RMSE", "mm", 0.003, 0.001, 0.004), plain_figure("length", "mm", None, 1.0, None)]
    levels = tuple(BudgetLevel(x, {"ball": y}) for x, y in FIGURES.items())
    source = BudgetSource("run-out", "run-out", "um", False, levels, {"ball": None}, "ball: not reached.")
    return Reproduction(
        info=info,
        claims=list_table("Abstract", "Claims", figures, "What it claims."),
        sensor=None,
        initial_axis=None,
        simulation=SimulationSection(list_table("Section 5.4", "Simulation", []), ()),
        mounts=None,
        stepped=None,
        stepped_disturbed=None,
        parts=None,
        complex_parts=None,
        budget=Budget({"ball": "error of the ball"}, {"ball": 0.004}, (source,), "Else ideal."),
    )


def test_the_terminal_shows_figures_verdicts_budget_rule_and_seeds(reproduction, capsys):
    show_reproduction(reproduction)
    text = capsys.readouterr().out
    (row,) = [line for line in text.splitlines() if "interval RMSE" in line]
    for part in ("0.0030", "0.0010", "better", "0.0040", "worse"):
        assert part in row
    assert "0 better, 0 equal, 1 worse" in text
    (last,) = [line for line in text.splitlines() if "50 um" in line]
    assert "–" in last
    assert "nan" not in text
    for part in (RULE[:60], "noise 7", "not done: Figure 16: no surface.", "run-out: ball: not reached."):
        assert part in text


def test_the_document_is_json_and_holds_every_table(reproduction):
    document = json.loads(json.dumps(plain(reproduction_document(reproduction)), allow_nan=False))
    assert document["verdicts"] == {"better": 0, "equal": 0, "worse": 1}
    assert [table["place"] for table in document["tables"]] == ["Abstract", "Section 5.4"]
    assert document["budget"]["sources"][0]["levels"][1]["figures"] == {"ball": None}
    assert document["info"]["seeds"] == {"noise": 7}


def test_small_figures_are_shown_in_powers_of_ten():
    cell = error_figure("mean distance", "mm", 2.278e-7, 3e-14, None, digits=None)
    assert figure_text(cell, cell.article) == "2.278e-07"
    assert figure_text(cell, cell.by_default_method) == "–"
