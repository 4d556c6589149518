"""Profiles along normals: geometry, interpolation, noise; strips of pixels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.vision.stripe.plain.strips import pixel_strips
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


@given(angle=ANGLES, u=st.floats(12, 18), v=st.floats(12, 18))
@settings(max_examples=50, deadline=None)
def test_a_strip_holds_pixels_at_their_true_distance(angle, u, v):
    rows, columns = np.mgrid[0:31, 0:31]
    normal = np.array([np.cos(angle), np.sin(angle)])
    distance = (columns - u) * normal[0] + (rows - v) * normal[1]
    along = (rows - v) * normal[0] - (columns - u) * normal[1]
    image = distance.astype(np.float32)
    strip = pixel_strips(image, None, np.array([[u, v]]), normal[None], np.array([6.0]))
    used = strip.valid[0]
    np.testing.assert_allclose(strip.value[0, used], strip.offset_px[0, used], atol=1e-5)
    within = (np.abs(along) < 1.0) & (np.abs(distance) <= 6.000001)
    assert abs(int(used.sum()) - int(within.sum())) <= (np.abs(np.abs(along) - 1.0) < 1e-5).sum()
    assert strip.weight[0, used].sum() == pytest.approx((1.0 - np.abs(along))[within].sum(), abs=0.01)
    assert (strip.weight[0, ~used] == 0).all()


@given(angle=ANGLES)
@settings(max_examples=30, deadline=None)
def test_strips_of_neighbours_share_each_pixel_out(angle):
    """On a line of points one pixel apart, the weights of every pixel near the line make up 1."""
    normal = np.array([np.cos(angle), np.sin(angle)])
    t = np.arange(-30.0, 31.0)[:, None]
    uv = np.array([15.3, 15.8]) + t * np.array([-normal[1], normal[0]])
    ones = np.ones((31, 31), dtype=np.float32)
    reach = np.full(len(uv), 4.0)
    total = np.zeros((31, 31))
    for row in range(11, 20):
        for column in range(11, 20):
            spot = np.zeros_like(ones)
            spot[row, column] = 1.0
            strips = pixel_strips(spot, None, uv, np.tile(normal, (len(uv), 1)), reach)
            total[row, column] = (strips.value * strips.weight).sum()
    rows, columns = np.mgrid[11:20, 11:20]
    near = np.abs((columns - 15.3) * normal[0] + (rows - 15.8) * normal[1]) < 3.99
    np.testing.assert_allclose(total[11:20, 11:20][near], 1.0, atol=1e-5)


def test_pixels_outside_the_image_are_not_valid_and_clipped_ones_are_told():
    clipped = np.zeros((20, 20), dtype=bool)
    clipped[10, 2] = True
    strip = pixel_strips(
        np.ones((20, 20), dtype=np.float32), clipped, np.array([[1.0, 10.0]]), np.array([[1.0, 0.0]]), np.array([5.0])
    )
    assert strip.offset_px[strip.valid].min() == -1.0
    np.testing.assert_allclose(strip.offset_px[strip.clipped], [1.0])
