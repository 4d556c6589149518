"""How far neighbours err alike, from values that were drawn so."""

import numpy as np
import pytest
from scipy.signal import lfilter

from rotaline.geometry.correlation import correlation_length


def _ar1(rho, n, rng):
    """Noise of variance 1 with the correlation ``rho^lag``."""
    gain = np.sqrt(1.0 - rho**2)
    return lfilter([gain], [1.0, -rho], rng.standard_normal(n + 200))[200:]


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.8, 0.9])
def test_correlation_length_of_noise_that_neighbours_share(rho):
    """Points that count as one: the variance of a mean is that of n / length independent values."""
    rng = np.random.default_rng(4)
    values = np.concatenate([_ar1(rho, 400, rng) for _ in range(40)])
    piece = np.repeat(np.arange(40), 400)
    length = correlation_length(values, piece, np.ones(len(values), dtype=bool))
    assert length == pytest.approx((1 + rho) / (1 - rho), rel=0.15)
    means = values.reshape(40, 400).mean(axis=1)
    assert np.sqrt(length / 400) == pytest.approx(np.sqrt(np.mean(means**2)), rel=0.35)


def test_neighbours_of_different_pieces_and_outliers_do_not_count():
    rng = np.random.default_rng(5)
    short = np.repeat(rng.standard_normal(4000), 2)  # pairs alike: 1 + 2 * 1/2 within one piece
    alone = np.ones(len(short), dtype=bool)
    assert correlation_length(short, np.zeros(len(short), dtype=int), alone) == pytest.approx(2.0, rel=0.1)
    assert correlation_length(short, np.arange(len(short)), alone) == 1.0
    values = rng.standard_normal(6000)
    values[2000:2040] = 80.0
    piece = np.zeros(6000, dtype=int)
    assert correlation_length(values, piece, np.abs(values) < 10) < 1.1
    assert correlation_length(values, piece, np.ones(6000, dtype=bool)) > 10.0
    assert correlation_length(values[:40], piece[:40], np.ones(40, dtype=bool)) == 1.0
