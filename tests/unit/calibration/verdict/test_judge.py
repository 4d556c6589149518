"""Measured parts against their references, the order of findings, and the words for lengths."""

import numpy as np
import pytest

from rotaline.calibration.verdict.evidence import Scale, gain_of, level_of, um, worst
from rotaline.calibration.verdict.judge import MeasuredEntry, judge_measurements
from rotaline.calibration.verdict.model import Finding, StepVerdict, Verdict

CLEAN = Verdict("pass", "", (StepVerdict("camera", "pass", ""), StepVerdict("measure", "none", "")), (), 2e-3, 5e-3)


def entry(name, error, reference=30.0, u=0.001):
    return MeasuredEntry(name, reference + error, reference, u)


def measured(*entries, verdict=CLEAN):
    result = judge_measurements(verdict, entries)
    (step,) = [s for s in result.steps if s.step == "measure"]
    return result, step


def test_values_within_u_pass():
    result, step = measured(entry("ball", 0.0019), entry("rod", -0.0015))
    assert step.level == result.level == "pass"
    assert result.findings == ()
    assert [f.value for f in step.figures] == pytest.approx([0.0019, -0.0015])


@pytest.mark.parametrize(("error", "level"), [(0.003, "doubtful"), (-0.0059, "doubtful"), (0.0061, "fail")])
def test_an_error_beyond_u_is_doubtful_and_beyond_three_u_fails(error, level):
    result, step = measured(entry("ball", error), entry("rod", 0.001))
    assert step.level == result.level == level
    (finding,) = result.findings
    assert (finding.cause, finding.step, finding.level) == ("wrong result", "measure", level)
    assert "ball" in finding.text
    assert "rod" not in finding.text


def test_of_many_values_some_lie_outside_by_chance():
    result, _ = measured(*(entry(f"part {k}", 0.0025 * (k == 3)) for k in range(20)))
    assert result.level == "pass"
    assert "19 of 20" in next(s.text for s in result.steps if s.step == "measure")
    result, _ = measured(*(entry(f"part {k}", 0.0032 * (k == 3)) for k in range(20)))  # 3.2 u: one in 36 of twenty
    assert result.level == "doubtful"
    result, _ = measured(entry("part", 0.0025))
    assert result.level == "doubtful"


def test_the_kind_of_the_errors_tells_the_likely_step():
    by_one_factor, _ = measured(entry("ball", 0.030, 30.0), entry("rod", 0.0402, 40.0), entry("groove", 0.012, 12.0))
    assert "+0.10 %" in by_one_factor.findings[0].text
    assert "laser-plane" in by_one_factor.findings[0].text
    by_one_length, _ = measured(entry("ball", 0.030, 10.0), entry("rod", 0.0303, 40.0), entry("pin", 0.0299, 80.0))
    assert "likely step is axis" in by_one_length.findings[0].text
    anyhow, _ = measured(entry("ball", 0.030), entry("rod", -0.02))
    assert "scan itself" in anyhow.findings[0].text


def test_with_a_cause_known_that_is_the_likely_step():
    cause = Finding("wrong pitch", "laser-plane", "fail", "The pitch is 6.1 mm.", "Measure it.", 20.0)
    known = Verdict("fail", "", CLEAN.steps, (cause,), 2e-3, 5e-3)
    result, _ = measured(entry("ball", 0.03), verdict=known)
    assert {f.cause for f in result.findings} == {"wrong pitch", "wrong result"}
    assert "laser-plane: wrong pitch" in next(f for f in result.findings if f.step == "measure").text


def test_without_references_or_uncertainties_nothing_is_judged():
    for entries in ((), (entry("ball", 0.03, u=float("nan")),)):
        result, step = measured(*entries)
        assert step.level == "none"
        assert result.level == "pass"


def test_judging_again_replaces_the_step():
    once, _ = measured(entry("ball", 0.03))
    again, step = measured(entry("ball", 0.0), verdict=once)
    assert step.level == again.level == "pass"
    assert again.findings == ()


def test_sizes_that_matter_are_those_of_the_noise():
    scale = Scale(0.01, 50.0, 300.0)
    assert [level_of(s, scale) for s in (0.02, 0.049, 0.051)] == ["doubtful", "doubtful", "fail"]
    assert gain_of(0.0, scale) == 1.0
    assert gain_of(0.1, scale) == pytest.approx(np.sqrt(101))
    assert Scale(0.0, 50.0, 300.0).matters_mm == 1e-3
    assert worst(["none", "pass"]) == "pass"
    assert worst(["doubtful", "fail", "none"]) == "fail"
    assert worst([]) == "none"


@pytest.mark.parametrize(
    ("mm", "words"), [(0.0123, "12 um"), (0.25, "0.25 mm"), (-0.003, "-3 um"), (np.nan, "unknown")]
)
def test_lengths_in_words(mm, words):
    assert um(mm) == words
