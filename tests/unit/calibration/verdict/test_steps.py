"""The staircase that is seen without its stated sizes, and the fit that frees everything."""

import dataclasses

import numpy as np
import pytest

from rotaline.calibration.observations import MountObservation
from rotaline.calibration.verdict.artifact_sizes import gross_sizes, wrong_large_height
from rotaline.calibration.verdict.evidence import Scale
from rotaline.calibration.verdict.steps_fit import AXIS, SIZES, fit_steps, roundness_mm
from rotaline.calibration.verdict.steps_seen import LARGE_SIDE, SMALL_SIDE, STEP, TOP, see_steps
from rotaline.geometry.primitives import Line, SteppedCylinder
from rotaline.simulation.ideal.observed_scan import trace_scan
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.parts.shapes import SteppedRod
from rotaline.simulation.plan import full_turn, mount, table_disc
from rotaline.simulation.rig import build_rig

RIG = build_rig((640, 480), turn_sense=-1)
ARTIFACT = SteppedCylinder(23.051, 36.006, 22.003, 25.005)
SCALE = Scale(0.01, 46.0, 290.0)


@pytest.fixture(scope="module")
def stripes():
    parts = [Placed(SteppedRod(ARTIFACT), mount(-4.1, 2.9)), table_disc(RIG)]
    return trace_scan(RIG, parts, full_turn(16), spacing_px=3.0)


def seen_of(stripes, sigma_px=0.0):
    observed = MountObservation(
        "stepped", ARTIFACT, tuple(str(i) for i in range(16)), stripes.angles_rad, stripes.observed(sigma_px, 1)
    )
    return see_steps(RIG.camera, RIG.laser_plane_camera, RIG.rotation_axis_camera, observed)


def test_pieces_and_heights_are_seen_without_sizes_axis_and_angles(stripes):
    seen = seen_of(stripes, 0.05)
    assert seen.height_mm == pytest.approx((22.003, 25.005), abs=0.01)
    base = RIG.camera_from_base.inv()
    plane = RIG.laser_plane_camera
    points = base.apply(seen.rays_camera * (-plane.offset / (seen.rays_camera @ plane.normal))[:, None])
    heights = {TOP: 47.008, STEP: 25.005}
    for piece, height in heights.items():
        assert np.abs(points[seen.piece == piece, 2] - height).max() < 0.1
    assert points[seen.piece == SMALL_SIDE, 2].min() > 25.5
    assert points[seen.piece == LARGE_SIDE, 2].max() < 24.5


def test_no_staircase_where_nothing_or_only_the_table_is_seen():
    table_only = trace_scan(RIG, [table_disc(RIG)], full_turn(6), spacing_px=3.0).observed(0.05, 1)
    for stripes in ((), table_only):
        names = tuple(str(i) for i in range(len(stripes)))
        bare = MountObservation("bare", ARTIFACT, names, np.zeros(len(stripes)), stripes)
        assert see_steps(RIG.camera, RIG.laser_plane_camera, RIG.rotation_axis_camera, bare) is None


def test_without_noise_the_freed_state_stays_at_the_truth(stripes):
    fitted = fit_steps(RIG.laser_plane_camera, RIG.rotation_axis_camera, [-1], 1.0, [seen_of(stripes)], ARTIFACT)
    assert fitted.rms_mm < 1e-4
    assert np.linalg.norm(fitted.centres_mm[0, :2]) == pytest.approx(np.hypot(4.1, 2.9), abs=0.01)
    assert np.abs(fitted.state[SIZES]).max() < 0.01


def test_an_axis_that_is_off_comes_back(stripes):
    true = RIG.rotation_axis_camera
    off = Line(true.point + np.array([0.4, 0.0, -1.0]), true.direction)
    fitted = fit_steps(RIG.laser_plane_camera, off, [-1], 1.0, [seen_of(stripes)], ARTIFACT)
    assert fitted.rms_mm < 1e-3
    moved = np.linalg.norm(fitted.state[AXIS][:2])
    assert moved == pytest.approx(float(off.distance_to(true.point[None])[0]), abs=0.05)


def test_the_jacobian_is_that_of_the_residuals(stripes):
    seen = seen_of(stripes, 0.05)
    first = fit_steps(RIG.laser_plane_camera, RIG.rotation_axis_camera, [-1], 1.0, [seen], ARTIFACT)
    larger = dataclasses.replace(ARTIFACT, diameter_large=36.026)
    second = fit_steps(RIG.laser_plane_camera, RIG.rotation_axis_camera, [-1], 1.0, [seen], larger)
    sides = first.piece == LARGE_SIDE
    assert np.allclose(first.jacobian[sides, SIZES.start + 1], -1.0, atol=1e-3)
    assert second.start_sizes[1] + second.state[SIZES][1] == pytest.approx(
        first.start_sizes[1] + first.state[SIZES][1], abs=0.02
    )


def test_a_part_is_round_with_the_right_sense_only(stripes):
    right, wrong = (
        roundness_mm(RIG.laser_plane_camera, RIG.rotation_axis_camera, sense, 1.0, seen_of(stripes))
        for sense in (-1, 1)
    )
    assert right < 1e-3
    assert wrong > 0.1


@pytest.mark.parametrize("factor", [1.0, 0.99, 1.08])
def test_sizes_that_are_seen_as_stated_stay_so_whatever_the_scale(factor):
    seen = factor * np.array([23.051 / 2, 36.006 / 2, 22.003])
    assert gross_sizes(ARTIFACT, seen, factor * 25.005, SCALE) == (ARTIFACT, None)


def test_an_axis_that_is_off_makes_no_other_sizes():
    seen = np.array([23.051 / 2 + 1.5, 36.006 / 2 + 1.5, 22.003])
    assert gross_sizes(ARTIFACT, seen, 25.005, SCALE)[1] is None


@pytest.mark.parametrize("height_large", [25.005, np.nan])
def test_mixed_up_sizes_are_told(height_large):
    seen = np.array([23.051 / 2, 36.006 / 2, 22.003])
    stated = SteppedCylinder(23.051, 36.006, 25.005, 22.003)
    meant, finding = gross_sizes(stated, seen, height_large, SCALE)
    assert meant == ARTIFACT
    assert "the heights are swapped" in finding.text
    inches = SteppedCylinder(*(np.array([23.051, 36.006, 22.003, 25.005]) / 25.4).tolist())
    meant, finding = gross_sizes(inches, seen, height_large, SCALE)
    assert meant.diameter_large == pytest.approx(36.006)
    assert "0.03937 times as large" in finding.text


def test_the_height_over_the_table_needs_a_third_of_a_percent():
    assert wrong_large_height(ARTIFACT, [25.06, np.nan], 1e-3, SCALE) is None
    assert wrong_large_height(ARTIFACT, [np.nan], 1e-3, SCALE) is None
    assert "25.20 mm" in wrong_large_height(ARTIFACT, [25.2], 1e-3, SCALE).text
    assert wrong_large_height(ARTIFACT, [25.2], 0.1, SCALE) is None
