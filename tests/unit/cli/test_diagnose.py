"""``rotaline diagnose`` shows a verdict, whole and within the terminal, and ends with its exit code."""

import json
import math

import pytest

from rotaline.calibration.verdict.model import Figure, Finding, StepVerdict, Verdict
from rotaline.cli.app import main
from rotaline.io.verdict_file import write_verdict


def make_verdict(level: str, n_findings: int = 2) -> Verdict:
    """A verdict with long texts, in which brackets are not markup."""
    text = "The plates [laser/0004.png] contradict each other by far more than their noise, " * 2
    return Verdict(
        level,
        f"The calibration is {level}: " + text,
        (
            StepVerdict("camera", "pass", "Fine.", (Figure("RMS", 0.04, "px", "below 0.1 px"),)),
            StepVerdict("laser-plane", level, text, tuple(Figure(f"figure {i}", i + 0.5, "mm") for i in range(9))),
            StepVerdict("table", "none", "The session has no full turn."),
        ),
        tuple(
            Finding(f"cause {i}", "laser-plane", level, f"Pose {i}: {text}", f"Take pose {i} again.", 3.0)
            for i in range(n_findings)
        ),
        0.0068,
        math.nan,
    )


@pytest.mark.parametrize(("level", "code"), [("pass", 0), ("doubtful", 1), ("fail", 3)])
def test_the_exit_code_is_the_verdict(tmp_path, capsys, level, code):
    write_verdict(tmp_path / "verdict.json", make_verdict(level))
    assert main(["diagnose", str(tmp_path)]) == code
    assert f" {level.upper()} " in capsys.readouterr().out


def test_all_is_shown_within_80_columns(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    write_verdict(tmp_path / "verdict.json", make_verdict("fail"))
    main(["diagnose", str(tmp_path)])
    out = capsys.readouterr().out
    assert max(len(line.rstrip()) for line in out.splitlines()) <= 80
    assert "…" not in out
    text = " ".join(out.split())
    assert text.count("[laser/0004.png]") == 8  # twice each: the sentence, the step, two findings
    places = ["FAIL", "Laser plane", "figure 8", "What to do, most useful first"]
    places += ["1. Take pose 0 again.", "about 3.0 times smaller", "2. Take pose 1 again."]
    assert sorted(places, key=text.index) == places


def test_nothing_to_do(tmp_path, capsys):
    write_verdict(tmp_path / "verdict.json", make_verdict("pass", n_findings=0))
    main(["diagnose", str(tmp_path)])
    assert "Nothing needs to be done." in capsys.readouterr().out


def test_json_is_the_file(tmp_path, capsys):
    path = tmp_path / "verdict.json"
    write_verdict(path, make_verdict("doubtful"))
    assert main(["diagnose", str(tmp_path), "--json"]) == 1
    assert json.loads(capsys.readouterr().out) == json.loads(path.read_text())


def test_a_session_that_cannot_be_read_gets_a_verdict_too(tmp_path, capsys):
    (tmp_path / "session.toml").write_text('version = 1\n[[captures]]\nfolder = "camera"\nrole = "camer"\n')
    assert main(["diagnose", str(tmp_path)]) == 3
    text = " ".join(capsys.readouterr().out.split())
    assert text.startswith("FAIL The session cannot be calibrated: 1 thing must be mended first.")
    assert "Session fail" in text
    assert "line 4" in text
    assert "found 'camer', expected" in text
    assert "`rotaline check`" in text


@pytest.mark.parametrize(
    ("name", "said"), [("calibration.json", "Diagnose the session itself"), ("x", "it is neither")]
)
def test_a_folder_without_a_verdict(tmp_path, capsys, name, said):
    (tmp_path / name).write_text("{}")
    assert main(["diagnose", str(tmp_path)]) == 2
    assert said in capsys.readouterr().err
