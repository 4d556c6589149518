"""A groove in a block: depth and widths.

The top is a plane that lies on both sides of a lower, parallel plane, the bottom. The depth is the mean distance of the
bottom's points from the plane fitted to the top (Li et al. 2026, section 6.2). The flanks between them, where they were
seen, give the widths: the distances of the lines in which they meet the top and the bottom, in the middle of the length.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from rotaline.errors import GeometryError, MeasurementError
from rotaline.geometry.fitting import across
from rotaline.geometry.primitives import Plane, unit
from rotaline.geometry.robust import ransac_plane
from rotaline.metrology.model import FeatureMeasurement
from rotaline.metrology.planes import (
    PlanePatch,
    are_parallel,
    plane_band,
    segment_planes,
    table_patch,
)
from rotaline.metrology.plausibility import describe_scene, edge_margin
from rotaline.metrology.responses import depend, linearise
from rotaline.metrology.scene import Scene
from rotaline.metrology.surface_fit import SurfaceFit, fit_all_points, form_error
from rotaline.scanning.thinning import SearchCloud

MIN_SIDE = 0.03
"""Smallest share of the top plane that must lie on either side of the bottom."""


MAX_SKEW_RAD = np.deg2rad(30.0)
MIN_SLOPE_RAD = np.deg2rad(10.0)
"""A flank runs along the groove to within the first angle, and is steeper than the second."""

MIN_FLANK_POINTS = 20
"""Fewest points that make a flank: little of it is lit."""


@dataclass(frozen=True, eq=False)
class GrooveShape:
    """Top and bottom found in the thinned cloud, and the direction across the groove in the top's plane."""

    top: PlanePatch
    bottom: PlanePatch
    across: Float[np.ndarray, "3"]
    depth: float
    left_edge: float
    right_edge: float
    bottom_edges: tuple[float, float]
    side_width: float


@dataclass(frozen=True, eq=False)
class Section:
    """The cross-section in the middle of the length: the directions along and across the groove, and where flanks meet levels.

    ``corners`` has the keys ``top_left``, ``top_right``, ``bottom_left``, ``bottom_right``; mm.
    """

    along: Float[np.ndarray, "3"]
    sideways: Float[np.ndarray, "3"]
    corners: dict[str, Float[np.ndarray, "3"]]

    def widths(self) -> dict[str, float]:
        """Distances of the corners of each level across the groove, mm."""
        return {
            f"width_{level}": float((self.corners[f"{level}_right"] - self.corners[f"{level}_left"]) @ self.sideways)
            for level in ("top", "bottom")
        }


def measure_groove(scene: Scene, nominal: dict[str, float] | None) -> FeatureMeasurement:
    """Depth of a groove and its widths at the top and at the bottom.

    Raises
    ------
    MeasurementError
        If there is no plane with a lower parallel one between two parts of it; the message says what was found instead.
    """
    shape = _find_shape(scene, nominal)
    try:
        top = _fit(scene, shape.top, shape.side_width)
        bottom = _fit(scene, shape.bottom, shape.bottom_edges[1] - shape.bottom_edges[0])
    except GeometryError as error:
        raise MeasurementError(f"A groove was found, but its planes cannot be fitted: {error}") from error
    left, right = (_fit_flank(scene, shape, side, top.rms) for side in (-1.0, 1.0))
    return groove_measurement(scene, top, bottom, (left, right), shape.across)


def groove_measurement(
    scene: Scene,
    top: SurfaceFit,
    bottom: SurfaceFit,
    flanks: tuple[SurfaceFit | None, SurfaceFit | None],
    across_rough: Float[np.ndarray, "3"],
) -> FeatureMeasurement:
    """What fitted planes say about the groove; the flanks are the left and the right one in the sense of ``across_rough``."""
    top_plane, bottom_plane = top.surface, bottom.surface
    assert isinstance(top_plane, Plane)
    assert isinstance(bottom_plane, Plane)
    distances = -top_plane.signed_distance_to(scene.points[bottom.used])
    depth = float(distances.mean())
    middle = scene.points[bottom.used].mean(axis=0)
    # The depth is measured along the normal of the top.
    fitted = [
        linearise(scene, top),
        replace(linearise(scene, bottom), normals=np.tile(top_plane.normal, (len(distances), 1))),
    ]
    value, gradients = {"depth": depth}, {"depth": _depth_gradient(scene, top, middle)}
    residuals = [top.residuals, depth - distances]
    warnings = []
    geometry: dict[str, float | list[float]] = {
        "top_normal": top_plane.normal.tolist(),
        "top_offset": top_plane.offset,
        "bottom_centroid": middle.tolist(),
    }
    left, right = flanks
    if left is not None and right is not None:
        surfaces = (top, bottom, left, right)
        section = _section(_planes(surfaces), middle, across_rough)
        value |= section.widths()
        geometry["direction"] = section.along.tolist()
        geometry |= {f"corner_{name}": corner.tolist() for name, corner in section.corners.items()}
        gradients["depth"] += (None, None)
        gradients |= _width_gradients(scene, surfaces, middle, across_rough)
        fitted += [linearise(scene, left), linearise(scene, right)]
        residuals += [left.residuals, right.residuals]
    else:
        missing = [name for name, flank in zip(("one", "the other"), flanks, strict=True) if flank is None]
        warnings.append(
            f"The groove's flank was not seen on {' and '.join(missing)} side: the widths cannot be measured. "
            "Take frames over a full turn, or set the part so that the laser reaches the flanks."
        )
    owed = depend(scene, tuple(fitted), gradients)
    tilt = float(np.arccos(np.clip(top_plane.normal @ bottom_plane.normal, -1.0, 1.0)))
    if tilt > np.deg2rad(0.5):
        warnings.append(
            f"Top and bottom are {np.rad2deg(tilt):.2f} deg from parallel; the depth is the mean over the bottom. "
            "Look at the residuals."
        )
    if max(top.rms, bottom.rms) > 0.02 * depth:
        warnings.append(
            f"The points scatter {max(top.rms, bottom.rms):.3g} mm about the planes of a groove of {depth:.4g} mm depth. "
            "Look at the residuals."
        )
    all_residuals = np.concatenate(residuals)
    return FeatureMeasurement(
        "groove",
        value,
        owed.u_scatter,
        len(all_residuals),
        float(np.sqrt(np.mean(all_residuals**2))),
        form_error(all_residuals),
        scene.indices[owed.used],
        all_residuals,
        geometry,
        1.0,
        tuple(warnings),
        owed.responses,
        owed.normals,
        owed.u_scatter,
    )


def _find_shape(scene: Scene, nominal: dict[str, float] | None) -> GrooveShape:
    """The best pair of planes that makes a groove."""
    patches = segment_planes(scene)
    shapes: list[GrooveShape] = []
    table = table_patch(scene)
    # In a cloud without a table, the bottom itself may have been taken for one.
    for bottoms in (patches, () if table is None else (table,)):
        for top in patches:
            for bottom in bottoms:
                if top is bottom or (shapes and bottom.is_table) or not are_parallel(top, bottom):
                    continue
                depth = -float(np.median(top.plane.signed_distance_to(bottom.support.points)))
                if depth > 2 * plane_band(scene):
                    shape = _between(top, bottom, depth)
                    if shape is not None:
                        shapes.append(shape)
    if not shapes:
        levels = sum(are_parallel(a, b) for i, a in enumerate(patches) for b in patches[i + 1 :])
        hint = "Measure it as a step if only one side is there. " if levels else ""
        raise MeasurementError(
            f"No groove in the cloud: of its {len(patches)} planes, {levels} pairs are parallel, but none lies lower than "
            f"another and between two parts of it. {hint}{describe_scene(scene)} Name the region of the groove if it is there."
        )
    if nominal is not None and "depth" in nominal:
        return min(shapes, key=lambda shape: abs(shape.depth - nominal["depth"]))
    return max(shapes, key=lambda shape: min(shape.bottom.area, shape.top.area))


def _between(top: PlanePatch, bottom: PlanePatch, depth: float) -> GrooveShape | None:
    """The direction in the plane in which the bottom parts the top best; None if there is none."""
    e1, e2 = across(top.plane.normal)
    origin = bottom.support.points.mean(axis=0)
    top_2d = (top.support.points - origin) @ np.column_stack([e1, e2])
    bottom_2d = (bottom.support.points - origin) @ np.column_stack([e1, e2])
    best: tuple[float, np.ndarray, np.ndarray, tuple[float, float]] | None = None
    for angle in np.deg2rad(np.arange(0.0, 180.0, 2.0)):
        m = np.array([np.cos(angle), np.sin(angle)])
        places = top_2d @ m
        # The middle of the bottom, as wide as if it were evenly covered: strays in its plane do not count.
        inner = np.quantile(bottom_2d @ m, [0.1, 0.9])
        low, high = float(1.1 * inner[0] - 0.1 * inner[1]), float(1.1 * inner[1] - 0.1 * inner[0])
        is_left, is_right = places < low, places > high
        left, right = float(np.mean(is_left)), float(np.mean(is_right))
        if min(left, right) < MIN_SIDE or left + right < 0.9:
            continue
        # Strips lie farthest apart when they are seen along their length.
        gap = float(np.quantile(places[is_right], 0.05) - high + low - np.quantile(places[is_left], 0.95))
        if best is None or gap > best[0]:
            best = (gap, m, places, (low, high))
    if best is None:
        return None
    _, m, places, (low, high) = best
    left_places, right_places = places[places < low], places[places > high]
    widths = [float(np.subtract(*np.quantile(side, [0.95, 0.05]))) for side in (left_places, right_places)]
    return GrooveShape(
        top,
        bottom,
        m[0] * e1 + m[1] * e2,
        depth,
        float(np.quantile(left_places, 0.98)),
        float(np.quantile(right_places, 0.02)),
        (low, high),
        min(widths),
    )


def _fit(scene: Scene, patch: PlanePatch, width: float) -> SurfaceFit:
    margin = edge_margin(scene, max(width, 1e-6))
    return fit_all_points(scene, patch.plane, patch.support, 2 * plane_band(scene), margin)


def _fit_flank(scene: Scene, shape: GrooveShape, side: float, noise: float) -> SurfaceFit | None:
    """The flank on one side (-1 or +1 across the groove), or None if too little of it was seen.

    A flank may be shorter than the cells of the thinned cloud, so all points between the two levels are searched.
    """
    origin = shape.bottom.support.points.mean(axis=0)
    place = side * ((scene.points - origin) @ shape.across)
    height = -shape.top.plane.signed_distance_to(scene.points)
    inner = shape.bottom_edges[1] if side > 0 else -shape.bottom_edges[0]
    outer = shape.right_edge if side > 0 else -shape.left_edge
    margin = min(max(edge_margin(scene, 10.0 * shape.depth), 5.0 * noise), 0.3 * shape.depth)
    slack = 2.0 * scene.part.spacing
    within = (place > inner - max(slack, 0.3 * inner)) & (place < outer + slack)
    # The faces at the ends of the groove are not flanks.
    along = np.cross(shape.top.plane.normal, shape.across)
    ends = np.quantile((shape.top.support.points - origin) @ along, [0.01, 0.99])
    run = (scene.points - origin) @ along
    within &= (run > ends[0] + min(margin, 0.1 * float(np.ptp(ends)))) & (
        run < ends[1] - min(margin, 0.1 * float(np.ptp(ends)))
    )
    zone = np.flatnonzero(within & (height > margin) & (height < shape.depth - margin))
    band = max(6.0 * noise, 0.01 * shape.depth)
    few = replace(scene, options=replace(scene.options, min_points=MIN_FLANK_POINTS))
    for _ in range(3):
        if len(zone) < MIN_FLANK_POINTS:
            return None
        try:
            plane, on = ransac_plane(scene.points[zone], band, scene.rng(), n_min=MIN_FLANK_POINTS)
            if abs(plane.normal @ along) > np.sin(MAX_SKEW_RAD) or abs(plane.normal @ shape.across) < np.sin(
                MIN_SLOPE_RAD
            ):
                zone = zone[~on]
                continue
            facing = plane if side * (plane.normal @ shape.across) < 0 else plane.flipped()
            cloud = scene.points[zone[on]]
            support = SearchCloud(cloud, cloud, scene.part.spacing, 0.0, 0.0)
            flank = _fit_between(few, shape, facing, support, band, margin, within)
            assert isinstance(flank.surface, Plane)
            return _fit_between(few, shape, flank.surface, support, band, margin, within)
        except (GeometryError, MeasurementError):
            return None
    return None


def _fit_between(
    scene: Scene,
    shape: GrooveShape,
    plane: Plane,
    support: SearchCloud,
    band: float,
    margin: float,
    within: Bool[np.ndarray, " n"],
) -> SurfaceFit:
    """Fit a flank to the points whose feet on it lie between top and bottom.

    Cutting by the foot, not by the height: a cut through the noise of a slanted plane would tilt it.
    """
    top = shape.top.plane
    rise = float(np.linalg.norm(np.cross(top.normal, plane.normal)))
    foot = scene.points - plane.signed_distance_to(scene.points)[:, None] * plane.normal
    below_top = -top.signed_distance_to(foot) / rise
    length = shape.depth / rise
    margin = min(margin, 0.3 * length)
    inside = within & (below_top > margin) & (below_top < length - margin)
    return fit_all_points(scene, plane, support, band, 0.0, inside)


def _planes(surfaces: tuple[SurfaceFit, ...]) -> tuple[Plane, ...]:
    return tuple(fit.surface for fit in surfaces if isinstance(fit.surface, Plane))


def _section(
    planes: tuple[Plane, ...], middle: Float[np.ndarray, "3"], across_rough: Float[np.ndarray, "3"]
) -> Section:
    """Cut top, bottom, left and right flank at right angles to the groove, through the middle of its bottom."""
    top, bottom, left, right = planes
    lines = [unit(np.cross(top.normal, flank.normal)) for flank in (left, right)]
    along = unit(lines[0] + lines[1] * (1.0 if lines[0] @ lines[1] > 0 else -1.0))
    sideways = np.cross(along, top.normal)
    sideways = sideways * (1.0 if sideways @ across_rough > 0 else -1.0)
    corners = {}
    for level_name, level in (("top", top), ("bottom", bottom)):
        for side_name, flank in (("left", left), ("right", right)):
            rows = np.array([p.normal @ np.column_stack([sideways, level.normal]) for p in (flank, level)])
            place, height = np.linalg.solve(rows, [-float(p.normal @ middle + p.offset) for p in (flank, level)])
            corners[f"{level_name}_{side_name}"] = middle + place * sideways + height * level.normal
    return Section(along, sideways, corners)


def _depth_gradient(
    scene: Scene, top: SurfaceFit, middle: Float[np.ndarray, "3"]
) -> tuple[Float[np.ndarray, " _"] | None, ...]:
    """Gradient of the depth by the parameters of top and bottom (see ``linearise``)."""
    assert isinstance(top.surface, Plane)
    e1, e2 = across(top.surface.normal)
    lever = middle - scene.points[top.used].mean(axis=0)
    return np.array([1.0, -lever @ e1, -lever @ e2]), np.array([-1.0, 0.0, 0.0])


def _width_gradients(
    scene: Scene,
    surfaces: tuple[SurfaceFit, ...],
    middle: Float[np.ndarray, "3"],
    across_rough: Float[np.ndarray, "3"],
) -> dict[str, tuple[Float[np.ndarray, " _"] | None, ...]]:
    """Gradients of the widths by the parameters of the four planes (see ``linearise``), by central differences."""
    planes = _planes(surfaces)
    steps = (1e-4 * scene.extent, 1e-4, 1e-4)
    gradients: dict[str, list[Float[np.ndarray, " _"] | None]] = {"width_top": [], "width_bottom": []}
    for k, surface in enumerate(surfaces):
        centroid = scene.points[surface.used].mean(axis=0)
        slopes: dict[str, list[float]] = {key: [] for key in gradients}
        for i, step in enumerate(steps):
            ends = []
            for sign in (1.0, -1.0):
                by = np.zeros(3)
                by[i] = sign * step
                there = _moved(planes[k], centroid, by)
                ends.append(_section((*planes[:k], there, *planes[k + 1 :]), middle, across_rough).widths())
            for key, slope in slopes.items():
                slope.append((ends[0][key] - ends[1][key]) / (2 * step))
        for key, slope in slopes.items():
            gradients[key].append(np.array(slope))
    return {key: tuple(by_fit) for key, by_fit in gradients.items()}


def _moved(plane: Plane, centroid: Float[np.ndarray, "3"], by: Float[np.ndarray, "3"]) -> Plane:
    """A plane shifted along its normal at the centroid, and its normal turned towards e1 and e2 (see ``linearise``)."""
    e1, e2 = across(plane.normal)
    normal = unit(plane.normal + by[1] * e1 + by[2] * e2)
    return Plane(normal, -float(normal @ (centroid + by[0] * plane.normal)))
