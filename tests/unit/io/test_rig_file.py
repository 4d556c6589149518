"""Rig files: what they mean, and what is said about a wrong one."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.errors import RigError
from rotaline.geometry.primitives import KnownCylinder, KnownSphere, SteppedCylinder
from rotaline.io.rig_file import PRESETS, parse_rig, preset_text, quick_look, read_preset, read_rig_file
from rotaline.io.rig_tables import CaptureTable
from rotaline.io.rig_values import angles_deg, rig_of, shape_of
from rotaline.io.session_file import parse_session_file
from rotaline.simulation.session import session_toml

SMALL = """version = 1
[camera]
position_mm = [200, -80, 180]
[laser]
position_mm = [150, 60, 210]
[parts.ball]
kind = "sphere"
diameter_mm = 28.475
[[captures]]
folder = "ball"
role = "scan"
part = "ball"
"""


def test_a_few_lines_are_enough():
    file = parse_rig(SMALL, "rig.toml")
    rig, plan = file.rig(), file.plan()
    assert rig.camera.image_size == (1280, 960)
    assert len(plan.captures[0].shots) == 90
    np.testing.assert_allclose(rig.camera.project(rig.camera_from_base.apply([[0.0, 0.0, 24.0]])), [[639.5, 479.5]])


def test_the_article_has_its_targets_parts_and_frames():
    file = read_preset("article")
    plan = file.plan()
    frames = {capture.folder: len(capture.shots) for capture in plan.captures}
    assert frames == {
        "camera": 20,
        "laser": 20,
        "axis": 21,
        "stepped-1": 90,
        "stepped-2": 90,
        "ball": 90,
        "rod": 90,
        "groove": 90,
    }
    assert plan.targets["checkerboard"].inner_corners == (18, 16)
    assert plan.targets["stepped-cylinder"].diameter_large == 36.006
    assert [m.reference for m in plan.measurements] == [{"diameter": 28.475}, {"diameter": 38.004}, {"depth": 12.003}]


def test_a_preset_can_be_changed_in_one_place():
    file = parse_rig('preset = "article"\n[turntable]\nangle_noise_deg = 0.02\n', "rig.toml")
    assert file.rig().mechanics.angle_noise_deg == 0.02
    assert file.rig().mechanics.run_out_um == 1.0
    assert file.rig().camera == read_preset("article").rig().camera


def _rig(**tables):
    """The small rig with other keys, by table."""
    text = SMALL
    for table, keys in tables.items():
        head = f"[{table}]\n"
        lines = "".join(f"{name} = {value}\n" for name, value in keys.items())
        text = (
            text.replace(head, head + lines)
            if head in text
            else text.replace("[parts.ball]", head + lines + "[parts.ball]")
        )
    return parse_rig(text, "rig.toml").rig()


def _pixel(rig, point_base):
    return rig.camera.project(rig.camera_from_base.apply(np.array([point_base], dtype=float)))[0]


def test_the_camera_is_where_the_file_says_and_stands_upright():
    rig = _rig()
    np.testing.assert_allclose(rig.camera_from_base.inv().translation, [200, -80, 180], atol=1e-9)
    assert rig.camera.fy == pytest.approx(9.0 / 3.75e-3)
    low, high = _pixel(rig, [0, 0, 14]), _pixel(rig, [0, 0, 34])
    assert low[0] == pytest.approx(high[0], abs=1e-6), "the axis is upright in the image"
    assert low[1] > high[1], "v points down"


@pytest.mark.parametrize(("roll_deg", "direction"), [(90.0, (1, 0)), (180.0, (0, 1)), (-90.0, (-1, 0))])
def test_roll_turns_the_camera_about_its_optical_axis(roll_deg, direction):
    rig = _rig(camera={"roll_deg": roll_deg})
    np.testing.assert_allclose(_pixel(rig, [0, 0, 24]), [639.5, 479.5], atol=1e-6)
    towards = _pixel(rig, [0, 0, 34]) - _pixel(rig, [0, 0, 14])
    np.testing.assert_allclose(towards / np.linalg.norm(towards), direction, atol=1e-6)


def test_a_camera_may_look_straight_down():
    rig = parse_rig(SMALL.replace("[200, -80, 180]", "[0, 0, 300]"), "rig.toml").rig()
    assert _pixel(rig, [0, 10, 24])[1] < _pixel(rig, [0, 0, 24])[1]


@given(
    position=st.tuples(*(st.floats(-300, 300),) * 2, st.floats(50, 400)),
    aim=st.tuples(*(st.floats(-20, 20),) * 3),
    roll_deg=st.floats(-90, 90),
)
@settings(deadline=None, max_examples=50)
def test_the_sheet_holds_the_laser_and_its_aim(position, aim, roll_deg):
    tables = parse_rig(SMALL, "rig.toml").tables
    laser_table = tables.laser.model_copy(
        update={"position_mm": position, "aim_at_mm": aim, "sheet_roll_deg": roll_deg}
    )
    laser = rig_of(tables.model_copy(update={"laser": laser_table})).laser
    points = np.array([position, aim])
    np.testing.assert_allclose(laser.plane_base.signed_distance_to(points), 0.0, atol=1e-9)
    beam = points[1] - points[0]
    np.testing.assert_allclose(laser.beam_base, beam / np.linalg.norm(beam), atol=1e-12)
    level = np.linalg.norm(np.cross(laser.beam_base, [0, 0, 1]))
    assert abs(laser.plane_base.normal[2]) == pytest.approx(level * abs(np.sin(np.radians(roll_deg))), abs=1e-9)


def test_the_base_frame_stands_on_the_axis():
    offset, tilt = [3.0, -2.0], [1.0, 0.5]
    straight, moved = _rig(), _rig(turntable={"axis_offset_mm": offset, "axis_tilt_deg": tilt})
    # the axis in the camera: through (3, -2, 0) of the nominal frame, leaning towards x and y
    axis = moved.rotation_axis_camera
    np.testing.assert_allclose(axis.point, straight.camera_from_base.apply([3.0, -2.0, 0.0]), atol=1e-9)
    lean = np.array([np.tan(np.radians(1.0)), np.tan(np.radians(0.5)), 1.0])
    expected = straight.camera_from_base.rotation.apply(lean / np.linalg.norm(lean))
    np.testing.assert_allclose(axis.direction, expected, atol=1e-12)
    # camera and laser have not moved
    np.testing.assert_allclose(moved.laser_plane_camera.normal @ axis.direction, 0.0, atol=1e-9)
    source = moved.camera_from_base.apply(moved.laser.position_base)
    np.testing.assert_allclose(source, straight.camera_from_base.apply(straight.laser.position_base), atol=1e-9)


def test_what_is_not_stated_follows_from_the_rest():
    rig = _rig(sensor={"gain": 2.0}, light={"exposure_on_ms": 5.0})
    assert rig.light.ambient_e_per_ms * rig.light.exposure_off_ms == pytest.approx(0.75 * 10200 / 2)
    sigma_px = 0.075 * rig.camera.fy / np.linalg.norm([200, -80, 156])
    in_image = rig.laser.peak_e_per_ms * 5.0 * sigma_px / np.hypot(sigma_px, 0.8)
    assert in_image == pytest.approx(0.6 * 10200 / 2)
    assert rig.optics.focus_mm == pytest.approx(np.linalg.norm([200, -80, 156]))
    assert rig.laser.sigma_mm == 0.075
    assert rig.laser.waist_mm == pytest.approx(np.linalg.norm([150, 60, 186]))
    assert 4 * rig.laser.divergence_mrad == pytest.approx(4 / np.pi * 0.65 / 0.3), "a Gaussian beam of 0.3 mm at 650 nm"
    assert rig.laser.rgb == (1.0, 0.12, 0.05)


def test_what_is_stated_holds():
    rig = _rig(
        camera={"focus_distance_mm": '"everywhere"', "principal_point_offset_px": [3.5, -1.0], "k3": 0.1},
        laser={"peak_e_per_ms": 77, "divergence_mrad": 4, "waist_distance_mm": 99, "rgb": [0.5, 0.4, 0.3]},
        light={"ambient_e_per_ms": 12},
    )
    assert rig.optics.focus_mm is None
    assert (rig.camera.cx, rig.camera.cy, rig.camera.k3) == (643.0, 478.5, 0.1)
    laser = rig.laser
    assert (laser.peak_e_per_ms, laser.divergence_mrad, laser.waist_mm, laser.rgb) == (77, 1.0, 99, (0.5, 0.4, 0.3))
    assert rig.light.ambient_e_per_ms == 12


def _shape(lines):
    tables = parse_rig(SMALL.replace('kind = "sphere"\ndiameter_mm = 28.475\n', lines), "rig.toml").tables
    return shape_of(tables.parts["ball"])


@pytest.mark.parametrize(
    ("lines", "kind", "sizes"),
    [
        ('kind = "cylinder"\ndiameter_mm = 8\nheight_mm = 9\n', "Rod", {"diameter": 8, "height": 9}),
        (
            'kind = "cone"\ndiameter_bottom_mm = 8\nheight_mm = 9\n',
            "Cone",
            {"diameter_bottom": 8, "diameter_top": 0, "height": 9},
        ),
        (
            'kind = "block"\nwidth_mm = 8\nlength_mm = 9\nheight_mm = 7\n',
            "Block",
            {"width": 8, "length": 9, "height": 7},
        ),
        ('kind = "groove"\ndepth_mm = 8\n', "GrooveBlock", {"depth": 8, "width_top": 22, "width_bottom": 12}),
    ],
)
def test_every_kind_of_part(lines, kind, sizes):
    shape = _shape(lines + "chamfer_mm = 0.2\nform_error_um = 3\nform_error_lobes = 5\nroughness_um = 2\ngloss = 0.3\n")
    assert type(shape).__name__ == kind
    assert shape.sizes() == sizes
    assert (shape.chamfer, shape.form_error.amplitude_um, shape.form_error.lobes) == (0.2, 3, 5)
    assert (shape.material.roughness_um, shape.material.gloss, shape.material.albedo) == (2, 0.3, 0.8)


def test_a_mesh_stands_beside_the_rig_file(tmp_path):
    trimesh.creation.box((0.02, 0.03, 0.04)).export(tmp_path / "box.stl")
    text = SMALL.replace(
        'kind = "sphere"\ndiameter_mm = 28.475\n', 'kind = "mesh"\nfile = "box.stl"\nmm_per_unit = 1000\n'
    )
    (tmp_path / "rig.toml").write_text(text)
    (capture,) = read_rig_file(tmp_path / "rig.toml").plan().captures
    np.testing.assert_allclose(capture.shots[0].on_table[0].shape.bounds(), [[-10, -15, 0], [10, 15, 40]], atol=1e-4)
    (tmp_path / "box.stl").unlink()
    with pytest.raises(RigError, match=r"rig.toml: parts.ball: .*box.stl: there is no such file"):
        read_rig_file(tmp_path / "rig.toml").plan()


def test_a_generated_part_can_have_another_surface():
    assert _shape('kind = "generated"\nname = "bust"\ngloss = 0.5\n').material.gloss == 0.5


@pytest.mark.parametrize(
    ("keys", "angles"),
    [
        ({"frames": 3}, [0, 120, 240]),
        ({"step_deg": 90.0}, [0, 90, 180, 270]),
        ({"step_deg": 100.0}, [0, 100, 200, 300]),
        ({"frames": 3, "to_deg": 10.0}, [0, 5, 10]),
        ({"from_deg": 10.0, "to_deg": 4.0, "step_deg": 3.0}, [10, 7, 4]),
        ({"from_deg": 5.0, "to_deg": -355.0, "frames": 2}, [5, -175]),
        ({"role": "axis", "target": "board", "part": None, "step_deg": 20.0}, [0, 20, 40]),
    ],
)
def test_angles(keys, angles):
    table = CaptureTable(**{"folder": "a", "role": "scan", "part": "ball"} | keys)
    assert angles_deg(table, 1) == pytest.approx(angles)


def test_shuffled_angles_are_uneven_and_in_mixed_order():
    angles = np.array(angles_deg(CaptureTable(folder="a", role="scan", part="ball", frames=20, shuffle=True), 1))
    assert np.any(np.diff(angles) < 0)
    steps = np.diff(np.sort(angles))
    assert steps.min() > 0
    assert steps.max() > 1.2 * steps.min()


def test_a_capture_can_have_its_own_light_and_background_frames():
    text = SMALL + "laser_off_frames = true\nframes = 2\nexposure_on_ms = 3.0\nambient_on_fraction = 0.5\n"
    (capture,) = parse_rig(text, "rig.toml").plan().captures
    assert [(s.laser, s.angle_deg, s.exposure_ms) for s in capture.shots] == [
        (False, 0.0, 10.0),
        (True, 0.0, 3.0),
        (False, 180.0, 10.0),
        (True, 180.0, 3.0),
    ]
    assert capture.shots[1].ambient_e_per_ms == pytest.approx(0.5 * capture.shots[0].ambient_e_per_ms)


def test_a_measurement_without_reference_is_held_against_the_true_sizes():
    (measurement,) = (
        parse_rig(SMALL + '[[measurements]]\ncapture = "ball"\nfeature = "sphere"\n', "rig.toml").plan().measurements
    )
    assert measurement.reference == {"diameter": 28.475}


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_complete_and_can_be_planned(name):
    """Every role, two mounts of the stepped cylinder, focused where the camera looks."""
    file = read_preset(name)
    plan = file.plan()
    assert {c.role for c in plan.captures} == {"camera", "laser-plane", "axis", "artifact", "scan"}
    assert file.rig().optics.focus_mm == pytest.approx(
        np.linalg.norm(np.subtract(file.tables.camera.look_at_mm, file.tables.camera.position_mm)), rel=0.05
    )
    mounts = [np.hypot(*c.mount.position_mm) for c in file.tables.captures if c.role == "artifact"]
    assert mounts == pytest.approx([0.4, 5.0], abs=0.01)


def test_a_preset_may_be_based_on_another():
    demo, article = read_preset("demo"), read_preset("article")
    assert demo.tables.laser == article.tables.laser
    edited = parse_rig('preset = "demo"\n[camera]\nroll_deg = 3.0\n', "rig.toml")
    assert edited.tables.camera == demo.tables.camera.model_copy(update={"roll_deg": 3.0})
    points = np.array([[10.0, -5.0, 20.0], [-20.0, 15.0, 40.0]])
    seen = [r.camera.project(r.camera_from_base.apply(points)) for r in (article.rig(), demo.rig())]
    np.testing.assert_allclose(seen[1], (seen[0] + 0.5) * 0.625 - 0.5, atol=1e-6)


@pytest.mark.parametrize("name", [name for name in PRESETS if name != "demo"])
def test_every_line_with_a_key_of_a_rig_explains_it(name):
    """Keys of the rig itself have a comment; those of parts and captures that have none say it by their names."""
    rig_part = preset_text(name).split("[targets.")[0]
    bare = [line for line in rig_part.splitlines() if "=" in line and "#" not in line]
    assert bare == ["version = 1"]


def test_a_quick_look_sees_the_same_with_half_the_pixels():
    file = read_preset("article")
    whole, half = file.rig(), quick_look(file).rig()
    points = np.array([[10.0, -5.0, 20.0], [-20.0, 15.0, 40.0]])
    seen = [r.camera.project(r.camera_from_base.apply(points)) for r in (whole, half)]
    np.testing.assert_allclose(seen[1], (seen[0] + 0.5) / 2 - 0.5, atol=1e-9)
    assert quick_look(file).plan().n_frames < 0.52 * file.plan().n_frames


@pytest.mark.parametrize(
    ("part", "artifact"),
    [
        ('kind = "sphere"\ndiameter_mm = 28.475', KnownSphere(28.475)),
        (
            'kind = "cylinder"\ndiameter_mm = 38.0\nheight_mm = 40.0\ntolerance_mm = 0.01',
            KnownCylinder(38.0, 40.0, 0.01),
        ),
        (
            'kind = "stepped-cylinder"\ndiameters_mm = [20.0, 30.0]\nheights_mm = [15.0, 16.0]\ntolerance_mm = 0.002',
            SteppedCylinder(20.0, 30.0, 15.0, 16.0, 0.002),
        ),
    ],
)
def test_a_session_states_its_artefacts_and_checks(tmp_path, part, artifact):
    text = f"""{SMALL}[parts.a]
{part}
[[captures]]
folder = "a"
role = "artifact"
part = "a"
[[measurements]]
capture = "ball"
feature = "sphere"
check = true
"""
    file = parse_rig(text, "rig.toml")
    content, problems = parse_session_file(session_toml(file.plan(), file.rig()).encode(), "session.toml")
    assert problems == []
    assert content.targets == {"a": artifact}  # the ball is scanned only
    assert [(c.role, c.target) for c in content.captures] == [("scan", "ball"), ("artifact", "a")]
    assert [(m.check, m.reference) for m in content.measurements] == [(True, {"diameter": 28.475})]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "position_mm = [200",
            "position = [200",
            r"rig.toml, line 3, camera.position: there is no such key; expected one of position_mm",
        ),
        ("position_mm = [200", "[sensor]\nposition_mm = [200", r"rig.toml, line 2, camera.position_mm: it is missing"),
        ("diameter_mm = 28.475", "diameter = 28.475", r"rig.toml, line 8, parts.ball.diameter: .*one of .*diameter_mm"),
        ("diameter_mm = 28.475", 'diameter_mm = "28.475"', r"line 8, parts.ball.diameter_mm: found '28.475'"),
        ("diameter_mm = 28.475", "diameter_mm = inf", r"line 8, parts.ball.diameter_mm: found inf"),
        ("[150, 60, 210]", "[150, 60]", r"line 5, laser.position_mm: the list is too short"),
        (
            'kind = "sphere"',
            'kind = "ball"',
            r"line 7, parts.ball.kind: found 'ball', expected one of sphere, cylinder",
        ),
        ('role = "scan"', 'role = "look"', r"line 11, captures\[1\].role: found 'look', expected camera"),
        ('role = "scan"', 'role = "camera"', r"captures\[1\].target: found nothing; role 'camera' needs a name under"),
        ('part = "ball"', 'part = "rod"', r"line 12, captures\[1\].part: found 'rod'; .*: ball"),
        ('part = "ball"', 'part = "ball"\nviews = 3', r"line 13, captures\[1\].views: this key says nothing"),
        ('part = "ball"', 'part = "ball"\nframes = 3\nstep_deg = 2', r"both frames and step_deg"),
        ('part = "ball"', 'part = "ball"\nto_deg = 0', r"captures\[1\].to_deg: found 0"),
        ('part = "ball"', 'part = "ball"\nmount = { tilt = 3 }', r"mount.tilt: there is no such key; .*tilt_deg"),
        (
            'role = "scan"\npart = "ball"\n',
            'role = "artifact"\npart = "a"\n[parts.a]\nkind = "block"\nwidth_mm = 9\nlength_mm = 9\nheight_mm = 9\n',
            r"'a' is a block; role 'artifact' needs a stepped-cylinder, cylinder or sphere",
        ),
        (
            'role = "scan"\npart = "ball"\n',
            'role = "artifact"\npart = "ball"\n[[measurements]]\ncapture = "ball"\nfeature = "sphere"\ncheck = true\n',
            r"measurements\[1\].check: 'ball' takes part in the calibration",
        ),
        (
            'part = "ball"\n',
            'part = "ball"\n[[measurements]]\ncapture = "ball"\nfeature = "plane"\ncheck = true\n',
            r"measurements\[1\].check: a check of a plane needs a reference",
        ),
        ("version = 1", "version = 2", r"line 1, version: found 2, expected 1"),
        ("version = 1", 'preset = "show"', r"line 1, preset: preset 'show': there is no such preset"),
        ("version = 1", "version = ", r"rig.toml, line 1: this is not valid TOML"),
        (
            "[[captures]]",
            '[session]\nimage_format = "jpg"\n[sensor]\nbit_depth = 12\n[[captures]]',
            r"'jpg' holds 8 bit only",
        ),
        ("[[captures]]", "[[shots]]", r"shots: there is no such key; expected one of version"),
        (
            "[[captures]]",
            '[[captures]]\nfolder = "ball"\nrole = "scan"\npart = "ball"\n[[captures]]',
            r"the folder of an earlier",
        ),
        (
            "[[captures]]",
            '[[measurements]]\ncapture = "rod"\nfeature = "sphere"\n[[captures]]',
            r"found 'rod', expected the folder",
        ),
        (
            "[[captures]]",
            '[targets.ball]\nkind = "dots"\ndots = [9, 9]\npitch_mm = 3\ndiameter_mm = 3\n[[captures]]',
            r"(?s)the name of a target.*less than pitch_mm",
        ),
    ],
)
def test_a_wrong_file_is_explained(old, new, message):
    assert old in SMALL
    with pytest.raises(RigError, match=message):
        parse_rig(SMALL.replace(old, new, 1), "rig.toml")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[200, -80, 180]", "[0, 0, 24]", "rig.toml: camera, position_mm and look_at_mm: both are"),
        ("[200, -80, 180]", "[0, 0, 30]", "rig.toml: camera, focus_distance_mm: .*beyond its focal length"),
        ("[150, 60, 210]", "[0, 0, 24]", "rig.toml: laser, position_mm and aim_at_mm: both are"),
        ('kind = "sphere"', 'kind = "cylinder"\nheight_mm = 3\nchamfer_mm = 9', "rig.toml: parts.ball: .*chamfer"),
    ],
)
def test_a_rig_that_cannot_be_is_explained(old, new, message):
    assert old in SMALL
    with pytest.raises(RigError, match=message):
        parse_rig(SMALL.replace(old, new, 1), "rig.toml").plan()


def test_a_file_that_is_missing_is_named(tmp_path):
    with pytest.raises(RigError, match=r"none\.toml: the rig file cannot be read"):
        read_rig_file(tmp_path / "none.toml")
    with pytest.raises(RigError, match="expected one of article"):
        preset_text("show")
