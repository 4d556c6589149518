"""Checks of a rig find what was planted: in a camera, a laser and a turntable of a few lines each."""

import json
import math
from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rotaline.errors import DeviceLimitError, DeviceStateError, LostFrameError
from rotaline.hardware.camera import CameraFrame, CameraInfo, CameraSettings, Region
from rotaline.hardware.clock import VirtualClock
from rotaline.hardware.connections import Connections
from rotaline.hardware.laser import LaserInfo
from rotaline.hardware.rig import OpenRig
from rotaline.hardware.turntable import TurntableInfo
from rotaline.io.rig_check_file import write_rig_check
from rotaline.pipeline.rig_check.check import check_rig

WIDTH, HEIGHT = 256, 160
PX_PER_DEG = 3.0
STRIPE_SIGMA_PX = 1.4
FRAME_S = 0.012
NAMES = {
    "camera": {
        "frame",
        "exposure",
        "time",
        "noise",
        "steadiness",
        "grey values",
        "focus",
        "change of exposure",
        "stream",
        "lost frames",
    },
    "laser": {"exposure", "stripe", "ends", "switching on", "switching off"},
    "turntable": {"home", "angle", "movement", "settling", "return", "small moves", "play", "turning"},
}


def texture(blur_px=0.9):
    """Blocks of grey, periodic, as the spectrum that shifts them by any part of a pixel."""
    rng = np.random.default_rng(4)
    blocks = np.kron(rng.integers(0, 2, (HEIGHT // 16, WIDTH // 16)), np.ones((16, 16)))
    return np.fft.rfft(gaussian_filter(0.1 + 0.7 * blocks, blur_px, mode="wrap"), axis=1)


@dataclass
class World:
    """What is planted, and how things stand.

    ``ring_px``: the scene swings after a move, dying away with ``ring_s``; ``lag_s``: light comes and goes so much after the command.
    """

    blur_px: float = 0.9
    noise: float = 0.006
    flicker: float = 0.0
    frozen: bool = False
    late_exposure: bool = False
    automatic: bool = False
    lost: frozenset[int] = frozenset()
    stream_gap: int = 0
    slow_s: float = 0.0
    dead_laser: bool = False
    stuck_laser: bool = False
    out_of_view: bool = False
    lag_s: float = 0.0
    interrupt_at: int | None = None
    stands: bool = False
    reports_off_deg: float = 0.0
    scatter_deg: float = 0.0
    play_deg: float = 0.0
    ring_px: float = 0.0
    ring_s: float = 0.15
    speed_factor: float = 1.0
    u_angle_deg: float = 0.02
    limits_deg: tuple[float, float] | None = None
    clock: VirtualClock = field(default_factory=VirtualClock)

    def __post_init__(self):
        self.rng = np.random.default_rng(7)
        self.texture = texture(self.blur_px)
        self.lights = [(-1e9, self.stuck_laser)]
        self.angle, self.true_angle, self.moved_s = 0.0, 0.0, -1e9
        self.turning = None
        self.visited = []

    def lit(self, begin_s, end_s):
        """Share of an exposure during which the laser shines."""
        times = np.linspace(begin_s, end_s, 40)
        return float(np.mean([next(on for t, on in reversed(self.lights) if t <= at) for at in times]))

    def switch(self, on):
        if not (self.dead_laser or self.stuck_laser):
            self.lights.append((self.clock.now_s() + self.lag_s, on))

    def image(self, middle_s, exposure_us, number):
        after = middle_s - self.moved_s
        ring = self.ring_px * math.exp(-after / self.ring_s) * math.cos(40.0 * after)
        shift = (0.0 if self.stands else PX_PER_DEG * self.true_angle) + ring
        phase = np.exp(-2j * np.pi * np.fft.rfftfreq(WIDTH) * shift)
        scene = np.fft.irfft(self.texture * phase, n=WIDTH, axis=1)
        lit = self.lit(middle_s - exposure_us * 0.5e-6, middle_s + exposure_us * 0.5e-6)
        u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
        stripe = 4.0 * lit * np.exp(-0.5 * ((u - 100.0 - 0.2 * v) / STRIPE_SIGMA_PX) ** 2)
        if self.out_of_view:  # only what it scatters into the room is seen
            stripe = 0.2 * lit
        light = 1.0 + self.flicker * math.sin(1.7 * number)
        value = (light * scene + stripe) * exposure_us / 10_000.0
        return value + self.noise * (0 if self.frozen else self.rng.normal(size=value.shape))


class Camera:
    def __init__(self, world):
        self.world, self.number, self.streams = world, 0, False
        self.info = CameraInfo("test camera", (WIDTH, HEIGHT), (50.0, 1e6))
        self.exposed_us = 5_000.0
        self.settings = CameraSettings(5_000.0, None, Region(0, 0, WIDTH, HEIGHT))

    def configure(self, settings):
        self.settings = settings
        return settings

    def take(self, timeout_s):
        self.number += 1
        if self.number == self.world.interrupt_at:
            raise KeyboardInterrupt
        begun_s, exposure_s = self.world.clock.now_s(), self.settings.exposure_us * 1e-6
        self.world.clock.wait(exposure_s + FRAME_S + self.world.slow_s)
        if self.number in self.world.lost:
            raise LostFrameError(f"test camera: frame {self.number} did not arrive.")
        middle_s = begun_s + exposure_s / 2
        old, self.exposed_us = self.exposed_us, self.settings.exposure_us
        exposure_us = (
            5_000.0 if self.world.automatic else old if self.world.late_exposure else self.settings.exposure_us
        )
        value = self.world.image(middle_s, exposure_us, self.number)
        image = np.clip(np.rint(255 * value), 0, 255).astype(np.uint8)
        return CameraFrame(image, self.number, middle_s, 0.0, self.settings)

    def start(self):
        self.streams = True

    def next_frame(self, timeout_s):
        self.number += self.world.stream_gap
        return self.take(timeout_s)

    def stop(self):
        self.streams = False

    def close(self):
        pass


class Table:
    def __init__(self, world):
        self.world = world
        self.info = TurntableInfo("test table", world.limits_deg, 0.01, world.u_angle_deg, 40.0)

    def home(self, timeout_s):
        self.world.angle = self.world.true_angle = 0.0

    def move_to(self, angle_deg, timeout_s):
        world = self.world
        if world.limits_deg and not world.limits_deg[0] <= angle_deg <= world.limits_deg[1]:
            raise DeviceLimitError(f"test table: {angle_deg} deg is outside of its limits.")
        world.clock.wait(0.2)
        play = math.copysign(world.play_deg / 2, angle_deg - world.angle)
        world.true_angle = angle_deg - play + world.scatter_deg * world.rng.normal()
        world.angle, world.moved_s = angle_deg, world.clock.now_s()
        world.visited.append(angle_deg)
        return angle_deg + world.reports_off_deg

    def angle_deg(self):
        if self.world.turning is None:
            return self.world.angle
        since_s, speed = self.world.turning
        return self.world.angle + speed * self.world.speed_factor * (self.world.clock.now_s() - since_s)

    def turn(self, speed_deg_s):
        self.world.turning = (self.world.clock.now_s(), speed_deg_s)

    def stop(self, timeout_s):
        self.world.angle = self.angle_deg()
        self.world.turning = None

    def close(self):
        pass


class Laser:
    def __init__(self, world):
        self.world, self.is_on = world, False
        self.info = LaserInfo("test laser", switching_s=0.001)

    def on(self):
        self.is_on = True
        self.world.switch(True)
        self.world.clock.wait(0.001)

    def off(self):
        self.is_on = False
        self.world.switch(False)
        self.world.clock.wait(0.001)

    def set_power(self, fraction):
        raise DeviceStateError("test laser: its power cannot be set.")

    def close(self):
        self.off()


def checked(laser=True, table=True, **planted):
    world = World(**planted)
    rig = OpenRig(
        Camera(world), Table(world) if table else None, Laser(world) if laser else None, world.clock, Connections()
    )
    said = []
    check = check_rig(rig, said.append)
    assert not (laser and rig.laser.is_on)
    assert world.turning is None
    assert [x for x in said if not isinstance(x, str)] == list(check.lines)
    return check, world


def line(check, device, name):
    (found,) = [x for x in check.lines if (x.device, x.name) == (device, name)]
    return found


@pytest.fixture(scope="module")
def good():
    return checked()


def test_a_good_rig_is_all_right_and_everything_has_been_looked_at(good):
    check, _ = good
    assert [x.text + x.mend for x in check.lines if x.level != "ok"] == []
    assert check.level == "ok"
    assert not check.broken
    assert check.left_out == ()
    for device, names in NAMES.items():
        assert {x.name for x in check.lines if x.device == device} == names
    assert check.recommended["settle_s"] == 0.0


def test_figures_are_those_of_the_rig(good):
    check, world = good
    assert line(check, "camera", "noise").values["share"] == pytest.approx(world.noise, rel=0.1)
    assert line(check, "camera", "focus").values["blur_px"] == pytest.approx(world.blur_px, rel=0.15)
    assert line(check, "camera", "time").values["overhead_s"] == pytest.approx(FRAME_S)
    assert line(check, "laser", "stripe").values["width_px"] == pytest.approx(STRIPE_SIGMA_PX, rel=0.1)
    assert line(check, "turntable", "movement").values["px"] == pytest.approx(PX_PER_DEG, rel=0.02)
    assert line(check, "turntable", "small moves").values["move_s"] == pytest.approx(0.2)
    assert line(check, "turntable", "return").values["deg"] < 0.01
    assert abs(line(check, "turntable", "play").values["deg"]) < 0.01
    stripe = line(check, "laser", "stripe").values
    assert (stripe["u_from_px"], stripe["u_to_px"]) == pytest.approx((100.0, 100.0 + 0.2 * HEIGHT), abs=3.0)


FAULTS = [
    ({"blur_px": 2.4}, "camera", "focus", "doubtful", "Focus"),
    ({"blur_px": 0.0}, "camera", "focus", "doubtful", "sharpening"),
    ({"blur_px": 5.0}, "camera", "focus", "fails", "Focus"),
    ({"noise": 0.05}, "camera", "noise", "doubtful", "gain"),
    ({"late_exposure": True}, "camera", "change of exposure", "fails", "settle_frames"),
    ({"automatic": True}, "camera", "change of exposure", "fails", "automatic"),
    ({"frozen": True}, "camera", "noise", "fails", "old frame"),
    ({"flicker": 0.05}, "camera", "steadiness", "doubtful", "8.33 ms"),
    ({"slow_s": 0.7}, "camera", "time", "doubtful", "faster"),
    ({"out_of_view": True}, "laser", "stripe", "fails", "pale"),
    ({"lost": frozenset({3, 9})}, "camera", "lost frames", "doubtful", "cable"),
    ({"stream_gap": 1}, "camera", "stream", "doubtful", "cable"),
    ({"dead_laser": True}, "laser", "stripe", "fails", "power"),
    ({"stuck_laser": True}, "laser", "ends", "fails", "it shines"),
    ({"lag_s": 0.09}, "laser", "switching on", "fails", "switching time"),
    ({"stands": True}, "turntable", "movement", "fails", "plate"),
    ({"reports_off_deg": 0.4}, "turntable", "angle", "doubtful", "steps a degree"),
    ({"scatter_deg": 0.2}, "turntable", "return", "doubtful", "u_angle_deg"),
    ({"play_deg": 0.3}, "turntable", "play", "doubtful", "same side"),
    ({"ring_px": 3.0, "ring_s": 30.0}, "turntable", "settling", "fails", "Fasten"),
    ({"speed_factor": 0.9}, "turntable", "turning", "doubtful", "step and shoot"),
    ({"speed_factor": 0.0}, "turntable", "turning", "fails", "step and shoot"),
]


@pytest.mark.parametrize(("planted", "device", "name", "level", "mend"), FAULTS, ids=lambda x: str(x)[:40])
def test_what_is_wrong_is_named_with_what_to_do(planted, device, name, level, mend):
    keep = {"laser": device == "laser", "table": device == "turntable"}
    check, _ = checked(**keep, **planted)
    found = line(check, device, name)
    assert found.level == level, found
    assert mend in found.mend
    assert check.level in (level, "fails")
    assert not check.broken


def test_the_scatter_of_returns_is_recovered_within_its_uncertainty():
    for scatter in (0.03, 0.2):
        found = line(checked(laser=False, scatter_deg=scatter)[0], "turntable", "return").values
        assert found["deg"] == pytest.approx(scatter, abs=4 * found["u_deg"])
        assert found["u_deg"] < scatter


def test_play_is_recovered_within_its_uncertainty():
    found = line(checked(laser=False, play_deg=0.3, scatter_deg=0.02)[0], "turntable", "play").values
    assert abs(found["deg"]) == pytest.approx(0.3, abs=4 * found["u_deg"])
    assert found["u_deg"] < 0.05


def test_settling_is_recommended_as_long_as_the_scene_swings():
    check, world = checked(laser=False, ring_px=2.0, ring_s=0.15)
    found = line(check, "turntable", "settling").values
    ends_s = world.ring_s * math.log(world.ring_px / 0.05)  # the swing is then below what counts as none
    assert found["settled_s"] == pytest.approx(ends_s, abs=0.1)
    assert found["settled_s"] <= check.recommended["settle_s"] <= ends_s + 0.15


def test_a_slow_camera_is_given_the_time_to_see_the_scene_stand():
    check, _ = checked(laser=False, slow_s=0.7)
    assert line(check, "turntable", "settling").level == "ok"
    assert check.recommended["settle_s"] == 0.0


def test_the_delay_of_the_light_is_found_to_a_frame_and_the_advice_cures_it():
    check, world = checked(table=False, lag_s=0.09)
    period_s = FRAME_S + check.recommended["exposure_on_us"] * 1e-6
    for name in ("switching on", "switching off"):
        delay_s = line(check, "laser", name).values["delay_s"]
        assert world.lag_s - 0.002 <= delay_s <= world.lag_s + period_s
    assert check.recommended["switching_s"] >= world.lag_s


def test_moves_stay_within_the_limits_and_what_has_no_room_is_left_out():
    check, world = checked(laser=False, limits_deg=(0.0, 1.5))
    assert min(world.visited) >= 0.0
    assert max(world.visited) <= 1.5
    assert line(check, "turntable", "return").level == "ok"
    assert len(check.left_out) == 3  # no laser; play; turning
    roomy, world = checked(laser=False, limits_deg=(0.0, 300.0))
    assert {x.name for x in roomy.lines if x.device == "turntable"} == NAMES["turntable"]
    assert min(world.visited) >= 0.0


def test_a_rig_without_laser_or_table_is_checked_and_that_is_said():
    check, _ = checked(laser=False, table=False)
    assert {x.device for x in check.lines} == {"camera"}
    assert check.level == "ok"
    assert [("[laser]" in x, "[turntable]" in x) for x in check.left_out] == [(True, False), (False, True)]


def test_an_interruption_ends_it_with_the_laser_off_and_the_table_at_rest():
    for at in range(10, 80, 9):
        world = World(interrupt_at=at)
        rig = OpenRig(Camera(world), Table(world), Laser(world), world.clock, Connections())
        with pytest.raises(KeyboardInterrupt):
            check_rig(rig, lambda _: None)
        assert not rig.laser.is_on
        assert world.turning is None


def test_an_error_of_a_device_is_a_line_and_the_others_are_looked_at():
    world = World()
    rig = OpenRig(Camera(world), Table(world), Laser(world), world.clock, Connections())

    def alarm(timeout_s):
        raise DeviceStateError("test table: it is in alarm. Home it first.")

    rig.turntable.home = alarm
    check = check_rig(rig, lambda _: None)
    assert check.broken
    (error,) = [x for x in check.lines if x.error]
    assert (error.device, error.level) == ("turntable", "fails")
    assert line(check, "laser", "stripe").level == "ok"
    assert line(check, "camera", "stream").level == "ok"


def test_without_frames_nothing_else_is_tried_and_what_was_found_is_written(tmp_path):
    world = World(lost=frozenset(range(100)))
    rig = OpenRig(Camera(world), Table(world), Laser(world), world.clock, Connections())
    check = check_rig(rig, lambda _: None)
    assert [(x.device, x.error) for x in check.lines] == [("camera", True)]
    assert check.broken
    assert world.visited == []
    write_rig_check(check, tmp_path / "new")
    assert json.loads((tmp_path / "new" / "check.json").read_text())["level"] == "fails"
    assert (tmp_path / "new" / "check.png").is_file()
