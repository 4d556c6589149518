"""Scatter of known parts is split into these parts again."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from rotaline.calibration.joint.model import JointMount
from rotaline.calibration.scatter import mount_scatter
from rotaline.geometry.primitives import KnownCylinder


def make_mount(distances_mm: np.ndarray, angles_rad: np.ndarray) -> JointMount:
    """A mount from distances (frames, points), half of them on each of two surfaces."""
    f, p = distances_mm.shape
    n = f * p
    return JointMount(
        "rod",
        KnownCylinder(20.0),
        RigidTransform.identity(),
        5.0,
        0.001,
        0.0,
        tuple(f"rod/{i:04d}.png" for i in range(f)),
        angles_rad,
        np.repeat(np.arange(f), p),
        np.tile(np.arange(p) % 2, f),
        np.zeros((n, 3)),
        distances_mm.ravel(),
        np.zeros(n),
        np.ones(n),
        ("side", "top disc"),
        np.zeros(2),
        np.zeros(2),
        float("nan"),
    )


ANGLES = np.deg2rad(np.arange(0.0, 360.0, 3.0))


def test_the_parts_come_out_again():
    """720 frames: the standard deviation of a sample is known to 2.6 %."""
    rng = np.random.default_rng(1)
    angles = np.deg2rad(np.arange(0.0, 360.0, 0.5))
    wave = 0.004 * np.cos(angles - 0.4) + 0.002 * np.sin(3 * angles)
    frames = rng.normal(0.0, 0.003, len(angles))
    distances = wave[:, None] + frames[:, None] + rng.normal(0.0, 0.010, (len(angles), 100))
    found = mount_scatter(make_mount(distances, angles))
    assert found.within_mm == pytest.approx(0.010, rel=0.02)
    assert found.between_mm == pytest.approx(0.003, rel=0.08)
    assert found.waves_mm[[0, 2]] == pytest.approx(np.array([0.004, 0.002]) / np.sqrt(2), abs=0.0003)
    assert np.all(found.waves_mm[[0, 2]] > found.chance_mm)
    assert np.all(found.waves_mm[[1, 3]] < found.chance_mm)
    assert found.total_mm == pytest.approx(float(np.sqrt(np.mean(distances**2))))


def test_noise_of_single_points_is_not_taken_for_scatter_of_the_frames():
    """Neighbours that share their noise leave more of it in the mean of a frame; what they leave is taken off."""
    rng = np.random.default_rng(2)
    noise = np.repeat(rng.normal(0.0, 0.010, (len(ANGLES), 25)), 8, axis=1)
    mount = make_mount(noise, ANGLES)
    correlated = mount_scatter(mount, correlation_length=4.0)  # every second point of a run of 8 is on the same surface
    assert correlated.between_mm < 0.4 * mount_scatter(mount).between_mm


def test_a_short_arc_has_no_waves_and_points_left_out_do_not_count():
    rng = np.random.default_rng(3)
    arc = ANGLES[:40]
    distances = rng.normal(0.0, 0.010, (40, 60))
    mount = make_mount(distances, arc)
    spoiled = distances.copy()
    spoiled[:, 7] = 3.0
    weight = np.ones_like(distances)
    weight[:, 7] = 0.0
    left_out = dataclasses.replace(make_mount(spoiled, arc), weight=weight.ravel())
    assert mount_scatter(left_out).within_mm == pytest.approx(mount_scatter(mount).within_mm, rel=0.05)
    assert np.isnan(mount_scatter(mount).waves_mm).all()
    assert np.isfinite(mount_scatter(mount).between_mm)


def test_too_few_frames_say_nothing_about_the_turn():
    found = mount_scatter(make_mount(np.zeros((2, 30)), ANGLES[:2]))
    assert np.isnan(found.between_mm)
    assert found.within_mm == 0.0
