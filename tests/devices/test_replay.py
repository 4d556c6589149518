"""A recorded session opened as devices."""

import dataclasses

import numpy as np
import pytest
from tests.devices.contracts import CameraContract, LaserContract, TurntableContract

from rotaline.errors import DeviceConnectionError, DeviceLimitError, DeviceStateError, SessionError
from rotaline.hardware.cameras import replay as replay_camera
from rotaline.hardware.clock import VirtualClock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import open_camera, open_laser, open_turntable
from rotaline.hardware.lasers import replay as replay_laser
from rotaline.hardware.replay import RecordedCapture, RecordedFrame, Recording, Replay
from rotaline.hardware.rig import DeviceTables, OpenRig, open_rig
from rotaline.hardware.turntables import replay as replay_turntable

WIDTH, HEIGHT = 160, 120
SESSION = "sessions/bench"


def image(value: int, shape=(HEIGHT, WIDTH), kind=np.uint8):
    """All pixels tell which frame it is; one does not, so that regions can be told apart."""
    pixels = np.full(shape, value, kind)
    pixels[30, 40] = 250
    return pixels


def frame(value, angle=None, on=False, pose=None, exposure=None, read=None) -> RecordedFrame:
    return RecordedFrame(f"{value:04}.png", angle, on, pose, read or (lambda: image(value)), exposure)


def recording() -> Recording:
    camera = tuple(frame(i, pose=f"p{i}") for i in range(5))
    laser = tuple(frame(10 + 2 * i + on, on=bool(on), pose=f"p{i}") for i in range(2) for on in (0, 1))
    ball = tuple(frame(20 + 2 * i + on, 90.0 * i, bool(on), pose=str(i)) for i in range(4) for on in (0, 1))
    bracket = tuple(frame(40 + i, 0.0, True, exposure=us) for i, us in enumerate((100.0, 1000.0, 10_000.0)))
    captures = {"camera": camera, "laser": laser, "ball": ball, "bracket": bracket}
    return Recording(SESSION, tuple(RecordedCapture(name, "scan", frames) for name, frames in captures.items()))


def rig(what: Recording | None = None, clock=None) -> tuple[OpenRig, Replay]:
    connections = Connections()
    connections.provide("recording", what or recording())
    tables = DeviceTables(
        replay_camera.Settings(),
        replay_turntable.Settings(),
        replay_laser.Settings(),
    )
    opened = open_rig(tables, clock or VirtualClock(), connections)
    return opened, connections.get("replay")


def shown(camera) -> int:
    return int(camera.take(1.0).image[0, 0])


class TestReplayCamera(CameraContract):
    @pytest.fixture
    def camera(self):
        opened, replay = rig()
        replay.present("p0")
        yield opened.camera
        opened.close()


class TestReplayCameraInColour(CameraContract):
    """16 bit, red, green, blue."""

    @pytest.fixture
    def camera(self):
        frames = tuple(frame(i, 0.0, read=lambda i=i: image(i, (HEIGHT, WIDTH, 3), np.uint16)) for i in range(4))
        opened, _ = rig(Recording(SESSION, (RecordedCapture("ball", "scan", frames),)))
        yield opened.camera
        opened.close()


class TestReplayTurntable(TurntableContract):
    @pytest.fixture
    def turntable(self):
        return rig()[0].turntable


class TestReplayLaser(LaserContract):
    @pytest.fixture
    def opened(self):
        return rig()

    @pytest.fixture
    def laser(self, opened):
        return opened[0].laser

    @pytest.fixture
    def shines(self, opened):
        return lambda: opened[1].laser_on


def test_turn_the_table_and_the_next_frame_shows_it():
    opened, replay = rig()
    replay.select("ball")
    for i in (2, 0, 3, 1):
        assert opened.turntable.move_to(90.0 * i, 1.0) == 90.0 * i
        assert shown(opened.camera) == 20 + 2 * i
        opened.laser.on()
        assert shown(opened.camera) == 21 + 2 * i
        opened.laser.off()
        assert shown(opened.camera) == 20 + 2 * i
    opened.turntable.move_to(360.0 + 90.0005, 1.0)
    assert shown(opened.camera) == 22, "a turn later, and within the tolerance"


def test_the_pose_that_is_presented_is_the_one_that_is_seen():
    opened, replay = rig()
    for i in (3, 1):
        replay.present(f"p{i}")
        opened.turntable.move_to(17.0 * i, 1.0)
        assert shown(opened.camera) == i, "the table plays no part"
    replay.select("laser")
    with pytest.raises(DeviceStateError, match=r"no pose is presented\. There is pose p0, p1"):
        opened.camera.take(1.0)
    replay.present("p1")
    opened.laser.on()
    assert shown(opened.camera) == 13


def test_the_same_state_shows_the_same_frame_again_with_a_number_of_its_own():
    clock = VirtualClock()
    opened, replay = rig(clock=clock)
    replay.present("p2")
    first, second = opened.camera.take(1.0), opened.camera.take(1.0)
    assert np.array_equal(first.image, second.image)
    assert second.number == first.number + 1
    assert second.time_s - first.time_s == pytest.approx(opened.camera.settings.exposure_us * 1e-6)
    assert clock.now_s() == pytest.approx(2 * opened.camera.settings.exposure_us * 1e-6)


def test_a_frame_owns_its_image_though_the_recording_may_keep_it():
    kept = image(7)
    opened, _ = rig(Recording(SESSION, (RecordedCapture("ball", "scan", (frame(7, 0.0, read=lambda: kept),)),)))
    opened.camera.take(1.0).image[:] = 0
    assert shown(opened.camera) == 7


@pytest.mark.parametrize(("exposure_us", "value"), [(1.0, 40), (300.0, 40), (330.0, 41), (4000.0, 42), (1e6, 42)])
def test_of_a_bracket_the_nearest_exposure_is_shown(exposure_us, value):
    opened, replay = rig()
    replay.select("bracket")
    opened.laser.on()
    opened.camera.configure(dataclasses.replace(opened.camera.settings, exposure_us=exposure_us))
    assert shown(opened.camera) == value


def test_a_stream_gives_the_frames_of_the_capture_in_order():
    opened, replay = rig()
    replay.select("ball")
    opened.camera.start()
    values = [int(opened.camera.next_frame(1.0).image[0, 0]) for _ in range(8)]
    assert values == list(range(20, 28))
    with pytest.raises(DeviceStateError, match="all 8 frames"):
        opened.camera.next_frame(1.0)
    opened.camera.stop()


def test_an_angle_that_was_not_recorded_says_which_there_are():
    opened, replay = rig()
    replay.select("ball")
    opened.turntable.move_to(100.0, 1.0)
    with pytest.raises(
        DeviceStateError,
        match=r"'ball': it has no frame at 100 deg .* 4 angles from 0 to 270 deg, the nearest is 90 deg",
    ):
        opened.camera.take(1.0)
    opened.turntable.move_to(90.0, 1.0)
    assert shown(opened.camera) == 22, "the camera works on"


def test_a_light_that_was_not_recorded_says_so():
    opened, replay = rig()
    replay.select("bracket")
    with pytest.raises(DeviceStateError, match="no frame with the laser off"):
        opened.camera.take(1.0)


def test_poses_and_captures_that_are_not_there_say_which_are():
    _, replay = rig()
    with pytest.raises(DeviceStateError, match=r"no capture 'rod'\. There is camera, laser, ball, bracket"):
        replay.select("rod")
    with pytest.raises(DeviceStateError, match=r"'camera': it has no pose 'p7'\. There is pose p0, p1"):
        replay.present("p7")
    assert replay.capture.name == "camera"
    assert replay.pose is None


def test_poses_are_listed_once_in_the_order_in_which_they_were_taken():
    captures = {capture.name: capture for capture in recording().captures}
    assert captures["laser"].poses == ("p0", "p1")
    assert captures["bracket"].poses == ()


def test_a_region_is_cut_from_the_recorded_frame():
    opened, replay = rig()
    replay.present("p0")
    region = dataclasses.replace(opened.camera.settings.region, x=40, y=30, width=16, height=32)
    opened.camera.configure(dataclasses.replace(opened.camera.settings, region=region))
    part = opened.camera.take(1.0).image
    assert part.shape == (32, 16)
    assert np.argwhere(part == 250).tolist() == [[0, 0]]


def test_what_a_recording_cannot_do_is_refused():
    opened, _ = rig()
    for change, words in (({"gain": 2.0}, "gain"), ({"trigger": "line"}, "trigger")):
        with pytest.raises(DeviceLimitError, match=words):
            opened.camera.configure(dataclasses.replace(opened.camera.settings, **change))
    with pytest.raises(DeviceStateError, match="plan in steps"):
        opened.turntable.turn(5.0)


def test_a_recorded_frame_that_cannot_be_read_is_named():
    def unreadable():
        raise SessionError("bench/p1.png: the image is damaged.")

    frames = (
        frame(0, pose="p0"),
        frame(1, pose="p1", read=unreadable),
        frame(2, pose="p2", read=lambda: image(2, (60, 80))),
    )
    opened, replay = rig(Recording(SESSION, (RecordedCapture("camera", "camera", frames),)))
    replay.present("p1")
    with pytest.raises(DeviceStateError, match=r"bench/p1\.png: the image is damaged"):
        opened.camera.take(1.0)
    replay.present("p2")
    with pytest.raises(DeviceStateError, match=r"0002\.png is 80 x 60 px .* 160 x 120 px"):
        opened.camera.take(1.0)
    replay.present("p0")
    assert opened.camera.take(1.0).number == 1, "what failed was no frame"


def test_without_a_recording_nothing_opens():
    clock = VirtualClock()
    for module, open_device in (
        (replay_camera, open_camera),
        (replay_turntable, open_turntable),
        (replay_laser, open_laser),
    ):
        with pytest.raises(DeviceConnectionError, match="no recorded session has been opened"):
            open_device(module.Settings(), clock, Connections())


def test_a_recording_without_frames_does_not_open():
    with pytest.raises(DeviceStateError, match="no frames"):
        rig(Recording(SESSION, (RecordedCapture("camera", "camera", ()),)))


def test_closing_the_rig_switches_the_laser_off():
    opened, replay = rig()
    opened.laser.on()
    opened.close()
    assert not replay.laser_on
