"""Scenes of which nothing can be measured, and poor ones; each message names the capture, the numbers and the way out."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.errors import RigError
from rotaline.geometry.primitives import Plane, unit
from rotaline.simulation.checks import check_scene, require_scene
from rotaline.simulation.parts.shapes import Rod
from rotaline.simulation.plan import SessionPlan, camera_capture, full_turn, laser_capture, mount, scan_capture
from rotaline.simulation.rig import Laser, Optics, build_rig
from rotaline.simulation.small_session import BALL, ROD, small_plan
from rotaline.vision.targets.model import Checkerboard

RIG = build_rig((320, 240))
CAMERA_BASE = RIG.camera_from_base.inv().translation
BOARD = Checkerboard((9, 7), 4.5)


def _laser(position, aim, **options):
    """A laser whose sheet holds the direction of the rotation axis."""
    position = np.array(position, dtype=float)
    beam = unit(np.array(aim) - position)
    normal = unit(np.cross(beam, [0.0, 0.0, 1.0]))
    return Laser(Plane(normal, -float(normal @ position)), position, beam, **({"sigma_mm": 0.5} | options))


def _camera_turned(rig, angle_deg, axis=(0.0, 1.0, 0.0)):
    turn = RigidTransform.from_rotation(Rotation.from_rotvec(np.radians(angle_deg) * np.array(axis)))
    return replace(rig, camera_from_base=turn * rig.camera_from_base)


def _zoomed(rig, factor):
    return replace(rig, camera=replace(rig.camera, fx=rig.camera.fx * factor, fy=rig.camera.fy * factor))


def _with_laser(rig, **options):
    return replace(rig, laser=replace(rig.laser, **options))


def _with_light(rig, **options):
    return replace(rig, light=replace(rig.light, **options))


def _scan(rig, shape=BALL, pose=None, angles=None):
    pose = mount(2.0, 1.0) if pose is None else pose
    capture = scan_capture(rig, shape, pose, full_turn(12) if angles is None else angles, folder="part")
    return SessionPlan({}, (capture,))


@pytest.mark.parametrize(("camera_side", "roll_deg", "turn_sense"), [(-1, 0.0, 1), (1, 90.0, -1)])
def test_a_good_scene_has_no_problems(camera_side, roll_deg, turn_sense):
    rig = build_rig((320, 240), camera_side=camera_side, roll_deg=roll_deg, turn_sense=turn_sense)
    plan = small_plan(rig, captures=("camera", "laser", "axis", "stepped", "groove"))
    assert check_scene(rig, plan) == ()
    assert require_scene(rig, plan) == ()


@pytest.mark.parametrize(
    ("rig", "where", "text"),
    [
        (_with_laser(RIG, position_base=np.array([100.0, 0.0, -30.0])), "Laser", "stands 30 mm below the table top"),
        (
            replace(RIG, camera_from_base=RIG.camera_from_base * RigidTransform.from_translation([0.0, 0.0, 250.0])),
            "Camera",
            r"stands \d+ mm below the table top",
        ),
        (_camera_turned(RIG, 180.0), "Camera", "looks away .* lies 302 mm behind the camera"),
        (
            _camera_turned(RIG, 30.0),
            "Camera",
            r"looks away .* lies \d+ deg from the optical axis",
        ),
        (
            replace(RIG, laser=_laser(CAMERA_BASE + np.array([2.0, 6.0, 20.0]), [0.0, 0.0, 20.0])),
            "Camera",
            r"sees the laser sheet at \d\.\d deg, almost edge on",
        ),
    ],
)
def test_camera_and_laser_that_stand_wrong_are_errors(rig, where, text):
    problems = check_scene(rig, _scan(rig))
    assert {(p.severity, p.where) for p in problems} == {("error", where)}
    assert re.search(text, problems[0].text)


def _far_side_laser():
    """Lower than the top of the rod, and behind it as the camera sees it."""
    away = -unit(np.array([CAMERA_BASE[0], CAMERA_BASE[1] - 60.0, 0.0]))
    return _laser(200.0 * away + np.array([0.0, 0.0, 20.0]), [0.0, 0.0, 20.0])


@pytest.mark.parametrize(
    ("rig", "plan_options", "text"),
    [
        (
            RIG,
            {"shape": Rod(200.0, 10.0)},
            r"the part \(200 x 200 x 10 mm\) is larger than the table.*the table ends at 80 mm",
        ),
        (RIG, {"shape": ROD, "pose": mount(70.0, 0.0)}, "hangs over the edge of the table: it reaches 89 mm"),
        (replace(RIG, table_radius_mm=600.0), {"shape": Rod(800.0, 400.0)}, "the camera stands inside the part"),
        (replace(RIG, table_radius_mm=600.0), {"shape": Rod(800.0, 400.0)}, "the laser stands inside the part"),
        (
            replace(RIG, laser=_laser([200.0, 60.0, 200.0], [0.0, 60.0, 20.0])),
            {},
            r"the laser sheet misses the part at all angles: it passes at a distance of 4\d\.\d mm",
        ),
        (
            _with_laser(RIG, beam_base=unit(RIG.laser.beam_base + np.array([0.0, 0.0, 1.0])), fan_deg=20.0),
            {},
            r"fan does not reach the part: it is \d+ deg or more .* the fan ends at 10 deg",
        ),
        (_with_laser(RIG, beam_base=-RIG.laser.beam_base), {}, "the laser points away from the part"),
        (
            replace(RIG, laser=_far_side_laser()),
            {"shape": ROD, "pose": mount(0.0, 0.0)},
            "does not see the stripe on the part: 0 % of it is outside the image, and the part hides 100 %",
        ),
        (
            _zoomed(RIG, 2.0),
            {"shape": Rod(4.0, 2.0), "pose": mount(0.0, 60.0), "angles": (0.0, 5.0)},
            "no point of the part is in the image",
        ),
    ],
)
def test_a_part_that_cannot_be_measured_is_an_error(rig, plan_options, text):
    plan = _scan(rig, **plan_options)
    with pytest.raises(RigError, match=r"(?s)Capture part: .*" + text):
        require_scene(rig, plan)


@pytest.mark.parametrize(
    ("rig", "plan_options", "text"),
    [
        (_zoomed(RIG, 3.0), {"shape": ROD}, r"up to \d\d % of the part's surface is outside the image"),
        (RIG, {"pose": mount(0.0, 0.0) * RigidTransform.from_translation([0.0, 0.0, 5.0])}, "floats 5.0 mm above"),
        (RIG, {"pose": mount(0.0, 0.0) * RigidTransform.from_translation([0.0, 0.0, -2.0])}, "sinks 2.0 mm into"),
        (RIG, {"shape": Rod(10.0, 20.0), "pose": mount(20.0, 0.0)}, r"the laser meets the part in \d of 12 frames"),
        (
            replace(_with_laser(RIG, sigma_mm=0.05), optics=Optics(blur_px=0.0)),
            {},
            r"the stripe is 1\.\d px wide .* too narrow",
        ),
        (_with_laser(RIG, sigma_mm=6.0), {}, r"the stripe is \d\d\.\d px wide .* too wide"),
        (_with_light(RIG, exposure_on_ms=80.0), {}, r"\d+ % of the stripe is saturated"),
        (_with_light(RIG, exposure_on_ms=0.1), {}, r"faint: half of it has less than \d\.\d of 255"),
        (
            replace(RIG, laser=replace(_laser([185.0, -20.0, 200.0], [0.0, 0.0, 20.0]), sigma_mm=0.5)),
            {},
            r"sees the laser sheet at \d+\.\d deg: depth is measured badly",
        ),
    ],
)
def test_a_poor_scene_is_a_warning(rig, plan_options, text):
    plan = _scan(rig, **plan_options)
    warnings = require_scene(rig, plan)
    assert {p.severity for p in warnings} == {"warning"}
    assert any(re.search(text, p.text) for p in warnings)


@pytest.mark.parametrize(
    ("light", "text"),
    [
        ({"exposure_off_ms": 20.0}, r"saturated: white paper that faces the camera gets \d+ of 255"),
        ({"ambient_e_per_ms": 20.0}, r"dark: white paper that faces the camera gets \d+ of 255"),
    ],
)
def test_laser_off_frames_are_judged_by_white_paper(light, text):
    rig = _with_light(RIG, **light)
    plan = SessionPlan({}, (camera_capture(rig, BOARD, "board", 3, 1),))
    (problem,) = check_scene(rig, plan)
    assert (problem.severity, problem.where) == ("warning", "Capture camera")
    assert re.match(text, problem.text)


def test_a_plate_that_the_laser_misses_is_an_error():
    plan = SessionPlan({}, (laser_capture(RIG, BOARD, "board", 3, 1),))
    rig = replace(RIG, laser=_laser([200.0, 200.0, 200.0], [0.0, 200.0, 20.0]))
    (problem,) = check_scene(rig, plan)
    assert (problem.severity, problem.where) == ("error", "Capture laser")
    assert "misses the part" in problem.text


def test_all_errors_come_at_once_and_warnings_after_them():
    rig = _with_light(RIG, exposure_off_ms=20.0)
    captures = (
        camera_capture(rig, BOARD, "board", 3, 1),
        scan_capture(rig, ROD, mount(70.0, 0.0), full_turn(4), folder="one"),
        scan_capture(rig, ROD, mount(0.0, 75.0), full_turn(4), folder="two"),
    )
    problems = check_scene(rig, SessionPlan({}, captures))
    assert [p.severity for p in problems][:3] == ["error", "error", "warning"]
    with pytest.raises(RigError) as raised:
        require_scene(rig, SessionPlan({}, captures))
    assert [line.split(":")[0] for line in str(raised.value).splitlines()] == ["Capture one", "Capture two"]
