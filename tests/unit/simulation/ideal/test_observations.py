"""Ideal observations of targets and stripes."""

import numpy as np
import pytest

from rotaline.geometry.primitives import Plane, unit
from rotaline.simulation.ideal.observations import observe_stripe, observe_target, random_board_poses
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import DotGrid

CAMERA = CameraModel((1280, 960), 2400.0, 2390.0, 645.0, 482.0, -0.11, 0.09, 0.0006, -0.0004)
TARGET = DotGrid((9, 9), 6.0, 3.0)
PLANE = Plane(unit(np.array([0.85, -0.3, 0.45])), -145.0)


def test_the_whole_target_is_in_view() -> None:
    """Every pose shows all points, from the front, within the tilt asked for."""
    rng = np.random.default_rng(1)
    for pose in random_board_poses(CAMERA, TARGET, 10, rng, tilt_deg=(5.0, 40.0)):
        assert len(observe_target(CAMERA, pose, TARGET, 0.0, rng).uv) == 81
        normal = pose.rotation.apply([0.0, 0.0, 1.0])
        assert np.cos(np.deg2rad(40.1)) < normal[2] < np.cos(np.deg2rad(4.9))


def test_stripe_points_lie_in_the_laser_plane_and_on_the_target() -> None:
    """Without noise, each point's ray meets target and laser plane in one point."""
    rng = np.random.default_rng(2)
    n_stripes = 0
    for pose in random_board_poses(CAMERA, TARGET, 10, rng):
        stripe = observe_stripe(CAMERA, PLANE, pose, TARGET, 0.0, rng)
        rays = CAMERA.rays(stripe.uv)
        points = -PLANE.offset / (rays @ PLANE.normal)[:, None] * rays
        board = pose.inv().apply(points) if len(points) else points
        assert np.abs(board[:, 2]).max(initial=0.0) < 1e-8
        assert np.all((board[:, :2] > -3.001) & (board[:, :2] < 51.001))
        n_stripes += len(stripe) > 0
    assert n_stripes > 5


def test_noise_is_across_the_stripe() -> None:
    """Its standard deviation is the one asked for."""
    pose = random_board_poses(CAMERA, TARGET, 1, np.random.default_rng(3), spread=0.02)[0]
    clean = observe_stripe(CAMERA, PLANE, pose, TARGET, 0.0, np.random.default_rng(4))
    noisy = observe_stripe(CAMERA, PLANE, pose, TARGET, 0.3, np.random.default_rng(4))
    across = np.sum((noisy.uv - clean.uv) * clean.normal, axis=1)
    assert np.std(across) == pytest.approx(0.3, rel=4 / np.sqrt(2 * len(across)))
    along = np.linalg.norm(noisy.uv - clean.uv - across[:, None] * clean.normal, axis=1)
    assert along.max() < 1e-9


def test_a_target_that_is_too_large_is_refused() -> None:
    """There is no pose; the call was wrong."""
    with pytest.raises(ValueError, match="fits into the image in 0"):
        random_board_poses(CAMERA, DotGrid((9, 9), 60.0), 1, np.random.default_rng(5))
