"""Blur and pixel area: shares that add up, and have the right width and place."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.simulation.imaging.footprint import pixel_kernel, point_kernels, reach_px
from rotaline.simulation.imaging.subpixel import cell_offsets, lattice_offsets

OFFSETS = (cell_offsets(), lattice_offsets(8), lattice_offsets(55))


@given(st.floats(0.0, 6.0))
@settings(deadline=None, max_examples=40)
def test_an_even_pixel_keeps_its_light_and_spreads_with_the_right_variance(sigma):
    kernel = pixel_kernel(sigma)
    away = np.arange(-(len(kernel) // 2), len(kernel) // 2 + 1)
    assert kernel.sum() == pytest.approx(1.0)
    np.testing.assert_allclose(kernel, kernel[::-1], atol=1e-15)
    # the areas of both pixels add to the blur; of a narrow one, what falls beyond the reach counts more
    if sigma > 0.3:
        assert (kernel * away**2).sum() == pytest.approx(sigma**2 + 2 / 12, rel=0.03 if sigma > 0.5 else 0.07)


@pytest.mark.parametrize("offsets", OFFSETS)
@pytest.mark.parametrize("sigma", [0.0, 0.1, 0.4, 0.8, 2.0])
def test_the_points_of_a_pixel_together_give_what_an_even_pixel_gives(offsets, sigma):
    kernels, even = point_kernels(offsets, sigma), pixel_kernel(sigma)
    np.testing.assert_allclose(kernels.sum(axis=0), np.outer(even, even), atol=1e-12)
    assert kernels.min() >= 0.0


@pytest.mark.parametrize("sigma", [0.4, 1.5])
def test_the_light_of_a_point_falls_about_its_place(sigma):
    offsets = lattice_offsets(55)
    reach = reach_px(sigma)
    away = np.arange(-reach, reach + 1)
    kernels = point_kernels(offsets, sigma) * len(offsets)
    for offset, kernel in zip(offsets, kernels, strict=True):
        total = kernel.sum()
        assert total == pytest.approx(1.0, abs=0.01)
        assert (kernel.sum(axis=0) @ away) / total == pytest.approx(offset[0], abs=0.02)
        assert (kernel.sum(axis=1) @ away) / total == pytest.approx(offset[1], abs=0.02)


@pytest.mark.parametrize("n_least", [1, 8, 9, 30, 1000])
def test_the_lattice_is_even_and_equals_its_mirror_image(n_least):
    offsets = lattice_offsets(n_least)
    n = len(offsets)
    assert n >= min(n_least, 144)
    np.testing.assert_allclose(offsets, -offsets[::-1], atol=1e-12)
    for column in offsets.T:
        np.testing.assert_allclose(np.sort(column), (np.arange(n) + 0.5) / n - 0.5, atol=1e-12)
    gaps = np.linalg.norm(offsets[:, None] - offsets[None], axis=2) + np.eye(n)
    assert gaps.min() > 0.75 / np.sqrt(n)
