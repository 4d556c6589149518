import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from rotaline.vision.motion import follow, points_to_follow

SCENE = np.fft.rfft2(gaussian_filter(np.random.default_rng(2).normal(size=(160, 200)), 4.0, mode="wrap"))


def shifted(du, dv, noise=1.0, dtype=np.uint8, seed=0):
    """A periodic scene, moved by any part of a pixel."""
    phase = np.exp(-2j * np.pi * (np.fft.rfftfreq(200) * du + np.fft.fftfreq(160)[:, None] * dv))
    scene = np.fft.irfft2(SCENE * phase, s=(160, 200))
    grey = 120.0 + 90.0 * scene / 0.2 + noise * np.random.default_rng(seed).normal(size=scene.shape)
    full = np.iinfo(dtype).max
    return np.clip(np.rint(grey * (full / 255.0)), 0, full).astype(dtype)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.1, -0.05), (1.3, 0.7), (-7.2, 4.9)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_shift_is_found_to_a_fraction_of_a_pixel(shift, dtype):
    before, after = shifted(0, 0, dtype=dtype), shifted(*shift, dtype=dtype, seed=1)
    uv = points_to_follow(before)
    moved = follow(before, after, uv)
    found = np.isfinite(moved).all(axis=1)
    assert found.sum() > 30
    scatter = np.std(moved[found], axis=0) / np.sqrt(found.sum())
    assert np.median(moved[found], axis=0) == pytest.approx(shift, abs=float(6 * scatter.max() + 0.004))


def test_a_plain_image_has_no_points_and_other_scenes_lose_them():
    plain = np.full((120, 160), 77, np.uint8)
    assert len(points_to_follow(plain)) == 0
    assert follow(plain, plain, np.zeros((0, 2))).shape == (0, 2)
    before = shifted(0, 0)
    uv = points_to_follow(before)
    gone = follow(before, np.full_like(before, 90), uv)
    assert np.isfinite(gone).all(axis=1).mean() < 0.2
