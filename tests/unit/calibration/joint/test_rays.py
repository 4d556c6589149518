"""Rays of pixels and their derivatives against the camera model itself."""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.calibration.joint.rays import RayBundle
from rotaline.vision.camera import CameraModel

CAMERA = CameraModel((640, 480), 1510.0, 1495.0, 323.0, 236.0, k1=-0.2, k2=0.15, p1=0.001, p2=-0.002, k3=0.05)
UV = np.random.default_rng(1).uniform([20.0, 20.0], [620.0, 460.0], (40, 2))
NAMES = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "p1", "p2")


def test_rays_lead_to_their_pixels():
    bundle = RayBundle.of(CAMERA, UV)
    assert CAMERA.project(200.0 * bundle.directions) == pytest.approx(UV, abs=1e-9)
    assert (bundle.directions[:, 2] == 1.0).all()


def test_derivative_by_the_pixel():
    bundle = RayBundle.of(CAMERA, UV)
    for k in range(2):
        step = 1e-3 * np.eye(2)[k]
        difference = (CAMERA.rays(UV + step) - CAMERA.rays(UV - step))[:, :2] / 2e-3
        assert bundle.by_pixel[:, :, k] == pytest.approx(difference, rel=1e-6, abs=1e-10)


def test_change_per_pixel_in_a_direction():
    bundle = RayBundle.of(CAMERA, UV)
    angle = np.linspace(0.0, 6.0, len(UV))
    towards = np.column_stack([np.cos(angle), np.sin(angle)])
    slopes = np.random.default_rng(2).standard_normal((len(UV), 2))
    there = CAMERA.rays(UV + 1e-3 * towards)[:, :2] - CAMERA.rays(UV - 1e-3 * towards)[:, :2]
    difference = np.einsum("ni,ni->n", slopes, there) / 2e-3
    assert bundle.per_pixel(slopes, towards) == pytest.approx(difference, rel=1e-6)
    keep = np.arange(len(UV)) % 3 == 0
    some = bundle.select(keep)
    assert some.per_pixel(slopes[keep], towards[keep]) == pytest.approx(bundle.per_pixel(slopes, towards)[keep])


@pytest.mark.parametrize("name", NAMES)
def test_derivative_by_a_parameter_of_the_camera_while_the_pixel_stays(name):
    slopes = np.random.default_rng(3).standard_normal((len(UV), 2))
    size = 1e-2 if name in ("fx", "fy", "cx", "cy") else 1e-4
    ends = [replace(CAMERA, **{name: getattr(CAMERA, name) + s * size}).rays(UV)[:, :2] for s in (1, -1)]
    difference = np.einsum("ni,ni->n", slopes, ends[0] - ends[1]) / (2 * size)
    columns = RayBundle.of(CAMERA, UV).camera_columns(slopes, NAMES)
    scale = np.abs(difference).max()
    assert columns[:, NAMES.index(name)] == pytest.approx(difference, abs=1e-5 * scale)


def test_an_unknown_parameter():
    with pytest.raises(ValueError, match="'k9'"):
        RayBundle.of(CAMERA, UV).camera_columns(np.ones((len(UV), 2)), ["k9"])
