"""Camera: truth -> observations -> estimate; errors against the stated uncertainties, and their spread over repeats."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from rotaline.calibration.intrinsics import CameraOptions, calibrate_camera
from rotaline.calibration.model import CameraCalibration, TargetView
from rotaline.calibration.pose import estimate_board_pose
from rotaline.simulation.ideal.observations import observe_target, random_board_poses
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import Checkerboard, TargetDetection

TELE = CameraModel((1280, 960), 2400.0, 2390.0, 645.0, 482.0, -0.11, 0.09, 0.0006, -0.0004)
WIDE = CameraModel((640, 480), 420.0, 421.0, 330.0, 235.0, -0.31, 0.11, -0.001, 0.0015)
UPRIGHT = CameraModel((3000, 4000), 5200.0, 5200.0, 1480.0, 2040.0, 0.08, -0.2, 0.0, 0.001)
TARGET = Checkerboard((9, 7), 7.0)


def calibrated(
    camera: CameraModel, n: int, sigma_px: float, seed: int, options: CameraOptions, distance: tuple[float, float]
) -> CameraCalibration:
    """Calibrate from ``n`` views with Gaussian noise."""
    rng = np.random.default_rng(seed)
    poses = random_board_poses(camera, TARGET, n, rng, spread=0.4, distance_mm=distance)
    views = [TargetView(f"v{k}", observe_target(camera, p, TARGET, sigma_px, rng)) for k, p in enumerate(poses)]
    return calibrate_camera(views, camera.image_size, options)


def normalised_errors(result: CameraCalibration, truth: CameraModel) -> np.ndarray:
    """Errors of all parameters in units of their standard deviations."""
    found = np.array([getattr(result.camera, name) for name in result.parameter_names])
    true = np.array([getattr(truth, name) for name in result.parameter_names])
    return (found - true) / result.u_parameters


@pytest.mark.parametrize(
    ("camera", "distance"), [(TELE, (220.0, 380.0)), (WIDE, (80.0, 200.0)), (UPRIGHT, (170.0, 300.0))]
)
@pytest.mark.parametrize(("n", "sigma_px"), [(3, 0.02), (20, 0.2)])
def test_camera_within_four_sigma(camera: CameraModel, distance: tuple[float, float], n: int, sigma_px: float) -> None:
    """Narrow and wide lenses, small and large images, few precise and many coarse views."""
    result = calibrated(camera, n, sigma_px, 1, CameraOptions(weak_parameters="free"), distance)
    assert np.abs(normalised_errors(result, camera)).max() < 4
    assert result.rms_px == pytest.approx(sigma_px * np.sqrt(2), rel=0.15)


def test_spread_of_repeats_is_what_is_stated() -> None:
    """Normalised errors of 36 repeats have mean 0 and standard deviation 1, to their own 4-sigma limits."""
    errors = np.array(
        [
            normalised_errors(calibrated(TELE, 6, 0.05, seed, CameraOptions(), (220.0, 380.0)), TELE)
            for seed in range(36)
        ]
    )
    n = len(errors)
    assert np.abs(errors.mean(axis=0)).max() < 4 / np.sqrt(n)
    assert np.abs(errors.std(axis=0, ddof=1) - 1).max() < 4 / np.sqrt(2 * n)


def calibrated_from_print(seed: int) -> CameraCalibration:
    """From eight views of a print that is bowed by 0.05 mm and whose corners are off by 0.02 mm, another one for each seed."""
    rng = np.random.default_rng(seed)
    target = Checkerboard((8, 5), 8.0)
    points = replace(target, bend=(0.05, 0.0, 0.05)).points_board()
    points[:, :2] += 0.02 * rng.standard_normal((len(points), 2))
    views = []
    for k, pose in enumerate(random_board_poses(TELE, target, 8, rng, spread=0.4, distance_mm=(220.0, 380.0))):
        uv = TELE.project(pose.apply(points)) + 0.03 * rng.standard_normal((len(points), 2))
        views.append(TargetView(f"v{k}", TargetDetection(target, np.arange(len(points)), uv, 0.03)))
    return calibrate_camera(views, TELE.image_size)


def test_spread_of_repeats_with_bad_prints_is_what_is_stated() -> None:
    """As above, with the errors of the print drawn anew each time: the offsets are estimated, and their uncertainty counts."""
    results = [calibrated_from_print(seed) for seed in range(36)]
    assert all(result.targets and result.targets[0].offsets for result in results)
    errors = np.array([normalised_errors(result, TELE) for result in results])
    n = len(errors)
    assert np.abs(errors.mean(axis=0)).max() < 4 / np.sqrt(n)
    assert np.abs(errors.std(axis=0, ddof=1) - 1).max() < 4 / np.sqrt(2 * n)


def test_k3_is_found_where_asked_for() -> None:
    """A lens with a third radial term."""
    camera = CameraModel((640, 480), 420.0, 421.0, 330.0, 235.0, -0.31, 0.11, -0.001, 0.0015, 0.05)
    result = calibrated(camera, 15, 0.02, 2, CameraOptions(distortion="k1k2p1p2k3"), (80.0, 200.0))
    assert np.abs(normalised_errors(result, camera)).max() < 4


def test_regularised_camera_is_within_what_it_states() -> None:
    """Three coarse views: the focal length leans on a central principal point, and its stated uncertainty holds."""
    camera = CameraModel((1280, 960), 2400.0, 2395.0, 660.0, 470.0, -0.11, 0.09)
    rng = np.random.default_rng(3)
    for _ in range(5):
        poses = random_board_poses(camera, TARGET, 3, rng, spread=0.1, tilt_deg=(15.0, 30.0))
        views = [TargetView(f"v{k}", observe_target(camera, p, TARGET, 0.3, rng)) for k, p in enumerate(poses)]
        result = calibrate_camera(views, camera.image_size)
        assert any("by themselves" in text for text in result.warnings)
        assert np.abs(normalised_errors(result, camera))[:4].max() < 4


def weak_session(seed: int) -> tuple[CameraModel, list[TargetView], list[RigidTransform]]:
    """Four to six little tilted views, a principal point some 6 % off the centre, and other poses to judge the camera by."""
    rng = np.random.default_rng(seed)
    focal = rng.uniform(600.0, 1300.0)
    cx, cy = np.array([319.5, 239.5]) + 0.06 * 640 * rng.standard_normal(2)
    corner = 400 / focal
    camera = CameraModel((640, 480), focal, focal, float(cx), float(cy), rng.uniform(-0.1, 0.05) / corner**2)
    depth = 0.3 * focal  # the board fills a tenth of the image
    poses = random_board_poses(
        camera,
        TARGET,
        int(rng.integers(4, 7)),
        rng,
        spread=0.2,
        tilt_deg=(3.0, 20.0),
        distance_mm=(0.9 * depth, 1.1 * depth),
    )
    views = [TargetView(f"v{k}", observe_target(camera, p, TARGET, 0.15, rng)) for k, p in enumerate(poses)]
    others = random_board_poses(camera, TARGET, 5, rng, tilt_deg=(5.0, 35.0), distance_mm=(0.85 * depth, 1.15 * depth))
    return camera, views, others


def test_leaning_on_lenses_makes_weak_cameras_better() -> None:
    """Over 12 weak sessions, by what counts: how wrong boards stand to each other that are seen with the camera."""
    rng = np.random.default_rng(0)
    points = TARGET.points_board()
    errors: dict[str, list[float]] = {"regularise": [], "free": []}
    for seed in range(12):
        camera, views, poses = weak_session(seed)
        seen = [observe_target(camera, p, TARGET, 0.0, rng).uv for p in poses]
        for how in ("regularise", "free"):
            found = calibrate_camera(views, camera.image_size, CameraOptions(weak_parameters=how)).camera
            placed = [estimate_board_pose(found, points, uv).camera_from_board for uv in seen]
            between = [
                (placed[0].inv() * a).apply(points) - (poses[0].inv() * b).apply(points)
                for a, b in zip(placed[1:], poses[1:], strict=True)
            ]
            errors[how].append(float(np.sqrt(np.mean(np.square(between)))))
    assert np.mean(errors["regularise"]) < np.mean(errors["free"])


def test_spread_of_poses_is_what_is_stated() -> None:
    """The covariance of a pose against 150 repeats, in all six directions."""
    rng = np.random.default_rng(4)
    pose = random_board_poses(TELE, TARGET, 1, rng)[0]
    points = TARGET.points_board()
    pivot = pose.apply(points).mean(axis=0)
    errors, covs = [], []
    for _ in range(150):
        found = estimate_board_pose(TELE, points, observe_target(TELE, pose, TARGET, 0.05, rng).uv)
        difference = found.camera_from_board * pose.inv()
        errors.append(np.concatenate([difference.rotation.as_rotvec(), difference.apply(pivot) - pivot]))
        covs.append(found.cov_pose)
    whiten = np.linalg.inv(np.linalg.cholesky(np.mean(covs, axis=0)))
    scaled = np.array(errors) @ whiten.T
    n = len(scaled)
    assert np.abs(scaled.mean(axis=0)).max() < 4 / np.sqrt(n)
    assert np.abs(scaled.std(axis=0, ddof=1) - 1).max() < 4 / np.sqrt(2 * n)
