"""The speckle limit against coherent imaging of a rough line, and against what it must depend on."""

import dataclasses

import numpy as np
import pytest

from rotaline.calibration.model import SystemCalibration
from rotaline.calibration.speckle_limit import LaserOptics, speckle_limit, speckle_limit_at_axis
from rotaline.geometry.primitives import Line, Plane, unit
from rotaline.vision.camera import CameraModel

CAMERA = CameraModel((1280, 960), 2450.0, 2450.0, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0)
POINT = np.array([0.0, 0.0, 300.0])
PLANE = Plane(unit(np.array([np.cos(np.deg2rad(30.0)), 0.0, -0.5])), 150.0)
OPTICS = LaserOptics(f_number=5.6, pixel_pitch_um=3.75, wavelength_nm=650.0)


def imaged_rough_line(sigma: float, n_fields: int, rng: np.random.Generator) -> np.ndarray:
    """Intensity (n_fields, across, along) of a line on a rough surface seen through a round aperture.

    Lengths in units of wavelength over sin u: there the aperture passes spatial frequencies up to 1.
    """
    n, side = 128, 16.0
    x = (np.arange(n) - n / 2) * side / n
    frequency = np.fft.fftfreq(n, side / n)
    aperture = np.hypot(frequency[:, None], frequency[None, :]) <= 1.0
    amplitude = np.exp(-((x[:, None] / sigma) ** 2) / 4.0)
    phases = rng.uniform(0.0, 2.0 * np.pi, (n_fields, n, n))
    return np.abs(np.fft.ifft2(np.fft.fft2(amplitude * np.exp(1j * phases)) * aperture)) ** 2


def scatter_of_centres(intensity: np.ndarray) -> float:
    """Standard deviation of the centroid across the line, at places that are a few grains apart along it; in the unit above."""
    x = (np.arange(128) - 64) * 0.125
    inside = np.abs(x) < 4.0
    rows = intensity[:, inside, ::16]
    return float(np.std((rows * x[inside, None]).sum(axis=1) / rows.sum(axis=1)))


def test_a_line_as_narrow_as_the_lens_resolves_scatters_as_the_limit_says():
    """In units of wavelength over sin u the limit is C / (2 pi); a wider line scatters more."""
    rng = np.random.default_rng(3)
    narrow = scatter_of_centres(imaged_rough_line(0.35, 60, rng)) * 2.0 * np.pi
    assert narrow == pytest.approx(1.0, abs=0.12)
    assert scatter_of_centres(imaged_rough_line(1.0, 60, rng)) * 2.0 * np.pi > 1.4


def test_the_limit_is_proportional_to_the_contrast():
    """Four patterns that do not interfere have half the contrast of one."""
    rng = np.random.default_rng(4)
    intensity = imaged_rough_line(0.35, 160, rng)
    one = scatter_of_centres(intensity)
    four = scatter_of_centres(intensity.reshape(40, 4, 128, 128).sum(axis=1))
    assert four / one == pytest.approx(0.5, abs=0.07)


def test_the_figures_of_a_rig():
    found = speckle_limit(OPTICS, CAMERA, PLANE, POINT)
    # b = 2450 * 3.75 um = 9.1875 mm, f = 8.9145 mm, D = 1.5919 mm, sin u = 0.79594 / 300
    assert found.sin_aperture == pytest.approx(0.0026531, rel=1e-4)
    assert found.lateral_mm == pytest.approx(650e-6 / (2 * np.pi * 0.0026531), rel=1e-4)
    assert np.rad2deg(found.triangulation_rad) == pytest.approx(30.0)
    assert found.depth_mm == pytest.approx(2.0 * found.lateral_mm)
    # the same in the image: a diffraction disc of f/5.75 over pi
    image_px = found.lateral_mm * CAMERA.fx / POINT[2]
    assert image_px == pytest.approx(0.65 * 5.6 * 9.1875 / 8.9145 / np.pi / 3.75, rel=1e-3)


@pytest.mark.parametrize(("field", "factor"), [("f_number", 2.0), ("wavelength_nm", 1.5), ("speckle_contrast", 0.1)])
def test_what_raises_the_limit(field, factor):
    base = speckle_limit(OPTICS, CAMERA, PLANE, POINT)
    other = dataclasses.replace(OPTICS, **{field: getattr(OPTICS, field) * factor})
    assert speckle_limit(other, CAMERA, PLANE, POINT).depth_mm == pytest.approx(factor * base.depth_mm, rel=1e-4)


def test_a_view_along_the_sheet_has_no_limit_in_depth():
    along = speckle_limit(OPTICS, CAMERA, Plane(np.array([1.0, 0.0, 0.0]), 0.0), POINT)
    assert along.depth_mm == np.inf
    assert np.isfinite(along.lateral_mm)


def test_at_the_axis_the_point_nearest_to_the_optical_axis_counts():
    direction = unit(np.array([0.1, -0.8, -0.5]))
    nearest = np.array([0.0, 0.0, 300.0])
    system = SystemCalibration(CAMERA, PLANE, Line(nearest + 40.0 * direction, direction), 1, True)
    expected = speckle_limit(OPTICS, CAMERA, PLANE, nearest)
    assert speckle_limit_at_axis(OPTICS, system).depth_mm == pytest.approx(expected.depth_mm)
