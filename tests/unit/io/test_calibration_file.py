import json

import numpy as np
import pytest

from rotaline.errors import SessionError
from rotaline.geometry.primitives import Line, Plane
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
    ],
)
def test_a_wrong_field_is_named(tmp_path, change, says):
    write_calibration(tmp_path / "c.json", CONTENT)
    document = json.loads((tmp_path / "c.json").read_text())
    change(document)
    (tmp_path / "c.json").write_text(json.dumps(document))
    with pytest.raises(SessionError, match=says):
        read_calibration(tmp_path / "c.json")
