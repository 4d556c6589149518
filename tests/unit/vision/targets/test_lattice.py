import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.vision.targets.lattice import Candidates, grow_lattices, place_grid

COLUMNS, ROWS = 8, 6


def grid_image(roll: float, perspective: float) -> np.ndarray:
    """Images of a grid's points, row by row: (48, 2) px."""
    r, c = np.divmod(np.arange(COLUMNS * ROWS), COLUMNS)
    x, y = c - 3.5, r - 2.5
    scale = 30.0 / (1.0 + perspective * (0.6 * x + 0.8 * y))
    turn = np.array([[np.cos(roll), -np.sin(roll)], [np.sin(roll), np.cos(roll)]])
    return (np.stack([x * scale, y * scale], axis=1) @ turn.T) + (320.0, 240.0)


def dots(uv: np.ndarray) -> Candidates:
    return Candidates(uv, np.full(len(uv), np.nan), np.full(len(uv), 50.0))


def corners(uv: np.ndarray, roll: float) -> Candidates:
    r, c = np.divmod(np.arange(len(uv)), COLUMNS)
    return Candidates(uv, np.mod(roll + np.pi / 4 + ((r + c) % 2) * np.pi / 2, np.pi), np.full(len(uv), np.nan))


@settings(max_examples=25, deadline=None)
@given(roll=st.floats(0.0, 6.28), perspective=st.floats(0.0, 0.05), seed=st.integers(0, 100), kind=st.booleans())
def test_a_grid_is_found_among_clutter_and_gaps(roll, perspective, seed, kind):
    rng = np.random.default_rng(seed)
    uv = grid_image(roll, perspective)
    inner = np.array([9, 10, 20, 29, 36])
    kept = np.setdiff1d(np.arange(len(uv)), rng.choice(inner, 3, replace=False))
    candidates = dots(uv) if kind else corners(uv, roll)
    order = rng.permutation(kept)
    clutter = rng.uniform(0, 640, (60, 2))
    clutter = clutter[np.linalg.norm(clutter[:, None] - uv[None], axis=2).min(axis=1) > 18.0]
    mixed = Candidates(
        np.concatenate([candidates.uv[order], clutter]),
        np.concatenate([candidates.phase[order], rng.uniform(0, np.pi, len(clutter)) * (np.nan if kind else 1.0)]),
        np.concatenate([candidates.size[order], np.full(len(clutter), 50.0 if kind else np.nan)]),
    )
    lattice = max(grow_lattices(mixed), key=len)
    placements, _ = place_grid(lattice, (COLUMNS, ROWS), alternating=not kind)
    assert placements
    fits = []
    for placement in placements:
        grid = placement.grid_of(lattice.cells)
        inside = np.all((grid >= 0) & (grid < (COLUMNS, ROWS)), axis=1)
        numbers = grid[inside, 1] * COLUMNS + grid[inside, 0]
        found = mixed.uv[lattice.ids[inside]]
        half_turn = COLUMNS * ROWS - 1 - numbers
        fits.append(
            len(numbers) >= 45
            and (np.allclose(uv[numbers], found, atol=1e-6) or np.allclose(uv[half_turn], found, atol=1e-6))
        )
    assert fits[0]  # right-handed, columns and rows not confused, the most likely place first


def test_another_size_is_reported():
    lattice = max(grow_lattices(corners(grid_image(0.3, 0.01), 0.3)), key=len)
    assert sorted(place_grid(lattice, (9, 7), alternating=True)[1]) == [6, 8]
    assert place_grid(lattice, (17, 12), alternating=True)[0] == []


@pytest.mark.parametrize("count", [0, 1, 5])
def test_too_few_points_are_no_lattice(count):
    assert list(grow_lattices(dots(grid_image(0.0, 0.0)[:count]))) == []
