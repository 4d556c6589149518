"""Profiles along normals: geometry, interpolation, noise."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.vision.stripe.profiles import sample_profiles

ANGLES = st.floats(0.0, 2 * np.pi)


@given(angle=ANGLES, u=st.floats(12, 18), v=st.floats(12, 18))
@settings(max_examples=50, deadline=None)
def test_a_plane_is_read_exactly(angle, u, v):
    rows, columns = np.mgrid[0:31, 0:31]
    image = (3.0 + 2.0 * columns - 1.5 * rows).astype(np.float32)
    normal = np.array([[np.cos(angle), np.sin(angle)]])
    profile = sample_profiles(image, None, np.array([[u, v]]), normal, np.array([7.0]))
    at = np.array([u, v]) + profile.offset_px[0][:, None] * normal
    expected = 3.0 + 2.0 * at[:, 0] - 1.5 * at[:, 1]
    np.testing.assert_allclose(profile.value[profile.valid], expected[profile.valid[0]], atol=1e-4)
    assert np.abs(profile.offset_px[profile.valid]).max() <= 7.00001
    assert profile.valid.sum() >= 9  # spacing at most sqrt(2)


@given(angle=ANGLES)
@settings(max_examples=30, deadline=None)
def test_the_gain_is_the_variance_of_the_samples(angle):
    rng = np.random.default_rng(1)
    uv = rng.uniform(12, 18, (1, 2))
    normal = np.array([[np.cos(angle), np.sin(angle)]])
    samples = [
        sample_profiles(rng.normal(0, 1, (31, 31)).astype(np.float32), None, uv, normal, np.array([6.0]))
        for _ in range(150)
    ]
    values = np.stack([s.value[0][s.valid[0]] for s in samples])
    ratio = values.var(axis=0).mean() / samples[0].gain[samples[0].valid].mean()
    assert ratio == pytest.approx(1.0, abs=0.15)
    neighbours = (values[:, 1:] * values[:, :-1]).mean()
    assert abs(neighbours) < 0.12  # samples of one profile share no pixel


def test_outside_the_image_is_not_valid():
    image = np.ones((20, 20), dtype=np.float32)
    profile = sample_profiles(image, None, np.array([[1.0, 10.0]]), np.array([[1.0, 0.0]]), np.array([5.0]))
    assert not profile.valid[profile.offset_px < -1.01].any()
    assert (profile.value[~profile.valid] == 0).all()


def test_clipped_pixels_are_reported():
    image = np.full((20, 20), 9.0, dtype=np.float32)
    clipped = np.zeros((20, 20), dtype=bool)
    clipped[:, 10] = True
    profile = sample_profiles(image, clipped, np.array([[10.2, 10.0]]), np.array([[1.0, 0.0]]), np.array([4.0]))
    np.testing.assert_array_equal(profile.clipped[0], np.isclose(profile.offset_px[0], -0.2))
