"""Common rotation of the frames of a target on the turntable."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotaline.calibration.turntable_motion import find_turntable_motion

DIRECTION = np.array([0.1, -0.8, -0.55]) / np.linalg.norm([0.1, -0.8, -0.55])
BOARD = Rotation.from_rotvec([0.4, -2.1, 0.7])


def _orientations(angles: np.ndarray, noise_deg: float, rng: np.random.Generator, orders: int = 1) -> list[Rotation]:
    """Stacks of orders; the one that fits stands first, unless the caller rolls them."""
    stacks = []
    for angle in angles:
        turned = Rotation.from_rotvec(angle * DIRECTION) * BOARD
        noisy = Rotation.from_rotvec(np.radians(noise_deg) * rng.standard_normal(3)) * turned
        stacks.append(
            Rotation.concatenate(
                [noisy * Rotation.from_euler("z", 360.0 * k / orders, degrees=True) for k in range(orders)]
            )
        )
    return stacks


@given(
    angles_deg=st.lists(st.floats(0, 360), min_size=3, max_size=15),
    sense=st.sampled_from([1, -1]),
    seed=st.integers(0, 1000),
)
@settings(deadline=None, max_examples=30)
def test_direction_is_the_one_about_which_angles_are_right_handed(
    angles_deg: list[float], sense: int, seed: int
) -> None:
    angles = np.radians([*angles_deg, 0.0, 25.0, 50.0])
    motion = find_turntable_motion(_orientations(sense * angles, 0.0, np.random.default_rng(seed)), angles)
    assert motion is not None
    np.testing.assert_allclose(motion.direction_camera, sense * DIRECTION, atol=1e-5)
    assert motion.fits.all()
    assert motion.scale == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("orders", [2, 4])
def test_orders_are_put_right(orders: int) -> None:
    rng = np.random.default_rng(7)
    angles = np.radians(np.arange(350, 390, 3) % 360.0)
    stacks = _orientations(angles, 0.3, rng, orders)
    rolled = rng.integers(0, orders, len(angles))
    stacks = [
        Rotation.concatenate([stack[(i + k) % orders] for i in range(orders)])
        for stack, k in zip(stacks, rolled, strict=True)
    ]
    motion = find_turntable_motion(stacks, angles)
    assert motion is not None
    assert motion.fits.all()
    assert len(set((motion.order + rolled) % orders)) == 1
    assert np.degrees(np.arccos(motion.direction_camera @ DIRECTION)) < 2.0


def test_frames_that_do_not_belong_are_marked() -> None:
    rng = np.random.default_rng(1)
    angles = np.radians(np.arange(0.0, 60.0, 5.0))
    stacks = _orientations(angles, 0.1, rng)
    for k in (3, 8):
        stacks[k] = Rotation.concatenate([Rotation.from_rotvec([0.2, 0.1, 0.0]) * stacks[k][0]])
    motion = find_turntable_motion(stacks, angles)
    assert motion is not None
    assert np.flatnonzero(~motion.fits).tolist() == [3, 8]


def test_wrong_scale_is_measured() -> None:
    angles = np.radians(np.arange(0.0, 60.0, 5.0))
    motion = find_turntable_motion(_orientations(0.5 * angles, 0.02, np.random.default_rng(2)), angles)
    assert motion is not None
    assert abs(motion.scale - 0.5) < 4 * motion.u_scale
    assert motion.u_scale < 0.01


def test_no_turn_no_motion() -> None:
    assert find_turntable_motion(_orientations(np.zeros(5), 0.1, np.random.default_rng(0)), np.zeros(5)) is None
    still = _orientations(np.zeros(5), 0.0, np.random.default_rng(0))
    assert find_turntable_motion(still, np.radians(np.arange(0.0, 50.0, 10.0))) is None
