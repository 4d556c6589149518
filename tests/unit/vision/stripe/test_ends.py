"""Ends of pieces, and averaging along them."""

import numpy as np
import pytest

from rotaline.vision.stripe.curve import Chains
from rotaline.vision.stripe.ends import average_along
from rotaline.vision.stripe.plain.ends import sound_ends

RNG = np.random.default_rng(5)
UV = np.column_stack([np.arange(60.0), 0.01 * RNG.normal(size=60)])
ONE = np.zeros(60, dtype=np.int64)
WIDTH = 2.0 + 0.02 * RNG.normal(size=60)


def test_a_sound_piece_stays_whole():
    assert sound_ends(Chains(UV, ONE), WIDTH).all()


def test_takes_points_off_the_line_and_points_of_another_width():
    uv, width = UV.copy(), WIDTH.copy()
    uv[:2, 1] += 0.5
    width[-3:] = 1.4
    keep = sound_ends(Chains(uv, ONE), width)
    assert not keep[:2].any()
    assert not keep[-3:].any()
    assert keep[2:-3].all()


def test_never_takes_more_than_six_of_an_end():
    width = WIDTH.copy()
    width[:6] = 8.0
    width[7] = 8.0
    keep = sound_ends(Chains(UV, ONE), width)
    assert not keep[:6].any()
    assert keep[6:].all()


def test_a_short_piece_is_left_alone():
    assert sound_ends(Chains(UV[:15], ONE[:15]), np.linspace(1, 3, 15)).all()


def test_averaging_keeps_a_parabola():
    x = np.arange(60.0)
    uv = np.column_stack([x, 0.002 * (x - 30) ** 2])
    slope = 0.004 * (x - 30)
    normal = np.column_stack([-slope, np.ones(60)]) / np.hypot(slope, 1.0)[:, None]
    averaged, gain = average_along(Chains(uv, ONE), normal, 5)
    np.testing.assert_allclose(averaged, uv, atol=1e-9)
    assert gain[30] < 0.75
    assert gain[30] < gain[0] < 1.1


@pytest.mark.parametrize("mixing", [0.0, 0.35])
def test_averaging_states_what_it_gains(mixing):
    rng = np.random.default_rng(8)
    white = rng.normal(size=6001)
    noise = 0.05 * (white[1:] + mixing * white[:-1]) / np.hypot(1.0, mixing)
    uv = np.column_stack([np.arange(6000.0), noise])
    chains = Chains(uv, np.zeros(6000, dtype=np.int64))
    averaged, gain = average_along(chains, np.tile([0.0, 1.0], (6000, 1)), 5)
    assert averaged[10:-10, 1].std() / noise.std() == pytest.approx(gain[3000], rel=0.1)
