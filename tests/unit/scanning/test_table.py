import numpy as np
import pytest

from rotaline.scanning.table import find_table_height

RNG = np.random.default_rng(7)


def _scan(n_frames=40, table=-3.2, radius=(20.0, 45.0), part_height=30.0, noise=0.01):
    """A rod on a table: top disc, side, table, per frame."""
    parts = []
    for frame in range(n_frames):
        angle = 2 * np.pi * frame / n_frames
        r_top, z_side, r_table = (
            RNG.uniform(0, 15, 60),
            RNG.uniform(table, table + part_height, 200),
            RNG.uniform(*radius, 150),
        )
        r = np.concatenate([r_top, np.full(200, 15.0), r_table])
        z = np.concatenate([np.full(60, table + part_height), z_side, np.full(150, table)]) + RNG.normal(0, noise, 410)
        parts.append(np.column_stack([r * np.cos(angle), r * np.sin(angle), z, np.full(410, frame)]))
    data = np.concatenate(parts)
    return data[:, :3], data[:, 3].astype(int)


@pytest.mark.parametrize("noise", [0.005, 0.1])
def test_the_table_is_the_lowest_level(noise):
    points, frame = _scan(noise=noise)
    n_table = 40 * 150
    assert find_table_height(points, frame) == pytest.approx(-3.2, abs=4 * 1.25 * noise / np.sqrt(n_table) + 0.01)


def test_stray_points_below_the_table_do_not_count():
    points, frame = _scan()
    stray = RNG.uniform([-30, -30, -40], [30, 30, -10], (60, 3))
    assert find_table_height(np.vstack([points, stray]), np.concatenate([frame, np.zeros(60, int)])) == pytest.approx(
        -3.2, abs=0.01
    )


def test_a_part_without_a_table_has_none():
    points, frame = _scan()
    side = np.abs(np.hypot(points[:, 0], points[:, 1]) - 15) < 0.01
    assert find_table_height(points[side], frame[side]) is None


def test_a_level_that_one_frame_shows_is_no_table():
    points, frame = _scan(n_frames=1)
    side = np.abs(np.hypot(points[:, 0], points[:, 1]) - 15) < 0.01
    more, more_frame = _scan(n_frames=40)
    wall = np.abs(np.hypot(more[:, 0], more[:, 1]) - 15) < 0.01
    both = np.vstack([points, more[wall] + [0, 0, 1.0]])
    frames = np.concatenate([frame, more_frame[wall]])
    assert side.any()
    assert find_table_height(both, frames) is None


def test_too_few_points_say_nothing():
    assert find_table_height(np.zeros((5, 3)), np.zeros(5, int)) is None
