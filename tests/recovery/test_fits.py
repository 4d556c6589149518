"""Fits of noisy points: errors within their uncertainties, and the spread of repeats as predicted."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotaline.geometry.fitting import (
    across,
    fit_circle_orthogonal,
    fit_cylinder_orthogonal,
    fit_line_2d,
    fit_line_orthogonal,
    fit_plane_orthogonal,
    fit_sphere_orthogonal,
)
from rotaline.geometry.primitives import Cylinder, Line

N_REPEATS = 150
SPREAD = 4 / np.sqrt(2 * N_REPEATS)
"""Four standard deviations of the ratio of an observed to a true standard deviation."""

NOISE = 0.01


def check(errors: list[list[float]], uncertainties: list[list[float]]) -> None:
    """Compare the errors of repeats (r, p) with their predicted standard uncertainties (r, p)."""
    e, u = np.array(errors), np.array(uncertainties)
    z = e / u
    assert np.abs(z).max() < 5
    assert np.abs(z.mean(axis=0)).max() < 4 / np.sqrt(len(e))
    assert z.std(axis=0) == pytest.approx(1, abs=SPREAD)


@pytest.mark.parametrize("arc_deg", [60.0, 360.0])
def test_circle(arc_deg: float) -> None:
    rng = np.random.default_rng(1)
    angle = np.deg2rad(rng.uniform(0, arc_deg, 200))
    truth = 10.0 * np.column_stack([np.cos(angle), np.sin(angle)]) + [3, -2]
    errors, predicted = [], []
    for _ in range(N_REPEATS):
        fit = fit_circle_orthogonal(truth + rng.normal(0, NOISE, truth.shape))
        errors.append([*(fit.centre - [3, -2]), fit.radius - 10.0])
        predicted.append(np.sqrt(np.diag(fit.cov)).tolist())
    check(errors, predicted)


def test_sphere_cap() -> None:
    rng = np.random.default_rng(2)
    outward = rng.normal(size=(3000, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    truth = 14.0 * outward[outward[:, 2] > np.cos(np.deg2rad(40))]
    errors, predicted = [], []
    for _ in range(N_REPEATS):
        fit = fit_sphere_orthogonal(truth + rng.normal(0, NOISE, truth.shape))
        errors.append([*fit.sphere.centre, fit.sphere.radius - 14.0])
        predicted.append(np.sqrt(np.diag(fit.cov)).tolist())
    check(errors, predicted)


@pytest.mark.parametrize("arc_deg", [60.0, 360.0])
def test_cylinder(arc_deg: float) -> None:
    rng = np.random.default_rng(3)
    angle = np.deg2rad(rng.uniform(0, arc_deg, 300))
    truth = np.column_stack([19 * np.cos(angle), 19 * np.sin(angle), rng.uniform(0, 30, 300)])
    # Slanted, so that the two vectors across the axis do not depend on the noise.
    turn = Rotation.from_rotvec([0.4, 0.3, 0.2])
    truth, direction = turn.apply(truth), turn.apply([0.0, 0.0, 1.0])
    start = Cylinder(Line(np.zeros(3), direction), 18.0)
    errors, predicted = [], []
    for _ in range(N_REPEATS):
        fit = fit_cylinder_orthogonal(truth + rng.normal(0, NOISE, truth.shape), start)
        axis = fit.cylinder.axis
        e1, e2 = across(axis.direction)
        tilt = direction - axis.direction
        gap = (axis.point @ direction) * direction - axis.point
        errors.append([gap @ e1, gap @ e2, tilt @ e1, tilt @ e2, fit.cylinder.radius - 19.0])
        predicted.append(np.sqrt(np.diag(fit.cov)).tolist())
    check(errors, predicted)


def test_plane_and_lines() -> None:
    rng = np.random.default_rng(4)
    flat = np.column_stack([rng.uniform(-30, 30, 80), rng.uniform(-5, 5, 80), np.zeros(80)])
    flat -= flat.mean(axis=0)
    along = np.column_stack([np.linspace(-20, 20, 80), np.zeros((80, 2))])
    planes: tuple[list[list[float]], list[list[float]]] = ([], [])
    lines: tuple[list[list[float]], list[list[float]]] = ([], [])
    lines_2d: tuple[list[list[float]], list[list[float]]] = ([], [])
    _, _, axes = np.linalg.svd(flat, full_matrices=False)
    for _ in range(N_REPEATS):
        plane = fit_plane_orthogonal(flat + rng.normal(0, NOISE, flat.shape))
        planes[0].append([plane.plane.normal @ axes[1], plane.plane.normal @ axes[0], plane.centroid[2]])
        planes[1].append([*plane.u_normal_rad, plane.u_offset])
        line = fit_line_orthogonal(along + rng.normal(0, NOISE, along.shape))
        lines[0].append([*line.line.direction[1:] * np.sign(line.line.direction[0]), *line.line.point[1:]])
        lines[1].append([line.u_direction_rad] * 2 + [line.u_position] * 2)
        flat_line = fit_line_2d(along[:, :2] + rng.normal(0, NOISE, (80, 2)))
        lines_2d[0].append([flat_line.direction[1] * np.sign(flat_line.direction[0]), flat_line.point[1]])
        lines_2d[1].append(np.sqrt(np.diag(flat_line.cov)).tolist())
    check(*planes)
    check(*lines)
    check(*lines_2d)
