"""The sensor: statistics of photons, conversion, rounding, saturation, colour."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.simulation.imaging.exposure import expose
from rotaline.simulation.rig import Sensor

LEVELS = {8: 255, 12: 4095, 16: 65535}
STORED = {8: 255, 12: 65535, 16: 65535}


def _even(level_e, n=200):
    return np.full((n, n), float(level_e))


@pytest.mark.parametrize("bit_depth", [8, 12, 16])
@pytest.mark.parametrize("gain", [1.0, 4.0])
def test_the_photon_transfer_line(bit_depth, gain):
    """Variance against mean is a line: its slope is one over electrons per DN, at no light there is read noise and rounding."""
    sensor = Sensor(bit_depth=bit_depth, full_well_e=20400.0, gain=gain, read_noise_e=60.0, black_level_dn=10.0)
    rng = np.random.default_rng(3)
    to_dn = 255.0 / STORED[bit_depth]
    levels = np.linspace(0.0, 0.8 * 20400.0 / gain, 7)
    images = [expose(_even(level), sensor, rng) * to_dn for level in levels]
    means, variances = np.array([image.mean() for image in images]), np.array([image.var() for image in images])
    slope, intercept = np.polyfit(means - 10.0, variances, 1)
    per_dn = 20400.0 / gain / 255.0
    rounding = (255.0 / LEVELS[bit_depth]) ** 2 / 12
    assert sensor.electrons_per_dn == per_dn
    np.testing.assert_allclose(means, levels / per_dn + 10.0, atol=4 * np.sqrt(variances.max()) / 200 + 0.01)
    assert slope == pytest.approx(1.0 / per_dn, rel=0.03)
    expected = (60.0 / per_dn) ** 2 + rounding
    assert variances[0] == pytest.approx(expected, rel=0.03)
    assert intercept == pytest.approx(expected, abs=0.03 * variances[-1])


@pytest.mark.parametrize("level_e", [0.3, 4.0, 60.0])
def test_few_photons_are_counted(level_e):
    sensor = Sensor(bit_depth=16, full_well_e=65535.0, read_noise_e=0.0, black_level_dn=0.0)
    counts = expose(_even(level_e), sensor, np.random.default_rng(5)).astype(float)
    assert counts.mean() == pytest.approx(level_e, abs=4 * np.sqrt(level_e / counts.size))
    assert counts.var() == pytest.approx(level_e, rel=0.05)
    assert (counts == 0).mean() == pytest.approx(np.exp(-level_e), abs=0.01)
    skewness = ((counts - counts.mean()) ** 3).mean() / counts.std() ** 3
    assert skewness == pytest.approx(1 / np.sqrt(level_e), abs=0.1)


def test_the_variance_goes_on_where_counting_ends():
    sensor = Sensor(bit_depth=16, full_well_e=65535.0, read_noise_e=0.0, black_level_dn=0.0)
    for level in (95.0, 105.0):
        image = expose(_even(level), sensor, np.random.default_rng(7))
        assert image.var() == pytest.approx(level, rel=0.05)


@pytest.mark.parametrize("bit_depth", [8, 12, 16])
def test_too_much_light_is_full_scale_and_too_little_is_zero(bit_depth):
    sensor = Sensor(bit_depth=bit_depth, read_noise_e=24.0, black_level_dn=0.0)
    rng = np.random.default_rng(1)
    bright = expose(_even(2e4, 8), sensor, rng)
    assert bright.dtype == (np.uint8 if bit_depth == 8 else np.uint16)
    assert np.all(bright == STORED[bit_depth])
    assert (expose(_even(0.0, 8), sensor, rng) == 0).any()


def test_with_a_gain_below_one_the_full_well_ends_before_full_scale():
    image = expose(_even(1e6, 8), Sensor(gain=0.5, read_noise_e=0.0, black_level_dn=2.0), np.random.default_rng(1))
    assert np.all(image == 130)


def test_twelve_bits_are_4096_levels_over_the_whole_scale():
    ramp = np.linspace(0.0, 10200.0, 300 * 300).reshape(300, 300)
    sensor = Sensor(bit_depth=12, black_level_dn=0.0)
    image = expose(ramp, sensor, np.random.default_rng(1))
    levels = np.unique(image)
    assert levels[0] == 0
    assert levels[-1] == 65535
    assert len(levels) <= 4096
    assert set(np.diff(levels.astype(int))) <= {16, 17, 32, 33}


@given(st.sampled_from([8, 12, 16]), st.floats(0.0, 3e4), st.integers(0, 100))
@settings(deadline=None, max_examples=20)
def test_the_seed_fixes_the_image(bit_depth, level, seed):
    sensor = Sensor(bit_depth=bit_depth)
    one, two = (expose(_even(level, 12), sensor, np.random.default_rng(seed)) for _ in range(2))
    np.testing.assert_array_equal(one, two)


@pytest.mark.parametrize("bit_depth", [8, 12, 16])
def test_colours_come_back_from_the_mosaic(bit_depth):
    sensor = Sensor(colour=True, bit_depth=bit_depth, full_well_e=255e4, read_noise_e=0.0, black_level_dn=0.0)
    light = np.broadcast_to(np.array([200.0, 80.0, 20.0]) * 1e4, (40, 40, 3))
    image = expose(light, sensor, np.random.default_rng(1)) * (255.0 / STORED[bit_depth])
    np.testing.assert_allclose(image.mean(axis=(0, 1)), [200.0, 80.0, 20.0], atol=0.6)


def test_a_pixel_sees_one_colour_and_its_neighbours_lend_the_others():
    sensor = Sensor(colour=True, full_well_e=255e4, read_noise_e=0.0, black_level_dn=0.0)
    light = np.zeros((12, 12, 3))
    light[4, 4, 0] = 200e4  # a red pixel: even row, even column
    light[4, 7, 0] = 200e4  # a green pixel does not see it
    image = expose(light, sensor, np.random.default_rng(1))
    assert image[4, 4, 0] == pytest.approx(200, abs=2)
    assert image[4, 5, 0] == pytest.approx(100, abs=2)
    assert image[5, 5, 0] == pytest.approx(50, abs=2)
    assert image[:, 6:].max() == 0
    assert image[:, :, 1:].max() == 0


def test_light_of_the_wrong_shape_is_refused():
    with pytest.raises(ValueError, match="grey sensor does not fit"):
        expose(np.zeros((4, 4, 3)), Sensor(), np.random.default_rng(1))
    with pytest.raises(ValueError, match="colour sensor does not fit"):
        expose(np.zeros((4, 4)), Sensor(colour=True), np.random.default_rng(1))
