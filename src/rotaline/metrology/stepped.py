"""The stepped cylinder: two coaxial diameters, and the heights of its upper and lower part.

The sides give the diameters. The top disc, the ring of the step and the table around the part, fitted as parallel planes,
give the heights; a level that was not seen leaves its height out.
"""

import numpy as np

from rotaline.errors import GeometryError, MeasurementError
from rotaline.geometry.primitives import Cylinder, Line, Plane
from rotaline.metrology.model import FeatureMeasurement
from rotaline.metrology.planes import fit_parallel
from rotaline.metrology.plausibility import describe_scene, edge_margin, search_band, what_it_is_rather
from rotaline.metrology.responses import depend, linearise, linearise_parallel
from rotaline.metrology.rounds import (
    CYLINDER_DIAMETER,
    MAX_CANDIDATES,
    cylinder_measurement,
    fit_cylinder_side,
    search_cylinder,
)
from rotaline.metrology.scene import Scene
from rotaline.metrology.surface_fit import SurfaceFit, fit_all_points, form_error
from rotaline.scanning.thinning import SearchCloud

LEVEL_RAD = np.deg2rad(20.0)
NOMINAL_RANGE = (0.85, 1.15)


def measure_stepped_cylinder(scene: Scene, nominal: dict[str, float] | None) -> FeatureMeasurement:
    """Diameters and heights of a small cylinder that stands on a large one.

    Raises
    ------
    MeasurementError
        If there are no two coaxial cylinders; the message says what was found instead.
    """
    small, large = _find_sides(scene, nominal)
    sides = (small, large)
    parts = [cylinder_measurement(scene, side) for side in sides]
    value = {f"diameter_{name}": part.value["diameter"] for name, part in zip(("small", "large"), parts, strict=True)}
    fits = [linearise(scene, side) for side in sides]
    gradients: dict[str, tuple[np.ndarray | None, ...]] = {
        "diameter_small": (CYLINDER_DIAMETER, None),
        "diameter_large": (None, CYLINDER_DIAMETER),
    }
    warnings = [
        f"{name}: {text}"
        for name, part in zip(("Small cylinder", "Large cylinder"), parts, strict=True)
        for text in part.warnings
    ]
    levels = _find_levels(scene, small, large)
    residuals = [side.residuals for side in sides]
    geometry: dict[str, float | list[float]] = {
        f"{key}_{name}": number
        for name, part in zip(("small", "large"), parts, strict=True)
        for key, number in part.geometry.items()
    }
    if levels:
        gradients = {key: (*by_fit, None) for key, by_fit in gradients.items()}
        joint = fit_parallel(scene, tuple(levels.values()))
        place = {name: i for i, name in enumerate(levels)}
        for name, upper, lower in (("small", "top", "step"), ("large", "step", "table")):
            if upper in place and lower in place:
                a, b = place[upper], place[lower]
                value[f"height_{name}"] = joint.offsets[a] - joint.offsets[b]
                gradients[f"height_{name}"] = (None, None, joint.height_gradient(a, b))
        geometry["level_normal"] = joint.normal.tolist()
        fits.append(linearise_parallel(scene, tuple(levels.values()), joint.normal))
        residuals += list(joint.residuals)
    seen_as = {"top": "the top disc", "step": "the ring of the step", "table": "the table around the part"}
    missing = [words for name, words in seen_as.items() if name not in levels]
    if missing:
        warnings.append(
            f"Too few points on {' and '.join(missing)}: heights that need them are left out. "
            "Raise the camera or move the part so that they are seen."
        )
    all_residuals = np.concatenate(residuals)
    owed = depend(scene, tuple(fits), gradients)
    return FeatureMeasurement(
        "stepped-cylinder",
        value,
        owed.u_scatter,
        len(all_residuals),
        float(np.sqrt(np.mean(all_residuals**2))),
        form_error(all_residuals),
        scene.indices[owed.used],
        all_residuals,
        geometry,
        min(part.coverage for part in parts),
        tuple(warnings),
        owed.responses,
        owed.normals,
        owed.u_scatter,
    )


def _find_sides(scene: Scene, nominal: dict[str, float] | None) -> tuple[SurfaceFit, SurfaceFit]:
    """The fitted sides of the small and of the large cylinder."""
    wanted: dict[str, float] = {} if nominal is None else nominal
    first: tuple[SurfaceFit, SearchCloud] | None = None
    for name in ("diameter_large", "diameter_small"):
        if name in wanted and first is None:
            first = _find_side(scene, scene.part, tuple(f * wanted[name] / 2 for f in NOMINAL_RANGE), None)
    if first is None:
        first = _find_side(scene, scene.part, (0.01 * scene.extent, scene.extent), None)
    if first is None:
        raise MeasurementError(
            f"No cylinder in the cloud, so no stepped cylinder. {describe_scene(scene)} Name its region if it is there."
        )
    found, cloud = first
    assert isinstance(found.surface, Cylinder)
    radius = found.surface.radius
    ranges = [
        tuple(f * wanted[name] / 2 for f in NOMINAL_RANGE)
        for name in ("diameter_small", "diameter_large")
        if name in wanted
    ]
    for low, high in [*ranges, (0.1 * radius, 0.97 * radius), (1.03 * radius, 10.0 * radius)]:
        if low < radius < high:
            continue
        second = _find_side(scene, cloud, (low, high), found.surface)
        if second is not None:
            both = sorted((found, second[0]), key=lambda side: _radius(side))
            return both[0], both[1]
    raise MeasurementError(
        f"No stepped cylinder in the cloud: it has a cylinder of {2 * radius:.4g} mm diameter, but no second one about the "
        f"same axis. {describe_scene(scene)} Measure it as a cylinder, or name the region of the part."
    )


def _find_side(
    scene: Scene, cloud: SearchCloud, radius_range: tuple[float, ...], coaxial: Cylinder | None
) -> tuple[SurfaceFit, SearchCloud] | None:
    """One side fitted to all points, and the thinned cloud without it; about the axis of ``coaxial`` if that is given."""
    direction = None if coaxial is None else coaxial.axis.direction
    if direction is not None:
        cloud = cloud.select(np.abs(cloud.normals @ direction) < np.sin(LEVEL_RAD))
    for _ in range(MAX_CANDIDATES):
        try:
            start, on = search_cylinder(scene, cloud, (radius_range[0], radius_range[1]), direction)
        except GeometryError:
            return None
        if coaxial is None or _offset(coaxial, start) < 0.1 * max(coaxial.radius, start.radius):
            try:
                side = fit_cylinder_side(scene, start, cloud.select(on), search_band(scene))
            except (GeometryError, MeasurementError):
                side = None
            if side is not None and not what_it_is_rather(scene, side):
                return side, cloud.select(~on)
        cloud = cloud.select(~on)
    return None


def _find_levels(scene: Scene, small: SurfaceFit, large: SurfaceFit) -> dict[str, SurfaceFit]:
    """Top disc, ring of the step and table, as far as they were seen."""
    axis, r1, r2 = _common_axis(small, large), _radius(small), _radius(large)
    band, ring = search_band(scene), r2 - r1
    margin = min(edge_margin(scene, 2 * r1), 0.2 * ring)
    if scene.options.edge_margin_mm is not None:
        margin = scene.options.edge_margin_mm
    rho_all = axis.distance_to(scene.points)
    along_small = (scene.points[small.used] - axis.point) @ axis.direction
    middle_small = float(np.median(along_small))
    middle_large = float(np.median((scene.points[large.used] - axis.point) @ axis.direction))
    table = scene.part if scene.table is None else scene.table_cloud
    zones = {
        "top": (scene.part, 0.0, r1 - margin, middle_small, np.inf),
        "step": (scene.part, r1 + margin, r2 - margin, middle_large, middle_small),
        "table": (table, r2 + margin, 2.5 * r2 + 5.0, -np.inf, middle_large),
    }
    levels = {}
    for name, (cloud, inner, outer, lowest, highest) in zones.items():
        rho, along = axis.distance_to(cloud.points), (cloud.points - axis.point) @ axis.direction
        level = np.abs(cloud.normals @ axis.direction) > np.cos(LEVEL_RAD)
        chosen = np.flatnonzero(level & (rho >= inner) & (rho <= outer) & (along > lowest) & (along < highest))
        if len(chosen) < 10:
            continue
        height = _densest(along[chosen], 2 * band)
        chosen = chosen[np.abs(along[chosen] - height) <= 2 * band]
        keep = np.zeros(len(cloud.points), dtype=bool)
        keep[chosen] = True
        start = Plane(axis.direction, -float(axis.direction @ (axis.point + height * axis.direction)))
        inside = (rho_all >= inner) & (rho_all <= outer)
        try:
            levels[name] = fit_all_points(scene, start, cloud.select(keep), 2 * band, margin, inside)
        except (GeometryError, MeasurementError):
            continue
    return levels


def _common_axis(small: SurfaceFit, large: SurfaceFit) -> Line:
    """The axis of the side that is seen over the greater length, pointing from the large to the small cylinder."""
    assert isinstance(small.surface, Cylinder)
    assert isinstance(large.surface, Cylinder)
    axis = min((small, large), key=lambda side: float(np.trace(side.fit.cov[2:4, 2:4]))).surface.axis  # type: ignore[union-attr]
    upward = small.surface.axis.point - large.surface.axis.point
    return axis if upward @ axis.direction >= 0 else Line(axis.point, -axis.direction)


def _densest(values: np.ndarray, width: float) -> float:
    """Middle of the window of a width that holds the most values."""
    ordered = np.sort(values)
    counts = np.searchsorted(ordered, ordered + width, side="right") - np.arange(len(ordered))
    first = int(np.argmax(counts))
    return float(np.median(ordered[first : first + counts[first]]))


def _offset(a: Cylinder, b: Cylinder) -> float:
    """Distance of the middle of one cylinder from the axis of the other, mm."""
    return float(a.axis.distance_to(b.axis.point[None])[0])


def _radius(side: SurfaceFit) -> float:
    assert isinstance(side.surface, Cylinder)
    return side.surface.radius
