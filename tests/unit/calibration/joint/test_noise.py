"""Scales of what is random, from residuals that were drawn with known ones."""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.calibration.joint.noise import (
    TABLE_CLASSES,
    TABLE_ERRORS,
    Noise,
    determined,
    frame_factor,
    information_factor,
    robust_scale,
    robust_weights,
    slow_variance,
    update_variances,
)


def _m_estimate(values, scale):
    """Location by the robust weights."""
    centre = np.median(values)
    for _ in range(30):
        weights = robust_weights((values - centre) / scale)
        centre = float(weights @ values / weights.sum())
    return centre


@pytest.mark.parametrize("outliers", [0.0, 0.05])
def test_scale_with_and_without_outliers(outliers):
    rng = np.random.default_rng(1)
    values = 0.05 * rng.standard_normal(20000)
    values[rng.random(20000) < outliers] += 3.0
    assert robust_scale(values) == pytest.approx(0.05, rel=0.03 + 1.5 * outliers)
    assert robust_scale(np.zeros(0)) == 1.0


@pytest.mark.parametrize("outliers", [0.0, 0.05])
def test_what_a_residual_is_worth_is_what_robust_means_scatter_by(outliers):
    """The variance of a robust mean of n values is 1 / (n factor^2)."""
    rng = np.random.default_rng(2)
    values = rng.standard_normal((600, 200))
    stray = rng.random(values.shape) < outliers
    values[stray] = 200.0 * rng.uniform(-1, 1, np.count_nonzero(stray))
    means = [_m_estimate(row, 1.0) for row in values]
    n = 200 * (1.0 - outliers)  # outliers are left out of the covariance
    assert 1.0 / (information_factor(values.ravel()) * np.sqrt(n)) == pytest.approx(np.std(means), rel=0.09)
    assert information_factor(rng.standard_normal(50000)) == pytest.approx(0.99, abs=0.01)


def test_a_residual_of_wrong_scale_is_worth_what_it_is():
    rng = np.random.default_rng(3)
    assert information_factor(1.5 * rng.standard_normal(50000)) == pytest.approx(1 / 1.5, rel=0.03)


def test_slow_variance_is_that_of_means_over_neighbours():
    rng = np.random.default_rng(6)
    piece = np.repeat(np.arange(60), 200)
    assert slow_variance(rng.standard_normal(12000), piece) == pytest.approx(1.0, rel=0.2)
    shifted = rng.standard_normal(12000) + 0.5 * rng.standard_normal(60)[piece]
    assert slow_variance(shifted, piece) == pytest.approx(1.0 + 24 * 0.25, rel=0.35)
    assert np.isnan(slow_variance(rng.standard_normal(60), np.zeros(60, dtype=int)))
    broken = np.arange(12000) // 5  # pieces too short to tell
    assert np.isnan(slow_variance(rng.standard_normal(12000), broken))


def test_a_frame_counts_less_only_if_it_errs_much_more():
    assert frame_factor(1.0, 3.0, 1.0) == 1.0
    assert frame_factor(1.0, 9.0, 1.0) == 3.0
    assert frame_factor(3.0, 1.0, 1.0) == 3.0  # with its factor it errs like the others
    assert frame_factor(3.0, 1e-6, 1.0) == 1.0
    assert frame_factor(1.0, float("nan"), 1.0) == 1.0


def _learnt(true, u, n_frames, seed, start=None):
    """Standard deviations after many rounds; each frame shows its errors with the noise ``u``."""
    rng = np.random.default_rng(seed)
    seen = true[TABLE_CLASSES] * rng.standard_normal((n_frames, 6)) + u * rng.standard_normal((n_frames, 6))
    plates_seen = 0.004 * rng.standard_normal((n_frames, 3)) + 0.001 * rng.standard_normal((n_frames, 3))
    noise = Noise(np.ones(1), np.ones(1)) if start is None else start
    for _ in range(40):
        sigma = noise.table[TABLE_CLASSES]
        variances = np.broadcast_to(1.0 / (1.0 / sigma**2 + 1.0 / u**2), seen.shape)
        plate_variance = 1.0 / (1.0 / noise.plate_mm**2 + 1.0 / 0.001**2)
        noise = update_variances(
            noise,
            seen * variances / u**2,
            variances.copy(),
            plates_seen * plate_variance / 0.001**2,
            np.full((n_frames, 3), plate_variance),
        )
    return noise


def test_errors_of_the_table_are_learnt_from_frames():
    true = np.array([2e-4, 3e-3, 1e-3, 5e-5])
    u = np.array([4e-5, 4e-5, 1e-4, 2e-3, 2e-3, 1e-3])  # wobble and lift hardly better seen than they are
    noise = _learnt(true, u, 400, 7)
    assert noise.table == pytest.approx(true, rel=0.12)
    assert noise.plate_mm == pytest.approx(0.004, rel=0.12)


def test_errors_that_are_not_there_shrink_to_what_chance_may_show():
    """The variance of the largest likelihood is the mean square less what the noise makes of it: 3 standard deviations of that."""
    u = np.array([1e-4, 1e-4, 1e-4, 2e-3, 2e-3, 1e-3])
    noise = _learnt(np.zeros(4), u, 200, 8)
    n = 200 * np.array([1, 2, 1, 2])
    assert (noise.table < (18.0 / n) ** 0.25 * np.array([1e-4, 2e-3, 1e-3, 1e-4])).all()


def test_what_is_known_of_some_angles_is_not_taken_for_an_error_of_all():
    true, known, n = 2e-4, 6e-4, 400
    rng = np.random.default_rng(9)
    excess = np.where(np.arange(n) % 2, known, 0.0)
    seen = 1e-9 * rng.standard_normal((n, 6))
    seen[:, 2] = np.hypot(true, excess) * rng.standard_normal(n)
    plates = np.zeros((0, 3))

    def learnt(noise):
        for _ in range(60):
            noise = update_variances(noise, seen, np.full((n, 6), 1e-18), plates, plates)
        return float(noise.table[0])

    noise = Noise(np.ones(1), np.ones(1))
    assert learnt(replace(noise, angle_excess=excess)) == pytest.approx(true, rel=0.12)
    assert learnt(noise) == pytest.approx(np.sqrt(true**2 + known**2 / 2), rel=0.12)
    assert learnt(replace(noise, angle_excess=np.zeros(n))) == learnt(noise)


def test_how_many_errors_the_data_determine():
    assert determined(1.0, np.full((5, 2), 0.25)) == pytest.approx(7.5)
    assert determined(1.0, np.ones((5, 2))) == 0.0


def test_priors_of_a_frame_are_in_the_order_of_its_motion():
    noise = Noise(np.ones(1), np.ones(1), table=np.array([1e-4, 2e-3, 3e-3, 4e-5]), plate_mm=0.01)
    assert TABLE_ERRORS == ("angle", "run-out", "lift", "wobble")
    on_table = 1.0 / noise.local_prior(6, 0)
    assert on_table == pytest.approx([4e-5, 4e-5, 1e-4, 2e-3, 2e-3, 3e-3])
    less_certain = replace(noise, angle_excess=np.array([0.0, 2.4e-4]))
    assert less_certain.local_prior(6, 0).tolist() == noise.local_prior(6, 0).tolist()
    assert 1.0 / less_certain.local_prior(6, 1) == pytest.approx([4e-5, 4e-5, 2.6e-4, 2e-3, 2e-3, 3e-3])
    assert noise.local_prior(9, -1) == pytest.approx([0] * 6 + [100.0] * 3)
