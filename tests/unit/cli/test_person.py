"""The person at the terminal: a script holds plates of the simulated rig before its camera, and reads what the screen says."""

import contextlib
import io
import os
import pty
import re
import sys
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from rich.text import Text

from rotaline.cli.acquisition_screen import AcquisitionScreen, ask, placing, summary
from rotaline.cli.person import TerminalPerson, keyboard, require_person
from rotaline.errors import DeviceStateError, RigError
from rotaline.hardware.clock import VirtualClock
from rotaline.hardware.connections import Connections
from rotaline.hardware.rig import open_rig
from rotaline.hardware.simulated.world import SimulatedWorld
from rotaline.io.device_file import SIMULATED_RIG, parse_device_file
from rotaline.io.plan_file import parse_plan
from rotaline.pipeline.acquire.acquire import Acquired, acquire
from rotaline.pipeline.acquire.guidance import lit_preview
from rotaline.pipeline.acquire.taking import FrameTaken
from rotaline.simulation.plan import CapturePlan, SessionPlan, laser_off
from rotaline.simulation.rig import build_rig
from rotaline.simulation.small_session import small_plan
from rotaline.vision.targets.model import Checkerboard

TARGETS = """version = 1
[targets.board]
kind = "checkerboard"
inner_corners = [10, 7]
pitch = 5.0
[targets.dots]
kind = "dots"
dots = [9, 9]
pitch = 6.0
diameter = 3.0
"""
CAMERA = '[[captures]]\nfolder = "camera"\nrole = "camera"\ntarget = "board"\nposes = 2\n'
LASER = '[[captures]]\nfolder = "laser"\nrole = "laser-plane"\ntarget = "dots"\nposes = 2\n'
BALL = '[[captures]]\nfolder = "ball"\nrole = "scan"\nframes = 4\nexposure_on_us = 10000.0\n'


def plan_of(*captures):
    return parse_plan(TARGETS + "".join(captures), "plan.toml")


def plate_poses(rig):
    """0: tilted; 1 to 5: the same, pushed on a little each; 6: half out of the picture; 7: tilted to another side."""
    from tests.unit.pipeline.test_guidance import held

    board = Checkerboard((10, 7), 5.0)
    pushed = [held(board, "upper", 25.0, at=(0.5 + shift, 0.5)) for shift in np.linspace(0.0, 0.02, 6)]
    return [*pushed, held(board, at=(0.97, 0.5)), held(board, "left", 25.0)]


class MovingClock(VirtualClock):
    """What a hand does goes on while somebody waits."""

    def __init__(self):
        super().__init__()
        self.move = lambda: None

    def wait(self, seconds):
        for _ in range(5):
            super().wait(seconds / 5)
            self.move()


class NoKeys:
    def enter_pressed(self):
        return False


class Bench:
    """The simulated rig, a terminal that is read, and hands that follow a script."""

    def __init__(self, folder, *captures):
        self.rig_model = build_rig((480, 360))
        self.clock = MovingClock()
        held = small_plan(self.rig_model, captures=("laser", "ball"))
        shots = tuple(laser_off(self.rig_model, held=(plate,)) for plate in plate_poses(self.rig_model))
        camera = CapturePlan("camera", "camera", "board", shots)
        self.world = SimulatedWorld(self.rig_model, SessionPlan(held.targets, (camera, *held.captures)), self.clock)
        connections = Connections()
        connections.provide("world", self.world)
        text = SIMULATED_RIG.replace("[turntable]", "readout_ms = 0.1\n[turntable]")
        file = parse_device_file(text, "rig.toml", folder)
        self.rig = open_rig(file.devices, self.clock, connections)
        self.out, self.plan = folder / "session", plan_of(*captures)
        self.screen = WatchedScreen(self.clock.now_s)

    def take(self, script, keys=NoKeys):
        person = Hands(self, script, keys)
        with self.rig:
            return acquire(self.plan, SIMULATED_RIG, self.rig, self.out, person, self.screen, self.screen.watch)

    @property
    def said(self):
        """What was advised, without repeats."""
        texts = [screen.advice.text for screen in self.screen.shown]
        return [b for a, b in zip(["", *texts], texts, strict=False) if a != b]


class WatchedScreen(AcquisitionScreen):
    """A screen whose pictures are kept."""

    def __init__(self, clock_s=None):
        console = Console(file=io.StringIO(), force_terminal=True, width=80, height=24, color_system=None)
        super().__init__(1, console, clock_s or VirtualClock().now_s)
        self.shown = []

    @contextlib.contextmanager
    def showing(self):
        yield self.shown.append

    def ask(self, text):
        return ""

    @property
    def text(self):
        return self.console.file.getvalue()


class Hands(TerminalPerson):
    """Before each preview of a pose, the next thing of the script happens."""

    def __init__(self, bench, script, keys):
        self.bench, self.script = bench, script
        super().__init__(
            bench.plan.tables,
            bench.out,
            bench.screen,
            lit_preview(bench.rig),
            keys=lambda: contextlib.nullcontext(keys()),
        )

    def place(self, capture, n_done):
        self.bench.world.set_up(capture.folder)
        super().place(capture, n_done)

    def pose(self, capture, index, preview):
        steps = iter(self.script[capture.folder][index])

        def next_preview():
            self.bench.clock.wait(0.6)
            next(steps, lambda: None)()
            return preview()

        super().pose(capture, index, next_preview)

    def aside(self, name):
        return self.bench.world.aside(name)


def test_the_advice_names_what_is_wrong_until_the_pose_is_good_and_still(tmp_path):
    bench = Bench(tmp_path, CAMERA.replace("poses", "exposure_off_us = 12000.0\nposes"))
    world, clock = bench.world, bench.clock
    full_light = bench.rig_model

    def hold(pose):
        return lambda: world.hold(pose)

    def darken():
        world.rig = replace(full_light, sensor=replace(full_light.sensor, gain=0.1 * full_light.sensor.gain))

    def push():
        """Push the plate on during the exposure, in full light again."""
        world.rig = full_light
        pushed = iter([1, 2, 3, 4, 5])
        clock.move = lambda: world.hold(next(pushed, 5))

    def stop():
        clock.move = lambda: None

    first = [hold(None), hold(6), hold(0), darken, push, stop]
    result = bench.take({"camera": [first, [hold(0), hold(7)]]})
    assert result.n_frames == 2
    expected = ["No checkerboard", "show all of it", "Good", "Dark", "Blurred", "Good", "It is taken"]
    said = bench.said[: len(expected)]
    assert [start in text for start, text in zip(expected, said, strict=True)] == [True] * len(expected), said
    assert "like pose 1" in bench.said[len(expected)]
    assert bench.said[-1] == "It is taken."
    assert "Pose 1 of 2 is taken: 70 of 70 points, tilted by 25 deg, upper edge nearer." in bench.screen.text
    assert "left edge nearer" in bench.screen.text


def test_enter_takes_it_at_once_and_what_is_no_use_is_refused_with_the_reason(tmp_path):
    class Enter:
        def enter_pressed(self):
            return True

    bench = Bench(tmp_path, CAMERA)
    tries = iter([None, 0, 7])

    class Impatient(list):
        def __getitem__(self, index):
            return [lambda: bench.world.hold(next(tries))]

    result = bench.take({"camera": Impatient()}, Enter)
    assert result.n_frames == 2
    assert len(bench.screen.shown) == 3  # of which the first was refused
    assert "Pose 1: the target is not found in the frame." in " ".join(bench.screen.text.split())


def test_the_stripe_has_to_run_over_the_plate(tmp_path):
    bench = Bench(tmp_path, LASER)
    world = bench.world
    lit = []

    class Beside(Hands):
        """The first time that the laser is on for a moment, the plate stands beside its light."""

        def _crossed(self, capture, seen, off):
            lit.append(super()._crossed(capture, seen, off))
            return lit[-1] and len(lit) > 1

    script = {"laser": [[lambda: world.hold(0)] * 4 + [lambda: world.hold(2)], [lambda: world.hold(3)]]}
    person = Beside(bench, script, NoKeys)
    with bench.rig:
        acquire(bench.plan, SIMULATED_RIG, bench.rig, bench.out, person, bench.screen, bench.screen.watch)
        assert not bench.rig.laser.is_on
    assert lit == [True] * 3
    assert any("stripe does not run over it" in text for text in bench.said)
    guide = bench.screen.shown[-1].guide
    assert guide.views[0].stripe_uv.shape[0] > 50
    assert "stripe seen" in _shown(bench.screen.shown[-1])


def test_a_plate_that_moves_while_the_laser_is_on_is_taken_again(tmp_path):
    bench = Bench(tmp_path, LASER)
    world, moved = bench.world, []

    class Pushed(Hands):
        """The first time that a pose has been taken, the plate does not stand where it stood in the first frame."""

        def judge(self, capture, index, frame, preview):
            if not moved:
                moved.append(world.hold(2))
            return super().judge(capture, index, frame, preview)

    class Script(list):
        def __getitem__(self, index):
            return [lambda: world.hold(3 if index else 0)]

    person = Pushed(bench, {"laser": Script()}, NoKeys)
    with bench.rig:
        result = acquire(bench.plan, SIMULATED_RIG, bench.rig, bench.out, person, bench.screen, bench.screen.watch)
    assert result.n_frames == 4
    said = " ".join(bench.screen.text.split())
    assert re.search(
        r"Pose 1: the target moved by \d+\.\d px between .* up to 0.4 px are good. .* It is taken again.", said
    )
    assert said.count("is taken again") == 1
    assert "Pose 2 of 2 is taken" in said


def test_poses_of_an_earlier_start_are_on_the_map(tmp_path):
    bench = Bench(tmp_path, CAMERA)
    world = bench.world

    def interrupted():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        bench.take({"camera": [[lambda: world.hold(0)], [interrupted]]})
    again = Bench(tmp_path, CAMERA)
    again.take({"camera": [[], [lambda: again.world.hold(0), lambda: again.world.hold(7)]]})
    assert len(again.screen.shown[0].guide.views) == 1
    assert "like pose 1" in again.said[0]
    assert "1 of 2 frames are there already; it goes on with the next pose." in again.screen.text


def _shown(screen, width=80, height=24):
    console = Console(file=io.StringIO(), force_terminal=True, width=width, height=height, color_system=None)
    console.print(screen)
    return console.file.getvalue()


@pytest.fixture(scope="module")
def pose_screen(tmp_path_factory):
    bench = Bench(tmp_path_factory.mktemp("pose"), CAMERA)
    bench.take({"camera": [[lambda: bench.world.hold(0)], [lambda: bench.world.hold(7)]]})
    return bench.screen.shown[-2]


@pytest.mark.parametrize(("width", "height"), [(80, 24), (100, 40), (200, 60), (50, 40)])
def test_a_pose_fits_into_the_terminal_with_all_that_counts(pose_screen, width, height):
    text = _shown(pose_screen, width, height)
    lines = text.splitlines()
    assert max(len(line) for line in lines) <= width
    assert len(lines) < height
    for part in (
        "pose 2 of 2",
        "found, 70 of 70 points",
        "left edge nearer",
        "measured",
        "upper ●",
        "Wanted:",
        "Enter",
    ):
        assert part in text, part
    assert ("▀" in text) == (width >= 80)


@pytest.mark.parametrize(
    ("width", "height", "parts"),
    [
        (80, 20, ("found, 70 of 70 points", "left edge nearer", "upper ●", "right ", "what was taken is kept")),
        (60, 20, ("found, 70 of 70 points", "left edge nearer", "upper ●", "right ", "Ctrl-C: end ─")),
        (60, 30, ("found, 70 of 70 points", "measured", "Ctrl-C: end ─")),
        (40, 12, ("found, 70 of 70 points", "left edge nearer", "Ctrl-C: end ─")),
        (40, 8, ("Ctrl-C: end ─",)),
    ],
)
def test_a_small_terminal_shows_the_parts_that_count_most(pose_screen, width, height, parts):
    text = _shown(pose_screen, width, height)
    lines = text.splitlines()
    assert max(len(line) for line in lines) <= width
    assert len(lines) < height
    for part in ("Good: hold it still", "Wanted: ", "camera.", *parts):
        assert part in text, part


def test_a_pose_fits_however_many_poses_are_tilted(pose_screen):
    views = pose_screen.guide.views
    for n_poses in (20, 30):
        guide = replace(pose_screen.guide, n_poses=n_poses, views=views * 9)
        text = _shown(replace(pose_screen, guide=guide))
        assert "▀" in text
        assert len(text.splitlines()) < 24
        assert f"upper {'●' * (n_poses // 10)}" in text
    assert "upper 9/10" in _shown(replace(pose_screen, guide=replace(guide, n_poses=100)))


def _taken(k, n=90, level=200, n_retaken=0):
    image = np.zeros((60, 80), np.uint8)
    image[:, 40] = level
    capture = plan_of(BALL).tables.captures[0]
    return FrameTaken(capture, k, n, image, 4.0 * k, True, 8200.0, 3, n_retaken)


def test_progress_says_where_it_is_how_bright_and_how_long_it_takes():
    clock = VirtualClock()
    screen = WatchedScreen(clock.now_s)
    with screen.work("ball", 90) as count:
        for _ in range(30):  # an earlier start has taken them
            count()
        for k in range(31, 41):
            clock.wait(2.0)
            count()
            screen.watch(_taken(k, n_retaken=2))
        text = _shown(screen.picture())
    for part in (
        "frame 40 of 90",
        "0:01:40 left",
        "angle 160.000 deg",
        "exposure 8.20 ms",
        "stripe 78 %",
        "for the disk 3",
        "taken again 2",
    ):
        assert part in text, part
    assert max(len(line) for line in text.splitlines()) <= 80
    with screen.work("ball", 90):
        screen.watch(_taken(31, level=255))
        assert "stripe saturated" in _shown(screen.picture())
        assert "left" not in _shown(screen.picture())
    assert _shown(screen.picture()).strip() == ""


def test_what_to_place_is_said_with_what_is_there_already():
    ball = plan_of(BALL).tables.captures[0]
    text = " ".join(_shown(placing(ball, 3, 4)).replace("│", " ").split())
    assert "Place ball on the table" in text
    assert "3 of 4 frames are there already: it must stand as it stood." in text
    assert "turns from 0 to 270 deg, 4 angles. The laser goes on: do not look into it." in text
    own = ball.model_copy(update={"text": "Put the [ball] 5 mm off centre."})
    assert "Put the [ball] 5 mm off centre." in _shown(placing(own, 0, 4))
    camera, laser = plan_of(CAMERA, LASER).tables.captures
    assert "2 poses follow" in _shown(placing(camera, 0, 2))
    assert "do not look into it" in _shown(placing(laser, 0, 4))


def test_the_summary_counts_what_is_in_the_folder(tmp_path):
    bench = Bench(tmp_path, BALL)
    result = bench.take({})
    text = _shown(summary(replace(result, n_retaken=1, n_before=2), bench.plan.tables, 65.0))
    for part in (
        "ball",
        "scan",
        "0.00 to 270.00 deg",
        "laser on 10.00 ms",
        "4 frames in 0:01:05, 2 of them by an earlier start, 1 taken again.",
    ):
        assert part in text, part
    assert "frame 4 of 4" not in text
    assert isinstance(result, Acquired)


def test_an_image_that_was_lost_and_taken_again_counts_once(tmp_path):
    Bench(tmp_path, BALL).take({})
    (tmp_path / "session/ball/0001.png").unlink()
    bench = Bench(tmp_path, BALL)
    result = bench.take({})
    assert len((tmp_path / "session/ball/frames.csv").read_text().splitlines()) == 1 + 5
    text = _shown(summary(result, bench.plan.tables, 65.0))
    assert re.search(r"ball +scan +4 ", text), text
    assert "4 frames in 0:01:05, 3 of them by an earlier start." in text


# the terminal itself


def test_without_a_terminal_a_plan_that_needs_a_person_is_refused_before_anything_is_asked(tmp_path):
    with pytest.raises(RigError, match=r"poses to be placed by a person \(capture camera, laser\).*no terminal"):
        TerminalPerson(plan_of(CAMERA, LASER, BALL).tables, tmp_path, WatchedScreen(), keys=None)
    with pytest.raises(RigError, match="2 captures, between which a person changes"):
        require_person(plan_of(BALL, BALL.replace("ball", "rod")).tables)
    screen = WatchedScreen()
    person = TerminalPerson(plan_of(BALL).tables, tmp_path, screen, keys=None)
    person.place(plan_of(BALL).tables.captures[0], 0)
    assert "Place ball" in screen.text


def test_standard_input_that_is_no_terminal_is_noticed(monkeypatch, tmp_path):
    monkeypatch.setattr(sys, "stdin", io.StringIO())
    with pytest.raises(RigError, match="no terminal"):
        TerminalPerson(plan_of(CAMERA).tables, tmp_path, WatchedScreen())
    with pytest.raises(DeviceStateError, match="no terminal"):
        ask("Stands it?")


def test_enter_is_seen_without_waiting_for_it_and_the_terminal_is_left_as_it_was():
    import termios

    outer, inner = pty.openpty()
    try:
        before = termios.tcgetattr(inner)
        with keyboard(inner) as keys:
            assert not keys.enter_pressed()
            os.write(outer, b"x")
            _arrived(inner)
            assert not keys.enter_pressed()
            os.write(outer, b"\r")
            _arrived(inner)
            assert keys.enter_pressed()
            assert not keys.enter_pressed()
        assert termios.tcgetattr(inner) == before
    finally:
        os.close(outer)
        os.close(inner)


def _arrived(file):
    import select

    assert select.select([file], [], [], 10.0)[0]


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_one_picture_lives_at_a_time_and_stands_still_while_somebody_is_asked(monkeypatch):
    console = Console(file=io.StringIO(), force_terminal=True, width=80, height=24)
    screen = AcquisitionScreen(1, console)
    with screen.work("camera", 3) as count:
        count()
        with screen.showing() as show:
            show(Text("now this"))
            assert "now this" in console.file.getvalue()

            def answer(text):
                begun = len(console.file.getvalue())
                console.print(text)
                assert console.file.getvalue()[begun:] == "Does it stand? \n"  # and no picture drawn anew
                return "yes"

            monkeypatch.setattr("builtins.input", answer)
            monkeypatch.setattr(sys, "stdin", Terminal())
            assert screen.ask("Does it stand?") == "yes"
        screen.note("a note")
    assert "a note" in console.file.getvalue()
