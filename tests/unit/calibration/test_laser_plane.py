"""Laser plane: which stripe points count, what is refused, left out and warned of."""

from dataclasses import fields, replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from rotaline.calibration.laser_plane import StripeView, calibrate_laser_plane
from rotaline.calibration.pose import estimate_board_pose
from rotaline.calibration.stripe_on_board import place_stripe_on_board
from rotaline.errors import CalibrationError, DetectionError
from rotaline.geometry.primitives import Plane, unit
from rotaline.simulation.ideal.observations import observe_stripe, observe_target, random_board_poses
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid, Target, target_height

CAMERA = CameraModel((1280, 960), 2400.0, 2390.0, 645.0, 482.0, -0.11, 0.09, 0.0006, -0.0004)
PLANE = Plane(unit(np.array([0.85, -0.3, 0.45])), -145.0)
DOTS = DotGrid((9, 9), 6.0, 3.0)


def stripe_views(n: int = 8, seed: int = 0, target: Target = DOTS, plane: Plane = PLANE) -> list[StripeView]:
    """Poses in which the laser crosses the target."""
    rng = np.random.default_rng(seed)
    views = []
    for pose in random_board_poses(CAMERA, target, 5 * n, rng, spread=0.15):
        stripe = observe_stripe(CAMERA, plane, pose, target, 0.05, rng)
        if len(stripe) > 150 and len(views) < n:
            detection = observe_target(CAMERA, pose, target, 0.01, rng)
            views.append(StripeView(f"laser/{2 * len(views) + 1:04d}.png", detection, stripe))
    assert len(views) == n
    return views


def test_the_plane_points_away_from_the_camera() -> None:
    """Offset <= 0 whichever way the true one is written; no warning on good data; every point within a few sigma."""
    result = calibrate_laser_plane(CAMERA, stripe_views())
    assert result.plane_camera.offset < 0
    assert result.plane_camera.normal @ PLANE.normal > 0
    assert result.warnings == ()
    assert all(view.used and view.reason == "" for view in result.views)
    residuals = np.concatenate([view.residuals_mm for view in result.views])
    assert result.rms_mm == pytest.approx(float(np.sqrt(np.mean(residuals**2))))
    assert result.u_normal_rad[0] >= result.u_normal_rad[1] > 0


def test_points_on_and_near_dots_are_left_out() -> None:
    """No point nearer to the rim of a dot than a good part of the stripe's width."""
    for view in stripe_views():
        xy = place_stripe_on_board(CAMERA, view, 2.5).xy_board
        nearest = np.clip(np.round(xy / 6.0), 0, 8) * 6.0
        assert np.linalg.norm(xy - nearest, axis=1).min() > 1.5 + 0.5


@pytest.mark.parametrize("target", [Checkerboard((9, 8), 6.0), CharucoBoard((9, 8), 7.0, 5.0, "DICT_4X4_50")])
def test_points_near_edges_of_squares_are_left_out(target: Checkerboard | CharucoBoard) -> None:
    """The edges of squares, and on a ChArUco board the outer edges of markers."""
    for view in stripe_views(3, 1, target):
        xy = place_stripe_on_board(CAMERA, view, 2.0).xy_board / target.pitch
        assert np.abs(xy - np.round(xy)).min() * target.pitch > 0.2
        if isinstance(target, CharucoBoard):
            from_centre = np.abs(xy - np.floor(xy) - 0.5).max(axis=1) * target.pitch
            assert np.abs(from_centre - target.marker / 2).min() > 0.1


def test_reflections_and_points_off_the_target_are_left_out() -> None:
    """Stray pieces beside the stripe and beyond the plate do not enter."""
    clean = stripe_views()
    stray = []
    for view in clean:
        stripe = view.stripe
        uv = stripe.uv.copy()
        uv[::4] += 60.0 * stripe.normal[::4]
        uv[1::9] = [5.0, 5.0]
        stray.append(replace(view, stripe=replace(stripe, uv=uv)))
    a, b = calibrate_laser_plane(CAMERA, clean), calibrate_laser_plane(CAMERA, stray)
    assert all(view.used for view in b.views)
    assert b.rms_mm == pytest.approx(a.rms_mm, rel=0.1)
    centre = np.concatenate([view.points_camera for view in a.views]).mean(axis=0)[None]
    shift = a.plane_camera.signed_distance_to(centre) - b.plane_camera.signed_distance_to(centre)
    assert abs(shift[0]) < 4 * b.u_offset_mm


def test_a_view_whose_stripe_does_not_fit_is_named() -> None:
    """A mirror image of the laser, or a plate that moved between the two frames."""
    views = stripe_views()
    moved = views[3].stripe
    views[3] = replace(views[3], stripe=replace(moved, uv=moved.uv + np.array([9.0, 0.0])))
    result = calibrate_laser_plane(CAMERA, views)
    assert [k for k, view in enumerate(result.views) if not view.used] == [3]
    assert "from the plane of the others" in result.views[3].reason
    assert any("laser/0007.png was left out" in text for text in result.warnings)


def test_views_without_a_stripe_are_named() -> None:
    """An empty stripe, and one beside the target."""
    views = stripe_views()
    nothing = np.zeros(len(views[1].stripe), dtype=bool)
    views[1] = replace(views[1], stripe=views[1].stripe.select(nothing))
    beside = views[2].stripe
    views[2] = replace(views[2], stripe=replace(beside, uv=beside.uv * 0.02))
    result = calibrate_laser_plane(CAMERA, views)
    assert [k for k, view in enumerate(result.views) if not view.used] == [1, 2]
    assert "0 points" in result.views[1].reason
    assert "lie on the target" in result.views[2].reason
    assert len(result.views[1].uv) == 0


@pytest.mark.parametrize("n", [0, 1])
def test_too_few_poses_are_refused(n: int) -> None:
    """The message says how many are needed, and what to add."""
    with pytest.raises(CalibrationError, match=f"at least 2 poses .* found {n}.*Add poses"):
        calibrate_laser_plane(CAMERA, stripe_views(2)[:n])


def test_stripes_on_one_line_are_refused() -> None:
    """The same pose again and again: the plane can turn about the stripe."""
    rng = np.random.default_rng(2)
    pose = next(
        p
        for p in random_board_poses(CAMERA, DOTS, 40, rng)
        if len(observe_stripe(CAMERA, PLANE, p, DOTS, 0.0, rng)) > 150
    )
    views = [
        StripeView(
            f"{k}", observe_target(CAMERA, pose, DOTS, 0.01, rng), observe_stripe(CAMERA, PLANE, pose, DOTS, 0.05, rng)
        )
        for k in range(4)
    ]
    with pytest.raises(
        CalibrationError, match=r"lie on one line in space .* can turn .* nearer to the camera and farther"
    ):
        calibrate_laser_plane(CAMERA, views)


def test_two_poses_are_enough_but_warned_of() -> None:
    """Two stripes fix the plane; nothing tells whether one is wrong."""
    result = calibrate_laser_plane(CAMERA, stripe_views(2))
    assert any("Only 2 poses" in text for text in result.warnings)
    assert np.arccos(result.plane_camera.normal @ PLANE.normal) < 0.01


def test_a_target_without_pose_is_a_detection_error() -> None:
    """Points on a line have no pose; the reason says so."""
    view = stripe_views(1)[0]
    d = view.detection
    row = replace(view, detection=replace(d, point_ids=d.point_ids[:9], uv=d.uv[:9]))
    with pytest.raises(DetectionError, match="no pose"):
        place_stripe_on_board(CAMERA, row, 2.0)


def test_the_board_frame_may_be_half_turned() -> None:
    """A symmetric plate read from the other end gives the same plane."""
    views = stripe_views()
    turned = [
        replace(v, detection=replace(v.detection, uv=v.detection.uv[::-1].copy())) if k % 2 else v
        for k, v in enumerate(views)
    ]
    a, b = calibrate_laser_plane(CAMERA, views), calibrate_laser_plane(CAMERA, turned)
    np.testing.assert_allclose(a.plane_camera.normal, b.plane_camera.normal, atol=1e-6)
    assert isinstance(b.views[0].camera_from_board, RigidTransform)


def test_rays_meet_the_surface_of_a_bent_target() -> None:
    """Stripe points of a board that is known to be bent lie in the laser plane; taken for flat, they do not."""
    flat = Checkerboard((9, 8), 6.0)
    bent = replace(flat, bend=(0.4, -0.3, 0.1))
    view = stripe_views(1, 3, flat)[0]
    pose = estimate_board_pose(CAMERA, view.detection.points_board, view.detection.uv).camera_from_board
    seen = place_stripe_on_board(CAMERA, view, 0.0).xy_board
    direction = np.array(
        [0.3, 1.0]
    )  # along which the stripe shifts where the board is bent; any but that of the stripe
    xy = seen.copy()
    for _ in range(20):
        points = pose.apply(np.column_stack([xy, target_height(bent, xy)]))
        ahead = pose.apply(np.column_stack([xy + 1e-3 * direction, target_height(bent, xy + 1e-3 * direction)]))
        distance = PLANE.signed_distance_to(points)
        xy = xy - (distance / ((PLANE.signed_distance_to(ahead) - distance) / 1e-3))[:, None] * direction
    uv = CAMERA.project(pose.apply(np.column_stack([xy, target_height(bent, xy)])))
    ideal = CAMERA.project(pose.apply(bent.points_board()))
    stripe = replace(
        view.stripe,
        **{f.name: uv if f.name == "uv" else getattr(view.stripe, f.name)[: len(uv)] for f in fields(view.stripe)},
    )
    misfits = {}
    for name, target in (("bent", bent), ("flat", flat)):
        placed = place_stripe_on_board(
            CAMERA, StripeView(view.name, replace(view.detection, target=target, uv=ideal), stripe), 0.0
        )
        misfits[name] = float(np.abs(PLANE.signed_distance_to(placed.points_camera)).max())
    assert misfits["bent"] < 1e-4
    assert misfits["flat"] > 0.01
