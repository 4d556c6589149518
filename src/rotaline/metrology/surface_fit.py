"""The final fit of one surface: which points belong to it, and the orthogonal fit to all of these.

A rough surface comes in from the search. The points near it are fitted with Cauchy weights until the scatter settles;
points next to an adjacent surface are left out, because stripes are bent, half lit and blurred at edges; what remains is
fitted by least squares without the points beyond a few standard deviations.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from rotaline.errors import GeometryError, MeasurementError
from rotaline.geometry.fitting import (
    CylinderFit,
    PlaneFit,
    SphereFit,
    fit_cylinder_orthogonal,
    fit_plane_orthogonal,
    fit_sphere_orthogonal,
)
from rotaline.geometry.primitives import Cylinder, Plane, Sphere
from rotaline.geometry.robust import cauchy_weights
from rotaline.metrology.scene import Scene
from rotaline.scanning.thinning import SearchCloud, cell_keys, sum_around

Surface = Plane | Sphere | Cylinder

SETTLE_POINTS = 20_000
FOREIGN_SIGMAS = 8.0
FOREIGN_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class SurfaceFit:
    """A surface fitted to points of a scene.

    Attributes
    ----------
    surface : Plane, Sphere or Cylinder
    fit : the orthogonal fit behind it, with its covariance (residuals of the points of ``used``)
    used : (m,)   indices into ``scene.points``
    residuals : (m,)   signed distances, mm
    rms : mm
    inflation : by how much standard uncertainties grow because neighbouring residuals are alike, >= 1
    """

    surface: Surface
    fit: PlaneFit | SphereFit | CylinderFit
    used: Int[np.ndarray, " m"]
    residuals: Float[np.ndarray, " m"]
    rms: float
    inflation: float


def signed_distance(surface: Surface, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Distance of points from a surface, positive outside (plane: on the side of the normal), mm."""
    if isinstance(surface, Plane):
        return surface.signed_distance_to(points)
    if isinstance(surface, Sphere):
        return np.linalg.norm(points - surface.centre, axis=1) - surface.radius
    return surface.axis.distance_to(points) - surface.radius


def fit_surface(
    surface: Surface, points: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"] | None = None
) -> tuple[Surface, PlaneFit | SphereFit | CylinderFit]:
    """Orthogonal fit of a surface of the same kind, starting from it; a plane keeps the side of its normal."""
    if isinstance(surface, Plane):
        plane = fit_plane_orthogonal(points, weights)
        turned = plane.plane.normal @ surface.normal < 0
        return (plane.plane.flipped() if turned else plane.plane), plane
    if isinstance(surface, Sphere):
        sphere = fit_sphere_orthogonal(points, weights, surface)
        return sphere.sphere, sphere
    cylinder = fit_cylinder_orthogonal(points, surface, weights)
    return cylinder.cylinder, cylinder


def settle(
    surface: Surface, points: Float[np.ndarray, "n 3"], band: float, n_rounds: int = 12
) -> tuple[Surface, float]:
    """Robust fit to the points within a band that shrinks to the scatter: the surface and the standard deviation.

    Raises
    ------
    GeometryError
        If too few points remain, or they do not determine the surface.
    """
    sigma = np.inf
    size = float(np.abs(points - points.mean(axis=0)).max())
    for _ in range(n_rounds):
        residuals = signed_distance(surface, points)
        near = np.abs(residuals) <= band
        if np.count_nonzero(near) < 10:
            raise GeometryError("Too few points lie near the surface.")
        now = max(1.4826 * float(np.median(np.abs(residuals[near]))), 1e-9 * size)
        surface, _ = fit_surface(surface, points[near], cauchy_weights(residuals[near], now))
        if abs(now - sigma) < 1e-3 * now:
            break
        sigma = now
        band = min(band, max(6.0 * now, 0.25 * band))
    return surface, float(min(sigma, now))


def fit_all_points(
    scene: Scene,
    start: Surface,
    support: SearchCloud,
    band: float,
    margin: float,
    inside: Bool[np.ndarray, " n"] | None = None,
) -> SurfaceFit:
    """Fit a surface to all points of the scene that belong to it.

    Parameters
    ----------
    scene : Scene
    start : from the search
    support : thinned points that the search found on it; points far from all of these do not belong to it
    band : how far the start may be off, mm
    margin : points nearer to an adjacent surface than about this are left out, mm
    inside : (n,)   points of the scene that may belong to it; None: all

    Raises
    ------
    MeasurementError
        If too few points remain.
    GeometryError
        If they do not determine the surface.
    """
    options = scene.options
    candidates = np.abs(signed_distance(start, scene.points)) <= 2.0 * band
    if inside is not None:
        candidates &= inside
    chosen = np.flatnonzero(candidates)
    gap, _ = cKDTree(support.points).query(scene.points[chosen], distance_upper_bound=3.0 * support.spacing)
    chosen = chosen[np.isfinite(gap)]
    _enough(len(chosen), options.min_points)
    some = chosen
    if len(chosen) > SETTLE_POINTS:
        some = scene.rng().choice(chosen, SETTLE_POINTS, replace=False)
    surface, sigma = settle(start, scene.points[some], band)

    all_residuals = signed_distance(surface, scene.points)
    own = np.zeros(len(scene.points), dtype=bool)
    own[chosen] = True
    own &= np.abs(all_residuals) <= FOREIGN_SIGMAS * sigma
    foreign = np.abs(all_residuals) > FOREIGN_SIGMAS * sigma
    # Points of a steep neighbour count as foreign only from this distance on, and noise carries them as far sideways.
    margin += FOREIGN_SIGMAS * sigma
    for _ in range(4):
        clear = own & ~_near_foreign(scene.points, own, foreign, margin)
        if np.count_nonzero(clear) >= max(options.min_points, 0.4 * np.count_nonzero(own)):
            break
        margin /= 2.0
    else:
        clear = own
    used = np.flatnonzero(clear)
    kept = used
    for _ in range(10):
        _enough(len(kept), options.min_points)
        surface, fit = fit_surface(surface, scene.points[kept])
        residuals = signed_distance(surface, scene.points[used])
        # The standard deviation of those kept, not of the middle ones: where the scan is precise in one place and poor in
        # another, the poor points are no outliers.
        scale = max(float(np.sqrt(np.mean(signed_distance(surface, scene.points[kept]) ** 2))), 1e-9 * scene.extent)
        now = used[np.abs(residuals) <= options.trim * scale]
        if len(now) == len(kept):
            break
        kept = now
    surface, fit = fit_surface(surface, scene.points[kept])
    residuals = signed_distance(surface, scene.points[kept])
    rms = float(np.sqrt(np.mean(residuals**2)))
    return SurfaceFit(surface, fit, kept, residuals, rms, correlation_inflation(scene.points[kept], residuals))


def correlation_inflation(points: Float[np.ndarray, "n 3"], residuals: Float[np.ndarray, " n"]) -> float:
    """How much larger standard uncertainties are than independent residuals would make them, >= 1.

    The mean residual of a patch of m independent points has the variance sigma^2 / m. Where neighbours share their errors
    (speckle, form error, frames that are off) the means scatter more, and so does the fit.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    cell = float(np.linalg.norm(high - low)) / 12.0
    variance = float(np.mean(residuals**2))
    if not cell > 0 or not variance > 0:
        return 1.0
    _, patch = np.unique(cell_keys(points, low, cell), return_inverse=True)
    counts = np.bincount(patch)
    sums = np.bincount(patch, weights=residuals)
    filled = counts >= 5
    if np.count_nonzero(filled) < 8:
        return 1.0
    ratio = float(np.mean(sums[filled] ** 2 / counts[filled])) / variance
    return float(np.sqrt(max(1.0, ratio)))


def form_error(residuals: Float[np.ndarray, " n"]) -> float:
    """Range of the residuals without the outermost 0.5 % on either side, mm."""
    low, high = np.quantile(residuals, [0.005, 0.995])
    return float(high - low)


def _near_foreign(points: np.ndarray, own: np.ndarray, foreign: np.ndarray, margin: float) -> np.ndarray:
    """Own points in whose neighbourhood of about the margin more than a tenth as many foreign points lie."""
    near = np.zeros(len(points), dtype=bool)
    if not margin > 0 or not foreign.any():
        return near
    keys = cell_keys(points, points[own].min(axis=0), margin / 1.5)
    own_cells, place, own_counts = np.unique(keys[own], return_inverse=True, return_counts=True)
    foreign_cells, foreign_counts = np.unique(keys[foreign], return_counts=True)
    ours = sum_around(own_cells, own_cells, own_counts)
    theirs = sum_around(own_cells, foreign_cells, foreign_counts)
    near[np.flatnonzero(own)] = (theirs > FOREIGN_SHARE * ours)[place]
    return near


def _enough(n: int, n_needed: int) -> None:
    if n < n_needed:
        raise MeasurementError(
            f"Only {n} points lie on the surface away from its edges; at least {n_needed} are needed. "
            "Take more frames, or name the region of the feature."
        )
