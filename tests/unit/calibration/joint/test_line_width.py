"""Where the centre of a broad line's image lies on a curved surface, against its profile summed up exactly."""

import numpy as np
import pytest

from rotaline.calibration.joint.line_width import crossing, line_and_blur
from rotaline.calibration.stripe_shift import stripe_shift
from rotaline.geometry.primitives import unit

FOCAL = 1500.0
SHEET = unit(np.array([0.8, 0.05, 0.55]))


def _ball(x, y):
    """Depth on a sphere along the rays (x, y, 1), its normal, and its curvature with the straight direction."""
    centre, radius = np.array([3.0, -2.0, 300.0]), 12.0
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    a, b = np.sum(rays**2, axis=-1), rays @ centre
    depth = (b - np.sqrt(b**2 - a * (centre @ centre - radius**2))) / a
    normal = (rays * depth[..., None] - centre) / radius
    return depth, normal, 1.0 / radius, np.zeros(3)


def _rod(x, y):
    axis, point, radius = unit(np.array([0.2, 0.95, 0.1])), np.array([2.0, 1.0, 310.0]), 18.0
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    r = rays - (rays @ axis)[..., None] * axis
    c = point - (point @ axis) * axis
    a, b = np.sum(r**2, axis=-1), r @ c
    depth = (b - np.sqrt(b**2 - a * (c @ c - radius**2))) / a
    normal = (depth[..., None] * r - c) / radius
    return depth, normal, 1.0 / radius, axis


def _plane(x, y):
    normal = unit(np.array([-0.3, 0.2, -0.9]))
    depth = -290.0 / (np.stack([x, y, np.ones_like(x)], axis=-1) @ normal)
    return depth, np.broadcast_to(normal, (*np.shape(x), 3)), 0.0, np.zeros(3)


_SURFACES = {"ball": (_ball, 0.004, -0.012), "rod": (_rod, -0.01, 0.015), "plane": (_plane, 0.03, -0.01)}


def _along(surface, x, y, direction):
    """Distance of the surface from the sheet through its point at (x, y), as a function of px along a direction."""
    depth, _, _, _ = surface(np.array(x), np.array(y))
    through = depth * np.array([x, y, 1.0])

    def distance(s):
        u, v = x + s * direction[0] / FOCAL, y + s * direction[1] / FOCAL
        return (surface(u, v)[0][:, None] * np.column_stack([u, v, np.ones_like(s)]) - through) @ SHEET

    return distance


def _crossing(surface, x, y, direction):
    depth, normal, curvature, straight = surface(np.array([x]), np.array([y]))
    rays = np.array([[x, y, 1.0]])
    by_px = direction[None] / FOCAL
    return crossing(rays, by_px, depth, normal, np.array([curvature]), straight[None], SHEET[None])


@pytest.mark.parametrize("name", _SURFACES)
def test_crossing_is_the_first_and_second_derivative_of_the_distance(name):
    surface, x, y = _SURFACES[name]
    direction = unit(np.array([0.9, 0.3, 0.0]))[:2]
    low, middle, high = _along(surface, x, y, direction)(np.array([-0.5, 0.0, 0.5]))
    a, b = _crossing(surface, x, y, direction)
    assert a[0] == pytest.approx(high - low, rel=1e-4)
    assert b[0] == pytest.approx((high - 2 * middle + low) / 0.25, rel=1e-3)


@pytest.mark.parametrize("name", ["ball", "rod"])
@pytest.mark.parametrize("sigma_mm", [0.05, 0.15])
def test_shift_is_that_of_the_centre_of_gravity(name, sigma_mm):
    """A surface that scatters evenly is as bright as the sheet that lights it, wherever it is seen from; blur spreads this, but does not move it."""
    surface, x, y = _SURFACES[name]
    direction = np.array([1.0, 0.0])
    a, b = _crossing(surface, x, y, direction)
    s = np.linspace(-7.0, 7.0, 4001) * sigma_mm / abs(a[0])
    light = np.exp(-0.5 * (_along(surface, x, y, direction)(s) / sigma_mm) ** 2)
    exact = float(s @ light / light.sum())
    shift = stripe_shift(a, b, np.zeros(1), sigma_mm, 1e3)[0]
    assert abs(exact) > 5e-5
    assert shift == pytest.approx(exact, rel=0.05)


@pytest.mark.parametrize("blur_px", [0.0, 0.6])
def test_width_of_the_line_from_stripes_on_steep_and_flat_surfaces(blur_px):
    rng = np.random.default_rng(1)
    a = rng.uniform(0.05, 0.3, 6000) * rng.choice([-1.0, 1.0], 6000)
    width = np.sqrt(blur_px**2 + (0.08 / a) ** 2) * (1 + 0.03 * rng.standard_normal(6000))
    width[::50] *= 5.0
    sigma_mm, blur = line_and_blur(width, a)
    assert sigma_mm == pytest.approx(0.08, rel=0.05)
    assert blur == pytest.approx(blur_px, abs=0.15)


def test_widths_that_do_not_show_the_line():
    rng = np.random.default_rng(2)
    a = rng.uniform(0.05, 0.3, 6000)
    assert line_and_blur(np.full(6000, 0.7), a)[0] == pytest.approx(0.0, abs=0.002)  # all of it blur
    assert line_and_blur(0.08 / a[:300], a[:300])[0] == 0.0  # too few points
    assert line_and_blur(np.full(6000, 0.7), 0.2 + 0.005 * rng.standard_normal(6000))[0] == 0.0  # one steepness
    growing = np.sqrt(np.maximum(1.0 - (0.02 / a) ** 2, 0.3))  # narrower where the line should be broader
    assert line_and_blur(growing, a)[0] == 0.0
