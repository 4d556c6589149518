"""Results against the truth: known differences come out as what they are."""

import dataclasses
import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotaline.cli.app import main
from rotaline.errors import SessionError
from rotaline.geometry.primitives import Line, Plane
from rotaline.io.calibration_file import CalibrationFile, write_calibration
from rotaline.pipeline.compare_truth import VOLUME_HEIGHT_MM, compare_with_truth, truth_beside
from rotaline.simulation.rig import build_rig
from rotaline.simulation.small_session import small_plan
from rotaline.simulation.truth import truth

RIG = build_rig((320, 240), turn_sense=-1)


def _content(camera=RIG.camera, plane=RIG.laser_plane_camera, axis=RIG.rotation_axis_camera, turn_sense=-1):
    return CalibrationFile(camera, plane, axis, axis, turn_sense, True, {})


@pytest.fixture
def place(tmp_path):
    """Write a calibration and measurements beside the truth of a rig; compare them."""
    plan = small_plan(RIG, captures=("ball",))
    truth_file = tmp_path / "session.truth.json"
    truth_file.write_text(json.dumps(truth(RIG, plan)))
    results = tmp_path / "session-results"
    entry = {"capture": "ball", "feature": "sphere", "name": "ball", "uncertainty": {"diameter": 0.002}}
    results.mkdir()
    (results / "measurements.json").write_text(json.dumps([entry | {"value": {"diameter": 28.485}}]))
    (results / "measurements-initial-axis.json").write_text(json.dumps([entry | {"value": {"diameter": 28.5}}]))

    def compare(content):
        write_calibration(results / "calibration.json", content)
        return compare_with_truth(results, truth_beside(results))

    compare.results = results
    return compare


def test_the_true_calibration_has_no_errors(place):
    errors = place(_content()).calibration
    assert errors.sense_right
    for name, value in dataclasses.asdict(errors).items():
        assert abs(value) < 1e-3 or name == "sense_right", name


def test_a_turned_camera_frame_is_no_error(place):
    rotation = Rotation.from_rotvec([0.0, 0.002, 0.0])
    camera = dataclasses.replace(RIG.camera, cx=RIG.camera.cx + 0.002 * RIG.camera.fx)
    plane, axis = RIG.laser_plane_camera, RIG.rotation_axis_camera
    turned = _content(
        camera,
        Plane(rotation.apply(plane.normal), plane.offset),
        Line(rotation.apply(axis.point), rotation.apply(axis.direction)),
    )
    turned_back = _content(
        camera,
        Plane(rotation.inv().apply(plane.normal), plane.offset),
        Line(rotation.inv().apply(axis.point), rotation.inv().apply(axis.direction)),
    )
    right, wrong = sorted((place(turned).calibration, place(turned_back).calibration), key=lambda e: e.plane_max_mm)
    assert right.plane_max_mm < 0.01
    assert right.axis_low_mm < 0.01
    assert wrong.plane_max_mm > 0.5
    assert right.cx_px == pytest.approx(0.002 * RIG.camera.fx)


def test_distances_and_angles_come_out_as_planted(place):
    plane, axis = RIG.laser_plane_camera, RIG.rotation_axis_camera
    across = np.cross(axis.direction, [1.0, 0.0, 0.0])
    across /= np.linalg.norm(across)
    tilted = axis.direction + 1e-3 * across
    shifted = Line(axis.point + 0.02 * across, tilted / np.linalg.norm(tilted))
    errors = place(_content(plane=Plane(plane.normal, plane.offset + 0.03), axis=shifted)).calibration
    assert errors.plane_rms_mm == pytest.approx(0.03)
    assert errors.plane_urad == pytest.approx(0.0, abs=1e-6)
    assert errors.axis_low_mm == pytest.approx(0.02, rel=1e-3)
    assert errors.axis_high_mm == pytest.approx(0.02 + 1e-3 * VOLUME_HEIGHT_MM, rel=1e-3)
    assert errors.axis_urad == pytest.approx(1000.0, rel=1e-3)


@pytest.mark.parametrize(("flip", "sense", "right"), [(1, -1, True), (1, 1, False), (-1, 1, True), (-1, -1, False)])
def test_the_sense_belongs_to_the_direction_of_the_axis(place, flip, sense, right):
    axis = Line(RIG.rotation_axis_camera.point, flip * RIG.rotation_axis_camera.direction)
    assert place(_content(axis=axis, turn_sense=sense)).calibration.sense_right is right


def test_sizes_are_held_against_the_true_part(place):
    (size,) = place(_content()).sizes
    assert (size.capture, size.quantity, size.true) == ("ball", "diameter", 28.475)
    assert size.error == pytest.approx(0.01)
    assert size.initial == 28.5
    assert size.uncertainty == 0.002


def test_a_truth_of_another_camera_is_refused(place):
    small = build_rig((160, 120))
    with pytest.raises(SessionError, match="different sessions"):
        place(_content(camera=small.camera))


def test_a_file_that_is_no_truth_is_refused(place):
    place(_content())
    other = place.results / "measurements.json"
    with pytest.raises(SessionError, match="not the truth of a rendered session"):
        compare_with_truth(place.results, other)


def test_the_command_prints_and_names_what_is_missing(place, capsys, tmp_path):
    place(_content())
    assert main(["compare", str(place.results)]) == 0
    assert "+0.0100" in capsys.readouterr().out
    assert main(["compare", str(place.results), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["calibration"]["sense_right"] is True
    assert main(["compare", str(tmp_path)]) == 2
    assert "--truth" in capsys.readouterr().err
