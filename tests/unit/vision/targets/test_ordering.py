import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid, TargetDetection
from rotaline.vision.targets.ordering import (
    canonical,
    grid_rotations,
    match_order,
    order_sequence,
    permuted,
    symmetry_permutations,
)

CAMERA = CameraModel((1280, 960), 1400.0, 1400.0, 640.0, 480.0, k1=-0.15, k2=0.05, p1=1e-3)
TARGETS = [Checkerboard((18, 16), 4.0), Checkerboard((6, 6), 5.0), DotGrid((9, 9), 6.0), DotGrid((7, 5), 6.0)]


def turntable_views(target, angles_rad, *, lying: bool, sense: int, seed: int = 0) -> list[TargetDetection | None]:
    """What a camera sees of a plate on a turntable; None where the plate shows its back or its edge."""
    rng = np.random.default_rng(seed)
    camera_from_base = RigidTransform.from_components([10.0, 40.0, 300.0], Rotation.from_euler("x", 120, degrees=True))
    middle = RigidTransform.from_translation(-target.points_board().mean(axis=0))
    turn = Rotation.from_euler("x", 180, degrees=True)
    if not lying:
        turn = Rotation.from_euler("x", -90, degrees=True) * Rotation.from_euler("z", 13, degrees=True)
    base_from_board = RigidTransform.from_components([5.0, 3.0, 0.0 if lying else 40.0], turn) * middle
    views: list[TargetDetection | None] = []
    for angle in angles_rad:
        spin = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.0, sense * angle]))
        pose = camera_from_base * spin * base_from_board
        matrix = pose.as_matrix()
        if matrix[:3, 2] @ matrix[:3, 3] < 0.15 * np.linalg.norm(matrix[:3, 3]):
            views.append(None)
            continue
        uv = CAMERA.project(pose.apply(target.points_board()))
        uv = uv + rng.normal(0, 0.05, uv.shape)
        views.append(TargetDetection(target, np.arange(len(uv)), uv, 0.05))
    return views


@pytest.mark.parametrize("target", TARGETS)
def test_symmetries_form_a_group(target):
    symmetries = symmetry_permutations(target)
    assert symmetries[0].tolist() == list(range(len(target.points_board())))
    known = {tuple(p.tolist()) for p in symmetries}
    for a, b in itertools.product(symmetries, repeat=2):
        assert tuple(a[b].tolist()) in known


@pytest.mark.parametrize(
    ("target", "count"),
    [
        (Checkerboard((18, 16), 4.0), 2),
        (Checkerboard((8, 5), 4.0), 1),
        (Checkerboard((6, 6), 4.0), 4),
        (Checkerboard((5, 5), 4.0), 2),
        (DotGrid((9, 9), 6.0), 4),
        (DotGrid((8, 5), 6.0), 2),
        (CharucoBoard((7, 5), 6.0, 4.0, "DICT_4X4_50"), 1),
    ],
)
def test_number_of_symmetries(target, count):
    assert len(symmetry_permutations(target)) == count


@pytest.mark.parametrize("grid_size", [(4, 3), (4, 4)])
def test_rotations_of_a_grid_keep_distances_and_handedness(grid_size):
    xy = DotGrid(grid_size, 1.0).points_board()[:, :2]
    for rotation in grid_rotations(grid_size):
        turned = np.empty_like(xy)
        turned[rotation] = xy
        shape = [np.linalg.solve(np.cov(xy.T), np.cov(xy.T, turned.T)[:2, 2:])]
        assert np.linalg.det(shape[0]) > 0
        np.testing.assert_allclose(
            np.linalg.norm(turned - turned[0], axis=1).sum(), np.linalg.norm(xy - xy[0], axis=1).sum()
        )


@pytest.mark.parametrize("target", TARGETS)
def test_canonical_order_does_not_depend_on_the_numbering(target):
    view = turntable_views(target, [0.3], lying=True, sense=1)[0]
    expected = canonical(view)
    for permutation in symmetry_permutations(target):
        np.testing.assert_array_equal(canonical(permuted(view, permutation)).uv, expected.uv)
    assert expected.uv[0].sum() == min(permuted(view, p).uv[0].sum() for p in symmetry_permutations(target))


def test_canonical_order_without_the_first_point():
    view = turntable_views(TARGETS[2], [0.3], lying=True, sense=1)[0]
    part = TargetDetection(view.target, view.point_ids[5:], view.uv[5:], view.u_px)
    full = canonical(view)
    found = canonical(part)
    np.testing.assert_array_equal(full.uv[found.point_ids], found.uv)


@settings(max_examples=20, deadline=None)
@given(target=st.sampled_from(TARGETS), which=st.integers(0, 3), seed=st.integers(0, 50))
def test_a_pair_is_numbered_alike(target, which, seed):
    off = turntable_views(target, [0.4], lying=True, sense=1)[0]
    symmetries = symmetry_permutations(target)
    kept = np.sort(np.random.default_rng(seed).choice(len(off.uv), len(off.uv) // 2, replace=False))
    on = permuted(TargetDetection(target, kept, off.uv[kept] + 0.02, 0.05), symmetries[which % len(symmetries)])
    matched = match_order(off, on)
    np.testing.assert_array_equal(matched.point_ids, kept)
    np.testing.assert_array_equal(matched.uv, off.uv[kept] + 0.02)


SEQUENCES = {
    "small steps": np.arange(0.0, 40.0, 2.0),
    "full turn": np.arange(0.0, 360.0, 15.0),
    "wide steps": np.arange(0.0, 360.0, 45.0),
    "wider steps": np.arange(0.0, 360.0, 60.0),
    "uneven, unsorted, beyond a turn": np.array([500.0, 12.0, 333.0, 90.0, 131.0, 47.0, 210.0, 260.0, 601.0, 185.0]),
    "two groups": np.array([0.0, 4.0, 8.0, 12.0, 70.0, 74.0, 78.0, 82.0]),
    "three frames": np.array([355.0, 0.0, 5.0]),
    "one frame": np.array([30.0]),
}


@pytest.mark.parametrize("target", TARGETS)
@pytest.mark.parametrize("lying", [True, False])
@pytest.mark.parametrize("sense", [1, -1])
@pytest.mark.parametrize("steps", list(SEQUENCES))
def test_a_turntable_sequence_is_numbered_alike(target, lying, sense, steps):
    angles = np.deg2rad(SEQUENCES[steps])
    truth = turntable_views(target, angles, lying=lying, sense=sense)
    ordered = order_sequence([None if v is None else canonical(v) for v in truth], angles.tolist())
    assert [o is None for o in ordered] == [t is None for t in truth]
    seen = [(o, t) for o, t in zip(ordered, truth, strict=True) if o is not None]
    agreeing = [all(np.array_equal(permuted(o, p).uv, t.uv) for o, t in seen) for p in symmetry_permutations(target)]
    assert any(agreeing)


def test_the_first_frame_keeps_its_numbers():
    angles = np.deg2rad(SEQUENCES["full turn"])
    views = [canonical(v) for v in turntable_views(TARGETS[2], angles, lying=True, sense=1)]
    ordered = order_sequence([None, *views], [0.0, *angles.tolist()])
    assert ordered[0] is None
    np.testing.assert_array_equal(ordered[1].uv, views[0].uv)


def test_a_target_without_symmetry_is_left_alone():
    views = turntable_views(Checkerboard((8, 5), 4.0), [0.0, 0.1], lying=True, sense=1)
    assert order_sequence(views, [0.0, 0.1]) == tuple(views)
    assert order_sequence([], []) == ()
    assert order_sequence([None], [0.0]) == (None,)


def test_as_many_angles_as_views():
    with pytest.raises(ValueError, match="1 detections, but 2 angles"):
        order_sequence([None], [0.0, 1.0])
