import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.io.report.reproduction import BudgetLevel, BudgetSource
from rotaline.pipeline.options import ARTICLE_OPTIONS
from rotaline.pipeline.reproduce.budget import (
    article_figures,
    conclusion,
    describe,
    reproducing_setting,
    true_knowledge,
)
from rotaline.pipeline.reproduce.budget_sources import SOURCES, ideal_conditions
from rotaline.pipeline.reproduce.plan import article_rig
from rotaline.pipeline.reproduce.virtual_rig import TITLES, Noise, observe_capture, resulting_figures
from rotaline.simulation.plan import full_turn, mount, scan_capture
from rotaline.simulation.truth import plain_value

RUN_OUT = next(source for source in SOURCES if source.key == "run-out")


@pytest.fixture(scope="module")
def ideal():
    return ideal_conditions(article_rig(small_images=True))


def _levels(*pairs):
    return [BudgetLevel(x, {"mean_distance": y}) for x, y in pairs]


def test_the_setting_is_interpolated_where_the_figure_first_reaches_the_target():
    levels = _levels((0.0, 0.001), (10.0, 0.006), (30.0, 0.016), (100.0, 0.01))
    expected = np.sqrt(10.0**2 + (0.011**2 - 0.006**2) / (0.016**2 - 0.006**2) * (30.0**2 - 10.0**2))
    assert reproducing_setting(levels, "mean_distance", 0.011) == pytest.approx(expected)


@pytest.mark.parametrize(
    "pairs",
    [
        ((0.0, 0.001), (10.0, 0.002)),  # not reached
        ((0.0, 0.02), (10.0, 0.03)),  # there without the error
        ((0.0, float("nan")), (10.0, 0.03)),  # not known without it
        ((0.0, 0.001), (10.0, float("nan"))),
    ],
)
def test_there_may_be_no_such_setting(pairs):
    assert reproducing_setting(_levels(*pairs), "mean_distance", 0.011) is None
    assert reproducing_setting(_levels(*pairs), "ball", 0.011) is None


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(1e-4, 1.0), min_size=2, max_size=5), st.floats(1e-3, 1.0))
def test_at_the_setting_the_interpolated_figure_is_the_target(figures, target):
    levels = _levels(*((float(i), figure) for i, figure in enumerate(figures)))
    setting = reproducing_setting(levels, "mean_distance", target)
    if setting is not None:
        squares = np.square(range(len(figures)))
        assert np.interp(setting**2, squares, np.square(figures)) == pytest.approx(target**2, rel=1e-6)
    else:
        assert figures[0] >= target or max(figures) < target


def test_the_words_say_what_was_found():
    article = {"mean_distance": 0.011, "ball": 0.004, "groove": 0.01}
    levels = [
        BudgetLevel(0.0, {"mean_distance": 0.001, "ball": 0.005, "groove": 0.002}),
        BudgetLevel(100.0, {"mean_distance": 0.021, "ball": 0.006, "groove": 0.0023}),
    ]
    reached = {key: reproducing_setting(levels, key, value) for key, value in article.items()}
    text = describe(RUN_OUT, levels, reached, article)
    assert f"{TITLES['mean_distance']} of 0.0110 mm at 52 um" in text
    assert f"{TITLES['ball']}: 0.0050 mm already without it" in text
    assert f"{TITLES['groove']}: no effect, 0.0023 mm at 100 um" in text


def test_the_conclusion_names_what_alone_is_enough_and_says_where_nothing_is():
    levels = tuple(_levels((0.0, 0.001), (10.0, 0.02)))
    enough = BudgetSource("run-out", "run-out", "um", False, levels, {"mean_distance": 5.43, "ball": None}, "")
    not_enough = BudgetSource("speckle", "speckle", "", True, levels, {"mean_distance": None, "ball": None}, "")
    text = conclusion([enough, not_enough], {"mean_distance": 0.011, "ball": 0.004})
    assert text.endswith("Mean distance of feature points after of 0.0110 mm: run-out (5.4 um).")
    assert "none of them" in conclusion([not_enough], {"mean_distance": 0.011})


def test_the_article_s_figures_are_those_of_its_tables():
    figures = article_figures()
    assert set(figures) <= set(TITLES)
    assert figures["mean_distance"] == 0.011
    assert figures["diameters"] == pytest.approx(0.0289)
    assert figures["groove"] == pytest.approx(0.01046)


@pytest.mark.parametrize("source", SOURCES, ids=lambda s: s.key)
def test_the_first_level_is_none_of_the_error_and_the_last_is_some(source, ideal):
    def stated(conditions):
        return plain_value(vars(conditions)["rig"]), {
            k: plain_value(v) for k, v in vars(conditions).items() if k != "rig"
        }

    assert list(source.levels) == sorted(source.levels)
    assert stated(source.apply(ideal, source.levels[0])) == stated(ideal)
    assert stated(source.apply(ideal, source.levels[-1])) != stated(ideal)


def test_run_out_alone_makes_diameters_wrong(ideal):
    def figures(conditions):
        rig = conditions.rig
        plan = scan_capture(rig, conditions.stepped, mount(-3.0, 2.5), full_turn(8), folder="stepped", role="artifact")
        stripes = observe_capture(rig, plan, Noise(0.01, 1), 0)
        angles = np.radians([shot.angle_deg for shot in plan.shots])
        return resulting_figures(true_knowledge(rig), stripes, angles, (), ARTICLE_OPTIONS)

    without, with_it = figures(ideal), figures(RUN_OUT.apply(ideal, 100.0))
    assert without["mean_distance"] < 0.002
    assert without["diameters"] < 0.001
    assert with_it["mean_distance"] > 3 * without["mean_distance"]
