"""The centroid in a profile: windows, thin stripes, stated uncertainty."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.vision.stripe.plain.centres import fit_gaussian, weighted_centroid
from rotaline.vision.stripe.profiles import Profiles

X = np.arange(-12.0, 13.0)


def profiles_of(values):
    n, m = values.shape
    yes = np.ones((n, m), dtype=bool)
    return Profiles(np.tile(X, (n, 1)), values, np.ones((n, m)), np.ones((n, m)), yes, ~yes)


def centroid(values, sigma_px, window, start_px=0.0, n_iterations=5):
    n = len(values)
    return weighted_centroid(
        profiles_of(values),
        np.zeros_like(values),
        np.zeros(n),
        np.full(n, start_px),
        np.full(n, sigma_px),
        window,
        n_iterations,
    )


@given(centre=st.floats(-0.5, 0.5), sigma=st.floats(0.5, 2.0), window=st.sampled_from([1.0, 1.5, 2.0]))
@settings(max_examples=60, deadline=None)
def test_finds_a_gaussian_however_few_samples_it_has(centre, sigma, window):
    values = 50.0 * np.exp(-0.5 * ((X - centre) / sigma) ** 2)[None]
    found = centroid(values, sigma, window)
    assert found.shift_px[0] == pytest.approx(centre, abs=1e-3)
    assert found.height[0] == pytest.approx(50.0, rel=0.01)
    assert found.width_px[0] == pytest.approx(sigma, rel=0.01)


@pytest.mark.parametrize("window", [1.0, 1.5, 2.0, 3.0])
def test_a_window_of_any_width_converges(window):
    values = 50.0 * np.exp(-0.5 * ((X - 0.8) / 1.5) ** 2)[None]
    assert centroid(values, 1.5, window, -0.4, 8).shift_px[0] == pytest.approx(0.8, abs=1e-4)


@pytest.mark.parametrize("sigma", [0.6, 1.0, 2.0])
@pytest.mark.parametrize("window", [1.0, 2.0])
def test_the_spread_of_repeats_is_the_stated_uncertainty(sigma, window):
    rng = np.random.default_rng(3)
    centre = rng.uniform(-0.5, 0.5, 3000)[:, None]
    values = 60.0 * np.exp(-0.5 * ((X - centre) / sigma) ** 2) + rng.normal(0.0, 1.0, (3000, len(X)))
    found = centroid(values, sigma, window)
    pulls = (found.shift_px - centre[:, 0]) / found.u_px
    assert pulls.std() == pytest.approx(1.0, abs=0.06)
    assert abs(pulls.mean()) < 4.0 / np.sqrt(3000)


def test_weights_of_a_fit_enter_its_uncertainty():
    """Samples of half the weight are not samples of twice the noise: the fit is not the best one, and says so."""
    rng = np.random.default_rng(4)
    values = 60.0 * np.exp(-0.5 * (X / 1.5) ** 2) + rng.normal(0.0, 1.0, (2000, len(X)))
    profiles = profiles_of(values)
    weight = np.where(np.arange(len(X)) % 2 == 0, 1.0, 0.2) * np.ones((2000, 1))
    uneven = Profiles(X * np.ones((2000, 1)), values, weight, profiles.gain, profiles.valid, profiles.clipped)
    n = np.ones(2000)
    found = fit_gaussian(uneven, np.zeros_like(values), 0.0 * n, 1.5 * n, 60.0 * n)
    assert found.shift_px.std() / np.median(found.u_px) == pytest.approx(1.0, abs=0.08)


def test_no_light_no_centre():
    found = centroid(-np.ones((2, len(X))), 1.5, 1.0)
    assert np.isnan(found.shift_px).all()
