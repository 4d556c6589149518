"""The verification of the stripe stage: cases, bound, rows."""

import numpy as np
import pytest

from rotaline.pipeline.verify_stripe import METHODS, centre_bound_px, stripe_cases, verify_stripe
from rotaline.simulation.ideal.stripes import StripeScene


def test_the_bound_is_that_of_the_textbook():
    scene = StripeScene(sigma_px=4.0, peak=200.0, noise=2.0, bits=16)
    assert centre_bound_px(scene) == pytest.approx(2.0 / 200.0 * np.sqrt(8.0 / np.sqrt(np.pi)), rel=0.01)
    assert np.isnan(centre_bound_px(StripeScene(peak=500.0)))
    assert np.isnan(centre_bound_px(StripeScene(speckle_contrast=0.1)))


def test_one_row_a_case_and_method():
    seen = []
    rows = verify_stripe(2, ["steger", "gray-gravity"], ["peak 220"], progress=lambda k, n: seen.append((k, n)))
    assert [(row.case, row.method) for row in rows] == [("peak 220", "gray-gravity"), ("peak 220", "steger")]
    assert seen == [(1, 1)]
    assert all(row.rms_px < 0.05 and row.found_fraction > 0.98 for row in rows)
    assert rows == verify_stripe(2, ["steger", "gray-gravity"], ["peak 220"])


def test_the_cases_cover_what_the_stage_promises():
    scenes = stripe_cases().values()
    assert {scene.angle_deg for scene in scenes} >= {0.0, 45.0, 90.0}
    assert {scene.sigma_px for scene in scenes} >= {1.0, 4.0}
    assert {scene.peak for scene in scenes} >= {40.0, 220.0}
    assert {scene.curve for scene in scenes} == {"line", "step", "arc"}
    assert "improved-gray-gravity" in METHODS
