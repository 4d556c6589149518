"""Section 6.3, figure 16: four parts with small details, scanned, and what the article could not do: held against the true surface."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float, UInt8
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import QhullError, cKDTree
from scipy.spatial.transform import RigidTransform

from rotaline.calibration.model import SystemCalibration
from rotaline.errors import GeometryError
from rotaline.io.frame_images import read_source
from rotaline.io.report.reproduction import ComplexPartResult, ComplexPartsSection, DetailResult
from rotaline.pipeline.compare_truth import best_rotation
from rotaline.pipeline.options import Options
from rotaline.pipeline.parts import make_cloud, place_on_table, system_at_optical_axis
from rotaline.pipeline.reproduce.plan import COMPLEX_TITLES
from rotaline.pipeline.reproduce.workbench import Workbench
from rotaline.pipeline.store import StageStore, key_of
from rotaline.pipeline.summary import PICTURE_WIDTH, thinned
from rotaline.scanning.cloud import PointCloud
from rotaline.scanning.surface import reconstruct_surface
from rotaline.simulation.parts.complex_parts import ComplexPart, Detail
from rotaline.simulation.parts.mesh_distance import signed_distances_to_mesh
from rotaline.simulation.plan import SessionPlan
from rotaline.simulation.rig import Rig
from rotaline.vision.images import small_picture

RESOLVED_FRACTION = 0.5
NEAR_MM = 0.5
_TOP, _RING = 0.5, (1.0, 1.4)
_GRID = 41
_RADIUS_MM = 18.0
"""Where most of the parts' surface lies."""

RESOLVED_RULE = (
    f"A detail counts as resolved if the measured surface stands out there by at least {100 * RESOLVED_FRACTION:.0f} % and at most "
    f"{100 * (2 - RESOLVED_FRACTION):.0f} % of the true height. Height: the highest place within half the detail's radius over the median of the ring "
    f"between {_RING[0]:g} and {_RING[1]:g} radii, along the normal of its surroundings, in the same way for the true and the measured surface. Covered is "
    f"the part of the true surface (without its bottom) with a measured point within {NEAR_MM:g} mm."
)


def complex_parts_section(
    bench: Workbench,
    store: StageStore,
    plans: Mapping[str, SessionPlan],
    parts: Mapping[str, ComplexPart],
    system: SystemCalibration,
    rig: Rig,
    options: Options,
) -> ComplexPartsSection:
    """Cloud, surface, deviation and details of each part.

    Parameters
    ----------
    plans : the session of each part, which say how it stands on the table
    parts : by name, with what they truly are
    system : as calibrated; the measured surface is held against the truth in the camera's frame, with no alignment
    """
    results = []
    for name, part in parts.items():
        _, stripe_key = bench.stripes(name, options)
        standing = plans[name].captures[0].shots[0].on_table[0].frame_from_part
        key = key_of(stripe_key, system, options.scan, options.surface, rig)

        def compute(
            name: str = name, part: ComplexPart = part, standing: RigidTransform = standing
        ) -> ComplexPartResult:
            photo = read_source(bench.capture(f"{name}-photo").frames[0].source)
            picture, _ = small_picture(photo, PICTURE_WIDTH)
            cloud, placed = _cloud(bench, name, system, options)
            return _judge(name, part, standing, cloud, placed, rig, options, picture)

        results.append(store.get(f"complex-{name}", COMPLEX_TITLES[name], key, compute))
    n_frames = len(next(iter(plans.values())).captures[0].shots)
    spacing_mm = 2 * np.pi * _RADIUS_MM / n_frames
    spacing = f"{n_frames} frames a turn: profiles are {spacing_mm:.2f} mm apart at {_RADIUS_MM:g} mm from the axis; smaller details may fall between them."
    return ComplexPartsSection(f"{RESOLVED_RULE} {spacing}", tuple(results))


def _cloud(
    bench: Workbench, name: str, system: SystemCalibration, options: Options
) -> tuple[PointCloud, SystemCalibration]:
    """The cloud without the table, and the system with z = 0 on the table."""
    stripes, _ = bench.stripes(name, options)
    level = system_at_optical_axis(system)
    placed = place_on_table(level, [make_cloud(stripes, level, options.scan)])
    cloud = make_cloud(stripes, placed, options.scan)
    return cloud.select(cloud.points_table[:, 2] > options.scan.table_margin_mm), placed


def _judge(
    name: str,
    part: ComplexPart,
    standing: RigidTransform,
    cloud: PointCloud,
    system: SystemCalibration,
    rig: Rig,
    options: Options,
    photo: UInt8[np.ndarray, "h w 3"],
) -> ComplexPartResult:
    # what was measured in the calibrated frame, brought into the true one through the camera
    true_from_calibrated = RigidTransform.from_rotation(best_rotation(system.camera, rig.camera)[0])
    true_from_measured = rig.camera_from_base.inv() * true_from_calibrated * system.base_from_camera.inv()
    part_from_measured = standing.inv() * true_from_measured
    try:
        surface = reconstruct_surface(cloud, options.surface)
        vertices, triangles = surface.vertices_table, surface.triangles
    except GeometryError:
        vertices, triangles = np.empty((0, 3)), np.empty((0, 3), dtype=int)
    vertices_part = part_from_measured.apply(vertices) if len(vertices) else vertices
    deviation = signed_distances_to_mesh(part.shape, vertices_part)
    known = deviation[np.isfinite(deviation)]
    details = tuple(
        judge_detail(detail, part, vertices_part, deviation, part_from_measured.inv()) for detail in part.details
    )
    shown = thinned(cloud)
    return ComplexPartResult(
        name=name,
        title=COMPLEX_TITLES[name],
        photo=photo,
        points_table=shown.points_table,
        n_points=len(cloud),
        vertices_table=vertices,
        triangles=triangles,
        deviation_mm=deviation,
        rms_mm=float(np.sqrt(np.mean(known**2))) if len(known) else float("nan"),
        p95_mm=float(np.quantile(np.abs(known), 0.95)) if len(known) else float("nan"),
        coverage=covered_fraction(part, part_from_measured.apply(cloud.points_table)),
        details=details,
    )


def covered_fraction(part: ComplexPart, points_part: Float[np.ndarray, "n 3"]) -> float:
    """The part of the true surface, without its bottom, that has a measured point within ``NEAR_MM``."""
    corners = part.shape.vertices[part.shape.triangles]
    middle = corners.mean(axis=1)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    area = np.where(middle[:, 2] > part.shape.vertices[:, 2].min() + NEAR_MM, area, 0.0)
    near = cKDTree(points_part).query(middle, distance_upper_bound=NEAR_MM)[0] <= NEAR_MM
    return float(area[near].sum() / area.sum())


def judge_detail(
    detail: Detail,
    part: ComplexPart,
    vertices_part: Float[np.ndarray, "v 3"],
    deviation_mm: Float[np.ndarray, " v"],
    measured_from_part: RigidTransform,
) -> DetailResult:
    """One detail of the measured surface beside the true one, see :data:`RESOLVED_RULE`."""
    true_mm = standing_out_mm(detail, part.shape.vertices)
    measured_mm = standing_out_mm(detail, vertices_part)
    near = np.linalg.norm(vertices_part - detail.position_part, axis=1) < detail.radius_mm
    inside = deviation_mm[near]
    inside = inside[np.isfinite(inside)]
    rms_mm = float(np.sqrt(np.mean(inside**2))) if len(inside) else float("nan")
    ratio = measured_mm / true_mm if true_mm else float("nan")
    resolved = bool(RESOLVED_FRACTION <= ratio <= 2 - RESOLVED_FRACTION)
    text = f"{100 * ratio:.0f} % of the true height" if np.isfinite(ratio) else "no measured surface there"
    return DetailResult(
        name=detail.name,
        position_table=measured_from_part.apply(detail.position_part),
        direction_table=measured_from_part.rotation.apply(detail.direction_part),
        radius_mm=detail.radius_mm,
        height_mm=true_mm,
        measured_height_mm=measured_mm,
        rms_mm=rms_mm,
        resolved=resolved,
        text=text,
    )


def standing_out_mm(detail: Detail, vertices_part: Float[np.ndarray, "v 3"]) -> float:
    """How far a surface stands out of its surroundings at a detail (negative: a hollow), mm; NaN where it has too few points.

    The vertices near the detail make a field of heights along its direction; the extreme within half its radius is compared with
    the median of the ring around it.
    """
    direction = detail.direction_part / np.linalg.norm(detail.direction_part)
    across = np.linalg.svd(direction[None])[2][1:]
    offset = vertices_part - detail.position_part
    height, lateral = offset @ direction, offset @ across.T
    reach = 1.2 * _RING[1] * detail.radius_mm
    near = (np.linalg.norm(lateral, axis=1) < reach) & (np.abs(height) < reach)  # the far side of the part lies deeper
    if np.count_nonzero(near) < 8:
        return float("nan")
    field = _height_field(lateral[near], height[near])
    if field is None:
        return float("nan")
    line = np.linspace(-_RING[1], _RING[1], _GRID) * detail.radius_mm
    x, y = np.meshgrid(line, line)
    z, radius = field(x, y), np.hypot(x, y) / detail.radius_mm
    top, ring = z[radius <= _TOP], z[(radius >= _RING[0]) & (radius <= _RING[1])]
    if np.isfinite(top).sum() < 3 or np.isfinite(ring).mean() < 0.3:
        return float("nan")
    extreme = np.nanmax(top) if detail.size_mm > 0 else np.nanmin(top)
    return float(extreme - np.nanmedian(ring))


def _height_field(lateral: Float[np.ndarray, "n 2"], height: Float[np.ndarray, " n"]) -> LinearNDInterpolator | None:
    try:
        return LinearNDInterpolator(lateral, height)
    except QhullError:  # all on one line
        return None
