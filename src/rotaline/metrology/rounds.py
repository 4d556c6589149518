"""Spheres and cylinders in a cloud.

RANSAC on the thinned cloud with normals, then orthogonal least squares on all points (Li et al. 2026, section 6.2). A
candidate counts only if its points fit it clearly better than the simpler surfaces that it could be mistaken for.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial import cKDTree

from rotaline.errors import GeometryError, MeasurementError
from rotaline.geometry.fitting import across
from rotaline.geometry.primitives import Cylinder, Sphere
from rotaline.geometry.robust import ransac_cylinder, ransac_sphere
from rotaline.metrology.model import FeatureMeasurement
from rotaline.metrology.plausibility import (
    MAX_NORMAL_RAD,
    agrees,
    describe_scene,
    edge_margin,
    search_band,
    what_it_is_rather,
)
from rotaline.metrology.responses import depend, linearise
from rotaline.metrology.scene import Scene
from rotaline.metrology.surface_fit import (
    Surface,
    SurfaceFit,
    fit_all_points,
    form_error,
    settle,
)
from rotaline.scanning.thinning import SearchCloud

MAX_CANDIDATES = 6
NOMINAL_RANGE = (0.7, 1.4)
"""Sizes around the nominal one that are tried first."""

SPHERE_DIAMETER = np.array([0.0, 0.0, 0.0, 2.0])
CYLINDER_DIAMETER = np.array([0.0, 0.0, 0.0, 0.0, 2.0])
"""Gradients by the parameters of the fits."""


def measure_sphere(scene: Scene, nominal: dict[str, float] | None) -> FeatureMeasurement:
    """Diameter of the sphere that most of the part's surface lies on.

    Raises
    ------
    MeasurementError
        If there is no sphere; the message says what was found instead.
    """
    return sphere_measurement(scene, _find(scene, "sphere", nominal))


def sphere_measurement(scene: Scene, surface_fit: SurfaceFit) -> FeatureMeasurement:
    """What a fitted sphere says."""
    sphere = surface_fit.surface
    assert isinstance(sphere, Sphere)
    owed = depend(scene, (linearise(scene, surface_fit),), {"diameter": (SPHERE_DIAMETER,)})
    outward = (scene.points[surface_fit.used] - sphere.centre) / sphere.radius
    coverage = sphere_coverage(outward)
    warnings = _judge("sphere", surface_fit, 2 * sphere.radius, owed.u_scatter["diameter"])
    if coverage < 0.15:
        warnings.append(
            f"The points cover only {100 * coverage:.0f} % of the sphere; the diameter leans on the calibration. "
            "Scan more of it."
        )
    geometry: dict[str, float | list[float]] = {"centre": sphere.centre.tolist(), "radius": sphere.radius}
    return FeatureMeasurement(
        "sphere",
        {"diameter": 2 * sphere.radius},
        owed.u_scatter,
        len(surface_fit.used),
        surface_fit.rms,
        form_error(surface_fit.residuals),
        scene.indices[surface_fit.used],
        surface_fit.residuals,
        geometry,
        coverage,
        tuple(warnings),
        owed.responses,
        owed.normals,
        owed.u_scatter,
    )


def measure_cylinder(scene: Scene, nominal: dict[str, float] | None) -> FeatureMeasurement:
    """Diameter of the cylinder that most of the part's surface lies on.

    Raises
    ------
    MeasurementError
        If there is no cylinder; the message says what was found instead.
    """
    return cylinder_measurement(scene, _find(scene, "cylinder", nominal))


def fit_cylinder_side(scene: Scene, start: Cylinder, support: SearchCloud, band: float) -> SurfaceFit:
    """Fit the side of a cylinder to all points, with a margin that suits its size."""
    along = (support.points - start.axis.point) @ start.axis.direction
    length = float(np.subtract(*np.quantile(along, [0.98, 0.02])))
    return fit_all_points(scene, start, support, band, edge_margin(scene, min(2 * start.radius, 4 * length)))


def cylinder_measurement(scene: Scene, surface_fit: SurfaceFit) -> FeatureMeasurement:
    """What a fitted side says about the cylinder."""
    cylinder = surface_fit.surface
    assert isinstance(cylinder, Cylinder)
    points = scene.points[surface_fit.used]
    owed = depend(scene, (linearise(scene, surface_fit),), {"diameter": (CYLINDER_DIAMETER,)})
    coverage = turn_coverage(cylinder, points)
    along = (points - cylinder.axis.point) @ cylinder.axis.direction
    low, high = (float(value) for value in np.quantile(along, [0.005, 0.995]))
    warnings = _judge("cylinder", surface_fit, 2 * cylinder.radius, owed.u_scatter["diameter"])
    if coverage < 0.35:
        warnings.append(
            f"The points cover only {360 * coverage:.0f} deg of the turn; the diameter leans on the calibration. "
            "Scan over a larger part of the turn."
        )
    if high - low < 0.2 * cylinder.radius:
        warnings.append(
            f"The points cover only {high - low:.2g} mm along the axis; its direction, and with it the diameter, is weak. "
            "Scan more of the length."
        )
    direction = cylinder.axis.direction * (1.0 if cylinder.axis.direction[2] >= 0 else -1.0)
    geometry: dict[str, float | list[float]] = {
        "axis_point": cylinder.axis.point.tolist(),
        "axis_direction": direction.tolist(),
        "radius": cylinder.radius,
        "length_seen": high - low,
    }
    return FeatureMeasurement(
        "cylinder",
        {"diameter": 2 * cylinder.radius},
        owed.u_scatter,
        len(surface_fit.used),
        surface_fit.rms,
        form_error(surface_fit.residuals),
        scene.indices[surface_fit.used],
        surface_fit.residuals,
        geometry,
        coverage,
        tuple(warnings),
        owed.responses,
        owed.normals,
        owed.u_scatter,
    )


def search_cylinder(
    scene: Scene,
    cloud: SearchCloud,
    radius_range: tuple[float, float],
    direction: Float[np.ndarray, "3"] | None = None,
) -> tuple[Cylinder, np.ndarray]:
    """The cylinder that most of a thinned cloud lies on, and which points these are.

    Raises
    ------
    GeometryError
        If there is none.
    """
    if direction is not None:
        return _settled_cylinder(scene, cloud, radius_range, direction)
    # Most cylinders stand upright on the table. That guess needs no normals, which are poor where frames are few.
    upright = np.array([0.0, 0.0, 1.0]) if scene.table is None else scene.table.normal
    found = []
    for guess in (None, upright):
        try:
            found.append(_settled_cylinder(scene, cloud, radius_range, guess))
        except GeometryError as error:
            failure = error
    if not found:
        raise failure
    return max(found, key=lambda candidate: np.count_nonzero(candidate[1]))


def _settled_cylinder(
    scene: Scene,
    cloud: SearchCloud,
    radius_range: tuple[float, float],
    direction: Float[np.ndarray, "3"] | None,
) -> tuple[Cylinder, np.ndarray]:
    """The best sample, fitted again to the points that agree with it until their number no longer grows."""
    n_min = max(30, len(cloud.points) // 50)
    band = search_band(scene)
    cylinder, on = ransac_cylinder(
        cloud.points, cloud.normals, band, scene.rng(), MAX_NORMAL_RAD, radius_range, direction, n_min
    )
    for _ in range(6):
        settled, _ = settle(cylinder, cloud.points[on], 2 * band)
        assert isinstance(settled, Cylinder)
        again = agrees(settled, cloud, band)
        # A fit to points of a plane runs off to any radius.
        ran_off = not 0.8 * radius_range[0] <= settled.radius <= 1.25 * radius_range[1]
        if ran_off or np.count_nonzero(again) < np.count_nonzero(on):
            break
        cylinder, on = settled, again
    return cylinder, on


def sphere_coverage(outward: Float[np.ndarray, "n 3"]) -> float:
    """Fraction of a sphere that lies within 8 deg of one of these directions."""
    n = 600
    k = np.arange(n) + 0.5
    polar, turn = np.arccos(1 - 2 * k / n), np.pi * (1 + np.sqrt(5)) * k
    lattice = np.column_stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)])
    some = outward[:: max(1, len(outward) // 20_000)]
    gap, _ = cKDTree(some).query(lattice)
    return float(np.mean(gap < np.deg2rad(8.0)))


def turn_coverage(cylinder: Cylinder, points: Float[np.ndarray, "n 3"]) -> float:
    """Fraction of the turn about a cylinder's axis that the points cover.

    Gaps up to 15 deg do not count, nor, with few frames a turn, those that are usual between the stripes.
    """
    e1, e2 = across(cylinder.axis.direction)
    relative = points - cylinder.axis.point
    angle = np.sort(np.arctan2(relative @ e2, relative @ e1))
    gaps = np.diff(np.append(angle, angle[0] + 2 * np.pi))
    between_stripes = gaps[gaps > np.deg2rad(2.0)]
    usual = float(np.median(between_stripes)) if len(between_stripes) >= 6 else 0.0
    tolerated = max(np.deg2rad(15.0), min(2.0 * usual, np.deg2rad(60.0)))
    return float(1.0 - np.sum(gaps[gaps > tolerated]) / (2 * np.pi))


def _find(scene: Scene, kind: str, nominal: dict[str, float] | None) -> SurfaceFit:
    """The final fit of the best candidate that stands the tests; first near the nominal size, then of any size."""
    ranges = [(0.01 * scene.extent, 1.5 * scene.extent)]
    if nominal is not None and "diameter" in nominal:
        radius = nominal["diameter"] / 2
        ranges.insert(0, (NOMINAL_RANGE[0] * radius, NOMINAL_RANGE[1] * radius))
    reasons = []
    for radius_range in ranges:
        cloud = scene.part
        for _ in range(MAX_CANDIDATES):
            try:
                start, on = _search(scene, cloud, kind, radius_range)
            except GeometryError:
                break
            try:
                found = _fit_all(scene, start, cloud.select(on))
                reason = what_it_is_rather(scene, found)
            except (GeometryError, MeasurementError) as error:
                reason = str(error)
            if not reason:
                return found
            reasons.append(reason)
            cloud = cloud.select(~on)
    raise MeasurementError(
        " ".join(
            [
                f"No {kind} in the cloud.",
                *reasons[:1],
                describe_scene(scene),
                "Name the region of the feature if it is there.",
            ]
        )
    )


def _search(
    scene: Scene, cloud: SearchCloud, kind: str, radius_range: tuple[float, float]
) -> tuple[Surface, np.ndarray]:
    """Rough surface and its thinned points."""
    if kind == "cylinder":
        return search_cylinder(scene, cloud, radius_range)
    band = search_band(scene)
    n_min = max(30, len(scene.part.points) // 50)
    sphere, on = ransac_sphere(cloud.points, band, scene.rng(), cloud.normals, MAX_NORMAL_RAD, radius_range, n_min)
    settled, _ = settle(sphere, cloud.points[on], 2 * band)
    again = agrees(settled, cloud, band)
    return (settled, again) if np.count_nonzero(again) >= np.count_nonzero(on) else (sphere, on)


def _fit_all(scene: Scene, start: Surface, support: SearchCloud) -> SurfaceFit:
    if isinstance(start, Cylinder):
        return fit_cylinder_side(scene, start, support, search_band(scene))
    assert isinstance(start, Sphere)
    return fit_all_points(scene, start, support, search_band(scene), edge_margin(scene, 2 * start.radius))


def _judge(kind: str, found: SurfaceFit, size: float, u_size: float) -> list[str]:
    """Warnings that hold for all round features."""
    warnings = []
    if found.rms > 0.01 * size:
        warnings.append(
            f"The points scatter {found.rms:.3g} mm about the {kind} of {size:.4g} mm: it may not be one, or the scan is poor. "
            "Look at the residuals."
        )
    if u_size > 0.005 * size:
        warnings.append(
            f"The points determine the diameter to {u_size:.2g} mm only (standard uncertainty). Scan more of the {kind}."
        )
    return warnings
