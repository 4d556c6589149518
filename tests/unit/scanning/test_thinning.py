"""Thinning to even density, and local normals."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.scanning.thinning import PIECE, cell_keys, cell_means, extent_of, sum_around, thin, thin_indices


def stripes(n: int = 400, gap: float = 2.0, noise: float = 0.0) -> np.ndarray:
    """A plane seen as dense stripes, 60 x 40 mm."""
    x, y = np.meshgrid(np.arange(0, 60, gap), np.linspace(0, 40, n))
    z = np.random.default_rng(0).normal(0, noise, x.size) if noise else np.zeros(x.size)
    return np.column_stack([x.ravel(), y.ravel(), z])


def test_the_dense_direction_is_thinned_until_neighbourhoods_spread_both_ways() -> None:
    cloud = thin(stripes(), 8000)
    assert 0.3 < cloud.spacing < 2.0
    assert np.abs(cloud.normals[:, 2]) == pytest.approx(1.0)
    assert cloud.roughness == pytest.approx(0.0, abs=1e-9)


def test_noise_makes_the_cells_larger_and_tells_the_roughness() -> None:
    points = stripes(400, 0.2, 0.3)
    cloud = thin(points, 100_000)
    assert np.median(np.abs(cloud.normals[:, 2])) > 0.95
    assert cloud.roughness == pytest.approx(0.3, rel=0.4)
    kept, cell = thin_indices(points, 100_000, 1 / 400)
    means = cell_means(points, kept, cell)
    assert np.std(means[:, 2]) < 0.9 * np.std(points[kept, 2])


def test_strays_are_left_out() -> None:
    points = np.vstack([stripes(), [[30.0, 20.0, 25.0]]])
    assert thin(points, 8000).points[:, 2].max() < 1.0


@settings(deadline=None, max_examples=10)
@given(n_target=st.integers(400, 5000), seed=st.integers(0, 50))
def test_no_more_points_than_asked_for_one_a_cell(n_target: int, seed: int) -> None:
    points = np.random.default_rng(seed).uniform(0, 30, (6000, 3))
    kept, cell = thin_indices(points, n_target, 1 / 400)
    assert len(kept) <= n_target
    assert len(np.unique(cell_keys(points[kept], points.min(axis=0), cell))) == len(kept)
    assert np.all(np.diff(kept) > 0)


def test_the_extent_ignores_the_outermost_points() -> None:
    points = np.vstack([stripes(), [[1e4, 0.0, 0.0]]])
    assert extent_of(points) == pytest.approx(np.hypot(58, 40), rel=0.05)


def test_sums_over_the_cells_around_are_those_of_counting_one_by_one() -> None:
    rng = np.random.default_rng(3)
    grid, other = (np.unique(rng.integers(0, 9, (250, 3)), axis=0) for _ in range(2))
    keys, known = (cell_keys(cells + 0.5, np.zeros(3), 1.0) for cells in (grid, other))
    order, known_order = np.argsort(keys), np.argsort(known)
    values = rng.integers(1, 100, len(other))
    near = np.all(np.abs(grid[:, None] - other[None]) <= 1, axis=2)
    found = sum_around(keys[order], known[known_order], values[known_order])
    assert found == pytest.approx((near * values).sum(axis=1)[order])
    assert np.any(found == 0)


def test_means_are_those_of_all_points_of_the_cell() -> None:
    points = np.random.default_rng(0).uniform(0, 5, (700, 3))
    kept, cell = np.array([3, 40, 41, 600]), 1.3
    keys = cell_keys(points, points.min(axis=0), cell)
    for k, mean in zip(kept, cell_means(points, kept, cell), strict=True):
        assert mean == pytest.approx(points[keys == keys[k]].mean(axis=0), rel=1e-12)


def test_keys_do_not_depend_on_the_pieces_in_which_they_are_made() -> None:
    points = np.random.default_rng(0).uniform(-40, 40, (PIECE + 1000, 3))
    low = points.min(axis=0)
    whole = cell_keys(points, low, 0.7)
    parts = [cell_keys(points[at], low, 0.7) for at in (slice(0, 77), slice(77, None))]
    assert np.array_equal(whole, np.concatenate(parts))


def test_thinning_takes_little_memory_beside_the_cloud() -> None:
    rng = np.random.default_rng(0)
    n = 1_000_000
    points = np.column_stack([rng.uniform(0, 60, (n, 2)), rng.normal(0, 0.005, n)])
    thin_indices(points[:1000], 1000, 1 / 400)  # compiled
    tracemalloc.start()
    kept, cell = thin_indices(points, 50_000, 1 / 400)
    cell_means(points, kept, cell)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # Keys, their order, the keys in order, and what sorting needs: 8 bytes each. And what does not grow.
    assert peak < 40 * n + 100 * PIECE
