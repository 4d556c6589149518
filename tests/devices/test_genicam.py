"""The ``genicam`` driver against cameras that need no hardware: the library's own GigE and USB3 cameras, and Aravis' over loopback."""

import contextlib
import dataclasses
import fcntl
import itertools
import shutil
import struct
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

import numpy as np
import pytest
from tests.devices.contracts import CameraContract

from rotaline.errors import (
    DeviceConnectionError,
    DeviceError,
    DeviceLimitError,
    DeviceStateError,
    DeviceTimeoutError,
    LostFrameError,
)
from rotaline.hardware.cameras import genicam
from rotaline.hardware.clock import SystemClock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import find_devices, settings_type

NEEDED = "needs the library: pip install 'rotaline[genicam]'"
library = pytest.importorskip("viva_genicam", reason=NEEDED)
testing = pytest.importorskip("viva_genicam.testing", reason=NEEDED)

LOOPBACK = "127.0.0.1"
ARAVIS = shutil.which("arv-fake-gv-camera-0.8")
needs_aravis = pytest.mark.skipif(ARAVIS is None, reason="needs Aravis' fake camera: apt-get install aravis-tools")


def open_camera(**keys):
    settings = genicam.Settings(driver="genicam", interface=LOOPBACK, **keys)
    return genicam.open_device(settings, SystemClock(), Connections())


@contextlib.contextmanager
def only_one_gige_camera():
    """GigE cameras answer at UDP port 3956: this machine has one of them, and tests run in several processes."""
    with (Path(tempfile.gettempdir()) / "rotaline-tests-gige-port").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@pytest.fixture
def gige_port():
    with only_one_gige_camera():
        yield


@pytest.fixture
def gige(gige_port):
    """A function that switches the library's GigE camera on, with the faults that a test states; switched off afterwards."""
    with contextlib.ExitStack() as stack:

        def switch_on(**faults):
            return stack.enter_context(testing.FakeGigeCamera(**{"width": 160, "height": 120, "fps": 100, **faults}))

        yield switch_on


@pytest.fixture
def opened():
    """A function that opens a camera; closed afterwards."""
    with contextlib.ExitStack() as stack:

        def open_it(**keys):
            camera = open_camera(**keys)
            stack.callback(camera.close)
            return camera

        yield open_it


class GigeContract(CameraContract):
    def test_a_region_is_read_and_given_back(self, camera, monkeypatch):
        """The whole sensor is 4 to 16 MB at once: a busy machine loses packets of it, and what is lost is taken again."""
        take = camera.take

        def take_again(timeout_s):
            for _ in range(9):
                with contextlib.suppress(LostFrameError):
                    return take(timeout_s)
            return take(timeout_s)

        monkeypatch.setattr(camera, "take", take_again)
        super().test_a_region_is_read_and_given_back(camera)


class TestGigeCamera(GigeContract):
    @pytest.fixture
    def camera(self, gige, opened):
        gige()
        return opened()


class TestUsbCamera(CameraContract):
    """Over USB3 Vision's own protocol; this camera has no exposure time, and no software trigger that works."""

    no_region = "the library's USB3 camera has no offsets"

    @pytest.fixture
    def camera(self):
        device = testing.FakeU3vCamera(160, 120).connect()
        camera = genicam.use_camera(device, genicam.Settings(driver="genicam", exposure_us=1000.0), SystemClock())
        yield camera
        camera.close()

    def test_says_what_it_is(self, camera):
        assert camera.info.exposure_limits_us == (1000.0, 1000.0)


@contextlib.contextmanager
def started_aravis(*arguments):
    """Aravis' camera as a process, when it answers; ended afterwards."""
    command = [str(ARAVIS), "-i", LOOPBACK, *arguments]
    with only_one_gige_camera(), subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        try:
            if not any(library.discover(timeout_ms=50, iface=LOOPBACK) for _ in range(100)):
                pytest.fail(f"{ARAVIS} does not answer")
            yield process
        finally:
            process.kill()


@pytest.fixture(scope="class")
def aravis():
    with started_aravis() as process:
        yield process


@needs_aravis
class TestAravisCamera(GigeContract):
    @pytest.fixture
    def camera(self, aravis, opened):
        return opened(ip=LOOPBACK)


def frames_until_it_fails(take, most=200):
    """The frames that ``take`` gives, and the error that ends them."""
    frames = []
    for _ in range(most):
        try:
            frames.append(take(1.0))
        except DeviceError as error:
            return frames, error
    pytest.fail("nothing failed")


def numbers_of(camera, n):
    """Numbers of the next frames of a stream; of a damaged one, its error."""
    found = []
    for _ in range(n):
        try:
            found.append(camera.next_frame(1.0).number)
        except LostFrameError as error:
            found.append(error)
    return found


def sent(fake, n_frames):
    """Return when the camera has sent so many frames; other threads work meanwhile."""
    for _ in range(2000):
        if fake.blocks_sent() >= n_frames:
            return
        SystemClock().wait(0.005)
    pytest.fail("the camera sends nothing")


ALL_PACKETS = range(20)
"""Of a small frame, and more."""


class TestPacketLoss:
    def test_packets_that_the_camera_sends_again_lose_nothing(self, gige, opened):
        gige(drop_packets=[(2, 3), (4, 0), (5, 1), (5, 2)])
        camera = opened()
        camera.start()
        assert numbers_of(camera, 6) == [0, 1, 2, 3, 4, 5]

    def test_a_damaged_frame_of_a_stream_is_an_error_with_its_number_and_the_next_one_comes(self, gige, opened):
        gige(drop_packets=[(2, 3)], packet_resend=False)
        camera = opened()
        camera.start()
        first, damaged, third = numbers_of(camera, 3)
        assert (first, third) == (0, 2)
        assert "frame 1 came damaged: 1 packets are missing" in str(damaged)

    def test_a_frame_of_which_nothing_came_is_a_gap_in_the_numbers(self, gige, opened):
        gige(drop_packets=[(3, i) for i in ALL_PACKETS], packet_resend=False)
        camera = opened()
        camera.start()
        assert numbers_of(camera, 4) == [0, 1, 3, 4]

    def test_a_single_frame_that_is_damaged_can_be_taken_again(self, gige, opened):
        fake = gige(drop_packets=[(2, 3)], packet_resend=False)
        camera = opened()
        first = camera.take(1.0)
        with pytest.raises(LostFrameError, match=r"packets are missing\. Take it again"):
            camera.take(1.0)
        assert camera.take(1.0).number > first.number + 1, "the damaged frame keeps its number"
        assert fake.software_triggers() == 3

    @needs_aravis
    def test_random_loss_is_told_frame_by_frame(self, opened):
        with started_aravis("--gvsp-lost-ratio=5"):  # packets of a thousand
            camera = opened(features={"AcquisitionFrameRate": 200.0})
            camera.start()
            found = numbers_of(camera, 40)
            camera.close()
        lost = [error for error in found if isinstance(error, LostFrameError)]
        numbers = [number for number in found if isinstance(number, int)]
        assert lost
        assert all("packets are missing" in str(error) or "end is missing" in str(error) for error in lost)
        assert numbers == sorted(set(numbers))


class TestTimes:
    def test_frames_wait_for_a_program_that_is_busy(self, gige, opened):
        fake = gige(fps=200)
        camera = opened()
        camera.start()
        first = camera.next_frame(1.0).number
        sent(fake, 40)
        assert numbers_of(camera, 30) == list(range(first + 1, first + 31))

    def test_frames_that_find_no_place_are_a_gap(self, gige, opened):
        fake = gige(fps=200)
        camera = opened(buffers=2)
        camera.start()
        camera.next_frame(1.0)
        sent(fake, 40)
        numbers = numbers_of(camera, 6)
        assert numbers[1] - numbers[0] == 1
        assert max(b - a for a, b in itertools.pairwise(numbers)) > 5

    def test_a_late_frame_is_a_time_out_and_the_next_take_has_its_own_frame(self, gige, opened):
        fake = gige(fps=5)
        camera = opened()
        camera.take(2.0)
        with pytest.raises(DeviceTimeoutError, match=r"no frame came within 0.01 s.*Give it more time"):
            camera.take(0.01)
        asked_s = SystemClock().now_s()
        frame = camera.take(2.0)
        assert frame.time_s + 4 * frame.u_time_s >= asked_s
        assert fake.software_triggers() == 3

    def test_times_are_those_of_the_program_and_lie_within_the_call(self, gige, opened):
        gige()
        camera = opened()
        for _ in range(3):
            before_s = SystemClock().now_s()
            frame = camera.take(1.0)
            after_s = SystemClock().now_s()
            assert before_s - 4 * frame.u_time_s <= frame.time_s <= after_s + 4 * frame.u_time_s + 0.005
            assert frame.u_time_s < 0.02


class TestUnplugged:
    def test_in_a_stream_and_back(self, gige, opened):
        fake = gige()
        camera = opened()
        camera.start()
        camera.next_frame(1.0)
        fake.stop()
        _, error = frames_until_it_fails(camera.next_frame)
        assert isinstance(error, DeviceConnectionError)
        assert "does not answer any more" in str(error)
        assert camera.info.device in str(error)
        camera.stop()
        camera.close()
        fake.start()
        assert opened().take(1.0).image.shape == (120, 160)

    def test_between_two_calls(self, gige, opened):
        fake = gige()
        camera = opened()
        before = camera.settings
        camera.take(1.0)
        fake.stop()
        with pytest.raises(DeviceConnectionError, match="cable and power"):
            camera.take(1.0)
        with pytest.raises(DeviceConnectionError, match="cable and power"):
            camera.configure(dataclasses.replace(before, exposure_us=1234.0))
        assert camera.settings == before

    @needs_aravis
    def test_a_process_that_is_killed(self, opened):
        with started_aravis() as process:
            camera = opened()
            camera.start()
            camera.next_frame(1.0)
            process.kill()
            _, error = frames_until_it_fails(camera.next_frame)
        assert isinstance(error, DeviceConnectionError)


class TestControl:
    def test_a_camera_that_another_process_controls_is_refused(self, gige):
        fake = gige()
        holder = (
            "import sys, viva_genicam as vg\n"
            f"camera = vg.connect_gige(vg.discover(200, iface='{LOOPBACK}')[0])\n"
            "print('held', flush=True)\n"
            "sys.stdin.read()\n"
            "camera.close()"
        )
        with subprocess.Popen([sys.executable, "-c", holder], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
            assert other.stdout.readline().strip() == b"held"
            held_by = fake.controller()
            with pytest.raises(DeviceConnectionError, match=r"another program controls it .* Close that program"):
                open_camera()
            assert fake.controller() == held_by
            other.communicate()
        camera = open_camera()
        camera.close()
        assert fake.controller() is None, "closing gives control back"

    def test_control_that_is_lost_is_said(self, gige, opened):
        fake = gige()
        camera = opened()
        camera.take(1.0)
        fake.revoke_control()
        _, error = frames_until_it_fails(camera.take)
        assert isinstance(error, DeviceConnectionError)
        assert "control of the camera is lost" in str(error)

    def test_control_that_another_program_took_is_said_at_once(self, gige, opened):
        fake = gige()
        camera = opened()
        before = camera.settings
        fake.revoke_control()
        with library.connect_gige(library.discover(timeout_ms=50, iface=LOOPBACK)[0]):
            with pytest.raises(DeviceConnectionError, match="another program took it"):
                camera.configure(dataclasses.replace(before, exposure_us=77.0))
            assert camera.settings == before

    def test_a_camera_that_cannot_be_used_is_let_go(self, gige):
        fake = gige()
        with pytest.raises(DeviceStateError, match="no feature 'Sharpness'"):
            open_camera(features={"Sharpness": 3})
        assert fake.controller() is None


class TestSettings:
    def test_what_is_stated_reaches_the_camera(self, gige, opened):
        fake = gige()
        camera = opened(features={"AcquisitionFrameRate": 50.0, "BlackLevel": 7}, pixel_format="Mono16")
        camera.configure(dataclasses.replace(camera.settings, exposure_us=2500.0, gain=3.0))
        where = testing.FakeGigeCamera.REGISTERS
        assert struct.unpack(">d", fake.peek(where["ExposureTime"], 8)) == (2500.0,)
        assert struct.unpack(">d", fake.peek(where["Gain"], 8)) == (3.0,)
        assert camera.info.bit_depth == 16
        assert camera.take(1.0).image.dtype == np.uint16

    def test_a_pixel_format_that_it_has_not_is_refused_with_those_it_has(self, gige):
        gige()
        with pytest.raises(DeviceStateError, match=r"no pixel format Mono12.*Mono8, Mono16"):
            open_camera(pixel_format="Mono12")

    @pytest.mark.parametrize("pixel_format", ["Mono8", "Mono16", "BayerRG8", "RGB8"])
    def test_formats_of_the_library_become_images(self, gige, opened, pixel_format):
        gige(pixel_format=pixel_format)
        camera = opened()
        image = camera.take(1.0).image
        assert image.ndim == (2 if pixel_format.startswith("Mono") else 3)
        assert image.dtype == (np.uint16 if pixel_format == "Mono16" else np.uint8)
        assert np.ptp(image) > 50, "the test pattern is no flat field"

    def test_a_trigger_that_it_has_not_is_refused(self, gige, opened):
        gige()
        camera = opened(trigger_line="Line7")
        assert camera.info.triggers == ("free",)
        with pytest.raises(DeviceLimitError, match="line"):
            camera.configure(dataclasses.replace(camera.settings, trigger="line"))


@needs_aravis
def test_block_ids_of_16_bit_go_round(opened):
    """Aravis' camera begins to count near the end, so that the round comes soon."""
    with started_aravis():
        camera = opened(features={"AcquisitionFrameRate": 1000.0, "Width": 32, "Height": 32, "ExposureTimeAbs": 10.0})
        camera.start()
        numbers = [camera.next_frame(1.0).number for _ in range(300)]
        camera.close()
    assert all(0 < b - a < 100 for a, b in itertools.pairwise(numbers)), "a busy machine may lose some"


def test_no_camera_says_what_to_look_at(gige_port, monkeypatch):
    monkeypatch.setattr(genicam, "_OPEN_MS", (20,))
    with pytest.raises(DeviceConnectionError, match=r"camera 127.0.0.1 does not answer.*firewall"):
        open_camera(ip=LOOPBACK)


def test_finds_what_answers(gige, monkeypatch):
    gige()
    discover = library.discover  # of this machine only: a test sends nothing into the network
    monkeypatch.setattr(
        library, "discover", lambda timeout_ms, all: discover(timeout_ms=timeout_ms // 4, iface=LOOPBACK)
    )
    (found,) = find_devices("camera", "genicam")
    table = settings_type("camera", "genicam").model_validate(tomllib.loads(found.toml))
    assert table.ip == LOOPBACK
    assert "FakeGigE" in found.name


def test_a_missing_library_is_one_sentence(monkeypatch):
    monkeypatch.setitem(sys.modules, "viva_genicam", None)
    with pytest.raises(DeviceConnectionError, match=r"pip install 'rotaline\[genicam\]'"):
        find_devices("camera", "genicam")
    with pytest.raises(DeviceConnectionError, match="viva-genicam"):
        open_camera()
