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


def _plain_undistort(camera, xy_distorted):
    """Newton's method on all points at once, with the camera's own distortion and derivative."""
    xy = xy_distorted.copy()
    with np.errstate(all="ignore"):
        for _ in range(50):
            step = np.linalg.solve(camera.distort_jacobian(xy), (camera.distort(xy) - xy_distorted)[:, :, None])
            xy = xy - step[:, :, 0]
        jacobian = camera.distort_jacobian(xy)
        good = np.linalg.norm(camera.distort(xy) - xy_distorted, axis=1) < 1e-10
    good &= (np.linalg.det(jacobian) > 0) & (np.trace(jacobian, axis1=1, axis2=2) > 0)
    return np.where(good[:, None], xy, np.nan)


DISTORTIONS = {
    "none": (0.0, 0.0, 0.0, 0.0, 0.0),
    "usual": (-0.11, 0.09, 6e-4, -4e-4, 0.0),
    "barrel": (-0.3, 0.12, 5e-3, -4e-3, -0.02),
    "fold": (-0.5, 0.0, 0.0, 0.0, 0.0),
    "turning back": (0.54, -0.04, -0.06, -0.02, -1.23),
    "pincushion": (0.6, 0.4, -0.02, 0.02, 0.1),
}


@pytest.mark.parametrize("name", DISTORTIONS)
def test_the_compiled_inverse_of_the_distortion_is_the_plain_one(name):
    camera = CameraModel((1280, 960), 500.0, 500.0, 640.0, 480.0, *DISTORTIONS[name])
    xy_distorted = np.random.default_rng(1).uniform(-0.9, 0.9, (2000, 2))
    plain, compiled = _plain_undistort(camera, xy_distorted), camera.undistort(xy_distorted)
    assert compiled == pytest.approx(plain, abs=1e-13, nan_ok=True)
    assert np.isnan(plain).any() == (name in ("barrel", "fold", "turning back"))


def test_what_a_pixel_becomes_does_not_depend_on_the_others_in_the_call():
    camera = CameraModel((1280, 960), 500.0, 500.0, 640.0, 480.0, *DISTORTIONS["fold"])
    xy_distorted = np.random.default_rng(2).uniform(-0.9, 0.9, (200, 2))
    together = camera.undistort(xy_distorted)
    alone = np.vstack([camera.undistort(xy_distorted[k : k + 1]) for k in range(200)])
    assert np.array_equal(together, alone, equal_nan=True)
    assert np.array_equal(together[::-1], camera.undistort(xy_distorted[::-1]), equal_nan=True)
