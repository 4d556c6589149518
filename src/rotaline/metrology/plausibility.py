"""What tells a feature that is there from one that only seems to be, and the tolerances of the search."""

import numpy as np

from rotaline.errors import GeometryError
from rotaline.geometry.fitting import fit_plane_orthogonal, fit_sphere_orthogonal
from rotaline.geometry.primitives import Cylinder, Line, Plane, Sphere
from rotaline.geometry.robust import ransac_plane
from rotaline.metrology.scene import Scene
from rotaline.metrology.surface_fit import Surface, SurfaceFit, fit_surface, signed_distance
from rotaline.scanning.thinning import SearchCloud

MAX_NORMAL_RAD = np.deg2rad(30.0)
"""Largest angle between the normal of a thinned point and that of the surface it counts for."""

MAX_RMS = 0.03
"""Largest rms, as a fraction of the diameter, unless the whole scan is as rough."""

TOUCH_RATIO = 1.25
TOUCH_RAD = np.deg2rad(3.0)


def what_it_is_rather(scene: Scene, found: SurfaceFit) -> str:
    """Why a sphere or cylinder is not what it was taken for; empty if it is."""
    assert isinstance(found.surface, Sphere | Cylinder)
    points = scene.points[found.used]
    some = points[:: max(1, len(points) // 1500)]
    rms = float(np.sqrt(np.mean(signed_distance(found.surface, some) ** 2)))
    rivals = {"plane": fit_plane_orthogonal(some).rms}
    if isinstance(found.surface, Sphere):
        rivals["cylinder"] = _best_cylinder_rms(found.surface, some[:: max(1, len(some) // 400)])
    else:
        rivals["sphere"] = _sphere_rms(some[:: max(1, len(some) // 400)])
    limits = {"plane": 1.5, "cylinder": 0.8, "sphere": 0.7}
    said = f"A candidate of {2 * found.surface.radius:.4g} mm diameter has {len(points)} points with an rms of {rms:.3g} mm, "
    for name, rival in rivals.items():
        if rival <= limits[name] * rms:
            return said + f"but a {name} fits them with {rival:.3g} mm."
    if rms > max(MAX_RMS * 2 * found.surface.radius, 3.0 * scene.part.roughness):
        return said + "too much for its size."
    if only_touches(found.surface, found.rms, scene.part):
        return said + "but the surface beside them leaves it smoothly: it only touches the part."
    return ""


def only_touches(surface: Surface, rms: float, cloud: SearchCloud) -> bool:
    """Whether a surface only touches the part instead of being part of it.

    A true surface ends at an edge, where the normals turn. Where one only touches, more and more points lie beside it at a
    growing distance, and the normals of those on it do not fit either.
    """
    on = agrees(surface, cloud, 3.5 * rms)
    beside = agrees(surface, cloud, 10.0 * rms)
    if not on.any():
        return True
    turned = float(np.median(_normal_angles(surface, cloud.select(on))))
    return bool(np.count_nonzero(beside) > TOUCH_RATIO * np.count_nonzero(on) and turned > TOUCH_RAD)


def agrees(surface: Surface, cloud: SearchCloud, band: float) -> np.ndarray:
    """Points of the thinned cloud near a surface whose normals fit it."""
    return (_normal_angles(surface, cloud) <= MAX_NORMAL_RAD) & (np.abs(signed_distance(surface, cloud.points)) <= band)


def describe_scene(scene: Scene) -> str:
    """What the cloud holds, in words."""
    low, high = np.quantile(scene.part.points, [0.01, 0.99], axis=0)
    size = " x ".join(f"{value:.1f}" for value in high - low)
    if scene.table is None:
        said = f"Found: {len(scene.points)} points over {size} mm, without a table top."
    else:
        height = -scene.table.offset / scene.table.normal[2]
        said = f"Found: a table top at z = {height:.2f} mm, and on it something of {size} mm."
    try:
        _, flat = ransac_plane(scene.part.points, search_band(scene), scene.rng(), scene.part.normals)
    except GeometryError:
        return said
    return f"{said} Its largest plane holds {100 * np.mean(flat):.0f} % of its surface."


def search_band(scene: Scene) -> float:
    """Distance within which a thinned point counts as lying on a surface, mm."""
    return min(max(4.0 * scene.part.roughness, 0.002 * scene.extent), 0.02 * scene.extent)


def edge_margin(scene: Scene, size: float) -> float:
    """Width along edges that is left out, mm."""
    if scene.options.edge_margin_mm is not None:
        return scene.options.edge_margin_mm
    return min(max(0.02 * size, 0.4, 3.0 * scene.gap), 0.1 * size)


def _normal_angles(surface: Surface, cloud: SearchCloud) -> np.ndarray:
    """Angle between each normal of the thinned cloud and that of a surface, rad."""
    if isinstance(surface, Plane):
        cosine = np.abs(cloud.normals @ surface.normal)
    else:
        foot = surface.axis.closest_to(cloud.points) if isinstance(surface, Cylinder) else surface.centre
        outward = cloud.points - foot
        length = np.maximum(np.linalg.norm(outward, axis=1), 1e-300)
        cosine = np.abs(np.einsum("ij,ij->i", outward, cloud.normals)) / length
    return np.arccos(np.clip(cosine, 0.0, 1.0))


def _sphere_rms(points: np.ndarray) -> float:
    try:
        return fit_sphere_orthogonal(points).rms
    except GeometryError:
        return float(np.inf)


def _best_cylinder_rms(sphere: Sphere, points: np.ndarray) -> float:
    """How well a cylinder of the sphere's size fits its points, whatever its direction."""
    _, _, axes = np.linalg.svd(points - sphere.centre, full_matrices=False)
    best = np.inf
    for direction in axes:
        try:
            surface, _ = fit_surface(Cylinder(Line(sphere.centre, direction), sphere.radius), points)
        except GeometryError:
            continue
        best = min(best, float(np.sqrt(np.mean(signed_distance(surface, points) ** 2))))
    return best
