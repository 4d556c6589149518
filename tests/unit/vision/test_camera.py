import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.vision.camera import CameraModel

CAMERA = CameraModel((1280, 960), 2400.0, 2390.0, 640.0, 470.0, -0.11, 0.09, 6e-4, -4e-4)


@settings(deadline=None, max_examples=50)
@given(u=st.floats(0, 1279), v=st.floats(0, 959), depth=st.floats(10, 5000))
def test_projecting_a_point_on_the_ray_gives_the_pixel_back(u, v, depth):
    uv = np.array([[u, v]])
    assert CAMERA.project(depth * CAMERA.rays(uv)) == pytest.approx(uv, abs=1e-8)


def test_undistorted_pixels_of_a_camera_without_distortion_are_the_pixels():
    uv = np.array([[0.0, 0.0], [100.25, 700.5]])
    assert CameraModel((1280, 960), 800.0, 800.0, 640.0, 480.0).undistort_pixels(uv) == pytest.approx(uv, abs=1e-11)


def test_points_behind_the_camera_have_no_image():
    assert np.isnan(CAMERA.project(np.array([[0.0, 0.0, -100.0], [0.0, 0.0, 0.0]]))).all()


def test_a_pixel_beyond_the_fold_of_the_distortion_has_no_ray():
    folded = CameraModel((1280, 960), 500.0, 500.0, 640.0, 480.0, k1=-0.5)
    rays = folded.rays(np.array([[640.0, 480.0], [1270.0, 950.0]]))
    assert np.isfinite(rays[0]).all()
    assert np.isnan(rays[1, :2]).all()


def test_the_derivative_of_the_distortion_matches_differences():
    xy = np.array([[0.2, -0.15], [0.0, 0.0], [-0.25, 0.1]])
    step = 1e-6
    camera = CameraModel((10, 10), 1.0, 1.0, 0.0, 0.0, -0.2, 0.1, 1e-3, -2e-3, 0.05)
    for axis in (0, 1):
        shift = np.zeros(2)
        shift[axis] = step
        slope = (camera.distort(xy + shift) - camera.distort(xy - shift)) / (2 * step)
        assert camera.distort_jacobian(xy)[:, :, axis] == pytest.approx(slope, abs=1e-8)


def test_equation_2_by_hand():
    camera = CameraModel((10, 10), 1.0, 1.0, 0.0, 0.0, 0.1, 0.01, 0.02, 0.03)
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    expected_x = x * (1 + 0.1 * r2 + 0.01 * r2**2) + 2 * 0.02 * x * y + 0.03 * (r2 + 2 * x * x)
    expected_y = y * (1 + 0.1 * r2 + 0.01 * r2**2) + 0.02 * (r2 + 2 * y * y) + 2 * 0.03 * x * y
    assert camera.distort(np.array([[x, y]])) == pytest.approx(np.array([[expected_x, expected_y]]), abs=1e-15)
