"""A rendered session read back with nothing but csv, tomllib and OpenCV."""

import csv
import json
import tomllib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import rotaline.simulation.session as session_module
from rotaline.errors import OutputError
from rotaline.simulation.plan import SessionPlan
from rotaline.simulation.rig import Mechanics, Sensor, build_rig
from rotaline.simulation.session import Unfinished, session_toml, unfinished, write_session
from rotaline.simulation.small_session import small_plan
from rotaline.simulation.truth import fingerprint, true_poses, truth, truth_path
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
    write_session(tmp_path / "s", rig, _plan(rig, captures=("stepped",)), notes={"origin": "a test"})
    assert sorted(p.name for p in tmp_path.iterdir()) == ["s", "s.truth.json"]
    assert sorted(p.name for p in (tmp_path / "s").iterdir()) == ["session.toml", "stepped"]
    content = json.loads(truth_path(tmp_path / "s").read_text())
    assert content["turn_sense"] == -1
    assert content["camera"]["fx"] == rig.camera.fx
    assert content["laser_plane_camera"]["offset"] < 0
    np.testing.assert_allclose(content["rotation_axis_camera"]["direction"], rig.rotation_axis_camera.direction)
    assert content["parts"]["stepped"][0]["sizes"]["diameter_large"] == 36.006
    assert content["sensor"]["full_well_e"] == rig.sensor.full_well_e
    assert content["origin"] == "a test"


def _files(folder):
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def _shaky(rig):
    """The rig with errors of the turntable."""
    return replace(rig, mechanics=Mechanics(angle_noise_deg=0.1, run_out_um=50.0, run_out_noise_um=5.0))


def test_the_number_of_threads_does_not_matter(tmp_path):
    rig = _shaky(_rig())
    plan = _plan(rig, n=3, captures=("laser", "ball"))
    write_session(tmp_path / "a", rig, plan, threads=1)
    write_session(tmp_path / "b", rig, plan, threads=3)
    assert len(_files(tmp_path / "a")) == 9
    assert _files(tmp_path / "a") == _files(tmp_path / "b")
    assert truth_path(tmp_path / "a").read_bytes() == truth_path(tmp_path / "b").read_bytes()


def test_another_seed_gives_other_noise_and_other_errors(tmp_path):
    rig = _shaky(_rig())
    plan = _plan(rig, captures=("ball",))
    other = replace(plan, seed=7)
    write_session(tmp_path / "a", rig, plan)
    write_session(tmp_path / "b", rig, other)
    assert _files(tmp_path / "a")["ball/0000.png"] != _files(tmp_path / "b")["ball/0000.png"]
    angles = [truth(rig, p)["frames"]["ball"][0]["true_angle_deg"] for p in (plan, other)]
    assert angles[0] != angles[1]


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


def _interrupt_after(n):
    calls = []

    def progress():
        calls.append(1)
        if len(calls) == n:
            raise KeyboardInterrupt

    return progress


@pytest.fixture
def rendered(monkeypatch):
    """Noise instead of pictures, as fast as it is drawn; the seeds of the frames so far."""
    seeds = []

    def render(rig, parts_base, *, seed, **light):
        seeds.append(seed)
        return np.random.default_rng(seed).integers(0, 255, (12, 16), dtype=np.uint8)

    monkeypatch.setattr(session_module, "render_frame", render)
    return seeds


def _interrupted(path, rig, plan, n=2):
    with pytest.raises(KeyboardInterrupt):
        write_session(path, rig, plan, _interrupt_after(n), threads=1)


def test_an_interrupted_call_stops_and_the_next_one_goes_on(tmp_path, rendered):
    rig = _rig()
    plan = _plan(rig, n=8, captures=("ball", "rod"))
    _interrupted(tmp_path / "s", rig, plan)
    assert [p.name for p in tmp_path.iterdir()] == ["s.partial"]
    n_kept = len(rendered)
    assert 2 <= n_kept < 16
    assert unfinished(tmp_path / "s", rig, plan) == Unfinished(n_kept, True)

    count = []
    write_session(tmp_path / "s", rig, plan, lambda: count.append(1))
    assert len(rendered) == len(count) == 16, "no frame is rendered twice, all are counted"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["s", "s.truth.json"]
    write_session(tmp_path / "t", rig, plan)
    assert _files(tmp_path / "s") == _files(tmp_path / "t")


def test_another_rig_starts_anew(tmp_path, rendered):
    rig = _rig()
    plan = _plan(rig, n=4, captures=("ball",))
    _interrupted(tmp_path / "s", rig, plan)
    other = replace(rig, sensor=replace(rig.sensor, read_noise_e=300.0))
    assert not unfinished(tmp_path / "s", other, plan).same
    rendered.clear()
    write_session(tmp_path / "s", other, plan)
    assert len(rendered) == 4


def test_an_image_that_was_cut_off_is_written_again(tmp_path, monkeypatch, rendered):
    rig = _rig()
    plan = _plan(rig, captures=("ball",))
    write = Path.write_bytes

    def fail(path, data):
        write(path, data[:100])
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as context:
        context.setattr(Path, "write_bytes", fail)
        with pytest.raises(OutputError, match=r"No space.*start the same command again"):
            write_session(tmp_path / "s", rig, plan)
    assert unfinished(tmp_path / "s", rig, plan) == Unfinished(0, True)
    write_session(tmp_path / "s", rig, plan)
    assert sorted(p.name for p in (tmp_path / "s" / "ball").iterdir()) == ["0000.png", "0001.png", "frames.csv"]
    assert cv2.imread(str(tmp_path / "s" / "ball" / "0000.png"), 0).shape == (12, 16)


def test_a_folder_of_someone_else_in_the_place_of_the_partial_one_is_left_alone(tmp_path):
    rig = _rig()
    (tmp_path / "s.partial").mkdir()
    (tmp_path / "s.partial" / "letter.txt").write_text("mine")
    with pytest.raises(OutputError, match="no unfinished session"):
        write_session(tmp_path / "s", rig, _plan(rig, captures=("ball",)))
    assert (tmp_path / "s.partial" / "letter.txt").read_text() == "mine"


def test_the_truth_says_where_the_table_was_in_each_frame():
    rig = _shaky(_rig(turn_sense=-1))
    frames = truth(rig, _plan(rig, n=16, captures=("ball",)))["frames"]["ball"]
    errors = np.array([f["true_angle_deg"] - f["angle_deg"] for f in frames])
    assert 0.03 < errors.std() < 0.3
    run_out = np.array([f["run_out_um"][0] for f in frames])
    expected = 50 * np.cos(np.radians([f["angle_deg"] for f in frames]))
    assert np.abs(run_out - expected).max() < 25
    pose = np.array(frames[3]["base_from_table"])
    turned = np.degrees(np.arctan2(pose[1, 0], pose[0, 0])) % 360
    assert turned == pytest.approx(-frames[3]["true_angle_deg"] % 360, abs=1e-9)


def test_frames_at_one_stop_of_the_table_share_its_pose():
    rig = _shaky(_rig())
    (capture,) = _plan(rig, captures=("ball",)).captures
    pairs = replace(capture, shots=(capture.shots[0], capture.shots[0], capture.shots[1]))
    poses = true_poses(rig, SessionPlan({}, (pairs,)))["ball"]
    assert np.array_equal(poses[0].as_matrix(), poses[1].as_matrix())
    assert not np.array_equal(poses[0].as_matrix(), poses[2].as_matrix())


def test_every_change_of_rig_or_plan_changes_the_fingerprint():
    rig = _rig()
    plan = _plan(rig, captures=("ball",))
    (capture,) = plan.captures
    part = capture.shots[0].on_table[0]
    bigger = replace(part, shape=replace(part.shape, diameter=28.4751))
    shots = (replace(capture.shots[0], on_table=(bigger, capture.shots[0].on_table[1])), capture.shots[1])
    variants = [
        (rig, plan),
        (replace(rig, optics=replace(rig.optics, blur_px=0.81)), plan),
        (replace(rig, laser=replace(rig.laser, bow_mm=0.001)), plan),
        (rig, replace(plan, seed=2)),
        (rig, replace(plan, image_format="bmp")),
        (rig, replace(plan, captures=(replace(capture, shots=shots),))),
    ]
    assert len({fingerprint(*variant) for variant in variants}) == len(variants)
    assert fingerprint(_rig(), _plan(_rig(), captures=("ball",))) == fingerprint(rig, plan)


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
    text = session_toml(SessionPlan({"checkerboard": board}, plan.captures), rig)
    assert tomllib.loads(text)["targets"]["checkerboard"] == {
        "kind": "charuco",
        "squares": [12, 9],
        "pitch": 8.0,
        "marker": 6.0,
        "dictionary": "DICT_5X5_100",
    }


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
