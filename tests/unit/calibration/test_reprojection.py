"""Derivatives of the projection, and least squares over camera and poses."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.reprojection import (
    BoardObservation,
    covariance_from_factor,
    get_parameters,
    projection_jacobians,
    refine_bundle,
    set_parameters,
)
from rotaline.simulation.ideal.observations import observe_target, random_board_poses
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import Checkerboard

CAMERA = CameraModel((1280, 960), 1500.0, 1490.0, 655.0, 470.0, -0.2, 0.12, 0.002, -0.003, 0.03)
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
TARGET = Checkerboard((8, 6), 12.0)
POINTS = TARGET.points_board()


def moved(pose: RigidTransform, step: np.ndarray) -> RigidTransform:
    """The pose after a rotation vector about the centre of the points, and a shift, along the camera's axes."""
    pivot = pose.apply(POINTS).mean(axis=0)
    turn = Rotation.from_rotvec(step[:3])
    return RigidTransform.from_components(pivot + step[3:] - turn.apply(pivot), turn) * pose


@settings(deadline=None, max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_derivatives_match_differences(seed: int) -> None:
    """Analytic against central differences, for every camera parameter and pose component."""
    pose = random_board_poses(CAMERA, TARGET, 1, np.random.default_rng(seed))[0]
    uv, by_camera, by_pose = projection_jacobians(CAMERA, pose.apply(POINTS), NAMES)
    np.testing.assert_allclose(uv, CAMERA.project(pose.apply(POINTS)), atol=1e-12)
    values = get_parameters(CAMERA, NAMES)
    for k in range(len(NAMES)):
        step = np.zeros(len(NAMES))
        step[k] = 1e-5 * max(abs(values[k]), 1.0)
        ahead = set_parameters(CAMERA, NAMES, values + step).project(pose.apply(POINTS))
        back = set_parameters(CAMERA, NAMES, values - step).project(pose.apply(POINTS))
        np.testing.assert_allclose(by_camera[:, :, k], (ahead - back) / (2 * step[k]), atol=1e-4, rtol=1e-5)
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-5
        ahead = CAMERA.project(moved(pose, step).apply(POINTS))
        back = CAMERA.project(moved(pose, -step).apply(POINTS))
        np.testing.assert_allclose(by_pose[:, :, k], (ahead - back) / 2e-5, atol=1e-3, rtol=1e-5)


def test_bundle_reaches_the_truth_without_noise() -> None:
    """From a camera 5 % off and disturbed poses, to rounding."""
    rng = np.random.default_rng(3)
    poses = random_board_poses(CAMERA, TARGET, 6, rng)
    observations = [
        BoardObservation(POINTS, observe_target(CAMERA, pose, TARGET, 0.0, rng).uv, np.ones(len(POINTS)))
        for pose in poses
    ]
    start = CameraModel(CAMERA.image_size, 1575.0, 1430.0, 640.0, 480.0)
    disturbed = [moved(p, np.array([0.02, -0.02, 0.01, 1.0, -1.0, 5.0])) for p in poses]
    fit = refine_bundle(start, disturbed, observations, NAMES)
    assert fit.converged
    np.testing.assert_allclose(get_parameters(fit.camera, NAMES[:4]), get_parameters(CAMERA, NAMES[:4]), rtol=1e-7)
    np.testing.assert_allclose(get_parameters(fit.camera, NAMES[4:]), get_parameters(CAMERA, NAMES[4:]), atol=1e-5)


def test_points_of_weight_zero_have_no_say() -> None:
    """A wild point with weight 0 changes nothing, even if it is NaN."""
    rng = np.random.default_rng(4)
    pose = random_board_poses(CAMERA, TARGET, 1, rng)[0]
    uv = observe_target(CAMERA, pose, TARGET, 0.02, rng).uv
    weights = np.ones(len(uv))
    weights[7] = 0.0
    wild = uv.copy()
    wild[7] = np.nan
    fits = [refine_bundle(CAMERA, [pose], [BoardObservation(POINTS, x, weights)], ()) for x in (uv, wild)]
    assert fits[0].cost == pytest.approx(fits[1].cost, rel=1e-12)
    assert fits[0].cost > 0


def test_covariance_of_an_open_parameter_is_huge_and_finite() -> None:
    """Two equal columns: their difference is open."""
    factor = np.linalg.qr(np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]), mode="r")
    cov = covariance_from_factor(np.asarray(factor), 1.0)
    assert np.isfinite(cov).all()
    assert cov[0, 0] > 1e10
