"""What goes into a verdict: uncertainty near the axis, and measured values whose whole uncertainty is known."""

import numpy as np
import pytest

from rotaline.calibration.model import SystemCalibration, SystemCovariance
from rotaline.calibration.verdict.model import StepVerdict, Verdict
from rotaline.geometry.primitives import Line, Plane, unit
from rotaline.io.results import MeasurementEntry
from rotaline.io.session_file import MeasurementRequest
from rotaline.metrology.model import FeatureMeasurement
from rotaline.pipeline.judge import judge_measured, u_near_axis_mm
from rotaline.vision.camera import CameraModel

CAMERA = CameraModel((640, 480), 1500.0, 1500.0, 320.0, 240.0, 0.0, 0.0, 0.0, 0.0)
AXIS = Line(np.array([0.0, 5.0, 300.0]), unit(np.array([0.0, -1.0, -0.5])))
PLANE = Plane(unit(np.array([1.0, 0.0, -1.0])), 300.0 / np.sqrt(2.0))
CALM = Verdict("pass", "All steps agree.", (StepVerdict("camera", "pass", "Fine."),), (), 0.002, 0.005)


def test_a_shift_of_the_axis_is_the_uncertainty_of_a_point_on_it():
    """Camera and plane exact, axis known to 3 um along x: a table point is uncertain by as much."""
    names = ("axis_shift_x", "axis_shift_y")
    covariance = SystemCovariance(names, np.diag([0.003**2, 0.0]), AXIS.point, AXIS.point)
    system = SystemCalibration(CAMERA, PLANE, AXIS, 1, True, covariance=covariance)
    assert u_near_axis_mm(system) == pytest.approx(0.003, rel=1e-3)
    assert np.isnan(u_near_axis_mm(SystemCalibration(CAMERA, PLANE, AXIS, 1, True)))


def entry(error_mm: float, known: bool = True) -> MeasurementEntry:
    """A ball with U = 4 um."""
    u = {"diameter": 0.002}
    value = {"diameter": 20.0 + error_mm}
    none = np.zeros(0)
    m = FeatureMeasurement("sphere", value, u, 100, 0.005, 0.02, none.astype(int), none, {}, u_scatter=u)
    return MeasurementEntry(
        "ball", "sphere", "", m.with_calibration({"diameter": 0.0}) if known else m, {"diameter": 20.0}
    )


def level_of(found: MeasurementEntry) -> str:
    request = MeasurementRequest(capture="ball", feature="sphere", reference={"diameter": 20.0}, check=True)
    verdict = judge_measured(CALM, [found], [request])
    (step,) = (s for s in verdict.steps if s.step == "measure")
    return step.level


def test_errors_beyond_u_spoil_the_verdict():
    assert level_of(entry(0.003)) == "pass"
    assert level_of(entry(0.006)) == "doubtful"
    assert level_of(entry(0.050)) == "fail"


def test_without_the_part_of_the_calibration_nothing_is_judged():
    assert level_of(entry(0.050, known=False)) == "none"
    assert level_of(MeasurementEntry("ball", "sphere", "", None, {"diameter": 20.0}, "not found")) == "none"
