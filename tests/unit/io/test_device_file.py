"""rig.toml of a live rig: every mistake with file, line, field, what was found and what is expected."""

from dataclasses import FrozenInstanceError
from pathlib import Path

import pytest
from pydantic import ValidationError

from rotaline.errors import RigError
from rotaline.io.device_file import SIMULATED_RIG, parse_device_file, read_device_file
from rotaline.io.plan_file import plan_text

REPLAY = 'version = 1\n[replay]\nsession = "s"\n[camera]\ndriver = "replay"\n'


def parsed(text):
    return parse_device_file(text, "rig.toml", Path("here"))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("version = 1", "version = 3", "rig.toml, line 2, version: found 3, expected version = 1."),
        ("version = 1", "", "rig.toml, version: found nothing, expected version = 1."),
        ("[turntable]", "[table]", "rig.toml, line 10, table: there is no such key; expected one of version, camera, turntable, laser, simulated, replay."),
        ('[camera]\ndriver = "simulated"', "", "rig.toml, camera: it is missing; expected a table [camera] with a driver."),
        ('[camera]\ndriver = "simulated"', "[camera]", "rig.toml, line 7, camera.driver: found nothing, expected one of genicam, gentl"),
        ('[camera]\ndriver = "simulated"', '[camera]\ndriver = "basler"', "rig.toml, line 8, camera.driver: found 'basler', expected one of genicam"),
        ('[camera]\ndriver = "simulated"', '[camera]\ndriver = "simulated"\nreadout = 3', "rig.toml, line 9, camera.readout: there is no such key; expected one of driver, readout_ms, queue_frames."),
        ('[camera]\ndriver = "simulated"', '[camera]\ndriver = "simulated"\nreadout_ms = -3', "rig.toml, line 9, camera.readout_ms: found -3, expected 0 or more."),
        ('[camera]\ndriver = "simulated"', '[camera]\ndriver = "simulated"\nreadout_ms = "3"', "rig.toml, line 9, camera.readout_ms: found '3', expected a number without quotes."),
        ('[camera]\ndriver = "simulated"', '[camera]\ndriver = "replay"', "rig.toml, replay: it is missing; expected a table [replay] with session"),
        ('rig = "article"', "rig = 3", "rig.toml, line 5, simulated.rig: found 3, expected text in quotes."),
        ('rig = "article"', "seed = -1", "rig.toml, line 5, simulated.seed: found -1"),
        ('rig = "article"', "real = true", "rig.toml, line 5, simulated.real: there is no such key; expected one of rig, seed, real_time."),
        ("[laser]", "[laser", "rig.toml, line 13: this is not valid TOML: found [laser; a table begins with [laser]"),
        ('rig = "article"', "rig = article", 'rig.toml, line 5: this is not valid TOML: found rig = article; text stands in quotes: rig = "article".'),
    ],
)  # fmt: skip
def test_a_mistake_is_named_with_its_place(old, new, said):
    assert old in SIMULATED_RIG
    with pytest.raises(RigError) as error:
        parsed(SIMULATED_RIG.replace(old, new))
    assert said in str(error.value)


@pytest.mark.parametrize("value", ["3", '"simulated"', "[1, 2]"])
def test_a_device_that_is_no_table(value):
    with pytest.raises(
        RigError, match=r"rig\.toml, line 2, camera: found .*, expected a table \[camera\] with a driver"
    ):
        parsed(f"version = 1\ncamera = {value}\n")


def test_all_mistakes_are_named_at_once():
    text = SIMULATED_RIG.replace("version = 1", "version = 2").replace("[turntable]", "[turntable]\nspeed = 3")
    with pytest.raises(RigError) as error:
        parsed(text.replace("[laser]", "[laser]\npower = 3"))
    assert len(str(error.value).splitlines()) == 3


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ("[10, 0]", "line 4, turntable: limits_deg are [10.0, 0.0]; the first has to be the smaller one."),
        ("[10]", "line 8, turntable.limits_deg: the list is too short, a value is missing."),
        ("5", "line 8, turntable.limits_deg: found 5, expected a list in brackets: [..., ...]."),
    ],
)
def test_mistakes_in_a_list(limits, said):
    text = 'version = 1\n[camera]\ndriver = "uvc"\n[turntable]\ndriver = "manual"\nresolution_deg = 0.1\nu_angle_deg = 0.1\n'
    with pytest.raises(RigError) as error:
        parsed(f"{text}limits_deg = {limits}\n")
    assert str(error.value) == f"rig.toml, {said}"


def test_keys_of_inner_tables_are_listed():
    text = 'version = 1\n[replay]\nsession = "s"\nfolder = "x"\n[camera]\ndriver = "replay"\n'
    with pytest.raises(RigError, match=r"line 4, replay\.folder: there is no such key; expected one of session"):
        parsed(text)


@pytest.mark.parametrize(
    "text", ['preset = "article"\n', "[camera]\nposition_mm = [1, 2, 3]\n", '[[captures]]\nfolder = "a"\n']
)
def test_the_file_of_a_rig_to_be_simulated_is_recognised(text):
    with pytest.raises(RigError, match="this describes a rig to be simulated, not devices") as error:
        parsed(text)
    parsed(str(error.value).split(":\n", 1)[1])  # what it shows can be used


def test_a_plan_in_its_place_is_recognised():
    with pytest.raises(RigError, match="this is a plan: what is taken, not with which devices"):
        parsed(plan_text("article"))


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(RigError, match=r"the rig file cannot be read .*`rotaline devices`"):
        read_device_file(tmp_path / "none.toml")
    (tmp_path / "rig.toml").write_bytes(b"# \xff\n")
    with pytest.raises(RigError, match="not UTF-8"):
        read_device_file(tmp_path / "rig.toml")


def test_what_a_file_says(tmp_path):
    (tmp_path / "rig.toml").write_bytes(b"\xef\xbb\xbf" + SIMULATED_RIG.encode())
    file = read_device_file(tmp_path / "rig.toml")
    assert file.drivers == {"simulated"}
    assert file.folder == tmp_path
    assert file.devices.laser.driver == "simulated"
    alone = parsed(REPLAY)
    assert alone.devices.turntable is None
    assert alone.replay.session == "s"


def test_it_is_frozen():
    file = parsed(SIMULATED_RIG)
    with pytest.raises(ValidationError):
        file.devices.camera.readout_ms = 3.0
    with pytest.raises(ValidationError):
        file.simulated.seed = 2
    with pytest.raises(FrozenInstanceError):
        file.devices.laser = None
