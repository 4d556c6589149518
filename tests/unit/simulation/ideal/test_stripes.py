"""Synthetic stripes are what they say they are."""

import numpy as np
import pytest
from scipy.special import erf

from rotaline.simulation.ideal.stripes import StripeScene, render_stripe

CLEAN = StripeScene(image_size=(64, 48), noise=0.0, bits=16)


def test_profile_is_a_gaussian_integrated_over_pixels():
    scene = StripeScene(image_size=(9, 41), sigma_px=1.2, noise=0.0, bits=16, background=0.0, offset_px=0.3)
    image = render_stripe(scene, np.random.default_rng(0)) / 257.0
    edges = (np.arange(42) - 0.5 - scene.middle[1]) / (np.sqrt(2.0) * 1.2)
    exact = 200.0 * 1.2 * np.sqrt(np.pi / 2.0) * np.diff(erf(edges))
    np.testing.assert_allclose(image[:, 4], exact, atol=0.01)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0, 135.0])
def test_brightest_pixels_lie_on_the_truth(angle_deg):
    scene = StripeScene(image_size=(64, 48), noise=0.0, angle_deg=angle_deg, offset_px=2.0)
    image = render_stripe(scene, np.random.default_rng(0))
    v, u = np.nonzero(image > 0.9 * image.max())
    assert np.abs(scene.distance(np.column_stack([u, v]).astype(float))).max() < 1.5


@pytest.mark.parametrize("curve", ["line", "step", "arc"])
def test_points_of_the_curve_have_no_error(curve):
    scene = StripeScene(curve=curve, angle_deg=33.0, offset_px=1.0)
    points = scene.curve_points(0.7)
    np.testing.assert_allclose(scene.error(points), 0.0, atol=1e-9)


def test_distance_is_positive_along_the_normal():
    scene = StripeScene(angle_deg=40.0)
    assert scene.distance((scene.middle + 3.0 * scene.normal)[None, :])[0] == pytest.approx(3.0)


def test_only_beside_a_step_both_sides_count():
    scene = StripeScene(curve="step", step_px=6.0)
    other_side = scene.middle + 6.0 * scene.normal
    np.testing.assert_allclose(scene.error((other_side - 0.5 * scene.direction)[None, :]), 0.0, atol=1e-9)
    np.testing.assert_allclose(scene.error((other_side - 2.0 * scene.direction)[None, :]), 6.0, atol=1e-9)


def test_clips_and_keeps_the_type():
    scene = StripeScene(peak=900.0, ceiling=255.0)
    assert render_stripe(scene, np.random.default_rng(0)).max() == 255
    assert render_stripe(StripeScene(bits=16), np.random.default_rng(0)).dtype == np.uint16


def test_one_sided_background_lies_on_the_side_of_the_normal():
    scene = StripeScene(peak=0.0, one_sided=36.0, noise=0.0, background=10.0)
    image = render_stripe(scene, np.random.default_rng(0))
    assert image[5, 80] == 10
    assert image[-5, 80] == 46


def test_speckle_has_the_contrast_and_the_grain_asked_for():
    scene = StripeScene(
        image_size=(400, 400), sigma_px=1e4, noise=0.0, background=0.0, peak=100.0, speckle_contrast=0.1, bits=16
    )
    image = render_stripe(scene, np.random.default_rng(3)) / 257.0
    light = image / image.mean() - 1.0
    assert light.std() == pytest.approx(0.1, rel=0.05)
    # half maximum at 0.75 px: a Gaussian autocorrelation is at 0.5 ** ((1 / 0.75) ** 2) one pixel on
    correlation = (light[:, 1:] * light[:, :-1]).mean() / light.var()
    assert correlation == pytest.approx(0.5 ** ((1 / 0.75) ** 2), abs=0.03)
