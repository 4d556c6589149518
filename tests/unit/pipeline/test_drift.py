"""Reference frames whose stripe moves by known amounts."""

import json
from dataclasses import replace

import numpy as np
import pytest

from rotaline.calibration.model import AngleError, SystemCalibration, SystemCovariance
from rotaline.io.acquired_session import COLUMNS, REFERENCE, FrameRow
from rotaline.io.calibration_file import CalibrationFile
from rotaline.io.session import read_session
from rotaline.pipeline.drift import find_drift
from rotaline.pipeline.observer import Silent
from rotaline.pipeline.options import Options, ScanOptions
from rotaline.pipeline.pack import pack_session
from rotaline.pipeline.run import Run, rewrite_report
from rotaline.pipeline.stages import planned_stages
from rotaline.pipeline.store import StageStore
from rotaline.scanning.triangulation import triangulate
from rotaline.simulation.ideal.stripes import StripeScene, render_stripe
from rotaline.simulation.rig import build_rig
from rotaline.vision.images import encode_png
from rotaline.vision.stripe.extract import StripeOptions, extract_stripe

RIG = build_rig((320, 240))
SYSTEM = SystemCalibration(RIG.camera, RIG.laser_plane_camera, RIG.rotation_axis_camera, RIG.turn_sense, True)
SCENE = StripeScene(image_size=RIG.camera.image_size, angle_deg=82.0)
TOML = 'version = 1\n[[captures]]\nfolder = "part"\nrole = "scan"\n'
WARMING = (0.0, 0.2, 0.32, 0.38)


def _stripe(offset_px, seed):
    return render_stripe(replace(SCENE, offset_px=offset_px), np.random.default_rng(seed))


def _fill(folder, rows, images):
    folder.mkdir(parents=True)
    (folder / "frames.csv").write_text(",".join(COLUMNS) + "\n" + "".join(row.text() for row in rows))
    for row, image in zip(rows, images, strict=True):
        (folder / row.image).write_bytes(encode_png(image))


def _session(path, offsets_px, pose="part", lit=None):
    """A part of which four frames were taken; a reference frame each ten minutes, the stripe beside its place."""
    path.mkdir()
    (path / "session.toml").write_text(TOML)
    _fill(
        path / "part",
        [FrameRow(f"{k}.png", 90.0 * k, True, u_angle_deg=0.01) for k in range(4)],
        [_stripe(0.0, 50 + k) for k in range(4)],
    )
    n = len(offsets_px)
    rows = [
        FrameRow(f"part-{k:04d}.png", 0.0, lit is None or lit[k], pose, time=f"2026-03-01T12:{10 * k:02d}:00.000Z")
        for k in range(n)
    ]
    images = [
        np.full(SCENE.image_size[::-1], 10, np.uint8) if o is None else _stripe(o, k) for k, o in enumerate(offsets_px)
    ]
    _fill(path / REFERENCE, rows, images)
    return path


def _drift(path, tmp_path, system=SYSTEM):
    store = StageStore(tmp_path / "stages", Silent())
    return find_drift(read_session(path), system, StripeOptions(), store, Silent())


def _with_covariance(sheet_mm):
    """The system with nothing but an uncertain place of the laser sheet."""
    covariance = SystemCovariance(
        ("plane_offset",), np.array([[sheet_mm**2]]), np.array([0.0, 0.0, 300.0]), np.zeros(3)
    )
    return replace(SYSTEM, covariance=covariance)


@pytest.fixture(scope="module")
def warming(tmp_path_factory):
    """A rig that gets warm."""
    return _session(tmp_path_factory.mktemp("drift") / "session", WARMING)


def test_known_shifts_come_back(warming, tmp_path):
    (drift,) = _drift(warming, tmp_path)
    assert drift.folder == "part"
    assert [f.minutes for f in drift.frames] == [0.0, 10.0, 20.0, 30.0]
    sense = np.sign(SCENE.normal[0])  # the normal of the scene points to the left
    for frame, offset in zip(drift.frames, WARMING, strict=True):
        assert frame.shift.shift_px == pytest.approx(sense * offset, abs=max(4.0 * frame.shift.u_px, 1e-12))
        assert frame.shift.u_px < 0.01
    assert drift.largest.name == f"{REFERENCE}/part-0003.png"


def test_a_shift_in_the_image_moves_points_as_the_calibration_says(warming, tmp_path):
    (drift,) = _drift(warming, tmp_path)
    points = extract_stripe(_stripe(0.0, 0))
    moved = [
        triangulate(points.uv + s * points.normal, SYSTEM.camera, SYSTEM.laser_plane_camera) for s in (-0.01, 0.01)
    ]
    expected = np.nanmedian(np.linalg.norm(moved[1] - moved[0], axis=1)) / 0.02
    assert drift.mm_per_px == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(("sheet_mm", "matters"), [(1e-3, True), (1.0, False)])
def test_a_drift_is_told_where_it_is_more_than_points_are_uncertain_by(warming, tmp_path, sheet_mm, matters):
    (drift,) = _drift(warming, tmp_path, _with_covariance(sheet_mm))
    assert bool(drift.warnings) == matters
    assert (drift.limit_mm < 0.38 * drift.mm_per_px) == matters
    if matters:
        (text,) = drift.warnings
        for word in ("part:", "um at the part", "30 min", "warm_up_s", "reference_every"):
            assert word in text


def test_a_rig_that_stands_still_is_no_drift(tmp_path):
    (drift,) = _drift(_session(tmp_path / "still", (0.0,) * 6), tmp_path, _with_covariance(1e-6))
    assert drift.warnings == ()
    assert abs(drift.largest.shift.shift_px) < 4.0 * drift.largest.shift.u_px


def test_without_a_calibration_pixels_are_told(warming, tmp_path):
    (drift,) = _drift(warming, tmp_path, None)
    assert np.isnan([drift.mm_per_px, drift.limit_mm]).all()
    assert 0.0 < drift.limit_px < 0.2
    (text,) = drift.warnings
    assert "moved by 0.3" in text
    assert "um" not in text.split("The rig")[0]


def test_frames_that_cannot_be_compared_say_why(tmp_path):
    path = _session(tmp_path / "s", (0.0, None, 0.0, 0.0), lit=(True, True, False, True))
    (drift,) = _drift(path, tmp_path)
    assert [f.reason for f in drift.frames] == ["", "no stripe", "laser off", ""]
    assert len(drift.compared) == 2
    (text,) = drift.warnings
    assert "1 of 4 reference frames" in text


def test_a_stripe_that_never_shows_and_one_that_was_never_lit(tmp_path):
    (dark,) = _drift(_session(tmp_path / "dark", (None, None)), tmp_path)
    assert "no stripe in any of its 2 reference frames" in dark.warnings[0]
    assert dark.largest is None
    (off,) = _drift(_session(tmp_path / "off", (None, None), pose="other", lit=(False, False)), tmp_path)
    assert (off.folder, off.warnings) == ("other", ())


def test_a_packed_session_drifts_alike(warming, tmp_path):
    packed = pack_session(warming, tmp_path / "p.rotaline.zarr", Silent()).folder
    assert _drift(packed, tmp_path / "a") == _drift(warming, tmp_path / "b")


def test_the_stage_is_planned_where_there_are_reference_frames(warming):
    session = read_session(warming)
    assert {s.name: s.text for s in planned_stages(session)}["drift"] == "4 reference frames of 1 capture"
    assert "drift" not in {s.name for s in planned_stages(replace(session, references=()))}


def test_a_run_finds_them_where_they_are(warming, tmp_path):
    calibration = CalibrationFile(
        camera=SYSTEM.camera,
        laser_plane_camera=SYSTEM.laser_plane_camera,
        rotation_axis_camera=SYSTEM.rotation_axis_camera,
        rotation_axis_initial_camera=None,
        turn_sense=1,
        table_seen=True,
        quality={},
        session="other",
        angle_error=AngleError(),
    )
    out = tmp_path / "results"
    options = Options(scan=ScanOptions(surface=False))
    with Run(read_session(warming), out, options, Silent()) as run:
        result = run.everything(calibration)
    assert [w.stage for w in result.warnings if "has moved" in w.text] == ["drift"]
    content = json.loads((out / "drift.json").read_text())
    (capture,) = content["captures"]
    assert [f["minutes"] for f in capture["frames"]] == [0.0, 10.0, 20.0, 30.0]
    last = capture["frames"][-1]
    assert abs(last["shift_px"]) == pytest.approx(0.38, abs=4.0 * last["u_shift_px"])
    assert last["shift_mm"] == pytest.approx(last["shift_px"] * capture["mm_per_px"])
    page = (out / "report.html").read_text()
    assert 'id="drift"' in page
    assert "could not be drawn" not in page
    (out / "report.html").unlink()
    assert 'id="drift"' in rewrite_report(out).read_text()

    bare = replace(read_session(warming), references=())
    with Run(bare, out, options, Silent()) as run:
        run.everything(calibration)
    assert not (out / "drift.json").exists()
    assert 'id="drift"' not in (out / "report.html").read_text()
