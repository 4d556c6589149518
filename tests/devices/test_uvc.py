"""Webcams, against a stand-in for OpenCV's VideoCapture: a camera that runs freely, with a queue of four frames, and late with its settings."""

import dataclasses
import math
import struct

import cv2
import numpy as np
import pytest
from tests.devices.contracts import CameraContract

from rotaline.errors import (
    DeviceConnectionError,
    DeviceLimitError,
    DeviceStateError,
    DeviceTimeoutError,
    LostFrameError,
)
from rotaline.hardware.camera import Region
from rotaline.hardware.cameras import uvc as adapter
from rotaline.hardware.cameras.frame_times import ArrivalTimes, StampGaps
from rotaline.hardware.cameras.uvc_controls import EXPOSURE, GAIN, Range, control_range, parsed_range, webcams
from rotaline.hardware.clock import VirtualClock
from rotaline.hardware.connections import Connections

PERIOD_S = 0.04
LATENCY_S = 0.01
"""From the end of an exposure until its frame begins to come."""


class Webcam:
    """``cv2.VideoCapture`` and the camera behind it, in virtual time.

    Frame k is exposed until k * PERIOD_S. Its pixels are BGR = (k, exposure in ms, k + column), each mod 256. Exposures take a change two frames late.
    """

    def __init__(self, clock, stamps=True):
        self.clock = clock
        self.stamps = stamps
        self.values = {
            cv2.CAP_PROP_FRAME_WIDTH: 64.0,
            cv2.CAP_PROP_FRAME_HEIGHT: 48.0,
            cv2.CAP_PROP_FPS: 1 / PERIOD_S,
            cv2.CAP_PROP_FOURCC: float(cv2.VideoWriter.fourcc(*"YUYV")),
            cv2.CAP_PROP_AUTO_EXPOSURE: 3.0,
            cv2.CAP_PROP_EXPOSURE: 100.0,
            cv2.CAP_PROP_AUTO_WB: 1.0,
            cv2.CAP_PROP_WB_TEMPERATURE: 4600.0,
            cv2.CAP_PROP_AUTOFOCUS: 1.0,
            cv2.CAP_PROP_FOCUS: 30.0,
            cv2.CAP_PROP_GAIN: 0.0,
        }
        self.stubborn = set()
        """Properties that nobody can change."""
        self.lost = set()
        """Frames that are lost on their way."""
        self.undecodable = set()
        self.unplugged = self.frozen = self.open_elsewhere = False
        self.signals = 0
        """So many waits end at once."""
        self.busy_s = 0.0
        """The computer is so busy that the program goes on so long after a frame has come."""
        self.delivered = 0
        self.grabbed = None
        self.pending = False
        self.exposures = [(0, 100.0)]
        self.is_open = True

    def isOpened(self):  # noqa: N802
        return self.is_open

    def release(self):
        self.is_open = False

    def get(self, prop):
        if prop == cv2.CAP_PROP_POS_MSEC:
            return 0.0 if self.grabbed is None or not self.stamps else 1000 * self.stamp_s(self.grabbed)
        return self.values.get(prop, -1.0)

    def set(self, prop, value):
        if prop in self.stubborn or prop not in self.values:
            return False
        if prop == cv2.CAP_PROP_EXPOSURE:
            self.exposures.append((math.ceil(self.clock.now_s() / PERIOD_S) + 2, value))
        self.values[prop] = value
        return True

    def stamp_s(self, k):
        return k * PERIOD_S + LATENCY_S

    def wait(self, seconds):
        """Until a frame is in the queue, or so long; it is grabbed then, but not before the last one was retrieved."""
        if self.unplugged:
            raise cv2.error("Error is reported for camera stream")
        if self.pending:
            return True
        if self.signals:
            self.signals -= 1
            return False
        end_s = self.clock.now_s() + seconds
        newest = math.floor((self.clock.now_s() - LATENCY_S) / PERIOD_S + 1e-9)
        k = max(self.delivered + 1, newest - 3)  # older ones did not fit into the queue
        while k in self.lost:
            k += 1
        if self.frozen or self.open_elsewhere or self.stamp_s(k) > end_s:
            self.clock.wait(seconds)
            return False
        self.clock.wait(self.stamp_s(k) - self.clock.now_s())
        self.clock.wait(self.busy_s)
        self.delivered = self.grabbed = k
        self.pending = True
        return True

    def retrieve(self):
        self.pending = False
        k = self.grabbed
        if k in self.undecodable:
            return False, None
        size = int(self.values[cv2.CAP_PROP_FRAME_HEIGHT]), int(self.values[cv2.CAP_PROP_FRAME_WIDTH])
        image = np.zeros((*size, 3), np.uint8)
        image[:, :, 0] = k % 256
        image[:, :, 1] = int([value for since, value in self.exposures if since <= k][-1] / 10) % 256
        image[:, :, 2] = (k + np.arange(size[1])) % 256
        return True, image


RANGES = {EXPOSURE: Range(1, 5000, 1), GAIN: Range(0, 100, 5)}


def opened(webcam, backend=adapter.V4L2, ranges=RANGES, device="/dev/null", **keys):
    settings = adapter.Settings(driver="uvc", device=device, latency_s=0.012, **keys)
    return adapter.UvcCamera(webcam, settings, webcam.clock, backend, webcam.wait, ranges.get)


@pytest.fixture
def webcam():
    return Webcam(VirtualClock(5.0))


@pytest.fixture
def camera(webcam):
    return opened(webcam)


class TestV4L2(CameraContract):
    @pytest.fixture
    def camera(self, camera):
        return camera


class TestWithoutStamps(CameraContract):
    """As on Windows: no time stamps, exposures in powers of two."""

    @pytest.fixture
    def camera(self):
        webcam = Webcam(VirtualClock(5.0), stamps=False)
        webcam.values[cv2.CAP_PROP_EXPOSURE] = -7.0
        return opened(webcam, adapter.MEDIA_FOUNDATION, {}, exposure_min_us=1e6 / 2**13, exposure_max_us=1e6 / 2**3)

    def between(self, camera):
        return 1e6 / 2**6


class TestWithoutColours(CameraContract):
    @pytest.fixture
    def camera(self, webcam):
        return opened(webcam, colour=False)


def test_what_it_says_of_itself(camera):
    assert camera.info.device == "webcam /dev/null (V4L2)"
    assert camera.info.exposure_limits_us == (100.0, 500_000.0)
    assert camera.info.gain_limits == (0.0, 100.0)
    assert camera.info.triggers == ("free",)


def test_automatics_are_off(webcam):
    opened(webcam, focus=120.0, white_balance_k=5000.0)
    expected = {
        cv2.CAP_PROP_AUTO_EXPOSURE: 1.0,
        cv2.CAP_PROP_AUTO_WB: 0.0,
        cv2.CAP_PROP_AUTOFOCUS: 0.0,
        cv2.CAP_PROP_FOCUS: 120.0,
        cv2.CAP_PROP_WB_TEMPERATURE: 5000.0,
    }
    assert {prop: webcam.values[prop] for prop in expected} == expected


@pytest.mark.parametrize(
    ("prop", "said"),
    [
        (cv2.CAP_PROP_AUTO_EXPOSURE, "automatic exposure off"),
        (cv2.CAP_PROP_AUTO_WB, "automatic white balance off"),
        (cv2.CAP_PROP_AUTOFOCUS, "automatic focus off"),
    ],
)
def test_what_stays_automatic_is_said(webcam, prop, said):
    webcam.stubborn.add(prop)
    with pytest.raises(DeviceStateError, match=rf"webcam.*{said} was asked for"):
        opened(webcam)


def test_a_camera_without_focus_and_white_balance_is_as_good(webcam):
    for prop in (cv2.CAP_PROP_AUTO_WB, cv2.CAP_PROP_AUTOFOCUS, cv2.CAP_PROP_FOCUS, cv2.CAP_PROP_WB_TEMPERATURE):
        del webcam.values[prop]
    assert opened(webcam).take(1.0).number > 0
    with pytest.raises(DeviceStateError, match="focus 10 was asked for, it has -1"):
        opened(webcam, focus=10.0)


def test_an_exposure_that_does_not_take_is_said_and_the_old_one_stays(camera, webcam):
    before = camera.settings
    webcam.stubborn.add(cv2.CAP_PROP_EXPOSURE)
    with pytest.raises(DeviceStateError, match=r"exposure 20000 us \(control 200\) was asked for, it has 100"):
        camera.configure(dataclasses.replace(before, exposure_us=20_000.0))
    assert camera.settings == before


def test_exposures_that_nobody_knows_the_limits_of_are_asked_for(webcam):
    with pytest.raises(DeviceStateError, match="exposure_min_us and exposure_max_us"):
        opened(webcam, ranges={})
    camera = opened(webcam, ranges={}, exposure_min_us=300.0, exposure_max_us=40_000.0)
    assert camera.info.exposure_limits_us == (300.0, 40_000.0)
    assert camera.info.gain_limits is None
    with pytest.raises(DeviceLimitError, match="gain of this camera cannot be set"):
        camera.configure(dataclasses.replace(camera.settings, gain=1.0))


def test_exposure_and_gain_go_in_the_steps_of_the_camera(camera, webcam):
    made = camera.configure(dataclasses.replace(camera.settings, exposure_us=1234.0, gain=12.0))
    assert (made.exposure_us, made.gain) == (1200.0, 10.0)
    assert webcam.values[cv2.CAP_PROP_EXPOSURE] == 12.0


def test_a_frame_began_after_the_call(camera, webcam):
    camera.configure(dataclasses.replace(camera.settings, exposure_us=20_000.0))
    for pause_s in (0.0, 0.013, 1.0):
        webcam.clock.wait(pause_s)
        called_s = webcam.clock.now_s()
        frame = camera.take(5.0)
        began_s = webcam.grabbed * PERIOD_S - 0.02
        assert began_s >= called_s
        assert frame.image[0, 0, 2] == webcam.grabbed % 256
        assert abs(frame.time_s - (began_s + 0.01)) < 3 * frame.u_time_s


@pytest.mark.parametrize("busy_s", [0.0, 0.03])
def test_without_stamps_a_frame_began_after_the_call_too(busy_s):
    webcam = Webcam(VirtualClock(5.0), stamps=False)
    camera = opened(webcam)
    webcam.busy_s = busy_s
    for pause_s in (0.0, 0.013, 1.0):
        webcam.clock.wait(pause_s)
        called_s = webcam.clock.now_s()
        frame = camera.take(5.0)
        middle_s = webcam.grabbed * PERIOD_S - 0.005
        assert middle_s - 0.005 >= called_s
        assert abs(frame.time_s - middle_s) < 3 * frame.u_time_s


def test_frames_with_the_old_exposure_are_thrown_away(camera):
    """The stand-in makes a change two frames late."""
    for exposure_us in (20_000.0, 5000.0):
        camera.configure(dataclasses.replace(camera.settings, exposure_us=exposure_us))
        assert camera.take(5.0).image[0, 0, 1] == exposure_us / 1000


def test_colours_are_red_green_blue(camera, webcam):
    image = camera.take(5.0).image
    k = webcam.grabbed
    assert image[3, 7].tolist() == [(k + 7) % 256, 10, k % 256]
    assert image.flags.c_contiguous


def test_the_region_is_cut_out(camera, webcam):
    camera.configure(dataclasses.replace(camera.settings, region=Region(5, 2, 20, 10)))
    image = camera.take(5.0).image
    assert image.shape == (10, 20, 3)
    assert image[0, 0, 0] == (webcam.grabbed + 5) % 256


def test_lost_frames_are_a_gap_in_the_numbers(camera, webcam):
    camera.start()
    numbers = [camera.next_frame(1.0).number for _ in range(3)]
    webcam.lost = {webcam.grabbed + 2, webcam.grabbed + 3}
    numbers += [camera.next_frame(1.0).number for _ in range(3)]
    assert np.diff(numbers).tolist() == [1, 1, 1, 3, 1]


def test_a_program_that_is_too_slow_finds_the_gap(camera, webcam):
    """The queue holds four frames; ten periods later others were there."""
    camera.start()
    before = camera.next_frame(1.0), webcam.grabbed
    webcam.clock.wait(10 * PERIOD_S)
    after = camera.next_frame(1.0), webcam.grabbed
    assert after[1] - before[1] > 4
    assert after[0].number - before[0].number == after[1] - before[1]


def test_a_frame_that_cannot_be_decoded_raises_and_the_next_one_comes(camera, webcam):
    camera.start()
    number = camera.next_frame(1.0).number
    webcam.undecodable = {webcam.grabbed + 1}
    with pytest.raises(LostFrameError, match="cannot be decoded"):
        camera.next_frame(1.0)
    assert camera.next_frame(1.0).number == number + 2


def test_a_camera_that_gives_no_frames_is_a_time_out(camera, webcam):
    webcam.frozen = True
    before_s = webcam.clock.now_s()
    with pytest.raises(DeviceTimeoutError, match=r"webcam.*1 s.*10000 us"):
        camera.take(1.0)
    assert webcam.clock.now_s() - before_s == pytest.approx(1.0, abs=0.05)
    webcam.frozen = False
    assert camera.take(1.0).number > 0


def test_a_time_out_that_is_too_short_for_a_fresh_frame(camera):
    with pytest.raises(DeviceTimeoutError, match="settle_frames"):
        camera.take(0.02)


@pytest.mark.parametrize("streams", [False, True])
def test_unplugged_is_a_lost_connection(camera, webcam, streams):
    if streams:
        camera.start()
    webcam.unplugged = True
    with pytest.raises(DeviceConnectionError, match=r"webcam.*cable"):
        camera.next_frame(1.0) if streams else camera.take(1.0)
    camera.stop()
    camera.close()
    assert not webcam.is_open


def test_waits_that_end_at_once(camera, webcam):
    """As they do when a signal comes, such as that of a window that changes its size; or for ever, when the camera is gone."""
    webcam.signals = 3
    assert camera.take(1.0).number > 0
    webcam.signals = 1000
    with pytest.raises(DeviceConnectionError, match="cable"):
        camera.take(1.0)


def test_a_device_file_that_is_gone_is_a_lost_connection(webcam, tmp_path):
    device = tmp_path / "video0"
    device.touch()
    camera = opened(webcam, device=str(device))
    device.unlink()
    webcam.frozen = True
    with pytest.raises(DeviceConnectionError, match="cable"):
        camera.take(1.0)


def test_another_program_that_holds_it_is_said(webcam):
    webcam.open_elsewhere = True
    with pytest.raises(DeviceConnectionError, match=r"gives no frame. Another program"):
        opened(webcam)


def test_the_format_is_asked_for_and_read_back(webcam):
    camera = opened(webcam, width=160, height=120, fourcc="MJPG", frame_rate_hz=25.0)
    assert camera.info.sensor_size == (160, 120)
    webcam.stubborn = {cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT}
    with pytest.raises(DeviceStateError, match=r"1280 x 960 px were asked for, it gives 160 x 120 px"):
        opened(webcam, width=1280, height=960)
    webcam.stubborn = {cv2.CAP_PROP_FOURCC}
    with pytest.raises(DeviceStateError, match="fourcc = 'YUYV'"):
        opened(webcam, fourcc="YUYV")


def test_a_webcam_that_is_not_there():
    with pytest.raises(DeviceConnectionError, match=r"there is no /dev/video99"):
        adapter.open_device(adapter.Settings(driver="uvc", device=99), VirtualClock(), Connections())


def test_a_file_that_is_no_camera(tmp_path):
    (tmp_path / "video0").touch()
    settings = adapter.Settings(driver="uvc", device=str(tmp_path / "video0"))
    with pytest.raises(DeviceConnectionError, match="cannot be opened"):
        adapter.open_device(settings, VirtualClock(), Connections())


def test_limits_of_a_control():
    answer = struct.pack("=II32siiiiIII", EXPOSURE, 1, b"Exposure Time, Absolute", 3, 2047, 1, 250, 0, 0, 0)
    assert parsed_range(answer) == Range(3, 2047, 1)
    assert parsed_range(answer[:56] + struct.pack("=I", 1) + answer[60:]) is None, "disabled"
    assert control_range("/dev/null", EXPOSURE) is None
    assert control_range("/nowhere", EXPOSURE) is None


def test_finds_webcams_by_their_lasting_names(tmp_path, monkeypatch):
    system, devices = tmp_path / "sys", tmp_path / "dev"
    for node, name, index in (("video0", "C920", "0"), ("video1", "C920", "1"), ("video10", "Microscope", "0")):
        (system / node).mkdir(parents=True)
        (system / node / "name").write_text(name + "\n")
        (system / node / "index").write_text(index + "\n")
    (devices / "v4l" / "by-id").mkdir(parents=True)
    (devices / "video0").touch()
    (devices / "v4l" / "by-id" / "usb-C920-index0").symlink_to(devices / "video0")
    there = webcams(system, devices)
    assert there == [
        ("C920", str(devices / "v4l/by-id/usb-C920-index0")),
        ("Microscope", str(devices / "video10")),
    ]
    monkeypatch.setattr(adapter, "webcams", lambda: there)
    assert adapter.find()[1].toml == f'driver = "uvc"\ndevice = "{devices / "video10"}"'


def test_steps_of_time_stamps():
    gaps = StampGaps(0.0)
    assert [gaps.step(t) for t in (1.0, 1.1, 1.2, 1.4, 1.51, None, 1.9, 2.0)] == [1, 1, 1, 2, 1, 1, 1, 1]
    gaps = StampGaps(0.1)
    assert [gaps.step(t) for t in (1.0, 1.09, 1.3)] == [1, 1, 2]
    gaps.restart()
    assert gaps.step(9.0) == 1


def test_times_of_arrival():
    clock = VirtualClock(10.0)
    times = ArrivalTimes(clock, latency_s=0.03)
    times.begun()
    clock.wait(0.01)
    times.none_waiting()
    clock.wait(0.02)
    middle_s, u_s = times.arrived(10_000.0)
    assert (middle_s, u_s) == (pytest.approx(10.02 - 0.005), pytest.approx(0.02 / math.sqrt(12))), (
        "ended at 10.01 to 10.03"
    )
    clock.wait(1.0)
    times.none_waiting()
    clock.wait(0.01)
    middle_s, u_s = times.arrived(10_000.0)
    assert (middle_s, u_s) == (pytest.approx(11.02 - 0.005), pytest.approx(0.04 / math.sqrt(12))), (
        "ended at 11.00 to 11.04"
    )
    clock.wait(0.5)
    assert times.arrived(10_000.0)[1] == pytest.approx(0.54 / math.sqrt(12)), "it may have waited in the queue"
    assert times.began_after(10.98, 10_000.0)
    assert not times.began_after(10.995, 10_000.0)
