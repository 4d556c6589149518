"""Orthogonal least squares of lines and planes, with covariance.

The fits are linear: the centroid lies on the line or plane, the directions are singular vectors of the centred points.
The singular values are taken of the points themselves, never of their scatter matrix.

References
----------
.. [1] Shakarji, Least-squares fitting algorithms of the NIST algorithm testing system, J. Res. NIST 103 (1998) 633
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rotaline.errors import GeometryError
from rotaline.geometry.least_squares import triangular_factor
from rotaline.geometry.primitives import Line, Plane

DEGENERATE = 1e-10
"""Ratio of extents below which points count as coincident, collinear or coplanar."""


@dataclass(frozen=True, eq=False)
class LineFit:
    """A line through points in space.

    Attributes
    ----------
    line : Line   ``line.point`` is the centroid
    residuals : (n,)   distances of the points, mm
    rms : mm
    u_direction_rad : standard uncertainty of the direction, the same in both ways across the line
    u_position : standard uncertainty of the line's position across itself at the centroid, mm
    """

    line: Line
    residuals: Float[np.ndarray, " n"]
    rms: float
    u_direction_rad: float
    u_position: float


@dataclass(frozen=True, eq=False)
class Line2DFit:
    """A line through points of a plane.

    Attributes
    ----------
    point : (2,)   centroid of the points
    direction : (2,)   unit vector
    residuals : (n,)   signed distances, positive to the left of the direction
    rms : in the unit of the points
    cov : (2, 2)   of the angle of the direction (rad) and of the offset across the line at the centroid
    """

    point: Float[np.ndarray, "2"]
    direction: Float[np.ndarray, "2"]
    residuals: Float[np.ndarray, " n"]
    rms: float
    cov: Float[np.ndarray, "2 2"]

    @property
    def normal(self) -> Float[np.ndarray, "2"]:
        """Unit vector to the left of the direction."""
        return np.array([-self.direction[1], self.direction[0]])

    def signed_distance_to(self, points: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """Distance of each point, positive to the left of the direction."""
        return (points - self.point) @ self.normal


@dataclass(frozen=True, eq=False)
class PlaneFit:
    """A plane through points in space.

    Attributes
    ----------
    plane : Plane
    centroid : (3,)   mm, on the plane
    residuals : (n,)   signed distances, mm, positive on the side of the normal
    rms : mm
    u_normal_rad : standard uncertainties of the normal along the two principal directions of the points, larger first
    u_offset : standard uncertainty of the plane along its normal at the centroid, mm
    """

    plane: Plane
    centroid: Float[np.ndarray, "3"]
    residuals: Float[np.ndarray, " n"]
    rms: float
    u_normal_rad: tuple[float, float]
    u_offset: float


def fit_line_orthogonal(points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"] | None = None) -> LineFit:
    """Fit a line to points in space by orthogonal least squares.

    Parameters
    ----------
    points : (n, 3)   mm
    weights : (n,)   of the squared distances, >= 0, relative to each other

    Raises
    ------
    GeometryError
        If there are fewer than two points, they coincide, or no single direction stands out.
    """
    centroid, singular, axes, total = _principal_axes(points, weights, 2, "line")
    if not singular[0] * (1 - 1e-9) > singular[1]:
        raise GeometryError(
            "The points spread equally in two directions, so no line fits them better than others. Use points along a line."
        )
    line = Line(centroid, axes[0])
    residuals = line.distance_to(points)
    dof = 2 * (_count(points, weights) - 2)
    sigma = float(np.hypot(singular[1], singular[2]) / np.sqrt(dof)) if dof > 0 else float("nan")
    return LineFit(line, residuals, _rms(residuals, weights), sigma / float(singular[0]), sigma / float(np.sqrt(total)))


def fit_line_2d(points: Float[np.ndarray, "n 2"], weights: Float[np.ndarray, " n"] | None = None) -> Line2DFit:
    """Fit a line to points of a plane by orthogonal least squares.

    Parameters
    ----------
    points : (n, 2)   any unit
    weights : (n,)   of the squared distances, >= 0, relative to each other

    Raises
    ------
    GeometryError
        If there are fewer than two points, they coincide, or no single direction stands out.
    """
    centroid, singular, axes, total = _principal_axes(points, weights, 2, "line")
    if not singular[0] * (1 - 1e-9) > singular[1]:
        raise GeometryError(
            "The points spread equally in all directions, so no line fits them better than others. Use points along a line."
        )
    direction = axes[0]
    residuals = (points - centroid) @ np.array([-direction[1], direction[0]])
    dof = _count(points, weights) - 2
    variance = float(singular[1] ** 2 / dof) if dof > 0 else float("nan")
    cov = variance * np.diag([1.0 / singular[0] ** 2, 1.0 / total])
    return Line2DFit(centroid, direction, residuals, _rms(residuals, weights), cov)


def fit_plane_orthogonal(points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"] | None = None) -> PlaneFit:
    """Fit a plane by orthogonal least squares.

    The normal's sign is chosen so that its largest component is positive.

    Parameters
    ----------
    points : (n, 3)   mm
    weights : (n,)   of the squared distances, >= 0, relative to each other

    Raises
    ------
    GeometryError
        If there are fewer than three points, or they lie on a line.
    """
    centroid, singular, axes, total = _principal_axes(points, weights, 3, "plane")
    if not singular[1] > DEGENERATE * singular[0] or not singular[1] * (1 - 1e-9) > singular[2]:
        raise GeometryError(
            f"The points lie on a line (extents {singular[0]:.3g} by {singular[1]:.3g} by {singular[2]:.3g}), so they do not "
            "determine a plane. Use points spread in two directions."
        )
    normal = axes[2] * (1.0 if axes[2][np.argmax(np.abs(axes[2]))] > 0 else -1.0)
    residuals = (points - centroid) @ normal
    dof = _count(points, weights) - 3
    sigma = float(singular[2] / np.sqrt(dof)) if dof > 0 else float("nan")
    return PlaneFit(
        Plane(normal, -float(normal @ centroid)),
        centroid,
        residuals,
        _rms(residuals, weights),
        (sigma / float(singular[1]), sigma / float(singular[0])),
        sigma / float(np.sqrt(total)),
    )


def _principal_axes(
    points: np.ndarray, weights: np.ndarray | None, n_needed: int, shape: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Weighted centroid, singular values of the centred points, their axes (rows), and the sum of the weights."""
    n = _count(points, weights)
    if n < n_needed:
        raise GeometryError(f"A {shape} needs at least {n_needed} points; there are {n}.")
    if not np.all(np.isfinite(points)):
        raise GeometryError(f"The points of a {shape} must be finite numbers; leave out the missing ones.")
    total = float(n) if weights is None else float(weights.sum())
    centroid = points.mean(axis=0) if weights is None else weights @ points / total
    centred = points - centroid
    # A second pass takes away what rounding left of a centroid far from the origin.
    shift = centred.mean(axis=0) if weights is None else weights @ centred / total
    centroid, centred = centroid + shift, centred - shift
    if weights is not None:
        centred = np.sqrt(weights)[:, None] * centred
    # The triangular factor has the singular values of the points and is small.
    triangle = triangular_factor(centred) if len(centred) > points.shape[1] else centred
    _, singular, axes = np.linalg.svd(triangle, full_matrices=True)
    singular = np.concatenate([singular, np.zeros(points.shape[1] - len(singular))])
    if not singular[0] > DEGENERATE * max(1e-300, float(np.abs(centroid).max())) * 1e-3:
        raise GeometryError(f"All points of the {shape} coincide near {np.round(centroid, 6).tolist()}; spread them.")
    return centroid, singular, axes, total


def _count(points: np.ndarray, weights: np.ndarray | None) -> int:
    return len(points) if weights is None else int(np.count_nonzero(weights))


def _rms(residuals: np.ndarray, weights: np.ndarray | None) -> float:
    if weights is None:
        return float(np.sqrt(np.mean(residuals**2)))
    return float(np.sqrt(weights @ residuals**2 / weights.sum()))
