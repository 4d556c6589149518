"""Orthogonal fits: exact on exact data, the same in every frame and scale, clear about degenerate points."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.errors import GeometryError
from rotaline.geometry.fitting import (
    across,
    fit_circle_algebraic,
    fit_circle_orthogonal,
    fit_cylinder_orthogonal,
    fit_line_2d,
    fit_line_orthogonal,
    fit_plane_orthogonal,
    fit_sphere_orthogonal,
)
from rotaline.geometry.least_squares import triangular_factor
from rotaline.geometry.primitives import Cylinder, Line, Sphere

MOVES = st.builds(
    lambda rotvec, shift: RigidTransform.from_components(shift, Rotation.from_rotvec(rotvec)),
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.tuples(*[st.floats(-500, 500)] * 3),
)


def arc(radius: float, arc_deg: float, n: int = 40) -> np.ndarray:
    angle = np.deg2rad(np.linspace(0, arc_deg, n))
    return radius * np.column_stack([np.cos(angle), np.sin(angle)])


def cap(radius: float, half_angle_deg: float, n: int = 120) -> np.ndarray:
    z = np.linspace(np.cos(np.deg2rad(half_angle_deg)), 1.0, n)
    turn = 2.4 * np.arange(n)
    rho = np.sqrt(1 - z**2)
    return radius * np.column_stack([rho * np.cos(turn), rho * np.sin(turn), z])


def shell(radius: float, arc_deg: float, height: float = 20.0) -> np.ndarray:
    angle, z = np.meshgrid(np.deg2rad(np.linspace(0, arc_deg, 15)), np.linspace(0, height, 12))
    return np.column_stack([radius * np.cos(angle.ravel()), radius * np.sin(angle.ravel()), z.ravel()])


@settings(deadline=None, max_examples=40)
@given(radius=st.floats(0.1, 1000), arc_deg=st.floats(5, 360), x=st.floats(-1e3, 1e3), y=st.floats(-1e3, 1e3))
def test_exact_circles_come_back_exactly(radius: float, arc_deg: float, x: float, y: float) -> None:
    points = arc(radius, arc_deg) + np.array([x, y])
    limit = 1e-8 * radius + 1e-9 * np.hypot(x, y)
    for fit in (fit_circle_orthogonal(points), fit_circle_algebraic(points)):
        assert fit.radius == pytest.approx(radius, abs=limit)
        assert fit.centre == pytest.approx([x, y], abs=limit)
        assert np.abs(fit.residuals).max() < 1e-12 * (radius + np.hypot(x, y))


@settings(deadline=None, max_examples=25)
@given(move=MOVES, radius=st.floats(1.5, 150), half_angle=st.floats(10, 90))
def test_exact_spheres_come_back_exactly(move: RigidTransform, radius: float, half_angle: float) -> None:
    fit = fit_sphere_orthogonal(move.apply(cap(radius, half_angle)))
    assert fit.sphere.radius == pytest.approx(radius, rel=1e-7)
    assert fit.sphere.centre == pytest.approx(move.apply([0, 0, 0]), abs=1e-7 * radius + 1e-9)
    assert fit.rms < 1e-11


@settings(deadline=None, max_examples=25)
@given(move=MOVES, radius=st.floats(1.5, 150), arc_deg=st.floats(40, 360))
def test_exact_cylinders_come_back_exactly_from_a_rough_start(
    move: RigidTransform, radius: float, arc_deg: float
) -> None:
    points = move.apply(shell(radius, arc_deg, height=1.5 * radius))
    direction = move.rotation.apply([0.1, -0.08, 1.0])
    start = Cylinder(Line(move.apply([0.1 * radius, 0.1 * radius, 0.0]), direction), 1.2 * radius)
    fit = fit_cylinder_orthogonal(points, start)
    assert fit.cylinder.radius == pytest.approx(radius, rel=1e-8)
    assert abs(fit.cylinder.axis.direction @ move.rotation.apply([0, 0, 1])) == pytest.approx(1, abs=1e-12)
    assert fit.cylinder.axis.distance_to(move.apply([0, 0, 0])[None])[0] < 1e-8 * radius + 1e-9
    assert fit.rms < 1e-11


@settings(deadline=None, max_examples=25)
@given(move=MOVES, scale=st.floats(0.1, 50))
def test_planes_and_lines_move_and_scale_with_their_points(move: RigidTransform, scale: float) -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(size=(50, 3)) * [5, 3, 0.1]
    plane, moved_plane = fit_plane_orthogonal(points), fit_plane_orthogonal(move.apply(scale * points))
    assert moved_plane.rms == pytest.approx(scale * plane.rms, rel=1e-6)
    assert abs(moved_plane.plane.normal @ move.rotation.apply(plane.plane.normal)) == pytest.approx(1, abs=1e-12)
    assert moved_plane.u_normal_rad == pytest.approx(plane.u_normal_rad, rel=1e-6)
    assert moved_plane.u_offset == pytest.approx(scale * plane.u_offset, rel=1e-6)
    line, moved_line = fit_line_orthogonal(points), fit_line_orthogonal(move.apply(scale * points))
    assert moved_line.rms == pytest.approx(scale * line.rms, rel=1e-6)
    assert moved_line.line.point == pytest.approx(move.apply(scale * line.line.point), abs=1e-9)
    assert abs(moved_line.line.direction @ move.rotation.apply(line.line.direction)) == pytest.approx(1, abs=1e-12)


def test_the_sign_of_residuals_is_that_of_the_outside_or_the_normal() -> None:
    ring = np.vstack([arc(10, 350), [[12.0, 0.0]]])
    assert fit_circle_orthogonal(ring).residuals[-1] > 1
    points = np.vstack([np.random.default_rng(0).uniform(-5, 5, (60, 3)) * [1, 1, 0], [[0.0, 0.0, 1.0]]])
    plane = fit_plane_orthogonal(points)
    assert np.sign(plane.residuals[-1]) == np.sign(plane.plane.normal[2])
    assert plane.residuals == pytest.approx(plane.plane.signed_distance_to(points), abs=1e-12)
    row = np.column_stack([np.linspace(0, 9, 20), np.zeros(20)])
    row[10, 1] = 0.5
    fit = fit_line_2d(row)
    assert np.sign(fit.residuals[10]) == np.sign(fit.direction[0])
    assert fit.residuals == pytest.approx(fit.signed_distance_to(row))


def test_weight_zero_leaves_a_point_out_and_equal_weights_change_nothing() -> None:
    rng = np.random.default_rng(5)
    points = shell(9.5, 200) + rng.normal(0, 0.01, (180, 3))
    spoiled = np.vstack([points, [[100.0, 3.0, 2.0]]])
    weights = np.append(np.full(180, 3.0), 0.0)
    start = Cylinder(Line(np.zeros(3), np.array([0.0, 0.0, 1.0])), 9.0)
    plain, weighted = fit_cylinder_orthogonal(points, start), fit_cylinder_orthogonal(spoiled, start, weights)
    assert weighted.cylinder.radius == pytest.approx(plain.cylinder.radius, abs=1e-9)
    assert weighted.cov == pytest.approx(plain.cov, rel=1e-4, abs=1e-14)
    for fit, coordinates in ((fit_circle_orthogonal, 2), (fit_sphere_orthogonal, 3)):
        good = (arc(9.5, 100) if coordinates == 2 else cap(9.5, 60)) + rng.normal(
            0, 0.01, (40 if coordinates == 2 else 120, coordinates)
        )
        bad = np.vstack([good, np.full((1, coordinates), 30.0)])
        keep = np.append(np.full(len(good), 2.0), 0.0)
        assert fit(bad, keep).rms == pytest.approx(fit(good).rms, rel=1e-6)


def test_the_cylinder_covariance_is_that_of_a_numerical_jacobian() -> None:
    rng = np.random.default_rng(8)
    points = shell(12.0, 150) + rng.normal(0, 0.02, (180, 3))
    fit = fit_cylinder_orthogonal(points, Cylinder(Line(np.zeros(3), np.array([0.0, 0.0, 1.0])), 11.0))
    axis = fit.cylinder.axis
    e1, e2 = across(axis.direction)

    def residuals(p: np.ndarray) -> np.ndarray:
        direction = axis.direction + p[2] * e1 + p[3] * e2
        line = Line(axis.point + p[0] * e1 + p[1] * e2, direction / np.linalg.norm(direction))
        return line.distance_to(points) - fit.cylinder.radius - p[4]

    judge = least_squares(residuals, np.zeros(5), xtol=1e-15, ftol=1e-15)
    assert judge.x == pytest.approx(np.zeros(5), abs=1e-6)
    expected = np.linalg.inv(judge.jac.T @ judge.jac) * np.sum(fit.residuals**2) / 175
    assert np.allclose(fit.cov, expected, rtol=1e-3, atol=1e-3 * np.abs(expected).max() * 1e-3)
    assert fit.u_radius == pytest.approx(np.sqrt(fit.cov[4, 4]))


CIRCLE_LINE = np.column_stack([np.arange(9.0), 2 * np.arange(9.0)])
FLAT = np.column_stack([arc(5, 300), np.zeros(40)])
AXIS_Z = Line(np.zeros(3), np.array([0.0, 0.0, 1.0]))


@pytest.mark.parametrize(
    ("fit", "message"),
    [
        (lambda: fit_circle_orthogonal(CIRCLE_LINE), "line"),
        (lambda: fit_circle_algebraic(CIRCLE_LINE), "line"),
        (lambda: fit_circle_orthogonal(np.zeros((2, 2))), "at least 3 points; there are 2"),
        (lambda: fit_circle_orthogonal(np.ones((9, 2))), "coincide"),
        (lambda: fit_circle_orthogonal(np.full((9, 2), np.nan)), "finite"),
        (lambda: fit_sphere_orthogonal(FLAT), "on one circle"),
        (lambda: fit_sphere_orthogonal(FLAT, start=Sphere(np.zeros(3), 5.0)), "determine a sphere"),
        (lambda: fit_sphere_orthogonal(FLAT[:3]), "at least 4"),
        (lambda: fit_plane_orthogonal(np.column_stack([CIRCLE_LINE, CIRCLE_LINE[:, 0]])), "on a line"),
        (lambda: fit_plane_orthogonal(FLAT[:2]), "at least 3"),
        (lambda: fit_line_orthogonal(np.ones((4, 3))), "coincide"),
        (lambda: fit_line_2d(arc(4, 270, 4)), "spread equally"),
        (lambda: fit_cylinder_orthogonal(FLAT, Cylinder(AXIS_Z, 5.0)), "cylinder"),
        (lambda: fit_cylinder_orthogonal(FLAT[:4], Cylinder(AXIS_Z, 5.0)), "at least 5"),
    ],
)
def test_degenerate_points_are_named(fit: Callable[[], object], message: str) -> None:
    with pytest.raises(GeometryError, match=message):
        fit()


@settings(deadline=None, max_examples=30)
@given(n=st.integers(1, 1500), p=st.integers(1, 6), seed=st.integers(0, 99))
def test_the_triangular_factor_has_the_same_gram_matrix(n: int, p: int, seed: int) -> None:
    matrix = np.random.default_rng(seed).normal(size=(n, p))
    factor = triangular_factor(matrix)
    assert factor.shape == (min(n, p), p)
    assert np.allclose(factor.T @ factor, matrix.T @ matrix, atol=1e-9)
    assert np.all(np.tril(factor, -1) == 0)
