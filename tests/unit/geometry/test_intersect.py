"""Rays and planes."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.errors import GeometryError
from rotaline.geometry.intersect import intersect_rays_with_plane
from rotaline.geometry.primitives import Plane, unit


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
