"""Plans of acquisitions: every mistake with file, line, field, what was found and what is expected."""

import tomllib

import pytest
from pydantic import ValidationError

from rotaline.errors import RigError
from rotaline.io.plan_file import PLANS, angles_of, parse_plan, plan_text, poses_of, read_plan, session_toml
from rotaline.io.plan_tables import PlanCapture
from rotaline.io.session_file import parse_session_file

ARTICLE = plan_text("article")
SCAN = 'version = 1\n[[captures]]\nfolder = "a"\nrole = "scan"\n'


def refused(text, source="plan.toml"):
    with pytest.raises(RigError) as error:
        parse_plan(text, source)
    return str(error.value)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("version = 1", "version = 2", "line 3, version: found 2, expected 1."),
        ("wavelength_nm = 650.0", "wave_nm = 650.0", "line 5, optics.wavelength_nm: it is missing; expected a value."),
        (
            "wavelength_nm = 650.0",
            "wavelength_nm = 650.0\nf = 1",
            "line 9, optics.f: there is no such key; expected one of f_number, pixel_pitch_um, wavelength_nm, speckle_contrast.",
        ),
        ("f_number = 5.6", "f_number = -5.6", "line 6, optics.f_number: found -5.6, expected more than 0."),
        ("poses = 20", "pose = 20", "line 30, captures[1].pose: there is no such key; expected one of folder, role, from_deg"),
        ("poses = 20", "poses = 0", "line 30, captures[1].poses: found 0, expected 1 or more."),
        ("poses = 20", "poses = 2.5", "line 30, captures[1].poses: found 2.5, expected a whole number."),
        ('role = "axis"', 'role = "axes"', "line 40, captures[3].role: found 'axes', expected camera, laser-plane, axis, artifact or scan."),
        ("step_deg = 2.0", 'step_deg = "2"', "line 44, captures[3].step_deg: found '2', expected a number without quotes."),
        ("step_deg = 2.0", "step_deg = 0.0001", "captures[3].step_deg: found 0.0001, expected at least 0.0004"),
        ("step_deg = 2.0", "step_deg = nan", "line 44, captures[3].step_deg: found nan"),
        ("step_deg = 2.0", "step_deg =", "line 44: this is not valid TOML: found step_deg =; the value is missing: expected step_deg = ..., or leave the line out."),
        ('folder = "ball"', "folder = ball", 'line 59: this is not valid TOML: found folder = ball; text stands in quotes: folder = "ball".'),
        ('folder = "ball"', 'folder = "the ball"', "line 59, captures[6].folder: found 'the ball', expected a name without blanks and slashes"),
        ('folder = "ball"', 'folder = "a/b"', "line 59, captures[6].folder: found 'a/b', expected a name without blanks and slashes"),
        ('folder = "rod"', 'folder = "ball"', "line 65, captures[7].folder: 'ball' is the folder of an earlier capture; rename it."),
        ('folder = "camera"', 'folder = "reference"', "line 27, captures[1].folder: 'reference' is taken by the program; rename it."),
        ('target = "dots"', 'target = "dotz"', "line 35, captures[2].target: found 'dotz', expected the name of a table under [targets]"),
        ("pitch = 4.0", "pitch = -4", "line 13, targets.checkerboard.pitch: found -4, expected more than 0."),
        ("pitch = 4.0", "pitch = 4.0\nnote = 1", "line 14, targets.checkerboard.note: there is no such key"),
        ("pitch = 4.0", "", "targets.checkerboard.pitch: it is missing"),
        ('kind = "dots"', 'kind = "dot"', "line 16, targets.dots.kind: found 'dot', expected one of checkerboard, dots"),
        ("diameter = 3.0", "diameter = 9.0", "line 19, targets.dots.diameter: the dots (9.0 mm) must be smaller than their pitch (6.0 mm)."),
        ('capture = "rod"', 'capture = "rods"', "line 83, measurements[2].capture: found 'rods', expected the folder of a capture with role scan or artifact: ball"),
        ('feature = "sphere"', 'feature = "spher"', "line 78, measurements[1].feature: found 'spher', expected sphere"),
    ],
)  # fmt: skip
def test_a_mistake_is_named_with_its_place(old, new, said):
    assert old in ARTICLE
    message = refused(ARTICLE.replace(old, new, 1))
    assert said in message
    assert all(line.startswith("plan.toml, ") for line in message.splitlines())


def test_a_single_table_in_place_of_several_is_recognised():
    message = refused(SCAN.replace("[[captures]]", "[captures]"))
    assert (
        message
        == "plan.toml, line 2, captures: found a table, expected tables, each opened by [[captures]] in double brackets."
    )


@pytest.mark.parametrize(
    "text", ['version = 1\n[camera]\ndriver = "uvc"\n', 'preset = "demo"\n', SCAN + "[turntable]\nradius_mm = 80.0\n"]
)
def test_a_rig_file_in_its_place_is_recognised(text):
    message = refused(text, "rig.toml")
    assert message.startswith("rig.toml: this names devices, or a rig to be simulated; expected a plan")
    assert len(message.splitlines()) == 1


def test_all_mistakes_are_named_at_once():
    message = refused(ARTICLE.replace("poses = 20", "pose = 20").replace("step_deg = 4.0", "step_deg = -4.0"))
    assert len(message.splitlines()) == 6, message


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ("poses = 3", "line 5, captures[1].poses: this key says nothing for role 'scan'; remove it."),
        ("frames = 4\nstep_deg = 2.0", "line 5, captures[1].frames: both frames and step_deg are given; keep one of them."),
        ("to_deg = 500.0", "to_deg: found 500, expected another angle than from_deg = 0, up to 360 deg from it."),
        ("to_deg = 0.0", "to_deg: found 0, expected another angle than from_deg = 0"),
        ("bracket = [1.0, 1.0]", "bracket: found [1.0, 1.0], expected different factors."),
        ("bracket = []", "bracket: found []"),
        ("bracket = [0.0]", "bracket[1]: found 0.0, expected more than 0."),
        ("speed_deg_s = 3.0", "speed_deg_s: this key says nothing for mode \"step\"; remove it."),
        ('mode = "continuous"\nlaser_off_frames = true', 'laser_off_frames: this needs a table that stands for each frame; expected mode = "step".'),
        ('mode = "continuous"\nreference_every = 3', "reference_every: this needs a table that stands"),
        ('mode = "continuous"\nshuffle = true', "shuffle: this needs a table that stands"),
        ('mode = "continuous"\nbracket = [1.0, 2.0]', "bracket: several exposures need a table that stands"),
        ('exposure_on_us = "automatic"', "exposure_on_us: found 'automatic', expected a number without quotes, or \"auto\"."),
        ("exposure_on_us = 0.0", "exposure_on_us: found 0.0, expected more than 0, or \"auto\"."),
        ("laser_power = 1.5", "laser_power: found 1.5"),
        ("reference_every = -1", "reference_every: found -1"),
        ('laser_off_frames = "yes"', "laser_off_frames: found 'yes', expected true or false without quotes."),
        ("bracket = []", "bracket: found [], expected at least 1 of them."),
    ],
)  # fmt: skip
def test_contradictions_are_named(fields, said):
    assert said in refused(SCAN + fields)


@pytest.mark.parametrize("name", ["gain", "laser_power"])
def test_what_stays_as_it_is_stays_so_in_all_captures(name):
    """Else a session that was interrupted would go on with another value."""
    other = '[[captures]]\nfolder = "b"\nrole = "scan"\n'
    message = refused(f"{SCAN}{name} = 0.5\n{other}")
    assert (
        f"captures[2].{name}: this capture does not state it, but others do; state it in all of them, or in none."
        in message
    )
    parse_plan(f"{SCAN}{name} = 0.5\n{other}{name} = 0.7", "p")
    parse_plan(f"{SCAN}{other}", "p")


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(
        RigError, match=r"none\.toml: the plan cannot be read .*`rotaline acquire --plan article --toml`"
    ):
        read_plan(str(tmp_path / "none.toml"))
    (tmp_path / "latin.toml").write_bytes(b"# Z\xfcrich\n")
    with pytest.raises(RigError, match="the file is not UTF-8 text"):
        read_plan(str(tmp_path / "latin.toml"))
    with pytest.raises(RigError, match="there is no such plan; expected one of article, or a file"):
        plan_text("other")


def test_a_byte_order_mark_does_no_harm(tmp_path):
    (tmp_path / "plan.toml").write_bytes(b"\xef\xbb\xbf" + SCAN.encode())
    assert read_plan(str(tmp_path / "plan.toml")).tables.captures[0].folder == "a"


@pytest.mark.parametrize("name", PLANS)
def test_the_plans_that_come_along_give_sessions_without_mistakes(name):
    plan = read_plan(name)
    assert plan.source == f"plan {name}"
    content, problems = parse_session_file(
        session_toml(plan.tables, list(plan.tables.captures)).encode(), "session.toml"
    )
    assert problems == []
    assert [c.folder for c in content.captures] == [c.folder for c in plan.tables.captures]


def test_the_session_file_names_the_captures_that_there_are():
    plan = read_plan("article").tables
    data = tomllib.loads(session_toml(plan, [c for c in plan.captures if c.folder in ("axis", "ball")]))
    assert [c["folder"] for c in data["captures"]] == ["axis", "ball"]
    assert list(data["targets"]) == ["checkerboard"]
    assert [m["capture"] for m in data["measurements"]] == ["ball"]
    assert data["optics"]["f_number"] == 5.6


def test_a_plan_is_frozen():
    plan = read_plan("article")
    with pytest.raises(ValidationError):
        plan.tables.version = 1
    with pytest.raises(ValidationError):
        plan.tables.captures[0].poses = 3
    assert isinstance(plan.tables.captures, tuple)
    assert isinstance(plan.tables.measurements, tuple)
    with pytest.raises(AttributeError):
        plan.text = ""


def test_poses_and_angles_have_defaults():
    assert poses_of(PlanCapture(folder="a", role="camera")) == 20
    assert poses_of(PlanCapture(folder="a", role="laser-plane")) == 10
    assert poses_of(PlanCapture(folder="a", role="scan")) == 0
    assert angles_of(PlanCapture(folder="a", role="camera")) == ()
    assert len(angles_of(PlanCapture(folder="a", role="scan"))) == 90
    assert angles_of(PlanCapture(folder="a", role="axis"))[-1] == 40.0
    shuffled = PlanCapture(folder="a", role="scan", frames=9, shuffle=True)
    assert angles_of(shuffled) == angles_of(shuffled)  # the next start has to find the same
