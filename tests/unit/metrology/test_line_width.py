"""A stripe on a ball, put together from the light of a sheet with a width, blurred, gathered and centred: where it is seen, and that it is moved back."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.model import SystemCalibration, TableMotion
from rotaline.geometry.intersect import intersect_rays_with_plane
from rotaline.geometry.primitives import unit
from rotaline.io.session_file import MeasurementRequest
from rotaline.metrology.features import MeasureOptions
from rotaline.metrology.line_width import moves_back
from rotaline.pipeline.parts import measure_request
from rotaline.scanning.table_pose import directions_base_from_table, table_from_base
from rotaline.scanning.triangulation import scan_points
from rotaline.simulation.ideal.observed_scan import trace_scan
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.parts.shapes import SteppedRod
from rotaline.simulation.plan import mount, table_disc
from rotaline.simulation.rig import build_rig
from rotaline.simulation.small_session import BALL, STEPPED_CYLINDER

RIG = build_rig((640, 480))
SYSTEM = SystemCalibration(RIG.camera, RIG.laser_plane_camera, RIG.rotation_axis_camera, RIG.turn_sense, True)
RADIUS = 14.0
CENTRE_TABLE = np.array([1.5, -2.0, 14.0])
ANGLE_RAD = 0.7
"""A ball on the table, which has turned."""

_FINE = 8
_HALF_PX = 8


def _camera_from_table():
    return SYSTEM.base_from_camera.inv() * RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, ANGLE_RAD]))


def _seen_on_ball(uv, centre):
    """Where viewing rays meet the ball first, camera frame."""
    rays = SYSTEM.camera.rays(uv)
    rays = rays / np.linalg.norm(rays, axis=1)[:, None]
    middle = rays @ centre
    return rays * (middle - np.sqrt(middle**2 - centre @ centre + RADIUS**2))[:, None]


def _points_of_the_stripe(centre):
    """Points where sheet and ball meet and both can be seen, camera frame, and the directions of the stripe there."""
    plane = SYSTEM.laser_plane_camera
    off = plane.signed_distance_to(centre[None])[0]
    middle, r = centre - off * plane.normal, np.sqrt(RADIUS**2 - off**2)
    up = SYSTEM.rotation_axis_camera.direction
    e1 = unit(up - (up @ plane.normal) * plane.normal)
    e2 = np.cross(plane.normal, e1)
    e2 = e2 if e2 @ centre < 0 else -e2
    angles = np.deg2rad([10.0, 25.0, 45.0, 65.0])[:, None]
    points = middle + r * (np.sin(angles) * e1 + np.cos(angles) * e2)
    return points, np.cos(angles) * e1 - np.sin(angles) * e2


def _centre_of_stripe(uv, normal, centre, sigma_mm, blur_px, window):
    """Offset along the normal of the centre under a Gaussian of ``window`` stripe widths, px; from a finely drawn image."""
    n = 2 * _HALF_PX * _FINE + 1
    steps = (np.arange(n) - n // 2) / _FINE
    tangent = np.array([-normal[1], normal[0]])
    s, q = np.meshgrid(steps, steps)
    at = uv + s.reshape(-1, 1) * normal + q.reshape(-1, 1) * tangent
    off = SYSTEM.laser_plane_camera.signed_distance_to(_seen_on_ball(at, centre)).reshape(n, n)
    light = gaussian_filter(np.exp(-0.5 * (off / sigma_mm) ** 2), blur_px * _FINE, truncate=6.0)
    profile = np.maximum(1.0 - np.abs(steps), 0.0) @ light
    shift = 0.0
    width = np.sqrt(np.sum(profile * steps**2) / profile.sum())
    for _ in range(60):
        weight = profile * np.exp(-0.5 * ((steps - shift) / (window * width)) ** 2)
        moved = weight @ steps / weight.sum()
        spread = weight @ (steps - moved) ** 2 / weight.sum()
        shift += (1.0 + 1.0 / window**2) * (moved - shift)
        width = np.sqrt(1.0 / (1.0 / spread - 1.0 / (window * width) ** 2))
    return shift


@pytest.mark.parametrize(("sigma_mm", "blur_px"), [(0.15, 0.3), (0.15, 1.0), (0.05, 1.2), (0.25, 0.6)])
def test_points_are_moved_back_onto_the_ball(sigma_mm, blur_px):
    camera_from_table = _camera_from_table()
    centre = camera_from_table.apply(CENTRE_TABLE)
    points, tangents = _points_of_the_stripe(centre)
    uv = SYSTEM.camera.project(points)
    along = SYSTEM.camera.project(points + 1e-4 * tangents) - uv
    normals_px = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
    off = []
    for window in (1.0, 2.0):
        shift = np.array(
            [_centre_of_stripe(*at, centre, sigma_mm, blur_px, window) for at in zip(uv, normals_px, strict=True)]
        )
        rays = SYSTEM.camera.rays(uv + shift[:, None] * normals_px)
        seen = intersect_rays_with_plane(rays, SYSTEM.laser_plane_camera)
        off.append(np.linalg.norm(seen - centre, axis=1) - RADIUS)
    outward = (seen - centre) / np.linalg.norm(seen - centre, axis=1)[:, None]
    off = np.array(off)
    assert (off < -2e-4).all()

    table = camera_from_table.inv()
    system = replace(SYSTEM, line_sigma_mm=sigma_mm, stripe_blur_px=blur_px)
    n = len(seen)
    moves = moves_back(
        table.apply(seen),
        np.full(n, ANGLE_RAD),
        table.rotation.apply(outward),
        np.full(n, 1.0 / RADIUS),
        np.zeros((n, 3)),
        system,
    )
    along_normal = np.sum(moves * table.rotation.apply(outward), axis=1)
    assert along_normal == pytest.approx(-off.mean(axis=0), rel=0.01)
    assert np.abs(along_normal / -off - 1.0).max() < 0.25
    plane = SYSTEM.laser_plane_camera
    assert np.abs(camera_from_table.rotation.apply(moves) @ plane.normal).max() < 1e-12


def test_the_same_points_in_front_of_the_camera_are_moved_back_alike_whatever_the_axis_did():
    centre = _camera_from_table().apply(CENTRE_TABLE)
    points, _ = _points_of_the_stripe(centre)
    base_from_camera, n = SYSTEM.base_from_camera, len(points)
    outward_base = base_from_camera.rotation.apply((points - centre) / RADIUS)
    angles = ANGLE_RAD + np.arange(n)
    moves_base = []
    for motion in (None, TableMotion((0.5, -0.3), (0.02, 0.03), RIG.rotation_axis_camera.point)):
        system = replace(SYSTEM, line_sigma_mm=0.15, stripe_blur_px=0.5, table_motion=motion)
        rotation = directions_base_from_table(angles, system)
        points_table = table_from_base(base_from_camera.apply(points), angles, system)
        normals_table = rotation.inv().apply(outward_base)
        moves = moves_back(points_table, angles, normals_table, np.full(n, 1.0 / RADIUS), np.zeros((n, 3)), system)
        moves_base.append(rotation.apply(moves))
    assert np.abs(moves_base[0]).max() > 1e-3
    assert moves_base[1] == pytest.approx(moves_base[0], abs=1e-10)


def _measured(part, feature, nominal, system):
    angles = tuple(15.0 * i for i in range(24))
    scan = trace_scan(RIG, [Placed(part, mount(2.0, -1.0)), table_disc(RIG)], angles, spacing_px=3.0)
    request = MeasurementRequest(capture="scan", feature=feature, nominal=nominal)
    cloud = scan_points(scan.observed(0.02, 1), scan.angles_rad, system)
    return measure_request(request, cloud, MeasureOptions(), system).measurement


SIZES = {
    "diameter_small": STEPPED_CYLINDER.diameter_small,
    "diameter_large": STEPPED_CYLINDER.diameter_large,
    "height_small": STEPPED_CYLINDER.height_small,
    "height_large": STEPPED_CYLINDER.height_large,
}


def test_each_side_of_a_stepped_cylinder_by_its_own_radius_and_no_height():
    measured = _measured(SteppedRod(STEPPED_CYLINDER), "stepped-cylinder", SIZES, replace(SYSTEM, line_sigma_mm=0.1))
    correction = measured.line_width_correction
    assert set(measured.value) == set(SIZES)
    assert set(correction) == {"diameter_small", "diameter_large"}
    ratio = STEPPED_CYLINDER.diameter_large / STEPPED_CYLINDER.diameter_small
    assert correction["diameter_small"] / correction["diameter_large"] == pytest.approx(ratio, rel=0.1)
    assert correction["diameter_large"] > 1e-4


@pytest.fixture(scope="module")
def ball_as_fitted():
    return _measured(BALL, "sphere", BALL.sizes(), SYSTEM)


def test_without_a_known_width_nothing_is_corrected(ball_as_fitted):
    plain = ball_as_fitted
    assert plain.line_width_correction == {}
    corrected = _measured(BALL, "sphere", BALL.sizes(), replace(SYSTEM, line_sigma_mm=0.1, stripe_blur_px=0.8))
    added = corrected.line_width_correction["diameter"]
    assert added > 1e-3
    assert corrected.value["diameter"] == plain.value["diameter"] + added
    assert corrected.geometry == plain.geometry


def test_what_is_unknown_of_the_correction_joins_the_calibration_only_where_that_is_known(ball_as_fitted):
    plain = ball_as_fitted
    u = plain.u_scatter["diameter"]
    corrected = plain.with_calibration({"diameter": 0.003}).with_line_width({"diameter": 0.016}, 0.25)
    assert corrected.u_calibration["diameter"] == pytest.approx(0.005)
    assert corrected.uncertainty["diameter"] == pytest.approx(np.hypot(u, 0.005))
    unknown = plain.with_line_width({"diameter": 0.016}, 0.25)
    assert unknown.u_calibration == {}
    assert unknown.uncertainty == plain.uncertainty
