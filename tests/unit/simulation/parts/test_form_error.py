"""Form errors against formulas of the bent surfaces, written without bending space."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.geometry.primitives import SteppedCylinder
from rotaline.simulation.parts.form_error import Bent, FormError, OutOfRound, OutOfSphere
from rotaline.simulation.parts.shapes import Ball, Block, Cone, GrooveBlock, Rod, SteppedRod

errors = st.builds(
    FormError, st.floats(1.0, 100.0), st.integers(1, 7), st.floats(-360.0, 360.0).map(lambda phase: round(phase, 3))
)


def _hits(shape, seed, n=300):
    """Points and normals where rays from all around meet a shape, not at a grazing angle; with their faces."""
    rng = np.random.default_rng(seed)
    low, high = shape.bounds()
    way = rng.normal(size=3)
    origin = (low + high) / 2 + 90.0 * way / np.linalg.norm(way)
    directions = rng.uniform(low, high, (n, 3)) - origin
    t, faces = shape.intersect(origin, directions)
    hit = np.isfinite(t)
    points, faces, directions = origin + t[hit, None] * directions[hit], faces[hit], directions[hit]
    normals = shape.normals(points, faces)
    steep = -np.sum(normals * directions, axis=1) > 0.2 * np.linalg.norm(directions, axis=1)
    return points[steep], normals[steep], faces[steep]


def _radius_change(error, points):
    phi = np.arctan2(points[:, 1], points[:, 0])
    return error.amplitude_um * 1e-3 * np.cos(error.lobes * phi + np.radians(error.phase_deg))


def _r(points):
    return np.hypot(points[:, 0], points[:, 1])


@given(error=errors, seed=st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_a_rod_and_its_ends_are_where_they_should_be(error, seed):
    points, normals, faces = _hits(Rod(30.0, 20.0, form_error=error), seed)
    side, top, bottom = (faces == 1), (faces == 2), (faces == 0)
    np.testing.assert_allclose(_r(points)[side], 15.0 + _radius_change(error, points[side]), atol=1e-6)
    np.testing.assert_allclose(points[top, 2], 20.0, atol=1e-6)
    np.testing.assert_allclose(points[bottom, 2], 0.0, atol=1e-6)
    assert np.all(_r(points)[~side] < 15.0 + _radius_change(error, points[~side]) + 1e-6)
    np.testing.assert_allclose(normals[top], np.tile([0.0, 0.0, 1.0], (top.sum(), 1)), atol=1e-12)


@given(error=errors, seed=st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_both_cylinders_of_a_stepped_rod_have_the_whole_amplitude(error, seed):
    points, _, faces = _hits(SteppedRod(SteppedCylinder(12.0, 24.0, 9.0, 11.0), form_error=error), seed)
    for face, radius in ((1, 12.0), (3, 6.0)):
        here = points[faces == face]
        np.testing.assert_allclose(_r(here), radius + _radius_change(error, here), atol=1e-6)


@given(error=errors, seed=st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_a_ball_is_where_it_should_be(error, seed):
    points, _, _ = _hits(Ball(30.0, form_error=error), seed)
    relative = points - [0.0, 0.0, 15.0]
    distance = np.linalg.norm(relative, axis=1)
    sine = _r(points) / distance
    np.testing.assert_allclose(distance, 15.0 + _radius_change(error, points) * sine**error.lobes, atol=1e-6)


@given(error=errors, seed=st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_a_cone_is_where_it_should_be_and_stays_pointed(error, seed):
    points, _, faces = _hits(Cone(30.0, 0.0, 30.0, form_error=error), seed)
    flank, core = points[faces == 1], error.core_radius_mm
    outer = _r(flank) > core
    exact = 15.0 - flank[:, 2] / 2
    np.testing.assert_allclose(_r(flank)[outer], (exact + _radius_change(error, flank))[outer], atol=1e-6)
    excess = np.abs(_r(flank) - exact)
    assert np.all(excess <= error.amplitude_um * 1e-3 + 1e-6)
    assert np.all(excess[_r(flank) < 0.1 * core] < 0.01 * error.amplitude_um * 1e-3 + 1e-6)


@pytest.mark.parametrize(("shape", "axis", "length"), [(Block, 1, 40.0), (GrooveBlock, 0, 50.0)])
@given(error=errors, seed=st.integers(0, 1000))
@settings(max_examples=8, deadline=None)
def test_flat_parts_bend_along_their_longer_side(shape, axis, length, error, seed):
    if shape is Block:
        part, levels = Block(30.0, 40.0, 5.0, form_error=error), (0.0, 5.0)
    else:
        part, levels = GrooveBlock(50.0, 30.0, 20.0, 8.0, 14.0, 6.0, form_error=error), (0.0, 12.0, 20.0)
    points, normals, _ = _hits(part, seed)
    flat = points[np.abs(normals[:, 2]) > 0.9]
    turn = np.pi * error.lobes * flat[:, axis] / length + np.radians(error.phase_deg)
    height = flat[:, 2] - error.amplitude_um * 1e-3 * np.cos(turn)
    assert np.all(np.abs(height[:, None] - np.array(levels)).min(axis=1) < 1e-6)
    other = points[np.abs(normals[:, 1 - axis]) > 0.999]
    np.testing.assert_allclose(np.abs(other[:, 1 - axis]), 15.0, atol=1e-6)


@given(error=errors, seed=st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_gradients_are_those_of_the_heights(error, seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(40, 3)) * 12.0
    points = points[_r(points) > 0.05]
    for field in (OutOfRound(error), OutOfSphere(error, 3.0), Bent(error, 0, 40.0), Bent(error, 1, 40.0)):
        heights, directions, gradients = field.at(points)
        np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
        assert np.all(np.abs(heights) <= field.largest)
        for k in range(3):
            step = np.zeros(3)
            step[k] = 1e-5
            slope = (field.at(points + step)[0] - field.at(points - step)[0]) / 2e-5
            np.testing.assert_allclose(gradients[:, k], slope, atol=1e-6)


def test_the_axis_itself_is_no_exception():
    on_axis = np.array([[0.0, 0.0, 2.0], [0.0, 0.0, -1.0]])
    for field in (OutOfRound(FormError(50.0, 2)), OutOfSphere(FormError(50.0, 2), 0.0)):
        heights, _, gradients = field.at(on_axis)
        np.testing.assert_allclose(heights, 0.0, atol=1e-15)
        assert np.all(np.isfinite(gradients))


def test_rays_that_graze_a_wave_are_not_lost():
    """In the plane at right angles to the axis: whether a ray meets the bent circle is known from samples along it."""
    error, radius = FormError(50.0, 5, 40.0), 8.0
    rod = Rod(2 * radius, 30.0, form_error=error)
    azimuth = np.linspace(0.0, 2 * np.pi, 9)[:-1] + 0.1
    along = np.linspace(50.0, 70.0, 4000)[:, None]
    grazing = 0
    for a in azimuth:
        origin = np.array([60.0 * np.cos(a), 60.0 * np.sin(a), 15.0])
        angle = a + np.pi + np.arcsin(np.linspace(radius - 0.07, radius + 0.06, 120) / 60.0)
        directions = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(120)])
        t, _ = rod.intersect(origin, directions)
        points = (origin + along[:, :, None] * directions).reshape(-1, 3)
        depth = (radius + _radius_change(error, points) - _r(points)).reshape(-1, 120).max(axis=0)
        sure = np.abs(depth) > 5e-4
        np.testing.assert_array_equal(np.isfinite(t)[sure], (depth > 0)[sure])
        grazing += np.count_nonzero((depth > 0) & (depth < 0.02))
    assert grazing > 50


@pytest.mark.parametrize(
    ("values", "match"),
    [((-1.0,), "amplitude_um"), ((float("nan"),), "amplitude_um"), ((5.0, 0), "at least 1 lobe")],
)
def test_what_is_no_form_error_is_refused(values, match):
    with pytest.raises(ValueError, match=match):
        FormError(*values)


def test_no_amplitude_is_no_form_error():
    origin, directions = np.array([50.0, 3.0, 40.0]), np.array([[-50.0, 0.0, -30.0], [-40.0, 2.0, -20.0]])
    plain, none = Rod(30.0, 20.0), Rod(30.0, 20.0, form_error=FormError(0.0))
    np.testing.assert_array_equal(plain.intersect(origin, directions)[0], none.intersect(origin, directions)[0])
