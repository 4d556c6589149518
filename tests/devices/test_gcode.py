"""Serial G-code boards: contracts, every fault with its outcome, and transcripts byte for byte."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from tests.devices.contracts import LaserContract, TurntableContract
from tests.devices.gcode_firmware import GrblFirmware, MarlinFirmware, Transcript

from rotaline.errors import (
    DeviceConnectionError,
    DeviceError,
    DeviceLimitError,
    DeviceStateError,
    DeviceTimeoutError,
)
from rotaline.hardware.clock import VirtualClock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import find_devices, open_laser, open_turntable
from rotaline.hardware.gcode.connection import POLL_S
from rotaline.hardware.lasers.gcode import Settings as LaserSettings
from rotaline.hardware.turntables.gcode import Settings as TableSettings
from rotaline.io.device_file import parse_device_file

pytest.importorskip("serial", reason="pip install 'rotaline[serial]'")
pytest.importorskip("pty", reason="pseudo-terminals need Linux or macOS")

TIMEOUT_S = 20.0
IMPATIENT = {"answer_s": 0.3, "start_s": 2.0}
"""For tests in which nobody answers."""


def table_settings(firmware, **changes):
    return TableSettings.model_validate(
        {
            "driver": "gcode",
            "port": firmware.port,
            "dialect": "marlin" if isinstance(firmware, MarlinFirmware) else "grbl",
            "axis": "X",
            "units_per_deg": 2.0,
            "speed_deg_s": 30.0,
            "resolution_deg": 0.01,
            "u_angle_deg": 0.01,
        }
        | changes
    )


def laser_settings(firmware, **changes):
    return LaserSettings.model_validate(
        {
            "driver": "gcode",
            "port": firmware.port,
            "dialect": "marlin" if isinstance(firmware, MarlinFirmware) else "grbl",
        }
        | changes
    )


class Rig:
    """A board with a table and a laser at it, as ``open_rig`` opens them: the laser first."""

    def __init__(self, firmware, clock, table=None, laser=None, both=None):
        self.firmware = firmware
        self.connections = Connections()
        try:
            self.laser = open_laser(laser_settings(firmware, **(laser or {}), **(both or {})), clock, self.connections)
            self.table = open_turntable(
                table_settings(firmware, **(table or {}), **(both or {})), clock, self.connections
            )
        except BaseException:
            self.connections.close()
            raise

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.laser.close()
        self.table.close()
        self.connections.close()


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def grbl(clock):
    with GrblFirmware(clock) as firmware:
        yield firmware


@pytest.fixture
def marlin():
    with MarlinFirmware() as firmware:
        yield firmware


@pytest.fixture
def rig(grbl, clock):
    with Rig(grbl, clock) as opened:
        yield opened


@pytest.fixture
def impatient(grbl, clock):
    with Rig(grbl, clock, both=IMPATIENT) as opened:
        yield opened


@pytest.fixture
def marlin_rig(marlin, clock):
    with Rig(marlin, clock) as opened:
        yield opened


# ------------------------------------------------------------------------------------------------------------------ contracts


class TestGrblTurntable(TurntableContract):
    @pytest.fixture
    def turntable(self, rig):
        return rig.table


class TestGrblTurntableOtherWayRoundWithLimits(TurntableContract):
    @pytest.fixture
    def turntable(self, grbl, clock):
        with Rig(grbl, clock, {"units_per_deg": -0.5, "limits_deg": [-20.0, 200.0], "home": "none"}) as rig:
            yield rig.table


class TestGrblHalTurntableThatHomes(TurntableContract):
    @pytest.fixture
    def turntable(self, clock):
        with GrblFirmware(clock, homing=True) as firmware:
            firmware.GREETING = "\r\nGrblHAL 1.1f ['$' or '$HELP' for help]\r\n"
            changes = {"dialect": "grblhal", "axis": "A", "home": "$H", "units_per_deg": 1.0}
            with Rig(firmware, clock, changes, {"dialect": "grblhal"}) as rig:
                rig.table.home(TIMEOUT_S)
                yield rig.table


class TestMarlinTurntable(TurntableContract):
    @pytest.fixture
    def turntable(self, marlin, clock):
        with Rig(marlin, clock, {"home": "G28"}) as rig:
            rig.table.home(TIMEOUT_S)
            yield rig.table


class GcodeLaserContract(LaserContract):
    @pytest.fixture
    def laser(self, opened):
        return opened.laser

    @pytest.fixture
    def shines(self, opened):
        return lambda: opened.firmware.laser_s > 0


class TestGrblLaser(GcodeLaserContract):
    @pytest.fixture
    def opened(self, grbl, clock):
        grbl.light(1000.0)  # left on by a program before
        with Rig(grbl, clock, laser={"power_range": [0.0, 1000.0]}) as rig:
            yield rig


class TestGrblLaserThatIsOnlySwitched(GcodeLaserContract):
    @pytest.fixture
    def opened(self, rig):
        return rig


class TestMarlinFanLaser(GcodeLaserContract):
    @pytest.fixture
    def opened(self, marlin, clock):
        marlin.light(255.0)
        with Rig(marlin, clock, laser={"output": "M106", "fan": 1, "power_range": [0.0, 255.0]}) as rig:
            yield rig


# ------------------------------------------------------------------------------------------------------------- what is at rest


def test_a_move_ends_when_the_board_is_idle_not_when_it_says_ok(rig, clock):
    before_s = clock.now_s()
    assert rig.table.move_to(90.0, TIMEOUT_S) == pytest.approx(90.0, abs=1e-6)
    assert clock.now_s() - before_s >= 90.0 / 30.0
    assert rig.firmware.position[0] == pytest.approx(180.0)


def test_a_board_that_begins_a_little_after_its_ok(rig):
    rig.table.move_to(1.0, TIMEOUT_S)
    idle = "<Idle|MPos:2.000,0.000,0.000,0.000|FS:0,0>\r\n"
    rig.firmware.at(1, b"$J", lambda: rig.firmware.garble(lambda data: data + idle.encode()))
    assert rig.table.move_to(9.0, TIMEOUT_S) == pytest.approx(9.0)


def test_a_move_that_somebody_stops_is_no_success(rig, clock):
    rig.firmware.at(6, b"?", lambda: rig.firmware._realtime(b"\x85"))
    with pytest.raises(DeviceStateError, match=r"instead of 100\.000 deg. Somebody stopped it"):
        rig.table.move_to(100.0, TIMEOUT_S)
    assert 0 < rig.table.angle_deg() < 20.0


def test_a_board_that_never_begins_to_move(rig):
    rig.firmware._begin = lambda axis, target, feed, state: None
    with pytest.raises(DeviceStateError, match=r"stands at 0\.000 deg instead of 100\.000 deg"):
        rig.table.move_to(100.0, TIMEOUT_S)


def test_the_time_for_settling_is_waited_after_the_move(grbl, clock):
    took_s = {}
    for settle_s in (0.0, 1.5):
        with Rig(grbl, clock, {"settle_s": settle_s}) as rig:
            rig.table.move_to(0.0, TIMEOUT_S)
            before_s = clock.now_s()
            rig.table.move_to(3.0, TIMEOUT_S)
            took_s[settle_s] = clock.now_s() - before_s
    assert took_s[1.5] - took_s[0.0] == pytest.approx(1.5, abs=1.1 * POLL_S)


def test_angles_while_it_turns_follow_the_clock(rig, clock):
    rig.table.turn(12.0)
    first = rig.table.angle_deg()
    clock.wait(2.0)
    second = rig.table.angle_deg()
    rig.table.stop(TIMEOUT_S)
    assert second - first == pytest.approx(24.0, abs=1e-3)


def test_turning_ends_at_the_limit(grbl, clock):
    with Rig(grbl, clock, {"limits_deg": [-10.0, 50.0]}) as rig:
        rig.table.turn(20.0)
        clock.wait(60.0)
        assert rig.table.angle_deg() == pytest.approx(50.0)
        rig.table.stop(TIMEOUT_S)
        with pytest.raises(DeviceLimitError, match="no way left"):
            rig.table.turn(20.0)


@pytest.mark.parametrize("speed", [0.0, float("nan"), float("inf")])
def test_a_speed_that_is_none_is_refused(rig, speed):
    with pytest.raises(DeviceLimitError, match="deg/s"):
        rig.table.turn(speed)


def test_a_table_that_turns_stands_once_it_is_closed(rig):
    rig.table.turn(5.0)
    rig.table.close()
    assert rig.firmware.state == "Idle"


def test_an_open_safety_door_is_waited_for_until_the_table_stands(rig):
    states = ["Door:2", "Door:2", "Door:1"]
    rig.firmware._report = lambda: rig.firmware.say(f"<{states.pop(0)}|MPos:0.000,0.000,0.000,0.000|FS:0,0>\r\n")
    rig.table.stop(TIMEOUT_S)
    assert states == []
    rig.firmware._report = lambda: rig.firmware.say("<Door:1|MPos:0.000,0.000,0.000,0.000|FS:0,0>\r\n")
    with pytest.raises(DeviceStateError, match="safety door is open"):
        rig.table.move_to(1.0, TIMEOUT_S)


def test_while_it_turns_it_takes_no_other_task(rig):
    rig.table.turn(5.0)
    for task in (
        lambda: rig.table.move_to(3.0, TIMEOUT_S),
        lambda: rig.table.home(TIMEOUT_S),
        lambda: rig.table.turn(6.0),
    ):
        with pytest.raises(DeviceStateError, match="still turns"):
            task()


def test_the_board_own_zero_is_kept_from_one_program_to_the_next(grbl, clock):
    for start in (0.0, 33.0):
        with Rig(grbl, clock, {"home": "none"}) as rig:
            assert rig.table.angle_deg() == pytest.approx(start)
            rig.table.move_to(33.0, TIMEOUT_S)
    with Rig(grbl, clock, {"home": "none"}) as rig:
        rig.table.home(TIMEOUT_S)
    assert grbl.position[0] == 0.0


# ------------------------------------------------------------------------------------------------------------------- the laser


def test_the_laser_goes_off_although_the_table_turns_and_the_table_is_stopped_for_it(rig):
    rig.laser.on()
    rig.table.turn(5.0)
    rig.laser.off()
    assert rig.firmware.laser_s == 0
    assert rig.firmware.state == "Idle"


def test_the_laser_is_not_switched_on_while_the_table_turns(rig):
    rig.table.turn(5.0)
    with pytest.raises(DeviceStateError, match="only while the table stands"):
        rig.laser.on()
    assert not rig.laser.is_on
    assert rig.firmware.laser_s == 0


def test_power_is_a_share_of_the_range(grbl, clock):
    with Rig(grbl, clock, laser={"power_range": [100.0, 900.0]}) as rig:
        rig.laser.set_power(0.25)
        rig.laser.on()
        assert grbl.laser_s == 300.0
        rig.laser.set_power(1.0)
        assert grbl.laser_s == 900.0


def test_the_time_for_switching_is_waited(grbl, clock):
    with Rig(grbl, clock, laser={"switching_s": 0.7}) as rig:
        before_s = clock.now_s()
        rig.laser.on()
        assert clock.now_s() - before_s == pytest.approx(0.7)


def test_a_board_in_laser_mode_is_refused(clock):
    with (
        GrblFirmware(clock, settings={32: 1}) as firmware,
        pytest.raises(DeviceStateError, match=r"\$32=0"),
        Rig(firmware, clock),
    ):
        pass


def test_more_power_than_the_board_gives_is_refused(clock):
    with (
        GrblFirmware(clock, settings={30: 500}) as firmware,
        pytest.raises(DeviceLimitError, match="S1000"),
        Rig(firmware, clock, laser={"power_range": [0.0, 1000.0]}),
    ):
        pass


def test_a_marlin_that_knows_no_laser_says_so(clock):
    with MarlinFirmware(knows_m3=False) as firmware, pytest.raises(DeviceStateError, match="does not know 'M5'"):
        Rig(firmware, clock)


# ---------------------------------------------------------------------------------------------------------------------- limits


def test_the_soft_limit_of_the_board_moves_nothing(clock):
    with GrblFirmware(clock, travel=(-100.0, 100.0)) as firmware, Rig(firmware, clock) as rig:
        with pytest.raises(DeviceLimitError, match="outside of the travel"):
            rig.table.move_to(60.0, TIMEOUT_S)
        assert firmware.position[0] == 0.0
        assert rig.table.move_to(49.0, TIMEOUT_S) == pytest.approx(49.0)


def test_a_soft_limit_alarm_locks_until_home(impatient):
    impatient.firmware.at(2, b"?", lambda: impatient.firmware.alarm(2))
    impatient.laser.on()
    with pytest.raises(DeviceStateError, match="ALARM:2, a target outside of the board's soft limits"):
        impatient.table.move_to(40.0, TIMEOUT_S)
    assert impatient.firmware.laser_s == 0
    assert not impatient.laser.is_on
    with pytest.raises(DeviceStateError, match="not homed"):
        impatient.table.move_to(10.0, TIMEOUT_S)
    impatient.table.home(TIMEOUT_S)
    assert impatient.table.move_to(10.0, TIMEOUT_S) == pytest.approx(10.0)


def test_marlin_clipping_a_move_is_found_out(clock):
    with MarlinFirmware(endstops=(0.0, 100.0)) as firmware, Rig(firmware, clock) as rig:
        with pytest.raises(DeviceStateError, match=r"stands at 50\.000 deg instead of 60\.000 deg"):
            rig.table.move_to(60.0, TIMEOUT_S)
        assert rig.table.move_to(40.0, TIMEOUT_S) == pytest.approx(40.0)


def test_a_speed_beyond_the_board_is_refused_when_it_is_opened(grbl, clock):
    with pytest.raises(DeviceLimitError, match=r"60 deg/s is faster than the board allows, 50 deg/s"):
        Rig(grbl, clock, {"speed_deg_s": 60.0})


# ------------------------------------------------------------------------------------------------------ the serial line's faults


def test_a_garbled_report_is_asked_for_again(impatient):
    for change in (lambda data: b"\xff\x00<Jo\xfe" + data[7:], lambda data: data[:9] + b"\n", lambda data: b""):
        impatient.firmware.garble(change)
        assert impatient.table.angle_deg() == pytest.approx(0.0)


def test_a_report_in_halves_is_put_together(impatient):
    rest = []

    def half(data: bytes) -> bytes:
        rest.append(data[12:])
        impatient.firmware.at(1, b"?", lambda: impatient.firmware.say(rest[0]))
        return data[:12]

    impatient.table.move_to(5.0, TIMEOUT_S)
    impatient.firmware.garble(half)
    assert impatient.table.angle_deg() == pytest.approx(5.0)
    assert impatient.table.move_to(6.0, TIMEOUT_S) == pytest.approx(6.0)


def test_half_a_report_that_never_ends_spoils_nothing_but_itself(impatient):
    impatient.firmware.garble(lambda data: data[:12])
    assert impatient.table.angle_deg() == pytest.approx(0.0)


def test_a_garbled_answer_ends_in_a_time_out_and_the_table_stands(impatient):
    impatient.laser.on()
    impatient.firmware.at(1, b"$J", lambda: impatient.firmware.garble(lambda data: b"o\xf0\n"))
    with pytest.raises(DeviceTimeoutError, match=r"\$J=G21G53X80\.0000F3600\.00.*'o.xf0'"):
        impatient.table.move_to(40.0, TIMEOUT_S)
    assert impatient.firmware.state == "Idle"
    assert 0 <= impatient.firmware.position[0] < 80.0
    impatient.laser.off()
    assert impatient.firmware.laser_s == 0
    assert impatient.table.move_to(40.0, TIMEOUT_S) == pytest.approx(40.0), "it knows where it is, and goes on"


def test_half_a_line_left_by_a_program_before_spoils_nothing(grbl, clock):
    grbl.take(b"G1 X5")
    with Rig(grbl, clock) as rig:
        assert rig.table.move_to(3.0, TIMEOUT_S) == pytest.approx(3.0)


def test_noise_without_end_is_no_answer(impatient):
    impatient.firmware.garble(lambda data: b"\xaa" * 3000)
    assert impatient.table.angle_deg() == pytest.approx(0.0)


def test_no_answer_at_all_is_a_time_out_that_names_what_to_look_at(grbl, clock):
    grbl._realtime = lambda byte: None
    with pytest.raises(DeviceTimeoutError, match="Are port, baud rate and dialect right"):
        Rig(grbl, clock, both={"start_s": 0.3})


def test_a_board_that_falls_mute_is_reset_and_not_homed_any_more(impatient):
    impatient.laser.on()

    def hang():
        impatient.firmware.mute = True

    impatient.firmware.at(3, b"?", hang)
    with pytest.raises(DeviceTimeoutError, match="no status report"):
        impatient.table.move_to(100.0, TIMEOUT_S)
    assert impatient.firmware.received.count(b"\x18") == 1
    assert impatient.firmware.laser_s == 0
    assert not impatient.laser.is_on
    assert impatient.firmware.position[0] < 200.0
    with pytest.raises(DeviceStateError, match="not homed"):
        impatient.table.move_to(1.0, TIMEOUT_S)
    with pytest.raises(DeviceStateError, match="not homed"):
        impatient.table.angle_deg()
    impatient.table.home(TIMEOUT_S)
    assert impatient.table.angle_deg() == pytest.approx(0.0)


def test_a_move_that_takes_too_long_is_stopped_and_knows_where(rig):
    with pytest.raises(DeviceTimeoutError, match="still moved after 1 s"):
        rig.table.move_to(300.0, 1.0)
    assert rig.firmware.state == "Idle"
    assert 0 < rig.table.angle_deg() < 40.0
    assert rig.table.move_to(0.0, TIMEOUT_S) == pytest.approx(0.0)


def test_an_interruption_stops_the_table(rig):
    def interrupt():
        raise KeyboardInterrupt

    wait = rig.table._board._clock.wait
    rig.table._board._clock.wait = lambda seconds: interrupt()
    with pytest.raises(KeyboardInterrupt):
        rig.table.move_to(300.0, TIMEOUT_S)
    rig.table._board._clock.wait = wait
    assert b"\x85" in rig.firmware.received[rig.firmware.received.index(b"$J=G21G53X600.0000F3600.00") :]


def test_an_error_has_its_meaning_in_words(grbl, clock):
    with GrblFirmware(clock, n_axes=4) as firmware, Rig(firmware, clock) as rig:
        firmware._jog = lambda words: 46
        with pytest.raises(DeviceStateError, match="error:46, the board wants to be homed first"):
            rig.table.move_to(3.0, TIMEOUT_S)
        firmware._jog = lambda words: 200
        with pytest.raises(DeviceStateError, match="error:200, see the list of the firmware"):
            rig.table.move_to(3.0, TIMEOUT_S)


def test_a_limit_switch_in_the_middle_of_a_move(impatient):
    impatient.laser.on()
    impatient.firmware.at(3, b"?", lambda: impatient.firmware.alarm(1))
    with pytest.raises(DeviceStateError, match="ALARM:1, a limit switch was hit; the position is lost"):
        impatient.table.move_to(100.0, TIMEOUT_S)
    assert impatient.firmware.laser_s == 0
    assert not impatient.laser.is_on
    with pytest.raises(DeviceStateError, match="not homed"):
        impatient.table.turn(3.0)
    impatient.table.home(TIMEOUT_S)
    assert impatient.table.move_to(2.0, TIMEOUT_S) == pytest.approx(2.0)


def test_a_reset_in_the_middle_of_a_move_loses_the_position(rig):
    rig.laser.on()
    rig.firmware.at(3, b"?", rig.firmware.reset_by_itself)
    with pytest.raises(DeviceStateError, match=r"was reset .its greeting came., so that the position is lost"):
        rig.table.move_to(100.0, TIMEOUT_S)
    assert not rig.laser.is_on
    assert rig.firmware.laser_s == 0
    for task in (lambda: rig.table.move_to(1.0, TIMEOUT_S), rig.table.angle_deg, lambda: rig.table.turn(3.0)):
        with pytest.raises(DeviceStateError, match="not homed"):
            task()
    rig.table.home(TIMEOUT_S)
    assert rig.table.move_to(1.0, TIMEOUT_S) == pytest.approx(1.0)


def test_a_reset_while_nobody_asks_is_noticed(rig):
    rig.laser.on()
    rig.firmware.reset_by_itself()
    with pytest.raises(DeviceStateError, match="position is lost"):
        rig.table.move_to(1.0, TIMEOUT_S)
    assert not rig.laser.is_on


def test_homing_that_finds_no_switch(clock):
    with GrblFirmware(clock, homing=True) as firmware, Rig(firmware, clock, {"home": "$H"}) as rig:

        def fails():
            firmware.alarm(9)
            return None

        firmware._home = fails
        with pytest.raises(DeviceStateError, match="ALARM:9, homing failed: no limit switch was found"):
            rig.table.home(TIMEOUT_S)
        with pytest.raises(DeviceStateError, match="not homed"):
            rig.table.move_to(1.0, TIMEOUT_S)


def test_homing_that_takes_too_long_is_ended_by_a_reset(clock):
    with GrblFirmware(clock, homing=True) as firmware, Rig(firmware, clock, {"home": "$H"}, both=IMPATIENT) as rig:

        def goes_on():
            firmware.state = "Home"
            return None

        firmware._home = goes_on
        with pytest.raises(DeviceTimeoutError, match=r"no answer to '\$H'"):
            rig.table.home(0.2)
        assert firmware.state == "Alarm"
        with pytest.raises(DeviceStateError, match="not homed"):
            rig.table.angle_deg()


def test_a_table_that_has_to_be_homed_first_says_so(clock):
    with GrblFirmware(clock, homing=True) as firmware, Rig(firmware, clock, {"home": "$H"}) as rig:
        with pytest.raises(DeviceStateError, match="not homed"):
            rig.table.move_to(1.0, TIMEOUT_S)
        assert not [line for line in firmware.received if line.startswith(b"$J")]


def test_a_board_that_moves_for_a_program_before_is_stopped_without_losing_its_place(grbl, clock):
    grbl.begin_program_move(0, 500.0, 600.0)
    clock.wait(3.0)
    with Rig(grbl, clock, {"home": "none"}) as rig:
        assert grbl.state == "Idle"
        assert 0 < rig.table.angle_deg() < 250.0
        assert rig.table.move_to(1.0, TIMEOUT_S) == pytest.approx(1.0)
    assert grbl.received.index(b"!") < grbl.received.index(b"\x18"), "held first, so that the reset loses nothing"


def test_reports_without_machine_position_are_refused(grbl, clock):
    grbl._report = lambda: grbl.say("<Idle|WPos:0.000,0.000,0.000|FS:0,0>\r\n")
    with pytest.raises(DeviceStateError, match=r"\$10=1"):
        Rig(grbl, clock)


def test_an_axis_that_the_board_does_not_have(clock):
    with (
        GrblFirmware(clock, n_axes=3) as firmware,
        pytest.raises(DeviceStateError, match=r"3 axes \(X Y Z\), none of them is A"),
    ):
        Rig(firmware, clock, {"axis": "A"})


# ------------------------------------------------------------------------------------------------------- the light in faults

FAULTS = {
    "answer garbled": lambda f: f.at(1, b"$J", lambda: f.garble(lambda data: b"\xf0\n")),
    "mute": lambda f: f.at(3, b"?", lambda: setattr(f, "mute", True)),
    "limit switch": lambda f: f.at(3, b"?", lambda: f.alarm(1)),
    "soft limit": lambda f: f.at(3, b"?", lambda: f.alarm(2)),
    "reset": lambda f: f.at(3, b"?", f.reset_by_itself),
    "error": lambda f: setattr(f, "_jog", lambda words: 46),
    "somebody stops it": lambda f: f.at(6, b"?", lambda: f._realtime(b"\x85")),
    "nothing": lambda f: None,
}


@pytest.mark.parametrize("fault", sorted(FAULTS))
def test_the_light_is_off_after_every_fault_once_the_rig_is_closed(grbl, clock, fault):
    with Rig(grbl, clock, both=IMPATIENT) as rig:
        rig.laser.on()
        FAULTS[fault](grbl)
        with pytest.raises(DeviceError):
            rig.table.move_to(100.0, 2.0)
        rig.laser.close()
        assert grbl.laser_s == 0
    assert grbl.state in ("Idle", "Alarm"), "and the table stands"


@pytest.mark.parametrize("fault", sorted(FAULTS))
def test_a_light_that_is_off_stays_off_in_every_fault(grbl, clock, fault):
    with Rig(grbl, clock, both=IMPATIENT) as rig:
        FAULTS[fault](grbl)
        with pytest.raises(DeviceError):
            rig.table.move_to(100.0, 2.0)
    assert not any(grbl.laser_log)


def test_a_laser_whose_switching_on_is_not_answered_is_switched_off(impatient):
    impatient.firmware.at(1, b"M3", lambda: impatient.firmware.garble(lambda data: b"o\n"))
    with pytest.raises(DeviceTimeoutError, match="no answer to 'M3'"):
        impatient.laser.on()
    assert not impatient.laser.is_on
    assert impatient.firmware.laser_log[-2:] == [1000.0, 0.0]


def test_a_laser_whose_switching_off_is_not_answered_is_reset(impatient):
    impatient.laser.on()
    impatient.firmware.at(1, b"M5", lambda: setattr(impatient.firmware, "mute", True))
    impatient.laser.off()
    assert not impatient.laser.is_on
    assert impatient.firmware.received[-2:] == [b"\x18", b""]
    assert impatient.table.move_to(2.0, TIMEOUT_S) == pytest.approx(2.0), "it stood: nothing is lost"


# ---------------------------------------------------------------------------------------------------------------- the port


@pytest.mark.parametrize("table_at", [1, 2, 3])
def test_a_port_that_goes_away_in_a_move(grbl, clock, table_at):
    with Rig(grbl, clock) as rig:
        grbl.at(table_at, b"?", grbl.unplug)
        with pytest.raises(DeviceConnectionError, match="the port is gone"):
            rig.table.move_to(100.0, TIMEOUT_S)
        with pytest.raises(DeviceConnectionError, match="the port is gone"):
            rig.table.stop(TIMEOUT_S)
        assert grbl.laser_s == 0


def test_a_second_process_at_the_port(grbl, clock):
    program = (
        "import sys, serial\n"
        "port = serial.Serial(sys.argv[1], exclusive=True)\n"
        "print('held', flush=True)\n"
        "sys.stdin.readline()\n"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", program, grbl.port], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    try:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(DeviceConnectionError, match="another program holds this port"):
            Rig(grbl, clock)
        assert grbl.laser_log == []
    finally:
        other.communicate("\n")
    with Rig(grbl, clock):
        assert grbl.laser_s == 0


def test_a_port_that_is_not_there(clock):
    class Nothing:
        port = "/dev/no-such-port"

    with pytest.raises(DeviceConnectionError, match=r"/dev/no-such-port: the port cannot be opened.*rotaline devices"):
        open_turntable(table_settings(Nothing()), clock, Connections())


def test_two_devices_that_disagree_about_their_port(grbl, clock):
    with pytest.raises(DeviceConnectionError, match="State the same for both"):
        Rig(grbl, clock, {"baud": 9600})


def test_the_port_is_free_again_once_everything_is_closed(grbl, clock):
    for _ in range(2):
        with Rig(grbl, clock) as rig:
            rig.laser.on()
        assert grbl.laser_s == 0


def test_no_serial_library_is_one_sentence(grbl, clock, monkeypatch):
    monkeypatch.setitem(sys.modules, "serial", None)
    with pytest.raises(DeviceConnectionError, match=r"pip install 'rotaline\[serial\]'"):
        Rig(grbl, clock)


# ----------------------------------------------------------------------------------------------------------------------- Marlin


def test_a_line_that_arrived_damaged_is_sent_again(marlin_rig):
    marlin_rig.firmware.damage = 2
    assert marlin_rig.table.move_to(12.0, TIMEOUT_S) == pytest.approx(12.0)
    assert marlin_rig.firmware.damage == 0


def test_a_line_that_always_arrives_damaged_is_given_up(marlin_rig):
    marlin_rig.firmware.damage = 8
    with pytest.raises(DeviceConnectionError, match="arrived damaged 4 times"):
        marlin_rig.table.move_to(12.0, TIMEOUT_S)
    assert marlin_rig.firmware.position["X"] == 0.0


def test_marlin_is_stopped_by_m410_and_not_homed_any_more(marlin_rig):
    marlin_rig.laser.on()
    marlin_rig.firmware.stalls = True
    with pytest.raises(DeviceTimeoutError, match="no answer to 'M400'"):
        marlin_rig.table.move_to(100.0, 0.2)
    assert b"M410" in marlin_rig.firmware.received
    assert not marlin_rig.firmware._stalled
    with pytest.raises(DeviceStateError, match="may have lost steps"):
        marlin_rig.table.move_to(1.0, TIMEOUT_S)
    marlin_rig.laser.close()
    assert marlin_rig.firmware.laser_s == 0
    marlin_rig.table.home(TIMEOUT_S)
    assert marlin_rig.table.angle_deg() == pytest.approx(0.0)


def test_marlin_without_emergency_parser_says_why_it_does_not_stop(clock):
    with MarlinFirmware(emergency_parser=False) as firmware, Rig(firmware, clock, both=IMPATIENT) as rig:
        firmware.stalls = True
        with pytest.raises(DeviceTimeoutError):
            rig.table.move_to(100.0, 0.2)
        with pytest.raises(DeviceTimeoutError, match="EMERGENCY_PARSER"):
            rig.table.stop(0.2)
        firmware.emergency_parser = True  # its move has ended
        rig.table.stop(TIMEOUT_S)


def test_a_reset_of_marlin_in_the_middle_of_a_move(marlin_rig):
    marlin_rig.laser.on()
    marlin_rig.firmware.at(1, b"M400", marlin_rig.firmware.reset_by_itself)
    with pytest.raises(DeviceStateError, match="'start' came"):
        marlin_rig.table.move_to(10.0, TIMEOUT_S)
    assert not marlin_rig.laser.is_on
    assert marlin_rig.firmware.laser_s == 0
    with pytest.raises(DeviceStateError, match="not homed"):
        marlin_rig.table.move_to(1.0, TIMEOUT_S)
    marlin_rig.table.home(TIMEOUT_S)
    assert marlin_rig.table.move_to(1.0, TIMEOUT_S) == pytest.approx(1.0)


def test_an_error_of_marlin_is_told_as_it_stands(marlin_rig):
    marlin_rig.firmware.at(1, b"M400", lambda: marlin_rig.firmware.say("Error:Printer halted. kill() called!\n"))
    with pytest.raises(DeviceStateError, match=r"kill\(\) called.*switch it off and on"):
        marlin_rig.table.move_to(10.0, TIMEOUT_S)
    marlin_rig.laser.off()
    assert marlin_rig.firmware.laser_s == 0


def test_marlin_cannot_turn_continuously_and_says_so(marlin_rig):
    assert not marlin_rig.table.info.continuous
    with pytest.raises(DeviceStateError, match="Step and shoot"):
        marlin_rig.table.turn(3.0)


def test_a_marlin_that_says_nothing(clock):
    with MarlinFirmware() as firmware:
        firmware.mute = True
        with pytest.raises(DeviceTimeoutError, match="Are port, baud rate and dialect right"):
            Rig(firmware, clock, both={"start_s": 0.3})


# --------------------------------------------------------------------------------------------------------------------- settings


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"units_per_deg": 0.0}, "units_per_deg is 0"),
        ({"limits_deg": [10.0, -10.0]}, "the first has to be the smaller one"),
        ({"home": "G28"}, "G28 for marlin"),
        ({"dialect": "marlin", "home": "$H"}, r"\$H is for grbl"),
        ({"axis": "E"}, "axis"),
    ],
)
def test_settings_of_the_table_that_contradict_themselves(grbl, changes, words):
    with pytest.raises(ValueError, match=words):
        table_settings(grbl, **changes)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"output": "M106"}, "no fan outputs"),
        ({"dialect": "marlin", "output": "M106", "power_range": [0.0, 1000.0]}, "S255"),
        ({"power_range": [5.0, 5.0]}, "smaller"),
        ({"fan": -1}, "counted from 0"),
    ],
)
def test_settings_of_the_laser_that_contradict_themselves(grbl, changes, words):
    with pytest.raises(ValueError, match=words):
        laser_settings(grbl, **changes)


@pytest.mark.parametrize("page", ["grbl", "marlin", "manual"])
def test_the_example_of_the_documentation_is_valid(page):
    path = Path(__file__).parents[2] / "docs" / "how-to" / "devices" / f"{page}.md"
    example = path.read_text(encoding="utf-8").split("```toml\n")[1].split("```")[0]
    devices = parse_device_file(example, page, path.parent).devices
    assert devices.turntable.driver == devices.laser.driver == ("manual" if page == "manual" else "gcode")
    if page != "manual":
        assert (devices.turntable.port, devices.turntable.baud) == (devices.laser.port, devices.laser.baud)


def test_find_lists_the_ports_of_usb_devices_and_how_to_write_them_down(monkeypatch):
    from serial.tools import list_ports

    class Port:
        def __init__(self, device, vid):
            self.device, self.vid, self.description = device, vid, "USB Serial"

    monkeypatch.setattr(list_ports, "comports", lambda: [Port("/dev/ttyUSB7", 0x1A86), Port("/dev/ttyS0", None)])
    for kind, settings in (("turntable", TableSettings), ("laser", LaserSettings)):
        (found,) = find_devices(kind, "gcode")
        assert "/dev/ttyUSB7" in found.name
        assert settings.model_validate(tomllib.loads(found.toml)[kind]).port == "/dev/ttyUSB7"


# ------------------------------------------------------------------------------------------------------------------ transcripts


def _grbl_home(rig):
    rig.table.home(TIMEOUT_S)


def _grbl_move(rig):
    assert rig.table.move_to(10.0, TIMEOUT_S) == pytest.approx(10.0)


def _limit(rig):
    with pytest.raises(DeviceLimitError):
        rig.table.move_to(400.0, TIMEOUT_S)


def _laser(rig):
    rig.laser.set_power(0.5)
    rig.laser.on()
    rig.laser.off()


def _stop(rig):
    rig.table.turn(10.0)
    rig.table.stop(TIMEOUT_S)


def _alarm(rig):
    with pytest.raises(DeviceStateError, match="ALARM:1"):
        rig.table.move_to(10.0, TIMEOUT_S)


def _marlin_stop(rig):
    with pytest.raises(DeviceTimeoutError):
        rig.table.move_to(10.0, 0.1)


def _marlin_alarm(rig):
    with pytest.raises(DeviceStateError, match="halted"):
        rig.table.move_to(10.0, TIMEOUT_S)


TRANSCRIPTS = Path(__file__).parent / "transcripts"
TASKS = {
    "grbl-home": _grbl_home,
    "grbl-move": _grbl_move,
    "grbl-limit": _limit,
    "grbl-laser": _laser,
    "grbl-stop": _stop,
    "grbl-alarm": _alarm,
    "marlin-home": _grbl_home,
    "marlin-move": _grbl_move,
    "marlin-laser": _laser,
    "marlin-stop": _marlin_stop,
    "marlin-alarm": _marlin_alarm,
}


def test_every_transcript_is_played():
    assert {path.stem for path in TRANSCRIPTS.glob("*.txt")} == set(TASKS)


@pytest.mark.parametrize("name", sorted(TASKS))
def test_what_is_said_is_the_transcript_byte_for_byte(name, clock):
    marlin = name.startswith("marlin")
    dialect = {"dialect": "marlin" if marlin else "grbl"}
    table = dialect | {"home": "here"}
    if name.endswith("-home"):
        table["home"] = "G28" if marlin else "$H"
    laser = dialect | (
        {"output": "M106", "fan": 1, "power_range": [0.0, 255.0]} if marlin else {"power_range": [0.0, 1000.0]}
    )
    both = {"answer_s": 0.2, "start_s": 2.0} if name == "marlin-alarm" else None
    text = (TRANSCRIPTS / f"{name}.txt").read_text(encoding="ascii")
    with Transcript(text) as board:
        rig = None
        try:
            rig = Rig(board, clock, table, laser, both)
            TASKS[name](rig)
        except DeviceError as error:
            pytest.fail(f"{board.wrong or 'no difference'}; left: {board.left[:3]}; {error}")
        finally:
            if rig is not None:
                rig.connections.close()
    assert board.wrong is None
    assert board.left == []
