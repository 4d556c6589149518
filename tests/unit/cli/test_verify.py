"""Tables, JSON and exit codes of verify-uncertainty and verify-methods."""

import json
import math

import pytest

import rotaline.pipeline.verify_efficiency as verify_efficiency
import rotaline.pipeline.verify_methods as verify_methods
import rotaline.pipeline.verify_uncertainty as verify_uncertainty
from rotaline.cli.app import main

NAN = math.nan


@pytest.fixture
def verified(monkeypatch):
    """Both verifications as they might end; ``calls``: with what they were called."""
    calls = []
    coverage = verify_uncertainty.UncertaintyVerification(
        (
            verify_uncertainty.CoverageRow("all", "", "", 600, 0.947, 0.012, 1.02, 0.01, 0.6, NAN, NAN, (0.93, 0.97)),
            verify_uncertainty.CoverageRow(
                "axis", "axis_turn_x", "rad", 200, 0.85, 0.03, 1.4, 0.2, 0.9, 3e-5, 4.2e-5, (0.9, 0.985)
            ),
            verify_uncertainty.CoverageRow(
                "camera", "k1", "1", 200, 0.5, 0.03, 2.0, 0.2, 0.9, 2e-4, 4e-4, (0.9, 0.985)
            ),
        ),
        200,
        20,
        (),
        {"wobble once per turn": 3},
    )
    efficiency = verify_efficiency.EfficiencyVerification(
        (verify_efficiency.EfficiencyRow("Gaussian", "all", 200, 15, 1.043, 0.026, 0.9, 1.1),), 0.98, ()
    )

    def of_uncertainty(n, plan):
        calls.append((n, plan.jobs, plan.folder))
        return coverage

    monkeypatch.setattr(verify_uncertainty, "verify_uncertainty", of_uncertainty)
    monkeypatch.setattr(verify_efficiency, "verify_efficiency", lambda n, plan: efficiency)
    return calls


def test_coverage_and_efficiency_are_shown(verified, capsys, tmp_path):
    assert main(["verify-uncertainty", "--realisations", "200", "--jobs", "1", "--out", str(tmp_path)]) == 0
    assert verified == [(200, 1, tmp_path)]
    out = capsys.readouterr().out
    assert "94.7" in out
    assert "93 to 97" in out
    line = next(line for line in out.splitlines() if "axis turn x" in line)
    assert "missed" in line
    assert "30.0" in line
    assert "42.0" in line
    assert "missed" not in next(line for line in out.splitlines() if "k1" in line)
    assert "1.043" in out
    assert "wobble once per turn 3" in out


def test_both_as_json(verified, capsys):
    assert main(["verify-uncertainty", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["coverage"]["rows"][0]["coverage"] == 0.947
    assert document["coverage"]["rows"][0]["mean_u"] is None
    assert document["efficiency"]["rows"][0]["ratio"] == 1.043


def test_methods_are_shown_and_a_failure_is_the_exit_code(monkeypatch, capsys):
    rows = (
        verify_methods.MethodsRow("rod, diameter", "mm", 19, 0.0123, 0.0011, 11.18, 1.3),
        verify_methods.MethodsRow("axis, direction", "rad", 19, 3e-4, 4e-5, 7.5, NAN),
    )
    result = verify_methods.MethodsVerification(rows, 19, True, ("s03, article: [no] corner",))
    monkeypatch.setattr(verify_methods, "verify_methods", lambda n, rendered, plan: result)
    assert main(["verify-methods"]) == 1
    out = capsys.readouterr().out
    assert "RMS errors over 19 rendered sessions" in out
    assert "12.30" in out
    assert "11.2" in out
    assert "300.0" in out
    assert "not done: s03, article: [no] corner" in out


def test_a_rendered_session_without_its_truth_is_bad_input(tmp_path, capsys):
    (tmp_path / "s").mkdir()
    assert main(["verify-methods", "--rendered", str(tmp_path / "s"), "--out", str(tmp_path / "o")]) == 2
    assert "truth" in capsys.readouterr().err


def test_a_folder_that_cannot_be_written_is_found_out_at_once(tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert main(["verify-uncertainty", "--out", str(tmp_path / "file" / "x")]) == 4
