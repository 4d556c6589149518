"""``rotaline diagnose`` on a session and on its results."""

import json

CODES = {"pass": 0, "doubtful": 1, "fail": 3}


def test_a_session_and_its_results_have_the_same_verdict(call, place):
    of_session = call("diagnose", place.session)
    verdict = json.loads((place.results / "verdict.json").read_text())
    assert verdict["level"] != "fail"
    assert of_session.code == CODES[verdict["level"]]
    assert verdict["text"] in " ".join(of_session.out.split())
    of_results = call("diagnose", place.results)
    assert (of_results.code, of_results.out) == (of_session.code, of_session.out)
    assert json.loads(call("diagnose", place.results, "--json").out) == verdict


def test_a_session_without_a_camera_capture_fails_at_the_camera(call, place):
    captures = '[[captures]]\nfolder = "camera"\nrole = "camera"\ntarget = "checkerboard"\n'
    place.edit("session.toml", captures, "")
    outcome = call("diagnose", place.session, "--json")
    verdict = json.loads(outcome.out)
    assert outcome.code == 3
    (camera,) = (s for s in verdict["steps"] if s["step"] == "camera")
    assert camera["level"] == "fail"
    assert any(f["step"] == "camera" for f in verdict["findings"])


def test_a_folder_that_is_neither_a_session_nor_results_is_wrong_use(call, place, tmp_path):
    (tmp_path / "other").mkdir()
    outcome = call("diagnose", tmp_path / "other")
    assert outcome.code == 2
    assert "session.toml" in outcome.err
    assert "verdict.json" in outcome.err


def test_results_without_a_verdict_say_what_to_diagnose(call, place):
    (place.results / "verdict.json").unlink()
    outcome = call("diagnose", place.results)
    assert outcome.code == 2
    assert "diagnose SESSION" in outcome.err
