"""The kernels against plain array code."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from rotaline.vision.targets.centre_kernels import normal_equations, read_windows
from rotaline.vision.targets.centres import refine_centres


def test_windows_are_read_as_by_scipy_also_beyond_the_border():
    rng = np.random.default_rng(3)
    image = rng.uniform(0, 255, (40, 55)).astype(np.float32)
    n, offsets = 300, rng.uniform(-1, 1, (30, 2))
    centres = rng.uniform(-6, 60, (n, 2))
    half_sides, bend = rng.normal(0, 4, (n, 2, 2)), rng.normal(0, 1, (n, 2, 2, 2))
    bend = (bend + bend.transpose(0, 1, 3, 2)) / 2
    read = np.empty((n, len(offsets)))
    read_windows(image, centres, half_sides, bend, offsets, read)
    at = centres[:, :, None] + half_sides @ offsets.T
    at += 0.5 * np.einsum("nabc,pb,pc->nap", bend, offsets, offsets)
    plain = map_coordinates(image, [at[:, 1], at[:, 0]], output=np.float64, order=3, mode="nearest", prefilter=False)
    np.testing.assert_allclose(read, plain, rtol=0, atol=1e-10)


def test_normal_equations_are_those_of_the_weighted_least_squares():
    rng = np.random.default_rng(4)
    n, p, q, step = 5, 81, 40, 0.25
    offsets = np.concatenate([half := rng.uniform(-1, 1, (40, 2)), [[0.0, 0.0]], -half[::-1]])
    counting = rng.permutation(p)[:q]
    next_alpha, next_beta = rng.integers(0, p, (2, q)), rng.integers(0, p, (2, q))
    weight = rng.uniform(0.1, 1, q)
    weight /= weight.sum()
    template = rng.normal(size=q)
    patch = rng.normal(100, 20, (n, p))
    symmetric, normal, right, figures = np.empty((n, q)), np.empty((n, 6, 6)), np.empty((n, 6)), np.empty((n, 3))
    normal_equations(
        patch, offsets, counting, next_alpha, next_beta, step, weight, template, symmetric, normal, right, figures
    )
    for i in range(n):
        even, odd = (patch[i] + patch[i, ::-1]) / 2, (patch[i] - patch[i, ::-1])[counting] / 2
        level = even[counting] - weight @ even[counting]
        contrast = np.sqrt(weight @ level**2)
        slopes = [(even[ahead] - even[behind]) / (2 * step) for ahead, behind in (next_alpha, next_beta)]
        d = offsets[counting].T
        design = np.stack([slopes[0] / contrast, slopes[1] / contrast, *d, *(d * level / contrast)], axis=1)
        np.testing.assert_allclose(symmetric[i], even[counting], rtol=1e-13)
        np.testing.assert_allclose(normal[i], design.T @ (weight[:, None] * design), rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(right[i], design.T @ (weight * odd / contrast), rtol=1e-9, atol=1e-12)
        expected = [contrast, weight @ odd**2 / contrast**2, weight @ (level * template)]
        np.testing.assert_allclose(figures[i], expected, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("rounding", [-1e-12, 0.0, 1e-12])
def test_rounding_does_not_decide_how_a_window_is_sampled(rounding):
    rng = np.random.default_rng(5)
    v, u = np.mgrid[0:80, 0:80]
    image = 100 + 60 * np.tanh((u - 40.2) / 1.5) * np.tanh((v - 39.7) / 1.5) + rng.normal(0, 3, (80, 80))
    windows = 18.0 * np.eye(2)[None]  # as large as they get
    start = np.array([[40.0, 40.0]])
    exact = refine_centres(image, start, windows, None, "corner")
    rounded = refine_centres(image, start, windows * (1 + rounding), None, "corner")
    np.testing.assert_allclose(rounded.uv, exact.uv, rtol=0, atol=1e-9)
