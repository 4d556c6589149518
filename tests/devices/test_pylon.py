"""Basler cameras, against pylon's emulated camera."""

import contextlib
import dataclasses
import subprocess
import sys
import types

import numpy as np
import pytest
from tests.devices.contracts import CameraContract

from rotaline.errors import (
    DeviceConnectionError,
    DeviceStateError,
    DeviceTimeoutError,
    LostFrameError,
)
from rotaline.hardware.camera import Region
from rotaline.hardware.cameras import pylon as adapter
from rotaline.hardware.clock import SystemClock
from rotaline.hardware.connections import Connections

pylon = pytest.importorskip("pypylon.pylon", reason="pip install pypylon: its emulated camera is needed")

SMALL = Region(16, 8, 64, 48)


ENUMERATE = pylon.TlFactory.EnumerateDevices


def emulated(factory):
    transport_layer = factory.CreateTl("BaslerCamEmu")
    return () if transport_layer is None else transport_layer.EnumerateDevices()


@pytest.fixture(autouse=True)
def one_emulated_camera(monkeypatch):
    """Only emulated cameras are looked for: asking the network takes a quarter of a second each time."""
    monkeypatch.setenv("PYLON_CAMEMU", "1")
    monkeypatch.setattr(pylon.TlFactory, "EnumerateDevices", emulated)


def opened(**keys):
    settings = adapter.Settings(driver="pylon", serial="0815-0000", **keys)
    camera = adapter.open_device(settings, SystemClock(), Connections())
    camera.configure(dataclasses.replace(camera.settings, exposure_us=2000.0, region=SMALL))
    return camera


@pytest.fixture
def camera():
    camera = opened()
    yield camera
    camera.close()


def instant_camera(camera):
    """pylon's own object behind the adapter, to do to it what nobody else can."""
    return camera._transport._camera


class TestEmulatedCamera(CameraContract):
    @pytest.fixture
    def camera(self, camera):
        return camera


def test_a_trigger_starts_the_exposure_that_is_returned(camera):
    """The emulated test image moves by one grey level each exposure: no frame was exposed and thrown away in between."""
    a, b, c = (camera.take(5.0) for _ in range(3))
    assert [b.number - a.number, c.number - b.number] == [1, 1]
    assert np.all(b.image.astype(int) - a.image.astype(int) == 1)
    assert np.all(c.image.astype(int) - b.image.astype(int) == 1)


def test_numbers_count_on_from_stream_to_take_to_stream(camera):
    numbers = [camera.take(5.0).number]
    for _ in range(2):
        camera.start()
        numbers += [camera.next_frame(5.0).number for _ in range(3)]
        camera.stop()
        numbers.append(camera.take(5.0).number)
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))


@pytest.mark.parametrize(
    ("pixel_format", "bits", "colour"),
    [
        ("Mono8", 8, False),
        ("Mono12", 12, False),
        ("BayerRG8", 8, True),
        ("BayerGB12", 12, True),
        ("RGB8Packed", 8, True),
    ],
)
def test_pixel_formats(pixel_format, bits, colour):
    camera = opened(pixel_format=pixel_format)
    try:
        assert (camera.info.bit_depth, camera.info.colour) == (bits, colour)
        image = camera.take(5.0).image
        assert image.shape == ((48, 64, 3) if colour else (48, 64))
        assert image.dtype == (np.uint8 if bits == 8 else np.uint16)
    finally:
        camera.close()


def test_a_pixel_format_that_it_has_not_is_refused():
    with pytest.raises(DeviceStateError, match=r"Mono13.*Mono12"):
        opened(pixel_format="Mono13")


def test_features_of_the_user_are_set():
    camera = opened(
        features={"AcquisitionFrameRateEnable": True, "AcquisitionFrameRate": 20.0, "TestImageSelector": "Testimage1"}
    )
    try:
        nodes = instant_camera(camera).GetNodeMap()
        assert nodes.GetNode("AcquisitionFrameRate").Value == 20.0
        assert nodes.GetNode("TestImageSelector").Value == "Testimage1"
    finally:
        camera.close()
    with pytest.raises(DeviceStateError, match=r"0815-0000.*'Colour'"):
        opened(features={"Colour": 1})


def test_a_trigger_line_can_begin_exposures(camera):
    """Nobody gives an edge to an emulated camera: no frame comes, and that is a time-out; then it takes frames again."""
    assert camera.info.triggers == ("free", "line")
    camera.configure(dataclasses.replace(camera.settings, trigger="line"))
    camera.start()
    with pytest.raises(DeviceTimeoutError, match=r"0815-0000.*0.02 s.*trigger"):
        camera.next_frame(0.02)
    camera.stop()
    assert camera.take(5.0).settings.trigger == "line"


def test_a_time_out_is_said_and_the_late_frame_is_not_taken_for_the_next_one(camera, monkeypatch):
    """The emulated test image begins anew when the camera is started, and gets brighter by one with each exposure."""
    first = camera.take(5.0)
    assert camera.take(5.0).image[0, 0] == first.image[0, 0] + 1
    with monkeypatch.context() as late:
        late.setattr(camera._transport, "receive", lambda timeout_s: None)
        with pytest.raises(DeviceTimeoutError, match=r"0.5 s.*2000 us"):
            camera.take(0.5)
    after = camera.take(5.0)
    assert np.array_equal(after.image, first.image), "it was started anew: the late frame is gone"
    assert after.number > first.number


def force_failed_frames(camera, n):
    nodes = instant_camera(camera).GetNodeMap()
    nodes.GetNode("ForceFailedBufferCount").Value = n
    nodes.GetNode("ForceFailedBuffer").Execute()


def test_a_damaged_frame_raises_and_the_next_take_brings_one(camera):
    first = camera.take(5.0)
    force_failed_frames(camera, 1)
    with pytest.raises(LostFrameError, match="incompletely grabbed"):
        camera.take(5.0)
    assert camera.take(5.0).number == first.number + 2


def test_damaged_frames_of_a_stream_raise_one_by_one_and_keep_their_numbers(camera):
    force_failed_frames(camera, 2)
    camera.start()
    for _ in range(2):
        with pytest.raises(LostFrameError):
            camera.next_frame(5.0)
    numbers = [camera.next_frame(5.0).number for _ in range(2)]
    assert numbers == [2, 3]
    camera.stop()


def test_a_gap_in_the_block_ids_is_a_gap_in_the_numbers(camera, monkeypatch):
    """The emulator waits when all buffers are full, where a camera loses frames: so the ids are changed on their way."""
    transport = camera._transport
    receive = transport.receive

    def without_some(timeout_s):
        raw = receive(timeout_s)
        return raw and dataclasses.replace(raw, frame_id=raw.frame_id + (3 if raw.frame_id >= 2 else 0))

    monkeypatch.setattr(transport, "receive", without_some)
    camera.start()
    numbers = [camera.next_frame(5.0).number for _ in range(4)]
    camera.stop()
    assert numbers == [0, 1, 5, 6]


def test_few_buffers_lose_nothing_that_is_fetched():
    camera = opened(buffers=2)
    try:
        assert instant_camera(camera).MaxNumBuffer.Value == 2
        camera.start()
        numbers = [camera.next_frame(5.0).number for _ in range(8)]
        assert numbers == list(range(8))
    finally:
        camera.close()


@pytest.mark.parametrize("streams", [False, True])
def test_a_camera_that_goes_away_is_a_lost_connection(camera, streams):
    if streams:
        camera.start()
        camera.next_frame(5.0)
    else:
        camera.take(5.0)
    instant_camera(camera).DestroyDevice()
    with pytest.raises(DeviceConnectionError, match=r"0815-0000.*cable"):
        camera.next_frame(5.0) if streams else camera.take(5.0)
    camera.stop()
    camera.close()


def test_a_removed_camera_is_told_from_other_errors_of_the_library(camera, monkeypatch):
    from pypylon import genicam

    def fail(*_):
        raise genicam.RuntimeException("The device has been removed.")

    camera.start()
    monkeypatch.setattr(pylon.InstantCamera, "RetrieveResult", fail)
    with pytest.raises(DeviceStateError, match=r"frames cannot be received \(The device has been removed"):
        camera.next_frame(1.0)
    monkeypatch.setattr(pylon.InstantCamera, "IsCameraDeviceRemoved", lambda _: True)
    with pytest.raises(DeviceConnectionError, match="cable"):
        camera.next_frame(1.0)


def test_a_stream_that_ended_by_itself_is_said(camera):
    camera.start()
    camera.next_frame(5.0)
    instant_camera(camera).StopGrabbing()
    with pytest.raises(DeviceConnectionError, match="the stream ended"):
        camera.next_frame(5.0)


def test_frames_wait_in_order_for_a_slow_program(camera):
    camera.start()
    first = camera.next_frame(5.0).number
    clock = SystemClock()
    for _ in range(5000):
        if instant_camera(camera).NumReadyBuffers.Value >= 3:
            break
        clock.wait(0.001)
    else:
        pytest.fail("frames do not wait")
    assert [camera.next_frame(5.0).number - first for _ in range(4)] == [1, 2, 3, 4]
    camera.stop()


def test_a_camera_that_cannot_be_used_is_let_go(monkeypatch):
    made = []

    class Recorded(pylon.InstantCamera):
        def Open(self):  # noqa: N802
            made.append(self)
            super().Open()

        def Close(self):  # noqa: N802
            made.remove(self)
            super().Close()

    monkeypatch.setattr(pylon, "InstantCamera", Recorded)
    with pytest.raises(DeviceStateError):
        opened(features={"Colour": 1})
    assert made == []


def test_it_can_be_opened_again_after_it_was_closed(camera):
    camera.take(5.0)
    camera.close()
    again = opened()
    assert again.take(5.0).image.shape == (48, 64)
    again.close()


def test_a_camera_that_another_program_holds_says_so(monkeypatch):
    """The emulator lets everybody in: so the answer of the library is replaced."""
    monkeypatch.setattr(pylon.TlFactory, "IsDeviceAccessible", lambda *_: False)
    with pytest.raises(DeviceConnectionError, match="Another program"):
        opened()


def test_a_camera_that_fails_to_open_says_why(monkeypatch):
    from pypylon import genicam

    def fail(*_):
        raise genicam.RuntimeException("Device is exclusively opened by another client.")

    monkeypatch.setattr(pylon.InstantCamera, "Open", fail)
    with pytest.raises(DeviceConnectionError, match=r"exclusively opened.*Another program"):
        opened()


def test_no_camera_or_several_are_said(monkeypatch):
    monkeypatch.setenv("PYLON_CAMEMU", "0")
    with pytest.raises(DeviceConnectionError, match=r"0815-0000 was looked for.*none"):
        opened()
    monkeypatch.setenv("PYLON_CAMEMU", "2")
    with pytest.raises(DeviceConnectionError, match=r"0815-0000, .*0815-0001.*serial"):
        adapter.open_device(adapter.Settings(driver="pylon"), SystemClock(), Connections())


def test_finds_what_is_connected(monkeypatch):
    monkeypatch.setattr(pylon.TlFactory, "EnumerateDevices", ENUMERATE)
    monkeypatch.setenv("PYLON_CAMEMU", "2")
    found = adapter.find()
    there = {one.name: one for one in found if "Emulation" in one.name}
    assert sorted(there) == ["Basler Emulation 0815-0000", "Basler Emulation 0815-0001"]
    assert there["Basler Emulation 0815-0001"].toml == 'driver = "pylon"\nserial = "0815-0001"'


def test_without_the_library_the_sentence_names_the_extra():
    code = (
        "import sys; sys.modules['pypylon'] = None\n"
        "from rotaline.errors import DeviceConnectionError\n"
        "from rotaline.hardware.cameras import pylon\n"
        "try: pylon.find()\n"
        "except DeviceConnectionError as error: print(error)\n"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert "pip install 'rotaline[pylon]'" in said.stdout


class FeaturesOfARealCamera(adapter._Features):
    """Features that the emulated camera lacks."""

    def __init__(self, **values):
        self.device = "Basler a2A1234 5"
        self.values = values
        self.executed = []

    def has(self, name):
        return name in self.values

    def set(self, name, value):
        self.values[name] = value

    def entries(self, name):
        return CHUNKS if name == "ChunkSelector" else ()

    def execute(self, name):
        self.executed.append((name, dict(self.values)))

    @contextlib.contextmanager
    def doing(self, what):
        yield


CHUNKS = ("Gain", "Timestamp")


class Result:
    """A grab result of pylon."""

    Width, Height, PaddingX = 2, 1, 0
    TimeStamp = 99
    BlockID = 2**64 - 1
    ChunkTimestamp = types.SimpleNamespace(Value=123)

    def GrabSucceeded(self):  # noqa: N802
        return True

    def GetBuffer(self):  # noqa: N802
        return b"ab and the chunk"


def transport(features, **keys):
    camera = types.SimpleNamespace(IsGigE=lambda: True, MaxNumBuffer=types.SimpleNamespace(Value=10))
    return adapter._Transport(camera, features, adapter.Settings(driver="pylon", **keys))


def test_the_time_of_the_exposure_comes_with_the_frame_where_the_camera_can():
    chunk = {"ChunkModeActive": False, "ChunkSelector": "Gain", "ChunkEnable": False}
    features = FeaturesOfARealCamera(**chunk, BslChunkTimestampSelector="FrameStart")
    assert transport(features)._raw(Result()).ticks == 123
    assert features.values == {
        "ChunkModeActive": True,
        "ChunkSelector": "Timestamp",
        "ChunkEnable": True,
        "BslChunkTimestampSelector": "ExposureStart",
    }


def test_without_such_a_chunk_the_stamp_of_the_transfer_is_used():
    features = FeaturesOfARealCamera(ChunkModeActive=False)
    assert transport(features)._raw(Result()).ticks == 99
    assert features.values == {"ChunkModeActive": False}
    features = FeaturesOfARealCamera(ChunkModeActive=False, ChunkSelector="Gain", ChunkEnable=False)
    result = Result()
    result.ChunkTimestamp = types.SimpleNamespace()  # promised, but it does not come
    assert transport(features)._raw(result).ticks == 99


def test_frames_without_block_ids_are_counted():
    receiver = transport(FeaturesOfARealCamera())
    assert receiver.wraps
    assert [receiver._raw(Result()).frame_id for _ in range(3)] == [1, 2, 3]


def test_a_user_set_is_loaded_before_anything_else():
    features = FeaturesOfARealCamera(UserSetSelector="Default", ChunkModeActive=True)
    transport(features, user_set="UserSet1")
    assert features.executed == [("UserSetLoad", {"UserSetSelector": "UserSet1", "ChunkModeActive": True})]
    with pytest.raises(DeviceStateError, match="'UserSetSelector'"):
        opened(user_set="UserSet1")
