"""Truth -> stripe points -> feature points: any roll, side and sense; hidden pieces, reflections, noise."""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.calibration.feature_points import FeaturePoints, extract_feature_points, extract_mount_features
from rotaline.calibration.stepped_profile import LARGE_SIDE, PIECES, STEP, TOP
from rotaline.geometry.primitives import Line, SteppedCylinder, unit
from rotaline.simulation.ideal.circles import TurntableRig, ideal_feature_points, ideal_rig, pose_on_table
from rotaline.simulation.ideal.profiles import IdealStripe, ideal_stepped_stripe
from rotaline.vision.camera import CameraModel
from rotaline.vision.stripe.model import StripePoints

ARTIFACT = SteppedCylinder(23.051, 36.006, 22.003, 25.005)
CAMERA = CameraModel((1280, 960), 2000.0, 2000.0, 640.0, 480.0, -0.11, 0.09, 0.0006, -0.0004)
POSE = pose_on_table((4.0, -2.0), (0.2, 0.3))


def _stripe(
    ideal: IdealStripe, sigma_px: float, rng: np.random.Generator, keep: np.ndarray | None = None
) -> StripePoints:
    keep = np.ones(len(ideal.uv), dtype=bool) if keep is None else keep
    uv = ideal.uv + sigma_px * rng.standard_normal((len(ideal.uv), 1)) * ideal.normal
    n = len(uv)
    return StripePoints(
        uv,
        ideal.normal,
        np.full(n, 1.5),
        np.full(n, 150.0),
        np.full(n, sigma_px),
        np.zeros(n, dtype=bool),
        np.zeros(n, dtype=int),
    ).select(keep)


def _case(rig: TurntableRig, angle_deg: float = 30.0) -> tuple[IdealStripe, np.ndarray]:
    angle = np.radians(angle_deg)
    truth = ideal_feature_points(ARTIFACT, rig, POSE, np.array([angle]))[0]
    return ideal_stepped_stripe(ARTIFACT, rig, POSE, float(angle), CAMERA), truth


def _rough(rig: TurntableRig) -> Line:
    axis = rig.axis_camera
    return Line(axis.point + np.array([0.4, 0.3, 0.0]), unit(axis.direction + np.array([0.012, 0.0, 0.012])))


def _errors(found: FeaturePoints, truth: np.ndarray) -> np.ndarray:
    return np.linalg.norm(found.points_camera - truth, axis=1)


@pytest.mark.parametrize("know_axis", [True, False])
@pytest.mark.parametrize("azimuth_deg", [40.0, -40.0])
@pytest.mark.parametrize("roll_deg", [0.0, 90.0, -90.0, 180.0, 30.0])
def test_any_roll_and_side(roll_deg: float, azimuth_deg: float, know_axis: bool) -> None:
    rng = np.random.default_rng(1)
    rig = ideal_rig(roll_deg=roll_deg, laser_azimuth_deg=azimuth_deg, laser_offset_mm=1.0, laser_tilt_deg=0.3)
    ideal, truth = _case(rig)
    found = extract_feature_points(
        _stripe(ideal, 0.1, rng), CAMERA, rig.laser_plane_camera, ARTIFACT, _rough(rig) if know_axis else None
    )
    assert found.reason == ""
    assert np.all(_errors(found, truth) < 4 * found.u_mm)
    assert np.all(found.piece[found.piece >= 0] == ideal.piece[found.piece >= 0])
    assert set(np.unique(found.piece)) == {-1, 0, 1, 2, 3, 4}


def test_inclined_laser_plane_cuts_the_sides_in_ellipses() -> None:
    """With the axis known the bend of the sides is part of their lines: a parabola leaves micrometres of tens."""
    rng = np.random.default_rng(2)
    rig = ideal_rig(laser_offset_mm=5.0, laser_tilt_deg=6.0)
    ideal, truth = _case(rig, 300.0)
    stripe = _stripe(ideal, 1e-4, rng)
    plane = rig.laser_plane_camera
    straight = _errors(extract_feature_points(stripe, CAMERA, plane, ARTIFACT), truth)
    bent = _errors(extract_feature_points(stripe, CAMERA, plane, ARTIFACT, rig.axis_camera), truth)
    assert straight.max() > 0.020
    assert bent.max() < 0.010


def test_stated_uncertainty_is_the_spread_of_repeats() -> None:
    rng = np.random.default_rng(3)
    rig = ideal_rig(laser_offset_mm=0.5)
    ideal, truth = _case(rig)
    errors, stated = [], []
    for _ in range(60):
        found = extract_feature_points(_stripe(ideal, 0.15, rng), CAMERA, rig.laser_plane_camera, ARTIFACT)
        errors.append(found.points_camera - truth)
        stated.append(found.u_mm)
    spread = np.sqrt(np.linalg.eigvalsh(np.einsum("khi,khj->hij", errors, errors) / len(errors))[:, -1])
    ratio = spread / np.sqrt(np.mean(np.square(stated), axis=0))
    # the stated u is the larger of the two lines', the spread the larger axis of the ellipse
    assert np.all(ratio > 0.6), ratio
    assert np.all(ratio < 1.5), ratio


def test_blurred_edges_do_not_move_the_corners() -> None:
    """Rounded corners, as blur makes them: only the points near the edges are touched, and those are left out."""
    rng = np.random.default_rng(4)
    rig = ideal_rig()
    ideal, truth = _case(rig)
    smooth = ideal.uv.copy()
    for _ in range(4):
        smooth[1:-1] = (smooth[:-2] + smooth[1:-1] + smooth[2:]) / 3
    assert np.abs(smooth - ideal.uv).max() > 0.3
    stripe = _stripe(replace(ideal, uv=smooth), 0.02, rng)
    found = extract_feature_points(stripe, CAMERA, rig.laser_plane_camera, ARTIFACT)
    assert np.all(_errors(found, truth) < 4 * found.u_mm)


def test_outliers_and_reflections() -> None:
    rng = np.random.default_rng(5)
    rig = ideal_rig()
    ideal, truth = _case(rig)
    clean = _stripe(ideal, 0.05, rng)
    ghost = clean.uv[ideal.piece == LARGE_SIDE] + np.array([35.0, 8.0])
    bar = np.column_stack([np.linspace(200, 500, 200), np.linspace(850, 700, 200)])
    spikes = clean.uv[::15] + rng.normal(0, 6.0, clean.uv[::15].shape)
    uv = np.concatenate([clean.uv, ghost, bar, spikes])
    tangent = np.concatenate(
        [np.diff(part, axis=0, append=part[-1:] + (part[-1:] - part[-2:-1])) for part in (ghost, bar, spikes)]
    )
    tangent /= np.linalg.norm(tangent, axis=1)[:, None]
    normal = np.concatenate([clean.normal, np.column_stack([-tangent[:, 1], tangent[:, 0]])])
    n = len(uv)
    dirty = StripePoints(
        uv,
        normal,
        np.full(n, 1.5),
        np.full(n, 150.0),
        np.full(n, 0.05),
        np.zeros(n, dtype=bool),
        np.zeros(n, dtype=int),
    )
    found = extract_feature_points(dirty, CAMERA, rig.laser_plane_camera, ARTIFACT)
    assert found.reason == ""
    assert np.all(_errors(found, truth) < 4 * found.u_mm)


@pytest.mark.parametrize("hidden", range(5))
def test_frames_with_a_hidden_piece_use_the_rest(hidden: int) -> None:
    rng = np.random.default_rng(6)
    rig = ideal_rig()
    angles = np.arange(0.0, 360.0, 30.0)
    cases = [_case(rig, a) for a in angles]
    stripes = [
        _stripe(ideal, 0.05, rng, ideal.piece != hidden if k == 3 else None) for k, (ideal, _) in enumerate(cases)
    ]
    found = extract_mount_features(stripes, CAMERA, rig.laser_plane_camera, ARTIFACT)
    for k, (features, (_, truth)) in enumerate(zip(found, cases, strict=True)):
        missing = {h for h in range(4) if k == 3 and hidden in (h, h + 1)}
        assert set(np.flatnonzero(np.isnan(features.points_camera[:, 0])).tolist()) == missing
        there = [h for h in range(4) if h not in missing]
        assert np.all(_errors(features, truth)[there] < 4 * features.u_mm[there])
        assert (PIECES[hidden] in features.reason) == bool(missing)


def test_half_hidden_frame_is_placed_by_the_others() -> None:
    """Two pieces alone could be top and small side, or step and large side: the other frames tell the height."""
    rng = np.random.default_rng(7)
    rig = ideal_rig()
    cases = [_case(rig, a) for a in np.arange(0.0, 360.0, 45.0)]
    stripes = [
        _stripe(ideal, 0.05, rng, np.isin(ideal.piece, (STEP, LARGE_SIDE)) if k == 2 else None)
        for k, (ideal, _) in enumerate(cases)
    ]
    found = extract_mount_features(stripes, CAMERA, rig.laser_plane_camera, ARTIFACT)
    half = found[2]
    assert np.flatnonzero(np.isfinite(half.points_camera[:, 0])).tolist() == [2]
    assert _errors(half, cases[2][1])[2] < 4 * half.u_mm[2]
    alone = extract_feature_points(stripes[2], CAMERA, rig.laser_plane_camera, ARTIFACT)
    assert np.isnan(alone.points_camera).all()


def test_stripe_on_something_else_gives_nothing() -> None:
    rng = np.random.default_rng(8)
    rig = ideal_rig()
    ideal, _ = _case(rig)
    stripe = _stripe(ideal, 0.05, rng)
    empty = extract_feature_points(
        stripe.select(np.zeros(len(stripe), dtype=bool)), CAMERA, rig.laser_plane_camera, ARTIFACT
    )
    assert np.isnan(empty.points_camera).all()
    assert "no stripe" in empty.reason
    only_top = extract_feature_points(stripe.select(ideal.piece == TOP), CAMERA, rig.laser_plane_camera, ARTIFACT)
    assert np.isnan(only_top.points_camera).all()
    other = SteppedCylinder(23.051, 36.006, 40.0, 12.0)
    wrong = extract_feature_points(stripe, CAMERA, rig.laser_plane_camera, other)
    assert np.isnan(wrong.points_camera).sum() >= 6


def test_small_image() -> None:
    """0.3 megapixels: the step is some ten pixels long."""
    rng = np.random.default_rng(9)
    rig = ideal_rig()
    small = CameraModel((640, 480), 1000.0, 1000.0, 320.0, 240.0)
    truth = ideal_feature_points(ARTIFACT, rig, POSE, np.array([0.0]))[0]
    ideal = ideal_stepped_stripe(ARTIFACT, rig, POSE, 0.0, small)
    found = extract_feature_points(_stripe(ideal, 0.05, rng), small, rig.laser_plane_camera, ARTIFACT)
    assert found.reason == ""
    assert np.all(_errors(found, truth) < 4 * found.u_mm)
