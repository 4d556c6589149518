"""``rotaline acquire``: the session that ``rotaline simulate`` renders, taken with devices; how it ends; every bad input."""

import contextlib
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.e2e.conftest import Outcome
from tests.unit.pipeline.small_acquisition import content, rendered

from rotaline.cli.acquire import ending_in_order
from rotaline.cli.app import main
from rotaline.errors import DeviceConnectionError
from rotaline.hardware.cameras.simulated import SimulatedCamera
from rotaline.hardware.clock import VirtualClock
from rotaline.hardware.simulated import world as world_module
from rotaline.hardware.simulated.world import SimulatedWorld
from rotaline.io.acquired_session import AcquiredSession
from rotaline.io.frame_images import read_source
from rotaline.io.plan_file import plan_text, read_plan
from rotaline.io.session import read_session

ROOT = Path(__file__).resolve().parents[2]

RIG = """preset = "article"
[camera]
image_size = [320, 240]
pixel_pitch_um = 15.0
blur_px = 0.4
principal_point_offset_px = [-1.5, 1.0]
[light]
exposure_off_ms = 8.0
exposure_on_ms = 12.0
[[captures]]
folder = "camera"
role = "camera"
target = "checkerboard"
views = 6
[[captures]]
folder = "laser"
role = "laser-plane"
target = "dots"
views = 4
[[captures]]
folder = "axis"
role = "axis"
target = "checkerboard"
to_deg = 32.0
step_deg = 8.0
[[captures]]
folder = "stepped"
role = "artifact"
part = "stepped-cylinder"
frames = 8
mount = { position_mm = [4.0, 3.0], turn_deg = 110.0 }
[[captures]]
folder = "ball"
role = "scan"
part = "ball"
frames = 6
laser_off_frames = true
[[measurements]]
capture = "ball"
feature = "sphere"
reference = { diameter_mm = 28.475 }
"""
DEVICES = """version = 1
[simulated]
rig = "world.toml"
seed = 3
[camera]
driver = "simulated"
[turntable]
driver = "simulated"
[laser]
driver = "simulated"
"""
PLAN = """version = 1
[optics]
f_number = 5.6
pixel_pitch_um = 15.0
wavelength_nm = 650.0
speckle_contrast = CONTRAST
[targets.checkerboard]
kind = "checkerboard"
inner_corners = [18, 16]
pitch = 4.0
[targets.dots]
kind = "dots"
dots = [9, 9]
pitch = 6.0
diameter = 3.0
[targets.stepped-cylinder]
kind = "stepped-cylinder"
diameters = [23.051, 36.006]
heights = [22.003, 25.005]
[[captures]]
folder = "camera"
role = "camera"
target = "checkerboard"
poses = 6
exposure_off_us = 8000.0
[[captures]]
folder = "laser"
role = "laser-plane"
target = "dots"
poses = 4
exposure_off_us = 8000.0
exposure_on_us = 12000.0
[[captures]]
folder = "axis"
role = "axis"
target = "checkerboard"
to_deg = 32.0
step_deg = 8.0
exposure_off_us = 8000.0
[[captures]]
folder = "stepped"
role = "artifact"
target = "stepped-cylinder"
frames = 8
exposure_on_us = 12000.0
[[captures]]
folder = "ball"
role = "scan"
target = "ball"
frames = 6
laser_off_frames = true
exposure_off_us = 8000.0
exposure_on_us = 12000.0
[[measurements]]
capture = "ball"
feature = "sphere"
[measurements.reference]
diameter = 28.475
"""
N_FRAMES = 6 + 8 + 5 + 8 + 12


@pytest.fixture
def place(tmp_path):
    """A folder with the files of rig, devices and plan."""
    (tmp_path / "world.toml").write_text(RIG)
    (tmp_path / "rig.toml").write_text(DEVICES)
    (tmp_path / "plan.toml").write_text(PLAN.replace("CONTRAST", "0.2"))
    return tmp_path


@pytest.fixture
def take(capsys, place):
    """Run ``rotaline acquire`` in this process; unlike other commands, it writes into the session."""

    def run(out="taken"):
        capsys.readouterr()
        code = main([str(a) for a in ("acquire", place / "rig.toml", place / "plan.toml", place / out)])
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err + captured.out
        return Outcome(code, captured.out, " ".join(captured.err.split()))

    return run


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(world_module, "render_exposure", rendered)


@pytest.fixture
def worlds(monkeypatch):
    """The worlds that were made, to ask how they were left."""
    made = []
    init = SimulatedWorld.__init__

    def kept(self, *args):
        init(self, *args)
        made.append(self)

    monkeypatch.setattr(SimulatedWorld, "__init__", kept)
    return made


def four_columns(table):
    return [line.split(",")[:4] for line in table.read_text().splitlines()]


def test_what_is_taken_is_what_is_rendered_and_both_give_the_same_results(call, place, take, monkeypatch):
    """Bit for bit the frames and the first four columns; the same calibration, the same sizes."""
    assert call("simulate", place / "world.toml", place / "made", "--seed", "3", "--quiet").code == 0
    contrast = next(
        line.split(" = ")[1] for line in (place / "made/session.toml").read_text().splitlines() if "contrast" in line
    )
    (place / "plan.toml").write_text(PLAN.replace("CONTRAST", contrast))
    done = take()
    assert done.code == 0, done.err
    assert f"{N_FRAMES} frames" in done.err
    assert f"rotaline run {place / 'taken'}" in done.out.replace("\n", "")
    for folder in ("camera", "laser", "axis", "stepped", "ball"):
        made, taken = place / "made" / folder, place / "taken" / folder
        assert four_columns(taken / "frames.csv") == four_columns(made / "frames.csv")
        images = sorted(path.name for path in made.glob("*.png"))
        assert sorted(path.name for path in taken.glob("*.png")) == images
        assert all((taken / name).read_bytes() == (made / name).read_bytes() for name in images)
    results = []
    monkeypatch.setattr(
        "rotaline.io.report.write.render_report", lambda *_, **__: ""
    )  # half of the time, and of no interest here
    for session in ("made", "taken"):
        assert call("run", place / session, "--quiet", "--out", place / f"{session}-results").code == 0
        found = place / f"{session}-results"
        calibration = json.loads((found / "calibration.json").read_text())
        calibration.pop("session", None)
        results.append((calibration, json.loads((found / "measurements.json").read_text())))
    assert _without_paths(results[0]) == _without_paths(results[1])


def _without_paths(value):
    return json.loads(json.dumps(value).replace("taken", "made"))


def test_automatic_exposures_are_sensible(place, take):
    """The stripe's core is bright and not saturated; the target is as bright as white may be."""
    plan = PLAN.replace("CONTRAST", "0.2")
    for text in ("exposure_off_us = 8000.0\n", "exposure_on_us = 12000.0\n"):
        plan = plan.replace(text, "")
    captures = plan.split("[[captures]]")
    keep = [captures[0], captures[1].replace("poses = 6", "poses = 1"), captures[4].replace("frames = 8", "frames = 4")]
    (place / "plan.toml").write_text("[[captures]]".join(keep))
    assert take().code == 0
    camera, stepped = read_session(place / "taken").captures
    white = np.quantile(_image(camera, 0), 0.99)
    assert 0.7 < white / 255 < 0.9
    for i in range(4):
        image = _image(stepped, i)
        core = image.max(axis=1)[image.max(axis=1) > 60]
        assert 0.55 < np.quantile(core, 0.95) / 255 <= 0.95
        assert np.mean(core >= 254) <= 0.05


def _image(capture, index):
    return read_source(capture.frames[index].source)


# how it ends


def _raises_at(monkeypatch, at, error):
    take, n = SimulatedCamera.take, []

    def failing(self, timeout_s):
        n.append(None)
        if len(n) == at:
            raise error
        return take(self, timeout_s)

    monkeypatch.setattr(SimulatedCamera, "take", failing)


def test_ctrl_c_keeps_what_was_taken_and_the_same_command_goes_on(place, quick, worlds, take):
    assert take("whole").code == 0
    with pytest.MonkeyPatch.context() as patch:
        _raises_at(patch, 17, KeyboardInterrupt())
        ended = take()
    assert ended.code == 130
    assert "interrupted. What was finished is kept; start the same command again to go on." in ended.err
    again = take()
    assert again.code == 0
    assert f"16 of {N_FRAMES} frames are there already; it goes on with the first that is missing." in again.err
    assert "16 of them by an earlier start" in again.err
    assert content(place / "taken") == content(place / "whole")
    assert all(not world.shines() and world.table_stands() for world in worlds)
    assert len(worlds) == 3


def test_another_plan_for_the_same_session_is_refused_with_what_differs(place, quick, take):
    with pytest.MonkeyPatch.context() as patch:
        _raises_at(patch, 3, KeyboardInterrupt())
        assert take().code == 130
    text = (place / "plan.toml").read_text()
    (place / "plan.toml").write_text(text.replace("poses = 6", "poses = 5"))
    ended = take()
    assert ended.code == 2
    assert "poses: 6 then, 5 now" in ended.err
    (place / "plan.toml").write_text("# begun on Monday\n" + text)
    assert take().code == 0


def test_a_defect_of_a_driver_leaves_the_rig_dark(place, quick, worlds, monkeypatch, take):
    _raises_at(monkeypatch, 17, ZeroDivisionError("division by zero"))
    assert take().err.count("This is a defect of the program") == 1
    assert not worlds[0].shines()
    assert worlds[0].table_stands()


def test_a_device_error_has_exit_code_5_and_a_full_disk_4(place, quick, take):
    with pytest.MonkeyPatch.context() as patch:
        _raises_at(patch, 3, DeviceConnectionError("simulated camera: it is gone. Plug it in, and open it again."))
        ended = take()
    assert (ended.code, "it is gone. Plug it in" in ended.err) == (5, True)
    with pytest.MonkeyPatch.context() as patch:

        def full(*_):
            raise OSError(28, "No space left on device")

        patch.setattr(AcquiredSession, "_add", staticmethod(full))
        ended = take()
    assert ended.code == 4
    assert "No space left on device" in ended.err
    assert "start the same command again: it goes on with the first missing frame" in ended.err


@pytest.mark.skipif(os.name != "posix", reason="needs the signals of POSIX")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGINT"])
def test_signals_end_it_in_order(place, quick, worlds, monkeypatch, name, take, request):
    """The signal comes while the table turns with the laser on."""
    wait, sent = VirtualClock.wait, []
    usual = {"SIGINT": signal.default_int_handler}.get(name, signal.SIG_DFL)
    started_with = signal.signal(
        getattr(signal, name), usual
    )  # a program in the background may be started to ignore it
    request.addfinalizer(lambda: signal.signal(getattr(signal, name), started_with))

    def signalled(self, seconds):
        if worlds and worlds[0].shines() and not worlds[0].table_stands() and not sent:
            sent.append(name)
            os.kill(os.getpid(), getattr(signal, name))
        wait(self, seconds)

    monkeypatch.setattr(VirtualClock, "wait", signalled)
    before = signal.getsignal(signal.SIGTERM)
    assert take().code == 130
    assert sent == [name]
    assert not worlds[0].shines()
    assert worlds[0].table_stands()
    assert signal.getsignal(signal.SIGTERM) is before
    read_session(place / "taken")


@pytest.mark.skipif(os.name != "posix", reason="needs the signals of POSIX")
def test_a_terminal_that_is_closed_does_not_end_what_was_started_to_ignore_it(request):
    started_with = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    request.addfinalizer(lambda: signal.signal(signal.SIGHUP, started_with))
    with ending_in_order():
        os.kill(os.getpid(), signal.SIGHUP)
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN


# what is wrong is said


@pytest.mark.parametrize(
    ("given", "code", "said"),
    [
        (["acquire"], 2, "expected `rotaline acquire RIG.toml PLAN.toml OUT`"),
        (["acquire", "rig.toml", "out"], 2, "found 2 paths"),
        (["acquire", "--plan", "article", "rig.toml", "plan.toml", "out"], 2, "found 3 paths and a plan"),
        (["acquire", "--plan", "artikel", "rig.toml", "out"], 2, "artikel: the plan cannot be read"),
        (["acquire", "none.toml", "plan.toml", "out"], 2, "none.toml: the rig file cannot be read"),
        (["acquire", "world.toml", "plan.toml", "out"], 2, "this describes a rig to be simulated, not devices"),
        (
            ["acquire", "rig.toml", "rig.toml", "out"],
            2,
            "this names devices, or a rig to be simulated; expected a plan",
        ),
        (["rig", "chek", "rig.toml"], 2, "No such command 'chek'. Did you mean 'check'? See `rotaline --help`."),
        (["rig"], 2, "Usage: "),
        (["acquire", "--toml"], 2, "`rotaline acquire --plan article --toml`"),
        (["acquire", "rig.toml", "plan.toml", "."], 2, "exists already, and is no session that an acquisition began"),
        (["acquire", "rig.toml", "plan.toml", "rig.toml"], 2, "exists already, and is no session"),
    ],
)
def test_wrong_use(call, place, monkeypatch, given, code, said):
    monkeypatch.chdir(place)
    ended = call(*given)
    assert ended.code == code
    assert said in ended.err
    assert not (place / "out").exists()


def test_a_plan_and_a_rig_file_with_mistakes(place, take):
    (place / "plan.toml").write_text(PLAN.replace("CONTRAST", "0.2").replace("poses = 6", "pose = 6"))
    ended = take()
    assert ended.code == 2
    assert "plan.toml, line 24, captures[1].pose: there is no such key; expected one of folder, role" in ended.err
    (place / "rig.toml").write_text(DEVICES.replace('"simulated"\n[turntable]', '"gencam"\n[turntable]'))
    ended = take()
    assert ended.code == 2
    assert "rig.toml, line 6, camera.driver: found 'gencam', expected one of genicam, gentl" in ended.err
    assert not (place / "taken").exists()


def test_a_simulated_rig_that_is_not_there_is_named_with_the_line_of_the_file(place, take):
    (place / "rig.toml").write_text(DEVICES.replace('"world.toml"', '"dmo"'))
    ended = take()
    assert ended.code == 2
    assert "simulated.rig: found 'dmo', expected one of article, " in ended.err
    assert ended.err.startswith(f"rotaline: {place / 'rig.toml'}, line ")
    assert not (place / "taken").exists()


def test_another_process_on_the_same_folder_is_refused(place, quick, take):
    """Really another process: it begins a session and then only waits until its input ends."""
    hold = (
        "import sys; from pathlib import Path; from rotaline.io.acquired_session import AcquiredSession; "
        "s = AcquiredSession(Path(sys.argv[1]), Path(sys.argv[2]).read_text(), 'rig'); print('held', flush=True); sys.stdin.read()"
    )
    held = [sys.executable, "-c", hold, str(place / "taken"), str(place / "plan.toml")]
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    with subprocess.Popen(held, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment) as other:
        assert other.stdout.readline().strip() == b"held"
        ended = take()
        with contextlib.suppress(BrokenPipeError):
            other.stdin.close()
        other.wait()
    assert ended.code == 4
    assert "another `rotaline acquire` writes this session. Wait until it has ended" in ended.err
    assert take().code == 0


def test_the_plan_of_the_article_is_printed_as_a_file(call, tmp_path):
    printed = call("acquire", "--plan", "article", "--toml")
    assert printed.code == 0
    assert printed.out == plan_text("article")
    (tmp_path / "plan.toml").write_text(printed.out)
    plan = read_plan(str(tmp_path / "plan.toml"))
    assert [c.folder for c in plan.tables.captures] == [
        *("camera", "laser", "axis", "stepped-1", "stepped-2", "ball", "rod", "groove")
    ]
    assert call("acquire", "--plan", "other", "--toml").code == 2
