"""Laser plane optimisation by cross-ratios: when it helps, when it is not accepted, when it cannot be done."""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.calibration.cross_ratio import CrossRatioOptions, optimise_plane_cross_ratio
from rotaline.calibration.laser_plane import StripeView, calibrate_laser_plane
from rotaline.calibration.model import LaserPlaneCalibration
from rotaline.calibration.pose import estimate_board_pose
from rotaline.calibration.stripe_on_board import board_plane, place_stripe_on_board
from rotaline.errors import CalibrationError
from rotaline.geometry.intersect import intersect_rays_with_plane
from rotaline.geometry.primitives import Plane, unit
from rotaline.simulation.ideal.observations import observe_stripe, observe_target, random_board_poses
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import DotGrid

CAMERA = CameraModel((1280, 960), 2400.0, 2390.0, 645.0, 482.0, -0.11, 0.09, 0.0006, -0.0004)
PLANE = Plane(unit(np.array([0.85, -0.3, 0.45])), -145.0)
DOTS = DotGrid((9, 9), 6.0, 3.0)


def stripe_views(n: int = 8, seed: int = 0) -> list[StripeView]:
    """Poses in which the laser crosses most rows of the plate."""
    rng = np.random.default_rng(seed)
    views: list[StripeView] = []
    for pose in random_board_poses(CAMERA, DOTS, 8 * n, rng, spread=0.15):
        stripe = observe_stripe(CAMERA, PLANE, pose, DOTS, 0.05, rng)
        if len(stripe) > 250 and len(views) < n:
            views.append(StripeView(f"laser/{len(views)}", observe_target(CAMERA, pose, DOTS, 0.01, rng), stripe))
    assert len(views) == n
    return views


def displaced(calibration: LaserPlaneCalibration, tilt_rad: float, shift_mm: float) -> LaserPlaneCalibration:
    """A fit to points that went wrong: the plane is off, and does not fit the points that it claims to."""
    plane = calibration.plane_camera
    normal = unit(plane.normal + tilt_rad * unit(np.cross(plane.normal, [0.0, 0.0, 1.0])))
    moved = Plane(normal, plane.offset + shift_mm)
    views = tuple(replace(v, residuals_mm=moved.signed_distance_to(v.points_camera)) for v in calibration.views)
    return replace(calibration, plane_camera=moved, views=views)


@pytest.mark.parametrize("method", ["sqp", "least-squares"])
def test_a_wrong_plane_is_put_right(method: str) -> None:
    """Both methods find the least interval error from a plane that is off; the history leads there."""
    views = stripe_views()
    good = calibrate_laser_plane(CAMERA, views)
    result = optimise_plane_cross_ratio(CAMERA, displaced(good, 0.003, 0.3), views, CrossRatioOptions(method=method))
    assert result.accepted
    assert result.reason == ""
    assert result.converged
    assert result.rmse_after_mm < 0.1 * result.rmse_before_mm
    assert result.history_mm[0] == pytest.approx(result.rmse_before_mm)
    assert result.history_mm[-1] == pytest.approx(result.rmse_after_mm, rel=1e-3)
    errors = result.measured_after_mm - result.reference_mm
    assert result.rmse_after_mm == pytest.approx(float(np.sqrt(np.mean(errors**2))))
    assert np.arccos(min(result.plane_camera.normal @ PLANE.normal, 1.0)) < 5e-4
    assert set(result.view.tolist()) == set(range(len(result.names)))


def test_both_methods_agree() -> None:
    """The same minimum to far below its uncertainty."""
    views = stripe_views(seed=1)
    start = displaced(calibrate_laser_plane(CAMERA, views), -0.002, 0.1)
    a, b = (
        optimise_plane_cross_ratio(CAMERA, start, views, CrossRatioOptions(method=m)) for m in ("sqp", "least-squares")
    )
    assert a.rmse_after_mm == pytest.approx(b.rmse_after_mm, rel=1e-4)
    np.testing.assert_allclose(a.plane_camera.normal, b.plane_camera.normal, atol=2e-5)


def test_noise_alone_is_not_accepted() -> None:
    """Where the points already know the plane better, the optimised one is not taken, and the report can say why."""
    views = stripe_views(seed=2)
    start = calibrate_laser_plane(CAMERA, views)
    result = optimise_plane_cross_ratio(CAMERA, start, views)
    assert not result.accepted
    assert "not clearly better" in result.reason
    assert result.plane_camera is start.plane_camera
    assert result.rmse_after_mm <= result.rmse_before_mm


def test_a_plane_that_contradicts_the_points_is_not_accepted() -> None:
    """A wrong pitch makes all intervals wrong; moving the plane to please them leaves the points behind."""
    views = stripe_views(seed=3)
    start = calibrate_laser_plane(CAMERA, views)
    wrong = DotGrid((9, 9), 6.03, 3.0)
    stretched = [replace(v, detection=replace(v.detection, target=wrong)) for v in views]
    result = optimise_plane_cross_ratio(CAMERA, start, stretched)
    assert not result.accepted
    assert "contradicts the stripe points" in result.reason
    assert result.plane_camera is start.plane_camera


def test_bad_intervals_are_left_out() -> None:
    """A piece of an oblique stripe that a scratch on the plate has shifted spoils its own intervals only."""
    views = stripe_views(seed=4)
    start = calibrate_laser_plane(CAMERA, views)
    placed = [place_stripe_on_board(CAMERA, view, 2.5) for view in views]
    k = int(np.argmax([np.abs(p.line_board.direction).min() for p in placed]))
    stripe = views[k].stripe
    from_row = placed[k].pose.camera_from_board.inv().apply(_on_board(views[k]))[:, 1] / DOTS.pitch - 4.0
    uv = stripe.uv + np.where((np.abs(from_row) < 0.5)[:, None], 0.15 * stripe.normal, 0.0)
    views[k] = replace(views[k], stripe=replace(stripe, uv=uv))
    result = optimise_plane_cross_ratio(CAMERA, start, views, CrossRatioOptions(window_pitches=0.5))
    assert any("far off the others" in text for text in result.warnings)
    assert result.rmse_before_mm < 0.004


def test_a_row_of_dots_that_is_off_has_no_interval() -> None:
    """Dots that do not fit the others have no say in the crossings either."""
    views = stripe_views(seed=4)
    start = calibrate_laser_plane(CAMERA, views)
    directions = [place_stripe_on_board(CAMERA, view, 2.5).line_board.direction for view in views]
    k = next(k for k, (x, y) in enumerate(directions) if abs(y) > abs(x))
    views[k].detection.uv[views[k].detection.point_ids // 9 == 4] += [0.0, 0.5]
    result = optimise_plane_cross_ratio(CAMERA, start, views)
    assert not {3, 4} & set(result.row[result.view == k].tolist())
    assert result.rmse_before_mm < 0.004


def test_views_left_out_of_the_plane_are_left_out_here() -> None:
    """A view that the plane did not take gives no intervals."""
    views = stripe_views(seed=5)
    start = calibrate_laser_plane(CAMERA, views)
    dropped = tuple(replace(v, used=k != 1) for k, v in enumerate(start.views))
    result = optimise_plane_cross_ratio(CAMERA, replace(start, views=dropped), views)
    assert views[1].name not in result.names
    assert len(result.names) == len(views) - 1


def test_too_few_poses_cannot_be_tested() -> None:
    """Two poses leave nothing to try the plane on."""
    views = stripe_views(2, seed=6)
    start = displaced(calibrate_laser_plane(CAMERA, views), 0.002, 0.1)
    result = optimise_plane_cross_ratio(CAMERA, start, views)
    assert not result.accepted
    assert "fewer than three poses" in result.reason


def test_no_intervals_are_refused() -> None:
    """The stripe reaches two rows only: the message says what is missing."""
    views = stripe_views(seed=7)
    start = calibrate_laser_plane(CAMERA, views)
    with pytest.raises(CalibrationError, match="at least 6 intervals"):
        optimise_plane_cross_ratio(CAMERA, start, [])


def _on_board(view: StripeView) -> np.ndarray:
    """All points of the stripe, on the plane of the plate, in the camera frame."""
    pose = estimate_board_pose(CAMERA, view.detection.points_board, view.detection.uv)
    return intersect_rays_with_plane(CAMERA.rays(view.stripe.uv), board_plane(pose))
