from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotaline.calibration.model import AngleError, SystemCalibration, SystemCovariance, TableMotion
from rotaline.errors import GeometryError
from rotaline.geometry.fitting import across
from rotaline.geometry.primitives import Line, Plane, SheetCurvature, unit
from rotaline.scanning.propagation import calibration_uncertainty, combination_uncertainty, point_sensitivities
from rotaline.scanning.triangulation import scan_points, triangulate
from rotaline.vision.camera import CameraModel
from rotaline.vision.stripe.model import StripePoints

CAMERA = CameraModel((1280, 960), 2400.0, 2410.0, 640.0, 480.0, -0.11, 0.09, 6e-4, -4e-4, 0.02)
AXIS = Line(np.array([2.0, 20.0, 290.0]), unit(np.array([0.02, -0.8, -0.6])))
NORMAL = unit(np.array([0.8, -0.3, 0.5]))
PLANE = Plane(NORMAL, float(-NORMAL @ (AXIS.point + np.array([1.5, 0.0, 0.0]))))
CURVATURE = SheetCurvature(AXIS.point + 10 * AXIS.direction, (1e-4, -3e-5, 5e-5))
ANGLE_ERROR = AngleError(3e-3, -2e-3)
MOTION = TableMotion((0.02, -0.01), (2e-4, 3e-4), AXIS.point + 7.0 * AXIS.direction)
STEPS = {
    **dict.fromkeys(("fx", "fy", "cx", "cy"), 1e-2),
    "k1": 1e-3,
    **dict.fromkeys(("k2", "k3"), 1e-2),
    **dict.fromkeys(("p1", "p2"), 1e-5),
    **dict.fromkeys(("plane_turn_1", "plane_turn_2", "axis_turn_x", "axis_turn_y", "angle_cos", "angle_sin"), 1e-5),
    **dict.fromkeys(("plane_offset", "axis_shift_x", "axis_shift_y"), 1e-3),
}
CURVED_STEPS = dict.fromkeys(("curvature_uu", "curvature_uv", "curvature_vv"), 1e-6)
MOTION_STEPS = {"run_out_x": 1e-3, "run_out_y": 1e-3, "wobble_x": 1e-4, "wobble_y": 1e-4}
READ_RAD = np.array([0.0, 0.9, 2.5, 4.4])


def _steps(curved, motion):
    return STEPS | (CURVED_STEPS if curved else {}) | (MOTION_STEPS if motion else {})


def _system(sense=1, curved=False, angle_error=ANGLE_ERROR, matrix=None, motion=None):
    steps = _steps(curved, motion)
    matrix = np.diag(np.square(list(steps.values()))) if matrix is None else matrix
    covariance = SystemCovariance(
        tuple(steps), matrix, AXIS.point + np.array([3.0, -2.0, 1.0]), AXIS.point + 7.0 * AXIS.direction
    )
    curvature = CURVATURE if curved else None
    return SystemCalibration(CAMERA, PLANE, AXIS, sense, True, curvature, angle_error, motion, covariance)


def _changed(system, name, step):
    """The system with one parameter changed, in the words of SystemCovariance."""
    covariance, plane, axis = system.covariance, system.laser_plane_camera, system.rotation_axis_camera
    kind, _, which = name.rpartition("_")
    if not kind:
        return replace(system, camera=replace(system.camera, **{name: getattr(system.camera, name) + step}))
    if kind == "angle":
        key = f"{which}_rad"
        return replace(
            system, angle_error=replace(system.angle_error, **{key: getattr(system.angle_error, key) + step})
        )
    if kind == "curvature":
        coefficients = np.array(system.laser_curvature.coefficients)
        coefficients[("uu", "uv", "vv").index(which)] += step
        return replace(system, laser_curvature=replace(system.laser_curvature, coefficients=tuple(coefficients)))
    if kind in ("run_out", "wobble"):
        key = "run_out_mm" if kind == "run_out" else "wobble_rad"
        values = np.array(getattr(system.table_motion, key))
        values["xy".index(which)] += step
        return replace(system, table_motion=replace(system.table_motion, **{key: (float(values[0]), float(values[1]))}))
    if kind.startswith("plane"):
        turn = across(plane.normal)[int(which) - 1] * step if kind == "plane_turn" else np.zeros(3)
        offset = plane.offset - turn @ covariance.plane_pivot_camera + (step if kind == "plane" else 0.0)
        length = np.linalg.norm(plane.normal + turn)
        return replace(system, laser_plane_camera=Plane((plane.normal + turn) / length, float(offset / length)))
    directions = system.base_from_camera.rotation.as_matrix()["xy".index(which)] * step
    turn = Rotation.from_rotvec(directions if kind == "axis_turn" else np.zeros(3))
    pivot = covariance.axis_pivot_camera
    shift = directions if kind == "axis_shift" else np.zeros(3)
    motion = system.table_motion
    if motion is not None:  # its pivot is the same point of the axis
        motion = replace(motion, pivot_camera=motion.pivot_camera + shift)
    point = turn.apply(axis.point - pivot) + pivot + shift
    return replace(system, rotation_axis_camera=Line(point, turn.apply(axis.direction)), table_motion=motion)


def _stripes():
    """Pixels all over the image, the same in all frames."""
    uv = np.random.default_rng(4).uniform([100, 100], [1180, 860], (30, 2))
    n = len(uv)
    full = np.ones(n)
    stripe = StripePoints(uv, np.tile([1.0, 0.0], (n, 1)), full, full, 0.05 * full, np.zeros(n, bool), np.zeros(n, int))
    return [stripe] * len(READ_RAD)


def _scan_of_changed(system, name, step):
    """The scan with one parameter changed, z = 0 on the same thing as before: what the sheet shows nearest to the origin."""
    nearest = AXIS.point - PLANE.signed_distance_to(AXIS.point[None])[0] * PLANE.normal
    pixel = system.camera.project(nearest[None])

    def height(of):
        seen = triangulate(pixel, of.camera, of.laser_plane_camera, of.laser_curvature)
        return of.base_from_camera.apply(seen)[0, 2]

    changed = replace(_changed(system, name, step), covariance=None)
    axis = changed.rotation_axis_camera
    rise = height(changed) - height(system)
    placed = replace(changed, rotation_axis_camera=Line(axis.point + rise * axis.direction, axis.direction))
    return scan_points(_stripes(), READ_RAD, placed).points_table


@pytest.mark.parametrize("motion", [None, MOTION], ids=["steady axis", "moving axis"])
@pytest.mark.parametrize("angle_error", [AngleError(), ANGLE_ERROR], ids=["exact angles", "angle error"])
@pytest.mark.parametrize("curved", [False, True], ids=["flat", "curved"])
@pytest.mark.parametrize("sense", [1, -1])
def test_every_derivative_is_that_of_the_whole_scan(sense, curved, angle_error, motion):
    system = _system(sense, curved, angle_error, motion=motion)
    cloud = scan_points(_stripes(), READ_RAD, system)
    jacobian = point_sensitivities(cloud.points_table, cloud.angle_rad, system)
    for k, name in enumerate(system.covariance.names):
        step = _steps(True, True)[name]
        ahead, behind = (_scan_of_changed(system, name, sign * step) for sign in (1, -1))
        expected = (ahead - behind) / (2 * step)
        assert np.abs(expected).max() > 0
        # the directions u, v of a bow turn with its plane, which the derivative leaves out: here it reaches 0.4 mm
        exact = 2e-3 if curved and name.startswith("plane_turn") else 1e-6
        assert np.abs(jacobian[:, :, k] - expected).max() < exact * np.abs(expected).max(), name


@pytest.mark.parametrize("curved", [False, True], ids=["flat", "curved"])
def test_the_scatter_of_scans_with_calibrations_drawn_from_the_covariance_is_the_predicted_one(curved):
    """Points, and a quantity that depends on all of them, with correlated errors of the size of a real calibration."""
    rng = np.random.default_rng(8)
    steps = np.array(list(_steps(curved, MOTION).values()))
    mixing = steps[:, None] * rng.normal(size=(len(steps), len(steps)))
    system = _system(-1, curved, ANGLE_ERROR, mixing @ mixing.T, MOTION)
    cloud = scan_points(_stripes(), READ_RAD, system)
    u = calibration_uncertainty(cloud.points_table, cloud.angle_rad, system)
    assert cloud.u_calibration_mm == pytest.approx(u, rel=1e-12)
    jacobian = point_sensitivities(cloud.points_table, cloud.angle_rad, system)
    weights = rng.normal(size=(2, len(cloud), 3))
    draws = mixing @ rng.normal(size=(len(steps), 20000))
    moves = np.tensordot(jacobian, draws, axes=1)
    assert u == pytest.approx(np.sqrt(np.mean(np.sum(moves**2, axis=1), axis=1)), rel=0.03)
    stated = combination_uncertainty(weights, cloud.points_table, cloud.angle_rad, system)
    assert stated == pytest.approx(np.std(np.tensordot(weights, moves, axes=2), axis=1), rel=0.03)


WIDE = CameraModel((1280, 960), 900.0, 905.0, 640.0, 480.0, -0.25, 0.1, 2e-3, -1e-3, -0.02)


@pytest.mark.parametrize("left_out", [(), ("k3", "fy", "angle_cos", "angle_sin", *MOTION_STEPS)], ids=["all", "some"])
@pytest.mark.parametrize("motion", [None, MOTION], ids=["steady axis", "moving axis"])
@pytest.mark.parametrize("camera", [CAMERA, WIDE], ids=["usual lens", "wide lens"])
@pytest.mark.parametrize("curved", [False, True], ids=["flat", "curved"])
def test_compiled_uncertainties_are_those_of_the_derivatives(curved, camera, motion, left_out):
    """Strongly correlated errors, one that is not there at all, and points each at an angle of its own or many at one."""
    rng = np.random.default_rng(11)
    names = tuple(name for name in _steps(curved, motion) if name not in left_out)
    sizes = np.array([_steps(curved, motion)[name] for name in names]) * (np.arange(len(names)) != 4)
    mixing = sizes[:, None] * (
        rng.normal(size=(len(names), 3)) @ rng.normal(size=(3, len(names))) + 1e-3 * np.eye(len(names))
    )
    system = replace(_system(-1, curved, ANGLE_ERROR, motion=motion), camera=camera)
    system = replace(system, covariance=replace(system.covariance, names=names, matrix=mixing @ mixing.T))
    cloud = scan_points(_stripes(), READ_RAD, system)
    own_angles = rng.uniform(0, 7, len(cloud))
    weights = rng.normal(size=(2, len(cloud), 3))
    for angle_rad in (cloud.angle_rad, own_angles):
        jacobian = point_sensitivities(cloud.points_table, angle_rad, system)
        moves = jacobian @ mixing
        u = calibration_uncertainty(cloud.points_table, angle_rad, system)
        assert u == pytest.approx(np.sqrt(np.sum(moves**2, axis=(1, 2))), rel=1e-9)
        stated = combination_uncertainty(weights, cloud.points_table, angle_rad, system)
        assert stated == pytest.approx(np.linalg.norm(np.tensordot(weights, moves, axes=2), axis=1), rel=1e-9)
    assert cloud.u_calibration_mm == pytest.approx(
        calibration_uncertainty(cloud.points_table, cloud.angle_rad, system), rel=1e-9
    )


def test_many_points_are_the_same_as_few():
    system = _system()
    cloud = scan_points(_stripes(), READ_RAD, system)
    points, angles = np.tile(cloud.points_table, (100, 1)), np.tile(cloud.angle_rad, 100)
    many = calibration_uncertainty(points, angles, system)
    assert many == pytest.approx(np.tile(cloud.u_calibration_mm, 100), rel=1e-12)
    weights = np.ones((1, len(points), 3))
    once = combination_uncertainty(weights[:, : len(cloud)], cloud.points_table, cloud.angle_rad, system)
    assert combination_uncertainty(weights, points, angles, system) == pytest.approx(100 * once, rel=1e-9)


@pytest.mark.parametrize(("name", "turn"), [("cx", [0.0, -1e-4, 0.0]), ("cy", [1e-4, 0.0, 0.0])])
def test_a_wrong_principal_point_that_turned_all_that_was_calibrated_moves_no_point(name, turn):
    """Near the optical axis it turns the camera frame, with sheet and axis in it: no image tells, and the cloud stays as it is."""
    camera = CameraModel((1280, 960), 2400.0, 2400.0, 640.0, 480.0)
    system = replace(_system(), camera=camera)
    covariance, turn = system.covariance, np.array(turn)
    uv = np.random.default_rng(3).uniform([580, 420], [700, 540], (40, 2))
    points_table = system.base_from_camera.apply(triangulate(uv, camera, PLANE))
    moves = point_sensitivities(points_table, np.zeros(len(uv)), system)
    base = system.base_from_camera.rotation
    normal_moves, pivot_moves = np.cross(turn, NORMAL), np.cross(turn, covariance.axis_pivot_camera)
    change = {
        name: 1e-4 * camera.fx,
        **{f"plane_turn_{k}": normal_moves @ e for k, e in zip((1, 2), across(NORMAL), strict=True)},
        "plane_offset": normal_moves @ covariance.plane_pivot_camera,
        **{f"axis_turn_{k}": value for k, value in zip("xy", base.apply(turn), strict=False)},
        **{f"axis_shift_{k}": value for k, value in zip("xy", base.apply(pivot_moves), strict=False)},
    }
    total = moves @ [change.get(parameter, 0.0) for parameter in covariance.names]
    turned_by_mm = 1e-4 * np.linalg.norm(AXIS.point)
    assert np.abs(total).max() < 0.01 * turned_by_mm


def test_without_a_covariance_nothing_is_known():
    system = replace(_system(), covariance=None)
    cloud = scan_points(_stripes(), READ_RAD, system)
    assert np.isnan(cloud.u_calibration_mm).all()
    assert np.isnan(
        combination_uncertainty(np.ones((2, len(cloud), 3)), cloud.points_table, cloud.angle_rad, system)
    ).all()
    with pytest.raises(GeometryError, match="no covariance"):
        point_sensitivities(cloud.points_table, cloud.angle_rad, system)
