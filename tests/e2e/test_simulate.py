"""``rotaline simulate``: from a rig file to a session that the other commands take."""

import json
import tomllib

import numpy as np
import pytest

import rotaline.simulation.session as session_module
from rotaline.io.rig_file import PRESETS

RIG = """preset = "article"
[camera]
image_size = [160, 120]
pixel_pitch_um = 30.0
[targets.checkerboard]
inner_corners = [8, 6]
pitch_mm = 8.0
[[captures]]
folder = "camera"
role = "camera"
target = "checkerboard"
views = 2
[[captures]]
folder = "ball"
role = "scan"
part = "ball"
frames = 3
[[measurements]]
capture = "ball"
feature = "sphere"
"""


@pytest.fixture
def rig_file(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    return path


@pytest.fixture
def noise(monkeypatch):
    """Noise instead of pictures; the seeds of the frames so far. ``noise.limit``: the frame at which somebody presses Ctrl-C."""

    class Noise:
        seeds: list[tuple[int, ...]] = []  # noqa: RUF012  (a new class in each test)
        limit = 10**9

    def render(rig, parts_base, *, seed, **light):
        if len(Noise.seeds) == Noise.limit:
            raise KeyboardInterrupt
        Noise.seeds.append(seed)
        return np.random.default_rng(seed).integers(0, 255, (120, 160), dtype=np.uint8)

    monkeypatch.setattr(session_module, "render_frame", render)
    monkeypatch.setattr(session_module.os, "cpu_count", lambda: 1)
    return Noise


def test_a_session_is_rendered_and_can_be_checked(call, rig_file, tmp_path):
    rig_file.write_text(RIG.replace("views = 2", "views = 1").replace("frames = 3", "frames = 2"))
    done = call("simulate", rig_file, tmp_path / "s")
    assert done.code == 0, done.err
    assert "Next: rotaline run" in " ".join(done.out.split())
    truth = json.loads((tmp_path / "s.truth.json").read_text())
    assert truth["rig_file"] == rig_file.read_text()
    assert truth["parts"]["ball"][0]["sizes"] == {"diameter": 28.475}
    assert [frame["angle_deg"] for frame in truth["frames"]["ball"]] == [0.0, 180.0]
    assert truth["frames"]["ball"][1]["true_angle_deg"] != 180.0
    assert truth["mechanics"]["run_out_um"] == 1.0
    assert truth["plates"]["camera"]["print_offset_um"] == 1.0
    assert not list((tmp_path / "s").glob("**/*truth*")), "the truth stands beside the session"
    session = tomllib.loads((tmp_path / "s" / "session.toml").read_text())
    assert session["measurements"] == [{"capture": "ball", "feature": "sphere", "reference": {"diameter": 28.475}}]
    checked = call("check", tmp_path / "s")
    assert checked.code in (0, 1)
    assert "160 x 120" in " ".join(checked.out.split())


def test_ctrl_c_keeps_what_is_finished_and_the_same_command_goes_on(call, rig_file, tmp_path, noise):
    noise.limit = 3
    stopped = call("simulate", rig_file, tmp_path / "s")
    assert stopped.code == 130
    assert "start the same command again" in stopped.err
    assert not (tmp_path / "s").exists()
    noise.limit = 10**9
    done = call("simulate", rig_file, tmp_path / "s")
    assert done.code == 0
    assert "3 frames are there already" in done.err
    assert len(noise.seeds) == len(set(noise.seeds)) == 5
    assert sorted(p.name for p in tmp_path.iterdir()) == ["rig.toml", "s", "s.truth.json"]


def test_a_changed_rig_starts_anew_and_says_so(call, rig_file, tmp_path, noise):
    noise.limit = 3
    call("simulate", rig_file, tmp_path / "s")
    noise.seeds.clear()
    noise.limit = 10**9
    rig_file.write_text(RIG + "[turntable]\nangle_noise_deg = 0.1\n")
    done = call("simulate", rig_file, tmp_path / "s")
    assert done.code == 0
    assert "rendered anew" in done.err
    assert len(noise.seeds) == 5


def test_the_seed_of_the_command_line_wins(call, rig_file, tmp_path, noise):
    assert call("simulate", rig_file, tmp_path / "s", "--seed", "7").code == 0
    assert {seed[0] for seed in noise.seeds} == {7}


def test_a_quick_look_has_half_of_everything(call, rig_file, tmp_path, noise):
    assert call("simulate", rig_file, tmp_path / "s", "--quick").code == 0
    truth = json.loads((tmp_path / "s.truth.json").read_text())
    assert truth["camera"]["image_size"] == [80, 60]
    assert truth["quick"] is True
    assert [len(frames) for frames in truth["frames"].values()] == [1, 2]


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_printed_as_it_can_be_read(call, name, tmp_path):
    printed = call("simulate", "--preset", name, "--toml")
    assert printed.code == 0
    assert "camera" in tomllib.loads(printed.out)


@pytest.mark.parametrize(
    ("arguments", "code", "text"),
    [
        (["rig.toml"], 2, "found 1 path"),
        (["--preset", "article"], 2, "found 0 paths and a preset"),
        (["--preset", "table", "out"], 2, "expected one of article"),
        (["--toml"], 2, "--toml prints a preset"),
        (["none.toml", "out"], 2, "the rig file cannot be read"),
        (["rig.toml", "full"], 4, "exists already"),
    ],
)
def test_wrong_use_is_explained(call, rig_file, tmp_path, monkeypatch, arguments, code, text):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "full").mkdir()
    failed = call("simulate", *arguments)
    assert (failed.code, text in failed.err) == (code, True), failed.err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["full", "rig.toml"]


@pytest.mark.parametrize(
    ("old", "new", "text"),
    [
        ("pixel_pitch_um = 30.0", "pixel_pitch_um = -30.0", "rig.toml, line 4, camera.pixel_pitch_um: found -30.0"),
        ("pixel_pitch_um = 30.0", "pixel_pitch_um = 30.0\nlook_at_mm = [400, -160, 180]", "camera"),
        ("[[captures]]", "[laser]\naim_at_mm = [90, 70, 24]\n[[captures]]", "laser"),
        ('part = "ball"', 'part = "bal"', "rig.toml, line 16, captures[2].part: found 'bal'"),
        (
            "pixel_pitch_um = 30.0",
            "look_at_mm = [212, -64, 176]",
            "rig.toml: camera, position_mm and look_at_mm: both are",
        ),
    ],
)
def test_a_bad_rig_is_explained(call, rig_file, tmp_path, noise, old, new, text):
    assert old in RIG
    rig_file.write_text(RIG.replace(old, new, 1))
    failed = call("simulate", rig_file, tmp_path / "s")
    assert failed.code == 2, failed.err
    assert text in failed.err
    assert not noise.seeds
