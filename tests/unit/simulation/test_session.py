"""A rendered session read back with nothing but csv, tomllib and OpenCV."""

import csv
import json
import os
import tomllib
from dataclasses import replace

import cv2
import numpy as np
import pytest

import rotaline.simulation.session as session_module
from rotaline.errors import OutputError
from rotaline.simulation.plan import SessionPlan, demo_plan, small_plan
from rotaline.simulation.rig import Sensor, build_rig
from rotaline.simulation.session import session_toml, truth_path, write_session
from rotaline.vision.targets.model import CharucoBoard


def _rig(**options):
    return build_rig((160, 120), **options)


def _plan(rig, n=2, **options):
    """A plan cut to its first frames."""
    plan = small_plan(rig, **options)
    captures = tuple(type(c)(c.folder, c.role, c.target, c.shots[:n]) for c in plan.captures)
    return SessionPlan(plan.targets, captures, plan.measurements, plan.image_format, plan.seed)


def test_a_session_reads_back_as_the_format_says(tmp_path):
    rig = _rig()
    plan = _plan(rig, captures=("camera", "laser", "axis", "stepped", "ball", "rod", "groove"))
    calls = []
    write_session(tmp_path / "s", rig, plan, lambda: calls.append(1))
    assert len(calls) == plan.n_frames == 14

    with (tmp_path / "s" / "session.toml").open("rb") as stream:
        session = tomllib.load(stream)
    assert session["version"] == 1
    assert session["targets"]["checkerboard"] == {"kind": "checkerboard", "inner_corners": [14, 9], "pitch": 4.5}
    assert session["targets"]["stepped-cylinder"]["diameters"] == [23.051, 36.006]
    roles = {capture["folder"]: capture["role"] for capture in session["captures"]}
    assert roles == {
        "camera": "camera",
        "laser": "laser-plane",
        "axis": "axis",
        "stepped": "artifact",
        "ball": "scan",
        "rod": "scan",
        "groove": "scan",
    }
    assert session["measurements"][0] == {"capture": "ball", "feature": "sphere", "reference": {"diameter": 28.475}}
    for folder in roles:
        with (tmp_path / "s" / folder / "frames.csv").open(newline="") as stream:
            rows = list(csv.DictReader(stream))
        assert list(rows[0]) == ["image", "angle_deg", "laser", "pose"]
        assert len(rows) == 2
        for row in rows:
            image = cv2.imread(str(tmp_path / "s" / folder / row["image"]), cv2.IMREAD_UNCHANGED)
            assert image.shape == (120, 160)
            assert image.max() > 60
            assert (row["angle_deg"] == "") == (folder in ("camera", "laser"))
        if folder == "laser":
            assert [(row["laser"], row["pose"]) for row in rows] == [("off", "0"), ("on", "0")]


def test_the_truth_stands_beside_the_session_and_nothing_else_is_left(tmp_path):
    rig = _rig(turn_sense=-1)
    write_session(tmp_path / "s", rig, _plan(rig, captures=("stepped",)))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["s", "s.truth.json"]
    assert sorted(p.name for p in (tmp_path / "s").iterdir()) == ["session.toml", "stepped"]
    truth = json.loads(truth_path(tmp_path / "s").read_text())
    assert truth["turn_sense"] == -1
    assert truth["camera"]["fx"] == rig.camera.fx
    assert truth["laser_plane_camera"]["offset"] < 0
    np.testing.assert_allclose(truth["rotation_axis_camera"]["direction"], rig.rotation_axis_camera.direction)
    assert truth["parts"]["stepped"][0]["sizes"]["diameter_large"] == 36.006


def test_the_number_of_threads_does_not_matter(tmp_path, monkeypatch):
    rig = _rig()
    plan = _plan(rig, n=3, captures=("laser", "ball"))
    write_session(tmp_path / "a", rig, plan)
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    write_session(tmp_path / "b", rig, plan)
    files = sorted(p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.is_file())
    assert len(files) == 9
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


@pytest.mark.parametrize(
    ("image_format", "colour", "bit_depth"),
    [("jpg", True, 8), ("bmp", False, 8), ("tiff", False, 16), ("png", True, 16)],
)
def test_formats_depths_and_colours(tmp_path, image_format, colour, bit_depth):
    rig = _rig(sensor=Sensor(colour=colour, bit_depth=bit_depth))
    write_session(tmp_path / "s", rig, _plan(rig, captures=("ball",), image_format=image_format))
    image = cv2.imread(str(tmp_path / "s" / "ball" / f"0000.{image_format}"), cv2.IMREAD_UNCHANGED)
    assert image.shape == ((120, 160, 3) if colour else (120, 160))
    assert image.dtype == (np.uint8 if bit_depth == 8 else np.uint16)
    if colour:
        assert image[:, :, 2].max() > 2 * image[:, :, 0].max(), "OpenCV reads blue first; the laser is red"


def test_an_interrupted_call_leaves_nothing(tmp_path):
    rig = _rig()

    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_session(tmp_path / "s", rig, _plan(rig, captures=("ball",)), interrupt)
    assert list(tmp_path.iterdir()) == []


def test_an_interrupted_call_does_not_render_the_rest(tmp_path, monkeypatch):
    rig = _rig()
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    rendered = []
    render = session_module.render_frame
    monkeypatch.setattr(session_module, "render_frame", lambda *a, **k: rendered.append(1) or render(*a, **k))

    def interrupt():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_session(tmp_path / "s", rig, _plan(rig, n=16, captures=("ball",)), interrupt)
    assert len(rendered) < 16


def test_every_frame_has_noise_of_its_own(tmp_path):
    rig = _rig()
    plan = _plan(rig, captures=("ball",))
    (capture,) = plan.captures
    twice = replace(plan, captures=(replace(capture, shots=(capture.shots[0],) * 2),))
    write_session(tmp_path / "s", rig, twice)
    first, second = (cv2.imread(str(tmp_path / "s" / "ball" / f"000{i}.png"), 0) for i in (0, 1))
    assert np.any(first != second)


@pytest.mark.parametrize("turn_sense", [-1, 1])
def test_the_board_on_the_table_faces_the_camera_in_the_middle_of_the_turn(turn_sense):
    rig = _rig(turn_sense=turn_sense)
    (capture,) = small_plan(rig, captures=("axis",)).captures
    angles = [shot.angle_deg for shot in capture.shots]
    (shot,) = [s for s in capture.shots if s.angle_deg == (min(angles) + max(angles)) / 2]
    board = shot.on_table[0].moved(rig.base_from_table(shot.angle_deg))
    front = -board.frame_from_part.rotation.as_matrix()[:, 2]
    towards_camera = np.asarray(rig.camera_from_base.inv().translation)
    assert front @ towards_camera / np.linalg.norm(towards_camera) > 0.97


def test_a_folder_that_exists_is_left_alone(tmp_path):
    (tmp_path / "s").mkdir()
    rig = _rig()
    with pytest.raises(OutputError, match="exists already"):
        write_session(tmp_path / "s", rig, _plan(rig, captures=("ball",)))
    assert list((tmp_path / "s").iterdir()) == []


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    rig = _rig()
    with pytest.raises(OutputError, match="cannot be written"):
        write_session(tmp_path / "file" / "s", rig, _plan(rig, captures=("ball",)))


def test_what_cannot_be_stored_is_refused(tmp_path):
    rig = _rig(sensor=Sensor(bit_depth=16))
    with pytest.raises(ValueError, match="JPEG"):
        write_session(tmp_path / "s", rig, _plan(rig, captures=("ball",), image_format="jpg"))
    with pytest.raises(ValueError, match="image_format"):
        small_plan(rig, image_format="gif")
    with pytest.raises(ValueError, match="Unknown captures"):
        small_plan(rig, captures=("sphere",))


def test_a_charuco_board_is_described_with_its_markers():
    rig = _rig()
    plan = small_plan(rig, captures=("camera",))
    board = CharucoBoard((12, 9), 8.0, 6.0, "DICT_5X5_100")
    text = session_toml(SessionPlan({"checkerboard": board}, plan.captures))
    assert tomllib.loads(text)["targets"]["checkerboard"] == {
        "kind": "charuco",
        "squares": [12, 9],
        "pitch": 8.0,
        "marker": 6.0,
        "dictionary": "DICT_5X5_100",
    }


@pytest.mark.parametrize("camera_side", [-1, 1])
@pytest.mark.parametrize("roll_deg", [0.0, 90.0, 180.0])
def test_boards_of_every_plan_are_wholly_in_view(camera_side, roll_deg):
    rig = build_rig((640, 480), camera_side=camera_side, roll_deg=roll_deg)
    for capture in demo_plan(rig).captures:
        if capture.role not in ("camera", "laser-plane", "axis"):
            continue
        for shot in capture.shots:
            base_from_table = rig.base_from_table(shot.angle_deg or 0.0)
            plates = [*shot.held, *(p.moved(base_from_table) for p in shot.on_table[:1])]
            for plate in plates:
                x0, x1, y0, y1 = plate.shape.extent
                corners = np.array([[x, y, 0.0] for x in (x0, x1) for y in (y0, y1)])
                uv = rig.camera.project((rig.camera_from_base * plate.frame_from_part).apply(corners))
                assert np.all((uv > 0) & (uv < np.array(rig.camera.image_size) - 1)), capture.folder


def test_uneven_angles_in_mixed_order():
    rig = _rig()
    (capture,) = small_plan(rig, captures=("ball",), shuffled=True).captures
    angles = np.array([shot.angle_deg for shot in capture.shots])
    steps = np.diff(np.sort(angles))
    assert np.any(np.diff(angles) < 0)
    assert steps.min() > 0
    assert steps.max() > 1.2 * steps.min()


def test_the_small_cylinder_stands_on_the_large_one_in_every_frame():
    rig = _rig()
    (capture,) = small_plan(rig, captures=("stepped",)).captures
    part = capture.shots[0].on_table[0]
    assert part.shape.sizes()["height_small"] == 22.003
    assert np.hypot(*part.frame_from_part.translation[:2]) == pytest.approx(5.0, abs=0.05)
