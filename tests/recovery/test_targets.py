"""Targets: truth -> rendered picture -> detected points."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.simulation.ideal.targets import pixel_rays, render_target
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.detect import detect_target
from rotaline.vision.targets.grid_map import fit_grid_map
from rotaline.vision.targets.measure import measure_grid
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid
from rotaline.vision.targets.ordering import permuted, symmetry_permutations

CAMERA = CameraModel((1000, 800), 1500.0, 1500.0, 510.0, 390.0, k1=-0.2, k2=0.05, p1=1e-3, p2=-5e-4)
CHECKERBOARD = Checkerboard((13, 10), 5.0)
DOTS = DotGrid((9, 8), 7.0, 3.5)
CHARUCO = CharucoBoard((12, 9), 6.0, 4.5, "DICT_5X5_100")


@pytest.fixture(scope="module")
def rays():
    return pixel_rays(CAMERA)


def picture_of(target, rays, angles_deg, samples=4):
    """Noise-free picture and the images of the points."""
    rotation = Rotation.from_euler("zyx", angles_deg, degrees=True)
    points = target.points_board()
    pose = RigidTransform.from_components([2.0, -3.0, 180.0] - rotation.apply(points.mean(axis=0)), rotation)
    picture = render_target(CAMERA, pose, target, rays=rays, blur_px=0.6, samples=samples)
    return picture.over(50.0), CAMERA.project(pose.apply(points))


def errors_of(detection, truth):
    """Errors under the symmetry that fits best, px."""
    turned = [permuted(detection, p) for p in symmetry_permutations(detection.target)]
    errors = [t.uv - truth[t.point_ids] for t in turned]
    return min(errors, key=lambda e: float(np.sum(e**2)))


@pytest.mark.parametrize("target", [CHECKERBOARD, DOTS, CHARUCO], ids=["checkerboard", "dots", "charuco"])
@pytest.mark.parametrize("angles_deg", [(3.0, 0.0, 0.0), (75.0, 30.0, -25.0), (20.0, 5.0, 45.0)])
def test_errors_are_those_stated(target, angles_deg, rays):
    image, truth = picture_of(target, rays, angles_deg)
    noisy = image + np.random.default_rng(1).normal(0, 2.0, image.shape)
    detection = detect_target(np.clip(np.round(noisy), 0, 255).astype(np.uint8), target)
    errors = errors_of(detection, truth)
    n = errors.size
    # u_px is estimated from n values itself: relative standard uncertainty 1 / sqrt(2 n) each
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(detection.u_px, rel=4 * np.sqrt(2 / (2 * n)) + 0.1)
    assert np.abs(errors.mean(axis=0)).max() < 4 * detection.u_px / np.sqrt(n / 2) + 0.001
    assert detection.u_px < 0.0125  # half of what OpenCV's best corners reach under the same noise


@pytest.mark.parametrize("angles_deg", [(10.0, 45.0, 0.0), (10.0, 0.0, 45.0), (200.0, 32.0, -32.0)])
def test_dots_have_no_bias_of_perspective_and_distortion(angles_deg, rays):
    image, truth = picture_of(DOTS, rays, angles_deg)
    rng = np.random.default_rng(0)
    start = truth + rng.uniform(-0.4, 0.4, truth.shape)
    measured = measure_grid(image, DOTS, np.arange(len(truth)), start, dot_radius=1.7)
    assert len(measured.point_ids) == len(truth)
    assert np.abs(measured.uv - truth).max() < 0.003
    # the check can fail: the centres of the dots' outlines are off by more than that
    angle = np.linspace(0, 2 * np.pi, 360, endpoint=False)
    ring = DOTS.diameter / 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    grid_map = fit_grid_map(DOTS.points_board()[:, :2], truth)[0]
    outlines = np.array([grid_map.apply(xy + ring).mean(axis=0) for xy in DOTS.points_board()[:, :2]])
    assert np.abs(outlines - truth).max() > 0.01


@pytest.mark.parametrize("angles_deg", [(0.0, 0.0, 0.0), (12.0, 25.0, -30.0)])
def test_corners_have_no_bias(angles_deg, rays):
    image, truth = picture_of(CHECKERBOARD, rays, angles_deg)
    measured = measure_grid(image, CHECKERBOARD, np.arange(len(truth)), truth + 0.3)
    assert np.abs(measured.uv - truth).max() < 0.002


@pytest.mark.parametrize("target", [CHECKERBOARD, DOTS], ids=["checkerboard", "dots"])
def test_spread_of_repeats_is_the_one_stated(target, rays):
    image, truth = picture_of(target, rays, (30.0, 20.0, -15.0))
    rng = np.random.default_rng(2)
    ids = np.arange(len(truth))
    repeats, stated = [], []
    for _ in range(20):
        noisy = np.round(image + rng.normal(0, 2.0, image.shape))
        measured = measure_grid(noisy.astype(np.float32), target, ids, truth, 1.7 if target is DOTS else None)
        if len(measured.point_ids) == len(truth):
            repeats.append(measured.uv)
            stated.append(measured.u_px)
    assert len(repeats) >= 15
    spread = float(np.sqrt(np.mean(np.var(np.array(repeats), axis=0, ddof=1))))
    assert spread == pytest.approx(float(np.mean(stated)), rel=0.1)
    mean_error = np.mean(repeats, axis=0) - truth
    assert np.sqrt(np.mean(mean_error**2)) < 1.3 * spread / np.sqrt(len(repeats)) + 0.0005
