"""What the GenICam drivers share, against features and frames that the test makes: no library, no time that goes by."""

import dataclasses

import numpy as np
import pytest

from rotaline.errors import DeviceConnectionError, DeviceLimitError, DeviceStateError, DeviceTimeoutError
from rotaline.hardware.camera import Region
from rotaline.hardware.clock import VirtualClock
from rotaline.hardware.genapi.camera import GenicamCamera, Options, RawFrame
from rotaline.hardware.genapi.counting import FrameCounter
from rotaline.hardware.genapi.device_time import DeviceTime
from rotaline.hardware.genapi.features import Limits, region_on_steps, set_number

CHOICES = {
    "PixelFormat": ("Mono8", "Mono12"),
    "ExposureAuto": ("Off", "Continuous"),
    "TriggerMode": ("Off", "On"),
    "TriggerSource": ("Software", "Line1"),
    "AcquisitionStatusSelector": ("FrameTriggerWait",),
}


class MadeUpCamera:
    """Features and transport of a camera whose clock runs 3 parts in 100000 fast, and began long ago."""

    device = "made-up camera 7"
    wraps = True

    def __init__(self, clock, *, latch=True, exposes_s=0.01, transfer_s=0.02):
        self.clock = clock
        self.transfer_s = transfer_s
        self.exposes_s = exposes_s
        self.values = {
            "ExposureTime": 5000.0,
            "ExposureAuto": "Continuous",
            "Gain": 0.0,
            "OffsetX": 0,
            "OffsetY": 0,
            "Width": 64,
            "Height": 48,
            "PixelFormat": "Mono8",
            "TriggerMode": "Off",
            "TriggerSource": "Line1",
            "TriggerSoftware": None,
            "AcquisitionStatusSelector": "FrameTriggerWait",
            "AcquisitionStatus": True,
        }
        if latch:
            self.values |= {
                "GevTimestampControlLatch": None,
                "GevTimestampValue": 0,
                "GevTimestampTickFrequency": 125_000_000,
            }
        self.written = []
        self.queue = []
        self.begins = []
        self.frame_id = 65_533
        self.late_by_s = 0.0
        self.gone = False
        self.running = False

    def ticks(self, time_s):
        return round((time_s * (1 + 3e-5) + 7e5) * 125e6)

    # features
    def has(self, name):
        return name in self.values

    def get(self, name):
        self.check()
        return self.values[name]

    def set(self, name, value):
        self.check()
        self.written.append((name, value))
        self.values[name] = value

    def execute(self, name):
        self.check()
        self.clock.wait(0.0002)
        if name == "GevTimestampControlLatch":
            self.values["GevTimestampValue"] = self.ticks(self.clock.now_s())
        else:
            self.expose(self.clock.now_s())
        self.clock.wait(0.0003)

    def expose(self, begin_s):
        self.frame_id = self.frame_id % 65_535 + 1
        there_s = begin_s + self.exposes_s + self.transfer_s + self.late_by_s
        self.queue.append((there_s, self.frame_id, begin_s))

    def limits(self, name):
        values = self.values
        return {
            "ExposureTime": Limits(20.0, 1e6),
            "Gain": Limits(0.0, 24.0, 0.5),
            "Width": Limits(16.0, 640.0 - values["OffsetX"], 16.0),
            "Height": Limits(2.0, 480.0 - values["OffsetY"], 2.0),
            "OffsetX": Limits(0.0, 640.0 - values["Width"], 4.0),
            "OffsetY": Limits(0.0, 480.0 - values["Height"], 2.0),
        }[name]

    def unit(self, name):
        return {"Gain": "dB"}.get(name, "")

    def entries(self, name):
        return CHOICES[name]

    # transport
    def start(self):
        self.running = True
        self.queue = []

    def stop(self):
        self.running = False
        self.queue = []

    def close(self):
        pass

    def check(self):
        if self.gone:
            raise DeviceConnectionError(f"{self.device}: gone")

    def receive(self, timeout_s):
        if not self.queue or self.queue[0][0] > self.clock.now_s() + timeout_s:
            self.clock.wait(timeout_s)
            return None
        there_s, frame_id, begin_s = self.queue.pop(0)
        self.clock.wait(there_s - self.clock.now_s())
        width, height = self.values["Width"], self.values["Height"]
        ticks = self.ticks(begin_s)
        self.begins.append(begin_s)
        return RawFrame(bytes(width * height), "Mono8", width, height, 0, frame_id, ticks)


@pytest.fixture
def clock():
    return VirtualClock(1000.0)


def opened(made_up, **options):
    return GenicamCamera(made_up, made_up, made_up.clock, Options(**options))


def ready(made_up, exposure_us=10_000.0):
    camera = opened(made_up)
    camera.configure(dataclasses.replace(camera.settings, exposure_us=exposure_us))
    return camera


def test_nothing_adjusts_itself_once_it_is_open(clock):
    made_up = MadeUpCamera(clock)
    camera = opened(made_up)
    assert made_up.values["ExposureAuto"] == "Off"
    assert camera.info.gain_unit == "dB"
    assert camera.info.sensor_size == (640, 480)
    assert camera.info.triggers == ("free", "line")


def test_ids_of_16_bit_go_round_and_leave_out_0():
    counter = FrameCounter(wraps=True)
    assert [counter.number(i) for i in (65_533, 65_534, 65_535, 1, 2, 5)] == [0, 1, 2, 3, 4, 7]


def test_a_gap_across_the_round_is_counted():
    counter = FrameCounter(wraps=True)
    assert [counter.number(i) for i in (65_530, 65_535, 4)] == [0, 5, 9]


def test_long_ids_do_not_go_round():
    counter = FrameCounter(wraps=True)
    assert [counter.number(i) for i in (65_535, 65_536, 65_540, 200_000)] == [0, 1, 5, 134_465]
    assert counter.number(3) is None


def test_a_frame_older_than_the_last_is_left_out_and_a_restart_counts_on():
    counter = FrameCounter(wraps=True)
    assert [counter.number(i) for i in (10, 12, 11, 13)] == [0, 2, None, 3]
    counter.restart()
    assert [counter.number(i) for i in (1, 2)] == [4, 5]


@pytest.mark.parametrize("latch", [True, False])
def test_times_are_within_their_uncertainty(clock, latch):
    made_up = MadeUpCamera(clock, latch=latch)
    camera = ready(made_up)
    errors, uncertainties = [], []
    for pause_s in (0.0, 0.1, 0.7, 3.0, 60.0, 600.0):
        clock.wait(pause_s)
        frame = camera.take(1.0)
        errors.append(frame.time_s - (made_up.begins[-1] + 0.005))
        uncertainties.append(frame.u_time_s)
    limit = np.sqrt(3) * np.array(uncertainties)  # of a uniform distribution, nothing lies beyond
    assert (np.abs(errors) <= limit + 1e-6).all()
    assert max(uncertainties) < (0.0003 if latch else 0.02)


def test_a_latch_that_counts_otherwise_is_not_believed(clock):
    made_up = MadeUpCamera(clock)
    latched = made_up.ticks
    made_up.ticks = lambda time_s: latched(time_s - 0.5)
    camera = ready(made_up)
    execute = made_up.execute

    def latch_other_time(name):
        execute(name)
        if name == "GevTimestampControlLatch":
            made_up.values["GevTimestampValue"] = latched(clock.now_s())

    made_up.execute = latch_other_time
    camera.take(1.0)  # by the latch it would have begun before its trigger; in a stream nothing would tell
    camera.start()
    for _ in range(10):
        clock.wait(1.0)
        made_up.expose(clock.now_s())
        frame = camera.next_frame(1.0)
        assert frame.time_s == pytest.approx(made_up.begins[-1] + 0.005, abs=np.sqrt(3) * frame.u_time_s + 1e-6)


def test_clocks_that_drift_apart_within_reason_do_not_contradict():
    times = DeviceTime(1000.0)
    assert times.observe(0, 5.0, 5.0)
    time_s, u_s = times.time_s(100_000)
    assert time_s == pytest.approx(105.0)
    assert u_s == pytest.approx(0.01 / np.sqrt(3)), "1e-4 of 100 s to both sides"
    assert times.observe(100_000, 105.009, 105.009)
    assert not times.observe(200_000, 205.03, 205.03)


def test_bounds_that_contradict_are_replaced():
    times = DeviceTime(1000.0)
    assert times.observe(1000, 10.0, 10.2)
    assert times.observe(1000, 10.1, 10.5)
    time_s, u_s = times.time_s(1000)
    assert time_s == pytest.approx(10.1), "no further from 10.1, the middle at first, than the bounds ask for"
    assert u_s == pytest.approx(np.hypot(0.1 / np.sqrt(12), 0.05))
    assert not times.observe(1000, 20.0, 20.2)
    assert times.time_s(1000)[0] == pytest.approx(20.0)


def test_a_small_contradiction_does_not_turn_the_order_of_frames_round():
    times = DeviceTime(1000.0)
    assert times.observe(0, 9.9999, 10.0001)
    before_s, _ = times.time_s(20)
    assert not times.observe(30, 10.0, 10.0295), "half a millisecond off, and known to 30 ms only"
    after_s, u_s = times.time_s(30)
    assert before_s < after_s <= 10.0295
    assert u_s > 0.0295 / np.sqrt(12)


def test_a_frame_that_comes_late_is_not_the_next_one(clock):
    made_up = MadeUpCamera(clock)
    camera = ready(made_up)
    camera.take(1.0)
    made_up.late_by_s = 0.6
    with pytest.raises(DeviceTimeoutError, match=r"made-up camera 7: no frame came within 0\.5 s"):
        camera.take(0.5)
    assert not made_up.running, "disarmed, and the late frame with it"
    made_up.late_by_s = 0.0
    asked_s = clock.now_s()
    frame = camera.take(1.0)
    assert made_up.begins[-1] >= asked_s
    assert frame.number == 1


def test_a_trigger_is_sent_when_the_camera_waits_for_it(clock):
    made_up = MadeUpCamera(clock)
    camera = ready(made_up)
    camera.take(1.0)
    made_up.values["AcquisitionStatus"] = False
    asked = len(made_up.begins)
    with pytest.raises(DeviceTimeoutError, match=r"not ready for a trigger after 0\.3 s"):
        camera.take(0.3)
    assert len(made_up.begins) == asked
    made_up.values["AcquisitionStatus"] = True
    camera.take(1.0)


def test_exposures_change_without_a_new_start(clock):
    made_up = MadeUpCamera(clock)
    camera = ready(made_up)
    camera.take(1.0)
    for exposure_us in (200.0, 400.0):
        camera.configure(dataclasses.replace(camera.settings, exposure_us=exposure_us))
        assert made_up.running, "bracketing costs no time"
        assert camera.take(1.0).settings.exposure_us == exposure_us


@pytest.mark.parametrize(
    ("wanted", "made"),
    [
        (Region(0, 0, 640, 480), Region(0, 0, 640, 480)),
        (Region(10, 11, 100, 100), Region(8, 10, 112, 102)),
        (Region(601, 475, 39, 5), Region(600, 474, 32, 6)),
        (Region(0, 0, 17, 3), Region(0, 0, 32, 4)),
    ],
)
def test_regions_come_onto_the_steps_of_the_camera(clock, wanted, made):
    made_up = MadeUpCamera(clock)
    camera = opened(made_up)
    assert region_on_steps(made_up, wanted, (640, 480)) == made
    assert camera.configure(dataclasses.replace(camera.settings, region=wanted)).region == made
    assert camera.take(1.0).image.shape == (made.height, made.width)


@pytest.mark.parametrize(
    ("name", "wanted", "made"), [("Gain", 3.3, 3.5), ("Gain", 24.0, 24.0), ("ExposureTime", 33.3, 33.3)]
)
def test_numbers_come_onto_the_steps_of_the_camera(clock, name, wanted, made):
    made_up = MadeUpCamera(clock)
    set_number(made_up, name, wanted)
    assert made_up.values[name] == made


def test_a_camera_without_ids_is_counted():
    counter = FrameCounter(wraps=False)
    assert [counter.number(i) for i in (None, None, 0, 0, 0)] == [0, 1, 2, 3, 4]


def test_what_was_set_before_an_error_is_known(clock):
    made_up = MadeUpCamera(clock)
    camera = opened(made_up)
    write = made_up.set

    def set_all_but_gain(name, value):
        if name == "Gain":
            raise DeviceStateError("locked")
        write(name, value)

    made_up.set = set_all_but_gain
    with pytest.raises(DeviceStateError, match="locked"):
        camera.configure(dataclasses.replace(camera.settings, exposure_us=321.0, gain=6.0))
    assert (camera.settings.exposure_us, camera.settings.gain) == (321.0, 0.0)


def test_a_stream_that_does_not_begin_leaves_nothing_behind(clock):
    made_up = MadeUpCamera(clock)
    camera = ready(made_up)
    begin = made_up.start

    def fail():
        raise DeviceStateError("no port")

    made_up.start = fail
    for call in (camera.start, lambda: camera.take(1.0)):
        with pytest.raises(DeviceStateError, match="no port"):
            call()
    made_up.start = begin
    assert camera.take(1.0).number == 0


def test_it_runs_free_again_once_it_is_closed(clock):
    made_up = MadeUpCamera(clock)
    camera = ready(made_up)
    camera.take(1.0)
    assert made_up.values["TriggerMode"] == "On"
    camera.close()
    assert made_up.values["TriggerMode"] == "Off"


def test_what_is_refused_is_refused_before_anything_is_set(clock):
    made_up = MadeUpCamera(clock)
    camera = opened(made_up)
    made_up.written.clear()
    good = dataclasses.replace(camera.settings, exposure_us=777.0, region=Region(0, 0, 32, 32))
    for bad in ({"gain": 30.0}, {"region": Region(600, 0, 64, 64)}, {"exposure_us": float("nan")}):
        with pytest.raises(DeviceLimitError, match="made-up camera 7"):
            camera.configure(dataclasses.replace(good, **bad))
    assert made_up.written == []


def test_a_camera_that_goes_away_in_the_middle_is_said_and_can_be_closed(clock):
    made_up = MadeUpCamera(clock)
    camera = ready(made_up)
    camera.start()
    made_up.gone = True
    with pytest.raises(DeviceConnectionError):
        camera.next_frame(5.0)
    camera.stop()
    with pytest.raises(DeviceConnectionError):
        camera.take(1.0)
    camera.close()
    with pytest.raises(DeviceStateError, match="closed"):
        camera.start()
