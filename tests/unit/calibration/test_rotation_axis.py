"""What the initial axis says when the frames do not suffice, and its conventions."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.model import TargetView
from rotaline.calibration.rotation_axis import calibrate_axis
from rotaline.errors import CalibrationError
from rotaline.simulation.ideal.circles import ideal_rig
from rotaline.simulation.ideal.turning_target import observe_turning_target, standing_board
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import Checkerboard, DotGrid, Target

CAMERA = CameraModel((1280, 960), 2400.0, 2400.0, 645.0, 482.0)
BOARD = Checkerboard((7, 5), 9.0)


def _views(
    angles_deg: np.ndarray,
    *,
    read_deg: np.ndarray | None = None,
    elevation_deg: float = 35.0,
    target: Target = BOARD,
    base_from_board: RigidTransform | None = None,
) -> list[TargetView]:
    rig = ideal_rig(elevation_deg=elevation_deg)
    pose = standing_board(target) if base_from_board is None else base_from_board
    rng = np.random.default_rng(0)
    detections = observe_turning_target(CAMERA, rig, target, pose, np.radians(angles_deg), 0.02, rng)
    read = np.radians(angles_deg if read_deg is None else read_deg)
    return [TargetView(f"axis/{k}.png", d, float(a)) for k, (d, a) in enumerate(zip(detections, read, strict=True))]


ANGLES = np.arange(-20.0, 21.0, 4.0)


def test_point_is_the_one_nearest_to_the_optical_axis() -> None:
    axis = calibrate_axis(CAMERA, _views(ANGLES)).axis_camera
    beside = [axis.point + s * axis.direction for s in (-1.0, 0.0, 1.0)]
    distances = [np.hypot(*point[:2]) for point in beside]
    assert distances[1] == min(distances)
    assert axis.direction[2] < 0


def test_views_need_angles() -> None:
    views = [TargetView(v.name, v.detection, None) for v in _views(ANGLES)]
    with pytest.raises(CalibrationError, match=r"at least 3 frames.*no turntable angle"):
        calibrate_axis(CAMERA, views)


def test_two_frames_are_too_few() -> None:
    with pytest.raises(CalibrationError, match="2 of 2 can be used"):
        calibrate_axis(CAMERA, _views(ANGLES)[:2])


def test_angles_that_do_not_differ() -> None:
    with pytest.raises(CalibrationError, match="angle_deg"):
        calibrate_axis(CAMERA, _views(ANGLES, read_deg=np.full(len(ANGLES), 7.0)))


def test_short_range_is_a_warning() -> None:
    found = calibrate_axis(CAMERA, _views(np.arange(0.0, 13.0, 2.0)))
    assert any("12.0 deg of turntable angle only" in text for text in found.warnings)


def test_wrong_scale_of_the_angle_is_a_warning() -> None:
    found = calibrate_axis(CAMERA, _views(ANGLES, read_deg=2 * ANGLES))
    assert any("0.500 times as far as angle_deg says" in text for text in found.warnings)


def test_camera_from_the_side_takes_up_from_the_image() -> None:
    found = calibrate_axis(CAMERA, _views(ANGLES, elevation_deg=3.0))
    assert found.axis_camera.direction[1] < -0.9
    assert any("up in the image" in text for text in found.warnings)


def test_board_that_lies_on_the_table() -> None:
    target = DotGrid((5, 5), 8.0, 3.0)
    lying = RigidTransform.from_components([-20.0, 16.0, 0.0], Rotation.from_euler("x", 180.0, degrees=True))
    found = calibrate_axis(CAMERA, _views(np.arange(0.0, 120.0, 10.0), target=target, base_from_board=lying))
    truth = ideal_rig().axis_camera
    assert any("same height" in text for text in found.warnings)
    assert np.degrees(np.arccos(found.axis_camera.direction @ truth.direction)) < 0.5
    assert found.turn_sense == 1
    assert found.axis_camera.distance_to(truth.point[None])[0] < 0.3
