"""Targets whose points are off their places: offsets, their gauge, and what single views do to the estimate."""

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform

from rotaline.calibration.board_shape import point_numbers
from rotaline.calibration.print_offsets import OffsetFit, fit_print_offsets
from rotaline.calibration.reprojection import BoardObservation
from rotaline.simulation.ideal.observations import random_board_poses
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import Checkerboard, DotGrid, TargetDetection

CAMERA = CameraModel((1280, 960), 1800.0, 1795.0, 645.0, 482.0, -0.11, 0.09, 0.0006, -0.0004)
TARGET = Checkerboard((8, 5), 9.0)
POINTS = TARGET.points_board()
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
IDS = np.arange(len(POINTS))


def printed(seed: int, offset_mm: float, sigma_px: float, n: int = 8) -> tuple[list[RigidTransform], list, np.ndarray]:
    """Poses, observations and offsets of a board that was printed badly."""
    rng = np.random.default_rng(seed)
    offsets = offset_mm * rng.standard_normal((len(POINTS), 2))
    true = POINTS + np.pad(offsets, ((0, 0), (0, 1)))
    poses = random_board_poses(CAMERA, TARGET, n, rng, spread=0.4)
    seen = [CAMERA.project(pose.apply(true)) + sigma_px * rng.standard_normal((len(true), 2)) for pose in poses]
    return poses, [BoardObservation(POINTS, uv, np.ones(len(POINTS))) for uv in seen], offsets


def fitted(poses: Sequence[RigidTransform], observations: Sequence[BoardObservation]) -> OffsetFit | None:
    """The estimate, from a start at the true camera and poses."""
    return fit_print_offsets(CAMERA, poses, observations, [IDS] * len(poses), NAMES)


def similarity_part(offsets: np.ndarray) -> np.ndarray:
    """What shift, turn and change of scale of the board have in common with the offsets."""
    x, y = (POINTS[:, :2] - POINTS[:, :2].mean(axis=0)).T
    zero, one = np.zeros_like(x), np.ones_like(x)
    basis = np.stack([np.stack(c, axis=1).ravel() for c in ((one, zero), (zero, one), (x, y), (-y, x))], axis=1)
    return (basis @ np.linalg.lstsq(basis, offsets.ravel(), rcond=None)[0]).reshape(-1, 2)


@settings(deadline=None, max_examples=5)
@given(seed=st.integers(0, 10_000))
def test_offsets_are_found_but_for_what_views_never_show(seed: int) -> None:
    """Shift, turn and size of the print are no part of the result; all else is what it was."""
    poses, observations, true = printed(seed, 0.03, 0.01)
    fit = fitted(poses, observations)
    assert fit is not None
    assert np.abs(similarity_part(fit.offsets)).max() < 5e-3 * np.abs(fit.offsets).max()
    error = fit.offsets - (true - similarity_part(true))
    assert np.sqrt(np.mean(error**2)) < 0.1 * 0.03
    assert fit.sigma_px == pytest.approx(0.01, rel=0.2)
    assert fit.sigma_mm == pytest.approx(0.03, rel=0.4)


@pytest.mark.parametrize("seed", range(6))
def test_an_exact_target_has_no_offsets(seed: int) -> None:
    """Noise alone does not look like a bad print."""
    poses, observations, _ = printed(seed, 0.0, 0.05)
    assert fitted(poses, observations) is None


def test_points_that_keep_to_their_place_have_no_offset() -> None:
    """Number -1, for some points or for all."""
    poses, observations, _ = printed(3, 0.03, 0.02)
    ids = np.where(IDS < 20, IDS, -1)
    fit = fit_print_offsets(CAMERA, poses, observations, [ids] * len(poses), NAMES)
    assert fit is not None
    assert fit.offsets.shape == (20, 2)
    assert np.array_equal(fit.of_rows(ids), np.vstack([fit.offsets, np.zeros((20, 2))]))
    none = np.full(len(IDS), -1)
    assert fit_print_offsets(CAMERA, poses, observations, [none] * len(poses), NAMES) is None


def test_what_fixed_points_are_off_counts_as_noise() -> None:
    """Five points keep to their places: four that are exact, and one that is off by 0.1 mm."""
    poses, observations, true = printed(3, 0.03, 0.02)
    fixed = np.isin(IDS, [0, 7, 20, 32, 39])
    ids = np.where(fixed, -1, IDS)
    exact = [o.with_offsets(np.where(fixed[:, None], true, 0.0)) for o in observations]
    off = [o.with_offsets(np.where(IDS[:, None] == 39, [0.1, 0.0], 0.0)) for o in exact]
    fit, wrong = (fit_print_offsets(CAMERA, poses, seen, [ids] * len(poses), NAMES) for seen in (exact, off))
    assert fit is not None
    assert wrong is not None
    assert fit.sigma_px == pytest.approx(0.02, rel=0.2)
    assert wrong.sigma_px > 1.5 * 0.02


def test_a_point_that_was_never_used_keeps_to_its_place() -> None:
    """Nothing is known of it, whatever was detected there."""
    poses, observations, _ = printed(4, 0.03, 0.02)
    weights = np.where(IDS == 7, 0.0, 1.0)
    wild = [BoardObservation(o.points_board, np.where(IDS[:, None] == 7, np.nan, o.uv), weights) for o in observations]
    fit = fitted(poses, wild)
    assert fit is not None
    assert np.array_equal(fit.offsets[7], [0.0, 0.0])
    assert np.abs(np.delete(fit.offsets, 7, axis=0)).min(axis=1).max() > 0.01


def test_points_behind_the_camera_are_no_estimate() -> None:
    """A start that explains nothing."""
    poses, observations, _ = printed(5, 0.03, 0.02)
    behind = [RigidTransform.from_translation([0.0, 0.0, -500.0]), *poses[1:]]
    assert fitted(behind, observations) is None


def test_leaving_out_a_view_is_foreseen() -> None:
    """The linear change against the estimate from the other views, in standard deviations."""
    poses, observations, _ = printed(6, 0.02, 0.03)
    fit = fitted(poses, observations)
    assert fit is not None
    for v in (0, 5):
        others = fitted([*poses[:v], *poses[v + 1 :]], [*observations[:v], *observations[v + 1 :]])
        assert others is not None
        change = np.array([getattr(others.camera, name) - getattr(fit.camera, name) for name in NAMES])
        whitened = fit.information @ np.stack([change, fit.changes[v]], axis=1) / fit.sigma_px
        assert np.linalg.norm(whitened[:, 0] - whitened[:, 1]) < 0.1 * np.linalg.norm(whitened[:, 0])


def test_numbers_of_points_go_through_all_targets() -> None:
    """Targets that can be read from several sides have no numbers."""
    uv = np.zeros((3, 2))
    a, b, dots = Checkerboard((4, 3), 5.0), Checkerboard((5, 4), 5.0), DotGrid((4, 3), 5.0)
    ids = np.array([0, 2, 5])
    numbers = point_numbers([TargetDetection(t, ids, uv, 0.1) for t in (dots, a, b, a)])
    assert [n.tolist() for n in numbers] == [[-1, -1, -1], [0, 2, 5], [12, 14, 17], [0, 2, 5]]
