"""A Standa stage: the library's virtual controller, and the same with faults put into what it reports.

The virtual controller moves in the time of the machine, so the clock here is the machine's: moves take milliseconds. It has neither sensor,
limit switches, encoder nor alarms, and may be opened twice; where those matter, what it reports is changed on its way, and time is virtual.
"""

import dataclasses
import math
import sys

import numpy as np
import pytest
from tests.devices.contracts import TurntableContract

from rotaline.errors import DeviceConnectionError, DeviceLimitError, DeviceStateError, DeviceTimeoutError
from rotaline.hardware.cameras.replay import Settings as ReplayedCamera
from rotaline.hardware.clock import SystemClock, VirtualClock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import open_turntable
from rotaline.hardware.lasers.replay import Settings as ReplayedLaser
from rotaline.hardware.replay import RecordedCapture, RecordedFrame, Recording
from rotaline.hardware.rig import DeviceTables, open_rig
from rotaline.hardware.turntables import standa_controller
from rotaline.hardware.turntables.standa import Settings, StandaTurntable
from rotaline.hardware.turntables.standa_controller import Controller, connected_uris, load_library

try:
    XIMC = load_library()
except (ImportError, OSError):
    pytest.skip("the library is not installed: pip install 'rotaline[standa]'", allow_module_level=True)

STEPS_PER_DEG = 2.0
MICROSTEPS = 256


def uri(folder) -> str:
    return f"xi-emu://{folder}/controller.bin"


def settings(folder, **changes) -> Settings:
    values = {"uri": uri(folder), "steps_per_deg": STEPS_PER_DEG, "u_angle_deg": 0.001, "speed_deg_s": 2500.0}
    return Settings(**{**values, **changes})


@pytest.fixture
def opened(tmp_path):
    tables = []

    def make(**changes):
        tables.append(open_turntable(settings(tmp_path, **changes), SystemClock(), Connections()))
        return tables[-1]

    yield make
    for table in tables:
        table.close()


class Reports(Controller):
    """The virtual controller; ``change`` makes of each status what is reported. Commands are written down."""

    def __init__(self, folder, change=lambda status: status):
        self.said = []
        self.change = lambda status: status
        super().__init__(XIMC, uri(folder))
        self.change = change

    def status(self):
        return self.change(super().status())

    def _call(self, name, *values):
        if not name.startswith("get_"):
            self.said.append(name)
        return super()._call(name, *values)


@pytest.fixture
def reporting(tmp_path):
    """A table, in virtual time unless another clock is given, on a controller whose reports can be changed."""
    made = []

    def make(clock=None, **changes):
        controller = Reports(tmp_path)
        made.append(controller)
        return StandaTurntable(controller, settings(tmp_path, **changes), clock or VirtualClock()), controller

    yield make
    for controller in made:
        controller.change = lambda status: status
        controller.close()


class TestStandaWithoutLimits(TurntableContract):
    speed_deg_s = 100.0

    @pytest.fixture
    def turntable(self, opened):
        return opened()


class TestStandaWithLimits(TurntableContract):
    speed_deg_s = 100.0

    @pytest.fixture
    def turntable(self, opened):
        return opened(limits_deg=(-170.0, 400.0), home="here")


class TestStandaBackwards(TurntableContract):
    """Angles grow against the steps; homing as the controller does it."""

    speed_deg_s = 100.0

    @pytest.fixture
    def turntable(self, opened):
        return opened(steps_per_deg=-STEPS_PER_DEG, home="sensor", microsteps=16)


def at_rest_at(position):
    return lambda status: dataclasses.replace(status, at_rest=True, position=position)


def test_resolution_and_greatest_speed_are_those_of_the_controller(opened):
    info = opened(microsteps=8).info
    assert info.resolution_deg == pytest.approx(1 / (STEPS_PER_DEG * 8))
    assert info.max_speed_deg_s == pytest.approx(5000 / STEPS_PER_DEG), (
        "the virtual motor's nominal speed is 5000 steps/s"
    )
    assert info.limits_deg is None
    assert not info.encoder


@pytest.mark.parametrize("angle", [12.345, -7.7, -0.001, 361.2])
def test_an_angle_is_rounded_to_the_nearest_microstep(opened, angle):
    reached = opened().move_to(angle, 5.0)
    assert reached == round(angle * STEPS_PER_DEG * MICROSTEPS) / (STEPS_PER_DEG * MICROSTEPS)


def test_angles_grow_with_the_steps_or_against_them(tmp_path, opened):
    table = opened(steps_per_deg=-STEPS_PER_DEG)
    table.move_to(10.0, 5.0)
    table.close()
    controller = Controller(XIMC, uri(tmp_path))
    assert controller.status().position == -20 * MICROSTEPS
    controller.close()


def test_the_count_outlives_the_program(opened):
    table = opened()
    table.move_to(33.0, 5.0)
    table.close()
    again = opened()
    assert again.angle_deg() == 33.0
    again.home(5.0)
    assert again.angle_deg() == 0.0


def test_home_here_moves_nothing(reporting):
    table, controller = reporting(home="here")
    controller.said.clear()
    table.home(5.0)
    assert controller.said == ["command_zero"]


def test_a_table_that_was_left_turning_stands_once_it_is_open(tmp_path, opened):
    controller = Controller(XIMC, uri(tmp_path))
    controller.turn(right=True)
    assert not controller.status().at_rest
    controller.close()
    there = (table := opened()).angle_deg()
    assert table.angle_deg() == there


def test_borders_of_the_controller_are_limits(tmp_path, opened):
    controller = Controller(XIMC, uri(tmp_path))
    raw = controller._get("edges_settings")
    raw.BorderFlags, raw.LeftBorder, raw.RightBorder, raw.uRightBorder = 7, -10, 40, 128
    controller._set("edges_settings", raw)
    controller.close()
    assert opened().info.limits_deg == (-5.0, 20.25)
    assert opened(limits_deg=(-3.0, 100.0)).info.limits_deg == (-3.0, 20.25)
    assert opened(steps_per_deg=-STEPS_PER_DEG).info.limits_deg == (-20.25, 5.0)
    with pytest.raises(DeviceLimitError, match="leave no angle"):
        opened(limits_deg=(30.0, 60.0))


def test_turning_ends_at_the_limit(opened):
    table = opened(limits_deg=(-10.0, 20.0))
    table.turn(1000.0)
    clock = SystemClock()
    end = clock.now_s() + 5.0
    while table.angle_deg() < 20.0 and clock.now_s() < end:
        clock.wait(0.005)
    assert table.angle_deg() == 20.0
    table.turn(1000.0)
    assert table.angle_deg() == 20.0, "it can go no further, and that is no error"


def test_speeds_are_those_that_were_asked_for(reporting):
    table, controller = reporting(SystemClock(), speed_deg_s=None)  # the virtual controller moves in real time
    assert controller.motor_settings().steps_s == 1000.0
    table.turn(-12.5)
    assert controller.status().speed == -25 * MICROSTEPS
    table.turn(12.25)
    assert controller.status().speed == round(24.5 * MICROSTEPS)
    table.close()
    again = Controller(XIMC, controller.device.rpartition(" ")[2])
    assert again.motor_settings().steps_s == 1000.0, "the controller has its own speed back"
    assert again.status().at_rest
    again.close()


@pytest.mark.parametrize("speed", [0.0, 1e-6, 2501.0, math.nan, -math.inf])
def test_a_speed_that_it_cannot_turn_with_is_refused(reporting, speed):
    table, controller = reporting()
    controller.said.clear()
    with pytest.raises(DeviceLimitError, match="deg/s"):
        table.turn(speed)
    assert controller.said == []


def test_an_angle_beyond_what_the_controller_counts_is_refused(reporting):
    table, controller = reporting()
    controller.said.clear()
    with pytest.raises(DeviceLimitError, match="deg"):
        table.move_to(2e9, 5.0)
    assert controller.said == []


def test_a_move_that_takes_too_long_is_stopped(reporting):
    table, controller = reporting()
    controller.change = lambda status: dataclasses.replace(status, at_rest=False)
    with pytest.raises(DeviceTimeoutError, match=r"move to 90 deg was not done within 2 s: it turns at .* deg"):
        table.move_to(90.0, 2.0)
    assert controller.said[-2:] == ["command_move", "command_sstp"]


def test_a_table_that_does_not_stop_is_stopped_at_once(reporting):
    table, controller = reporting()
    controller.change = lambda status: dataclasses.replace(status, at_rest=False)
    with pytest.raises(DeviceTimeoutError, match="may have lost steps"):
        table.stop(1.0)
    assert controller.said[-2:] == ["command_sstp", "command_stop"]


def test_a_limit_switch_in_the_middle_of_a_move_is_an_error_that_says_so(reporting):
    table, controller = reporting()
    controller.change = lambda status: dataclasses.replace(at_rest_at(17 * MICROSTEPS)(status), pressed=("right",))
    with pytest.raises(DeviceStateError, match=r"stands at 8\.5 deg.*limit switch pressed: right"):
        table.move_to(90.0, 5.0)
    assert controller.said[-1] == "command_sstp"


def test_a_command_that_shows_late_is_waited_for(reporting):
    """The controller may still report the rest before the move when it is first asked."""
    table, controller = reporting()
    reports = iter([0, 0, 0, 0])
    arrived = 180 * MICROSTEPS
    controller.change = lambda status: at_rest_at(next(reports, arrived))(status)
    assert table.move_to(90.0, 5.0) == 90.0


@pytest.mark.parametrize("sense", [1, -1])
def test_it_turns_when_turn_returns(reporting, sense):
    """The speed alone does not show it: the controller may tell that of its ramp, or of the command before."""
    table, controller = reporting()
    positions = iter([0, 0, -5 * sense, 0, 2 * sense, 77 * sense])
    controller.change = lambda status: dataclasses.replace(
        status, at_rest=False, speed=sense * 20 * MICROSTEPS, position=next(positions)
    )
    table.turn(sense * 10.0)
    assert next(positions) == 77 * sense


def test_a_stalled_turn_is_an_error(reporting):
    table, controller = reporting()
    controller.change = lambda status: dataclasses.replace(status, at_rest=True, speed=0, position=0)
    with pytest.raises(DeviceStateError, match="it stands"):
        table.turn(10.0)
    assert controller.said[-1] == "command_sstp"


def raise_flags(monkeypatch, flags, after=0):
    """The controller's own flags, as its library hands them over."""
    get, asked = Controller._get, []

    def altered(self, what):
        raw = get(self, what)
        if what == "status":
            asked.append(what)
            if len(asked) > after:
                raw.Flags |= flags
        return raw

    monkeypatch.setattr(Controller, "_get", altered)


def test_an_alarm_in_the_middle_of_a_move_is_told_in_words(reporting, monkeypatch):
    table, controller = reporting()
    raise_flags(monkeypatch, 0x40 | 0x20000 | 0x100, after=1)
    with pytest.raises(DeviceStateError, match="the motor driver is too hot, the H bridge has a fault") as caught:
        table.move_to(90.0, 5.0)
    assert "move to 90 deg" in str(caught.value)
    assert controller.said[-1] == "command_sstp"


def test_nothing_is_commanded_in_alarm(reporting, monkeypatch):
    table, controller = reporting(home="sensor")
    raise_flags(monkeypatch, 0x40)
    controller.said.clear()
    for action in (lambda: table.move_to(1.0, 5.0), lambda: table.turn(1.0), lambda: table.home(5.0)):
        with pytest.raises(DeviceStateError, match="in alarm: no cause is given"):
            action()
    assert controller.said == []


def test_an_alarm_that_stays_keeps_the_table_from_opening(opened, monkeypatch):
    raise_flags(monkeypatch, 0x40 | 0x10000)
    with pytest.raises(DeviceStateError, match="the supply voltage is too low"):
        opened()


def test_an_alarm_whose_cause_is_gone_ends_when_the_table_is_opened(tmp_path):
    controller = Reports(tmp_path)
    controller.change = lambda status: (
        status
        if "command_stop" in controller.said
        else dataclasses.replace(status, faults=("the supply voltage is too low",))
    )
    table = StandaTurntable(controller, settings(tmp_path), VirtualClock())
    assert table.move_to(0.0, 5.0) == 0.0
    table.close()


def test_bits_of_newer_firmware_are_no_error(reporting, monkeypatch):
    table, _ = reporting()
    raise_flags(monkeypatch, 0xFC000000)
    assert table.angle_deg() == 0.0


def test_homing_without_a_sensor_fails_and_stops(reporting):
    table, controller = reporting(home="sensor")
    controller.change = lambda status: dataclasses.replace(status, failed=True)
    with pytest.raises(DeviceStateError, match="without finding its sensor"):
        table.home(5.0)
    assert controller.said[-1] == "command_sstp"
    assert "command_zero" not in controller.said


def test_an_encoder_is_what_the_angle_is_read_from(tmp_path, reporting):
    with pytest.raises(DeviceStateError, match="its encoder is absent"):
        reporting(encoder_counts_per_deg=400.0)
    controller = Reports(tmp_path, lambda status: dataclasses.replace(status, encoder="working", encoder_counts=4001))
    table = StandaTurntable(controller, settings(tmp_path, encoder_counts_per_deg=400.0), SystemClock())
    assert table.info.encoder
    assert table.move_to(10.0, 5.0) == pytest.approx(10.0025)
    table.close()


@pytest.mark.parametrize(
    ("what", "field", "value", "words"),
    [
        ("entype_settings", "EngineType", 1, "another motor than a stepper"),
        ("feedback_settings", "FeedbackType", 1, "Set the feedback to 'none'"),
    ],
)
def test_a_motor_that_is_not_counted_in_steps_is_refused(tmp_path, opened, what, field, value, words):
    controller = Controller(XIMC, uri(tmp_path))
    raw = controller._get(what)
    setattr(raw, field, value)
    controller._set(what, raw)
    controller.close()
    with pytest.raises(DeviceStateError, match=words):
        opened()


def test_a_controller_that_goes_away_is_a_lost_connection_and_close_still_works(reporting):
    table, controller = reporting()
    call = controller._call
    controller._call = lambda name, *values: -4 if not name.startswith("close") else call(name, *values)
    with pytest.raises(DeviceConnectionError, match="gone or does not answer"):
        table.move_to(10.0, 5.0)
    table.close()
    with pytest.raises(DeviceStateError, match="closed"):
        table.angle_deg()


def test_an_interruption_while_it_closes_can_be_followed_by_another_close(reporting):
    table, controller = reporting()
    interruptions = [KeyboardInterrupt()]

    def interrupt(status):
        if interruptions:
            raise interruptions.pop()
        return status

    controller.change = interrupt
    with pytest.raises(KeyboardInterrupt):
        table.close()
    table.close()
    assert controller.said == ["command_sstp", "command_sstp"]
    with pytest.raises(DeviceStateError, match="closed"):
        controller.status()


def test_an_interrupted_move_is_stopped(reporting):
    table, controller = reporting()

    def interrupt(status):
        if "command_move" in controller.said:
            raise KeyboardInterrupt
        return status

    controller.change = interrupt
    with pytest.raises(KeyboardInterrupt):
        table.move_to(90.0, 5.0)
    assert controller.said[-2:] == ["command_move", "command_sstp"]


@pytest.mark.parametrize("error", [DeviceConnectionError("camera: gone"), KeyboardInterrupt(), SystemExit(143)])
def test_whatever_ends_the_work_the_laser_is_off_and_the_table_stands(tmp_path, error):
    connections = Connections()
    frames = (RecordedFrame("0000.png", None, False, None, lambda: np.zeros((48, 64), np.uint8)),)
    connections.provide("recording", Recording("bench", (RecordedCapture("ball", "scan", frames),)))
    tables = DeviceTables(ReplayedCamera(), settings(tmp_path), ReplayedLaser())
    rig = open_rig(tables, SystemClock(), connections)
    rig.laser.on()
    rig.turntable.turn(100.0)
    with pytest.raises(type(error)), rig:
        raise error
    assert not rig.laser.is_on
    controller = Controller(XIMC, uri(tmp_path))
    assert controller.status().at_rest, "the virtual controller's file says how it was left"
    assert controller.status().position > 0
    controller.close()


@pytest.fixture
def firmware():
    if sys.platform == "win32":
        pytest.skip("there are no pseudo-terminals: run it on Linux")
    from tests.devices.standa_firmware import Firmware

    controller = Firmware()
    yield controller
    controller.unplug()


@pytest.fixture
def serial(tmp_path, firmware):
    """Opens the stand-in on its serial port, through the library."""
    tables = []

    def make(**changes):
        made = settings(tmp_path, uri=f"xi-com:{firmware.name}", **changes)
        tables.append(open_turntable(made, VirtualClock(), Connections()))
        return tables[-1]

    yield make
    for table in tables:
        table.close()


class TestStandaOnASerialPort(TurntableContract):
    speed_deg_s = 100.0

    @pytest.fixture
    def turntable(self, serial):
        return serial(limits_deg=(-400.0, 400.0), microsteps=64)


def test_what_is_sent_to_the_controller(serial, firmware):
    table = serial(microsteps=32)
    table.move_to(-12.3, 5.0)
    assert firmware.position == round(-12.3 * STEPS_PER_DEG * 32)
    table.turn(30.0)
    assert firmware.speed == 60 * 32
    table.stop(5.0)
    table.home(5.0)
    table.close()
    assert firmware.said == ["seng", "smov", "move", "smov", "rigt", "sstp", "smov", "move", "sstp", "smov"]


def test_a_port_that_another_program_holds(serial, firmware):
    """The library locks its port."""
    table = serial()
    with pytest.raises(DeviceConnectionError, match=f"{firmware.name}: another program holds it"):
        serial()
    table.close()
    assert serial().angle_deg() == 0.0


def test_an_answer_that_came_damaged_is_asked_for_again(serial, firmware):
    table = serial()
    firmware.garbled = 2
    assert table.move_to(10.0, 5.0) == 10.0


def test_a_line_that_damages_everything_is_an_error_and_the_table_is_told_to_stop(serial, firmware):
    table = serial()
    table.turn(10.0)
    firmware.garbled = 10**6
    with pytest.raises(DeviceConnectionError, match="cannot be understood"):
        table.stop(5.0)
    assert firmware.said[-1] == "sstp"
    firmware.garbled = 0
    table.stop(5.0)
    assert table.move_to(10.0, 5.0) == 10.0


def test_a_controller_that_is_unplugged_while_it_turns(serial, firmware):
    table = serial()
    table.turn(10.0)
    firmware.unplug()
    with pytest.raises(DeviceConnectionError, match="gone or does not answer"):
        table.angle_deg()
    table.close()
    with pytest.raises(DeviceConnectionError, match="there is no such port"):
        serial()


def test_what_a_killed_program_left_turning_is_stopped(serial, firmware):
    firmware.speed, firmware.command = 5120, 0x84
    table = serial()
    assert firmware.said == ["sstp"]
    assert table.angle_deg() == table.angle_deg()


def test_an_alarm_over_the_line(serial, firmware):
    table = serial()
    firmware.flags = 0x40 | 0x10000 | 0xFC000000
    with pytest.raises(DeviceStateError, match=r"in alarm: the supply voltage is too low\."):
        table.move_to(1.0, 5.0)
    assert "move" not in firmware.said
    table.close()
    assert serial().move_to(1.0, 5.0) == 1.0, "opening clears what is no more"


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("xi-com:/dev/no-such-port", "there is no such port"),
        ("xi-emu:///no/such/folder/controller.bin", "must exist"),
        ("xi-tcp://127.0.0.1:9", "nothing answers"),
        ("/dev/ttyACM0", "Expected e.g. xi-com:"),
    ],
)
def test_an_address_where_nothing_is(opened, address, words):
    with pytest.raises(DeviceConnectionError, match=words):
        opened(uri=address)


def test_only_ports_with_the_usb_ids_of_the_maker_are_listed(tmp_path):
    for name, ids in (("ttyACM0", ("1cbe", "0007")), ("ttyACM1", ("2341", "0043"))):
        (tmp_path / name / "device" / "x").mkdir(parents=True)
        for key, value in zip(("idVendor", "idProduct"), ids, strict=True):
            (tmp_path / name / key).write_text(f"{value}\n")
    may_be = standa_controller._may_be_standa
    assert may_be(tmp_path / "ttyACM0", tmp_path)
    assert not may_be(tmp_path / "ttyACM1", tmp_path)
    assert isinstance(connected_uris(XIMC), tuple)
