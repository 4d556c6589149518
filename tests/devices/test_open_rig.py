"""The devices of a rig opened and closed together, and what holds for every driver."""

import json
import subprocess
import sys
import types
from pathlib import Path
from typing import Literal

import numpy as np
import pytest

from rotaline.errors import DeviceConnectionError
from rotaline.hardware.camera import CameraFrame, CameraInfo, CameraSettings, Region
from rotaline.hardware.clock import VirtualClock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import DRIVERS, KINDS, find_devices, open_camera, settings_type
from rotaline.hardware.laser import LaserInfo
from rotaline.hardware.rig import DeviceTables, open_rig
from rotaline.hardware.turntable import TurntableInfo
from rotaline.tables import Table

DEVICES = ("laser", "turntable", "camera", "port")
"""In the order in which they are closed."""


class Device:
    """A device that writes down what happens to it; ``closings``: what its next closings raise, None: nothing."""

    def __init__(self, name, log):
        self.name, self.log, self.closings = name, log, []

    def close(self):
        self.log.append(f"{self.name} begins to close")
        error = self.closings.pop(0) if self.closings else None
        if error is not None:
            raise error
        self.log.append(f"{self.name} closed")


class Camera(Device):
    info = CameraInfo("camera", (64, 48), (1.0, 1000.0))
    settings = CameraSettings(10.0, region=Region(0, 0, 64, 48))

    def configure(self, settings):
        return settings

    def take(self, timeout_s):
        return CameraFrame(np.zeros((48, 64), np.uint8), 1, 0.0, 0.0, self.settings)

    def start(self): ...

    def next_frame(self, timeout_s):
        return self.take(timeout_s)

    def stop(self): ...


class Turntable(Device):
    info = TurntableInfo("turntable", None, 0.1, 0.1)

    def home(self, timeout_s): ...

    def move_to(self, angle_deg, timeout_s):
        return angle_deg

    def angle_deg(self):
        return 0.0

    def turn(self, speed_deg_s): ...

    def stop(self, timeout_s): ...


class Laser(Device):
    info = LaserInfo("laser")
    is_on = False

    def on(self): ...

    def off(self): ...

    def set_power(self, fraction): ...


class Settings(Table):
    driver: Literal["bench"] = "bench"


@pytest.fixture
def bench(monkeypatch):
    """Drivers "bench" of all kinds on one port; ``failing`` maps a kind to what its opening raises."""
    log, failing, devices = [], {}, {}

    def driver(kind, make):
        def open_device(settings, clock, connections):
            connections.shared("port", lambda: devices.setdefault("port", Device("port", log)))
            if kind in failing:
                raise failing[kind]
            log.append(f"{kind} opened")
            return devices.setdefault(kind, make(kind, log))

        return types.SimpleNamespace(Settings=Settings, open_device=open_device, find=lambda: ())

    for kind, make in (("camera", Camera), ("turntable", Turntable), ("laser", Laser)):
        monkeypatch.setitem(sys.modules, f"rotaline.hardware.{kind}s.bench", driver(kind, make))
    return types.SimpleNamespace(log=log, failing=failing, devices=devices)


def opened(tables=None):
    return open_rig(tables or DeviceTables(Settings(), Settings(), Settings()), VirtualClock())


def closed(log):
    return [line.removesuffix(" closed") for line in log if line.endswith(" closed")]


def test_the_laser_opens_first_and_closes_first(bench):
    with opened() as rig:
        assert bench.log == ["laser opened", "turntable opened", "camera opened"]
        assert rig.laser is bench.devices["laser"]
        bench.log.clear()
    assert closed(bench.log) == list(DEVICES)


@pytest.mark.parametrize("error", [DeviceConnectionError("camera: gone"), KeyboardInterrupt(), SystemExit(143)])
def test_whatever_ends_the_work_closes_everything(bench, error):
    with pytest.raises(type(error)) as caught, opened():
        raise error
    assert caught.value is error
    assert closed(bench.log) == list(DEVICES)


@pytest.mark.parametrize("name", DEVICES)
def test_an_error_while_one_is_closed_leaves_none_of_the_others_open(bench, name):
    rig = opened()
    bench.devices[name].closings = [RuntimeError("of the vendor")]
    rig.close()
    assert closed(bench.log) == [other for other in DEVICES if other != name]


@pytest.mark.parametrize("name", DEVICES)
@pytest.mark.parametrize("interruption", [KeyboardInterrupt, SystemExit])
def test_an_interruption_while_one_is_closed_closes_it_and_the_others_and_then_goes_on(bench, name, interruption):
    rig = opened()
    bench.devices[name].closings = [interruption()]
    with pytest.raises(interruption):
        rig.close()
    assert closed(bench.log) == list(DEVICES)


@pytest.mark.parametrize("name", DEVICES)
def test_who_interrupts_again_and_again_still_gets_the_others_closed(bench, name):
    rig = opened()
    bench.devices[name].closings = [KeyboardInterrupt(), KeyboardInterrupt(), KeyboardInterrupt()]
    with pytest.raises(KeyboardInterrupt):
        rig.close()
    assert closed(bench.log) == [other for other in DEVICES if other != name]


def test_an_interruption_while_the_rig_closes_after_an_error_keeps_the_error_as_its_context(bench):
    rig = opened()
    bench.devices["laser"].closings = [KeyboardInterrupt()]
    with pytest.raises(KeyboardInterrupt) as caught, rig:
        raise DeviceConnectionError("camera: gone")
    assert isinstance(caught.value.__context__, DeviceConnectionError)
    assert closed(bench.log) == list(DEVICES)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("error", [DeviceConnectionError("it is held by another program"), KeyboardInterrupt()])
def test_a_device_that_does_not_open_leaves_the_others_closed(bench, kind, error):
    bench.failing[kind] = error
    with pytest.raises(type(error)) as caught:
        opened()
    assert caught.value is error
    before = {"laser": [], "turntable": ["laser"], "camera": ["laser", "turntable"]}[kind]
    assert [line.removesuffix(" opened") for line in bench.log if line.endswith(" opened")] == before
    assert closed(bench.log) == [*before, "port"]


def test_a_rig_may_be_a_camera_alone(bench):
    with opened(DeviceTables(Settings())) as rig:
        assert rig.laser is None
        assert rig.turntable is None
    assert closed(bench.log) == ["camera", "port"]


def test_a_rig_can_be_closed_twice(bench):
    rig = opened()
    rig.close()
    rig.close()
    assert closed(bench.log).count("port") == 1


def test_what_devices_share_is_opened_once_and_closed_last_first():
    log, connections = [], Connections()
    connections.provide("prompt", input)
    first = connections.shared(("gcode", "a"), lambda: Device("a", log))
    assert connections.shared(("gcode", "a"), lambda: Device("never", log)) is first
    connections.shared(("gcode", "b"), lambda: Device("b", log)).closings = [OSError("of the port")]
    connections.shared(("gcode", "c"), lambda: Device("c", log))
    assert connections.get("prompt") is input
    assert connections.get("nothing") is None
    connections.close()
    assert closed(log) == ["c", "a"]
    assert connections.get(("gcode", "a")) is None


def test_what_could_not_be_opened_is_tried_anew():
    connections = Connections()

    def fails():
        raise DeviceConnectionError("no such port")

    with pytest.raises(DeviceConnectionError):
        connections.shared("port", fails)
    assert connections.shared("port", lambda: 7) == 7


def test_a_driver_that_is_not_there():
    with pytest.raises(KeyError):
        settings_type("camera", "bench")


ALL = [(kind, driver) for kind in KINDS for driver in DRIVERS[kind]]
EXTRAS = {
    ("camera", "genicam"): "rotaline[",
    ("camera", "gentl"): "rotaline[",
    ("camera", "pylon"): "rotaline[",
    ("turntable", "standa"): "rotaline[",
    ("turntable", "gcode"): "rotaline[",
    ("laser", "gcode"): "rotaline[",
}
"""What has to be said by drivers whose library cannot be imported; the libraries of the others come from elsewhere, or they need none."""

PAGES = sorted(
    p for p in (Path(__file__).parents[2] / "docs" / "how-to" / "devices").glob("*.md") if p.stem != "README"
)
VENDORS = ("aravis", "genicam", "gi", "harvesters", "libximc", "pypylon", "serial", "usb", "viva_genicam")
WITHOUT_LIBRARIES = """
import importlib.abc, json, re, sys, tomllib
from pathlib import Path

class Blocked(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name.partition(".")[0] in {blocked}:
            raise ModuleNotFoundError(f"No module named '{{name}}'", name=name)

sys.meta_path.insert(0, Blocked())

from rotaline.errors import DeviceConnectionError
from rotaline.hardware.drivers import KINDS, find_devices, settings_type
from rotaline.io.device_file import parse_device_file
from rotaline.tables import Table

def keys(table):
    for name, field in table.model_fields.items():
        yield [table.__name__, name, str(field.annotation), field.description]
        if isinstance(field.annotation, type) and issubclass(field.annotation, Table):
            yield from keys(field.annotation)

def valid(kind, text):
    table = tomllib.loads(text)[kind]
    return settings_type(kind, table["driver"])(**table).driver

for kind, driver in {drivers}:
    told = {{"what": [kind, driver]}}
    try:
        told["keys"] = list(keys(settings_type(kind, driver)))
        told["found"] = [[d.kind, d.driver, d.name, valid(kind, d.toml)] for d in find_devices(kind, driver)]
    except DeviceConnectionError as error:
        told["error"] = str(error)
    except Exception as error:
        told["wrong"] = repr(error)
    print(json.dumps(told))

for page in map(Path, {pages}):
    told = {{"what": ["page", page.stem], "examples": 0}}
    try:
        for text in re.findall(r"^```toml\\n(.*?)^```", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE):
            tables = tomllib.loads(text)
            if "version" in tables:
                parse_device_file(text, page.name, page.parent)
            for kind in set(KINDS) & set(tables):
                valid(kind, text)
                told["examples"] += 1
    except Exception as error:
        told["wrong"] = repr(error)
    print(json.dumps(told))
"""


@pytest.fixture(scope="module")
def without_libraries():
    """What each driver does on a machine where no vendor's library is installed, and what its page shows."""
    code = WITHOUT_LIBRARIES.format(blocked=set(VENDORS), drivers=ALL, pages=[str(page) for page in PAGES])
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
    return {tuple(told["what"]): told for told in map(json.loads, done.stdout.splitlines())}


@pytest.mark.parametrize(("kind", "driver"), ALL)
def test_a_driver_is_imported_without_its_library(without_libraries, kind, driver):
    assert "keys" in without_libraries[kind, driver], without_libraries[kind, driver]


@pytest.mark.parametrize(("kind", "driver"), ALL)
def test_a_driver_lists_its_devices_or_says_what_to_install(without_libraries, kind, driver):
    told = without_libraries[kind, driver]
    assert "wrong" not in told, told
    if (kind, driver) in EXTRAS:
        assert f"pip install '{EXTRAS[kind, driver]}" in told["error"]
    elif "error" in told:
        assert "nstall" in told["error"], "what to do"
    else:
        for found_kind, found_driver, name, of_its_lines in told["found"]:
            assert (found_kind, found_driver, of_its_lines) == (kind, driver, driver)
            assert name


@pytest.mark.parametrize(("kind", "driver"), ALL)
def test_every_key_of_a_driver_is_described(without_libraries, kind, driver):
    keys = without_libraries[kind, driver]["keys"]
    assert ["Settings", "driver", f"typing.Literal['{driver}']"] in [key[:3] for key in keys]
    assert [f"{table}.{name}" for table, name, _, description in keys if not description] == []


@pytest.mark.parametrize(("kind", "driver"), ALL)
def test_a_key_that_is_a_quantity_states_its_unit(without_libraries, kind, driver):
    """Names carry the unit, and descriptions repeat it for those who read them alone."""
    units = {"_deg": "deg", "_deg_s": "deg/s", "_s": " s", "_ms": "ms", "_us": "us", "_mm": "mm", "_px": "px"}
    for table, name, _, description in without_libraries[kind, driver]["keys"]:
        unit = next((units[end] for end in sorted(units, key=len, reverse=True) if name.endswith(end)), "")
        assert unit in f" {description}", f"{table}.{name}: {description}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_examples_of_a_page_are_valid(without_libraries, page):
    told = without_libraries["page", page.stem]
    assert "wrong" not in told, told
    assert told["examples"], "each page shows a rig.toml"


def test_an_adapter_opens_what_its_table_says(bench):
    assert open_camera(Settings(), VirtualClock(), Connections()) is bench.devices["camera"]
    assert find_devices("camera", "bench") == ()
