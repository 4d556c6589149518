"""Derivatives and invariances of the distances from the ideal circles."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.calibration.feature_circles import CircleModel, circle_model
from rotaline.geometry.primitives import Line, SteppedCylinder
from rotaline.geometry.transforms import rotate_about_line

ARTIFACT = SteppedCylinder(20.0, 32.0, 15.0, 18.0)


def _model(rng: np.random.Generator, n: int = 24) -> CircleModel:
    circle = np.arange(n) % 4
    radii, heights = np.array([10.0, 10.0, 16.0, 16.0]), np.array([33.0, 18.0, 18.0, 0.0])
    azimuth = rng.uniform(0, 2 * np.pi, n)
    points = np.column_stack([radii[circle] * np.cos(azimuth), radii[circle] * np.sin(azimuth), heights[circle]])
    points += rng.normal(0, 0.5, points.shape)
    return circle_model(points, rng.uniform(-3, 3, n), np.arange(n) // 4 % 2, np.arange(n) // 4, circle, ARTIFACT)


@given(seed=st.integers(0, 10_000))
@settings(deadline=None, max_examples=15)
def test_derivatives(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model = _model(rng)
    x = rng.normal(0, 0.5, model.n_unknowns)
    _, slopes = model.residuals_with_slopes(x)
    for k, step in enumerate(1e-6 * np.eye(len(x))):
        numeric = (model.residuals(x + step) - model.residuals(x - step)) / 2e-6
        np.testing.assert_allclose(slopes[:, :, k], numeric, atol=1e-7)
    _, slope = model.mean_distance_with_slope(x)
    step = 1e-6 * rng.normal(size=len(x))
    numeric = (model.mean_distance_with_slope(x + step)[0] - model.mean_distance_with_slope(x - step)[0]) / 2
    np.testing.assert_allclose(slope @ step, numeric, atol=1e-10)


@given(seed=st.integers(0, 10_000), slide=st.tuples(st.floats(-5, 5), st.floats(-5, 5)))
@settings(deadline=None, max_examples=15)
def test_sliding_pa_and_pb_along_the_axis_changes_nothing(seed: int, slide: tuple[float, float]) -> None:
    rng = np.random.default_rng(seed)
    model = _model(rng)
    x = rng.normal(0, 0.5, model.n_unknowns)
    direction = model.axis(x).direction
    slid = x.copy()
    slid[:3] += slide[0] * direction
    slid[3:6] += slide[1] * direction
    np.testing.assert_allclose(model.residuals(slid), model.residuals(x), atol=1e-9)


def test_turned_is_the_rotation_about_the_axis() -> None:
    rng = np.random.default_rng(4)
    model = _model(rng)
    x = rng.normal(0, 0.5, model.n_unknowns)
    axis = model.axis(x)
    np.testing.assert_allclose(model.turned(x), rotate_about_line(model.points, axis, model.turn_rad), atol=1e-12)
    assert isinstance(axis, Line)


def test_points_on_the_circles_have_no_distance() -> None:
    circle = np.arange(8) % 4
    azimuth = np.linspace(0, 5, 8)
    points = np.array(
        [
            c.centre + c.radius * np.array([np.cos(a), np.sin(a), 0.0])
            for c, a in zip((ARTIFACT.edge_circles_part()[h] for h in circle), azimuth, strict=True)
        ]
    )
    model = circle_model(points, np.zeros(8), np.zeros(8, dtype=int), np.arange(8), circle, ARTIFACT)
    np.testing.assert_allclose(model.residuals(np.zeros(model.n_unknowns)), 0.0, atol=1e-12)
    outside = circle_model(points * [2, 2, 1], np.zeros(8), np.zeros(8, dtype=int), np.arange(8), circle, ARTIFACT)
    np.testing.assert_allclose(outside.residuals(np.zeros(11))[:, 0], model.radii[circle], atol=1e-12)
