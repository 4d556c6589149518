import json
from dataclasses import replace

import numpy as np
import pytest

from rotaline.calibration.model import AngleError, SystemCovariance, TableMotion
from rotaline.errors import SessionError
from rotaline.geometry.primitives import Line, Plane, SheetCurvature
from rotaline.io.calibration_file import CalibrationFile, read_calibration, write_calibration
from rotaline.vision.camera import CameraModel

CONTENT = CalibrationFile(
    CameraModel((1280, 960), 2400.0, 2401.0, 640.0, 480.0, -0.1, 0.2, 1e-3, -2e-3, 0.0),
    Plane(np.array([0.6, 0.0, 0.8]), -140.0),
    Line(np.array([1.0, 20.0, 280.0]), np.array([0.0, -1.0, 0.0])),
    Line(np.array([1.5, 20.0, 280.0]), np.array([0.0, -1.0, 0.0])),
    -1,
    True,
    {"camera": {"rms_px": 0.03, "u": [float("nan")]}},
    "session",
)
NAMES = (
    "fx",
    "k1",
    "plane_turn_1",
    "plane_offset",
    "curvature_uv",
    "axis_turn_x",
    "axis_shift_y",
    "angle_cos",
    "run_out_x",
    "wobble_y",
)
MIXED = np.random.default_rng(1).normal(size=(10, 10))
JOINT = replace(
    CONTENT,
    laser_curvature=SheetCurvature(np.array([1.0, 2.0, 170.0]), (1e-5, -2e-5, 3e-5)),
    angle_error=AngleError(1e-4, -2e-4),
    table_motion=TableMotion((2e-3, -1e-3), (3e-5, 4e-5), np.array([1.0, 21.0, 280.0])),
    line_sigma_mm=0.08,
    stripe_blur_px=0.7,
    covariance=SystemCovariance(NAMES, MIXED @ MIXED.T, np.array([1.0, 2.0, 170.0]), np.array([1.0, 21.0, 280.0])),
)


def test_what_was_written_comes_back(tmp_path):
    path = tmp_path / "calibration.json"
    write_calibration(path, CONTENT)
    back = read_calibration(path)
    assert back.camera == CONTENT.camera
    assert back.laser_plane_camera.normal == pytest.approx(CONTENT.laser_plane_camera.normal)
    assert back.laser_plane_camera.offset == -140.0
    assert back.rotation_axis_camera.point == pytest.approx(CONTENT.rotation_axis_camera.point)
    assert back.system().turn_sense == -1
    assert back.system(initial_axis=True).rotation_axis_camera.point[0] == 1.5
    assert back.quality["camera"] == {"rms_px": 0.03, "u": [None]}


def test_the_fields_that_other_programs_read(tmp_path):
    write_calibration(tmp_path / "c.json", CONTENT)
    document = json.loads((tmp_path / "c.json").read_text())
    assert document["camera"]["image_size"] == [1280, 960]
    assert document["camera"]["distortion"] == {"k1": -0.1, "k2": 0.2, "p1": 1e-3, "p2": -2e-3, "k3": 0.0}
    assert document["laser_plane_camera"] == {"normal": [0.6, 0.0, 0.8], "offset": -140.0}
    assert document["rotation_axis_camera"]["direction"] == [0.0, -1.0, 0.0]
    assert document["turn_sense"] == -1


def test_the_joint_estimate_comes_back_whole(tmp_path):
    write_calibration(tmp_path / "c.json", JOINT)
    system = read_calibration(tmp_path / "c.json").system()
    assert (system.laser_curvature.origin == JOINT.laser_curvature.origin).all()
    assert system.laser_curvature.coefficients == JOINT.laser_curvature.coefficients
    assert system.angle_error == JOINT.angle_error
    assert system.table_motion.run_out_mm == (2e-3, -1e-3)
    assert system.table_motion.wobble_rad == (3e-5, 4e-5)
    assert (system.table_motion.pivot_camera == [1.0, 21.0, 280.0]).all()
    assert (system.line_sigma_mm, system.stripe_blur_px) == (0.08, 0.7)
    assert system.covariance.names == NAMES
    assert (system.covariance.matrix == JOINT.covariance.matrix).all()
    assert (system.covariance.plane_pivot_camera == JOINT.covariance.plane_pivot_camera).all()
    assert (system.covariance.axis_pivot_camera == JOINT.covariance.axis_pivot_camera).all()


def test_the_initial_axis_has_neither_errors_of_the_table_nor_covariance():
    system = JOINT.system(initial_axis=True)
    assert system.covariance is None
    assert system.table_motion is None
    assert system.angle_error == AngleError()
    assert system.laser_curvature is JOINT.laser_curvature


def test_other_programs_find_units_and_meanings_in_the_file(tmp_path):
    write_calibration(tmp_path / "c.json", JOINT)
    document = json.loads((tmp_path / "c.json").read_text())
    covariance, sheet = document["covariance"], document["laser_curvature"]
    assert covariance["units"] == ["px", "1", "rad", "mm", "1/mm", "rad", "mm", "rad", "mm", "rad"]
    assert all(covariance["meaning"][name] for name in NAMES)
    basis = np.array([sheet["u_direction"], sheet["v_direction"], document["laser_plane_camera"]["normal"]])
    assert basis @ basis.T == pytest.approx(np.eye(3), abs=1e-12)
    assert (sheet["uu"], sheet["uv"], sheet["vv"]) == (1e-5, -2e-5, 3e-5)


def test_a_file_of_an_earlier_version_has_no_covariance(tmp_path):
    write_calibration(tmp_path / "c.json", JOINT)
    document = json.loads((tmp_path / "c.json").read_text())
    for key in ("covariance", "laser_curvature", "angle_error", "table_motion"):
        document.pop(key)
    (tmp_path / "c.json").write_text(json.dumps(document))
    system = read_calibration(tmp_path / "c.json").system()
    assert system.covariance is None
    assert system.laser_curvature is None
    assert system.angle_error == AngleError()
    assert system.table_motion is None


def test_pivots_that_mean_nothing_come_back_as_missing(tmp_path):
    """Without a turntable no axis parameter is named, and its pivot is nowhere."""
    names = ("fx", "plane_offset")
    covariance = SystemCovariance(names, np.eye(2), np.zeros(3), np.full(3, np.nan))
    write_calibration(tmp_path / "c.json", replace(CONTENT, covariance=covariance))
    back = read_calibration(tmp_path / "c.json").covariance
    assert back.names == names
    assert np.isnan(back.axis_pivot_camera).all()


def test_a_calibration_without_an_axis_makes_no_system(tmp_path):
    write_calibration(tmp_path / "c.json", CalibrationFile(CONTENT.camera, None, None, None, 1, False, {}))
    back = read_calibration(tmp_path / "c.json")
    assert back.system() is None
    assert back.camera == CONTENT.camera


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda d: d.pop("camera"), "camera"),
        (lambda d: d["camera"].update(fx="wide"), r"camera\.fx"),
        (lambda d: d["camera"]["distortion"].update(k9=1.0), "k9"),
        (lambda d: d.update(version=2), "version"),
        (lambda d: d.update(turn_sense=0), "turn_sense"),
        (lambda d: d["laser_plane_camera"].update(normal=[1.0, 2.0]), "normal"),
        (lambda d: d["covariance"]["names"].__setitem__(0, "focus"), r"covariance\.names: found focus"),
        (lambda d: d["covariance"]["names"].pop(), r"covariance\.matrix: .* 9 rows of 9"),
        (lambda d: d["covariance"]["matrix"][2].pop(), r"covariance\.matrix: .* 10 rows of 10"),
        (lambda d: d.update(line_sigma_mm=-0.1), "line_sigma_mm: input should be greater"),
        (lambda d: d.update(laser_curvature=None), r"covariance\.names: found curvature_uv"),
        (lambda d: d["angle_error"].pop("sin"), r"angle_error\.sin"),
        (lambda d: d.update(table_motion=None), r"covariance\.names: found run_out_x, wobble_y"),
        (lambda d: d["table_motion"].update(wobble_rad=[1e-5]), r"table_motion\.wobble_rad"),
    ],
)
def test_a_wrong_field_is_named(tmp_path, change, says):
    write_calibration(tmp_path / "c.json", JOINT)
    document = json.loads((tmp_path / "c.json").read_text())
    change(document)
    (tmp_path / "c.json").write_text(json.dumps(document))
    with pytest.raises(SessionError, match=says):
        read_calibration(tmp_path / "c.json")
