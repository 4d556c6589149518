import numpy as np
import pytest

from rotaline.calibration.model import AngleError, SystemCalibration, SystemCovariance, TableMotion
from rotaline.geometry.primitives import KnownCylinder, KnownSphere, Line, Plane, SheetCurvature, SteppedCylinder, unit
from rotaline.io.results import MeasurementEntry
from rotaline.metrology.model import FeatureMeasurement
from rotaline.pipeline.parts import (
    artifact_sizes,
    feature_uncertainty,
    place_on_table,
    reference_contradiction,
    system_at_optical_axis,
)
from rotaline.scanning.cloud import PointCloud
from rotaline.scanning.propagation import point_sensitivities
from rotaline.vision.camera import CameraModel

NAMES = ("fx", "plane_offset", "axis_shift_x", "angle_sin")
AXIS = Line(np.array([2.0, 20.0, 290.0]), unit(np.array([0.0, -0.8, -0.6])))
SYSTEM = SystemCalibration(
    CameraModel((1280, 960), 2400.0, 2400.0, 640.0, 480.0),
    Plane(unit(np.array([0.8, 0.0, 0.6])), float(-unit(np.array([0.8, 0.0, 0.6])) @ AXIS.point)),
    AXIS,
    1,
    table_seen=True,
    laser_curvature=SheetCurvature(AXIS.point, (1e-4, 0.0, 0.0)),
    angle_error=AngleError(1e-3, 0.0),
    table_motion=TableMotion((2e-3, 0.0), (0.0, 3e-5), AXIS.point),
    covariance=SystemCovariance(NAMES, np.diag([1.0, 1e-4, 1e-4, 1e-8]), AXIS.point, AXIS.point),
)


def _entry(diameter, reference):
    nothing = np.empty(0)
    value = FeatureMeasurement(
        "cylinder", {"diameter": diameter}, {"diameter": 0.001}, 9, 0.01, 0.03, nothing.astype(int), nothing, {}
    )
    return MeasurementEntry("rod", "cylinder", "rod", value, reference)


@pytest.mark.parametrize(
    ("diameter", "says"), [(81.5, True), (38.8, True), (37.2, True), (38.1, False), (38.004, False)]
)
def test_a_size_far_from_its_reference_is_said_to_be_wrong(diameter, says):
    text = reference_contradiction(_entry(diameter, {"diameter": 38.004}))
    assert bool(text) == says
    assert not says or ("38.004" in text and "pitch" in text)


def test_without_a_reference_or_a_measurement_there_is_nothing_to_contradict():
    assert reference_contradiction(_entry(81.5, {})) == ""
    assert (
        reference_contradiction(MeasurementEntry("rod", "cylinder", "rod", None, {"diameter": 38.0}, "no points")) == ""
    )


def _cloud(n, table_z=None):
    """Points on the sheet; or a table top at a height, seen by many frames."""
    rng = np.random.default_rng(3)
    if table_z is None:
        points, frame = rng.uniform(-20, 20, (n, 3)), np.arange(n)
    else:
        radius, angle = rng.uniform(25, 60, n), rng.uniform(0, 2 * np.pi, n)
        points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), table_z + rng.normal(0, 0.06, n)])
        frame = np.arange(n) % 36
    full = np.ones(n)
    return PointCloud(points, points, full, rng.uniform(0, 6, n), frame, full, full * np.nan)


def test_another_origin_leaves_all_that_was_calibrated():
    placed = [system_at_optical_axis(SYSTEM), place_on_table(SYSTEM, [_cloud(4000, table_z=-7.0)])]
    for system in placed:
        assert system.laser_curvature is SYSTEM.laser_curvature
        assert system.angle_error == SYSTEM.angle_error
        assert system.table_motion is SYSTEM.table_motion
        assert system.covariance is SYSTEM.covariance
        assert AXIS.distance_to(system.rotation_axis_camera.point[None])[0] < 1e-9
    assert not placed[0].table_seen
    assert placed[1].table_seen
    fall = (placed[1].rotation_axis_camera.point - AXIS.point) @ AXIS.direction
    assert fall == pytest.approx(-7.0, abs=0.05)


def test_the_calibration_acts_on_a_value_through_the_points_that_it_depends_on():
    rng = np.random.default_rng(4)
    cloud = _cloud(50)
    indices = np.array([3, 8, 8, 40])
    normals = rng.normal(size=(4, 3))
    responses = {"depth": rng.normal(size=4), "width_top": rng.normal(size=4)}
    values = dict.fromkeys((*responses, "flatness"), 1.0)
    measurement = FeatureMeasurement(
        "groove", values, values, 4, 0.0, 0.0, indices, np.zeros(4), {}, responses=responses, normals=normals
    )
    stated = feature_uncertainty(measurement, cloud, SYSTEM)
    assert set(stated) == {"depth", "width_top"}
    jacobian = point_sensitivities(cloud.points_table[indices], cloud.angle_rad[indices], SYSTEM)
    for key, response in responses.items():
        c = np.einsum("i,ij,ijp->p", response, normals, jacobian)
        assert stated[key] == pytest.approx(np.sqrt(c @ SYSTEM.covariance.matrix @ c))


def test_both_parts_of_the_uncertainty_stand_in_the_file():
    nothing = np.empty(0)
    measurement = FeatureMeasurement(
        "cylinder",
        {"diameter": 38.0},
        {"diameter": 0.003},
        9,
        0.01,
        0.03,
        nothing.astype(int),
        nothing,
        {},
        u_scatter={"diameter": 0.003},
    ).with_calibration({"diameter": 0.004})
    entry = MeasurementEntry("rod", "cylinder", "rod", measurement, {"diameter": 38.004}).to_json()
    assert entry["uncertainty"]["diameter"] == pytest.approx(0.005)
    assert entry["uncertainty_scatter"] == {"diameter": 0.003}
    assert entry["uncertainty_calibration"] == {"diameter": 0.004}


def test_artefacts_of_every_kind_have_the_sizes_that_are_measured():
    assert artifact_sizes(KnownSphere(25.4, 0.001)) == {"diameter": 25.4}
    assert artifact_sizes(KnownCylinder(30.0, 40.0)) == {"diameter": 30.0}
    assert artifact_sizes(SteppedCylinder(23.0, 36.0, 22.0, 25.0))["height_large"] == 25.0
