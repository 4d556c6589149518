"""Every kind of bad input: a message that says what and where, the documented exit code, no stack trace, nothing lost."""

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import cv2
import numpy as np
import pytest

from rotaline.cli.console import ConsoleObserver

OK, INCOMPLETE, BAD_INPUT, NOT_POSSIBLE, NOT_WRITTEN, INTERRUPTED = 0, 1, 2, 3, 4, 130


def _write_image(path, image):
    assert cv2.imwrite(str(path), image)


def _shrink(path, size):
    _write_image(path, cv2.resize(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), size))


# ---------------------------------------------------------------- sessions that cannot be read


def _no_folder(place):
    shutil.rmtree(place.session)


def _empty_folder(place):
    shutil.rmtree(place.session)
    place.session.mkdir()


def _a_file(place):
    shutil.rmtree(place.session)
    place.session.write_text("")


def _toml(old, new):
    return lambda place: place.edit("session.toml", old, new)


def _csv(folder, old, new):
    return lambda place: place.edit(f"{folder}/frames.csv", old, new)


def _other_size(place):
    _shrink(place.session / "ball" / "0003.png", (200, 150))


def _one_pixel(place):
    _shrink(place.session / "ball" / "0003.png", (1, 1))


def _only_one_pixel(place):
    for path in place.session.rglob("*.png"):
        _shrink(path, (1, 1))


def _no_table_of_frames(place):
    (place.session / "ball" / "frames.csv").unlink()


def _no_capture_folder(place):
    shutil.rmtree(place.session / "ball")


UNREADABLE = {
    "no folder": (_no_folder, ("no such folder", "session.toml")),
    "empty folder": (_empty_folder, ("empty", "session.toml")),
    "a file": (_a_file, ("file", "folder")),
    "no session.toml": (lambda place: (place.session / "session.toml").unlink(), ("no session.toml",)),
    "TOML syntax": (_toml("version = 1", "version = = 1"), ("session.toml", "line 2", "TOML")),
    "TOML encoding": (
        lambda place: (place.session / "session.toml").write_bytes(b"version = 1 # \xe4"),
        ("session.toml", "UTF-8"),
    ),
    "wrong version": (_toml("version = 1", "version = 2"), ("line 2", "version", "2", "expected 1")),
    "no version": (_toml("version = 1\n", ""), ("session.toml", "version", "missing")),
    "unknown role": (_toml('role = "axis"', 'role = "spin"'), ("line", "role", "'spin'", "axis, ")),
    "unknown target": (_toml('target = "dots"', 'target = "points"'), ("line", "target", "'points'", "checkerboard")),
    "unknown kind": (_toml('kind = "dots"', 'kind = "holes"'), ("line", "kind", "'holes'", "charuco")),
    "negative pitch": (_toml("pitch = 4.5", "pitch = -4.5"), ("line", "pitch", "-4.5", "more than 0")),
    "pitch is NaN": (_toml("pitch = 4.5", "pitch = nan"), ("line", "pitch", "nan")),
    "text for a number": (_toml("pitch = 4.5", 'pitch = "wide"'), ("line", "pitch", "wide")),
    "board of one corner": (_toml("[14, 9]", "[1, 9]"), ("line", "inner_corners", "1")),
    "unknown feature": (_toml('feature = "sphere"', 'feature = "cube"'), ("line", "feature", "'cube'", "sphere")),
    "measurement without capture": (_toml('capture = "ball"', 'capture = "bell"'), ("'bell'", "ball")),
    "no capture folder": (_no_capture_folder, ("'ball'", "no folder")),
    "no frames.csv": (_no_table_of_frames, ("frames.csv", "image,angle_deg,laser,pose")),
    "header": (_csv("ball", "angle_deg", "angle"), ("frames.csv, line 1", "angle_deg")),
    "text in angle_deg": (_csv("ball", ",45.000000,", ",a lot,"), ("frames.csv, line 4", "angle_deg", "'a lot'")),
    "angle_deg is NaN": (_csv("ball", ",45.000000,", ",nan,"), ("frames.csv, line 4", "angle_deg", "'nan'")),
    "angle_deg is infinite": (_csv("ball", ",45.000000,", ",-inf,"), ("frames.csv, line 4", "angle_deg", "'-inf'")),
    "no angle_deg": (_csv("ball", ",45.000000,", ",,"), ("ball/0002.png", "angle_deg")),
    "laser neither on nor off": (_csv("ball", "on", "red"), ("frames.csv, line 2", "laser", "'red'", "'on' or 'off'")),
    "no laser-on frame": (_csv("ball", ",on,", ",off,"), ("'ball'", "no laser-on frames")),
    "no laser-off frame": (_csv("camera", ",off,", ",on,"), ("'camera'", "no laser-off frames")),
    "image outside the folder": (_csv("ball", "0003.png", "../0003.png"), ("frames.csv, line 5", "image")),
    "images of different sizes": (_other_size, ("0003.png", "200 x 150", "320 x 240")),
    "a 1 x 1 image": (_one_pixel, ("0003.png", "1 x 1", "320 x 240")),
    "nothing but 1 x 1 images": (_only_one_pixel, ("1 x 1", "at least 32 x 32")),
}


@pytest.mark.parametrize("case", UNREADABLE)
def test_a_session_that_cannot_be_read_is_refused_with_the_place_and_the_reason(case, fresh, call):
    spoil, words = UNREADABLE[case]
    spoil(fresh)
    for command in ("check", "run"):
        outcome = call(command, fresh.session)
        assert outcome.code == BAD_INPUT
        text = outcome.err + " " + " ".join(outcome.out.split())
        for word in words:
            assert word in text, f"'{word}' is not in: {text}"
    assert not fresh.results.exists(), "nothing is written before the session can be read"


def test_check_lists_all_mistakes_at_once(fresh, call):
    fresh.edit("session.toml", 'role = "axis"', 'role = "spin"')
    fresh.edit("session.toml", "pitch = 4.5", "pitch = -4.5")
    outcome = call("check", fresh.session)
    assert outcome.code == BAD_INPUT
    text = outcome.err + " ".join(outcome.out.split())
    assert "'spin'" in text
    assert "-4.5" in text


# ---------------------------------------------------------------- frames that are left out


def _cut(path):
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


LEFT_OUT = {
    "missing": (lambda path: path.unlink(), "0003.png"),
    "truncated": (_cut, "cut off"),
    "empty": (lambda path: path.write_bytes(b""), "0003.png"),
    "text": (lambda path: path.write_text("not an image"), "0003.png"),
}


@pytest.mark.parametrize("case", LEFT_OUT)
def test_an_image_that_cannot_be_read_is_left_out_and_named(case, place, call):
    spoil, words = LEFT_OUT[case]
    spoil(place.session / "axis" / "0003.png")
    checked = call("check", place.session)
    assert checked.code == INCOMPLETE
    assert "0003.png" in checked.err + checked.out
    outcome = call("calibrate", place.session)
    assert outcome.code == INCOMPLETE
    assert "axis" in outcome.err
    assert "0003.png" in outcome.err
    assert words in outcome.err
    assert json.loads((place.results / "calibration.json").read_text())["rotation_axis_camera"] is not None


# ---------------------------------------------------------------- data that do not allow the calibration


def test_a_wrong_board_size_says_which_size_was_nearly_found(place, call):
    place.edit("session.toml", "inner_corners = [14, 9]", "inner_corners = [13, 9]")
    outcome = call("calibrate", place.session)
    assert outcome.code == NOT_POSSIBLE
    assert "14 x 9" in outcome.err
    assert "13 x 9" in outcome.err


def test_a_wrong_dot_plate_says_which_size_was_nearly_found(place, call):
    place.edit("session.toml", "dots = [9, 9]", "dots = [9, 8]")
    outcome = call("calibrate", place.session)
    assert outcome.code == NOT_POSSIBLE
    assert "9 x 9" in outcome.err
    assert "9 x 8" in outcome.err


def _keep_rows(place, folder, n):
    path = place.session / folder / "frames.csv"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[: n + 1]))


@pytest.mark.parametrize(("folder", "words"), [("camera", "at least"), ("laser", "at least"), ("axis", "at least")])
def test_a_capture_with_one_frame_says_how_many_are_needed(folder, words, place, call):
    _keep_rows(place, folder, 2 if folder == "laser" else 1)
    outcome = call("calibrate", place.session)
    assert outcome.code == NOT_POSSIBLE
    assert words in outcome.err


def test_a_scan_with_one_frame_is_incomplete(place, call):
    _keep_rows(place, "ball", 1)
    assert "one frame" in call("check", place.session).out
    outcome = call("scan", place.session, "--option", "scan.surface=false")
    assert outcome.code == INCOMPLETE
    assert "one frame" in outcome.err


@pytest.mark.parametrize("value", [0, 255], ids=["black", "white"])
@pytest.mark.parametrize(
    ("folder", "code"),
    [("camera", NOT_POSSIBLE), ("laser", NOT_POSSIBLE), ("axis", NOT_POSSIBLE), ("ball", INCOMPLETE)],
)
def test_frames_without_any_picture(folder, code, value, place, call):
    for path in (place.session / folder).glob("*.png"):
        _write_image(path, np.full((240, 320), value, np.uint8))
    command = ("scan", "--option", "scan.surface=false") if folder == "ball" else ("calibrate",)
    outcome = call(command[0], place.session, *command[1:])
    assert outcome.code == code
    assert folder in outcome.err
    calibration = json.loads((place.results / "calibration.json").read_text())
    assert (calibration["camera"] is None) == (folder == "camera"), "what can be calibrated is written"


# ---------------------------------------------------------------- other files and options


def test_options_that_do_not_exist_are_named_with_those_that_do(place, call):
    outcome = call("calibrate", place.session, "--option", "stripe.colour=red")
    assert outcome.code == BAD_INPUT
    assert "colour" in outcome.err
    assert "method" in outcome.err


def test_a_value_that_an_option_cannot_have_is_refused(place, call):
    outcome = call("calibrate", place.session, "--option", "stripe.method=best")
    assert outcome.code == BAD_INPUT
    assert "best" in outcome.err
    assert "steger" in outcome.err


@pytest.mark.parametrize(
    "text", [None, "{", "[]", "{}", '{"camera": {"fx": "wide"}}'], ids=["missing", "cut", "list", "empty", "text"]
)
def test_a_calibration_file_that_cannot_be_read(text, place, call, tmp_path):
    path = tmp_path / "other.json"
    if text is not None:
        path.write_text(text)
    outcome = call("scan", place.session, "--calibration", path)
    assert outcome.code == BAD_INPUT
    assert "other.json" in outcome.err


def test_a_calibration_of_another_image_size_is_refused(place, call, tmp_path):
    content = json.loads((place.results / "calibration.json").read_text())
    content["camera"]["image_size"] = [640, 480]
    (tmp_path / "other.json").write_text(json.dumps(content))
    outcome = call("scan", place.session, "--calibration", tmp_path / "other.json")
    assert outcome.code == BAD_INPUT
    assert "640 x 480" in outcome.err
    assert "320 x 240" in outcome.err


PLY = "ply\nformat ascii 1.0\nelement vertex {n}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
CLOUDS = {
    "missing": ("c.ply", None, BAD_INPUT),
    "not a cloud": ("c.ply", "hello", BAD_INPUT),
    "unknown kind": ("c.doc", "hello", BAD_INPUT),
    "no points": ("c.ply", PLY.format(n=0), BAD_INPUT),
    "cut off": ("c.ply", PLY.format(n=5) + "1 2 3\n", BAD_INPUT),
    "too few points": ("c.ply", PLY.format(n=2) + "1 2 3\n4 5 6\n", NOT_POSSIBLE),
}


@pytest.mark.parametrize("case", CLOUDS)
def test_a_cloud_that_cannot_be_measured(case, call, tmp_path):
    name, text, code = CLOUDS[case]
    if text is not None:
        (tmp_path / name).write_text(text)
    outcome = call("measure", tmp_path / name, "--feature", "sphere")
    assert outcome.code == code
    assert name in outcome.err


def test_a_capture_that_is_not_there(place, call):
    outcome = call("scan", place.session, "bell")
    assert outcome.code == BAD_INPUT
    assert "'bell'" in outcome.err
    assert "ball" in outcome.err


@pytest.mark.parametrize(
    "arguments",
    [["nothing"], ["run"], ["run", "a", "b"], ["run", "--speed"], ["measure", "SESSION", "--feature", "sphere"]],
    ids=" ".join,
)
def test_wrong_use_points_to_the_help(arguments, place, call):
    outcome = call(*[place.session if a == "SESSION" else a for a in arguments])
    assert outcome.code == BAD_INPUT
    assert "--help" in outcome.err or "--capture" in outcome.err


# ---------------------------------------------------------------- results that cannot be written


def test_results_never_go_into_the_session(place, call):
    outcome = call("calibrate", place.session, "--out", place.session / "results")
    assert outcome.code == BAD_INPUT
    assert "session" in outcome.err


def test_a_results_folder_in_place_of_a_file(place, call, tmp_path):
    (tmp_path / "taken").write_text("mine")
    outcome = call("calibrate", place.session, "--out", tmp_path / "taken")
    assert outcome.code == NOT_WRITTEN
    assert "taken" in outcome.err
    assert "--out" in outcome.err
    assert (tmp_path / "taken").read_text() == "mine"


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="needs a folder that nobody can write to")
def test_a_results_folder_that_cannot_be_made(place, call):
    outcome = call("calibrate", place.session, "--out", "/proc/rotaline-results")
    assert outcome.code == NOT_WRITTEN
    assert "/proc/rotaline-results" in outcome.err
    assert "--out" in outcome.err


@pytest.mark.skipif(os.geteuid() == 0, reason="the administrator may write anywhere")
def test_a_results_folder_without_permission(fresh, call):
    fresh.results.mkdir(mode=0o500)
    outcome = call("calibrate", fresh.session)
    assert outcome.code == NOT_WRITTEN
    assert "permissions" in outcome.err


@pytest.mark.parametrize("n_files", [0, 4])
def test_a_full_disk_keeps_what_was_finished(n_files, fresh, calibrated, call, monkeypatch):
    made = Path.touch
    count = iter(range(1000))

    def fill_up(path, **how):
        if next(count) >= n_files:
            raise OSError(28, os.strerror(28))
        made(path, **how)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "touch", fill_up)
        outcome = call("calibrate", fresh.session)
    assert outcome.code == NOT_WRITTEN
    assert "no space left" in outcome.err
    assert not list(fresh.results.rglob(".*")), "no half written file stays"
    assert len(list((fresh.results / "stages").iterdir())) == n_files

    again = call("calibrate", fresh.session)
    assert again.code == OK
    assert again.err.count("stored result") >= n_files
    assert _figures(fresh) == pytest.approx(_figures(calibrated), rel=1e-9, abs=1e-9)


def test_a_file_that_is_cut_off_while_it_is_written(place, call):
    def allow_small_files_only():
        resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))

    for path in (place.results / "stages").glob("camera*"):
        path.unlink()
    before = (place.results / "calibration.json").read_bytes()
    done = subprocess.run(
        [sys.executable, "-m", "rotaline.cli", "calibrate", str(place.session)],
        preexec_fn=allow_small_files_only,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == NOT_WRITTEN, done.stderr
    assert "Traceback" not in done.stderr
    assert (place.results / "calibration.json").read_bytes() == before
    assert not list(place.results.rglob(".*"))


# ---------------------------------------------------------------- Ctrl-C


def _figures(place):
    """The numbers of a calibration; reading a stored pose makes its rotation a rotation again, which changes the last digit."""
    content = json.loads((place.results / "calibration.json").read_text())
    plane, axis, camera = content["laser_plane_camera"], content["rotation_axis_camera"], content["camera"]
    vectors = {"normal": plane["normal"], "point": axis["point"], "direction": axis["direction"]}
    numbers = {f"{name}_{i}": value for name, vector in vectors.items() for i, value in enumerate(vector)}
    return (
        numbers
        | {"offset": plane["offset"], "turn_sense": content["turn_sense"]}
        | {name: camera[name] for name in ("fx", "fy", "cx", "cy")}
        | camera["distortion"]
    )


@pytest.mark.parametrize("moment", [0, 12, 40])
def test_an_interrupted_run_goes_on_where_it_stopped(moment, fresh, calibrated, call, monkeypatch):
    steps = iter(range(1000))

    def press_ctrl_c():
        if next(steps) == moment:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(ConsoleObserver, "work", lambda self, label, total: nullcontext(press_ctrl_c))
        outcome = call("calibrate", fresh.session)
    assert outcome.code == INTERRUPTED
    assert "interrupted" in outcome.err
    assert "again" in outcome.err
    assert not list(fresh.results.rglob(".*"))
    finished = len(list((fresh.results / "stages").iterdir()))

    again = call("calibrate", fresh.session)
    assert again.code == OK
    assert again.err.count("stored result") == finished
    assert _figures(fresh) == pytest.approx(_figures(calibrated), rel=1e-9, abs=1e-9)


def test_a_real_interrupt_ends_the_process_without_a_stack_trace(fresh):
    with subprocess.Popen(
        [sys.executable, "-m", "rotaline.cli", "calibrate", str(fresh.session)],
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # a background shell has it ignored
    ) as process:
        assert process.stderr is not None
        first = process.stderr.readline()  # the first stage has begun
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
        assert process.wait() == INTERRUPTED, first + rest
    assert "Traceback" not in first + rest
    assert "interrupted" in rest
    assert not list(fresh.results.rglob(".*"))
