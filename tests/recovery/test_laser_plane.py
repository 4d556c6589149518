"""Laser plane: truth -> observations -> estimate, by points and by cross-ratios."""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.calibration.cross_ratio import optimise_plane_cross_ratio
from rotaline.calibration.laser_plane import StripeView, calibrate_laser_plane
from rotaline.calibration.model import LaserPlaneCalibration
from rotaline.geometry.primitives import Plane, unit
from rotaline.simulation.ideal.observations import observe_stripe, observe_target, random_board_poses
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid, Target

CAMERA = CameraModel((1280, 960), 2400.0, 2390.0, 645.0, 482.0, -0.11, 0.09, 0.0006, -0.0004)
STANDING = Plane(unit(np.array([0.85, -0.1, 0.5])), -150.0)
LYING = Plane(unit(np.array([0.1, -0.85, 0.5])), -150.0)
DOTS = DotGrid((9, 9), 6.0, 3.0)


def stripe_views(
    plane: Plane, target: Target, n: int, rng: np.random.Generator, sigma_px: float = 0.05
) -> list[StripeView]:
    """Poses in which the laser crosses the target."""
    views: list[StripeView] = []
    while len(views) < n:
        pose = random_board_poses(CAMERA, target, 1, rng, spread=0.15)[0]
        stripe = observe_stripe(CAMERA, plane, pose, target, sigma_px, rng, spacing_px=2.0)
        if len(stripe) > 120:
            detection = observe_target(CAMERA, pose, target, 0.02, rng)
            views.append(StripeView(f"laser/{len(views)}", detection, stripe))
    return views


def normalised_errors(result: LaserPlaneCalibration, truth: Plane) -> np.ndarray:
    """Error of the offset at the centroid and of the two tilts, in units of their standard uncertainties."""
    points = np.concatenate([view.points_camera for view in result.views if view.used])
    centroid = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points - centroid, full_matrices=False)
    plane = result.plane_camera
    shift = truth.signed_distance_to(centroid[None])[0] - plane.signed_distance_to(centroid[None])[0]
    tilt = axes[:2] @ (truth.normal - plane.normal)
    return np.array([shift / result.u_offset_mm, tilt[1] / result.u_normal_rad[0], tilt[0] / result.u_normal_rad[1]])


@pytest.mark.parametrize("plane", [STANDING, LYING])
@pytest.mark.parametrize("target", [DOTS, Checkerboard((9, 8), 6.0), CharucoBoard((10, 9), 6.0, 4.5, "DICT_4X4_50")])
def test_plane_within_four_sigma(plane: Plane, target: Target) -> None:
    """Any target with a pose, stripes standing and lying."""
    result = calibrate_laser_plane(CAMERA, stripe_views(plane, target, 8, np.random.default_rng(1)))
    assert np.abs(normalised_errors(result, plane)).max() < 4


def test_spread_of_repeats_is_what_is_stated() -> None:
    """The poses' errors move all points of a view together; the stated uncertainty holds nevertheless."""
    rng = np.random.default_rng(2)
    errors = np.array(
        [
            normalised_errors(calibrate_laser_plane(CAMERA, stripe_views(STANDING, DOTS, 6, rng)), STANDING)
            for _ in range(36)
        ]
    )
    n = len(errors)
    assert np.abs(errors.mean(axis=0)).max() < 4 / np.sqrt(n)
    assert np.abs(errors.std(axis=0, ddof=1) - 1).max() < 4 / np.sqrt(2 * n)


def test_scatter_between_views_enters_the_uncertainty() -> None:
    """Plates that are off their poses by 0.05 mm, which no detection knows of."""
    rng = np.random.default_rng(3)
    errors, offsets = [], []
    for _ in range(10):
        views = []
        for view in stripe_views(STANDING, DOTS, 8, rng):
            moved = view.stripe.uv + rng.normal(0.0, 0.4) * view.stripe.normal[0]
            views.append(replace(view, stripe=replace(view.stripe, uv=moved)))
        result = calibrate_laser_plane(CAMERA, views)
        errors.append(normalised_errors(result, STANDING))
        offsets.append(result.u_offset_mm)
    # Student's t with some 13 degrees of freedom is a little wider than a Gaussian
    assert np.abs(errors).max() < 6
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(1.0, abs=0.35)
    assert np.mean(offsets) > 0.005


def test_outliers_do_not_move_the_plane() -> None:
    """A fifth of the points stray, and one view in eight is wrong."""
    rng = np.random.default_rng(4)
    views = stripe_views(STANDING, DOTS, 8, rng)
    for k, view in enumerate(views):
        uv = view.stripe.uv.copy()
        chosen = rng.random(len(uv)) < 0.2
        uv[chosen] += rng.normal(0.0, 20.0, (int(chosen.sum()), 2))
        views[k] = replace(view, stripe=replace(view.stripe, uv=uv + (12.0 if k == 5 else 0.0)))
    result = calibrate_laser_plane(CAMERA, views)
    assert [k for k, view in enumerate(result.views) if not view.used] == [5]
    assert np.abs(normalised_errors(result, STANDING)).max() < 4


@pytest.mark.parametrize("plane", [STANDING, LYING])
def test_cross_ratios_recover_a_plane_without_poses(plane: Plane) -> None:
    """From a plane that is off by 3 mrad and 0.3 mm to the interval errors of the true plane, by rows and by columns."""
    rng = np.random.default_rng(5)
    views = stripe_views(plane, DOTS, 10, rng)
    fit = calibrate_laser_plane(CAMERA, views)
    off = Plane(unit(fit.plane_camera.normal + np.array([0.002, 0.001, -0.002])), fit.plane_camera.offset + 0.3)
    moved = tuple(replace(v, residuals_mm=off.signed_distance_to(v.points_camera)) for v in fit.views)
    result = optimise_plane_cross_ratio(CAMERA, replace(fit, plane_camera=off, views=moved), views)
    true = optimise_plane_cross_ratio(CAMERA, replace(fit, plane_camera=plane), views)
    assert result.accepted
    assert result.rmse_before_mm > 0.01
    assert result.rmse_after_mm <= true.rmse_before_mm
