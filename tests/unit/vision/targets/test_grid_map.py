import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.errors import GeometryError
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.grid_map import fit_grid_map, fit_grid_map_robust, fit_homography
from rotaline.vision.targets.model import Checkerboard

XY = Checkerboard((9, 8), 5.0).points_board()[:, :2]
H = np.array([[3.0, 0.4, 100.0], [-0.3, 2.5, 80.0], [1e-3, -5e-4, 1.0]])


def apply(h, xy):
    q = np.column_stack([xy, np.ones(len(xy))]) @ h.T
    return q[:, :2] / q[:, 2:]


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6),
    st.lists(st.floats(-3e-3, 3e-3), min_size=2, max_size=2),
)
def test_a_homography_is_recovered(affine, perspective):
    h = np.eye(3)
    h[:2] += np.reshape(affine, (2, 3)) * [[0.4, 0.4, 50.0]] * np.array([[1.0], [1.0]])
    h[2, :2] = perspective
    found = fit_homography(XY, apply(h, XY))
    np.testing.assert_allclose(apply(found, XY), apply(h, XY), atol=1e-6)


@pytest.mark.parametrize("xy", [XY[:3], np.zeros((6, 2)), np.column_stack([np.arange(6.0), np.arange(6.0)])])
def test_points_that_fix_no_homography(xy):
    with pytest.raises(GeometryError):
        fit_homography(xy, xy)


def test_lens_distortion_is_followed():
    camera = CameraModel((1280, 960), 1200.0, 1200.0, 640.0, 480.0, k1=-0.2, k2=0.05, p1=1e-3)
    points = np.column_stack([(XY - XY.mean(axis=0)) * 4, 300.0 + XY @ [1.0, -0.7]])
    uv = camera.project(points)
    grid_map, residuals, rms = fit_grid_map(XY, uv)
    assert np.abs(fit_grid_map(XY, uv, max_degree=0)[1]).max() > 1.0  # a homography alone does not do
    assert rms < 0.02
    np.testing.assert_allclose(grid_map.apply(XY), uv - residuals, atol=1e-9)


def test_derivatives_are_those_of_the_map():
    uv = apply(H, XY) + 1e-4 * (apply(H, XY) - 150.0) ** 2
    grid_map = fit_grid_map(XY, uv)[0]
    step = 1e-4
    for b, unit in enumerate(np.eye(2) * step):
        numeric = (grid_map.apply(XY + unit) - grid_map.apply(XY - unit)) / (2 * step)
        np.testing.assert_allclose(grid_map.jacobian(XY)[:, :, b], numeric, atol=1e-6)
        numeric = (grid_map.jacobian(XY + unit) - grid_map.jacobian(XY - unit)) / (2 * step)
        np.testing.assert_allclose(grid_map.bend(XY, 0.5)[:, :, :, b], numeric, atol=1e-4)


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 1000), wrong=st.integers(0, 6))
def test_wrong_points_are_left_out(seed, wrong):
    rng = np.random.default_rng(seed)
    uv = apply(H, XY) + rng.normal(0, 0.01, XY.shape)
    which = rng.choice(len(XY), wrong, replace=False)
    uv[which] += rng.uniform(0.5, 3.0, (wrong, 1)) * np.array([0.6, -0.8])
    _, kept, rms = fit_grid_map_robust(XY, uv, floor_px=0.08)
    assert not kept[which].any()
    assert kept.sum() == len(XY) - wrong
    assert 0.006 < rms < 0.016
