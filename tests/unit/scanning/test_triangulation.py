from dataclasses import fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.calibration.model import AngleError, SystemCalibration, SystemCovariance, TableMotion
from rotaline.errors import GeometryError
from rotaline.geometry.primitives import Line, Plane, SheetCurvature, unit
from rotaline.geometry.transforms import rotate_about_line
from rotaline.scanning.cloud import read_angles_rad
from rotaline.scanning.table_pose import table_from_base
from rotaline.scanning.triangulation import move_to_axis, scan_points, triangulate
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
    cloud = scan_points([_stripe(uv)] * 3, angles, _system(sense))
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
    cloud = scan_points([_stripe(uv, sigma)], np.zeros(1), _system(1))
    assert cloud.u_mm[0] == pytest.approx(scatter, rel=4 / np.sqrt(2 * 2000))


@pytest.mark.parametrize("sense", [1, -1])
def test_an_uncertain_angle_is_in_the_uncertainty_of_points_as_far_as_they_are_from_the_axis(sense):
    rng = np.random.default_rng(2)
    _, uv = _seen(AXIS.point + np.array([[5.0, 5.0, -5.0], [22.0, 4.0, -15.0], [0.4, 0.1, -0.3]]))
    sigma_px, sigma_rad, n = 0.02, 3e-4, 2000
    angles = 1.0 + rng.normal(0, sigma_rad, n)
    noisy = [_stripe(uv + np.outer(rng.normal(0, sigma_px, 3), [1.0, 0.0])) for _ in range(n)]
    points = scan_points(noisy, angles, _system(sense)).points_table.reshape(n, 3, 3)
    scatter = np.sqrt(np.sum(np.var(points, axis=0), axis=1))
    stated = scan_points([_stripe(uv, sigma_px)], np.ones(1), _system(sense), u_angles_rad=np.array([sigma_rad]))
    assert stated.u_mm == pytest.approx(scatter, rel=4 / np.sqrt(2 * n))
    without = scan_points([_stripe(uv, sigma_px)], np.ones(1), _system(sense))
    radius = np.hypot(*stated.points_table[:, :2].T)
    assert np.sqrt(stated.u_mm**2 - without.u_mm**2) == pytest.approx(sigma_rad * radius)
    assert (stated.u_mm / without.u_mm).max() > 1.1


def test_angles_of_which_nothing_is_stated_change_nothing():
    _, uv = _seen(AXIS.point + np.random.default_rng(3).normal(0, 5, (30, 3)))
    stripes, angles = [_stripe(uv)] * 70, np.linspace(0, 6, 70)
    plain = scan_points(stripes, angles, _system(1))
    same = scan_points(stripes, angles, _system(1), u_angles_rad=np.zeros(70))
    one = scan_points(stripes, angles, _system(1), u_angles_rad=np.where(np.arange(70) == 66, 1e-3, 0.0))
    for field in fields(plain):
        assert np.array_equal(getattr(plain, field.name), getattr(same, field.name), equal_nan=True)
    assert ((one.u_mm != plain.u_mm) == (plain.frame == 66)).all()


def test_empty_frames_keep_their_number():
    _, uv = _seen(AXIS.point + np.array([[5.0, 5.0, -5.0]]))
    nothing = _stripe(np.empty((0, 2)))
    cloud = scan_points([nothing, _stripe(uv), nothing], np.zeros(3), _system(1))
    assert list(cloud.frame) == [1]
    assert len(scan_points([nothing], np.zeros(1), _system(1))) == 0


@pytest.mark.parametrize("sense", [1, -1])
def test_an_error_of_the_read_out_is_taken_off_before_the_sense(sense):
    _, uv = _seen(AXIS.point + np.array([[12.0, 3.0, -8.0]]))
    error = AngleError(2e-3, -1e-3)
    read = np.radians([20.0, 130.0, 250.0])
    turned = read + 2e-3 * np.cos(read) - 1e-3 * np.sin(read)
    stripes = [_stripe(uv)] * 3
    cloud = scan_points(stripes, read, replace(_system(sense), angle_error=error))
    assert cloud.points_table == pytest.approx(scan_points(stripes, turned, _system(sense)).points_table, abs=1e-12)
    assert cloud.angle_rad == pytest.approx(sense * turned, abs=1e-15)
    assert read_angles_rad(cloud.angle_rad, sense, error) == pytest.approx(read, abs=1e-14)


def test_a_curved_sheet_gives_other_points_and_their_uncertainty():
    _, uv = _seen(AXIS.point + np.random.default_rng(6).normal(0, 8, (20, 3)))
    curvature = SheetCurvature(AXIS.point, (2e-4, 1e-4, -1e-4))
    system = replace(_system(1), laser_curvature=curvature)
    cloud = scan_points([_stripe(uv)], np.zeros(1), system)
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
    direct = scan_points(stripes, angles, other)
    moved = move_to_axis(scan_points(stripes, angles, old), old, other)
    assert moved.points_table == pytest.approx(direct.points_table, abs=1e-9)
    assert moved.viewpoints_table == pytest.approx(direct.viewpoints_table, abs=1e-9)
    assert moved.angle_rad == pytest.approx(direct.angle_rad)


WIDE = CameraModel((1280, 960), 700.0, 705.0, 640.0, 480.0, -0.3, 0.12, 2e-3, -1e-3, -0.02)
BOW = SheetCurvature(AXIS.point, (2e-4, 1e-4, -1e-4))


def _frames(n_frames, seed=0):
    """Stripes of all lengths, none among them, all over the image and beyond its borders, with normals in all directions."""
    rng = np.random.default_rng(seed)
    stripes = []
    for n in rng.integers(0, 300, n_frames) * (rng.random(n_frames) > 0.1):
        turn = rng.uniform(0, 2 * np.pi, n)
        stripe = _stripe(rng.uniform([-300, -300], [1580, 1260], (n, 2)))
        normal, u_px = np.column_stack([np.cos(turn), np.sin(turn)]), rng.uniform(0.02, 0.1, n)
        stripes.append(replace(stripe, normal=normal, u_normal_px=u_px, intensity=rng.uniform(0, 255, n)))
    return stripes, rng.uniform(0, 2 * np.pi, n_frames)


def _with_covariance(system):
    names = ("fx", "cx", "k1", "plane_turn_1", "plane_offset", "axis_turn_x", "axis_shift_y", "angle_cos", "run_out_x")
    sizes = np.array([1.0, 1.0, 1e-3, 1e-4, 1e-2, 1e-4, 1e-2, 1e-4, 1e-3])
    return replace(system, covariance=SystemCovariance(names, np.diag(sizes**2), AXIS.point, AXIS.point))


def _plain(stripes, angles, system):
    """The points of all frames by plain NumPy, and their uncertainty from small moves of the pixel; NaN where these are not small enough."""
    sheet = (system.camera, system.laser_plane_camera, system.laser_curvature)
    points_table, eyes_table, u_mm, frames = [], [], [], []
    turned_rad = system.turn_sense * system.angle_error.turned_rad(angles)
    for frame, (stripe, angle) in enumerate(zip(stripes, turned_rad, strict=True)):
        points_camera = triangulate(stripe.uv, *sheet)
        good = np.isfinite(points_camera).all(axis=1)
        points_base = system.base_from_camera.apply(points_camera[good])
        points_table.append(table_from_base(points_base, float(angle), system))
        eyes_base = system.base_from_camera.apply(np.zeros((len(points_base), 3)))
        eyes_table.append(table_from_base(eyes_base, float(angle), system))
        once, twice = (
            (triangulate(stripe.uv + h * stripe.normal, *sheet) - triangulate(stripe.uv - h * stripe.normal, *sheet))
            / h
            for h in (0.01, 0.02)
        )
        slope = np.where(np.abs(once - twice) < 1e-4 * np.abs(once), (4 * once - twice) / 3, np.nan)
        u_mm.append((np.linalg.norm(slope, axis=1) / 2 * stripe.u_normal_px)[good])
        frames.append(np.full(np.count_nonzero(good), frame))
    return np.vstack(points_table), np.vstack(eyes_table), np.concatenate(u_mm), np.concatenate(frames)


@pytest.mark.parametrize("motion", [None, MOTION], ids=["steady axis", "moving axis"])
@pytest.mark.parametrize("curvature", [None, BOW], ids=["flat", "curved"])
@pytest.mark.parametrize("camera", [CAMERA, WIDE], ids=["usual lens", "wide lens"])
def test_compiled_points_are_the_plain_ones(camera, curvature, motion):
    """Beyond the fold of the wide lens, and where rays graze or miss the sheet, there are none in both."""
    system = replace(_system(-1), camera=camera, laser_curvature=curvature, table_motion=motion)
    system = replace(system, angle_error=AngleError(3e-3, -2e-3))
    stripes, angles = _frames(12)
    points_table, eyes_table, u_mm, frame = _plain(stripes, angles, system)
    cloud = scan_points(stripes, angles, system)
    assert (cloud.frame == frame).all()
    assert (len(cloud) < sum(map(len, stripes))) == (camera is WIDE)
    reach_mm = 300.0 + np.linalg.norm(points_table, axis=1)
    assert (np.linalg.norm(cloud.points_table - points_table, axis=1) / reach_mm).max() < 1e-12
    assert np.abs(cloud.viewpoints_table - eyes_table).max() < 1e-11
    known = np.isfinite(u_mm)
    assert known.mean() > 0.9
    assert cloud.u_mm[known] == pytest.approx(u_mm[known], rel=1e-6)


@pytest.mark.parametrize("length", [1, 7, 70])
def test_ranges_of_frames_make_the_same_cloud_to_the_last_bit(length):
    stripes, angles = _frames(90, seed=3)
    system = _with_covariance(replace(_system(1), camera=WIDE, laser_curvature=BOW, table_motion=MOTION))
    other = replace(system, rotation_axis_camera=Line(AXIS.point + 0.3, AXIS.direction), turn_sense=-1)
    whole = scan_points(stripes, angles, system)
    parts = [
        scan_points(stripes[k : k + length], angles[k : k + length], system, first_frame=k)
        for k in range(0, len(stripes), length)
    ]
    for make in (lambda cloud: cloud, lambda cloud: move_to_axis(cloud, system, other)):
        together, apart = make(whole), [make(part) for part in parts]
        for field in fields(whole):
            values = getattr(together, field.name)
            assert np.array_equal(values, np.concatenate([getattr(part, field.name) for part in apart])), field.name


def test_a_scan_of_a_plane_seen_edge_on_or_without_an_angle_for_each_frame_is_refused():
    stripes, angles = _frames(3)
    with pytest.raises(GeometryError, match="edge-on"):
        scan_points(stripes, angles, replace(_system(1), laser_plane_camera=Plane(NORMAL, 0.0)))
    with pytest.raises(ValueError, match="3 stripes, but 2 angles"):
        scan_points(stripes, angles[:2], _system(1))
    assert len(scan_points([], np.empty(0), _with_covariance(replace(_system(1), table_motion=MOTION)))) == 0
