"""A cloud made ready for the search: cropped, thinned evenly, with local normals, the table top found and set aside.

The search works on the thinned points, where areas count; the final fits come back to all points.

References
----------
.. [1] Breunig, Kriegel, Ng and Sander, LOF: identifying density-based local outliers, SIGMOD 2000
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from rotaline.errors import GeometryError, MeasurementError
from rotaline.geometry.fitting import fit_plane_orthogonal
from rotaline.geometry.primitives import Plane
from rotaline.geometry.robust import mad_scale, ransac_plane
from rotaline.metrology.model import Region
from rotaline.metrology.options import MeasureOptions
from rotaline.scanning.thinning import SearchCloud, extent_of, thin

MAX_RAW = 300_000
"""Points beyond this number do not take part in the search."""

FOG = 0.25
"""Thickness of a thinned cloud from which on it is no surface."""

STRAY = 2.5
FAR_STRAY = 12.0
"""A point is a stray if its neighbours are this many times farther than theirs, or than is usual in the cloud."""

TABLE_TILT_RAD = np.deg2rad(10.0)


@dataclass(frozen=True, eq=False)
class Scene:
    """A cloud with its table top.

    Attributes
    ----------
    points : (n, 3)   all finite points of the region, mm
    viewpoints : (n, 3) or None   where each was seen from
    frame : (n,) or None   index of the frame of each
    indices : (n,)   their places in the cloud that was given
    part : the thinned points that do not belong to the table
    table : the table top, normal up; None if none was found
    table_cloud : its thinned points (none without a table)
    extent : size of the part (without its outermost points), mm
    gap : distance of neighbouring points along the stripe, mm (the cell size, if the cloud is not in the order of the scan)
    """

    points: Float[np.ndarray, "n 3"]
    viewpoints: Float[np.ndarray, "n 3"] | None
    frame: Int[np.ndarray, " n"] | None
    indices: Int[np.ndarray, " n"]
    part: SearchCloud
    table: Plane | None
    table_cloud: SearchCloud
    extent: float
    gap: float
    options: MeasureOptions

    def rng(self) -> np.random.Generator:
        """Random numbers for one search."""
        return np.random.default_rng(self.options.seed)


def build_scene(
    points: Float[np.ndarray, "n 3"],
    viewpoints: Float[np.ndarray, "n 3"] | None,
    frame: Int[np.ndarray, " n"] | None,
    region: Region | None,
    options: MeasureOptions,
) -> Scene:
    """Crop, thin, find the table.

    Raises
    ------
    MeasurementError
        If the region holds too few points.
    """
    keep = np.all(np.isfinite(points), axis=1)
    n_finite = int(np.count_nonzero(keep))
    if region is not None:
        keep &= _inside(points, region)
    indices = np.flatnonzero(keep)
    if len(indices) < options.min_points:
        where = "" if region is None else f" in the region ({describe_region(region)})"
        raise MeasurementError(
            f"Only {len(indices)} points{where} of {n_finite} in the cloud; at least {options.min_points} are needed. "
            + ("Scan the part again." if region is None else "Enlarge the region.")
        )
    inside = points[indices]
    rng = np.random.default_rng(options.seed)
    raw = inside if len(inside) <= MAX_RAW else inside[rng.choice(len(inside), MAX_RAW, replace=False)]
    raw = raw[_in_company(raw)]
    whole = thin(raw, options.n_search)
    table, on_table = _find_table(whole, rng)
    eyes = None if viewpoints is None else viewpoints[indices]
    frames = None if frame is None else frame[indices]
    if table is None:
        part, table_cloud = whole, whole.select(on_table)
    else:
        distance = table.signed_distance_to(raw)
        scale = mad_scale(table.signed_distance_to(whole.points[on_table]))
        above = distance > max(6.0 * scale, 1e-3 * extent_of(whole.points))
        table_cloud = whole.select(on_table)
        standing = thin(raw[above], options.n_search) if np.count_nonzero(above) >= options.min_points else None
        if standing is not None and standing.thickness < FOG:
            part = standing
        else:
            # Nothing stands on it, or only strays float above: then it is the part.
            part, table, table_cloud = whole, None, whole.select(np.zeros(len(whole.points), dtype=bool))
    gap = min(float(np.median(np.linalg.norm(np.diff(inside, axis=0), axis=1))), part.spacing)
    return Scene(inside, eyes, frames, indices, part, table, table_cloud, extent_of(part.points), gap, options)


def describe_region(region: Region) -> str:
    """The limits of a region in words."""
    names = ("x", "y", "z", "radius")
    limits = (region.x, region.y, region.z, region.radius)
    said = [
        f"{name} {limit[0]:g} to {limit[1]:g} mm"
        for name, limit in zip(names, limits, strict=True)
        if limit is not None
    ]
    return ", ".join(said) if said else "no limits"


def _reach(points: np.ndarray, middle: np.ndarray, share: float = 0.98) -> float:
    """Distance from a vertical line that a share of the points keeps within, mm."""
    return float(np.quantile(np.hypot(*(points - middle)[:, :2].T), share)) if len(points) else 0.0


def _in_company(points: np.ndarray) -> np.ndarray:
    """Which points have neighbours as near as their neighbours have: all but strays (local outlier factor [1]_)."""
    far, near = cKDTree(points, balanced_tree=False).query(points, k=min(9, len(points)))
    reach = far[:, -1]
    usual = np.median(reach[near[:, 1:]], axis=1)
    return (reach <= STRAY * usual) & (reach <= FAR_STRAY * float(np.median(reach)))


def _inside(points: np.ndarray, region: Region) -> np.ndarray:
    values = (points[:, 0], points[:, 1], points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    limits = (region.x, region.y, region.z, region.radius)
    keep = np.ones(len(points), dtype=bool)
    for value, limit in zip(values, limits, strict=True):
        if limit is not None:
            with np.errstate(invalid="ignore"):
                keep &= (value >= limit[0]) & (value <= limit[1])
    return keep


def _find_table(cloud: SearchCloud, rng: np.random.Generator) -> tuple[Plane | None, np.ndarray]:
    """The table top: the lowest large plane at right angles to z, with hardly anything below it."""
    none = (None, np.zeros(len(cloud.points), dtype=bool))
    level = np.abs(cloud.normals[:, 2]) > np.cos(TABLE_TILT_RAD)
    size = extent_of(cloud.points)
    threshold = min(max(4.0 * cloud.roughness, 0.002 * size), 0.01 * size)
    best: tuple[float, Plane, np.ndarray] | None = None
    remaining = level.copy()
    for _ in range(4):
        chosen = np.flatnonzero(remaining)
        if len(chosen) < max(20, 0.05 * len(cloud.points)):
            break
        try:
            plane, inliers = ransac_plane(
                cloud.points[chosen], threshold, rng, cloud.normals[chosen], 2 * TABLE_TILT_RAD
            )
            for _ in range(3):
                fit = fit_plane_orthogonal(cloud.points[chosen[inliers]])
                plane = fit.plane if fit.plane.normal[2] > 0 else fit.plane.flipped()
                inliers = np.abs(plane.signed_distance_to(cloud.points[chosen])) < threshold
        except GeometryError:
            break
        remaining[chosen[inliers]] = False
        height = plane.signed_distance_to(cloud.points)
        above, below = cloud.points[height > 2 * threshold], np.count_nonzero(height < -2 * threshold)
        enough = np.count_nonzero(inliers) >= max(20, 0.05 * len(cloud.points))
        if not enough or plane.normal[2] < np.cos(TABLE_TILT_RAD) or below > 0.3 * len(cloud.points):
            continue
        # A scan puts z = 0 on the table; then its rim may show below it. It reaches farther than what stands on it.
        at_zero = abs(plane.offset) < max(threshold, 0.5)
        if at_zero and _reach(cloud.points[chosen[inliers]], fit.centroid) > _reach(above, fit.centroid, 0.9):
            return plane, (np.abs(height) < threshold) & level
        middle = float(fit.centroid[2])
        if below < 0.05 * len(cloud.points) and (best is None or middle < best[0]):
            best = (middle, plane, np.abs(height) < threshold)
    return none if best is None else (best[1], best[2] & level)
