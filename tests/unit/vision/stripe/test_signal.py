"""The grey images in which a stripe is found and measured: exposure, background, saturation."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.vision.stripe.signal import find_stripe, match_exposure, split_frame

RNG = np.random.default_rng(6)
ROOM = RNG.uniform(20, 150, (12, 16)).repeat(20, axis=0).repeat(20, axis=1)


def noisy(image, seed, dtype=np.uint8):
    top = np.iinfo(dtype).max
    return np.rint((image + np.random.default_rng(seed).normal(0, 1.5, image.shape)).clip(0, 255) * top / 255).astype(
        dtype
    )


@given(gain=st.floats(0.8, 1.25), offset=st.floats(-8.0, 8.0), dtype=st.sampled_from([np.uint8, np.uint16]))
@settings(max_examples=25, deadline=None)
def test_exposure_is_matched_beside_the_stripe(gain, offset, dtype):
    image = ROOM * gain + offset
    image[100:130] += 90.0  # the stripe and its halo
    found = match_exposure(noisy(image, 1, dtype), noisy(ROOM, 2, dtype))
    assert found[0] == pytest.approx(gain, abs=0.01)
    assert found[1] == pytest.approx(offset * np.iinfo(dtype).max / 255, abs=1.2 * np.iinfo(dtype).max / 255)


def test_a_plain_scene_has_a_gain_and_a_dark_one_has_none():
    plain = np.full((100, 100), 80.0)
    assert match_exposure(noisy(plain * 1.1, 1), noisy(plain, 2)) == pytest.approx((1.1, 0.0), abs=0.01)
    dark = np.full((100, 100), 4.0)
    assert match_exposure(noisy(dark * 1.5, 1), noisy(dark, 2)) == (1.0, 0.0)
    assert match_exposure(noisy(0 * dark, 1), np.zeros((100, 100), dtype=np.uint8)) == (1.0, 0.0)


def test_another_light_is_not_an_exposure():
    assert match_exposure(noisy(ROOM * 0.5, 1), noisy(ROOM, 2)) == (1.0, 0.0)


def test_nothing_is_left_of_a_room_at_another_exposure():
    colour = ROOM[:, :, None] * np.array([1.0, 0.9, 0.8])
    frame = split_frame(noisy(colour * 0.93 + 5.0, 1), noisy(colour, 2))
    for plane in frame.planes:
        assert plane.std() < 2.5  # noise of two frames and rounding
    assert frame.lit
    assert find_stripe(frame, "auto", 6.0, 2.0, 10.0)[0] == []
