"""MindVision cameras, against a library that stands in for the vendor's (compiled here: needs a C compiler)."""

import ctypes
import ctypes.util
import dataclasses
import shutil
import subprocess
from pathlib import Path

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
from rotaline.hardware.cameras import mindvision as adapter
from rotaline.hardware.cameras.mindvision_library import (
    Capability,
    DeviceInfo,
    FrameHead,
    Library,
    Resolution,
    Statistic,
)
from rotaline.hardware.clock import SystemClock, VirtualClock
from rotaline.hardware.connections import Connections

SOURCE = Path(__file__).with_name("mindvision_stand_in.c")


@pytest.fixture(scope="session")
def library_path(tmp_path_factory):
    compiler = next((name for name in ("cc", "gcc", "clang") if shutil.which(name)), None)
    if compiler is None:
        pytest.skip("a C compiler is needed to build the stand-in for MindVision's library: apt install gcc")
    made = tmp_path_factory.mktemp("mindvision") / "libMVSDK.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", str(made), str(SOURCE)], check=True, timeout=60)
    return str(made)


class StandIn:
    """The camera itself: what a test does to it, and looks at."""

    def __init__(self, path):
        self.path = path
        self._library = ctypes.CDLL(path)
        self._library.stand_in_reset()

    def set(self, **values):
        for name, value in values.items():
            self._library.stand_in_set(name.encode(), value)

    def get(self, name):
        return self._library.stand_in_get(name.encode())

    def opened(self, clock=None, **keys):
        settings = adapter.Settings(driver="mindvision", library=self.path, latency_s=0.001, **keys)
        return adapter.open_device(settings, clock or SystemClock(), Connections())


@pytest.fixture
def stand_in(library_path):
    stand_in = StandIn(library_path)
    yield stand_in
    assert stand_in.get("releases_missing") == 0, "every buffer was given back"


@pytest.fixture
def camera(stand_in):
    camera = stand_in.opened()
    yield camera
    camera.close()
    assert not stand_in.get("is_open")


class SlowClock(VirtualClock):
    """A tenth of a millisecond goes by whenever somebody looks at it."""

    def now_s(self):
        self.wait(1e-4)
        return super().now_s()


class TestMono(CameraContract):
    @pytest.fixture
    def camera(self, camera):
        return camera


class TestColour(CameraContract):
    @pytest.fixture
    def camera(self, stand_in):
        stand_in.set(colour=1)
        camera = stand_in.opened()
        yield camera
        camera.close()


class TestWithoutSoftwareTrigger(CameraContract):
    @pytest.fixture
    def camera(self, stand_in):
        stand_in.set(triggers=1, every_second_waits=1)
        camera = stand_in.opened()
        camera.configure(dataclasses.replace(camera.settings, exposure_us=1000.0))
        yield camera
        camera.close()


def test_what_it_says_of_itself(camera):
    info = camera.info
    assert info.device == "MindVision MV-U300 049000000001"
    assert info.sensor_size == (64, 48)
    assert info.exposure_limits_us == (25.0, 200_000.0)
    assert info.gain_limits == (1.0, 8.0)
    assert info.gain_unit == "x"
    assert info.triggers == ("free", "line")


def test_automatics_are_off_and_processing_does_nothing(camera, stand_in):
    assert [stand_in.get(name) for name in ("auto_exposure", "gamma", "contrast", "mirrored")] == [0, 100, 100, 0]


def test_automatic_exposure_that_stays_on_is_said(stand_in):
    stand_in.set(auto_stays=1)
    with pytest.raises(DeviceStateError, match="automatic exposure stays on"):
        stand_in.opened()
    assert not stand_in.get("is_open"), "it was let go"


def test_a_model_without_sharpening_is_as_good(stand_in):
    stand_in.set(no_sharpness=1)
    stand_in.opened().close()


def test_the_frame_is_that_of_its_trigger(camera, stand_in):
    camera.configure(dataclasses.replace(camera.settings, exposure_us=30_010.0, gain=2.0))
    assert camera.settings.exposure_us == 30_000.0, "whole lines"
    assert stand_in.get("gain") == 16
    for n in (1, 2, 3):
        image = camera.take(1.0).image
        assert image[0, :2].tolist() == [n, 30]
        assert image[5].tolist() == list(range(5, 69))


def test_colour_is_red_green_blue(stand_in):
    stand_in.set(colour=1)
    camera = stand_in.opened()
    assert camera.take(1.0).image[20, 10].tolist() == [30, 20, 10]
    camera.close()


def test_rows_may_come_from_below(stand_in):
    camera = stand_in.opened(rows_from_below=True)
    image = camera.take(1.0).image
    camera.close()
    assert image[0].tolist() == list(range(47, 111))
    assert image.flags.c_contiguous


def test_a_region_is_in_the_steps_of_the_sensor(camera):
    made = camera.configure(dataclasses.replace(camera.settings, region=Region(6, 5, 42, 20)))
    assert made.region == Region(4, 5, 40, 20)
    assert camera.take(1.0).image.shape == (20, 40)
    with pytest.raises(DeviceLimitError, match=r"region.*16 x 4"):
        camera.configure(dataclasses.replace(camera.settings, region=Region(0, 0, 15, 20)))


def test_a_setting_that_fails_leaves_all_as_it_was(camera, stand_in):
    before = camera.settings
    stand_in.set(fail_gain=1)
    with pytest.raises(DeviceLimitError, match="CameraSetAnalogGain"):
        camera.configure(dataclasses.replace(before, exposure_us=500.0, gain=3.0, region=Region(4, 5, 40, 20)))
    assert camera.settings == before
    frame = camera.take(1.0)
    assert frame.image.shape == (48, 64)
    assert frame.image[0, 1] == before.exposure_us / 1000


def test_frames_that_the_library_lost_are_a_gap(camera, stand_in):
    camera.start()
    numbers = [camera.next_frame(1.0).number]
    stand_in.set(lose=3)
    numbers += [camera.next_frame(1.0).number for _ in range(2)]
    camera.stop()
    assert numbers == [0, 4, 5]


def test_a_damaged_frame_raises_and_the_next_one_comes(camera, stand_in):
    camera.start()
    first = camera.next_frame(1.0).number
    stand_in.set(damage=1)
    with pytest.raises(LostFrameError, match=r"MV-U300.*data are missing.*again"):
        camera.next_frame(1.0)
    assert camera.next_frame(1.0).number == first + 2
    camera.stop()
    stand_in.set(damage=1)
    with pytest.raises(LostFrameError):
        camera.take(1.0)
    assert camera.take(1.0).image[0, 0] == stand_in.get("exposures")


def test_a_late_frame_is_a_time_out_and_not_taken_for_the_next_one(camera, stand_in):
    camera.take(1.0)
    stand_in.set(late=1)
    with pytest.raises(DeviceTimeoutError, match=r"MV-U300.*0.05 s.*10000 us"):
        camera.take(0.05)
    assert stand_in.get("pending") == 0, "the exposure that was under way was given up"
    stand_in.set(late=0)
    assert camera.take(1.0).image[0, 0] == 2


def test_an_interruption_gives_the_exposure_up(camera, stand_in, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    stand_in.set(late=1)
    with monkeypatch.context() as patched:
        patched.setattr(camera, "_wait_for_buffer", interrupted)
        with pytest.raises(KeyboardInterrupt):
            camera.take(1.0)
    assert stand_in.get("pending") == 0
    stand_in.set(late=0)


def test_no_edge_at_the_input_is_a_time_out(camera):
    camera.configure(dataclasses.replace(camera.settings, trigger="line"))
    camera.start()
    with pytest.raises(DeviceTimeoutError, match="trigger"):
        camera.next_frame(0.01)
    camera.stop()
    assert camera.take(1.0).settings.trigger == "line"


def test_without_a_trigger_frames_are_thrown_away_until_one_is_fresh(stand_in):
    """The stand-in always has a frame; for 2 ms (exposure and latency) after the call it may be an old one."""
    stand_in.set(triggers=1, every_second_waits=1)
    camera = stand_in.opened(SlowClock())
    camera.configure(dataclasses.replace(camera.settings, exposure_us=1000.0))
    before = stand_in.get("exposures")
    frame = camera.take(1.0)
    assert stand_in.get("exposures") > before + 1
    assert frame.image[0, 0] == stand_in.get("exposures") % 256
    camera.close()


def test_a_camera_that_has_become_silent_is_a_lost_connection(camera, stand_in):
    """The library says only time-out when a USB camera is unplugged: it is asked."""
    stand_in.set(silent=1)
    with pytest.raises(DeviceConnectionError, match=r"does not answer any more.*cable"):
        camera.take(0.01)
    stand_in.set(silent=0)


def test_structures_have_the_sizes_of_the_header(library_path):
    """What the library writes into them fits."""
    library = ctypes.CDLL(library_path)
    for structure in (DeviceInfo, Resolution, Capability, FrameHead, Statistic):
        assert ctypes.sizeof(structure) == library.stand_in_size(structure.__name__.encode())


@pytest.mark.parametrize("streams", [False, True])
def test_unplugged_is_a_lost_connection(stand_in, streams):
    camera = stand_in.opened()
    if streams:
        camera.start()
    stand_in.set(unplugged=1)
    with pytest.raises(DeviceConnectionError, match=r"MV-U300.*cable"):
        camera.next_frame(1.0) if streams else camera.take(1.0)
    camera.stop()
    camera.close()
    assert not stand_in.get("is_open")


def test_another_program_that_holds_it_is_named(stand_in):
    stand_in.set(held=1)
    with pytest.raises(DeviceConnectionError, match="another program holds"):
        stand_in.opened()
    stand_in.set(held=0)
    camera = stand_in.opened()
    with pytest.raises(DeviceConnectionError, match="already open"):
        stand_in.opened()
    camera.close()


def test_none_or_several_cameras_are_said(stand_in):
    stand_in.set(cameras=0)
    with pytest.raises(DeviceConnectionError, match="connected: none"):
        stand_in.opened()
    stand_in.set(cameras=2)
    with pytest.raises(DeviceConnectionError, match=r"049000000001, .*049000000002.*serial"):
        stand_in.opened()
    camera = stand_in.opened(serial="049000000002")
    assert camera.info.device.endswith("049000000002")
    camera.close()


def test_finds_what_is_connected(stand_in, monkeypatch):
    monkeypatch.setattr(adapter.mv, "Library", lambda _: Library(stand_in.path))
    (found,) = adapter.find()
    assert found.name == "MindVision MV-U300 049000000001"
    assert found.toml == 'driver = "mindvision"\nserial = "049000000001"'


@pytest.mark.parametrize("path", ["/nowhere/libMVSDK.so", None])
def test_without_the_library_the_sentence_says_what_to_install(path):
    if path is None:
        try:
            ctypes.CDLL("libMVSDK.so")
        except OSError:
            pass
        else:
            pytest.skip("the vendor's library is installed here")
    with pytest.raises(DeviceConnectionError, match=r"MindVision.*libMVSDK.so.*Install MindVision's SDK"):
        Library(path)


def test_a_library_that_is_something_else_is_refused():
    with pytest.raises(DeviceConnectionError, match="cannot be loaded"):
        Library(ctypes.util.find_library("c") or "libc.so.6")
