"""The command line from a rendered session to measured parts, and what a second run does."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
import trimesh

from rotaline.cli.app import main
from rotaline.geometry.fitting import across
from rotaline.geometry.transforms import base_from_axis
from rotaline.io.calibration_file import read_calibration
from rotaline.io.clouds import read_points
from rotaline.simulation.rig import Sensor, build_rig
from rotaline.simulation.session import write_session
from rotaline.simulation.small_session import small_plan
from rotaline.simulation.truth import truth_path


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    """A session with every kind of capture, and the results of ``rotaline run`` on it; not to be changed."""
    folder = tmp_path_factory.mktemp("finished")
    rig = build_rig((480, 360))
    plan = small_plan(rig, captures=("camera", "laser", "axis", "stepped", "ball", "rod"), shuffled=True)
    write_session(folder / "session", rig, plan)
    assert main(["run", str(folder / "session"), "--quiet"]) == 0
    return folder


def _entries(folder, name="measurements.json"):
    return {(e["capture"], e["feature"]): e for e in json.loads((folder / name).read_text())}


def test_all_results_are_there_and_the_session_is_untouched(finished):
    results = finished / "session-results"
    for name in (
        "calibration.json",
        "verdict.json",
        "measurements.json",
        "measurements-initial-axis.json",
        "report.html",
        "log.txt",
    ):
        assert (results / name).stat().st_size > 0, name
    for capture in ("stepped", "ball", "rod"):
        assert len(read_points(results / "clouds" / f"{capture}.ply")) > 500
    for capture in ("ball", "rod"):
        for suffix in (".ply", ".stl"):
            assert len(read_points(results / "meshes" / f"{capture}{suffix}")) > 500
    assert sorted(p.name for p in finished.iterdir()) == ["session", "session-results", "session.truth.json"]
    assert not list(results.rglob(".*"))
    assert "could not be drawn" not in (results / "report.html").read_text()


def _errors(found, truth):
    """Truth minus calibration, in the parameters of the covariance."""
    covariance, plane, axis = found.covariance, found.laser_plane_camera, found.rotation_axis_camera
    errors = {name: truth["camera"][name] - getattr(found.camera, name) for name in ("fx", "fy", "cx", "cy")}
    normal, offset = np.array(truth["laser_plane_camera"]["normal"]), truth["laser_plane_camera"]["offset"]
    along = float(normal @ plane.normal)
    for k, direction in enumerate(across(plane.normal), 1):
        errors[f"plane_turn_{k}"] = float(normal @ direction) / along
    errors["plane_offset"] = float(normal @ covariance.plane_pivot_camera + offset) / along
    base = base_from_axis(axis).rotation
    x, y, z = base.apply(truth["rotation_axis_camera"]["direction"])
    relative = base.apply(np.array(truth["rotation_axis_camera"]["point"]) - covariance.axis_pivot_camera)
    errors["axis_turn_x"], errors["axis_turn_y"] = -y / z, x / z
    errors["axis_shift_x"], errors["axis_shift_y"] = relative[:2] - relative[2] * np.array([x, y]) / z
    return errors


def test_the_calibration_is_that_of_the_rig_within_its_uncertainty(finished):
    truth = json.loads(truth_path(finished / "session").read_text())
    found = read_calibration(finished / "session-results" / "calibration.json")
    assert found.turn_sense == truth["turn_sense"]
    assert found.table_seen
    assert "joint" in found.quality
    assert "artifact" not in found.quality
    u = dict(zip(found.covariance.names, np.sqrt(np.diag(found.covariance.matrix)), strict=True))
    errors = _errors(found, truth)
    assert {name: error / u[name] for name, error in errors.items() if abs(error) > 4 * u[name]} == {}


def test_the_measured_sizes_are_those_of_the_parts_within_their_uncertainty(finished):
    results = finished / "session-results"
    entries = _entries(results)
    assert set(entries) == {("stepped", "stepped-cylinder"), ("ball", "sphere"), ("rod", "cylinder")}
    for entry in entries.values():
        u = entry["uncertainty"]
        assert (
            set(u) == set(entry["value"]) == set(entry["uncertainty_scatter"]) == set(entry["uncertainty_calibration"])
        )
        for key, error in entry["error"].items():
            assert error == pytest.approx(entry["value"][key] - entry["reference"][key])
            parts = entry["uncertainty_scatter"][key], entry["uncertainty_calibration"][key]
            assert u[key] == pytest.approx(np.hypot(*parts))
            assert min(parts) > 0
            assert abs(error) < 4 * u[key], (entry["capture"], key)
            assert u[key] < 0.001 * entry["value"][key]
    initial = _entries(results, "measurements-initial-axis.json")
    assert set(initial) == set(entries)
    assert initial["rod", "cylinder"]["value"] != entries["rod", "cylinder"]["value"]


def test_every_point_of_a_cloud_has_its_uncertainty(finished):
    for capture in ("stepped", "ball", "rod"):
        vertices = trimesh.load(finished / "session-results" / "clouds" / f"{capture}.ply", process=False)
        data = vertices.metadata["_ply_raw"]["vertex"]["data"]
        for name in ("u_noise", "u_calibration"):
            assert np.all((data[name] > 0) & (data[name] < 0.5)), (capture, name)


def test_the_verdict_stands_on_the_first_page(finished):
    verdict = json.loads((finished / "session-results" / "verdict.json").read_text())
    assert {s["step"] for s in verdict["steps"]} >= {"camera", "laser-plane", "axis", "artifact", "measure"}
    assert verdict["u_point_mm"] > 0
    report = (finished / "session-results" / "report.html").read_text()
    place = report.index('<section id="verdict"')
    assert report.count("<section", 0, place) == 0
    assert f'class="verdict {verdict["level"]}"' in report


@pytest.fixture(scope="session")
def by_article(finished, tmp_path_factory):
    """Results of the same session by the article's way; not to be changed."""
    results = tmp_path_factory.mktemp("article") / "results"
    shutil.copytree(finished / "session-results", results)
    article = ("--method", "article", "--option", "scan.surface=false")
    assert main(["run", str(finished / "session"), *article, "--out", str(results), "--quiet"]) == 0
    return results


def test_the_article_s_way_makes_the_article_s_stages(by_article):
    found = read_calibration(by_article / "calibration.json")
    assert "joint" not in found.quality
    assert found.covariance is None
    figures = found.quality["artifact"]
    assert figures["method"] == "sqp"
    assert figures["mean_distance_mm"] < figures["mean_distance_before_mm"]
    assert figures["mounts"]["stepped"]["n_frames_used"] == figures["mounts"]["stepped"]["n_frames"]
    assert found.quality["cross_ratio"]["n_intervals"] > 0
    for entry in _entries(by_article).values():
        assert entry["uncertainty_calibration"] == {}
        assert entry["uncertainty"] == entry["uncertainty_scatter"]
        for key, error in entry["error"].items():
            assert abs(error) < 0.002 * entry["reference"][key], (entry["capture"], key)
    report = (by_article / "report.html").read_text()
    assert 'id="verdict"' not in report
    assert "could not be drawn" not in report


@pytest.fixture
def copied(finished, tmp_path):
    """A copy of the finished session and its results."""
    for name in ("session", "session-results"):
        shutil.copytree(finished / name, tmp_path / name)
    return tmp_path


def _stage_files(folder):
    return {p.name: p.stat().st_mtime_ns for p in (folder / "session-results" / "stages").iterdir()}


def test_a_second_run_does_nothing_again(copied, call, without_pictures):
    before = _stage_files(copied)
    outcome = call("run", copied / "session")
    assert outcome.code == 0
    after = _stage_files(copied)
    assert {n: t for n, t in after.items() if n != "report.npz"} == {
        n: t for n, t in before.items() if n != "report.npz"
    }
    assert outcome.err.count("stored result") > 10


def test_a_changed_option_does_only_the_stages_that_depend_on_it_again(copied, call, without_pictures):
    before = _stage_files(copied)
    assert call("run", copied / "session", "--option", "joint.optional_parameters=false").code == 0
    changed = {name.split(".")[0] for name in set(_stage_files(copied)) - set(before)}
    assert "joint" in changed
    assert "measure" in changed
    assert not {n for n in changed if n.startswith(("stripes", "detect", "camera", "laser", "axis"))}


def test_a_run_that_lost_its_last_stages_makes_them_again_with_the_same_result(copied, call, without_pictures):
    results = copied / "session-results"
    before = _entries(results)
    for pattern in ("measure.*", "joint.*", "stripes-ball.*/*"):
        for path in (results / "stages").glob(pattern):
            path.unlink()
    (results / "measurements.json").unlink()
    assert call("run", copied / "session").code == 0
    after = _entries(results)
    # sums of the joint estimate differ in the last digit from one process to another, and a fit stops where another step would lower its cost by
    # less than 1e-14 of it: a step of about 1e-7 of the points' scatter
    for key, entry in before.items():
        assert after[key]["value"] == pytest.approx(entry["value"], rel=1e-12, abs=1e-8)


def test_the_report_is_written_again_without_the_session(copied, call):
    shutil.rmtree(copied / "session")
    report = copied / "session-results" / "report.html"
    first = report.read_text()
    report.unlink()
    assert call("report", copied / "session-results").code == 0
    assert report.read_text() == first


def test_another_session_is_scanned_with_the_calibration_of_this_one(
    finished, copied, tmp_path, call, without_pictures
):
    text = (copied / "session" / "session.toml").read_text()
    calibration = copied / "session-results" / "calibration.json"
    other = tmp_path / "other"
    other.mkdir()
    shutil.copytree(copied / "session" / "ball", other / "ball")
    start = text.index('[[captures]]\nfolder = "ball"')
    scans = [block for block in text[start:].split("\n\n") if '"ball"' in block]
    (other / "session.toml").write_text("version = 1\n\n" + "\n\n".join(scans))
    assert call("run", other, "--calibration", calibration).code == 0
    here, there = (
        _entries(folder)["ball", "sphere"] for folder in (tmp_path / "other-results", finished / "session-results")
    )
    # directions are made unit vectors when they are read, which changes their last digit
    for key in ("value", "uncertainty", "uncertainty_calibration", "line_width_correction"):
        assert here[key]["diameter"] == pytest.approx(there[key]["diameter"], abs=1e-7)
    assert not (tmp_path / "other-results" / "verdict.json").exists(), "it is that of another session"
    assert call("run", other).code == 3


def test_the_commands_on_parts_of_the_job(copied, call):
    session, cloud = copied / "session", copied / "session-results" / "clouds" / "rod.ply"
    outcome = call("calibrate", session, "--json", "--quiet")
    assert outcome.code == 0
    assert json.loads(outcome.out)["turn_sense"] in (1, -1)
    outcome = call("scan", session, "ball", "--json", "--quiet", "--option", "scan.surface=false")
    assert outcome.code == 0
    assert list(json.loads(outcome.out)) == ["ball"]
    outcome = call("measure", cloud, "--feature", "cylinder", "--reference", "diameter=38.004", "--json")
    assert outcome.code == 0
    entry = json.loads(outcome.out)["measurements"][0]
    assert abs(entry["error"]["diameter"]) < 0.08
    outcome = call("measure", session, "--capture", "ball", "--feature", "sphere", "--json", "--quiet")
    assert outcome.code == 0
    assert call("scan", session, "nothing").code == 2
    assert call("measure", cloud).code == 2
    assert call("measure", cloud, "--feature", "sphere", "--region", "z=100:200").code == 3


def test_check_lists_what_is_there(copied, call):
    outcome = call("check", copied / "session", "--json")
    assert outcome.code == 0
    document = json.loads(outcome.out)
    assert document["usable"]
    assert document["problems"] == []
    assert [c["folder"] for c in document["captures"]] == ["camera", "laser", "axis", "stepped", "ball", "rod"]
    assert all(s["possible"] for s in document["stages"])


@pytest.mark.parametrize(
    ("name", "options", "plan"),
    [
        (
            "left-handed, rolled, colour",
            {"turn_sense": -1, "roll_deg": 90.0, "sensor": Sensor(colour=True)},
            {"image_format": "jpg"},
        ),
        (
            "laser on the other side, 16 bit",
            {"camera_side": 1, "sensor": Sensor(bit_depth=16)},
            {"image_format": "tiff", "shuffled": True},
        ),
    ],
)
def test_rigs_of_other_kinds(tmp_path, call, without_pictures, name, options, plan):
    rig = build_rig((320, 240), **options)
    write_session(tmp_path / "s", rig, small_plan(rig, captures=("camera", "laser", "axis", "stepped"), **plan))
    outcome = call("run", tmp_path / "s", "--quiet")
    assert outcome.code == 0, outcome.err
    truth = json.loads(truth_path(tmp_path / "s").read_text())
    found = read_calibration(tmp_path / "s-results" / "calibration.json")
    assert found.turn_sense == truth["turn_sense"]
    entry = _entries(tmp_path / "s-results")["stepped", "stepped-cylinder"]
    for key, error in entry["error"].items():
        assert abs(error) < 0.004 * entry["reference"][key], key
    assert dataclasses.is_dataclass(rig)
