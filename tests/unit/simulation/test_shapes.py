"""Shapes against a reference that walks along each ray in small steps and asks whether it is inside."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.geometry.primitives import SteppedCylinder
from rotaline.simulation.shapes import Ball, GrooveBlock, Rod, SteppedRod

BALL = Ball(20.0)
ROD = Rod(16.0, 30.0, 2.0)
STEPPED = SteppedRod(SteppedCylinder(12.0, 24.0, 9.0, 11.0))
GROOVE = GrooveBlock(30.0, 20.0, 15.0, 8.0, 14.0, 6.0)


def _in_rod(p, diameter, z0, z1):
    return (np.hypot(p[..., 0], p[..., 1]) < diameter / 2) & (p[..., 2] > z0) & (p[..., 2] < z1)


def _in_groove_block(p):
    x, y, z = np.moveaxis(p, -1, 0)
    half_gap = np.interp(z, [7.0, 15.0], [3.0, 7.0])
    gap = (z > 7.0) & (np.abs(x) < half_gap)
    return (np.abs(x) < 15) & (np.abs(y) < 10) & (z > 0) & (z < 15) & ~gap


INSIDE = {
    "ball": (BALL, lambda p: np.linalg.norm(p - [0, 0, 10.0], axis=-1) < 10.0),
    "rod": (ROD, lambda p: _in_rod(p, 16.0, 2.0, 32.0)),
    "stepped": (STEPPED, lambda p: _in_rod(p, 24.0, 0.0, 11.0) | _in_rod(p, 12.0, 10.9, 20.0)),
    "groove": (GROOVE, _in_groove_block),
}
STEP_MM = 0.02


@pytest.mark.parametrize("name", INSIDE)
@given(seed=st.integers(0, 10_000))
@settings(max_examples=8, deadline=None)
def test_rays_enter_where_a_walk_along_them_first_gets_inside(name, seed):
    shape, inside = INSIDE[name]
    rng = np.random.default_rng(seed)
    origin = rng.normal(size=3)
    origin = 60.0 * origin / np.linalg.norm(origin) + [0.0, 0.0, 10.0]
    directions = rng.uniform(-18, 18, (30, 3)) - (origin - np.array([0.0, 0.0, 10.0]))
    directions /= np.linalg.norm(directions, axis=1)[:, None]

    t, faces = shape.intersect(origin, directions)

    walk = np.arange(0.0, 120.0, STEP_MM)
    within = inside(origin + walk[:, None] * directions[:, None, :])
    expected = np.where(within.any(axis=1), walk[np.argmax(within, axis=1)], np.inf)
    # a ray that only scrapes an edge may be inside for less than a step
    long_enough = (within.sum(axis=1) > 3) | ~np.isfinite(t)
    np.testing.assert_allclose(t[long_enough], expected[long_enough], atol=1.1 * STEP_MM)

    hit = np.isfinite(t)
    points = origin + t[hit, None] * directions[hit]
    normals = shape.normals(points, faces[hit])
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
    assert np.all(np.sum(normals * directions[hit], axis=1) < 0), "a ray enters through a face that looks towards it"
    assert np.count_nonzero(inside(points - 1e-6 * normals)) >= 0.9 * len(points)
    assert not np.any(inside(points + 1e-6 * normals))


def test_nothing_is_hit_behind_the_origin():
    for shape, _ in INSIDE.values():
        t, _ = shape.intersect(np.array([0.0, 0.0, 80.0]), np.array([[0.0, 0.0, 1.0], [0.01, 0.0, 1.0]]))
        assert np.all(np.isinf(t))


def test_a_ray_along_a_face_hits_only_from_within_its_height():
    for z, expected in ((16.0, np.inf), (14.0, 45.0)):
        t, _ = GROOVE.intersect(np.array([-60.0, 0.0, z]), np.array([[1.0, 0.0, 0.0]]))
        assert t[0] == pytest.approx(expected)


def test_a_groove_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="groove must fit"):
        GrooveBlock(30.0, 20.0, 15.0, 16.0, 14.0, 6.0)
