import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from rotaline.vision.targets.centres import refine_centres

SIZE = 60


def corner(centre: np.ndarray, edges: np.ndarray, blur: float = 0.8) -> np.ndarray:
    """A blurred corner with the given edge directions."""
    v, u = np.mgrid[0:SIZE, 0:SIZE]
    d = np.stack([u - centre[0], v - centre[1]], axis=-1) @ np.linalg.inv(edges).T
    across = 1.0 / np.linalg.norm(np.linalg.inv(edges), axis=1)
    wave = (2 * ndtr(d[..., 0] * across[0] / blur) - 1) * (2 * ndtr(d[..., 1] * across[1] / blur) - 1)
    return 100.0 + 60.0 * wave


def disc(centre: np.ndarray, axes: np.ndarray, blur: float = 0.8) -> np.ndarray:
    """A blurred ellipse with the given conjugate half diameters."""
    v, u = np.mgrid[0:SIZE, 0:SIZE]
    d = np.stack([u - centre[0], v - centre[1]], axis=-1) @ np.linalg.inv(axes).T
    radius = np.linalg.norm(d, axis=-1)
    slope = np.linalg.norm(d @ np.linalg.inv(axes), axis=-1) / np.maximum(radius, 1e-9)
    return 150.0 - 120.0 * ndtr((1 - radius) / np.maximum(slope, 1e-9) / blur)


def axes_of(angle: float, skew: float, length: float) -> np.ndarray:
    a = np.array([np.cos(angle), np.sin(angle)])
    b = np.array([np.cos(angle + skew), np.sin(angle + skew)])
    return np.stack([a, b], axis=1) * length


where = st.tuples(st.floats(28.0, 31.0), st.floats(28.0, 31.0)).map(np.array)
off = st.tuples(st.floats(-0.7, 0.7), st.floats(-0.7, 0.7)).map(np.array)


@settings(max_examples=40, deadline=None)
@given(centre=where, start=off, angle=st.floats(0.0, 6.28), skew=st.floats(0.9, 2.2))
def test_corners_are_found(centre, start, angle, skew):
    edges = axes_of(angle, skew, 1.0)
    found = refine_centres(corner(centre, edges), (centre + start)[None], 12.0 * edges[None], None, "corner")
    assert np.abs(found.uv[0] - centre).max() < 0.003  # what sampling at whole pixels leaves of a blur of 0.8 px
    assert found.agreement[0] > 0.8


@settings(max_examples=40, deadline=None)
@given(centre=where, start=off, angle=st.floats(0.0, 6.28), skew=st.floats(1.0, 2.1), radius=st.floats(5.0, 9.0))
def test_dots_are_found(centre, start, angle, skew, radius):
    axes = axes_of(angle, skew, radius)
    found = refine_centres(disc(centre, axes), (centre + start)[None], 1.6 * axes[None], None, "dot", 1 / 1.6)
    assert np.abs(found.uv[0] - centre).max() < 0.003
    assert found.agreement[0] < -0.8
    assert np.sqrt(found.filled[0] / np.pi) == pytest.approx(1 / 1.6, rel=0.05)


@settings(max_examples=20, deadline=None)
@given(gradient=st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)), scale=st.floats(0.1, 3.0))
def test_uneven_light_does_not_move_centres(gradient, scale):
    centre, edges = np.array([29.3, 30.6]), axes_of(0.4, 1.5, 1.0)
    v, u = np.mgrid[0:SIZE, 0:SIZE]
    light = 1.0 + gradient[0] * (u - 30) + gradient[1] * (v - 30)
    found = refine_centres(scale * light * corner(centre, edges), centre[None], 12.0 * edges[None], None, "corner")
    assert np.abs(found.uv[0] - centre).max() < 0.005


def test_centres_move_with_the_image():
    centre, edges = np.array([29.3, 30.6]), axes_of(0.4, 1.5, 1.0)
    image = corner(centre, edges) + np.random.default_rng(0).normal(0, 2, (SIZE, SIZE))
    here = refine_centres(image, centre[None], 12.0 * edges[None], None, "corner")
    moved = refine_centres(np.roll(image, (3, -2), (0, 1)), centre[None] + (-2, 3), 12.0 * edges[None], None, "corner")
    np.testing.assert_allclose(moved.uv - here.uv, [[-2.0, 3.0]], atol=1e-9)


def test_what_cannot_be_refined_is_nan():
    edges = axes_of(0.0, np.pi / 2, 12.0)
    uv = np.array([[30.0, 30.0], [3.0, 30.0], [30.0, 58.0]])
    image = corner(np.array([30.0, 30.0]), edges / 12)
    found = refine_centres(image, uv, np.repeat(edges[None], 3, axis=0), None, "corner")
    assert np.isfinite(found.uv).all(axis=1).tolist() == [True, False, False]
    empty = refine_centres(image, np.zeros((0, 2)), np.zeros((0, 2, 2)), None, "corner")
    assert len(empty.uv) == 0
