"""The small renderer: what is in front is seen, sizes are true, light comes from the viewer's side."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.io.report.raster import View, render_mesh, render_points, view_rotation, views_around

FRONT = View(view_rotation(0.0, 0.0), np.zeros(3), 0.1, (120, 100))
RED, GREEN = np.array([0.9, 0.1, 0.1]), np.array([0.1, 0.9, 0.1])
SQUARE = np.array([[0, 1, 2], [0, 2, 3]])


def square(x: float, half: float) -> np.ndarray:
    """A square facing +x, at a distance x towards the viewer."""
    return np.array([[x, -half, -half], [x, half, -half], [x, half, half], [x, -half, half]])


@settings(deadline=None, max_examples=50)
@given(st.floats(-180, 180), st.floats(-89, 89))
def test_a_view_is_a_rotation_with_z_upwards(azimuth, elevation):
    rotation = view_rotation(azimuth, elevation)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1.0)
    assert rotation[0, 2] == pytest.approx(0.0, abs=1e-12)
    assert rotation[1, 2] > 0.0


def test_the_viewer_at_azimuth_0_sees_y_to_the_right():
    picture = render_points(np.array([[0.0, 4.0, 3.0]]), RED[None], FRONT, 1.5)
    v, u = np.nonzero((picture < 200).any(axis=2))
    assert abs(u.mean() - (60 - 0.5 + 40)) < 1.0
    assert abs(v.mean() - (50 - 0.5 - 30)) < 1.0


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_the_nearer_point_hides_the_farther_one(order):
    points, colours = np.array([[1.0, 0, 0], [-1.0, 0, 0]]), np.stack([RED, GREEN])
    picture = render_points(points[list(order)], colours[list(order)], FRONT, 3.0)
    assert picture[50, 60, 0] > 200 > 60 > picture[50, 60, 1]


def test_a_square_covers_its_area_without_holes():
    picture = render_mesh(square(0.0, 3.0), SQUARE, [FRONT])[0]
    covered = (picture < 250).any(axis=2)
    assert covered.sum() == pytest.approx(60 * 60, rel=0.05)
    assert covered[25:75, 35:85].all()


def test_many_small_triangles_cover_the_same_as_two_large_ones():
    n = 41
    y, z = np.meshgrid(np.linspace(-3, 3, n), np.linspace(-3, 3, n), indexing="ij")
    vertices = np.stack([0 * y, y, z], axis=-1).reshape(-1, 3)
    i, j = (g.ravel() for g in np.meshgrid(np.arange(n - 1), np.arange(n - 1), indexing="ij"))
    a = i * n + j
    triangles = np.concatenate([np.stack([a, a + n, a + n + 1], 1), np.stack([a, a + n + 1, a + 1], 1)])
    fine, coarse = (render_mesh(*mesh, [FRONT])[0] for mesh in ((vertices, triangles), (square(0.0, 3.0), SQUARE)))
    assert np.abs(fine.astype(int) - coarse).max() <= 2


def test_the_nearer_square_hides_the_farther_one_and_its_back_is_brownish():
    near, far = square(2.0, 1.0), square(-2.0, 3.0)
    vertices = np.vstack([near, far])
    turned = SQUARE[:, ::-1]  # the near one is seen from its back
    picture = render_mesh(vertices, np.vstack([turned, SQUARE + 4]), [FRONT])[0].astype(int)
    assert picture[50, 60, 0] > picture[50, 60, 2]
    assert picture[50, 38, 0] < picture[50, 38, 2]


def test_elements_that_are_not_finite_or_out_of_view_are_left_out():
    vertices = np.vstack([square(0.0, 2.0), [[np.nan] * 3], square(0.0, 1.0) + np.array([0, 500.0, 0])])
    triangles = np.vstack([SQUARE, [[0, 1, 4]], SQUARE + 5])
    alone = render_mesh(square(0.0, 2.0), SQUARE, [FRONT])[0]
    np.testing.assert_array_equal(render_mesh(vertices, triangles, [FRONT])[0], alone)
    empty = render_points(np.array([[np.nan, 0, 0], [0, 500.0, 0]]), np.stack([RED, RED]), FRONT)
    assert (empty == 255).all()


def test_a_triangle_without_area_draws_nothing():
    picture = render_mesh(np.array([[0.0, 0, 0], [0, 1, 0], [0, 2, 0]]), np.array([[0, 1, 2]]), [FRONT])[0]
    assert (picture == 255).all()


def test_all_views_share_one_scale_and_hold_all_points():
    points = np.random.default_rng(3).uniform(-1, 1, (500, 3)) * [10.0, 3.0, 6.0] + 50.0
    views = views_around(points, ((0.0, 20.0), (90.0, 20.0), (0.0, 89.0)), (200, 160))
    assert len({v.mm_per_px for v in views}) == 1
    for view in views:
        picture = render_points(points, np.tile(RED, (500, 1)), view, 1.0)
        frame = np.ones((160, 200), bool)
        frame[2:-2, 2:-2] = False
        assert (picture[frame] == 255).all()


def test_a_single_far_outlier_does_not_shrink_the_picture():
    points = np.random.default_rng(3).uniform(-5, 5, (2000, 3))
    (view,) = views_around(points, ((0.0, 0.0),), (200, 160))
    (disturbed,) = views_around(np.vstack([points, [[0, 900.0, 0]]]), ((0.0, 0.0),), (200, 160))
    assert disturbed.mm_per_px == pytest.approx(view.mm_per_px, rel=0.05)
