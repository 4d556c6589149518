"""Each error of the turntable alone has the stated effect; without errors the table is ideal."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.simulation.mechanics import base_from_table, true_angle_deg
from rotaline.simulation.rig import Mechanics, build_rig

ANGLES = st.floats(-720, 720)
SENSES = st.sampled_from([-1, 1])


def _rng(seed=0):
    return np.random.default_rng(seed)


@given(angle_deg=ANGLES, sense=SENSES)
@settings(max_examples=30, deadline=None)
def test_without_errors_the_pose_is_the_ideal_one(angle_deg, sense):
    pose = base_from_table(sense, Mechanics(), angle_deg, _rng())
    ideal = build_rig((160, 120), turn_sense=sense).base_from_table(angle_deg)
    np.testing.assert_allclose(pose.as_matrix(), ideal.as_matrix(), rtol=0, atol=1e-15)


@given(angle_deg=ANGLES, sense=SENSES, phase_deg=st.floats(0, 360))
@settings(max_examples=30, deadline=None)
def test_eccentricity_turns_the_table_once_per_turn(angle_deg, sense, phase_deg):
    mechanics = Mechanics(angle_eccentricity_deg=0.02, angle_eccentricity_phase_deg=phase_deg)
    error_deg = 0.02 * np.sin(np.radians(angle_deg + phase_deg))
    assert true_angle_deg(mechanics, angle_deg, _rng()) - angle_deg == pytest.approx(error_deg, abs=1e-12)
    rotvec = (
        base_from_table(sense, Mechanics(), angle_deg, _rng()).inv()
        * base_from_table(sense, mechanics, angle_deg, _rng())
    ).rotation.as_rotvec(degrees=True)
    np.testing.assert_allclose(rotvec, [0.0, 0.0, sense * error_deg], atol=1e-9)


@given(angle_deg=ANGLES, sense=SENSES, phase_deg=st.floats(0, 360))
@settings(max_examples=30, deadline=None)
def test_run_out_moves_the_axis_along_base_x(angle_deg, sense, phase_deg):
    mechanics = Mechanics(run_out_um=5.0, run_out_phase_deg=phase_deg)
    pose = base_from_table(sense, mechanics, angle_deg, _rng())
    expected_um = [5.0 * np.cos(np.radians(angle_deg + phase_deg)), 0.0, 0.0]
    np.testing.assert_allclose(pose.translation * 1e3, expected_um, atol=1e-9)
    ideal = base_from_table(sense, Mechanics(), angle_deg, _rng())
    np.testing.assert_array_equal(pose.rotation.as_matrix(), ideal.rotation.as_matrix())


@given(angle_deg=ANGLES, sense=SENSES, phase_deg=st.floats(0, 360))
@settings(max_examples=30, deadline=None)
def test_wobble_tilts_the_axis_towards_base_x(angle_deg, sense, phase_deg):
    mechanics = Mechanics(wobble_urad=200.0, wobble_phase_deg=phase_deg)
    pose = base_from_table(sense, mechanics, angle_deg, _rng())
    np.testing.assert_array_equal(pose.translation, np.zeros(3))
    axis_urad = 1e6 * pose.rotation.apply([0.0, 0.0, 1.0])[:2]
    expected_urad = [200.0 * np.cos(np.radians(angle_deg + phase_deg)), 0.0]
    np.testing.assert_allclose(axis_urad, expected_urad, atol=1e-4)


def test_noise_has_the_stated_standard_deviations_and_no_mean():
    mechanics = Mechanics(angle_noise_deg=0.01, run_out_noise_um=2.0)
    poses = [base_from_table(1, mechanics, 30.0, _rng(seed)) for seed in range(2000)]
    errors_deg = np.array([pose.rotation.as_euler("zyx", degrees=True)[0] - 30.0 for pose in poses])
    shifts_um = 1e3 * np.array([pose.translation for pose in poses])
    # standard uncertainties of a mean and of a standard deviation of 2000 values
    assert abs(errors_deg.mean()) < 4 * 0.01 / np.sqrt(2000)
    assert errors_deg.std() == pytest.approx(0.01, rel=4 / np.sqrt(4000))
    np.testing.assert_allclose(shifts_um[:, :2].mean(axis=0), 0.0, atol=4 * 2.0 / np.sqrt(2000))
    np.testing.assert_allclose(shifts_um[:, :2].std(axis=0), 2.0, rtol=4 / np.sqrt(4000))
    assert np.all(shifts_um[:, 2] == 0.0)
    assert abs(np.corrcoef(np.column_stack([errors_deg, shifts_um[:, :2]]).T) - np.eye(3)).max() < 4 / np.sqrt(2000)


def test_the_same_seed_gives_the_same_pose_and_one_error_leaves_the_others_alone():
    noisy = Mechanics(angle_noise_deg=0.01, run_out_noise_um=2.0)
    first, again = (base_from_table(1, noisy, 30.0, _rng(7)).as_matrix() for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert np.any(first != base_from_table(1, noisy, 30.0, _rng(8)).as_matrix())
    still = base_from_table(1, Mechanics(run_out_noise_um=2.0), 30.0, _rng(7)).as_matrix()
    np.testing.assert_array_equal(first[:, 3], still[:, 3])


def test_a_part_takes_half_of_the_run_out_for_its_own_offset():
    """Put together as if the table were ideal, a point moves on a circle of half the run-out, twice in a turn."""
    mechanics = Mechanics(run_out_um=10.0)
    angles_deg = np.arange(0.0, 360.0, 10.0)
    point_table = np.array([12.0, -3.0, 5.0])
    seen = np.array(
        [
            (base_from_table(1, Mechanics(), a, _rng()).inv() * base_from_table(1, mechanics, a, _rng())).apply(
                point_table[None]
            )[0]
            for a in angles_deg.tolist()
        ]
    )
    offset_um = 1e3 * (seen.mean(axis=0) - point_table)
    np.testing.assert_allclose(offset_um, [5.0, 0.0, 0.0], atol=1e-9)
    left_um = 1e3 * (seen - seen.mean(axis=0))
    twice = np.radians(-2 * angles_deg)
    expected_um = 5.0 * np.column_stack([np.cos(twice), np.sin(twice), 0 * twice])
    np.testing.assert_allclose(left_um, expected_um, atol=1e-9)
