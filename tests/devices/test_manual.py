"""Table and laser that a person works: contracts with a scripted person, and what the person may answer."""

import pytest
from tests.devices.contracts import LaserContract, TurntableContract

from rotaline.errors import DeviceLimitError, DeviceStateError
from rotaline.hardware.clock import VirtualClock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import find_devices, open_laser, open_turntable
from rotaline.hardware.lasers.manual import Settings as LaserSettings
from rotaline.hardware.turntables.manual import Settings as TableSettings


class Person:
    """Does what is asked and presses Enter, or gives the answers that were put down; switches the laser that there is."""

    def __init__(self):
        self.questions: list[str] = []
        self.answers: list[str | BaseException] = []
        self.shines = True

    def __call__(self, question: str) -> str:
        self.questions.append(question)
        if self.answers:
            answer = self.answers.pop(0)
            if isinstance(answer, BaseException):
                raise answer
            return answer
        if "switch it" in question:
            self.shines = "switch it on" in question
        return ""


@pytest.fixture
def person():
    return Person()


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def connections(person):
    made = Connections()
    made.provide("prompt", person)
    return made


def table_settings(**changes):
    return TableSettings.model_validate({"driver": "manual", "resolution_deg": 0.1, "u_angle_deg": 0.05} | changes)


@pytest.fixture
def table(connections, clock):
    return open_turntable(table_settings(limits_deg=[-10.0, 400.0]), clock, connections)


@pytest.fixture
def light(connections, clock):
    return open_laser(LaserSettings(driver="manual"), clock, connections)


class TestManualTurntable(TurntableContract):
    @pytest.fixture
    def turntable(self, connections, clock):
        opened = open_turntable(table_settings(limits_deg=[-10.0, 400.0]), clock, connections)
        opened.home(1.0)
        return opened


class TestManualLaser(LaserContract):
    @pytest.fixture
    def laser(self, light):
        return light

    @pytest.fixture
    def shines(self, person):
        return lambda: person.shines


def test_enter_means_that_it_stands_where_it_was_asked_to(table, person):
    assert table.move_to(30.0, 1.0) == 30.0
    assert "turn it to 30.000 deg" in person.questions[-1]


@pytest.mark.parametrize("typed", ["30.05", " 30,05 "])
def test_the_angle_that_was_read_counts(table, person, typed):
    person.answers = [typed]
    assert table.move_to(30.0, 1.0) == 30.05
    assert table.angle_deg() == 30.05


def test_an_angle_far_off_is_believed_only_when_it_is_typed_twice(table, person):
    person.answers = ["300", "30"]
    assert table.move_to(30.0, 1.0) == 30.0
    assert "300 deg is +270 deg off" in person.questions[-1]
    person.answers = ["25", "25"]
    assert table.move_to(40.0, 1.0) == 25.0


@pytest.mark.parametrize("typed", ["thirty", "nan", "inf", "401"])
def test_what_is_no_angle_is_asked_again(table, person, typed):
    person.answers = [typed]
    assert table.move_to(30.0, 1.0) == 30.0
    assert f"'{typed}' is no angle" in person.questions[-1]
    assert len(person.questions) == 2


def test_nobody_is_asked_for_an_angle_outside_the_limits(table, person):
    with pytest.raises(DeviceLimitError):
        table.move_to(401.0, 1.0)
    assert person.questions == []


def test_where_it_stands_is_not_known_before_somebody_has_said_so(table, person):
    with pytest.raises(DeviceStateError, match="not known"):
        table.angle_deg()
    table.move_to(30.0, 1.0)
    person.answers = [EOFError()]
    with pytest.raises(DeviceStateError, match="nobody answers"):
        table.move_to(60.0, 1.0)
    with pytest.raises(DeviceStateError, match="not known"):
        table.angle_deg()


def test_nobody_is_asked_for_the_angle_at_which_it_stands(table, person):
    table.home(1.0)
    assert table.move_to(0.0, 1.0) == 0.0
    person.answers = ["30.05"]
    assert table.move_to(30.0, 1.0) == 30.05
    assert len(person.questions) == 2
    assert table.move_to(30.0, 1.0) == 30.05  # as near to it as can be read
    assert table.move_to(30.05, 1.0) == 30.05
    assert len(person.questions) == 2
    table.move_to(30.1, 1.0)  # a step that is smaller than what can be read
    assert len(person.questions) == 3
    person.answers = ["25", "25"]
    assert table.move_to(60.0, 1.0) == 25.0
    table.move_to(60.0, 1.0)  # it is not there
    assert "turn it to 60.000 deg" in person.questions[-1]


def test_a_move_or_a_home_that_was_broken_off_is_asked_for_again(table, person):
    for move in (lambda: table.move_to(30.0, 1.0), lambda: table.home(1.0)):
        table.move_to(0.0, 1.0)
        person.answers = [KeyboardInterrupt()]
        with pytest.raises(KeyboardInterrupt):
            move()
        n = len(person.questions)
        table.move_to(0.0, 1.0)
        assert len(person.questions) == n + 1


def test_the_time_for_settling_is_waited(connections, clock):
    table = open_turntable(table_settings(settle_s=3.0), clock, connections)
    table.home(1.0)
    assert clock.now_s() == 3.0
    table.move_to(10.0, 1.0)
    assert clock.now_s() == 6.0


def test_without_limits_it_turns_on_and_on(connections, clock):
    table = open_turntable(table_settings(), clock, connections)
    assert table.info.limits_deg is None
    assert table.move_to(7200.0, 1.0) == 7200.0


def test_the_laser_is_switched_off_first_of_all(light, person):
    assert person.questions == ["laser: switch it off, then press Enter:"]
    assert not person.shines


def test_a_laser_that_is_on_is_asked_off_when_it_is_closed(light, person):
    light.on()
    person.answers = [EOFError()]
    light.close()
    assert "switch it off" in person.questions[-1]


def test_a_laser_whose_switching_on_was_broken_off_may_shine(light, person):
    person.answers = [KeyboardInterrupt()]
    with pytest.raises(KeyboardInterrupt):
        light.on()
    assert light.is_on
    light.close()
    assert "switch it off" in person.questions[-1]


@pytest.mark.parametrize(
    ("open_device", "settings"), [(open_turntable, table_settings()), (open_laser, LaserSettings(driver="manual"))]
)
def test_without_a_terminal_it_says_that_it_needs_one(open_device, settings, clock):
    with pytest.raises(DeviceStateError, match="Work in a terminal"):
        open_device(settings, clock, Connections())


def test_limits_the_wrong_way_round_are_refused():
    with pytest.raises(ValueError, match="smaller"):
        table_settings(limits_deg=[10.0, -10.0])


@pytest.mark.parametrize("kind", ["turntable", "laser"])
def test_a_person_is_not_found_by_looking(kind):
    assert find_devices(kind, "manual") == ()
