"""A stripe against the same stripe moved by a known amount."""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.simulation.ideal.stripes import StripeScene, render_stripe
from rotaline.vision.stripe.extract import extract_stripe
from rotaline.vision.stripe.shift import REACH_PX, StripeShift, stripe_shift

SCENE = StripeScene(image_size=(160, 140), angle_deg=25.0)


def _seen(scene, seed):
    return extract_stripe(render_stripe(scene, np.random.default_rng(seed)))


def _moved(offset_px, seed, scene=SCENE):
    return stripe_shift(_seen(scene, seed), _seen(replace(scene, offset_px=scene.offset_px + offset_px), seed + 1000))


@pytest.mark.parametrize("angle_deg", [0.0, 25.0, 90.0, 170.0])
@pytest.mark.parametrize("offset_px", [0.0, 0.013, -0.4, 3.7])
def test_a_known_shift_comes_back(angle_deg, offset_px):
    scene = replace(SCENE, angle_deg=angle_deg)
    first, second = (_seen(replace(scene, offset_px=o), s) for o, s in ((0.0, 1), (offset_px, 2)))
    found = stripe_shift(first, second)
    sense = np.sign(scene.normal @ _side(first))  # the scene's own normal may point to the other side
    assert found.shift_px == pytest.approx(sense * offset_px, abs=4.0 * found.u_px)
    assert found.u_px < 0.02
    assert found.share > 0.8
    assert found.brightness == pytest.approx(1.0, abs=0.01)
    assert found.width == pytest.approx(1.0, abs=0.03)


def _side(points):
    """The common normal of the points, to the right or down."""
    normal = points.normal[0]
    return normal * np.sign(normal[np.argmax(np.abs(normal))])


@pytest.mark.parametrize("speckle_contrast", [0.0, 0.4])
def test_errors_of_repeats_are_as_large_as_stated(speckle_contrast):
    scene = replace(SCENE, speckle_contrast=speckle_contrast, speckle_grain_px=3.0)
    found = [_moved(0.25, seed, scene) for seed in range(60)]
    errors = (np.abs([f.shift_px for f in found]) - 0.25) / [f.u_px for f in found]
    # the spread of 60 values is known to 9 %
    assert 0.65 < np.sqrt(np.mean(errors**2)) < 1.35


@pytest.mark.parametrize("speckle_contrast", [0.0, 0.4])
def test_changes_of_brightness_are_as_uncertain_as_stated(speckle_contrast):
    scene = StripeScene((480, 100), angle_deg=5.0, speckle_contrast=speckle_contrast, speckle_grain_px=3.0, peak=80.0)
    found = [_moved(0.25, seed, scene) for seed in range(40)]
    errors = np.array([f.brightness - 1.0 for f in found]) / [f.u_brightness for f in found]
    # the spread of 40 values is known to 11 %
    assert 0.6 < np.sqrt(np.mean(errors**2)) < 1.4


def test_a_stripe_against_itself_has_not_moved_whatever_its_shape():
    points = _seen(SCENE, 3)
    wavy = replace(points, uv=points.uv + np.sin(points.uv / 5.0))
    found = stripe_shift(wavy, wavy)
    assert (found.shift_px, found.u_px, found.share, found.brightness, found.width) == (0.0, 0.0, 1.0, 1.0, 1.0)


def test_normals_that_change_sides_do_not_cancel():
    first, second = _seen(SCENE, 1), _seen(replace(SCENE, offset_px=1.0), 2)
    flip = np.where(np.arange(len(first)) % 3 == 0, -1.0, 1.0)[:, None]
    as_is, turned = stripe_shift(first, second), stripe_shift(replace(first, normal=flip * first.normal), second)
    assert turned.shift_px == pytest.approx(as_is.shift_px, abs=1e-12)


def test_light_and_width_are_compared():
    first = _seen(SCENE, 1)
    second = replace(first, intensity=0.8 * first.intensity, width_px=1.1 * first.width_px)
    found = stripe_shift(first, second)
    assert found.brightness == pytest.approx(0.8)
    assert found.width == pytest.approx(1.1)


def test_parts_that_are_gone_and_points_far_off_do_not_count():
    first, second = _seen(SCENE, 1), _seen(replace(SCENE, offset_px=0.5), 2)
    clean = stripe_shift(first, second)
    uv = second.uv.copy()
    uv[10:14] += 3.0 * second.normal[10:14]
    half = replace(second, uv=uv).select(np.arange(len(second)) < len(second) // 2)
    found = stripe_shift(first, half)
    assert 0.35 < found.share < 0.55
    assert found.shift_px == pytest.approx(clean.shift_px, abs=4.0 * np.hypot(found.u_px, clean.u_px))


@pytest.mark.parametrize("n", [0, 1, 12])
def test_too_little_to_compare(n):
    first = _seen(SCENE, 1)
    few = first.select(np.arange(len(first)) < n)
    for found in (stripe_shift(first, few), stripe_shift(few, first)):
        assert isinstance(found, StripeShift)
        assert np.isnan([found.shift_px, found.u_px, found.brightness]).all()
        assert found.n_points <= n + 3
    gone = replace(first, uv=first.uv + 2.0 * REACH_PX * _side(first))
    assert np.isnan(stripe_shift(first, gone).shift_px)
