"""A closed-up surface from a cloud: screened Poisson reconstruction, cut back to what was seen.

Poisson reconstruction fits an indicator function whose gradient matches the oriented normals of the points [1]_; it closes
every hole. What was never seen is cut away again: where few samples stand behind a vertex, and where no point is near it.
Normals come from local planes and are turned towards the camera's place when the point was taken.

References
----------
.. [1] Kazhdan and Hoppe, Screened Poisson surface reconstruction, ACM Trans. Graphics 32 (2013) 29
"""

import ctypes
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from types import ModuleType

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import cKDTree

from rotaline.errors import GeometryError
from rotaline.scanning.cloud import PointCloud
from rotaline.scanning.thinning import cell_means, extent_of, local_planes, thin_indices

MIN_POINTS = 100
DEPTHS = (5, 10)
"""Octree depths that are used: coarser is no surface, finer takes minutes."""

MOST_CELLS = 2_500_000
"""Cells of the octree on the surface, each of which takes about 1 kB: the depth that follows from the spacing keeps below."""

FINEST = 1 / 3000
"""Smallest cell of thinning, as a part of the extent of the cloud."""

MAX_REACH = 4.0
"""Points whose neighbours are so many times farther away than usual are strays without company."""

MAX_ASIDE = 0.75
"""Vertices farther than this from the local plane of the nearest point, in point spacings, bend away where nothing was seen."""


@dataclass(frozen=True)
class SurfaceOptions:
    """How a surface is made from a cloud."""

    n_points: int = field(
        default=1_500_000,
        metadata={
            "help": "Points to which a larger cloud is thinned before meshing; 150000 makes a quick and coarse surface."
        },
    )
    neighbours: int = field(default=20, metadata={"help": "Neighbouring points that make the normal of a point."})
    depth: int | None = field(
        default=None, metadata={"help": "Depth of the octree (5 to 10: more is finer); none: from the point spacing."}
    )
    trim_density: float = field(
        default=3.0,
        metadata={
            "help": "Vertices whose sample density lies this many powers of two below the usual one are cut away."
        },
    )
    trim_distance: float = field(
        default=2.5, metadata={"help": "Vertices farther from all points than this many point spacings are cut away."}
    )
    min_island: float = field(
        default=0.02, metadata={"help": "Separate pieces with less than this fraction of all triangles are left out."}
    )


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh in the table frame, mm; triangles are counter-clockwise seen from outside, normals point outwards."""

    vertices_table: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]
    normals: Float[np.ndarray, "v 3"]


def reconstruct_surface(cloud: PointCloud, options: SurfaceOptions | None = None) -> Surface:
    """Make a surface from a scan.

    Parameters
    ----------
    cloud : PointCloud   with the viewpoints that orient the normals
    options : SurfaceOptions

    Raises
    ------
    GeometryError
        If there are too few points, or nothing remains after trimming.
    """
    options = SurfaceOptions() if options is None else options
    finite = _finite(cloud.points_table) & _finite(cloud.viewpoints_table)
    n_finite = int(np.count_nonzero(finite))
    if n_finite < MIN_POINTS:
        raise GeometryError(
            f"A surface needs at least {MIN_POINTS} points; the cloud has {n_finite}. Scan the part with more frames."
        )
    points, viewpoints, cell, steps = _thinned(cloud if n_finite == len(cloud) else cloud.select(finite), options)
    normals, reach = oriented_normals(points, viewpoints, options.neighbours)
    # On a surface with evenly strewn points the j-th neighbour is about sqrt(j / pi) spacings away.
    reach_in_spacings = float(np.sqrt(np.arange(1, max(2, options.neighbours // 2)) / np.pi).mean())
    spacing = max(cell, float(np.median(reach)) / reach_in_spacings)
    # Stripes lie a table step apart; that is farther on the rim than near the axis, and farther where frames are missing.
    gaps = np.maximum(spacing, 0.35 * steps * np.hypot(points[:, 0], points[:, 1]))
    company = reach <= MAX_REACH * float(np.median(reach))
    points, normals, gaps = points[company], normals[company], gaps[company]
    if len(points) < MIN_POINTS:
        raise GeometryError(
            f"A surface needs at least {MIN_POINTS} neighbouring points; only {len(points)} of {n_finite} have company. "
            "Scan the part with more frames."
        )
    depth = octree_depth(float(np.ptp(points, axis=0).max()), spacing, len(points))
    if options.depth is not None:
        depth = int(np.clip(options.depth, *DEPTHS))
    vertices, triangles, density = _poisson(points, normals, depth)

    distance, nearest = cKDTree(points).query(vertices)
    aside = np.abs(np.einsum("ij,ij->i", vertices - points[nearest], normals[nearest]))
    keep = (
        (distance <= options.trim_distance * gaps[nearest])
        & (aside <= MAX_ASIDE * gaps[nearest])
        & (density >= np.median(density) - options.trim_density)
    )
    triangles = triangles[np.all(keep[triangles], axis=1)]
    triangles = _drop_islands(vertices, triangles, options.min_island)
    if len(triangles) == 0:
        raise GeometryError(
            "No surface remains after trimming what was not seen: the points are too sparse for a mesh. "
            "Scan with smaller steps, or raise trim_distance."
        )
    return _compact(vertices, triangles)


def octree_depth(extent: float, spacing: float, n_points: int) -> int:
    """The depth whose cells are not larger than the points' spacing, within memory.

    Parameters
    ----------
    extent : longest side of the box around the points, mm; the octree's cube is a tenth larger
    spacing : of the points, mm
    n_points : points that make the surface: its area is about ``n_points * spacing**2``
    """
    cells_along = 1.1 * extent / spacing
    wanted = int(np.ceil(np.log2(cells_along)))
    affordable = int(np.floor(np.log2(cells_along * np.sqrt(MOST_CELLS / n_points))))
    return int(np.clip(min(wanted, affordable), *DEPTHS))


def oriented_normals(
    points: Float[np.ndarray, "n 3"], viewpoints: Float[np.ndarray, "n 3"], neighbours: int
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, " n"]]:
    """Unit normals of local planes, turned towards the viewpoints, and the mean distance of the nearer half of the neighbours, mm."""
    normals, _, reach = local_planes(points, neighbours)
    towards = np.einsum("ij,ij->i", normals, viewpoints - points)
    normals[towards < 0] *= -1.0
    return normals, reach


def _finite(rows: np.ndarray) -> np.ndarray:
    return np.asarray(np.isfinite(rows[:, 0]) & np.isfinite(rows[:, 1]) & np.isfinite(rows[:, 2]))


def _thinned(cloud: PointCloud, options: SurfaceOptions) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
    """Thinned points and viewpoints, the cell size, and the angle between the frames about each point."""
    points = cloud.points_table
    kept, cell = thin_indices(points, options.n_points, FINEST)
    means = cell_means(points, kept, cell)
    return means, cloud.viewpoints_table[kept], max(cell, 1e-4 * extent_of(points)), _steps(cloud.angle_rad)[kept]


def _steps(angle_rad: np.ndarray) -> np.ndarray:
    """For each point, the larger of the angles to the frames before and after it, at most three times the usual step."""
    turn = np.mod(np.round(angle_rad, 9), 2 * np.pi)
    angles, place = np.unique(turn, return_inverse=True)
    if len(angles) < 2:
        return np.zeros(len(angle_rad))
    after = np.diff(np.append(angles, angles[0] + 2 * np.pi))
    larger = np.maximum(after, np.roll(after, 1))
    return np.minimum(larger, 3.0 * float(np.median(after)))[place]


def _poisson(points: np.ndarray, normals: np.ndarray, depth: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, triangles, and the sample density of each vertex (a power of two)."""
    o3d = _open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error), _silent_stderr():
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        cloud.normals = o3d.utility.Vector3dVector(normals)
        # One thread: the solver's result would otherwise differ a little from run to run.
        mesh, density = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(cloud, depth=depth, n_threads=1)
    return (
        np.asarray(mesh.vertices).copy(),
        np.asarray(mesh.triangles).astype(np.int64),
        np.asarray(density).copy(),
    )


@contextmanager
def _silent_stderr() -> Iterator[None]:
    """The solver writes harmless remarks ("bad average roots") straight to the process's error stream; they go nowhere."""
    sys.stderr.flush()
    kept = os.dup(2)
    with open(os.devnull, "wb") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _open3d() -> ModuleType:
    """open3d, loaded when first needed. Its wheel expects libusb in the system; the package libusb_package brings one."""
    import libusb_package

    path = libusb_package.get_library_path()
    if path is not None:
        ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import open3d
    return open3d


def _drop_islands(vertices: np.ndarray, triangles: np.ndarray, min_island: float) -> np.ndarray:
    """Triangles of the pieces that hold at least a fraction of all triangles."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if len(triangles) == 0:
        return triangles
    a, b = triangles[:, [0, 1]].T, triangles[:, [1, 2]].T
    rows, columns = np.concatenate([a[0], b[0]]), np.concatenate([a[1], b[1]])
    graph = coo_matrix((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(len(vertices), len(vertices)))
    _, piece = connected_components(graph, directed=False)
    of_triangle = piece[triangles[:, 0]]
    counts = np.bincount(of_triangle)
    return triangles[counts[of_triangle] >= min_island * len(triangles)]


def _compact(vertices: np.ndarray, triangles: np.ndarray) -> Surface:
    """The mesh without unused vertices, with the area-weighted normals of the vertices."""
    used, renumbered = np.unique(triangles, return_inverse=True)
    triangles = renumbered.reshape(-1, 3).astype(np.int64)
    vertices = vertices[used]
    corners = vertices[triangles]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, triangles[:, corner], facing)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return Surface(vertices, triangles, normals)
