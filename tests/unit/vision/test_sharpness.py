import numpy as np
import pytest
from scipy.special import erf

from rotaline.vision.sharpness import edge_blur_px


def edge(blur_px, noise=1.0, angle_deg=7.0, dtype=np.uint8, shift_px=0.0):
    """A straight edge from 40 to 190 of 255, blurred by a Gaussian."""
    v, u = np.mgrid[0:240, 0:320].astype(float)
    a = np.deg2rad(angle_deg)
    distance = (u - 160.0 - shift_px) * np.cos(a) + (v - 120.0) * np.sin(a)
    grey = 40.0 + 150.0 * (0.5 + 0.5 * erf(distance / (np.sqrt(2.0) * blur_px)))
    grey += noise * np.random.default_rng(3).normal(size=grey.shape)
    full = np.iinfo(dtype).max
    return np.clip(np.rint(grey * (full / 255.0)), 0, full).astype(dtype)


@pytest.mark.parametrize("blur_px", [0.6, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("angle_deg", [3.0, 40.0, 88.0])
def test_the_blur_of_an_edge_is_found(blur_px, angle_deg):
    assert np.nanmedian(edge_blur_px(edge(blur_px, angle_deg=angle_deg), 1.0)) == pytest.approx(blur_px, rel=0.12)


def test_noise_changes_it_little():
    for noise in (0.3, 4.0):
        assert np.nanmedian(edge_blur_px(edge(1.5, noise), noise)) == pytest.approx(1.5, rel=0.1)


def test_depth_and_colour_do_not_matter():
    grey = edge(1.3)
    expected = edge_blur_px(grey, 1.0)
    assert edge_blur_px(np.repeat(grey[:, :, None], 3, axis=2), 1.0) == pytest.approx(expected, nan_ok=True)
    assert np.nanmedian(edge_blur_px(edge(1.3, dtype=np.uint16), 257.0)) == pytest.approx(1.3, rel=0.1)


def test_only_tiles_with_an_edge_say_something():
    blur = edge_blur_px(edge(1.0, angle_deg=0.0), 1.0, tile_px=48)
    seen = np.isfinite(blur)
    assert blur.shape == (4, 6)
    assert seen[:, 3].all()  # u = 160 lies in the fourth column
    assert not seen[:, [0, 1, 5]].any()
    assert not np.isfinite(edge_blur_px(np.full((100, 100), 90, np.uint8), 1.0)).any()


def test_a_tile_that_holds_little_of_the_edge_is_taken_neither_for_sharp_nor_for_blurred():
    n_seen = 0
    for shift_px in np.arange(-26.0, 26.0, 2.0):
        blur = edge_blur_px(edge(1.5, angle_deg=0.0, shift_px=shift_px), 1.0)
        seen = blur[np.isfinite(blur)]
        n_seen += len(seen) > 0
        assert seen.min(initial=1.5) > 1.3, shift_px
        assert seen.max(initial=1.5) < 1.8, shift_px
    assert n_seen >= 24  # of 26: where the edge is the border of two tiles, neither holds it
