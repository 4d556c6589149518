"""``rotaline rig check`` on the simulated rig: what it prints, what it writes, how it ends; as it should be, and with faults."""

import json
from dataclasses import replace

import pytest
from PIL import Image

import rotaline.pipeline.devices as devices_module
from rotaline.cli.app import main
from rotaline.hardware.simulated.faults import Faults
from rotaline.hardware.simulated.world import SimulatedWorld
from rotaline.simulation.rig import build_rig
from rotaline.simulation.session import write_session
from rotaline.simulation.small_session import small_plan

SMALL = """preset = "article"
[camera]
image_size = [160, 120]
pixel_pitch_um = 30.0
[targets.checkerboard]
inner_corners = [8, 6]
pitch_mm = 8.0
[[captures]]
folder = "axis"
role = "axis"
target = "checkerboard"
frames = 3
[[captures]]
folder = "ball"
role = "scan"
part = "ball"
frames = 3
[[measurements]]
capture = "ball"
feature = "sphere"
"""
CAMERA = """version = 1
[simulated]
rig = "small.toml"
[camera]
driver = "simulated"
"""
TABLE = '[turntable]\ndriver = "simulated"\n'
LASER = '[laser]\ndriver = "simulated"\n'


@pytest.fixture
def worlds(monkeypatch):
    """The worlds that were made; ``faults`` are planted in the next one."""
    made = []

    def plant(**faults):
        def make(*args):
            made.append(SimulatedWorld(*args, faults=Faults(**faults)))
            return made[-1]

        monkeypatch.setattr(devices_module, "SimulatedWorld", make)
        return made

    return plant


@pytest.fixture
def write(tmp_path):
    def write(*tables):
        (tmp_path / "small.toml").write_text(SMALL)
        path = tmp_path / "rig.toml"
        path.write_text("".join([CAMERA, *tables]))
        return path

    return write


def document(path):
    return json.loads((path.with_name("rig-check") / "check.json").read_text())


def levels(checked):
    return {(x["device"], x["check"]): x["level"] for x in checked["lines"]}


def test_a_whole_rig_is_checked(write, worlds, call):
    made = worlds()
    path = write(TABLE, LASER)
    done = call("rig", "check", path)
    checked = document(path)
    found = levels(checked)
    assert set(found.values()) == {"ok"}, checked
    assert done.code == 0
    for line in (("laser", "stripe"), ("turntable", "return"), ("turntable", "turning"), ("camera", "stream")):
        assert line in found
        assert f"{line[0]}, {line[1]}" in done.out
    assert "Nobody looks into its beam" in " ".join(done.out.split())
    assert checked["devices"] == {
        "camera": "simulated camera",
        "turntable": "simulated turntable",
        "laser": "simulated laser",
    }
    assert "settle_s" in checked["recommended"]
    assert not made[0].shines()
    assert made[0].table_stands()
    with Image.open(path.with_name("rig-check") / "check.png") as picture:
        assert picture.size[0] > 1000


def test_a_laser_that_does_not_switch_and_a_table_that_is_stuck_are_device_errors(write, worlds, call):
    made = worlds(laser_dark_at_switchings=frozenset({1}), stalled_moves=frozenset({2}))
    path = write(TABLE, LASER)
    done = call("rig", "check", path)
    assert done.code == 5
    found = {(x["device"], x["level"]): x["found"] for x in document(path)["lines"]}
    assert "still dark" in found["laser", "fails"]
    assert "has not reached" in found["turntable", "fails"]
    assert not made[0].shines()
    assert made[0].table_stands()


def test_lost_frames_are_counted_and_a_rig_may_be_a_camera_alone(write, worlds, call, tmp_path):
    worlds(lost_frames=frozenset({2, 5}))
    path = write()
    done = call("rig", "check", path, "--json", "--out", tmp_path / "here")
    checked = json.loads(done.out)
    assert done.code == 1
    assert levels(checked)["camera", "lost frames"] == "doubtful"
    (lost,) = [x for x in checked["lines"] if x["check"] == "lost frames"]
    assert lost["values"]["lost"] == 2
    assert len(checked["left_out"]) == 2
    assert json.loads((tmp_path / "here" / "check.json").read_text())["lines"] == checked["lines"]
    assert (tmp_path / "here" / "check.png").is_file()


def test_what_cannot_be_opened_is_said(write, tmp_path, call):
    path = write()
    path.write_text('version = 1\n[camera]\ndriver = "uvc"\ndevice = "/dev/video-none"\n')
    assert call("rig", "check", path).code == 5
    assert call("rig", "check", tmp_path / "absent.toml").code == 2
    assert not path.with_name("rig-check").exists()


def test_a_place_that_cannot_be_used_is_said_before_anything_is_checked(write, worlds, call, tmp_path):
    made = worlds()
    (tmp_path / "taken").touch()
    done = call("rig", "check", write(), "--out", tmp_path / "taken")
    assert done.code == 4
    assert "taken: cannot be written (File exists)" in done.err
    assert made[0].counts["frames"] == 0


def test_a_recorded_session_is_no_rig(tmp_path, call):
    rig = build_rig((64, 48))
    plan = small_plan(rig, captures=("ball",))
    (capture,) = plan.captures
    write_session(
        tmp_path / "taken", rig, replace(plan, captures=(replace(capture, shots=capture.shots[:1]),)), threads=1
    )
    path = tmp_path / "rig.toml"
    path.write_text('version = 1\n[camera]\ndriver = "replay"\n[replay]\nsession = "taken"\n')
    done = call("rig", "check", path)
    assert done.code == 2
    assert "no rig" in done.err


def test_an_interruption_leaves_the_laser_off(write, worlds, capsys, monkeypatch):
    made = worlds()
    path = write(LASER)
    seen = []

    def interrupted(self, *args, **options):
        seen.append(self.shines())
        if seen[-1]:
            raise KeyboardInterrupt
        return expose(self, *args, **options)

    expose = SimulatedWorld.expose
    monkeypatch.setattr(SimulatedWorld, "expose", interrupted)
    assert main(["rig", "check", str(path)]) == 130
    assert seen[-1]
    assert not made[0].shines()
