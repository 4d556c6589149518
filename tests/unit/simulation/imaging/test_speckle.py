"""Speckle has the contrast, the distribution and the grain that physics says."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import gamma

from rotaline.simulation.imaging.speckle import contrast, grain_px, speckle_factor, speckle_pattern
from rotaline.simulation.rig import Optics, build_rig

LASER = replace(build_rig().laser, speckle_contrast=None, wavelength_nm=650.0, linewidth_nm=0.0)


def _factor(grain, of_light, shape=(300, 300), seed=1):
    return speckle_factor(speckle_pattern(shape, grain, np.random.default_rng(seed)).ravel(), of_light).reshape(shape)


@pytest.mark.parametrize("grain", [0.3, 1.2])
@pytest.mark.parametrize("of_light", [0.05, 0.3, 0.7, 1.0])
def test_mean_contrast_and_distribution(grain, of_light):
    factor = _factor(grain, of_light)
    assert factor.min() >= 0.0
    assert factor.mean() == pytest.approx(1.0, abs=0.02 * of_light)
    assert factor.std() == pytest.approx(of_light, rel=0.03)
    shape = 1 / of_light**2
    for quantile in (0.05, 0.5, 0.95):
        assert np.quantile(factor, quantile) == pytest.approx(
            gamma.ppf(quantile, shape, scale=1 / shape), abs=0.04 * of_light
        )


def test_no_contrast_is_no_speckle():
    assert np.all(_factor(1.0, 0.0) == 1.0)


def _brute_force(grain, oversampling=12, pixels=120):
    """Intensity of a random field behind a square aperture, summed over pixels: contrast, and correlation of neighbours."""
    rng = np.random.default_rng(2)
    n = oversampling * pixels
    frequency = np.fft.fftfreq(n, 1 / oversampling)
    # a square aperture of this width has grains of this area: sinc^2 has the integral 1 / width
    aperture = np.abs(frequency) < 0.5 / grain
    field = np.fft.ifft2(
        np.fft.fft2(rng.standard_normal((n, n)) + 1j * rng.standard_normal((n, n))) * np.outer(aperture, aperture)
    )
    light = (np.abs(field) ** 2).reshape(pixels, oversampling, pixels, oversampling).mean(axis=(1, 3))
    light /= light.mean()
    return light.std(), np.corrcoef(light[:, 1:].ravel(), light[:, :-1].ravel())[0, 1]


@pytest.mark.parametrize("grain", [0.5, 1.2, 3.0])
def test_contrast_and_grain_are_those_of_a_random_field_seen_by_pixels(grain):
    polarised, neighbours = _brute_force(grain)
    assert contrast(LASER, grain, 1.0) == pytest.approx(polarised / np.sqrt(2), rel=0.06)
    factor = _factor(grain, 0.3)
    found = np.corrcoef(factor[:, 1:].ravel(), factor[:, :-1].ravel())[0, 1]
    assert found == pytest.approx(neighbours, abs=0.06)
    down = np.corrcoef(factor[1:].ravel(), factor[:-1].ravel())[0, 1]
    assert down == pytest.approx(found, abs=0.02)


def test_the_grain_is_the_diffraction_disc_in_pixels():
    optics = Optics(pixel_pitch_um=3.0, f_number=8.0)
    # 4000 px of 3 um: a focal length of 12 mm; magnification 12 / (312 - 12)
    grain = grain_px(LASER, optics, 4000.0, 312.0)
    assert grain == pytest.approx(0.65 * 8.0 * 1.04 * np.sqrt(4 / np.pi) / 3.0)
    assert grain_px(LASER, replace(optics, f_number=16.0), 4000.0, 312.0) == pytest.approx(2 * grain)


def test_what_lowers_the_contrast():
    sharp = contrast(LASER, 5.0, 1.0)
    assert 0.6 < sharp < np.sqrt(0.5)
    assert contrast(LASER, 0.3, 1.0) < 0.5 * sharp
    broad = replace(LASER, linewidth_nm=20.0)
    assert contrast(broad, 5.0, 1.0) < sharp
    assert contrast(broad, 5.0, 10.0) < 0.5 * sharp
    # wave numbers drawn from the line: the mean correlation of their patterns is the square of the contrast
    k = 2 * np.pi / 0.65 + np.random.default_rng(1).normal(0, 2 * np.pi * 0.02 / 0.65**2 / 2.3548, (2, 200000))
    square = np.mean(np.exp(-4 * 10.0**2 * (k[0] - k[1]) ** 2))
    assert contrast(broad, 5.0, 10.0) == pytest.approx(sharp * np.sqrt(square), rel=0.02)


def test_a_stated_contrast_is_taken():
    assert contrast(replace(LASER, speckle_contrast=0.17), 0.5, 30.0) == 0.17


def test_the_seed_fixes_the_pattern():
    np.testing.assert_array_equal(_factor(1.0, 0.5, (20, 30), 4), _factor(1.0, 0.5, (20, 30), 4))
    assert np.any(_factor(1.0, 0.5, (20, 30), 4) != _factor(1.0, 0.5, (20, 30), 5))
