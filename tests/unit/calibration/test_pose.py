"""Pose of a board in one image."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.pose import estimate_board_pose
from rotaline.errors import GeometryError
from rotaline.simulation.ideal.observations import observe_target, random_board_poses
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import Checkerboard, DotGrid

CAMERA = CameraModel((1280, 960), 2400.0, 2390.0, 645.0, 482.0, -0.11, 0.09, 0.0006, -0.0004)
TARGET = DotGrid((9, 9), 6.0, 3.0)


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_perfect_images_give_the_pose(seed: int) -> None:
    """Any pose in view comes back; seen from the front, the board's z points away from the camera."""
    pose = random_board_poses(CAMERA, TARGET, 1, np.random.default_rng(seed))[0]
    found = estimate_board_pose(CAMERA, TARGET.points_board(), CAMERA.project(pose.apply(TARGET.points_board())))
    difference = found.camera_from_board * pose.inv()
    assert difference.rotation.magnitude() < 1e-7
    assert np.linalg.norm(difference.translation) < 1e-5
    assert found.camera_from_board.rotation.apply([0.0, 0.0, 1.0])[2] > 0
    assert found.rms_px < 1e-6


@settings(deadline=None, max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_half_turned_order_is_the_same_geometry(seed: int) -> None:
    """A symmetric board read from the other end lies in the same place, turned by 180 deg about its normal."""
    rng = np.random.default_rng(seed)
    pose = random_board_poses(CAMERA, TARGET, 1, rng)[0]
    uv = observe_target(CAMERA, pose, TARGET, 0.02, rng).uv
    points = TARGET.points_board()
    a, b = estimate_board_pose(CAMERA, points, uv), estimate_board_pose(CAMERA, points, uv[::-1].copy())
    assert a.rms_px == pytest.approx(b.rms_px, rel=1e-6)
    np.testing.assert_allclose(a.camera_from_board.apply(points), b.camera_from_board.apply(points)[::-1], atol=1e-5)


def test_the_better_of_two_mirror_poses_is_taken() -> None:
    """A small distant board looks nearly the same when its normal is mirrored in the line of sight."""
    target = Checkerboard((4, 4), 3.0)
    rng = np.random.default_rng(5)
    tilts = []
    for k in range(20):
        rotation = Rotation.from_rotvec([0.5 * np.cos(k), 0.5 * np.sin(k), 0.0])
        pose = RigidTransform.from_components([10.0, -15.0, 500.0], rotation)
        uv = observe_target(CAMERA, pose, target, 0.01, rng).uv
        found = estimate_board_pose(CAMERA, target.points_board(), uv).camera_from_board
        tilts.append((found.rotation * rotation.inv()).magnitude())
    assert max(tilts) < 0.1  # the mirrored pose is off by about 1 rad


def test_bad_points_are_left_out() -> None:
    """Three dots moved by glare do not bend the pose, and are named."""
    rng = np.random.default_rng(6)
    pose = random_board_poses(CAMERA, TARGET, 1, rng)[0]
    uv = observe_target(CAMERA, pose, TARGET, 0.02, rng).uv
    uv[[4, 40, 77]] += [[3.0, 0.0], [0.0, -8.0], [20.0, 20.0]]
    found = estimate_board_pose(CAMERA, TARGET.points_board(), uv)
    assert sorted(np.flatnonzero(~found.used)) == [4, 40, 77]
    assert found.rms_px < 0.04
    assert np.linalg.norm(found.residuals_px[77]) > 20.0


def test_missing_points_are_left_out() -> None:
    """NaN rows have NaN residuals."""
    pose = random_board_poses(CAMERA, TARGET, 1, np.random.default_rng(7))[0]
    uv = CAMERA.project(pose.apply(TARGET.points_board()))
    uv[10] = np.nan
    found = estimate_board_pose(CAMERA, TARGET.points_board(), uv)
    assert not found.used[10]
    assert np.isnan(found.residuals_px[10]).all()


def test_too_few_points_are_refused() -> None:
    """The message says how many are needed."""
    with pytest.raises(GeometryError, match="at least 4 points, found 3"):
        estimate_board_pose(CAMERA, TARGET.points_board()[:3], np.array([[1.0, 2.0], [30.0, 4.0], [5.0, 60.0]]))


def test_a_row_of_points_is_refused() -> None:
    """A row leaves the turn about itself open."""
    points = TARGET.points_board()[:9]
    with pytest.raises(GeometryError, match="line"):
        estimate_board_pose(CAMERA, points, CAMERA.project(points + np.array([0.0, 0.0, 300.0])))
