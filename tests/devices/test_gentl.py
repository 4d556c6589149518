"""The ``gentl`` driver against the GenTL producer that the ``genicam`` package brings along: a game with the interface of a camera."""

import contextlib
import dataclasses
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from tests.devices.contracts import CameraContract

from rotaline.errors import DeviceConnectionError, DeviceLimitError, DeviceStateError, DeviceTimeoutError
from rotaline.hardware.camera import Region
from rotaline.hardware.cameras import gentl
from rotaline.hardware.clock import SystemClock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import find_devices, settings_type

NEEDED = "needs the libraries: pip install 'rotaline[gentl]'"
pytest.importorskip("harvesters.core", reason=NEEDED)
PRODUCER = Path(pytest.importorskip("genicam", reason=NEEDED).__file__).parent / "viky.cti"
if not PRODUCER.is_file():
    pytest.skip(f"this version of 'genicam' has no {PRODUCER.name}", allow_module_level=True)


@pytest.fixture
def connections():
    connections = Connections()
    yield connections
    connections.close()


@pytest.fixture
def opened(connections):
    """A function that opens a camera of the producer; closed afterwards, before the producer is."""
    with contextlib.ExitStack() as stack:

        def open_it(serial="1", rate_hz=200.0, **keys):
            keys = {"exposure_us": 1000.0, "pixel_format": "Mono8", "buffers": 4, **keys}
            settings = gentl.Settings(
                driver="gentl",
                producer=str(PRODUCER),
                serial=serial,
                features={"AcquisitionFrameRate": rate_hz},
                **keys,
            )
            camera = gentl.open_device(settings, SystemClock(), connections)
            stack.callback(camera.close)
            return camera

        yield open_it


class TestGentlCamera(CameraContract):
    """The game has no exposure time, no offsets and no triggers: so it runs free for each frame."""

    no_region = "the game's picture has no offsets"

    @pytest.fixture
    def camera(self, opened):
        return opened()

    def test_says_what_it_is(self, camera):
        info = camera.info
        assert info.device == "gentl Machine Vision Games Ltd. Viky 1"
        assert info.sensor_size == (800, 800)
        assert info.exposure_limits_us == (1000.0, 1000.0)
        assert (info.bit_depth, info.colour, info.triggers) == (8, False, ("free",))


def with_region(camera, region):
    return dataclasses.replace(camera.settings, region=region)


def test_a_region_that_begins_at_0_is_read(opened):
    camera = opened()
    made = camera.configure(with_region(camera, Region(0, 0, 321, 123)))
    assert made.region == Region(0, 0, 321, 123)
    assert camera.take(2.0).image.shape == (123, 321)
    assert camera.configure(with_region(camera, None)).region == Region(0, 0, 800, 800)


@pytest.mark.parametrize("region", [Region(8, 0, 400, 400), Region(0, 0, 50, 400), Region(0, 0, 801, 400)])
def test_a_region_that_it_cannot_read_is_refused_and_nothing_changes(opened, region):
    camera = opened()
    before = camera.settings
    with pytest.raises(DeviceLimitError, match="region"):
        camera.configure(with_region(camera, region))
    assert camera.settings == before
    assert camera.take(2.0).image.shape == (before.region.height, before.region.width)


def test_colour_frames_are_red_green_blue(opened):
    image = opened(pixel_format="RGBa8").take(2.0).image
    assert image.shape == (400, 400, 3)
    assert image.dtype == np.uint8
    assert np.ptp(image) > 50, "the game is no flat field"


def test_an_exposure_that_cannot_be_set_has_to_be_stated(opened):
    with pytest.raises(DeviceStateError, match=r"no ExposureTime\. State 'exposure_us'"):
        opened(exposure_us=None)
    assert opened().take(2.0).number == 0, "it was let go"


def test_a_time_out(opened):
    camera = opened(rate_hz=3.0)
    camera.start()
    camera.next_frame(2.0)
    with pytest.raises(DeviceTimeoutError, match=r"no frame came within 0\.05 s"):
        camera.next_frame(0.05)


def test_a_camera_that_is_held_is_refused(opened):
    opened()
    with pytest.raises(DeviceConnectionError, match=r"another program holds it .* Close that program"):
        opened()


def test_two_cameras_share_one_producer(opened):
    first, second = opened(serial="0"), opened(serial="2")
    assert first.take(2.0).number == second.take(2.0).number == 0
    assert first.info.device != second.info.device


def test_which_camera_has_to_be_stated(opened):
    with pytest.raises(DeviceConnectionError, match=r"several cameras: .*serial 0.*serial 1.*State serial or id"):
        opened(serial=None)
    with pytest.raises(DeviceConnectionError, match="no camera 77"):
        opened(serial="77")
    assert opened(serial=None, id="VikyTL_DEV_blue").take(2.0).image.shape == (400, 400)


def test_no_producer_says_where_it_is_looked_for(opened, monkeypatch, tmp_path):
    monkeypatch.delenv("GENICAM_GENTL64_PATH", raising=False)
    settings = gentl.Settings(driver="gentl")
    with pytest.raises(DeviceConnectionError, match=r"GENICAM_GENTL64_PATH \(not set\)"):
        gentl.open_device(settings, SystemClock(), Connections())
    missing = str(tmp_path / "none.cti")
    with pytest.raises(DeviceConnectionError, match=r"no producer .*none\.cti"):
        gentl.open_device(gentl.Settings(driver="gentl", producer=missing), SystemClock(), Connections())


def test_a_file_that_is_no_producer(tmp_path, capfd):
    broken = tmp_path / "broken.cti"
    broken.write_text("no library")
    with pytest.raises(DeviceConnectionError, match=r"broken\.cti"):
        gentl.open_device(gentl.Settings(driver="gentl", producer=str(broken)), SystemClock(), Connections())
    assert capfd.readouterr() == ("", "")


def test_finds_what_the_producers_see(monkeypatch):
    monkeypatch.setenv("GENICAM_GENTL64_PATH", str(PRODUCER.parent))
    found = find_devices("camera", "gentl")
    tables = [settings_type("camera", "gentl").model_validate(tomllib.loads(device.toml)) for device in found]
    assert [table.serial for table in tables] == ["0", "1", "2"]
    monkeypatch.delenv("GENICAM_GENTL64_PATH")
    assert find_devices("camera", "gentl") == ()


def test_a_missing_library_is_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "harvesters", None)
    monkeypatch.setitem(sys.modules, "harvesters.core", None)
    with pytest.raises(DeviceConnectionError, match=r"pip install 'rotaline\[gentl\]'"):
        find_devices("camera", "gentl")
