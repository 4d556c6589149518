"""Robust scales and random sampling."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.errors import GeometryError
from rotaline.geometry.robust import (
    cauchy_weights,
    fit_plane_robust,
    mad_scale,
    ransac_cylinder,
    ransac_line_2d,
    ransac_plane,
    ransac_sphere,
)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_mad_scale_is_the_standard_deviation_of_gaussian_residuals_and_ignores_outliers() -> None:
    residuals = rng().normal(3.0, 0.7, 20_000)
    assert mad_scale(residuals) == pytest.approx(0.7, rel=0.03)
    residuals[:4000] = 1e6
    assert mad_scale(residuals) < 1.1
    with pytest.raises(GeometryError, match="at least one"):
        mad_scale(np.empty(0))


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=20), st.floats(0, 10))
def test_cauchy_weights_fall_from_one_with_distance(residuals: list[float], scale: float) -> None:
    weights = cauchy_weights(np.array(residuals), scale)
    order = np.argsort(np.abs(residuals))
    assert np.all((weights >= 0) & (weights <= 1))
    assert np.all(np.diff(weights[order]) <= 0)
    assert cauchy_weights(np.array([2.3849]), 1.0)[0] == pytest.approx(0.5)


@settings(deadline=None, max_examples=15)
@given(seed=st.integers(0, 1000), share=st.floats(0.0, 0.45))
def test_the_robust_plane_keeps_to_the_majority(seed: int, share: float) -> None:
    random = rng(seed)
    points = random.uniform(-20, 20, (600, 3))
    n_bad = int(600 * share)
    points[n_bad:, 2] = 0.2 * points[n_bad:, 0] + random.normal(0, 0.01, 600 - n_bad)
    points[:n_bad, 2] += 30.0
    found = fit_plane_robust(points)
    truth = np.array([-0.2, 0.0, 1.0]) / np.hypot(0.2, 1)
    assert np.arccos(min(1.0, abs(found.plane.normal @ truth))) < 4 * np.hypot(*found.fit.u_normal_rad) + 1e-7
    assert not found.inliers[:n_bad].any()
    assert found.inliers[n_bad:].mean() > 0.97
    assert len(found.fit.residuals) == found.inliers.sum()


def test_the_robust_plane_of_exact_points_and_with_a_threshold() -> None:
    points = np.column_stack([rng().uniform(-5, 5, (50, 2)), np.full(50, 2.0)])
    assert fit_plane_robust(points).inliers.all()
    points[:10, 2] += 1.0
    found = fit_plane_robust(points, threshold=0.5)
    assert found.inliers.tolist() == [False] * 10 + [True] * 40
    assert found.threshold == 0.5
    with pytest.raises(GeometryError, match="on a line"):
        fit_plane_robust(np.column_stack([np.arange(9.0)] * 3), threshold=0.1)


def test_the_line_with_most_points_is_found_among_others() -> None:
    random = rng(1)
    points = random.uniform(0, 100, (300, 2))
    points[:120, 1] = 0.3 * points[:120, 0] + random.normal(0, 0.1, 120)
    fit, inliers = ransac_line_2d(points, 0.4, rng(2))
    angle = np.arctan2(fit.direction[1], fit.direction[0]) - np.arctan(0.3)
    assert abs(np.sin(angle)) < 4 * np.sqrt(fit.cov[0, 0])
    assert inliers[:120].mean() > 0.97
    again, same = ransac_line_2d(points, 0.4, rng(2))
    assert np.array_equal(inliers, same)
    assert np.array_equal(again.direction, fit.direction)
    with pytest.raises(GeometryError, match="has only"):
        ransac_line_2d(points, 0.4, rng(2), n_min=250)
    with pytest.raises(GeometryError, match="coincide"):
        ransac_line_2d(np.ones((5, 2)), 0.4, rng(2))


def test_round_surfaces_are_found_among_outliers() -> None:
    random = rng(4)
    outward = random.normal(size=(6000, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    points = 14.0 * outward + [1, 2, 3]
    points[4000:] = random.uniform(-30, 30, (2000, 3))
    for normals in (None, outward):
        sphere, inliers = ransac_sphere(points, 0.1, rng(), normals)
        assert sphere.radius == pytest.approx(14.0, abs=1e-6)
        assert sphere.centre == pytest.approx([1, 2, 3], abs=1e-6)
        assert inliers[:4000].all()
        assert inliers[4000:].mean() < 0.1
    with pytest.raises(GeometryError, match="sphere"):
        ransac_sphere(points, 0.1, rng(), outward, radius_range=(20.0, 30.0), n_min=1000)

    turn = random.uniform(0, 2 * np.pi, 6000)
    side = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(6000)])
    points = 19.0 * side + np.column_stack([np.zeros((6000, 2)), random.uniform(0, 40, 6000)])
    points[4000:] = random.uniform(-30, 30, (2000, 3))
    cylinder, inliers = ransac_cylinder(points, side, 0.1, rng())
    assert cylinder.radius == pytest.approx(19.0, abs=1e-6)
    assert abs(cylinder.axis.direction[2]) == pytest.approx(1.0)
    assert inliers[:4000].all()
    straight, _ = ransac_cylinder(points, side, 0.1, rng(), direction=np.array([0.0, 0.0, 1.0]))
    assert straight.axis.direction == pytest.approx([0, 0, 1])


def test_normals_keep_planes_off_points_that_face_elsewhere() -> None:
    random = rng(6)
    floor = np.column_stack([random.uniform(-10, 10, (400, 2)), random.normal(0, 0.01, 400)])
    mist = np.column_stack([random.uniform(-10, 10, (800, 2)), 5 + random.normal(0, 0.01, 800)])
    points = np.vstack([floor, mist])
    normals = np.vstack([np.tile([0.0, 0.0, -1.0], (400, 1)), np.tile([1.0, 0.0, 0.0], (800, 1))])
    plain, _ = ransac_plane(points, 0.05, rng())
    assert abs(plain.offset) == pytest.approx(5, abs=0.1)
    wise, inliers = ransac_plane(points, 0.05, rng(), normals)
    assert abs(wise.offset) < 0.1
    assert not inliers[400:].any()


@pytest.mark.parametrize("search", [ransac_plane, ransac_sphere])
def test_too_few_or_missing_points_are_named(search: object) -> None:
    assert callable(search)
    with pytest.raises(GeometryError, match="at least"):
        search(np.zeros((2, 3)), 0.1, rng())
    with pytest.raises(GeometryError, match="finite"):
        search(np.full((9, 3), np.nan), 0.1, rng())
