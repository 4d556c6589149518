"""Stripe centres against known truth: bias, scatter, and the uncertainty that is stated."""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.pipeline.verify_stripe import centre_bound_px, stripe_cases, verify_stripe
from rotaline.simulation.ideal.stripes import StripeScene, render_stripe
from rotaline.vision.stripe.extract import StripeOptions, extract_stripe

NOISE_LIMITED = [name for name, scene in stripe_cases().items() if np.isfinite(centre_bound_px(scene))]
ONE = "improved-gray-gravity"


@pytest.fixture(scope="module")
def table():
    rows = verify_stripe(n_images=8, methods=[ONE, f"{ONE}, average 5 px", "profile-fit"])
    return {(row.case, row.method): row for row in rows}


@pytest.mark.parametrize("case", NOISE_LIMITED)
@pytest.mark.parametrize("method", [ONE, "profile-fit"])
def test_scatter_is_at_the_bound_and_stated(table, case, method):
    row = table[case, method]
    assert row.found_fraction > 0.97
    assert row.rms_px < 1.1 * row.bound_px
    assert row.stated_over_scatter == pytest.approx(1.0, abs=0.2)
    # neighbours are correlated by up to 0.4, so the mean of n centres is known to sqrt(1.8 / n) of one
    assert abs(row.bias_px) < 4 * row.rms_px * np.sqrt(1.8 / row.n_points) + 0.002


@pytest.mark.parametrize("case", NOISE_LIMITED)
def test_averaging_along_the_stripe_halves_the_scatter(table, case):
    row = table[case, f"{ONE}, average 5 px"]
    assert row.rms_px < 0.65 * row.bound_px
    assert row.stated_over_scatter == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize("case", ["clipped core, peak 300", "clipped core, peak 500", "clipped core, peak 1000"])
def test_a_clipped_core_costs_nothing(table, case):
    row = table[case, ONE]
    assert row.rms_px < 0.0164
    assert row.stated_over_scatter == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("case", [name for name in stripe_cases() if name.startswith("one-sided")])
def test_an_edge_under_the_stripe_is_modelled(table, case):
    assert abs(table[case, ONE].bias_px) < 0.06  # without a model of the edge 0.25 to 1.2 px
    assert table[case, ONE].rms_px < 0.15


@pytest.mark.parametrize("case", ["speckle 0.1, sigma 1 px", "speckle 0.1, sigma 2 px"])
def test_speckle_is_stated(table, case):
    row = table[case, ONE]
    assert row.rms_px < 0.08
    assert row.stated_over_scatter == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("method", [ONE, "profile-fit"])
@pytest.mark.parametrize("angle_deg", [0.4, 2.0, 20.0, 45.0, 89.0])
@pytest.mark.parametrize("sigma_px", [0.6, 0.75])
def test_a_thin_stripe_does_not_lock_to_the_pixels(method, angle_deg, sigma_px):
    """The error must not follow the place of the centre between the pixels; interpolated samples made it 0.01 to 0.15 px."""
    rng = np.random.default_rng(11)
    scene = StripeScene(image_size=(128, 128), angle_deg=angle_deg, sigma_px=sigma_px, peak=90.0, noise=0.6)
    error, stated, phase = [], [], []
    for offset in np.arange(5) / 5.0:
        one = replace(scene, offset_px=float(offset))
        points = extract_stripe(render_stripe(one, rng), None, StripeOptions(method=method))
        inner = ((points.uv > 8) & (points.uv < 119)).all(axis=1)
        error.append(one.error(points.uv[inner]))
        stated.append(points.u_normal_px[inner])
        phase.append(points.uv[inner, 1 if angle_deg < 60 else 0] % 1.0)
    error_px, stated_px, bins = np.concatenate(error), np.concatenate(stated), (np.concatenate(phase) * 6).astype(int)
    stated_rms = float(np.sqrt(np.mean(stated_px**2)))
    for k in range(6):
        here = error_px[bins == k]
        assert len(here) > 30
        # errors of neighbours correlate; what else is left is that the pixel's square is not part of the Gaussian shape
        assert abs(here.mean()) < 4.0 * stated_rms * np.sqrt(1.8 / len(here)) + 0.002
    assert stated_rms / error_px.std() == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("method", ["gray-gravity", "improved-gray-gravity", "steger", "profile-fit"])
def test_spread_of_repeats_is_the_stated_uncertainty(method):
    """One place of the stripe, 120 images that differ by their noise alone."""
    scene = StripeScene(image_size=(64, 64), angle_deg=20.0, offset_px=0.3)
    rng = np.random.default_rng(7)
    errors, stated = [], []
    for _ in range(120):
        points = extract_stripe(render_stripe(scene, rng), None, StripeOptions(method=method))
        k = int(np.argmin(np.abs(scene.along(points.uv))))
        errors.append(scene.error(points.uv[k : k + 1])[0])
        stated.append(points.u_normal_px[k])
    stated_px = float(np.sqrt(np.mean(np.square(stated))))
    assert abs(np.mean(errors)) < 4 * stated_px / np.sqrt(len(errors)) + 0.003
    # a spread of 120 repeats is known to 6.5 %
    assert np.std(errors) == pytest.approx(stated_px, rel=0.25)


def test_photon_noise_is_stated_too():
    """Noise that grows with the light is no part of the model; the scatter of the centres tells it."""
    scene = StripeScene(image_size=(160, 160), angle_deg=20.0, noise=0.0)
    rng = np.random.default_rng(2)
    errors, stated = [], []
    for _ in range(6):
        one = replace(scene, offset_px=float(rng.uniform(-1, 1)), bits=16)
        light = render_stripe(one, rng) / 257.0
        image = np.rint((light + rng.normal(0, np.sqrt(0.5 * light))).clip(0, 255)).astype(np.uint8)
        points = extract_stripe(image)
        inner = np.abs(one.along(points.uv)) < 70
        errors.append(one.error(points.uv)[inner])
        stated.append(points.u_normal_px[inner])
    ratio = np.sqrt(np.mean(np.concatenate(stated) ** 2)) / np.concatenate(errors).std()
    assert ratio == pytest.approx(1.0, abs=0.2)
