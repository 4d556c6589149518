"""Causes of bad calibrations are found and named where they were planted, gross or moderate, and nowhere else."""

import dataclasses

import numpy as np
import pytest
from tests.recovery.planted import (
    observed,
    rig_and_plan,
    traced,
    with_angles,
    with_artifact,
    with_camera_moved,
    with_pitch,
    with_plates_moved,
    with_poses_alike,
    with_saturation,
    without,
)

from rotaline.calibration.intrinsics import calibrate_camera
from rotaline.calibration.laser_plane import calibrate_laser_plane
from rotaline.calibration.rotation_axis import AxisOptions, calibrate_axis
from rotaline.calibration.verdict.evidence import Evidence
from rotaline.calibration.verdict.judge import judge_calibration
from rotaline.calibration.verdict.model import CAUSES, STEPS
from rotaline.errors import CalibrationError, DetectionError, GeometryError
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid

RIG, PLAN = rig_and_plan()
STRIPES = ("laser", "stepped-1", "stepped-2")
TURNING = ("axis", "stepped-1", "stepped-2")
_DONE = {}
"""Stages that other tests have done already, by what they were given."""


def _once(stage, views, compute, *more):
    key = (
        stage,
        *more,
        *((v.detection.target, getattr(v, "angle_rad", None), v.detection.uv.tobytes()) for v in views),
    )
    key += tuple(v.stripe.uv.tobytes() for v in views if hasattr(v, "stripe"))
    if key not in _DONE:
        _DONE[key] = compute()
    return _DONE[key]


def evidence_of(observations):
    """The stages before the joint estimate."""
    failures = {}

    def attempt(step, compute):
        try:
            return compute()
        except (CalibrationError, DetectionError, GeometryError) as error:
            failures[step] = str(error)
            return None

    size, preferred = observations.image_size, observations.preferred_folders
    seen = observations.camera_views
    camera = attempt("camera", lambda: _once("camera", seen, lambda: calibrate_camera(seen, size, preferred=preferred)))
    plane = axis = None
    if camera is not None:

        def found(views):
            return [dataclasses.replace(v, detection=camera.with_target_as_found(v.detection)) for v in views]

        if observations.plate_views:
            plates = found(observations.plate_views)
            plane = attempt(
                "laser-plane",
                lambda: _once("plane", plates, lambda: calibrate_laser_plane(camera.camera, plates), camera.camera),
            )
        if observations.table_views:
            views = found(observations.table_views)
            axis = attempt(
                "axis",
                lambda: _once(
                    "axis",
                    views,
                    lambda: calibrate_axis(camera.camera, views, AxisOptions(method="joint")),
                    camera.camera,
                ),
            )
    return Evidence(observations, camera, plane, axis, failures=failures)


def judged(observations):
    verdict = judge_calibration(evidence_of(observations))
    assert [s.step for s in verdict.steps] == list(STEPS)
    assert {f.cause for f in verdict.findings} <= set(CAUSES)
    for finding in verdict.findings:
        assert finding.step in STEPS
        assert finding.cause in ("sense assumed", "stage failed") or any(c.isdigit() for c in finding.text)
        assert finding.action.endswith(".")
        level = next(s.level for s in verdict.steps if s.step == finding.step)
        assert level in (("fail",) if finding.level == "fail" else ("fail", "doubtful"))
    return verdict


def the_only(verdict, cause, step):
    """The finding, after a check that it is the only cause named."""
    assert {(f.cause, f.step) for f in verdict.findings} == {(cause, step)}, verdict.findings
    assert verdict.level in ("doubtful", "fail")
    return verdict.findings[0]


@pytest.fixture(autouse=True)
def shapes(request):
    """Checked in clean sessions; those with planted errors go the same ways."""
    if not request.node.originalname.startswith("test_clean"):
        request.getfixturevalue("shapes_unchecked")


@pytest.fixture(scope="module")
def twin():
    return traced(RIG, PLAN)


@pytest.fixture(scope="module")
def clean(twin):
    return observed(twin)


@pytest.fixture(scope="module")
def webcam():
    return traced(*rig_and_plan("webcam", 4))


def rig_with(part, **values):
    return dataclasses.replace(RIG, **{part: dataclasses.replace(getattr(RIG, part), **values)})


def passes(verdict):
    assert verdict.findings == ()
    assert verdict.level == "pass"
    assert {s.level for s in verdict.steps if s.step != "measure"} == {"pass"}
    assert 0 < verdict.u_point_mm < 3 * verdict.u_noise_mm


@pytest.mark.parametrize("preset", ["article", "high-resolution"])
def test_clean_sessions_pass_without_a_finding(preset):
    passes(judged(observed(traced(*rig_and_plan(preset, 5)), 5)))


@pytest.mark.parametrize(("name", "noise"), [("twin", 1.0), ("twin", 3.0), ("webcam", 1.0)])
def test_clean_sessions_of_the_other_presets_pass(name, noise, request):
    passes(judged(observed(request.getfixturevalue(name), 5, noise)))


@pytest.mark.parametrize("factor", [1.01, 0.998])
@pytest.mark.parametrize(("target", "pitch", "step"), [(DotGrid, 6.0, "laser-plane"), (Checkerboard, 4.0, "axis")])
def test_wrong_pitch_of_one_of_two_targets(clean, target, pitch, step, factor):
    finding = the_only(judged(with_pitch(clean, target, factor)), "wrong pitch", step)
    assert float(finding.text.split(" points is ")[1].split(" mm")[0]) == pytest.approx(pitch, rel=3e-4)


@pytest.mark.parametrize("factor", [1.02, 0.997])
def test_wrong_pitch_of_the_only_target(webcam, factor):
    finding = the_only(judged(with_pitch(observed(webcam), CharucoBoard, factor)), "wrong pitch", "laser-plane")
    assert float(finding.text.split(" points is ")[1].split(" mm")[0]) == pytest.approx(8.0, rel=5e-4)


@pytest.mark.parametrize("folders", [("axis",), ("stepped-2",)])
def test_wrong_sense_of_the_table(clean, folders):
    finding = the_only(judged(with_angles(clean, lambda a: -a, folders)), "wrong sense", "table")
    assert "stepped-2" in finding.text


def test_a_session_whose_angles_all_run_the_other_way_is_no_error(clean):
    assert judged(with_angles(clean, lambda a: -a)).findings == ()


def test_without_a_target_on_the_table_the_sense_is_assumed(clean):
    the_only(judged(dataclasses.replace(clean, table_views=())), "sense assumed", "axis")


@pytest.mark.parametrize(("read", "true"), [(1 / 0.9, 0.9), (1.02, 1 / 1.02), (1.003, 1 / 1.003)])
def test_wrong_angle_scale(clean, read, true):
    finding = the_only(judged(with_angles(clean, lambda a: read * a)), "wrong angle scale", "axis")
    assert f"turned {true:.3f}" in finding.text
    assert ("gon" in finding.text) == (true == 0.9)


@pytest.mark.parametrize("slip_mm", [0.5, 0.1])
def test_one_plate_moved_between_off_and_on(twin, slip_mm):
    plan = with_plates_moved(PLAN, lambda i: slip_mm * (i == 3))
    finding = the_only(
        judged(observed(traced(RIG, plan, twin, ["laser"]))), "target moved between off and on", "laser-plane"
    )
    assert finding.text.startswith("The stripe of laser/0007.png (")


@pytest.mark.parametrize("slip_mm", [0.5, 0.1])
def test_plates_moved_between_off_and_on(twin, slip_mm):
    slips = slip_mm * np.random.default_rng(5).standard_normal(20)
    verdict = judged(observed(traced(RIG, with_plates_moved(PLAN, lambda i: slips[i]), twin, ["laser"])))
    the_only(verdict, "target moved between off and on", "laser-plane")


@pytest.mark.parametrize("slip_mm", [0.1, 0.03])
def test_drift_during_the_capture_of_the_plates(twin, slip_mm):
    verdict = judged(observed(traced(RIG, with_plates_moved(PLAN, lambda i: slip_mm * i), twin, ["laser"])))
    the_only(verdict, "drift", "laser-plane")


@pytest.mark.parametrize(
    ("first", "shift_mm", "turn_rad", "words"),
    [
        ("axis", (0.5, 0.1, 0.3), (1e-3, 0.0, 1e-3), "between the capture of the plates and"),
        ("stepped-1", (0.5, 0.1, 0.3), (1e-3, 0.0, 1e-3), "between the captures of the targets and the mounts"),
        ("stepped-1", (0.05, 0.02, 0.03), (3e-4, 3e-4, 3e-4), "between the captures of the targets and the mounts"),
        ("stepped-2", (0.5, 0.1, 0.3), (1e-3, 0.0, 1e-3), "between stepped-1 and stepped-2"),
        ("stepped-2", (0.05, 0.02, 0.03), (3e-4, 3e-4, 3e-4), "between stepped-1 and stepped-2"),
    ],
)
def test_camera_moved_between_captures(twin, first, shift_mm, turn_rad, words):
    observations = observed(with_camera_moved(twin, first, shift_mm, turn_rad))
    assert words in the_only(judged(observations), "camera moved", "artifact").text


@pytest.mark.parametrize(
    ("sizes", "words"),
    [
        ({"height_small": 25.005, "height_large": 22.003}, "the heights are swapped"),
        ({"diameter_small": 36.006, "diameter_large": 23.051}, "the diameters are swapped"),
        ({"diameter_small": 23.051 / 2, "diameter_large": 36.006 / 2}, "radii are stated for diameters"),
        ({"diameter_small": 26.051}, "these are other sizes than stated"),
        ({"diameter_large": 36.106}, "the large diameter is 36.0"),
        ({"diameter_small": 23.011}, "the small diameter is 23.05"),
        ({"height_small": 22.033}, "the small height is 22.00"),
        ({"height_large": 25.5}, "The step stands 25.0"),
    ],
)
def test_wrong_artefact_sizes(clean, sizes, words):
    assert words in the_only(judged(with_artifact(clean, **sizes)), "wrong artefact sizes", "artifact").text


def test_a_tolerance_of_the_artefact_covers_what_lies_in_it(clean):
    assert judged(with_artifact(clean, diameter_large=36.036, tolerance=0.03)).findings == ()


@pytest.mark.parametrize("shifts_mm", [2.0, 8.0])
def test_laser_plane_from_too_few_depths(twin, shifts_mm):
    observations = observed(traced(RIG, with_poses_alike(RIG, PLAN, "laser", shifts_mm, 4.0), twin, ["laser"]))
    the_only(judged(observations), "too few depths", "laser-plane")


@pytest.mark.parametrize("turns_deg", [1.0, 5.0])
def test_boards_nearly_parallel(twin, turns_deg):
    observations = observed(traced(RIG, with_poses_alike(RIG, PLAN, "camera", 12.0, turns_deg), twin, ["camera"]))
    the_only(judged(observations), "boards nearly parallel", "camera")


@pytest.mark.parametrize("name", ["twin", "webcam"])
def test_mount_too_well_centred(name, request):
    full = request.getfixturevalue(name)
    observations = observed(traced(full.rig, without(full.plan, "stepped-2"), full))
    finding = the_only(judged(observations), "mount too well centred", "artifact")
    assert "mm off centre" in finding.action


@pytest.mark.parametrize(
    "mechanics",
    [
        {"angle_eccentricity_deg": 0.2, "angle_eccentricity_phase_deg": 90.0},
        {"angle_eccentricity_deg": 0.1},
        {"run_out_um": 100.0},
        {"run_out_um": 40.0, "run_out_phase_deg": 60.0},
    ],
)
def test_turntable_eccentricity(twin, mechanics):
    finding = the_only(
        judged(observed(traced(rig_with("mechanics", **mechanics), PLAN, twin, TURNING))),
        "turntable eccentricity",
        "table",
    )
    assert ("run-out" in finding.text) == ("run_out_um" in mechanics)


@pytest.mark.parametrize(("f_number", "focus_mm"), [(1.4, 180.0), (2.0, 200.0)])
def test_defocus(twin, f_number, focus_mm):
    blurred = traced(rig_with("optics", f_number=f_number, focus_mm=focus_mm), PLAN, twin, STRIPES)
    sharp, wide = (
        np.median(np.concatenate([c.scan.width_px for c in t.ideal.captures if c.scan is not None]))
        for t in (twin, blurred)
    )
    the_only(judged(observed(blurred, noise=float(wide / sharp))), "defocus", "session")


@pytest.mark.parametrize(("fraction", "bias_px"), [(0.6, 0.3), (0.3, 0.15)])
def test_over_exposure(clean, fraction, bias_px):
    finding = the_only(judged(with_saturation(clean, fraction, bias_px)), "over-exposure", "session")
    assert f"{100 * fraction:.0f} % of the stripe on plates" in finding.text


def test_an_overexposed_laser_of_the_twin(twin):
    bright = rig_with("laser", peak_e_per_ms=8 * RIG.laser.peak_e_per_ms)
    the_only(judged(observed(traced(bright, PLAN, twin, STRIPES))), "over-exposure", "session")


def test_two_causes_at_once_are_both_named(clean):
    observations = with_artifact(with_pitch(clean, Checkerboard, 1.005), height_small=25.005, height_large=22.003)
    found = {(f.cause, f.step) for f in judged(observations).findings}
    assert found == {("wrong pitch", "axis"), ("wrong artefact sizes", "artifact")}


def test_sessions_that_lack_parts_are_judged_as_far_as_they_go(clean):
    no_mounts = judged(dataclasses.replace(clean, mounts=()))
    assert no_mounts.level == "pass"
    assert [s.level for s in no_mounts.steps if s.step in ("artifact", "table")] == ["none", "none"]
    assert no_mounts.u_point_mm > 0
    no_plates = judged(dataclasses.replace(clean, plate_views=(), preferred_folders=frozenset()))
    assert [s.level for s in no_plates.steps if s.step in ("laser-plane", "scan")] == ["none", "none"]
    assert no_plates.level == "pass"
    nothing = judged(dataclasses.replace(clean, camera_views=()))
    the_only(nothing, "stage failed", "camera")
    assert nothing.level == "fail"
