"""The other ways to find a stripe do what they are compared for, and errors are those that they make."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[3]))

from benchmarks.rendered_frames import RenderedFrame, judge
from benchmarks.stripe_methods import others

from rotaline.simulation.ideal.stripes import StripeScene, render_stripe

SCENE = StripeScene(angle_deg=80.0, offset_px=3.3, peak=180.0, background=4.0, noise=1.0)


@pytest.fixture(scope="module")
def frame() -> RenderedFrame:
    truth = SCENE.curve_points(0.25)
    inside = np.all((truth >= 8) & (truth <= 151), axis=1)
    normals = np.broadcast_to(SCENE.normal, truth.shape)
    return RenderedFrame(render_stripe(SCENE, np.random.default_rng(0)), truth[inside], normals[inside])


@pytest.mark.parametrize("name", sorted(others()))
def test_a_clear_stripe_is_found_to_a_fraction_of_a_pixel(name: str, frame: RenderedFrame) -> None:
    rms, points, found, strays = judge(others()[name], [frame])
    assert rms < 0.1
    assert points > 140
    assert found > 0.98
    assert strays == 0.0


def test_errors_are_measured_along_the_normal_and_strays_apart(frame: RenderedFrame) -> None:
    some = frame.uv[::4]
    half = some[: len(some) // 2]
    rms, points, found, strays = judge(lambda _: half + 0.2 * SCENE.normal, [frame])
    assert rms == pytest.approx(0.2, rel=1e-6)
    assert points == len(half)
    assert found == pytest.approx(0.5, abs=0.02)
    assert strays == 0.0
    away = np.vstack([some, some + 30.0 * SCENE.normal])
    rms, _, found, strays = judge(lambda _: away, [frame])
    assert rms == pytest.approx(0.0, abs=1e-9)
    assert found == 1.0
    assert strays == pytest.approx(0.5)
