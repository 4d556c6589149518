"""Orthogonal (geometric) least squares of lines, planes, circles, spheres and cylinders, with covariance.

Residuals are true distances from the surface, so short arcs and small caps come out unbiased where algebraic fits do not.
Data are centred and scaled before they are fitted. This module holds the curved shapes and gives all fits one address;
lines and planes stand in ``fitting_lines``.

Weights multiply the squared residuals and count relative to each other: the variance of a point of weight 1 is estimated
from the residuals. A covariance is NaN where no degree of freedom is left.

References
----------
.. [1] Forbes, Least-squares best-fit geometric elements, NPL report DITC 140/89, 1989
.. [2] Chernov, Circular and Linear Regression, 2010, sections 4.5 (Levenberg-Marquardt) and 5.8 (Taubin)
.. [3] Taubin, IEEE Trans. PAMI 13 (1991) 1115
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rotaline.errors import GeometryError
from rotaline.geometry.fitting_lines import (
    DEGENERATE,
    Line2DFit,
    LineFit,
    PlaneFit,
    fit_line_2d,
    fit_line_orthogonal,
    fit_plane_orthogonal,
)
from rotaline.geometry.least_squares import covariance, minimise, triangular_factor, variance_of_unit_weight
from rotaline.geometry.primitives import Cylinder, Line, Sphere, unit

__all__ = [
    "Circle2DFit",
    "CylinderFit",
    "Line2DFit",
    "LineFit",
    "PlaneFit",
    "SphereFit",
    "across",
    "fit_circle_algebraic",
    "fit_circle_orthogonal",
    "fit_cylinder_orthogonal",
    "fit_line_2d",
    "fit_line_orthogonal",
    "fit_plane_orthogonal",
    "fit_sphere_orthogonal",
]


@dataclass(frozen=True, eq=False)
class Circle2DFit:
    """A circle in a plane.

    Attributes
    ----------
    centre : (2,), radius : in the unit of the points
    residuals : (n,)   signed distances from the circle, positive outside
    rms : of the residuals
    cov : (3, 3)   of centre x, centre y, radius
    """

    centre: Float[np.ndarray, "2"]
    radius: float
    residuals: Float[np.ndarray, " n"]
    rms: float
    cov: Float[np.ndarray, "3 3"]


@dataclass(frozen=True, eq=False)
class SphereFit:
    """A sphere: signed residuals (positive outside, mm) and the covariance (4, 4) of centre x, y, z and radius (mm^2)."""

    sphere: Sphere
    residuals: Float[np.ndarray, " n"]
    rms: float
    cov: Float[np.ndarray, "4 4"]


@dataclass(frozen=True, eq=False)
class CylinderFit:
    """A cylinder.

    Attributes
    ----------
    cylinder : Cylinder   ``axis.point`` is the foot of the centroid of the points
    residuals : (n,)   signed distances, mm, positive outside
    rms : mm
    u_radius : standard uncertainty of the radius, mm
    cov : (5, 5)   of the axis point along e1 and e2 (mm), the tilt of the direction towards e1 and e2 (rad), the radius (mm),
        with ``e1, e2 = across(cylinder.axis.direction)``
    """

    cylinder: Cylinder
    residuals: Float[np.ndarray, " n"]
    rms: float
    u_radius: float
    cov: Float[np.ndarray, "5 5"]


def across(direction: Float[np.ndarray, "3"]) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Two unit vectors at right angles to a unit vector and to each other; ``e1, e2, direction`` is right-handed."""
    helper = np.zeros(3)
    helper[np.argmin(np.abs(direction))] = 1.0
    e1 = unit(np.cross(helper, direction))
    return e1, np.cross(direction, e1)


def fit_circle_algebraic(points: Float[np.ndarray, "n 2"]) -> Circle2DFit:
    """Fit a circle by Taubin's method: no iteration, a start value for ``fit_circle_orthogonal`` [3]_.

    Short noisy arcs come out slightly biased; the covariance is that of an orthogonal fit at this circle.

    Raises
    ------
    GeometryError
        If there are fewer than three points, or they lie on a line.
    """
    centred, centroid, scale = _normalise(points, None, 3, "circle")
    centre, radius = _fit_taubin(centred, "circle")
    residuals, jacobian = _round_residuals(centred, np.append(centre, radius))
    factor = triangular_factor(jacobian)
    variance = variance_of_unit_weight(residuals, None, 3)
    return Circle2DFit(
        centroid + scale * centre,
        scale * radius,
        scale * residuals,
        _rms(scale * residuals, None),
        covariance(factor, variance) * scale**2,
    )


def fit_circle_orthogonal(
    points: Float[np.ndarray, "n 2"], weights: Float[np.ndarray, " n"] | None = None
) -> Circle2DFit:
    """Fit a circle by orthogonal least squares.

    Parameters
    ----------
    points : (n, 2)   any unit
    weights : (n,)   of the squared distances, >= 0

    Raises
    ------
    GeometryError
        If there are fewer than three points, or they lie on a line.

    Examples
    --------
    >>> import numpy as np
    >>> angle = np.deg2rad([0.0, 10.0, 20.0, 30.0])
    >>> fit = fit_circle_orthogonal(np.column_stack([10 * np.cos(angle), 10 * np.sin(angle)]))
    >>> round(fit.radius, 9)
    10.0
    """
    centred, centroid, scale = _normalise(points, weights, 3, "circle")
    centre, radius = _fit_taubin(centred if weights is None else centred[weights > 0], "circle")
    parameters, residuals, cov, rms = _fit_round(centred, np.append(centre, radius), weights, "circle")
    return Circle2DFit(
        centroid + scale * parameters[:2], float(scale * parameters[2]), scale * residuals, scale * rms, scale**2 * cov
    )


def fit_sphere_orthogonal(
    points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"] | None = None, start: Sphere | None = None
) -> SphereFit:
    """Fit a sphere by orthogonal least squares.

    Parameters
    ----------
    points : (n, 3)   mm
    weights : (n,)   of the squared distances, >= 0
    start : Sphere   where the iteration starts; without it, Taubin's algebraic fit

    Raises
    ------
    GeometryError
        If there are fewer than four points, or they lie on a plane or on a single circle.
    """
    centred, centroid, scale = _normalise(points, weights, 4, "sphere")
    if start is None:
        centre, radius = _fit_taubin(centred if weights is None else centred[weights > 0], "sphere")
        guess = np.append(centre, radius)
    else:
        guess = np.append(start.centre - centroid, start.radius) / scale
    parameters, residuals, cov, rms = _fit_round(centred, guess, weights, "sphere")
    sphere = Sphere(centroid + scale * parameters[:3], float(scale * parameters[3]))
    return SphereFit(sphere, scale * residuals, scale * rms, scale**2 * cov)


def fit_cylinder_orthogonal(
    points: Float[np.ndarray, "n 3"], start: Cylinder, weights: Float[np.ndarray, " n"] | None = None
) -> CylinderFit:
    """Fit a cylinder by orthogonal least squares.

    Parameters
    ----------
    points : (n, 3)   mm
    start : Cylinder   where the iteration starts; its direction should be within some 30 deg
    weights : (n,)   of the squared distances, >= 0

    Raises
    ------
    GeometryError
        If there are fewer than five points, or they do not determine a cylinder (points on a line, on a plane, on one circle).
    """
    centred, centroid, scale = _normalise(points, weights, 5, "cylinder")
    axis = Line((start.axis.point - centroid) / scale, unit(start.axis.direction))
    guess = Cylinder(_slide(axis), start.radius / scale)

    def linearise(cylinder: Cylinder) -> tuple[np.ndarray, np.ndarray]:
        e1, e2 = across(cylinder.axis.direction)
        relative = centred - cylinder.axis.point
        along = relative @ cylinder.axis.direction
        x, y = relative @ e1, relative @ e2
        rho = np.hypot(x, y)
        safe = np.where(rho > 0, rho, 1.0)
        cos, sin = x / safe, y / safe
        jacobian = np.column_stack([-cos, -sin, -along * cos, -along * sin, -np.ones(len(centred))])
        return rho - cylinder.radius, jacobian

    def retract(cylinder: Cylinder, step: np.ndarray) -> Cylinder:
        e1, e2 = across(cylinder.axis.direction)
        point = cylinder.axis.point + step[0] * e1 + step[1] * e2
        direction = unit(cylinder.axis.direction + step[2] * e1 + step[3] * e2)
        return Cylinder(_slide(Line(point, direction)), float(cylinder.radius + step[4]))

    try:
        solution = minimise(linearise, retract, guess, weights)
    except GeometryError as error:
        raise GeometryError(
            f"The {len(points)} points do not determine a cylinder: {error} Use points on more than one line and one circle "
            "of its side, over a larger part of the turn."
        ) from error
    fitted = solution.state
    if not 0 < fitted.radius < 1e6:
        raise GeometryError(
            f"The points do not bend like the side of a cylinder (radius {scale * fitted.radius:.3g} mm for an extent of "
            f"{scale:.3g} mm). Use points over a larger part of the turn."
        )
    to_mm = np.array([scale, scale, 1.0, 1.0, scale])
    cov = covariance(solution.factor, variance_of_unit_weight(solution.residuals, weights, 5)) * np.outer(to_mm, to_mm)
    residuals = scale * solution.residuals
    cylinder = Cylinder(Line(centroid + scale * fitted.axis.point, fitted.axis.direction), float(scale * fitted.radius))
    return CylinderFit(cylinder, residuals, _rms(residuals, weights), float(np.sqrt(cov[4, 4])), cov)


def _slide(axis: Line) -> Line:
    """The same line with its point nearest to the origin."""
    return Line(axis.point - (axis.point @ axis.direction) * axis.direction, axis.direction)


def _normalise(
    points: np.ndarray, weights: np.ndarray | None, n_needed: int, shape: str
) -> tuple[np.ndarray, np.ndarray, float]:
    """Points with (weighted) mean 0 and mean square distance 1, their centroid and scale."""
    n = len(points) if weights is None else int(np.count_nonzero(weights))
    if n < n_needed:
        raise GeometryError(f"A {shape} needs at least {n_needed} points; there are {n}.")
    if not np.all(np.isfinite(points)):
        raise GeometryError(f"The points of a {shape} must be finite numbers; leave out the missing ones.")
    centroid = points.mean(axis=0) if weights is None else weights @ points / weights.sum()
    centred = points - centroid
    squared = np.einsum("ij,ij->i", centred, centred)
    scale = float(np.sqrt(squared.mean() if weights is None else weights @ squared / weights.sum()))
    if not scale > DEGENERATE * 1e-3 * max(float(np.abs(centroid).max()), 1e-300):
        raise GeometryError(f"All points of the {shape} coincide near {np.round(centroid, 6).tolist()}; spread them.")
    return centred / scale, centroid, scale


def _fit_taubin(centred: np.ndarray, shape: str) -> tuple[np.ndarray, float]:
    """Centre and radius of the circle or sphere through centred points, by singular values [2]_."""
    centroid = centred.mean(axis=0)
    centred = centred - centroid
    squared = np.einsum("ij,ij->i", centred, centred)
    mean = float(squared.mean())
    lifted = np.column_stack([(squared - mean) / (2 * np.sqrt(mean)), centred])
    triangle = triangular_factor(lifted) if len(lifted) > lifted.shape[1] else lifted
    _, singular, right = np.linalg.svd(triangle, full_matrices=True)
    singular = np.concatenate([singular, np.zeros(lifted.shape[1] - len(singular))])
    if not singular[-2] > 1e-9 * singular[0]:
        lies = "on a line" if shape == "circle" else "on a plane, or on one circle,"
        raise GeometryError(f"The points lie {lies} and do not determine a {shape}. Use points spread over more of it.")
    a = right[-1, 0] / (2 * np.sqrt(mean))
    b = right[-1, 1:]
    if not abs(a) > 1e-7 * float(np.linalg.norm(b)):
        lies = "a line" if shape == "circle" else "a plane"
        raise GeometryError(
            f"The points lie on {lies}, not on a {shape}. Use points over a larger part of the {shape}."
        )
    radius = float(np.sqrt(b @ b + 4 * a**2 * mean) / (2 * abs(a)))
    return centroid - b / (2 * a), radius


def _round_residuals(centred: np.ndarray, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances from the circle or sphere (centre, radius), and their derivatives."""
    outward = centred - parameters[:-1]
    distance = np.linalg.norm(outward, axis=1)
    jacobian = np.empty((len(centred), len(parameters)))
    jacobian[:, :-1] = -outward / np.where(distance > 0, distance, 1.0)[:, None]
    jacobian[:, -1] = -1.0
    return distance - parameters[-1], jacobian


def _fit_round(
    centred: np.ndarray, guess: np.ndarray, weights: np.ndarray | None, shape: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Orthogonal fit of a circle or sphere to normalised points: parameters, residuals, covariance, rms."""
    try:
        solution = minimise(
            lambda parameters: _round_residuals(centred, parameters),
            lambda parameters, step: parameters + step,
            guess,
            weights,
        )
    except GeometryError as error:
        raise GeometryError(
            f"The {len(centred)} points do not determine a {shape}: {error} Use points over a larger part of the {shape}."
        ) from error
    variance = variance_of_unit_weight(solution.residuals, weights, len(guess))
    return (
        solution.state,
        solution.residuals,
        covariance(solution.factor, variance),
        _rms(solution.residuals, weights),
    )


def _rms(residuals: np.ndarray, weights: np.ndarray | None) -> float:
    if weights is None:
        return float(np.sqrt(np.mean(residuals**2)))
    return float(np.sqrt(weights @ residuals**2 / weights.sum()))
