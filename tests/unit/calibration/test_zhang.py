"""Start values of the camera."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.homography import fit_homography
from rotaline.calibration.zhang import camera_from_homographies, focal_from_homographies, start_cameras
from rotaline.simulation.ideal.observations import random_board_poses
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import Checkerboard

CAMERA = CameraModel((1280, 960), 2400.0, 2350.0, 655.0, 470.0)
CENTRED = CameraModel((1280, 960), 2400.0, 2400.0, 639.5, 479.5)
TARGET = Checkerboard((8, 6), 6.0)


def homographies(camera: CameraModel, poses: list[RigidTransform]) -> list[np.ndarray]:
    """Homographies of perfect views."""
    points = TARGET.points_board()
    return [fit_homography(points[:, :2], camera.project(pose.apply(points))) for pose in poses]


def test_closed_form_is_exact_without_noise() -> None:
    """Three tilted boards give all four parameters."""
    poses = random_board_poses(CAMERA, TARGET, 3, np.random.default_rng(1))
    found = camera_from_homographies(homographies(CAMERA, poses), CAMERA.image_size)
    assert found is not None
    values = [found.fx, found.fy, found.cx, found.cy]
    assert values == pytest.approx([2400.0, 2350.0, 655.0, 470.0], rel=1e-6)


def test_single_focal_length_is_exact_without_noise() -> None:
    """One tilted board is enough when the principal point is known."""
    poses = random_board_poses(CENTRED, TARGET, 1, np.random.default_rng(2))
    found = focal_from_homographies(homographies(CENTRED, poses), CENTRED.image_size)
    assert found is not None
    assert found.fx == pytest.approx(2400.0, rel=1e-6)


def test_boards_parallel_to_the_image_give_no_camera_but_guesses() -> None:
    """Nothing is made up: the closed forms decline, and the guesses remain."""
    poses = [
        RigidTransform.from_components([-20.0, -10.0, z], Rotation.from_rotvec([0.0, 0.0, roll]))
        for z, roll in ((300.0, 0.0), (350.0, 0.4), (400.0, 1.0))
    ]
    views = homographies(CENTRED, poses)
    assert camera_from_homographies(views, CENTRED.image_size) is None
    assert len(start_cameras(views, CENTRED.image_size)) >= 5
