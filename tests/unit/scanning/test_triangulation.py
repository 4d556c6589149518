from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.calibration.model import AngleError, SystemCalibration, TableMotion
from rotaline.geometry.primitives import Line, Plane, SheetCurvature, unit
from rotaline.geometry.transforms import rotate_about_line
from rotaline.scanning.cloud import read_angles_rad
from rotaline.scanning.triangulation import move_to_axis, scan_cloud, triangulate
from rotaline.vision.camera import CameraModel
from rotaline.vision.stripe.model import StripePoints

CAMERA = CameraModel((1280, 960), 2400.0, 2400.0, 640.0, 480.0, -0.11, 0.09, 6e-4, -4e-4)
AXIS = Line(np.array([2.0, 20.0, 290.0]), unit(np.array([0.02, -0.8, -0.6])))
NORMAL = unit(np.array([0.8, -0.3, 0.5]))
PLANE = Plane(NORMAL, float(-NORMAL @ (AXIS.point + 10 * AXIS.direction)))


def _system(sense):
    return SystemCalibration(CAMERA, PLANE, AXIS, sense, table_seen=False)


def _stripe(uv, u=0.05):
    n = len(uv)
    normal = np.tile([1.0, 0.0], (n, 1))
    full = np.ones(n)
    return StripePoints(uv, normal, 2 * full, 100 * full, u * full, np.zeros(n, bool), np.zeros(n, int))


def _seen(points_camera):
    """Points of the laser plane, and their images."""
    on_plane = points_camera - PLANE.signed_distance_to(points_camera)[:, None] * PLANE.normal
    return on_plane, CAMERA.project(on_plane)


@settings(deadline=None, max_examples=30)
@given(u=st.floats(100, 1180), v=st.floats(100, 860))
def test_a_triangulated_point_lies_on_the_plane_and_on_its_ray(u, v):
    uv = np.array([[u, v]])
    point = triangulate(uv, CAMERA, PLANE)
    assert abs(PLANE.signed_distance_to(point)[0]) < 1e-9
    assert CAMERA.project(point) == pytest.approx(uv, abs=1e-7)


@pytest.mark.parametrize("sense", [1, -1])
def test_a_point_fixed_to_the_table_comes_back_to_one_place(sense):
    """A ring about the axis crosses the laser plane at different table angles; turned back, each is where it started."""
    start, _ = _seen(AXIS.point + np.array([[12.0, 3.0, -8.0]]))
    angles = np.radians([0.0, 30.0, 250.0])
    # the point of the table that the laser meets at each angle is another one: put it there by turning it the other way
    fixed = [rotate_about_line(start, AXIS, -sense * a) for a in angles]
    _, uv = _seen(start)
    cloud = scan_cloud([_stripe(uv)] * 3, angles, _system(sense))
    base_from_camera = _system(sense).base_from_camera
    for k in range(3):
        assert cloud.points_table[k] == pytest.approx(base_from_camera.apply(fixed[k])[0], abs=1e-8)
    assert cloud.angle_rad == pytest.approx(sense * angles)
    assert list(cloud.frame) == [0, 1, 2]


def test_the_stated_uncertainty_is_the_scatter_of_repeats():
    rng = np.random.default_rng(1)
    _, uv = _seen(AXIS.point + np.array([[5.0, 5.0, -5.0]]))
    sigma = 0.05
    noisy = uv + np.outer(rng.normal(0, sigma, 2000), [1.0, 0.0])
    points = triangulate(noisy, CAMERA, PLANE)
    scatter = np.sqrt(np.sum(np.var(points, axis=0)))
    cloud = scan_cloud([_stripe(uv, sigma)], np.zeros(1), _system(1))
    assert cloud.u_mm[0] == pytest.approx(scatter, rel=4 / np.sqrt(2 * 2000))


def test_empty_frames_keep_their_number():
    _, uv = _seen(AXIS.point + np.array([[5.0, 5.0, -5.0]]))
    nothing = _stripe(np.empty((0, 2)))
    cloud = scan_cloud([nothing, _stripe(uv), nothing], np.zeros(3), _system(1))
    assert list(cloud.frame) == [1]
    assert len(scan_cloud([nothing], np.zeros(1), _system(1))) == 0


@pytest.mark.parametrize("sense", [1, -1])
def test_an_error_of_the_read_out_is_taken_off_before_the_sense(sense):
    _, uv = _seen(AXIS.point + np.array([[12.0, 3.0, -8.0]]))
    error = AngleError(2e-3, -1e-3)
    read = np.radians([20.0, 130.0, 250.0])
    turned = read + 2e-3 * np.cos(read) - 1e-3 * np.sin(read)
    stripes = [_stripe(uv)] * 3
    cloud = scan_cloud(stripes, read, replace(_system(sense), angle_error=error))
    assert cloud.points_table == pytest.approx(scan_cloud(stripes, turned, _system(sense)).points_table, abs=1e-12)
    assert cloud.angle_rad == pytest.approx(sense * turned, abs=1e-15)
    assert read_angles_rad(cloud.angle_rad, sense, error) == pytest.approx(read, abs=1e-14)


def test_a_curved_sheet_gives_other_points_and_their_uncertainty():
    _, uv = _seen(AXIS.point + np.random.default_rng(6).normal(0, 8, (20, 3)))
    curvature = SheetCurvature(AXIS.point, (2e-4, 1e-4, -1e-4))
    system = replace(_system(1), laser_curvature=curvature)
    cloud = scan_cloud([_stripe(uv)], np.zeros(1), system)
    points = system.base_from_camera.inv().apply(cloud.points_table)
    assert CAMERA.project(points) == pytest.approx(uv, abs=1e-7)
    off_plane = PLANE.signed_distance_to(points)
    assert np.abs(off_plane).max() > 1e-3
    ahead, behind = (triangulate(uv + side, CAMERA, PLANE, curvature) for side in ([[0.5, 0.0]], [[-0.5, 0.0]]))
    assert cloud.u_mm == pytest.approx(0.05 * np.linalg.norm(ahead - behind, axis=1))


MOTION = TableMotion((0.02, -0.03), (2e-4, 3e-4), AXIS.point)


@pytest.mark.parametrize(
    ("old_error", "new_error", "old_motion", "new_motion"),
    [
        (AngleError(), AngleError(), None, None),
        (AngleError(4e-3, 3e-3), AngleError(), MOTION, None),
        (AngleError(0.0, 2e-3), AngleError(1e-3, 0.0), None, MOTION),
    ],
)
def test_moving_a_cloud_to_another_axis_is_scanning_with_that_axis(old_error, new_error, old_motion, new_motion):
    rng = np.random.default_rng(2)
    _, uv = _seen(AXIS.point + rng.normal(0, 8, (20, 3)))
    stripes, angles = [_stripe(uv), _stripe(uv)], np.array([0.3, 4.0])
    other = SystemCalibration(
        CAMERA,
        PLANE,
        Line(AXIS.point + np.array([0.3, 0.1, -0.2]), unit(AXIS.direction + np.array([0.01, 0.0, 0.0]))),
        -1,
        table_seen=False,
        angle_error=new_error,
        table_motion=new_motion,
    )
    old = replace(_system(1), angle_error=old_error, table_motion=old_motion)
    direct = scan_cloud(stripes, angles, other)
    moved = move_to_axis(scan_cloud(stripes, angles, old), old, other)
    assert moved.points_table == pytest.approx(direct.points_table, abs=1e-9)
    assert moved.viewpoints_table == pytest.approx(direct.viewpoints_table, abs=1e-9)
    assert moved.angle_rad == pytest.approx(direct.angle_rad)
