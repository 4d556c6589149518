"""Acquisitions on a small simulated rig: what is kept whatever happens, and how the rig is left (``small_acquisition.start`` asks the world)."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.unit.pipeline import small_acquisition as small
from tests.unit.pipeline.small_acquisition import (
    AXIS,
    BALL,
    CAMERA,
    EVERYTHING,
    LASER,
    STEPPED,
    TARGETS,
    Heard,
    content,
    rows,
    small_world,
    start,
)

from rotaline.errors import (
    DetectionError,
    DeviceConnectionError,
    DeviceStateError,
    DeviceTimeoutError,
    LostFrameError,
    OutputError,
    RigError,
    SessionError,
)
from rotaline.hardware.camera import CameraFrame, CameraInfo, CameraSettings
from rotaline.hardware.simulated import world as world_module
from rotaline.hardware.simulated.faults import Faults
from rotaline.io import acquired_session
from rotaline.io.frame_writer import FrameWriter
from rotaline.io.plan_tables import PlanCapture
from rotaline.io.session import read_session
from rotaline.pipeline.acquire.exposure import STRIPE_LEVEL, WHITE_LEVEL, better_exposure, expose_scene, expose_stripe
from rotaline.pipeline.acquire.stand_ins import SimulatedPerson
from rotaline.pipeline.acquire.tasks import missing_stops, n_frames, stops_of, unfinished_pose, wanted_images

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(world_module, "render_exposure", small.rendered)


# what a plan consists of


def names(stops):
    return [[task.image for task in stop.tasks] for stop in stops]


@pytest.mark.parametrize(
    ("fields", "lights", "poses"),
    [
        ({"role": "camera", "poses": 2}, "-", ["", ""]),
        ({"role": "laser-plane", "poses": 2}, "-+", ["0", "1"]),
        ({"role": "laser-plane", "poses": 2, "bracket": [0.5, 2.0]}, "-++", ["0", "1"]),
        ({"role": "axis", "to_deg": 2.0}, "-", ["", ""]),
        ({"role": "artifact", "frames": 2}, "+", ["", ""]),
        ({"role": "scan", "frames": 2, "laser_off_frames": True}, "-+", ["", ""]),
        ({"role": "scan", "frames": 2, "laser_off_frames": True, "bracket": [1.0, 3.0]}, "-++", ["", ""]),
    ],
)
def test_a_stop_has_the_frames_that_its_role_needs(fields, lights, poses):
    capture = PlanCapture(folder="a", **fields)
    stops = stops_of(capture)
    assert ["".join("+" if t.laser else "-" for t in stop.tasks) for stop in stops] == [lights, lights]
    assert [stop.tasks[0].pose for stop in stops] == poses
    assert [name for stop in names(stops) for name in stop] == [f"{i:04d}.png" for i in range(2 * len(lights))]
    assert n_frames(capture) == 2 * len(lights)


def test_brackets_are_factors_of_the_exposure():
    stop = stops_of(PlanCapture(folder="a", role="scan", frames=2, bracket=[0.3, 1.0, 3.0]))[0]
    assert [task.factor for task in stop.tasks] == [0.3, 1.0, 3.0]


TURNED = PlanCapture(folder="a", role="scan", frames=3, laser_off_frames=True)
POSED = PlanCapture(folder="a", role="laser-plane", poses=3)
ALL = [f"{i:04d}.png" for i in range(6)]


def test_single_frames_of_an_angle_are_taken_again():
    assert missing_stops(TURNED, ALL, ALL) == []
    assert names(missing_stops(TURNED, ALL[:3], ALL[:3])) == [["0003.png"], ["0004.png", "0005.png"]]
    # 1 is listed and gone; and gone once more under its second name
    assert names(missing_stops(TURNED, ALL, set(ALL) - {"0001.png"})) == [["0001-2.png"]]
    assert names(missing_stops(TURNED, [*ALL, "0001-2.png"], set(ALL) - {"0001.png"})) == [["0001-3.png"]]
    assert missing_stops(TURNED, [*ALL, "0001-2.png"], {*ALL, "0001-2.png"} - {"0001.png"}) == []


def test_a_pose_that_lost_a_frame_is_taken_again_as_a_pose_of_its_own():
    (stop,) = missing_stops(POSED, ALL, set(ALL) - {"0003.png"})
    assert [task.image for task in stop.tasks] == ["0002-2.png", "0003-2.png"]
    assert {task.pose for task in stop.tasks} == {"1-2"}
    again = [*ALL, "0002-2.png", "0003-2.png"]
    assert missing_stops(POSED, again, set(again) - {"0003.png"}) == []


def test_what_was_lost_and_taken_again_counts_once():
    assert wanted_images(TURNED, ALL, ALL) == set(ALL)
    again = [*ALL, "0001-2.png"]
    assert wanted_images(TURNED, again, set(again) - {"0001.png"}) == {*ALL, "0001-2.png"} - {"0001.png"}
    assert wanted_images(TURNED, again, again) == set(ALL)  # it was damaged, and is there
    assert wanted_images(POSED, ALL, set(ALL) - {"0003.png"}) == set(ALL) - {"0002.png", "0003.png"}
    again = [*ALL, "0002-2.png", "0003-2.png"]
    assert wanted_images(POSED, again, set(again) - {"0003.png"}) == set(again) - {"0002.png", "0003.png"}


@pytest.mark.parametrize(
    ("capture", "listed", "expected"),
    [
        (POSED, [], (0, 0)),
        (POSED, ALL, (0, 0)),
        (POSED, ALL[:2], (0, 0)),
        (POSED, ALL[:3], (1, 1)),
        (POSED, [*ALL, "0002-2.png"], (1, 1)),
        (POSED, [*ALL, "0002-2.png", "0003-2.png"], (0, 0)),
        (TURNED, ALL[:3], (0, 0)),
    ],
)
def test_a_pose_that_was_interrupted_is_recognised(capture, listed, expected):
    assert unfinished_pose(capture, listed) == expected


# exposures


def scene_at(exposure_us, *, stripe_e_per_us, white_e_per_us=0.002, speckle=0.0, dtype=np.uint8):
    """A frame of a camera of 255 e full well (or that much more for 16 bit), with a stripe and a white patch."""
    u = np.arange(160)
    rng = np.random.default_rng(1)
    light = np.full((120, 160), 0.1 * white_e_per_us)
    light[:30, :80] = white_e_per_us
    stripe = stripe_e_per_us * np.exp(-0.5 * ((u - 70.0) / 1.8) ** 2)
    light = light + stripe * np.maximum(1.0 + speckle * rng.normal(size=(120, 1)), 0.05)
    full = np.iinfo(dtype).max
    grey = np.clip(light * exposure_us / 255.0 + rng.normal(0.01, 0.004, light.shape), 0.0, 1.0)
    image = np.rint(full * grey).astype(dtype)
    return CameraFrame(image, 1, 0.0, 0.0, CameraSettings(exposure_us))


@pytest.mark.parametrize("stripe_e_per_us", [0.0005, 0.02, 5.0])
@pytest.mark.parametrize("speckle", [0.0, 0.2])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_the_stripe_is_bright_and_not_saturated(stripe_e_per_us, speckle, dtype):
    def take_at(exposure_us):
        return scene_at(exposure_us, stripe_e_per_us=stripe_e_per_us, white_e_per_us=0.0, speckle=speckle, dtype=dtype)

    found = expose_stripe(take_at, 10_000.0, (10.0, 1e6))
    column = take_at(found.exposure_us).image[:, 70] / np.iinfo(dtype).max
    core = np.max([column[:-2], column[1:-1], column[2:]], axis=0)
    assert abs(np.quantile(core, 0.95) - STRIPE_LEVEL) < 0.1 * STRIPE_LEVEL
    assert np.mean(core >= 0.995) <= 0.03
    assert found.note == ""
    assert 10.0 < found.exposure_us < 1e6


def test_a_stripe_in_a_washed_out_frame_is_found_at_a_shorter_exposure():
    def take_at(exposure_us):
        return scene_at(exposure_us, stripe_e_per_us=2.0, white_e_per_us=1.0)

    assert take_at(10_000.0).image.min() == 255
    found = expose_stripe(take_at, 10_000.0, (1.0, 1e6))
    assert 50.0 < found.exposure_us < 130.0


def test_a_stripe_that_stays_dark_or_bright_is_said():
    dark = expose_stripe(lambda us: scene_at(us, stripe_e_per_us=0.0001, white_e_per_us=0.0), 10_000.0, (10.0, 5e5))
    assert dark.exposure_us == 5e5
    assert "stays dark" in dark.note
    assert "open the lens" in dark.note
    bright = expose_stripe(lambda us: scene_at(us, stripe_e_per_us=5.0, white_e_per_us=0.0), 10_000.0, (200.0, 1e6))
    assert bright.exposure_us == 200.0
    assert "saturated" in bright.note
    assert "dim the laser" in bright.note


def test_without_a_stripe_it_is_said_after_few_frames():
    tried = []

    def take_at(exposure_us):
        tried.append(exposure_us)
        return scene_at(exposure_us, stripe_e_per_us=0.0, white_e_per_us=0.0)

    with pytest.raises(
        DetectionError, match=r"No laser stripe was found at exposures from 10 to 1000000 us. Is the laser on"
    ):
        expose_stripe(take_at, 10_000.0, (10.0, 1e6))
    assert (min(tried), max(tried)) == (10.0, 1e6)
    assert len(tried) <= 12


def test_white_is_bright_and_not_saturated():
    def take_at(exposure_us):
        return scene_at(exposure_us, stripe_e_per_us=0.0)

    for begin_us in (100.0, 1e6):
        found = expose_scene(take_at, begin_us, (10.0, 1e6))
        assert abs(found.level - WHITE_LEVEL) < 0.1 * WHITE_LEVEL
    exposure = 100.0
    for _ in range(6):  # a preview follows the light
        exposure = better_exposure(take_at(exposure).image, exposure, (10.0, 1e6))
    assert exposure == pytest.approx(found.exposure_us, rel=0.1)


# one acquisition


def test_a_session_is_complete_and_readable(tmp_path):
    heard = Heard()
    done = start(tmp_path / "s", heard=heard)
    assert (done.n_frames, done.n_before, done.n_retaken) == (39, 0, 0)
    assert heard.stages == [
        ("Capture camera (camera, checkerboard)", False),
        ("Capture laser (laser-plane, dots)", False),
        ("Capture axis (axis, checkerboard)", False),
        ("Capture stepped (artifact, stepped-cylinder)", False),
        ("Capture ball (scan)", False),
    ]
    session = read_session(tmp_path / "s")
    assert session.problems == ()
    assert {c.folder: len(c.frames) for c in session.captures} == {
        "camera": 3,
        "laser": 9,
        "axis": 5,
        "stepped": 14,
        "ball": 8,
    }
    laser = rows(tmp_path / "s/laser")
    assert [row["pose"] for row in laser] == [*"000111222"]
    assert [row["exposure_us"] for row in laser[:3]] == ["10000", "10000", "20000"]
    assert all(row["time"].endswith("Z") and row["gain"] == "1" for row in laser)
    times = [row["time"] for folder in ("camera", "laser", "axis") for row in rows(tmp_path / "s" / folder)]
    assert times == sorted(times)


def test_an_exposure_that_was_found_is_kept_and_recorded(tmp_path):
    heard = Heard()
    start(tmp_path / "s", heard=heard)
    on = [row for row in rows(tmp_path / "s/stepped") if row["laser"] == "on"]
    (exposure,) = {float(row["exposure_us"]) for row in on}
    # the stripe of the stand-in for the renderer: 8 e-3 of a grey level each us, and 6 + 0.5e-3 of the room
    assert (6 + 8.5e-3 * exposure) / 255 == pytest.approx(STRIPE_LEVEL, rel=0.1)
    assert any(f"Exposure of laser-on frames: {exposure:.0f} us; the stripe reaches 7" in note for note in heard.notes)
    # the next start does not look for it again
    again = Heard()
    start(tmp_path / "s", heard=again)
    assert not any("Exposure" in note for note in again.notes)


def test_started_again_there_is_nothing_left_to_do(tmp_path):
    start(tmp_path / "s")
    before = content(tmp_path / "s")
    world, heard = small_world(), Heard()
    done = start(tmp_path / "s", world=world, heard=heard)
    assert (done.n_frames, done.n_before) == (39, 39)
    assert all(stored for _, stored in heard.stages)
    assert world.counts["frames"] == world.counts["moves"] == 0
    assert content(tmp_path / "s") == before
    assert heard.notes == ["All 39 frames are there already."]


def test_previews_use_an_exposure_of_their_own_until_the_target_is_there(tmp_path):
    """The exposure is found when the first pose is held, not before."""
    seen = []

    class Looks(SimulatedPerson):
        def pose(self, capture, index, preview):
            seen.extend(preview().settings.exposure_us for _ in range(5))
            super().pose(capture, index, preview)

    world, heard = small_world(), Heard()
    start(
        tmp_path / "s",
        TARGETS + CAMERA.replace("exposure_off_us = 10000.0", ""),
        world,
        person=Looks(world),
        heard=heard,
    )
    assert len(heard.notes) == 1
    used = {float(row["exposure_us"]) for row in rows(tmp_path / "s/camera")}
    assert len(used) == 1
    assert seen[5:] == [pytest.approx(*used)] * 10
    assert seen[0] == 10_000.0 != seen[1]


def test_nobody_works_in_the_light_of_the_laser(tmp_path):
    world = small_world()
    lit = []

    class Watches(SimulatedPerson):
        def place(self, capture, n_done):
            lit.append(world.shines())
            super().place(capture, n_done)

        def pose(self, capture, index, preview):
            lit.append(world.shines())
            super().pose(capture, index, preview)

    start(tmp_path / "s", world=world, person=Watches(world))
    assert len(lit) == 5 + 6
    assert not any(lit)


def test_a_pose_that_is_refused_is_taken_again(tmp_path):
    world, heard, judged = small_world(), Heard(), []

    class Strict(SimulatedPerson):
        def judge(self, capture, index, frame, preview):
            judged.append(index)
            return "It is blurred." if judged.count(1) == 1 and index == 1 else None

    done = start(tmp_path / "s", TARGETS + LASER, world, person=Strict(world), heard=heard)
    assert judged == [0, 1, 1, 2]
    assert done.n_frames == 9
    assert heard.notes == ["Pose 2: It is blurred. It is taken again."]


def test_the_laser_warms_up_once(tmp_path):
    world, heard = small_world(), Heard()
    start(tmp_path / "s", "warm_up_s = 600.0\n" + EVERYTHING, world, heard=heard)
    assert heard.notes.count("The laser warms up for 600 s.") == 1
    laser = rows(tmp_path / "s/laser")
    assert laser[0]["time"][:16] < laser[1]["time"][:16] == laser[-1]["time"][:16]


# interruptions


def test_twenty_kills_change_nothing(tmp_path):
    if not hasattr(os, "fork"):
        pytest.skip("processes cannot fork here")
    done = subprocess.run(
        [sys.executable, "-m", "tests.unit.pipeline.killed_acquisition", str(tmp_path), "4", "20"],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT / "src"), str(ROOT)])},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("20 kills"), done.stdout
    whole, killed = content(tmp_path / "whole"), content(tmp_path / "killed")
    assert killed.keys() == whole.keys()
    assert [name for name in whole if killed[name] != whole[name]] == []


def test_rows_are_only_ever_appended(tmp_path):
    """Each start leaves what was there as it was, byte for byte."""
    world = small_world()

    class GivesUp(SimulatedPerson):
        n = 4

        def place(self, capture, n_done):
            super().place(capture, n_done)
            if capture.folder == ["camera", "laser", "axis", "stepped", "ball"][GivesUp.n]:
                raise KeyboardInterrupt

    tables = {}
    for n in (1, 2, 3, 4, 5):
        GivesUp.n = min(n, 4)
        person = GivesUp(world) if n < 5 else None
        if n < 5:
            with pytest.raises(KeyboardInterrupt):
                start(tmp_path / "s", world=world, person=person)
        else:
            start(tmp_path / "s")
        now = {p: p.read_bytes() for p in (tmp_path / "s").rglob("frames.csv")}
        assert len(now) >= len(tables) + (n > 1)
        assert all(now[path].startswith(before) for path, before in tables.items())
        assert len(read_session(tmp_path / "s").captures) == n  # what is there can be used at any time
        tables = now


def test_a_pose_that_was_not_finished_is_taken_whole(tmp_path):
    with pytest.raises(DeviceConnectionError):
        start(tmp_path / "s", TARGETS + LASER, small_world(Faults(camera_gone_at_frames=frozenset({5}))))
    # frames of a pose go to the disk together; what a crash may leave is the beginning of it
    assert len(rows(tmp_path / "s/laser")) == 3
    start(tmp_path / "half", TARGETS + LASER)
    table = tmp_path / "half/laser/frames.csv"
    table.write_bytes(b"".join(table.read_bytes().splitlines(keepends=True)[:6]))
    heard = Heard()
    done = start(tmp_path / "half", TARGETS + LASER, heard=heard)
    assert (done.n_frames, done.n_before) == (9, 3)
    assert "laser: pose 2 was not finished; all its frames are taken again." in heard.notes
    assert heard.notes[0] == "3 of 9 frames are there already; it goes on with the first that is missing."
    start(tmp_path / "s", TARGETS + LASER)
    assert content(tmp_path / "half") == content(tmp_path / "s")


def test_a_torn_line_and_lost_and_damaged_images_are_taken_again(tmp_path):
    plan = TARGETS + AXIS + BALL
    start(tmp_path / "s", plan)
    whole = content(tmp_path / "s")
    axis, ball = tmp_path / "s/axis", tmp_path / "s/ball"
    table = (axis / "frames.csv").read_bytes()
    (axis / "frames.csv").write_bytes(table[:-9])
    (axis / "0002.png").unlink()
    data = (ball / "0003.png").read_bytes()
    (ball / "0003.png").write_bytes(data[: len(data) // 2])
    (ball / "0007.png.part").write_bytes(b"x")
    heard = Heard()
    done = start(tmp_path / "s", plan, heard=heard)
    assert heard.notes == [
        "axis/frames.csv: the last line was half written; its frame is taken again.",
        "axis/0002.png: it is listed, but the image is gone; it is taken again.",
        "ball/0007.png: it was half written; the frame is taken again.",
        "ball/0003.png: it is listed, but the image is damaged; it is taken again.",
        "10 of 13 frames are there already; it goes on with the first that is missing.",
    ]
    assert done.n_frames == 13
    assert [row["image"] for row in rows(axis)] == [
        *(f"{i:04d}.png" for i in range(4)),
        "0002-2.png",
        "0004.png",
    ]
    assert rows(ball)[-1]["image"] == "0003-2.png"
    now = content(tmp_path / "s")
    assert now["axis/0002-2.png"] == whole["axis/0002.png"]
    assert now["ball/0003-2.png"] == whole["ball/0003.png"]
    assert now["axis/0004.png"] == whole["axis/0004.png"]
    session = read_session(tmp_path / "s")  # the rows without an image are left out
    assert [len(c.frames) for c in session.captures] == [5, 8]
    assert all(not p.fatal for p in session.problems)


def test_zeros_that_a_power_cut_left_at_the_end_are_cut_off(tmp_path):
    plan = TARGETS + AXIS
    start(tmp_path / "s", plan)
    whole = content(tmp_path / "s")
    with (tmp_path / "s/axis/frames.csv").open("ab") as stream:
        stream.write(b"\0" * 50 + b"\n")
    heard = Heard()
    start(tmp_path / "s", plan, heard=heard)
    assert "the last line was half written" in heard.notes[0]
    assert content(tmp_path / "s") == whole


def test_another_plan_and_another_rig(tmp_path):
    start(tmp_path / "s", TARGETS + AXIS)
    with pytest.raises(SessionError, match=r"begun with another plan(?s:.*)capture 'ball': only in the new plan"):
        start(tmp_path / "s", TARGETS + AXIS + BALL)
    heard = Heard()
    start(tmp_path / "s", TARGETS + AXIS, heard=heard, rig_text="another rig")
    assert heard.warnings == [
        "The rig file is not the one that this session was begun with; the devices are taken as they are now."
    ]


def test_references_come_every_so_often_and_at_the_end(tmp_path):
    start(tmp_path / "s", TARGETS + STEPPED)
    references = rows(tmp_path / "s/reference")
    assert [row["image"] for row in references] == [f"stepped-{i:04d}.png" for i in (0, 3, 6, 7)]
    assert {(row["angle_deg"], row["laser"], row["pose"]) for row in references} == {("0.000000", "on", "stepped")}
    assert {row["exposure_us"] for row in references} == {rows(tmp_path / "s/stepped")[1]["exposure_us"]}
    assert [c.folder for c in read_session(tmp_path / "s").captures] == ["stepped"]


@pytest.mark.parametrize("gone_at", range(5, 23, 3))
def test_references_are_resumed(tmp_path, gone_at):
    start(tmp_path / "whole", TARGETS + STEPPED)
    with pytest.raises(DeviceConnectionError):
        start(tmp_path / "s", TARGETS + STEPPED, small_world(Faults(camera_gone_at_frames=frozenset({gone_at}))))
    start(tmp_path / "s", TARGETS + STEPPED)
    assert content(tmp_path / "s") == content(tmp_path / "whole")


# the disk


class Full:
    """A disk on which the write of this number, and all later ones, find no space."""

    def __init__(self, monkeypatch, at):
        self.at, self.n, self.begun = at, 0, True
        for name in ("write", "fsync"):
            monkeypatch.setattr(acquired_session.os, name, self.failing(getattr(os, name)))
        monkeypatch.setattr(Path, "write_bytes", self.failing(Path.write_bytes))

    def failing(self, function):
        def call(*args):
            self.n += self.begun
            if self.begun and self.n >= self.at:
                if function is os_write and self.n == self.at:
                    function(args[0], bytes(args[1])[: len(args[1]) // 2])  # what still fits
                raise OSError(28, "No space left on device")
            return function(*args)

        return call


os_write = os.write


@pytest.mark.parametrize("at", [1, 3, 6, *range(9, 40, 2)])
def test_a_full_disk_keeps_what_is_listed_and_goes_on_later(tmp_path, at):
    plan = TARGETS + AXIS + BALL
    out = tmp_path / "s"
    with pytest.MonkeyPatch.context() as patch:
        full = Full(patch, at)
        world = small_world()
        with pytest.raises(
            OutputError,
            match=r"cannot be written \(No space left on device\)\. All frames that are listed are kept\. Free some space",
        ):
            start(out, plan, world)
        full.begun = False
    for table in out.glob("*/frames.csv"):
        assert table.read_bytes()[-1:] in (b"\n", b"")
        assert all((table.parent / row["image"]).stat().st_size > 0 for row in rows(table.parent))
    start(out, plan)
    start(tmp_path / "whole", plan)
    assert content(out) == content(tmp_path / "whole")


def test_a_folder_that_cannot_be_written(tmp_path, monkeypatch):
    def refused(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "mkdir", refused)
    with pytest.raises(OutputError, match=r"s: cannot be written \(Permission denied\).*change the permissions"):
        start(tmp_path / "s", TARGETS + AXIS)


def test_a_slow_disk_makes_the_camera_wait_and_nothing_is_lost(tmp_path, monkeypatch):
    """No more than a few frames wait in memory; here, the disk takes one only when the queue is full."""
    depth, waiting = 3, []

    class Slow(FrameWriter):
        def __init__(self, session):
            super().__init__(session, depth)

        def put(self, folder, row, image):
            super().put(folder, row, image)
            waiting.append(self.n_waiting)

    add = acquired_session.AcquiredSession.add
    added = 0

    def slow(self, folder, row, encoded):
        """Wait until the camera is as far ahead as it can get: the frame in hand, those in the queue, and one more."""
        nonlocal added
        while added > 0 and world.counts["frames"] < min(added + depth + 2, 8):
            continue
        added += 1
        add(self, folder, row, encoded)

    world = small_world()
    monkeypatch.setattr("rotaline.pipeline.acquire.acquire.FrameWriter", Slow)
    monkeypatch.setattr(acquired_session.AcquiredSession, "add", slow)
    start(tmp_path / "s", TARGETS + BALL, world)
    assert [row["image"] for row in rows(tmp_path / "s/ball")] == [f"{i:04d}.png" for i in range(8)]
    assert max(waiting) == depth + 1


# devices that fail


PLAN = TARGETS + AXIS + BALL


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The content of PLAN's session."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(world_module, "render_exposure", small.rendered)
        out = tmp_path_factory.mktemp("undisturbed") / "s"
        start(out, PLAN)
        return content(out)


@pytest.mark.parametrize(
    ("faults", "said"),
    [
        (Faults(lost_frames=frozenset({2, 7})), "did not arrive"),
        (Faults(damaged_frames=frozenset({2, 7})), "arrived in pieces"),
        (Faults(late_frames={2: 60.0, 7: 60.0}), "did not arrive within 5.01 s"),
    ],
)
def test_lost_damaged_and_late_frames_are_taken_again(tmp_path, undisturbed, faults, said):
    heard = Heard()
    done = start(tmp_path / "s", PLAN, small_world(faults), heard=heard)
    assert (done.n_frames, done.n_retaken) == (13, 2)
    assert len(heard.notes) == 2
    for note in heard.notes:
        assert said in note
        assert note.endswith("Taken again (1 of 4).")
    now = content(tmp_path / "s")
    assert now.keys() == undisturbed.keys()
    tables = [name for name in now if name.endswith("frames.csv")]
    assert all(now[name] == undisturbed[name] for name in tables)
    events = (tmp_path / "s/acquisition/events.jsonl").read_text().splitlines()
    assert sum('"kind": "retaken"' in line for line in events) == 2


def test_a_camera_that_sends_nothing_any_more_is_given_up(tmp_path):
    faults = Faults(lost_frames=frozenset(range(4, 100)))
    with pytest.raises(LostFrameError, match=r"did not arrive\. Take it again. It was tried 5 times"):
        start(tmp_path / "s", PLAN, small_world(faults))
    assert len(rows(tmp_path / "s/axis")) == 3
    with pytest.raises(DeviceTimeoutError, match="It was tried 5 times"):
        start(tmp_path / "s", PLAN, small_world(Faults(late_frames=dict.fromkeys(range(2, 100), 60.0))))
    assert len(rows(tmp_path / "s/axis")) == 4


def test_an_old_frame_does_not_count(tmp_path):
    """A driver that hands out a frame once more."""

    class Stale:
        def __init__(self, camera):
            self._camera, self._last, self._n = camera, None, 0

        def __getattr__(self, name):
            return getattr(self._camera, name)

        def take(self, timeout_s):
            self._n += 1
            if self._n in (3, 4):
                return self._last
            self._last = self._camera.take(timeout_s)
            return self._last

    heard = Heard()
    done = start(tmp_path / "s", PLAN, heard=heard, wrap=lambda rig: replace(rig, camera=Stale(rig.camera)))
    assert done.n_retaken == 2
    assert "frame 2 came, but frame 2 was there already" in heard.notes[0]
    numbers = [int(row["number"]) for row in rows(tmp_path / "s/axis")]
    assert numbers == [1, 2, 3, 4, 5]


@pytest.mark.parametrize(
    ("faults", "error", "n_frames"),
    [
        (Faults(camera_gone_at_frames=frozenset({4})), DeviceConnectionError, 3),
        (Faults(stalled_moves=frozenset({4})), DeviceTimeoutError, 2),
        (Faults(alarm_at_moves=frozenset({4})), DeviceStateError, 2),
        (Faults(turntable_gone_at_moves=frozenset({4})), DeviceConnectionError, 2),
        (Faults(laser_dark_at_switchings=frozenset({1})), DeviceTimeoutError, 5),
    ],
)
def test_what_was_taken_is_kept_and_the_next_start_goes_on(tmp_path, undisturbed, faults, error, n_frames):
    """Unplugged and plugged in again, stuck and freed: the same world, the devices opened anew."""
    world, heard = small_world(faults), Heard()
    with pytest.raises(error):
        start(tmp_path / "s", PLAN, world)
    assert sum(len(rows(t.parent)) for t in (tmp_path / "s").glob("*/frames.csv")) == n_frames
    start(tmp_path / "s", PLAN, world, heard=heard)
    assert heard.notes == [f"{n_frames} of 13 frames are there already; it goes on with the first that is missing."]
    assert content(tmp_path / "s") == undisturbed


def test_a_laser_that_stays_lit_is_said_and_switched_off_at_the_next_try(tmp_path):
    world, heard = small_world(Faults(laser_lit_at_switchings=frozenset({1}))), Heard()
    with pytest.raises(DeviceTimeoutError, match="still shines"):
        start(tmp_path / "s", TARGETS + LASER, world, heard=heard)


@pytest.mark.parametrize("what", [ZeroDivisionError("a driver's own defect"), KeyboardInterrupt(), SystemExit(3)])
@pytest.mark.parametrize("device", ["camera", "turntable", "laser"])
def test_whatever_a_driver_raises_the_rig_is_left_dark_and_still(tmp_path, device, what):
    class Broken:
        def __init__(self, inner):
            self._inner, self._n = inner, 0

        def __getattr__(self, name):
            return getattr(self._inner, name)

        def __call_(self):
            self._n += 1
            if self._n == (2 if device == "laser" else 6):
                raise what

        def take(self, timeout_s):
            self.__call_()
            return self._inner.take(timeout_s)

        def move_to(self, angle_deg, timeout_s):
            self.__call_()
            return self._inner.move_to(angle_deg, timeout_s)

        def on(self):
            self._inner.on()
            self.__call_()

    def wrap(rig):
        return replace(rig, **{device: Broken(getattr(rig, device))})

    plan = TARGETS + AXIS + STEPPED
    with pytest.raises(type(what)):
        start(tmp_path / "s", plan, wrap=wrap)
    assert len(rows(tmp_path / "s/axis")) == 5
    start(tmp_path / "s", plan)
    start(tmp_path / "whole", plan)
    assert content(tmp_path / "s") == content(tmp_path / "whole")


def test_an_error_hides_no_other(tmp_path):
    """The camera is gone, and then the laser cannot be switched off: both are said, and the table stands."""

    class Stuck:
        is_on = True

        def __init__(self, inner):
            self._inner, self.fails = inner, True

        def __getattr__(self, name):
            return getattr(self._inner, name)

        def off(self):
            self._inner.off()
            if world.counts["frames"] >= 3:
                raise DeviceTimeoutError("the laser does not answer.")

    world, heard = small_world(Faults(camera_gone_at_frames=frozenset({3}))), Heard()
    with pytest.raises(DeviceConnectionError, match="it is gone"):
        start(tmp_path / "s", TARGETS + AXIS, world, heard=heard, wrap=lambda rig: replace(rig, laser=Stuck(rig.laser)))
    assert heard.warnings == ["the laser does not answer."]


def test_a_second_acquisition_on_the_same_folder_is_refused(tmp_path):
    held = acquired_session.AcquiredSession(tmp_path / "s", PLAN, "rig")
    with held, pytest.raises(OutputError, match="another `rotaline acquire` writes this session"):
        start(tmp_path / "s", PLAN)
    start(tmp_path / "s", PLAN)


def test_a_camera_with_another_size_is_refused(tmp_path):
    with pytest.raises(DeviceConnectionError):
        start(tmp_path / "s", PLAN, small_world(Faults(camera_gone_at_frames=frozenset({4}))))

    class Smaller:
        def __init__(self, camera):
            self._camera = camera

        def __getattr__(self, name):
            return getattr(self._camera, name)

        def take(self, timeout_s):
            frame = self._camera.take(timeout_s)
            return replace(frame, image=frame.image[::2, ::2].copy())

    with pytest.raises(
        DeviceStateError, match="frames are 32 x 24 px, 8 bit, grey; the session was begun with 64 x 48 px, 8 bit, grey"
    ):
        start(tmp_path / "s", PLAN, wrap=lambda rig: replace(rig, camera=Smaller(rig.camera)))


def test_the_gain_is_that_of_the_first_start(tmp_path):
    def louder(rig):
        rig.camera.configure(replace(rig.camera.settings, gain=4.0))
        return rig

    with pytest.raises(DeviceConnectionError):
        start(tmp_path / "s", PLAN, small_world(Faults(camera_gone_at_frames=frozenset({4}))))
    start(tmp_path / "s", PLAN, wrap=louder)
    assert {row["gain"] for folder in ("axis", "ball") for row in rows(tmp_path / "s" / folder)} == {"1"}


# where the table finds its angle 0


class NoReference:
    """A table that calls the present place 0 when it is homed."""

    def __init__(self, table, angle=None):
        self._table, self._angle, self.homed = table, angle, 0
        self.info = replace(table.info, has_reference=False)

    def __getattr__(self, name):
        return getattr(self._table, name)

    def home(self, timeout_s):
        self.homed += 1

    def angle_deg(self):
        if self._angle is not None:
            raise self._angle
        return self._table.angle_deg()


def with_table(tables, **options):
    def wrap(rig):
        tables.append(NoReference(rig.turntable, **options))
        return replace(rig, turntable=tables[-1])

    return wrap


def test_a_table_without_a_reference_is_not_homed_once_there_are_angles(tmp_path):
    world, told = small_world(Faults(camera_gone_at_frames=frozenset({4}))), []

    class Hears(SimulatedPerson):
        def place(self, capture, n_done):
            told.append(capture.text)
            super().place(capture, n_done)

    tables = []
    with pytest.raises(DeviceConnectionError):
        start(tmp_path / "s", PLAN, world, wrap=with_table(tables))
    assert tables[0].homed == 1
    start(tmp_path / "s", PLAN, world, wrap=with_table(tables), person=Hears(world))
    assert tables[1].homed == 0
    assert told[0].startswith(
        "Place checkerboard. The turntable has no reference: it says 15.000 deg, and has to stand where it stood"
    )
    assert "end here (Ctrl-C) and acquire into another folder" in told[0]
    assert told[1] is None  # asked once


def test_a_table_that_has_lost_its_angle_ends_a_session_with_angles(tmp_path):
    world = small_world(Faults(camera_gone_at_frames=frozenset({4})))
    with pytest.raises(DeviceConnectionError):
        start(tmp_path / "s", PLAN, world, wrap=with_table([]))
    lost = with_table([], angle=DeviceStateError("gcode table: not homed. Home it, then go on."))
    with pytest.raises(
        DeviceStateError,
        match="session has 3 frames with angles that count from a 0 which this table cannot find again",
    ):
        start(tmp_path / "s", PLAN, world, wrap=lost)
    # a session without angles yet: it is homed, as at first
    start(tmp_path / "new", PLAN, world, wrap=lost)


def test_the_table_is_homed_once_and_only_if_something_turns(tmp_path):
    world = small_world()
    start(tmp_path / "posed", TARGETS + CAMERA + LASER, world)
    assert world.counts["moves"] == 0
    tables = []
    start(tmp_path / "s", PLAN, wrap=with_table(tables))
    assert tables[0].homed == 1
    tables = []
    start(tmp_path / "kept", "home = false\n" + PLAN, wrap=with_table(tables))
    assert tables[0].homed == 0


# what a rig cannot do is said before anything moves


@pytest.mark.parametrize(
    ("plan", "rig", "said"),
    [
        (AXIS, {"turntable": None}, "capture 'axis': role 'axis' needs a turntable; the rig file has no [turntable]."),
        (BALL, {"laser": None}, "capture 'ball': role 'scan' needs a laser; the rig file has no [laser]."),
        (BALL.replace("10000.0", "2e7"), {}, "exposure_on_us gives 2e+07 us; simulated camera allows 1 to 1e+07 us."),
        (LASER.replace("2.0]", "2000.0]"), {}, "exposure_on_us gives 2e+07 us"),
        (AXIS + "gain = 99.0", {}, "gain is 99; simulated camera allows 0.125 to 16 x."),
    ],
)
def test_a_plan_that_the_rig_cannot_carry_out_is_refused(tmp_path, plan, rig, said):
    world = small_world()
    with pytest.raises(RigError) as error:
        start(tmp_path / "s", TARGETS + plan, world, wrap=lambda whole: replace(whole, **rig))
    assert said in str(error.value)
    assert str(error.value).startswith("plan.toml, capture ")
    assert not (tmp_path / "s").exists()
    assert world.counts["moves"] == 0


def test_limits_and_speeds_of_a_table_are_asked_before_anything_moves(tmp_path):
    world = small_world()
    with pytest.raises(RigError, match="angles 0 to 315 deg; simulated turntable allows -10 to 300 deg"):
        start(tmp_path / "s", TARGETS + BALL, world, table={"limits_deg": (-10.0, 300.0)})
    with pytest.raises(RigError, match="speed_deg_s is 50; simulated turntable turns at up to 30 deg/s"):
        start(tmp_path / "s", TARGETS + small.TURNING.replace("25.0", "50.0"), world)

    def fixed(rig):
        return replace(rig, turntable=NoReference(rig.turntable), laser=Fixed(rig.laser))

    class Fixed:
        def __init__(self, laser):
            self._laser, self.info = laser, replace(laser.info, can_set_power=False)

        def __getattr__(self, name):
            return getattr(self._laser, name)

    with pytest.raises(RigError, match=r"laser_power is 0\.5; the power of simulated laser cannot be set"):
        start(tmp_path / "s", TARGETS + BALL + "laser_power = 0.5", world, wrap=fixed)
    assert not (tmp_path / "s").exists()


def test_cameras_without_gain_refuse_one(tmp_path):
    class Plain:
        def __init__(self, camera):
            self._camera = camera
            self.info = CameraInfo("plain", (64, 48), (1.0, 1e6))
            self.settings = replace(camera.settings, gain=None)

        def __getattr__(self, name):
            return getattr(self._camera, name)

    with pytest.raises(RigError, match="gain is 2; the gain of plain cannot be set"):
        start(tmp_path / "s", TARGETS + AXIS + "gain = 2.0", wrap=lambda rig: replace(rig, camera=Plain(rig.camera)))


def test_a_capture_that_the_simulated_rig_does_not_have_is_named(tmp_path):
    with pytest.raises(RigError, match="capture 'balls': the simulated rig has no capture of this name"):
        start(tmp_path / "s", TARGETS + BALL.replace('"ball"', '"balls"'))
    with pytest.raises(RigError, match="30 poses; the simulated rig has"):
        start(tmp_path / "t", TARGETS + CAMERA.replace("poses = 3", "poses = 30"))
    assert not list(tmp_path.iterdir()), "it was refused before anything was begun"
