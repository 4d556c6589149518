"""The simulated rig as devices: what they show is what a rendered session holds."""

import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.devices.contracts import CameraContract, LaserContract, TurntableContract

from rotaline.errors import (
    DeviceConnectionError,
    DeviceLimitError,
    DeviceStateError,
    DeviceTimeoutError,
    LostFrameError,
)
from rotaline.hardware.camera import CameraSettings, Region
from rotaline.hardware.cameras import simulated as cameras
from rotaline.hardware.clock import SystemClock, VirtualClock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import find_devices
from rotaline.hardware.lasers import simulated as lasers
from rotaline.hardware.rig import DeviceTables, open_rig
from rotaline.hardware.simulated import world as world_module
from rotaline.hardware.simulated.faults import Faults
from rotaline.hardware.simulated.trajectory import move
from rotaline.hardware.simulated.world import SUB_POSES, SimulatedWorld
from rotaline.hardware.turntables import simulated as turntables
from rotaline.simulation.imaging.render import render_frame
from rotaline.simulation.rig import Mechanics, Sensor, build_rig
from rotaline.simulation.session import write_session
from rotaline.simulation.small_session import small_plan
from rotaline.simulation.truth import image_name, true_poses

LONG_S = 100.0
ERRORS = Mechanics(angle_noise_deg=0.3, run_out_um=800.0, run_out_noise_um=300.0)


def small_rig(sensor=None, mechanics=ERRORS, image_size=(160, 120)):
    return replace(build_rig(image_size, sensor=sensor), mechanics=mechanics)


def bright_rig(mechanics=ERRORS):
    """So much light, and so large a well, that nothing is left of the noise."""
    rig = small_rig(
        Sensor(bit_depth=16, full_well_e=1e4 * Sensor().full_well_e, read_noise_e=0.0, black_level_dn=0.0), mechanics
    )
    laser = replace(rig.laser, peak_e_per_ms=0.5e4 * rig.laser.peak_e_per_ms, speckle_contrast=0.0)
    return replace(rig, laser=laser, light=replace(rig.light, ambient_e_per_ms=0.5e4 * rig.light.ambient_e_per_ms))


def cut_plan(rig, captures=("laser", "stepped"), n=3, seed=1):
    plan = small_plan(rig, captures=captures, seed=seed)
    return replace(plan, captures=tuple(replace(c, shots=c.shots[:n]) for c in plan.captures))


def pairs_plan(rig, n=3, part="stepped"):
    """Laser-off and laser-on frames of a part at each angle, with an exposure of its own for each."""
    plan = cut_plan(rig, (part,), n)
    (capture,) = plan.captures
    off = [replace(s, laser=False, exposure_ms=3.3, ambient_e_per_ms=rig.light.ambient_e_per_ms) for s in capture.shots]
    shots = tuple(shot for pair in zip(off, capture.shots, strict=True) for shot in pair)
    return replace(plan, captures=(replace(capture, shots=shots),))


class Devices:
    """A world and its devices; everything is shut by closing the rig."""

    def __init__(self, rig=None, plan=None, faults=None, table=(), camera=(), clock=None):
        rig = small_rig() if rig is None else rig
        self.clock = clock or VirtualClock()
        self.world = SimulatedWorld(rig, plan or cut_plan(rig, ("stepped",)), self.clock, faults)
        self.tables = DeviceTables(
            cameras.Settings(driver="simulated", **dict(camera)),
            turntables.Settings(driver="simulated", **dict(table)),
            lasers.Settings(driver="simulated"),
        )
        self.open()

    def open(self):
        connections = Connections()
        connections.provide("world", self.world)
        self.rig = open_rig(self.tables, self.clock, connections)
        self.camera, self.table, self.laser = self.rig.camera, self.rig.turntable, self.rig.laser

    def take(self, exposure_ms=None):
        if exposure_ms is not None:
            self.camera.configure(replace(self.camera.settings, exposure_us=exposure_ms * 1e3))
        return self.camera.take(LONG_S).image

    def acquire(self, capture):
        """The frames of a capture, as a program takes them that knows of its plan what a person plans."""
        self.world.set_up(capture.folder)
        images, names = [], []
        for i, shot in enumerate(capture.shots):
            if shot.held:
                names += [shot.pose or i] if (shot.pose or i) not in names else []
                self.world.hold(names.index(shot.pose or i))
            if shot.angle_deg is not None:
                self.table.move_to(shot.angle_deg, LONG_S)
            (self.laser.on if shot.laser else self.laser.off)()
            images.append(self.take(shot.exposure_ms))
        return images


def lit_rows(image, dark):
    """Rows in which the stripe is much brighter than what is there without it."""
    return int(np.sum(np.any(image.astype(int) - dark > 40, axis=1)))


@pytest.fixture
def quick(monkeypatch):
    """Noise that depends on the seed instead of pictures, where it matters which frame comes and when, and not what it shows."""

    def render(rig, moments, *, exposure_ms, seed):
        width, height = rig.camera.image_size
        return np.random.default_rng(seed).integers(0, 255, (height, width), dtype=np.uint8)

    monkeypatch.setattr(world_module, "render_exposure", render)


class TestCamera(CameraContract):
    @pytest.fixture
    def camera(self):
        devices = Devices(small_rig(image_size=(64, 48)))
        yield devices.camera
        devices.rig.close()


class TestColourCameraOf12Bit(CameraContract):
    n_frames = 2

    @pytest.fixture
    def camera(self):
        devices = Devices(small_rig(Sensor(colour=True, bit_depth=12), image_size=(64, 48)))
        yield devices.camera
        devices.rig.close()


class TestTurntable(TurntableContract):
    @pytest.fixture
    def turntable(self):
        devices = Devices()
        yield devices.table
        devices.rig.close()


class TestTurntableWithLimits(TurntableContract):
    @pytest.fixture
    def turntable(self):
        devices = Devices(table={"limits_deg": (-30.0, 200.0)})
        yield devices.table
        devices.rig.close()


class TestLaser(LaserContract):
    @pytest.fixture
    def devices(self):
        devices = Devices()
        yield devices
        devices.rig.close()

    @pytest.fixture
    def laser(self, devices):
        return devices.laser

    @pytest.fixture
    def shines(self, devices):
        return devices.world.shines


# what is planned


def test_frames_of_the_plan_are_those_of_the_rendered_session_bit_for_bit(tmp_path):
    rig = small_rig(image_size=(96, 72))
    plan = cut_plan(rig, ("camera", "laser", "axis", "stepped"), n=2, seed=5)
    paired = pairs_plan(rig, 2).captures[0]
    plan = replace(plan, captures=(*plan.captures, replace(paired, folder="pairs")))
    write_session(tmp_path / "s", rig, plan, threads=1)
    devices = Devices(rig, plan)
    for capture in reversed(plan.captures):
        for i, image in enumerate(devices.acquire(capture)):
            file = tmp_path / "s" / capture.folder / image_name(i, "png")
            assert np.array_equal(image, cv2.imread(str(file), cv2.IMREAD_UNCHANGED)), (capture.folder, i)


def test_frames_of_the_plan_may_come_in_any_order(quick):
    rig = small_rig()
    plan = pairs_plan(rig)
    straight = Devices(rig, plan).acquire(plan.captures[0])
    shots = plan.captures[0].shots
    order = [5, 2, 0, 3, 1, 4]
    devices = Devices(rig, plan)
    other = devices.acquire(replace(plan.captures[0], shots=tuple(shots[i] for i in order)))
    for image, i in zip(other, order, strict=True):
        assert np.array_equal(image, straight[i])


def test_frames_that_are_alike_in_the_plan_come_one_after_the_other():
    rig = small_rig()
    plan = cut_plan(rig, ("stepped",), 1)
    plan = replace(plan, captures=(replace(plan.captures[0], shots=plan.captures[0].shots * 2),))
    images = Devices(rig, plan).acquire(plan.captures[0])
    pose = true_poses(rig, plan)["stepped"]
    assert pose[0] is pose[1]
    for i, image in enumerate(images):
        shot = plan.captures[0].shots[i]
        parts = [part.moved(pose[i]) for part in shot.on_table]
        light = {"laser_on": True, "ambient_e_per_ms": shot.ambient_e_per_ms, "exposure_ms": shot.exposure_ms}
        assert np.array_equal(image, render_frame(rig, parts, **light, seed=(plan.seed, 0, i)))


def test_a_frame_taken_again_has_other_noise_and_a_new_world_begins_anew():
    rig = small_rig()
    plan = cut_plan(rig, ("stepped",))
    devices = Devices(rig, plan)
    first = devices.acquire(plan.captures[0])
    assert devices.table.angle_deg() == plan.captures[0].shots[-1].angle_deg
    again = [devices.take(), devices.take()]
    assert not np.array_equal(again[0], first[-1])
    assert not np.array_equal(again[0], again[1])
    np.testing.assert_allclose(again[0].astype(float).mean(), first[-1].mean(), rtol=0.02)

    resumed = Devices(rig, plan)
    resumed.world.set_up("stepped")
    resumed.table.move_to(plan.captures[0].shots[-1].angle_deg, LONG_S)
    resumed.laser.on()
    assert np.array_equal(resumed.take(), first[-1])
    assert np.array_equal(resumed.take(), again[0])


def test_what_is_placed_anew_is_there_to_be_taken_again(quick):
    rig = small_rig()
    plan = cut_plan(rig, ("laser", "stepped"))
    devices = Devices(rig, plan)
    first = [devices.acquire(capture) for capture in plan.captures]
    for capture, images in zip(plan.captures, first, strict=True):
        assert all(map(np.array_equal, devices.acquire(capture), images))


def test_frames_taken_aside_use_nothing_up(quick):
    rig = small_rig()
    plan = cut_plan(rig, ("stepped",))
    expected = Devices(rig, plan).acquire(plan.captures[0])[0]

    def taken(n_previews):
        devices = Devices(rig, plan)
        devices.world.set_up("stepped")
        devices.laser.on()
        with devices.world.aside("preview"):
            previews = [devices.take() for _ in range(n_previews)]
        with devices.world.aside("reference 1"):
            reference = devices.take()
        return previews, reference, devices.take()

    previews, reference, frame = taken(2)
    _, same_reference, same_frame = taken(0)
    assert np.array_equal(frame, expected)
    assert np.array_equal(frame, same_frame)
    assert np.array_equal(reference, same_reference)
    for one, other in itertools.combinations([*previews, reference, frame], 2):
        assert not np.array_equal(one, other)


def test_streamed_frames_use_nothing_up(quick):
    rig = small_rig()
    plan = cut_plan(rig, ("stepped",))
    devices = Devices(rig, plan)
    devices.world.set_up("stepped")
    devices.laser.on()
    devices.camera.start()
    streamed = [devices.camera.next_frame(LONG_S).image for _ in range(2)]
    devices.camera.stop()
    assert not np.array_equal(*streamed)
    assert np.array_equal(devices.take(), Devices(rig, plan).acquire(plan.captures[0])[0])


def test_with_another_exposure_the_table_still_stands_as_planned():
    rig = bright_rig()
    plan = cut_plan(rig, ("stepped",))
    shot, pose = plan.captures[0].shots[1], true_poses(rig, plan)["stepped"][1]
    devices = Devices(rig, plan)
    devices.world.set_up("stepped")
    devices.table.move_to(shot.angle_deg, LONG_S)
    devices.laser.on()
    image = devices.take(2 * shot.exposure_ms).astype(float)

    def seen(base_from_table):
        parts = [part.moved(base_from_table) for part in shot.on_table]
        light = {"laser_on": True, "ambient_e_per_ms": shot.ambient_e_per_ms, "exposure_ms": 2 * shot.exposure_ms}
        return render_frame(rig, parts, **light, seed=1).astype(float)

    spread = image.max() - image.min()
    assert np.abs(image - seen(pose)).max() < 0.02 * spread, "shot noise only"
    assert np.abs(image - seen(rig.base_from_table(shot.angle_deg))).max() > 0.1 * spread, "it is not the ideal table"


def test_at_angles_that_nobody_planned_each_stop_has_errors_of_its_own():
    rig = bright_rig()
    devices = Devices(rig, cut_plan(rig, ("stepped",)))
    devices.world.set_up("stepped")

    def there():
        devices.table.move_to(7.0, LONG_S)
        return [devices.take().astype(float) for _ in range(2)]

    first = there()
    devices.table.move_to(20.0, LONG_S)
    second = there()
    assert np.abs(first[0] - first[1]).max() < 0.05 * np.ptp(first[0])
    assert np.abs(second[0] - second[1]).max() < 0.05 * np.ptp(first[0])
    assert np.abs(first[0] - second[0]).max() > 0.2 * np.ptp(first[0])


# what the world shows


def test_the_next_frame_shows_what_has_changed():
    rig = small_rig()
    plan = pairs_plan(rig)
    devices = Devices(rig, plan)
    bare = devices.take().astype(float)
    devices.laser.on()
    assert np.median(devices.take()) < 0.5 * np.median(bare), "the lamps are off while the laser is on"
    devices.laser.off()
    devices.world.set_up("stepped")
    dark = devices.take().astype(float)
    assert np.abs(dark - bare).max() > 50, "the part stands on the table"
    devices.laser.on()
    lit = devices.take().astype(float)
    assert lit_rows(lit, 40) > 20, "a stripe"
    assert np.median(lit) < 0.5 * np.median(dark), "the lamps are off while the laser is on"
    devices.laser.off()
    np.testing.assert_allclose(devices.take().astype(float).mean(), dark.mean(), rtol=0.02)
    devices.laser.on()
    devices.table.move_to(100.0, LONG_S)
    assert np.abs(devices.take().astype(float) - lit).max() > 50


def test_light_grows_with_power_and_gain_and_exposure():
    rig = bright_rig()
    devices = Devices(rig, cut_plan(rig, ("stepped",)))
    devices.world.set_up("stepped")
    devices.laser.on()

    def light():
        return float(devices.take().astype(float).sum())

    full = light()
    devices.laser.set_power(0.5)
    half = light()
    devices.laser.set_power(0.0)
    assert devices.laser.is_on
    none = light()
    assert half - none == pytest.approx((full - none) / 2, rel=0.05)
    devices.camera.configure(replace(devices.camera.settings, gain=2.0))
    assert light() == pytest.approx(2 * none, rel=0.05)
    devices.camera.configure(CameraSettings(2 * devices.camera.settings.exposure_us))
    assert devices.camera.settings.gain == 2.0, "what is left out stays as it was"
    assert light() == pytest.approx(4 * none, rel=0.05)


def test_with_gain_a_planned_state_is_brighter_than_planned():
    rig = bright_rig()
    plan = pairs_plan(rig, 1)
    planned = Devices(rig, plan).acquire(plan.captures[0])[0]
    devices = Devices(rig, plan)
    devices.world.set_up("stepped")
    devices.camera.configure(CameraSettings(1e3 * plan.captures[0].shots[0].exposure_ms, gain=2.0))
    assert devices.take().astype(float).sum() == pytest.approx(2 * planned.astype(float).sum(), rel=0.01)


def test_the_room_is_as_bright_as_in_the_capture_at_all_exposures():
    rig = bright_rig()
    plan = small_plan(rig, captures=("laser",), plate_visible=True)
    devices = Devices(rig, plan)
    devices.world.set_up("laser")
    devices.world.hold(0)
    devices.laser.on()
    devices.laser.set_power(0.0)
    lit = devices.take(7.0).astype(float).sum()
    devices.laser.off()
    assert lit == pytest.approx(0.4 * devices.take(7.0).astype(float).sum(), rel=0.02)


def test_a_pose_that_is_held_anew_is_there_to_be_taken_again(quick):
    rig = small_rig()
    plan = cut_plan(rig, ("laser",))
    devices = Devices(rig, plan)
    first = devices.acquire(plan.captures[0])
    devices.world.hold(0)
    devices.laser.off()
    assert np.array_equal(devices.take(), first[0])
    assert not np.array_equal(devices.take(), first[0])


def test_a_region_is_cut_out_of_the_whole_frame():
    rig = small_rig()
    plan = cut_plan(rig, ("stepped",))
    whole = Devices(rig, plan).acquire(plan.captures[0])[0]
    devices = Devices(rig, plan)
    devices.camera.configure(replace(devices.camera.settings, region=Region(30, 20, 50, 41)))
    (part,) = devices.acquire(replace(plan.captures[0], shots=plan.captures[0].shots[:1]))
    assert np.array_equal(part, whole[20:61, 30:80])


def test_a_turning_table_blurs_the_frame():
    rig = bright_rig(Mechanics())
    plan = pairs_plan(rig, 1, "groove")
    devices = Devices(rig, plan, table={"speed_deg_s": 450.0, "acceleration_deg_s2": 1800.0})
    devices.world.set_up("groove")
    devices.table.turn(450.0)
    devices.camera.configure(replace(devices.camera.settings, exposure_us=30_000.0))
    began = devices.table.angle_deg()
    frame = devices.camera.take(LONG_S)
    assert devices.table.angle_deg() == pytest.approx(began + 450.0 * (0.030 + 0.004))
    shot = plan.captures[0].shots[0]

    def seen(angle_deg):
        parts = [part.moved(rig.base_from_table(angle_deg)) for part in shot.on_table]
        light = {"laser_on": False, "ambient_e_per_ms": shot.ambient_e_per_ms, "exposure_ms": 30.0}
        return render_frame(rig, parts, **light, seed=1).astype(float)

    angles = began + 13.5 * (np.arange(SUB_POSES) + 0.5) / SUB_POSES
    blurred = np.mean([seen(float(a)) for a in angles], axis=0)
    image = frame.image.astype(float)
    assert np.abs(image - blurred).max() < 0.01 * np.ptp(blurred), "shot noise only"
    assert np.abs(image - seen(began + 6.75)).max() > 0.1 * np.ptp(blurred), "it is not one sharp picture"


def test_what_a_person_holds():
    rig = small_rig()
    plan = cut_plan(rig, ("camera", "laser", "stepped"))
    devices = Devices(rig, plan)
    assert [devices.world.n_poses(folder) for folder in ("camera", "laser", "stepped")] == [3, 2, 0]
    devices.world.set_up("laser")
    bare = devices.take().astype(float)
    devices.world.hold(1)
    assert np.abs(devices.take() - bare).max() > 50
    devices.world.hold(None)
    np.testing.assert_allclose(devices.take().astype(float).mean(), bare.mean(), rtol=0.02)
    with pytest.raises(IndexError, match="2 poses"):
        devices.world.hold(2)
    with pytest.raises(KeyError, match=r"no capture 'bust', only camera, laser, stepped"):
        devices.world.set_up("bust")


# the stream


def test_a_stream_shows_what_was_when_it_was_exposed():
    devices = Devices(camera={"readout_ms": 25.0})
    devices.world.set_up("stepped")
    devices.camera.configure(replace(devices.camera.settings, exposure_us=10_000.0))
    before = devices.camera.take(LONG_S)
    devices.laser.on()
    began = devices.clock.now_s()
    devices.camera.start()
    devices.clock.wait(0.060)
    devices.laser.off()
    devices.clock.wait(1.0)
    frames = [devices.camera.next_frame(LONG_S) for _ in range(4)]
    assert [f.number for f in frames] == [before.number + 1 + k for k in range(4)]
    np.testing.assert_allclose([f.time_s - began for f in frames], [0.005, 0.030, 0.055, 0.080], atol=1e-12)
    # exposures are 0 to 10, 25 to 35, 50 to 60, 75 to 85 ms: the room is bright again in the last one
    assert [bool(np.median(f.image) > 20) for f in frames] == [False, False, False, True]
    devices.camera.stop()
    n_begun = 1 + int((devices.clock.now_s() - began) / 0.025)
    assert devices.camera.take(LONG_S).number == before.number + n_begun + 1


def test_a_stream_waits_for_the_next_frame(quick):
    devices = Devices()
    devices.camera.start()
    first = devices.camera.next_frame(LONG_S)
    now = devices.clock.now_s()
    assert now == pytest.approx(first.time_s + 0.005 + 0.004)
    with pytest.raises(DeviceTimeoutError, match=r"within 0.002 s"):
        devices.camera.next_frame(0.002)
    assert devices.camera.next_frame(0.1).number == first.number + 1, "the time-out costs no frame"


def test_what_nobody_looks_at_is_not_rendered_and_changes_nothing(monkeypatch):
    rendered = []

    def counted(*args, **kwargs):
        rendered.append(kwargs["seed"])
        return render_exposure(*args, **kwargs)

    render_exposure = world_module.render_exposure
    monkeypatch.setattr(world_module, "render_exposure", counted)
    images = []
    for looked_at in ((0, 1, 2, 3), (2,)):
        devices = Devices()
        devices.world.set_up("stepped")
        devices.camera.start()
        devices.table.turn(20.0)
        frames = [devices.camera.next_frame(LONG_S) for _ in range(4)]
        devices.table.stop(LONG_S)
        devices.world.set_up("stepped")  # what is done afterwards does not show
        assert not rendered
        images.append({i: frames[i].image for i in looked_at})
        assert frames[2].image is images[-1][2]
        assert len(rendered) == len(looked_at)
        rendered.clear()
    np.testing.assert_array_equal(images[0][2], images[1][2])


def test_a_full_queue_loses_the_oldest_frames(quick):
    devices = Devices(camera={"queue_frames": 3})
    devices.camera.start()
    devices.clock.wait(0.1)
    numbers = [devices.camera.next_frame(LONG_S).number for _ in range(4)]
    # ten exposures of 10 ms have ended, nine have been read out
    assert numbers == [7, 8, 9, 10]


# the table and the laser by the clock


def test_a_move_takes_the_time_that_speed_and_acceleration_ask_for():
    devices = Devices(table={"speed_deg_s": 30.0, "acceleration_deg_s2": 120.0})
    for angle, seconds in ((90.0, 90 / 30 + 30 / 120), (87.0, 2 * (3 / 120) ** 0.5), (87.0, 0.0)):
        before = devices.clock.now_s()
        assert devices.table.move_to(angle, LONG_S) == angle
        assert devices.clock.now_s() - before == pytest.approx(seconds)


@given(st.floats(-400, 400), st.floats(-400, 400), st.floats(0.5, 100), st.floats(1, 500), st.floats(0, 1e4))
def test_a_move_is_smooth_and_ends_where_it_should(angle, to, speed, acceleration, start):
    pieces, duration = move(start, angle, to, speed, acceleration)
    if not pieces:
        assert angle == to
        return
    ends = [*(p.start_s for p in pieces[1:]), start + duration]
    for piece, end, then in zip(pieces, ends, [*pieces[1:], None], strict=True):
        assert end >= piece.start_s
        assert abs(piece.speed_at(end)) <= speed * (1 + 1e-6) + 1e-6
        assert piece.angle_at(end) == pytest.approx(to if then is None else then.angle_deg, abs=1e-6)
        assert piece.speed_at(end) == pytest.approx(0.0 if then is None else then.speed_deg_s, abs=1e-6)


def test_the_table_turns_by_the_clock_and_stops():
    devices = Devices(table={"speed_deg_s": 30.0, "acceleration_deg_s2": 120.0})
    devices.table.turn(-20.0)
    assert devices.clock.now_s() == pytest.approx(20 / 120)
    before = devices.table.angle_deg()
    devices.clock.wait(30.0)
    assert devices.table.angle_deg() == pytest.approx(before - 600.0)
    devices.table.turn(10.0)
    devices.table.stop(LONG_S)
    there = devices.table.angle_deg()
    devices.clock.wait(5.0)
    assert devices.table.angle_deg() == there
    devices.table.home(LONG_S)
    assert devices.table.angle_deg() == 0.0
    assert devices.clock.now_s() < 50.0, "home is the nearest whole turn, not the first one"


def test_a_move_while_it_turns_begins_with_a_stop():
    devices = Devices(table={"speed_deg_s": 30.0, "acceleration_deg_s2": 120.0})
    devices.table.turn(30.0)
    before, turned = devices.clock.now_s(), devices.table.angle_deg()
    assert devices.table.move_to(0.0, LONG_S) == 0.0
    stopped = turned + 30.0**2 / (2 * 120.0)
    assert devices.clock.now_s() - before == pytest.approx(30 / 120 + 2 * (stopped / 120) ** 0.5)


def test_a_table_with_limits_turns_up_to_them():
    devices = Devices(table={"limits_deg": (0.0, 50.0)})
    devices.table.turn(20.0)
    devices.clock.wait(60.0)
    assert devices.table.angle_deg() == 50.0
    with pytest.raises(DeviceLimitError, match="limit of 50 deg"):
        devices.table.turn(20.0)
    assert devices.table.angle_deg() == 50.0
    devices.table.turn(-20.0)
    devices.table.stop(LONG_S)
    assert 0.0 < devices.table.angle_deg() < 50.0


def test_a_move_that_takes_too_long_is_given_up_and_the_table_stands():
    devices = Devices()
    with pytest.raises(DeviceTimeoutError, match="has not reached 90 deg"):
        devices.table.move_to(90.0, 1.0)
    there = devices.table.angle_deg()
    assert 20.0 < there < 35.0
    devices.clock.wait(10.0)
    assert devices.table.angle_deg() == there
    assert devices.table.move_to(90.0, LONG_S) == 90.0


class InterruptedClock(VirtualClock):
    """The user presses Ctrl-C in the middle of a wait."""

    interrupt = False

    def wait(self, seconds):
        if self.interrupt:
            self.interrupt = False
            super().wait(seconds / 2)
            raise KeyboardInterrupt
        super().wait(seconds)


def test_an_interrupted_move_ends_with_a_table_that_stands():
    devices = Devices(clock=InterruptedClock())
    devices.clock.interrupt = True
    with pytest.raises(KeyboardInterrupt):
        devices.table.move_to(90.0, LONG_S)
    there = devices.table.angle_deg()
    assert 40.0 < there < 60.0
    devices.clock.wait(10.0)
    assert devices.table.angle_deg() == there


def test_closing_that_was_interrupted_can_be_done_again():
    devices = Devices(clock=InterruptedClock())
    devices.laser.on()
    devices.table.turn(10.0)
    devices.clock.interrupt = True
    with pytest.raises(KeyboardInterrupt):
        devices.rig.close()
    assert not devices.world.shines()
    assert devices.world.table_stands()
    devices.open()


# opening


def test_what_is_open_is_not_opened_twice():
    devices = Devices()
    with pytest.raises(DeviceConnectionError, match="another program holds it"):
        devices.open()
    devices.laser.on()
    devices.table.turn(5.0)
    devices.rig.close()
    assert not devices.world.shines()
    assert devices.world.table_stands()
    devices.open()
    assert not devices.laser.is_on


def test_devices_need_a_world_and_its_clock():
    settings = cameras.Settings(driver="simulated")
    with pytest.raises(DeviceConnectionError, match="no simulated world"):
        cameras.open_device(settings, VirtualClock(), Connections())
    devices = Devices()
    with pytest.raises(ValueError, match="same clock"):
        lasers.open_device(lasers.Settings(driver="simulated"), SystemClock(), devices.rig.connections)


def test_limits_must_be_in_order():
    with pytest.raises(DeviceLimitError, match=r"\[10.0, -10.0\] deg"):
        Devices(table={"limits_deg": (10.0, -10.0)})


def test_a_simulated_device_of_each_kind_is_found():
    for kind in ("camera", "turntable", "laser"):
        (found,) = find_devices(kind, "simulated")
        assert (found.kind, found.driver) == (kind, "simulated")
        assert found.toml == f'[{kind}]\ndriver = "simulated"\n'


# what goes wrong


def test_a_lost_frame_is_said_by_take_and_left_out_by_a_stream(quick):
    rig = small_rig()
    plan = cut_plan(rig, ("stepped",))
    expected = Devices(rig, plan).acquire(plan.captures[0])[0]
    devices = Devices(rig, plan, Faults(lost_frames=frozenset({1, 4})))
    devices.world.set_up("stepped")
    devices.laser.on()
    with pytest.raises(LostFrameError, match="frame 1 did not arrive"):
        devices.camera.take(LONG_S)
    again = devices.camera.take(LONG_S)
    assert again.number == 2
    assert np.array_equal(again.image, expected), "a frame that never came has used nothing up"
    devices.camera.start()
    assert [devices.camera.next_frame(LONG_S).number for _ in range(3)] == [3, 5, 6]


def test_a_damaged_frame_is_said_and_the_next_one_comes(quick):
    devices = Devices(faults=Faults(damaged_frames=frozenset({1, 3})))
    with pytest.raises(LostFrameError, match="in pieces"):
        devices.camera.take(LONG_S)
    assert devices.camera.take(LONG_S).number == 2
    devices.camera.start()
    with pytest.raises(LostFrameError, match="frame 3"):
        devices.camera.next_frame(LONG_S)
    assert devices.camera.next_frame(LONG_S).number == 4


def test_a_late_frame_is_waited_for_and_after_a_time_out_thrown_away(quick):
    devices = Devices(faults=Faults(late_frames={1: 0.5, 2: 5.0, 4: 5.0}))
    assert devices.camera.take(1.0).number == 1
    before = devices.clock.now_s()
    with pytest.raises(DeviceTimeoutError, match="frame 2 did not arrive within 1 s"):
        devices.camera.take(1.0)
    assert devices.clock.now_s() - before == pytest.approx(1.0)
    assert devices.camera.take(1.0).number == 3
    devices.camera.start()
    with pytest.raises(DeviceTimeoutError):
        devices.camera.next_frame(1.0)
    assert [devices.camera.next_frame(LONG_S).number for _ in range(2)] == [4, 5]


@pytest.mark.parametrize("streams", [False, True])
def test_a_camera_that_is_gone_stays_so_until_it_is_opened_anew(quick, streams):
    devices = Devices(faults=Faults(camera_gone_at_frames=frozenset({2})))
    if streams:
        devices.camera.start()
    get = devices.camera.next_frame if streams else devices.camera.take
    get(LONG_S)
    for _ in range(2):
        with pytest.raises(DeviceConnectionError, match="open it again"):
            get(LONG_S)
    devices.rig.close()
    devices.open()
    assert devices.camera.take(LONG_S).number == 3


def test_a_table_that_gets_stuck_is_a_time_out():
    devices = Devices(faults=Faults(stalled_moves=frozenset({2})))
    devices.table.move_to(10.0, LONG_S)
    before = devices.clock.now_s()
    with pytest.raises(DeviceTimeoutError, match=r"is at 15.000 deg and has not reached 20 deg"):
        devices.table.move_to(20.0, 7.0)
    assert devices.clock.now_s() - before == pytest.approx(7.0)
    assert devices.world.table_stands()
    assert devices.table.move_to(20.0, LONG_S) == 20.0


def test_an_alarm_ends_with_homing():
    devices = Devices(faults=Faults(alarm_at_moves=frozenset({1})))
    with pytest.raises(DeviceStateError, match=r"alarm at 5.000 deg"):
        devices.table.move_to(10.0, LONG_S)
    assert devices.world.table_stands()
    for call in (lambda: devices.table.move_to(1.0, LONG_S), lambda: devices.table.turn(5.0)):
        with pytest.raises(DeviceStateError, match="Home it first"):
            call()
    devices.table.home(LONG_S)
    assert devices.table.move_to(10.0, LONG_S) == 10.0


def test_a_table_that_is_gone_stands_and_stays_gone_until_it_is_opened_anew():
    devices = Devices(faults=Faults(turntable_gone_at_moves=frozenset({1})))
    for _ in range(2):
        with pytest.raises(DeviceConnectionError, match="simulated turntable"):
            devices.table.move_to(10.0, LONG_S)
    assert devices.world.table_stands()
    devices.rig.close()
    devices.open()
    assert devices.table.angle_deg() == 5.0


def test_a_laser_that_does_not_switch_is_said():
    devices = Devices(faults=Faults(laser_dark_at_switchings=frozenset({1}), laser_lit_at_switchings=frozenset({1, 2})))
    with pytest.raises(DeviceTimeoutError, match="still dark"):
        devices.laser.on()
    assert not devices.laser.is_on
    devices.laser.on()
    with pytest.raises(DeviceTimeoutError, match="still shines"):
        devices.laser.off()
    assert devices.world.shines()
    assert devices.laser.is_on
    devices.rig.close()  # tries twice
    assert not devices.world.shines()


def test_a_laser_that_cannot_be_switched_off_does_not_keep_the_rest_from_closing():
    devices = Devices(faults=Faults(laser_lit_at_switchings=frozenset(range(1, 100))))
    devices.laser.on()
    devices.table.turn(5.0)
    devices.rig.close()
    assert devices.world.shines()
    assert devices.world.table_stands()
    devices.open()
    assert not devices.world.shines(), "what is opened is dark"
