"""Errors of the calibration in measured features: a wrong calibration changes each value by what its covariance predicts."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotaline.calibration.model import AngleError, SystemCalibration, SystemCovariance
from rotaline.geometry.fitting import across
from rotaline.geometry.primitives import Line, Plane
from rotaline.io.session_file import MeasurementRequest
from rotaline.metrology.features import MeasureOptions
from rotaline.pipeline.parts import measure_request
from rotaline.scanning.triangulation import scan_points
from rotaline.simulation.ideal.observed_scan import trace_scan
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.plan import mount, table_disc
from rotaline.simulation.rig import build_rig
from rotaline.simulation.small_session import BALL, ROD

NAMES = ("fx", "fy", "cx", "cy", "k1", "plane_turn_1", "plane_turn_2", "plane_offset")
NAMES += ("axis_turn_x", "axis_turn_y", "axis_shift_x", "axis_shift_y", "angle_cos", "angle_sin")
SIZES = np.array([1.0, 1.0, 1.0, 1.0, 2e-3, 5e-4, 5e-4, 0.03, 5e-4, 5e-4, 0.03, 0.03, 5e-4, 5e-4])
PARTS = {
    "sphere": (Placed(BALL, mount(4.0, -2.0)), BALL.diameter),
    "cylinder": (Placed(ROD, mount(3.0, 2.0)), ROD.diameter),
}
RIG = build_rig((640, 480), turn_sense=-1)


def _true_system():
    axis = RIG.rotation_axis_camera
    near = axis.point + 20.0 * axis.direction
    plane = RIG.laser_plane_camera
    covariance = SystemCovariance(
        NAMES, np.diag(SIZES**2), near - plane.signed_distance_to(near[None])[0] * plane.normal, near
    )
    return SystemCalibration(RIG.camera, plane, axis, RIG.turn_sense, True, covariance=covariance)


def _wrong(system, error):
    """The system with an error in every parameter, in the words of SystemCovariance."""
    p = dict(zip(NAMES, error, strict=True))
    camera = replace(
        system.camera, **{k: getattr(system.camera, k) + float(p[k]) for k in ("fx", "fy", "cx", "cy", "k1")}
    )
    plane, covariance = system.laser_plane_camera, system.covariance
    e1, e2 = across(plane.normal)
    turn = p["plane_turn_1"] * e1 + p["plane_turn_2"] * e2
    length = np.linalg.norm(plane.normal + turn)
    offset = (plane.offset - turn @ covariance.plane_pivot_camera + p["plane_offset"]) / length
    base = system.base_from_camera.rotation.inv()
    tilt = Rotation.from_rotvec(base.apply([p["axis_turn_x"], p["axis_turn_y"], 0.0]))
    pivot, axis = covariance.axis_pivot_camera, system.rotation_axis_camera
    point = tilt.apply(axis.point - pivot) + pivot + base.apply([p["axis_shift_x"], p["axis_shift_y"], 0.0])
    return replace(
        system,
        camera=camera,
        laser_plane_camera=Plane((plane.normal + turn) / length, float(offset)),
        rotation_axis_camera=Line(point, tilt.apply(axis.direction)),
        angle_error=AngleError(float(p["angle_cos"]), float(p["angle_sin"])),
    )


@pytest.mark.parametrize("feature", PARTS)
def test_a_wrong_calibration_changes_a_diameter_as_predicted(feature):
    part, diameter = PARTS[feature]
    scan = trace_scan(RIG, [part, table_disc(RIG)], tuple(12.0 * i for i in range(30)), spacing_px=3.0)
    stripes = scan.observed(0.02, 1)
    request = MeasurementRequest(capture="scan", feature=feature, nominal={"diameter": diameter})

    def measure(system):
        return measure_request(request, scan_points(stripes, scan.angles_rad, system), MeasureOptions(), system)

    true = _true_system()
    plain = measure(replace(true, covariance=None)).measurement
    assert plain.u_calibration == {}
    error = SIZES * np.random.default_rng(5).normal(size=len(SIZES)) / 3
    known = replace(true.covariance, matrix=np.outer(error, error))
    predicted = measure(replace(true, covariance=known)).measurement
    assert predicted.value == plain.value
    ahead, behind = (measure(_wrong(true, sign * error)).measurement.value["diameter"] for sign in (1, -1))
    assert predicted.u_calibration["diameter"] == pytest.approx(abs(ahead - behind) / 2, rel=0.01)
    combined = np.hypot(predicted.u_scatter["diameter"], predicted.u_calibration["diameter"])
    assert predicted.uncertainty["diameter"] == pytest.approx(combined)
