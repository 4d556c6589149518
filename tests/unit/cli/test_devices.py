"""``rotaline devices``: what each driver sees, or why it cannot look; quickly, whatever a library does."""

import json
import threading
from pathlib import Path

import pytest

import rotaline.pipeline.connected as connected
from rotaline.cli.app import main
from rotaline.errors import DeviceConnectionError
from rotaline.hardware.drivers import DRIVERS, KINDS, FoundDevice, settings_type
from rotaline.io.device_file import SIMULATED_RIG, driver_lines, lines_of, meaning_of, parse_device_file

CAMERAS = (
    FoundDevice("camera", "uvc", "webcam [one] (/dev/video0)", 'driver = "uvc"\ndevice = "/dev/video0"'),
    FoundDevice("camera", "uvc", "webcam two (/dev/video2)", '[camera]\ndriver = "uvc"\ndevice = "/dev/video2"\n'),
)


@pytest.fixture
def drivers(monkeypatch):
    """One with devices, one without its library, one that finds nothing, one that fails."""

    def find(kind, driver):
        if driver == "uvc":
            return CAMERAS
        if driver == "pylon":
            raise DeviceConnectionError(
                "pylon: the library 'pypylon' cannot be loaded. Install it: pip install 'rotaline[pylon]'."
            )
        if driver == "gentl":
            raise RuntimeError("odd")
        return ()

    monkeypatch.setattr(connected, "find_devices", find)


def test_devices_are_shown_with_their_lines_and_problems_with_what_to_install(drivers, capsys):
    assert main(["devices"]) == 0
    out = capsys.readouterr().out
    assert "uvc: webcam [one] (/dev/video0)" in out
    assert out.count("[camera]\n") == 2
    assert 'device = "/dev/video2"' in out
    assert "pip install 'rotaline[pylon]'" in out
    assert "gentl: it could not look (RuntimeError: odd)" in out
    assert any("standa" in x for x in out.splitlines() if x.endswith(": nothing found"))
    for kind in KINDS:
        assert f"{kind.capitalize()}s\n" in out


def test_json_holds_devices_and_problems(drivers, capsys):
    assert main(["devices", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [d["name"] for d in document["devices"]] == [d.name for d in CAMERAS]
    assert [p["driver"] for p in document["problems"]] == ["gentl", "pylon"]
    for device in document["devices"]:
        parse_device_file(f"version = 1\n{device['toml']}", "found", Path())


def test_a_driver_that_hangs_does_not_keep_the_others_waiting(monkeypatch):
    released = threading.Event()

    def find(kind, driver):
        if driver == "pylon":
            released.wait(20.0)
        return CAMERAS if driver == "uvc" else ()

    monkeypatch.setattr(connected, "find_devices", find)
    try:
        pylon, uvc = connected.look((("camera", "pylon"), ("camera", "uvc")), limit_s=0.05)
    finally:
        released.set()
    assert "no answer within 0.05 s" in pylon.problem
    assert uvc.found == CAMERAS


def test_every_driver_is_asked_but_those_that_nothing_can_be_seen_of():
    asked = connected.all_drivers()
    assert {name for _, name in asked} == {n for names in DRIVERS.values() for n in names} - {"manual", "replay"}


def test_what_real_drivers_find_can_be_written_into_a_rig_file(tmp_path):
    for answer in connected.look((("camera", "simulated"), ("turntable", "simulated"), ("laser", "simulated"))):
        (device,) = answer.found
        text = "version = 1\n" + lines_of(device)
        parse_device_file(text if device.kind == "camera" else text + "\n" + lines_of(CAMERAS[0]), "found", tmp_path)


def test_a_simulated_rig_is_printed(capsys, tmp_path):
    assert main(["devices", "--toml", "simulated"]) == 0
    text = capsys.readouterr().out
    assert text == SIMULATED_RIG
    assert parse_device_file(text, "printed", tmp_path).drivers == {"simulated"}


@pytest.mark.parametrize("driver", sorted({name for names in DRIVERS.values() for name in names} - {"simulated"}))
def test_the_keys_of_a_driver_are_printed_with_their_meaning(driver):
    text = driver_lines(driver)
    for kind in KINDS:
        if driver in DRIVERS[kind]:
            body = text.split(f"[{kind}]")[1].split("\n[")[0]
            for name, field in settings_type(kind, driver).model_fields.items():
                assert f"{name} =" in body
                assert name == "driver" or meaning_of(field) in body


def test_an_unknown_driver_is_named_with_those_that_there_are(capsys):
    assert main(["devices", "--toml", "tripod"]) == 2
    err = capsys.readouterr().err
    assert "tripod" in err
    assert "gcode" in err
