"""The verdict on disk."""

import json
import math

import pytest

from rotaline.calibration.verdict.model import Figure, Finding, StepVerdict, Verdict
from rotaline.errors import SessionError
from rotaline.io.verdict_file import read_verdict, write_verdict

VERDICT = Verdict(
    "fail",
    "The laser plane is wrong.",
    (
        StepVerdict("camera", "pass", "Fine.", (Figure("RMS", 0.04, "px", "below 0.1 px"),)),
        StepVerdict("laser-plane", "fail", "The plates contradict each other.", (Figure("RMS", math.nan, "mm"),)),
        StepVerdict("axis", "none", ""),
    ),
    (Finding("target moved", "laser-plane", "fail", "Pose 4 is 0.3 mm off.", "Take it again.", 12.0),),
    math.nan,
    0.005,
)


def test_it_comes_back_as_it_was(tmp_path):
    write_verdict(tmp_path / "verdict.json", VERDICT)
    back = read_verdict(tmp_path / "verdict.json")
    assert math.isnan(back.u_point_mm)
    assert math.isnan(back.steps[1].figures[0].value)
    assert repr(back) == repr(VERDICT)
    assert json.loads((tmp_path / "verdict.json").read_text())["u_point_mm"] is None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"version": 2}, "found version 2"),
        ({"level": "good"}, "level"),
        ({"steps": None}, "steps"),
        ({"findings": [{"cause": "x"}]}, "findings.0"),
    ],
)
def test_what_is_no_verdict_is_refused(tmp_path, change, said):
    path = tmp_path / "verdict.json"
    write_verdict(path, VERDICT)
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(SessionError, match=said):
        read_verdict(path)
