"""Planes in a cloud, and the step between two of them.

Planes are taken one after another from the thinned cloud by RANSAC with normals; the fits use all points. The height of a
step is measured along the common normal of both levels, fitted to both at once, so that a small level does not tilt it.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rotaline.errors import GeometryError, MeasurementError
from rotaline.geometry.fitting import PlaneFit, across
from rotaline.geometry.least_squares import triangular_factor
from rotaline.geometry.primitives import Plane
from rotaline.geometry.robust import ransac_plane
from rotaline.metrology.model import FeatureMeasurement
from rotaline.metrology.plausibility import describe_scene, edge_margin, only_touches
from rotaline.metrology.responses import depend, linearise_parallel
from rotaline.metrology.scene import Scene
from rotaline.metrology.surface_fit import SurfaceFit, fit_all_points, form_error, settle
from rotaline.scanning.thinning import SearchCloud

MAX_PLANES = 12
PARALLEL_RAD = np.deg2rad(4.0)
MAX_NORMAL_RAD = np.deg2rad(20.0)
LEVEL_RAD = np.deg2rad(30.0)
"""Planes whose normals are nearer to z than this face up."""


@dataclass(frozen=True, eq=False)
class PlanePatch:
    """A plane found in the thinned cloud: normal towards the outside, its points, and whether it is the table top."""

    plane: Plane
    support: SearchCloud
    is_table: bool = False

    @property
    def area(self) -> float:
        """Rough area, mm^2: one cell a point."""
        return len(self.support.points) * self.support.spacing**2

    @property
    def width(self) -> float:
        """Extent in the narrower direction, mm."""
        centred = self.support.points - self.support.points.mean(axis=0)
        _, _, axes = np.linalg.svd(centred, full_matrices=False)
        return float(np.subtract(*np.quantile(centred @ axes[1], [0.95, 0.05])))


def plane_band(scene: Scene) -> float:
    """Distance within which a thinned point counts as lying on a plane, mm."""
    return min(max(4.0 * scene.part.roughness, 0.001 * scene.extent), 0.01 * scene.extent)


def segment_planes(scene: Scene) -> tuple[PlanePatch, ...]:
    """The planes of the part, largest first; the table is not among them."""
    cloud, band, rng = scene.part, plane_band(scene), scene.rng()
    n_min = max(25, len(cloud.points) // 150)
    patches = []
    for _ in range(MAX_PLANES):
        if len(cloud.points) < n_min:
            break
        try:
            plane, on = ransac_plane(cloud.points, band, rng, cloud.normals, MAX_NORMAL_RAD, n_min)
            settled, sigma = settle(plane, cloud.points[on], 2 * band)
        except GeometryError:
            break
        assert isinstance(settled, Plane)
        facing = np.abs(cloud.normals @ settled.normal) >= np.cos(MAX_NORMAL_RAD)
        on = facing & (np.abs(settled.signed_distance_to(cloud.points)) <= 1.5 * band)
        if np.count_nonzero(on) < n_min:
            break
        patch = PlanePatch(_face_outward(scene, settled, cloud.points[on]), cloud.select(on))
        # A single stripe lies on many planes.
        if patch.width > 2 * cloud.spacing and not only_touches(settled, max(sigma, 0.1 * band), scene.part):
            patches.append(patch)
        cloud = cloud.select(~on)
    return tuple(sorted(patches, key=lambda patch: -len(patch.support.points)))


def table_patch(scene: Scene) -> PlanePatch | None:
    """The table top as a plane like others."""
    return None if scene.table is None else PlanePatch(scene.table, scene.table_cloud, is_table=True)


def fit_patch(scene: Scene, patch: PlanePatch) -> SurfaceFit:
    """Fit a plane to all points of a patch, away from its edges.

    Raises
    ------
    MeasurementError
        If too few points remain.
    """
    try:
        return fit_all_points(
            scene, patch.plane, patch.support, 2 * plane_band(scene), edge_margin(scene, max(patch.width, 1e-6))
        )
    except GeometryError as error:
        raise MeasurementError(f"A plane was found, but cannot be fitted: {error}") from error


def measure_plane(scene: Scene, nominal: dict[str, float] | None) -> FeatureMeasurement:
    """Flatness of the largest plane that is not the table top.

    Raises
    ------
    MeasurementError
        If there is no plane.
    """
    del nominal
    patches = segment_planes(scene)
    warnings = []
    table = table_patch(scene)
    if patches:
        patch = patches[0]
    elif table is not None:
        patch = table
        warnings.append(
            "The only plane is the lowest one, which looks like the table top. Name the region of the plane if it is another."
        )
    else:
        raise MeasurementError(f"No plane in the cloud. {describe_scene(scene)}")
    found = fit_patch(scene, patch)
    plane, fit = found.surface, found.fit
    assert isinstance(plane, Plane)
    assert isinstance(fit, PlaneFit)
    flatness = form_error(found.residuals)
    # Standard uncertainty of the 0.5 % and 99.5 % quantiles of a normal distribution: 4.9 sigma / sqrt(n) each.
    u_flatness = found.inflation * 6.9 * found.rms / float(np.sqrt(len(found.used)))
    return FeatureMeasurement(
        "plane",
        {"flatness": flatness},
        {"flatness": u_flatness},
        len(found.used),
        found.rms,
        flatness,
        scene.indices[found.used],
        found.residuals,
        {"normal": plane.normal.tolist(), "offset": plane.offset, "centroid": fit.centroid.tolist()},
        1.0,
        tuple(warnings),
        u_scatter={"flatness": u_flatness},
    )


def measure_step(scene: Scene, nominal: dict[str, float] | None) -> FeatureMeasurement:
    """Height between two parallel planes that face the same side.

    The two largest levels of the part count; if it has only one, its height above the table top. Levels that face sideways
    count only where none face up: name a region without these to measure them.

    Raises
    ------
    MeasurementError
        If there are no two such planes; the message says what was found instead.
    """
    upper, lower, n_levels = _choose_levels(scene, nominal)
    fits = (fit_patch(scene, upper), fit_patch(scene, lower))
    joint = fit_parallel(scene, fits)
    high, low = joint.offsets
    height = high - low
    owed = depend(scene, (linearise_parallel(scene, fits, joint.normal),), {"height": (joint.height_gradient(0, 1),)})
    warnings = []
    if n_levels > 2 and nominal is None:
        warnings.append(
            f"The part has {n_levels} parallel levels; the height is that between the two largest. "
            "Name a region or the nominal height for another."
        )
    normals = [fit.surface.normal for fit in fits if isinstance(fit.surface, Plane)]
    tilt = float(np.arccos(np.clip(normals[0] @ normals[1], -1.0, 1.0)))
    if tilt > np.deg2rad(0.5):
        warnings.append(
            f"The two levels are {np.rad2deg(tilt):.2f} deg from parallel; the height is that between their middles. "
            "Look at the residuals."
        )
    used = np.concatenate([fit.used for fit in fits])
    residuals = np.concatenate(joint.residuals)
    return FeatureMeasurement(
        "step",
        {"height": height},
        owed.u_scatter,
        len(used),
        float(np.sqrt(np.mean(residuals**2))),
        form_error(residuals),
        scene.indices[used],
        residuals,
        {
            "normal": joint.normal.tolist(),
            "upper_centroid": joint.centroids[0].tolist(),
            "lower_centroid": joint.centroids[1].tolist(),
            "lower_is_table": float(lower.is_table),
        },
        1.0,
        tuple(warnings),
        owed.responses,
        owed.normals,
        owed.u_scatter,
    )


@dataclass(frozen=True, eq=False)
class ParallelFit:
    """Parallel planes fitted together.

    Attributes
    ----------
    normal : (3,)   common normal
    centroids : one (3,) each, mm
    offsets : positions along the normal, mm
    residuals : (n_i,) each, signed distances of the points, mm
    """

    normal: Float[np.ndarray, "3"]
    centroids: tuple[Float[np.ndarray, "3"], ...]
    offsets: tuple[float, ...]
    residuals: tuple[Float[np.ndarray, " _"], ...]

    def height_gradient(self, a: int, b: int) -> Float[np.ndarray, " p"]:
        """Gradient of ``offsets[a] - offsets[b]`` by the parameters of ``linearise_parallel``."""
        lever = self.centroids[a] - self.centroids[b]
        gradient = np.zeros(len(self.offsets) + 2)
        gradient[a], gradient[b] = 1.0, -1.0
        gradient[-2:] = [lever @ e for e in across(self.normal)]
        return gradient


def fit_parallel(scene: Scene, fits: tuple[SurfaceFit, ...]) -> ParallelFit:
    """Fit planes of one direction to the points of several surfaces: one centroid each, one normal by singular values."""
    groups = [scene.points[fit.used] for fit in fits]
    centroids = [points.mean(axis=0) for points in groups]
    triangle = triangular_factor(np.vstack([p - c for p, c in zip(groups, centroids, strict=True)]))
    axes = np.linalg.svd(triangle)[2]
    first = fits[0].surface
    assert isinstance(first, Plane)
    normal = axes[2] * (1.0 if axes[2] @ first.normal > 0 else -1.0)
    return ParallelFit(
        normal,
        tuple(centroids),
        tuple(float(normal @ c) for c in centroids),
        tuple((p - c) @ normal for p, c in zip(groups, centroids, strict=True)),
    )


def are_parallel(a: PlanePatch, b: PlanePatch) -> bool:
    """Whether two planes are parallel and face the same side."""
    return bool(a.plane.normal @ b.plane.normal > np.cos(PARALLEL_RAD))


def _choose_levels(scene: Scene, nominal: dict[str, float] | None) -> tuple[PlanePatch, PlanePatch, int]:
    """Upper and lower level, and how many levels the part has in all."""
    patches = list(segment_planes(scene))
    table = table_patch(scene)
    pairs = []
    for i, a in enumerate(patches):
        for b in patches[i + 1 :] + ([table] if table is not None else []):
            if are_parallel(a, b):
                distance = float(np.mean(a.plane.signed_distance_to(b.support.points)))
                pairs.append((a, b, -distance) if distance < 0 else (b, a, distance))
    pairs = [pair for pair in pairs if pair[2] > 2 * plane_band(scene) or pair[1].is_table]
    if not pairs:
        n_planes = len(patches) + (table is not None)
        raise MeasurementError(
            f"No step in the cloud: it has {n_planes} planes, but no two of them are parallel, at different heights and face "
            f"the same side. {describe_scene(scene)} Name the region of the step if it is there."
        )
    if nominal is not None and "height" in nominal:
        upper, lower, _ = min(pairs, key=lambda pair: abs(pair[2] - nominal["height"]))
    else:
        level = [pair for pair in pairs if pair[0].plane.normal[2] > np.cos(LEVEL_RAD)]
        on_part = [pair for pair in level if not pair[1].is_table]
        upper, lower, _ = max(on_part or level or pairs, key=lambda pair: min(pair[0].area, pair[1].area))
    n_levels = 1 + sum(1 for patch in patches if patch is not upper and are_parallel(upper, patch))
    return upper, lower, n_levels


def _face_outward(scene: Scene, plane: Plane, support: np.ndarray) -> Plane:
    """Turn the normal to the side from which the plane was seen, or, if that is not known, up or away from the part."""
    if scene.viewpoints is not None:
        near = np.flatnonzero(np.abs(plane.signed_distance_to(scene.points)) <= plane_band(scene))
        near = near[:: max(1, len(near) // 2000)]
        outward = float(np.median(plane.signed_distance_to(scene.viewpoints[near]))) if len(near) else 0.0
    elif abs(plane.normal[2]) > 0.5:
        outward = float(plane.normal[2])
    else:
        outward = float((support.mean(axis=0) - scene.part.points.mean(axis=0)) @ plane.normal)
    return plane if outward >= 0 else plane.flipped()
