"""Noise of observed scans, frames and angles, and the errors of the turntable in them."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.simulation.ideal.observed_scan import trace_scan
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.plan import mount, table_disc
from rotaline.simulation.rig import Mechanics, build_rig
from rotaline.simulation.small_session import ROD

RIG = build_rig((320, 240), turn_sense=-1)
PARTS = [Placed(ROD, mount(-2.4, 0.8)), table_disc(RIG)]
ANGLES_DEG = (0.0, 40.0, 200.0)


@pytest.fixture(scope="module")
def scan():
    return trace_scan(RIG, PARTS, ANGLES_DEG)


@pytest.fixture(scope="module")
def dense():
    """Many points, for statistics."""
    return trace_scan(RIG, PARTS, ANGLES_DEG, spacing_px=0.1)


def _shifts_px(scan, stripes):
    """Along the normal and along the stripe."""
    move = np.concatenate([stripe.uv for stripe in stripes]) - scan.uv
    across = np.column_stack([-scan.normal[:, 1], scan.normal[:, 0]])
    return (move * scan.normal).sum(axis=1), (move * across).sum(axis=1)


def test_without_noise_the_centres_are_the_true_ones(scan):
    stripes = scan.observed(0.0, 1)
    assert [len(stripe) for stripe in stripes] == np.bincount(scan.frame).tolist()
    np.testing.assert_array_equal(np.concatenate([stripe.uv for stripe in stripes]), scan.uv)
    assert all(np.all(stripe.u_normal_px == 0.0) for stripe in stripes)
    assert all(stripe.segment[0] == 0 and stripe.segment.max() >= 2 for stripe in stripes)
    assert np.all(scan.observed(0.0, 1, stated_px=0.03)[0].u_normal_px == 0.03)
    np.testing.assert_allclose(scan.angles_rad, np.radians(ANGLES_DEG))


@given(sigma_px=st.floats(0.01, 0.5), seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_noise_is_along_the_normal_and_of_the_stated_size(dense, sigma_px, seed):
    along_normal, along_stripe = _shifts_px(dense, dense.observed(sigma_px, seed))
    n = len(along_normal)
    assert np.abs(along_stripe).max() < 1e-9
    assert abs(along_normal.std() / sigma_px - 1) < 5 / np.sqrt(2 * n)
    assert abs(along_normal.mean()) < 5 * sigma_px / np.sqrt(n)
    neighbours = np.corrcoef(along_normal[:-1], along_normal[1:])[0, 1]
    assert abs(neighbours) < 5 / np.sqrt(n)


@pytest.mark.parametrize("correlation_px", [1.0, 5.0])
def test_correlated_noise_falls_off_along_a_segment_and_ends_with_it(dense, correlation_px):
    repeats = np.array(
        [
            _shifts_px(dense, dense.observed(0.0, seed, correlated_px=0.2, correlation_px=correlation_px))[0]
            for seed in range(60)
        ]
    )
    assert repeats.std() == pytest.approx(0.2, rel=0.03)
    same = (dense.segment[:-10] == dense.segment[10:]) & (dense.frame[:-10] == dense.frame[10:])
    lag_1px = (repeats[:, :-10] * repeats[:, 10:]).mean(axis=0) / 0.04
    assert lag_1px[same].mean() == pytest.approx(np.exp(-1.0 / correlation_px), abs=0.03)
    assert abs(lag_1px[~same].mean()) < 0.1
    first = np.flatnonzero(np.diff(dense.segment) != 0) + 1
    assert repeats[:, first].std() == pytest.approx(0.2, rel=0.1)
    stated = dense.observed(0.3, 1, correlated_px=0.4)[0].u_normal_px
    np.testing.assert_allclose(stated, 0.5)


def test_outliers_are_as_many_and_as_far_as_stated(dense):
    shift, _ = _shifts_px(dense, dense.observed(0.0, 4, outlier_fraction=0.1, outlier_px=2.0))
    out = shift != 0
    assert out.mean() == pytest.approx(0.1, abs=4 * np.sqrt(0.09 / len(shift)))
    assert np.abs(shift).max() <= 2.0
    assert shift[out].std() == pytest.approx(2.0 / np.sqrt(3), rel=0.1)


def test_one_error_does_not_change_the_random_numbers_of_the_others(scan):
    alone, _ = _shifts_px(scan, scan.observed(0.1, 9))
    slow, _ = _shifts_px(scan, scan.observed(0.0, 9, correlated_px=0.2))
    both, _ = _shifts_px(scan, scan.observed(0.1, 9, correlated_px=0.2))
    np.testing.assert_allclose(both, alone + slow, atol=1e-9)
    other, _ = _shifts_px(scan, scan.observed(0.1, 10))
    assert np.abs(other - alone).max() > 0.1


def test_points_that_leave_the_image_are_left_out():
    scan = trace_scan(RIG, PARTS, [0.0], edge_px=0.0)
    stripe = scan.observed(0.0, 1, outlier_fraction=1.0, outlier_px=200.0)[0]
    assert 0 < len(stripe) < len(scan.uv)
    assert np.all((stripe.uv >= 0) & (stripe.uv <= (319, 239)))


@pytest.mark.parametrize("sense", [-1, 1])
def test_points_in_the_table_frame_are_on_the_part_in_every_frame(sense):
    rig = replace(RIG, turn_sense=sense)
    scan = trace_scan(rig, PARTS, ANGLES_DEG)
    x, y, z = (scan.points_table - [-2.4, 0.8, 0.0]).T
    side = (z > 1e-6) & (z < 40.0 - 1e-6)
    assert np.bincount(scan.frame[side]).min() > 40
    np.testing.assert_allclose(np.hypot(x, y)[side], 19.002, atol=1e-9)
    assert np.all((np.abs(z[~side]) < 1e-9) | (np.abs(z[~side] - 40.0) < 1e-9))


def test_the_errors_of_the_turntable_move_what_is_seen():
    shaky = replace(RIG, mechanics=Mechanics(run_out_um=200.0, angle_noise_deg=0.1))
    still, moved, again, other = (
        trace_scan(rig, PARTS, [0.0, 90.0], seed=seed) for rig, seed in ((RIG, 1), (shaky, 1), (shaky, 1), (shaky, 2))
    )
    np.testing.assert_array_equal(moved.uv, again.uv)
    assert len(moved.uv) != len(other.uv) or np.abs(moved.uv - other.uv).max() > 1e-3
    # run-out is along base x, 0.2 mm at angle 0 and none at 90 deg; noise of the angle turns the part about the axis
    px_per_mm = RIG.camera.fx / 290.0
    for frame, (low, high) in enumerate(((0.1 * px_per_mm, 0.5 * px_per_mm), (1e-4, 0.05 * px_per_mm))):
        a, b = (s.uv[(s.frame == frame) & (s.segment == 1)] for s in (still, moved))
        gap = np.linalg.norm(a[:, None] - b[None], axis=2).min(axis=1)
        assert low < np.median(gap) < high


def test_the_noise_of_a_frame_does_not_depend_on_the_other_frames():
    shaky = replace(RIG, mechanics=Mechanics(angle_noise_deg=0.1, run_out_noise_um=5.0))
    few, many = trace_scan(shaky, PARTS, [0.0], seed=3), trace_scan(shaky, PARTS, [0.0, 90.0], seed=3)
    np.testing.assert_array_equal(few.uv, many.uv[many.frame == 0])


def test_frames_without_a_stripe_keep_their_place():
    beside = Placed(ROD, mount(75.0, 0.0))
    scan = trace_scan(RIG, [beside], [0.0, 180.0, 270.0])
    stripes = scan.observed(0.1, 1, correlated_px=0.1)
    assert len(stripes) == 3
    assert [len(stripe) for stripe in stripes] == np.bincount(scan.frame, minlength=3).tolist()
    assert 0 in [len(stripe) for stripe in stripes]


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"sigma_px": -0.1}, "sigma_px"),
        ({"correlated_px": -0.1}, "correlated_px"),
        ({"correlation_px": 0.0}, "correlation_px"),
        ({"outlier_fraction": 1.5}, "outlier_fraction"),
        ({"outlier_px": -1.0}, "outlier_px"),
    ],
)
def test_impossible_noise_is_refused(scan, wrong, named):
    with pytest.raises(ValueError, match=named):
        scan.observed(**({"sigma_px": 0.1, "seed": 1} | wrong))


def test_a_scan_without_angles_is_refused():
    with pytest.raises(ValueError, match="angle"):
        trace_scan(RIG, PARTS, [])
