"""Rays, planes and curved sheets."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.errors import GeometryError
from rotaline.geometry.intersect import intersect_rays_with_plane, intersect_rays_with_sheet, sheet_distance
from rotaline.geometry.primitives import Plane, SheetCurvature, unit


@settings(deadline=None, max_examples=50)
@given(seed=st.integers(0, 10_000), scale=st.floats(0.01, 100.0))
def test_points_lie_on_ray_and_plane_whatever_the_length_of_the_ray(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    plane = Plane(unit(rng.normal(size=3)), float(rng.uniform(-500, -10)))
    rays = rng.normal(size=(40, 3))
    points = intersect_rays_with_plane(rays, plane)
    hit = np.isfinite(points[:, 0])
    assert np.allclose(plane.signed_distance_to(points[hit]), 0, atol=1e-9 * np.abs(points[hit]).max(initial=1.0))
    assert np.allclose(np.cross(points[hit], rays[hit]), 0, atol=1e-8 * np.abs(points[hit]).max(initial=1.0))
    assert np.all(np.einsum("ij,ij->i", points[hit], rays[hit]) > 0)
    again = intersect_rays_with_plane(scale * rays, plane)
    assert np.array_equal(np.isnan(again), np.isnan(points))
    assert np.allclose(again[hit], points[hit], rtol=1e-9)


def test_rays_that_graze_or_point_away_give_nan_rows_in_order() -> None:
    wall = Plane(np.array([0.0, 0.0, 1.0]), -300.0)
    graze = np.deg2rad(0.9)
    rays = np.array(
        [[0.0, 0.0, 2.0], [np.cos(graze), 0.0, np.sin(graze)], [0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [np.nan, 0, 1]]
    )
    points = intersect_rays_with_plane(rays, wall)
    assert points[0] == pytest.approx([0, 0, 300])
    assert np.all(np.isnan(points[1:]))


def test_a_plane_through_the_projection_centre_is_an_error() -> None:
    with pytest.raises(GeometryError, match="edge-on"):
        intersect_rays_with_plane(np.ones((1, 3)), Plane(np.array([1.0, 0.0, 0.0]), 0.0))


@settings(deadline=None, max_examples=30)
@given(seed=st.integers(0, 10_000))
def test_points_of_a_bowed_sheet_lie_on_it_and_on_their_rays(seed: int) -> None:
    """Bows of many mm, far beyond those of any laser line."""
    rng = np.random.default_rng(seed)
    plane = Plane(unit(np.array([0.6, 0.1, 0.8]) + 0.1 * rng.normal(size=3)), -250.0)
    curvature = SheetCurvature(
        rng.uniform(-20, 20, 3) - plane.offset * plane.normal, tuple(rng.uniform(-2e-4, 2e-4, 3))
    )
    rays = np.column_stack([rng.uniform(-0.25, 0.25, (40, 2)), np.ones(40)])
    points = intersect_rays_with_sheet(rays, plane, curvature)
    distance, _ = sheet_distance(points, plane, curvature)
    assert np.abs(distance).max() < 1e-10
    assert np.abs(np.cross(points, rays)).max() < 1e-10
    assert np.abs(plane.signed_distance_to(points)).max() > 0.01


def test_a_flat_sheet_is_the_plane_to_the_last_bit() -> None:
    rng = np.random.default_rng(1)
    plane = Plane(unit(np.array([0.6, 0.1, 0.8])), -250.0)
    rays = np.vstack([np.column_stack([rng.uniform(-0.25, 0.25, (40, 2)), np.ones(40)]), [[-0.8, 0.0, 0.6]]])
    points = intersect_rays_with_plane(rays, plane)
    assert np.isnan(points[-1]).all()
    assert np.array_equal(intersect_rays_with_sheet(rays, plane, None), points, equal_nan=True)
    no_bow = SheetCurvature(np.zeros(3), (0.0, 0.0, 0.0))
    assert intersect_rays_with_sheet(rays, plane, no_bow) == pytest.approx(points, abs=1e-12, nan_ok=True)


def test_the_gradient_of_a_sheet_is_that_of_its_equation() -> None:
    rng = np.random.default_rng(2)
    plane = Plane(unit(np.array([0.6, 0.1, 0.8])), -250.0)
    curvature = SheetCurvature(np.array([150.0, 20.0, 200.0]), (3e-4, -1e-4, 2e-4))
    points = rng.uniform(-50, 50, (10, 3)) - plane.offset * plane.normal
    _, gradient = sheet_distance(points, plane, curvature)
    for axis, step in enumerate(1e-3 * np.eye(3)):
        ahead, behind = (sheet_distance(points + sign * step, plane, curvature)[0] for sign in (1, -1))
        assert gradient[:, axis] == pytest.approx((ahead - behind) / 2e-3, abs=1e-9)


def test_a_ray_that_a_strong_bow_avoids_meets_nothing() -> None:
    """A sheet that bends away before it gets to the ray."""
    wall = Plane(np.array([0.0, 0.0, 1.0]), -300.0)
    bowl = SheetCurvature(np.array([0.0, 0.0, 300.0]), (-0.1, 0.0, -0.1))
    points = intersect_rays_with_sheet(np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 1.0]]), wall, bowl)
    assert points[0] == pytest.approx([0.0, 0.0, 300.0])
    assert np.isnan(points[1]).all()
