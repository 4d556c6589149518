"""Robust estimation: scales and weights, and random sampling of lines, planes, spheres and cylinders.

Every sampled model is scored by the residuals of that very model (``sampling``).
All functions take a ``numpy.random.Generator`` and give the same answer for the same seed.

References
----------
.. [1] Schnabel, Wahl and Klein, Efficient RANSAC for point-cloud shape detection, Computer Graphics Forum 26 (2007) 214
.. [2] Rousseeuw and Leroy, Robust Regression and Outlier Detection, 1987
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from rotaline.errors import GeometryError
from rotaline.geometry.fitting import Line2DFit, PlaneFit, across, fit_line_2d, fit_plane_orthogonal
from rotaline.geometry.primitives import Cylinder, Line, Plane, Sphere
from rotaline.geometry.sampling import (
    BLOCK,
    MAX_HYPOTHESES,
    index_tuples,
    require_points,
    sample_consensus,
    some_indices,
)

CAUCHY = 2.3849
"""Tuning constant of the Cauchy weights: 95 % efficiency under Gaussian noise."""


@dataclass(frozen=True, eq=False)
class RobustPlaneFit:
    """A plane fitted to the points that lie within ``threshold`` (mm) of it; ``fit.residuals`` are those of the inliers."""

    fit: PlaneFit
    inliers: Bool[np.ndarray, " n"]
    threshold: float

    @property
    def plane(self) -> Plane:
        """The fitted plane."""
        return self.fit.plane


def mad_scale(residuals: Float[np.ndarray, " n"]) -> float:
    """Standard deviation of Gaussian residuals from their median absolute deviation from the median.

    Examples
    --------
    >>> import numpy as np
    >>> mad_scale(np.array([-1.0, 0.0, 1.0, 100.0]))
    1.4826
    """
    if len(residuals) == 0:
        raise GeometryError("A scale needs at least one residual; there are none.")
    return 1.4826 * float(np.median(np.abs(residuals - np.median(residuals))))


def cauchy_weights(residuals: Float[np.ndarray, " n"], scale: float) -> Float[np.ndarray, " n"]:
    """Weights ``1 / (1 + (r / (2.385 scale))^2)`` of the squared residuals; ``scale`` as from ``mad_scale``."""
    with np.errstate(over="ignore"):
        return 1.0 / (1.0 + (residuals / (CAUCHY * max(scale, 1e-300))) ** 2)


def fit_plane_robust(
    points: Float[np.ndarray, "n 3"], threshold: float | None = None, rng: np.random.Generator | None = None
) -> RobustPlaneFit:
    """Fit a plane to points of which up to half are outliers.

    A plane is found by sampling (the least median of squares if no threshold is given), then fitted orthogonally to the
    points within the threshold until these stay the same.

    Parameters
    ----------
    points : (n, 3)   mm
    threshold : largest distance of an inlier, mm; None: three times the robust standard deviation of the residuals
    rng : for the samples; None: a fixed seed

    Raises
    ------
    GeometryError
        If fewer than three points lie on one plane, or those that do lie on a line.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    require_points(points, 3, "plane")
    if threshold is None:
        scored = some_indices(len(points), rng)
        planes = _planes_through(points[index_tuples(len(points), 3, 500, rng)])
        distances = np.abs(_plane_residuals(planes, points[scored]))
        medians = np.median(np.where(np.isfinite(distances), distances, np.inf), axis=1)
        best = planes[int(np.argmin(medians))]
        plane = Plane(best[:3], float(best[3]))
    else:
        plane, _ = ransac_plane(points, threshold, rng)
    inliers = np.zeros(len(points), dtype=bool)
    least = 1e-12 * float(np.abs(points).max())
    limit = 0.0 if threshold is None else threshold
    for _ in range(30):
        distances = np.abs(plane.signed_distance_to(points))
        if threshold is None:
            # First the scale of all, then of those near the plane: the median of all is too wide when many are outliers.
            kept = distances[distances <= max(4.45 * float(np.median(distances)), least)]
            limit = max(4.45 * float(np.median(kept)), least)
        now = distances <= limit
        if np.count_nonzero(now) < 3:
            raise GeometryError(
                f"Only {np.count_nonzero(now)} of {len(points)} points lie within {limit:.3g} mm of one plane; three are "
                "needed. Allow a larger threshold, or choose points that lie on a plane."
            )
        same = bool(np.array_equal(now, inliers))
        inliers = now
        fit = fit_plane_orthogonal(points[inliers])
        plane = fit.plane
        if same:
            break
    return RobustPlaneFit(fit, inliers, limit)


def ransac_line_2d(
    points: Float[np.ndarray, "n 2"], threshold: float, rng: np.random.Generator, n_min: int = 2
) -> tuple[Line2DFit, Bool[np.ndarray, " n"]]:
    """Find the line that most points of a plane lie on, fitted orthogonally to its inliers.

    Parameters
    ----------
    points : (n, 2)   any unit
    threshold : largest distance of an inlier
    rng : for the samples
    n_min : fewest inliers that count as a line

    Raises
    ------
    GeometryError
        If no line has that many inliers.
    """
    require_points(points, 2, "line")

    def propose(samples: np.ndarray) -> np.ndarray:
        a, b = points[samples[:, 0]], points[samples[:, 1]]
        normal = np.stack([a[:, 1] - b[:, 1], b[:, 0] - a[:, 0]], axis=1)
        normal = _unit_rows(normal)
        return np.column_stack([normal, -np.einsum("ij,ij->i", normal, a)])

    def score(models: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        return np.abs(models[:, :2] @ points[chosen].T + models[:, 2:3])

    _, inliers = sample_consensus(len(points), 2, threshold, rng, propose, score, n_min, "line")
    fit = fit_line_2d(points[inliers])
    refined = np.abs(fit.signed_distance_to(points)) <= threshold
    if np.count_nonzero(refined) >= np.count_nonzero(inliers):
        inliers = refined
        fit = fit_line_2d(points[inliers])
    return fit, inliers


def ransac_plane(
    points: Float[np.ndarray, "n 3"],
    threshold: float,
    rng: np.random.Generator,
    normals: Float[np.ndarray, "n 3"] | None = None,
    max_angle_rad: float = np.deg2rad(25.0),
    n_min: int = 3,
) -> tuple[Plane, Bool[np.ndarray, " n"]]:
    """Find the plane that most points lie on.

    Parameters
    ----------
    points : (n, 3)   mm
    threshold : largest distance of an inlier, mm
    rng : for the samples
    normals : (n, 3)   unit normals of either sign; if given, an inlier's normal must agree with the plane's
    max_angle_rad : largest angle between the two
    n_min : fewest inliers that count as a plane

    Raises
    ------
    GeometryError
        If no plane has that many inliers.
    """
    require_points(points, 3, "plane")

    cosine = np.cos(max_angle_rad)

    def propose(samples: np.ndarray) -> np.ndarray:
        planes = _planes_through(points[samples])
        if normals is not None:
            # A plane whose own three points do not face its way is not worth scoring.
            agreement = np.abs(np.einsum("mk,mjk->mj", planes[:, :3], normals[samples]))
            planes = planes[np.all(agreement >= cosine, axis=1)]
        return planes

    def score(models: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        residuals = np.abs(_plane_residuals(models, points[chosen]))
        if normals is not None:
            residuals[np.abs(models[:, :3] @ normals[chosen].T) < cosine] = np.inf
        return residuals

    block, most = (BLOCK, MAX_HYPOTHESES) if normals is None else (8 * BLOCK, 4 * MAX_HYPOTHESES)
    model, inliers = sample_consensus(len(points), 3, threshold, rng, propose, score, n_min, "plane", block, most)
    return Plane(model[:3], float(model[3])), inliers


def ransac_sphere(
    points: Float[np.ndarray, "n 3"],
    threshold: float,
    rng: np.random.Generator,
    normals: Float[np.ndarray, "n 3"] | None = None,
    max_angle_rad: float = np.deg2rad(25.0),
    radius_range: tuple[float, float] = (0.0, np.inf),
    n_min: int = 4,
) -> tuple[Sphere, Bool[np.ndarray, " n"]]:
    """Find the sphere that most points lie on.

    With normals, two points make a sphere (the normals meet at its centre) [1]_; without, four.

    Parameters
    ----------
    points : (n, 3)   mm
    threshold : largest distance of an inlier, mm
    rng : for the samples
    normals : (n, 3)   unit normals of either sign; an inlier's must point along the radius
    max_angle_rad : largest angle between the two
    radius_range : smallest and largest radius, mm
    n_min : fewest inliers that count as a sphere

    Raises
    ------
    GeometryError
        If no sphere has that many inliers.
    """
    require_points(points, 4, "sphere")

    def propose(samples: np.ndarray) -> np.ndarray:
        if normals is None:
            corners = points[samples]
            rows = 2 * (corners[:, 1:] - corners[:, :1])
            squares = np.einsum("ijk,ijk->ij", corners, corners)
            centres = _solve_rows(rows, squares[:, 1:] - squares[:, :1])
            radii = np.linalg.norm(corners[:, 0] - centres, axis=1)
        else:
            centres, radii = _meet(points[samples], normals[samples])
        radii = np.where((radii >= radius_range[0]) & (radii <= radius_range[1]), radii, np.nan)
        return np.column_stack([centres, radii])

    def score(models: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        outward = points[chosen][None] - models[:, None, :3]
        distance = np.linalg.norm(outward, axis=2)
        residuals = np.abs(distance - models[:, 3:4])
        if normals is not None:
            agreement = np.abs(np.einsum("mnk,nk->mn", outward, normals[chosen]))
            residuals[agreement < np.cos(max_angle_rad) * distance] = np.inf
        return residuals

    n_sample = 4 if normals is None else 2
    model, inliers = sample_consensus(len(points), n_sample, threshold, rng, propose, score, n_min, "sphere")
    return Sphere(model[:3], float(model[3])), inliers


def ransac_cylinder(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    threshold: float,
    rng: np.random.Generator,
    max_angle_rad: float = np.deg2rad(25.0),
    radius_range: tuple[float, float] = (0.0, np.inf),
    direction: Float[np.ndarray, "3"] | None = None,
    n_min: int = 5,
) -> tuple[Cylinder, Bool[np.ndarray, " n"]]:
    """Find the cylinder that most points lie on.

    Two points with normals make a cylinder: its axis is at right angles to both normals, and they meet on it [1]_. Where the
    direction is known, three points make one, without their normals.

    Parameters
    ----------
    points : (n, 3)   mm
    normals : (n, 3)   unit normals of either sign
    threshold : largest distance of an inlier, mm
    rng : for the samples
    max_angle_rad : largest angle between an inlier's normal and the radius
    radius_range : smallest and largest radius, mm
    direction : (3,)   of the axis, if it is known
    n_min : fewest inliers that count as a cylinder

    Raises
    ------
    GeometryError
        If no cylinder has that many inliers.
    """
    require_points(points, 5, "cylinder")

    def through_three(samples: np.ndarray) -> np.ndarray:
        assert direction is not None
        e1, e2 = across(direction)
        p = np.stack([points[samples] @ e1, points[samples] @ e2], axis=2)
        a, b = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
        twice_area = 2.0 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
        a2, b2 = np.sum(a**2, axis=1), np.sum(b**2, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            x = (b[:, 1] * a2 - a[:, 1] * b2) / twice_area
            y = (a[:, 0] * b2 - b[:, 0] * a2) / twice_area
        radii = np.hypot(x, y)
        radii = np.where((radii >= radius_range[0]) & (radii <= radius_range[1]), radii, np.nan)
        centres = np.outer(p[:, 0, 0] + x, e1) + np.outer(p[:, 0, 1] + y, e2)
        return np.column_stack([centres, np.broadcast_to(direction, centres.shape), radii])

    def propose(samples: np.ndarray) -> np.ndarray:
        p, n = points[samples], normals[samples]
        axes = np.cross(n[:, 0], n[:, 1])
        axes[np.linalg.norm(axes, axis=1) < np.sin(np.deg2rad(5.0))] = np.nan
        axes = _unit_rows(axes)
        flat_p = p - np.einsum("ijk,ik->ij", p, axes)[..., None] * axes[:, None]
        flat_n = n - np.einsum("ijk,ik->ij", n, axes)[..., None] * axes[:, None]
        lengths = np.linalg.norm(flat_n, axis=2, keepdims=True)
        with np.errstate(invalid="ignore", divide="ignore"):
            centres, radii = _meet(flat_p, np.where(lengths > 0.5, flat_n / lengths, np.nan))
        radii = np.where((radii >= radius_range[0]) & (radii <= radius_range[1]), radii, np.nan)
        return np.column_stack([centres, axes, radii])

    def score(models: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        outward = points[chosen][None] - models[:, None, :3]
        axes = models[:, 3:6]
        outward -= np.einsum("mnk,mk->mn", outward, axes)[..., None] * axes[:, None]
        distance = np.linalg.norm(outward, axis=2)
        residuals = np.abs(distance - models[:, 6:7])
        agreement = np.abs(np.einsum("mnk,nk->mn", outward, normals[chosen]))
        residuals[agreement < np.cos(max_angle_rad) * distance] = np.inf
        return residuals

    n_sample, maker = (2, propose) if direction is None else (3, through_three)
    model, inliers = sample_consensus(len(points), n_sample, threshold, rng, maker, score, n_min, "cylinder")
    return Cylinder(Line(model[:3], model[3:6]), float(model[6])), inliers


def _unit_rows(vectors: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(lengths > 0, vectors / lengths, np.nan)


def _planes_through(corners: np.ndarray) -> np.ndarray:
    """Planes (normal, offset) through triples of points (m, 3, 3); NaN where a triple lies on a line."""
    normal = _unit_rows(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    return np.column_stack([normal, -np.einsum("ij,ij->i", normal, corners[:, 0])])


def _plane_residuals(planes: np.ndarray, points: np.ndarray) -> np.ndarray:
    return planes[:, :3] @ points.T + planes[:, 3:4]


def _solve_rows(rows: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve many 3 x 3 systems; NaN where a matrix is singular."""
    determinant = np.linalg.det(rows)
    size = np.prod(np.linalg.norm(rows, axis=2), axis=1)
    regular = np.abs(determinant) > 1e-9 * size
    solution = np.full((len(rows), 3), np.nan)
    solution[regular] = np.linalg.solve(rows[regular], right[regular][..., None])[..., 0]
    return solution


def _meet(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the normals of two points come nearest to each other (m, 3), and the mean distance of the points from there.

    NaN where the normals are parallel, or where the distances differ so much that both points cannot be on one round surface.
    """
    p1, p2 = points[:, 0], points[:, 1]
    n1, n2 = normals[:, 0], normals[:, 1]
    gap = p2 - p1
    cos = np.einsum("ij,ij->i", n1, n2)
    along1, along2 = np.einsum("ij,ij->i", gap, n1), np.einsum("ij,ij->i", gap, n2)
    with np.errstate(invalid="ignore", divide="ignore"):
        sine_squared = np.where(1 - cos**2 > 1e-3, 1 - cos**2, np.nan)
        s1 = (along1 - cos * along2) / sine_squared
        s2 = (cos * along1 - along2) / sine_squared
        centres = ((p1 + s1[:, None] * n1) + (p2 + s2[:, None] * n2)) / 2
        r1, r2 = np.linalg.norm(p1 - centres, axis=1), np.linalg.norm(p2 - centres, axis=1)
        unequal = np.abs(r1 - r2) > 0.3 * (r1 + r2)
    radii = np.where(unequal, np.nan, (r1 + r2) / 2)
    return centres, radii
