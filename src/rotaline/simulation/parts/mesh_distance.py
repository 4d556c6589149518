"""How far measured points are from the true surface of a mesh.

The nearest triangle is found among those near the point: a search tree holds samples of all triangles, so dense that every point
of a triangle is within a known reach of one of them. A point whose nearest sample is ``s`` away can only be nearest to a triangle
with a sample within ``s + reach``; the distances to those triangles are exact. The sign comes from the angle-weighted normal of
the face, edge or corner that is nearest [1]_.

References
----------
.. [1] Baerentzen and Aanaes, IEEE Transactions on Visualization and Computer Graphics 2005, 11(3), 243-253.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from rotaline.simulation.parts.mesh import MeshPart, corner_angles, pair_edges, triangle_normals, unit_rows
from rotaline.simulation.parts.surface import dot_rows

_CHUNK_PAIRS = 400_000
_SAMPLES = 200_000
_FIRST_NEIGHBOURS = 24


def signed_distances_to_mesh(part: MeshPart, points_part: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Distance of points from the surface of a part, exact to rounding.

    Fast for points near the surface; those farther away than the part is wide have to look at much of it.

    Parameters
    ----------
    part : MeshPart
    points_part : (n, 3)   mm, part frame; rows of NaN are allowed

    Returns
    -------
    distances : (n,)   mm, positive outside; NaN where the point is
    """
    surface = _prepared(part)
    distances = np.full(len(points_part), np.nan)
    (waiting,) = np.nonzero(np.isfinite(points_part).all(axis=1))
    k = _FIRST_NEIGHBOURS
    while len(waiting):
        k = min(k, len(surface.triangle_of_sample))
        chunks = np.array_split(waiting, -(-len(waiting) * k // _CHUNK_PAIRS))
        unsure = []
        for chunk in chunks:
            signed, sure = _distances_among(surface, points_part[chunk], k)
            distances[chunk[sure]] = signed
            unsure.append(chunk[~sure])
        waiting, k = np.concatenate(unsure), 4 * k
    return distances


@dataclass(frozen=True, eq=False)
class _Surface:
    """A mesh made ready for distances.

    ``feature_normals`` of a triangle: its face, the edges from corner 0, 1 and 2, the corners 0, 1 and 2; lengths do not matter.
    """

    corners: Float[np.ndarray, "t 3 3"]
    feature_normals: Float[np.ndarray, "t 7 3"]
    tree: cKDTree
    triangle_of_sample: Int[np.ndarray, " s"]
    reach: float


def _prepared(part: MeshPart) -> _Surface:
    vertices, triangles = part.vertices, part.triangles
    corners = vertices[triangles]
    doubled_areas = triangle_normals(vertices, triangles)
    faces = unit_rows(doubled_areas)
    pairs = pair_edges(triangles)
    edges = np.empty((len(triangles), 3, 3))
    across = faces[pairs.triangle_1] + faces[pairs.triangle_2]
    edges[pairs.triangle_1, pairs.edge_1] = across
    edges[pairs.triangle_2, pairs.edge_2] = across
    weighted = (corner_angles(vertices, triangles)[:, :, None] * faces[:, None, :]).reshape(-1, 3)
    summed = np.stack([np.bincount(triangles.ravel(), weighted[:, k], len(vertices)) for k in range(3)], axis=1)
    normals = np.concatenate([faces[:, None], edges, summed[triangles]], axis=1)

    area = float(np.linalg.norm(doubled_areas, axis=1).sum()) / 2
    pieces, owners, longest = _split_to(corners, np.sqrt(2 * area / _SAMPLES) * 2)
    # the middle of a triangle is nearer to all its points than two thirds of its longest edge
    return _Surface(corners, normals, cKDTree(pieces.mean(axis=1)), owners, 2 / 3 * longest)


def _split_to(
    corners: Float[np.ndarray, "t 3 3"], edge_mm: float
) -> tuple[Float[np.ndarray, "s 3 3"], Int[np.ndarray, " s"], float]:
    """Triangles halved across their longest edge until none is longer than ``edge_mm``; whose piece each is; the longest edge."""
    done, owners_done, longest = [], [], 0.0
    owners = np.arange(len(corners))
    while len(corners):
        lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        small = lengths.max(axis=1) <= edge_mm
        longest = max(longest, float(lengths[small].max(initial=0.0)))
        done.append(corners[small])
        owners_done.append(owners[small])
        corners, owners, first = corners[~small], owners[~small], lengths[~small].argmax(axis=1)
        rows = np.arange(len(corners))
        a, b, c = (corners[rows, (first + k) % 3] for k in range(3))
        middle = (a + b) / 2
        corners = np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])
        owners = np.concatenate([owners, owners])
    return np.concatenate(done), np.concatenate(owners_done), longest


def _distances_among(
    surface: _Surface, points: Float[np.ndarray, "n 3"], k: int
) -> tuple[Float[np.ndarray, " m"], Bool[np.ndarray, " n"]]:
    """Signed distances of those points for which the k nearest samples are enough, and which points these are."""
    to_samples, samples = surface.tree.query(points, k=np.arange(1, k + 1))
    limit = to_samples[:, :1] + surface.reach
    sure = (to_samples[:, -1] > limit[:, 0]) | (k == len(surface.triangle_of_sample))
    points, near = points[sure], to_samples[sure] <= limit[sure]
    triangles = surface.triangle_of_sample[samples[sure]]
    row, column = np.nonzero(near)
    offsets, _ = _offsets_from_triangles(points[row], surface.corners[triangles[row, column]])
    squared = np.full(near.shape, np.inf)
    squared[row, column] = dot_rows(offsets, offsets)
    nearest = triangles[np.arange(len(points)), squared.argmin(axis=1)]
    offsets, feature = _offsets_from_triangles(points, surface.corners[nearest])
    outside = dot_rows(offsets, surface.feature_normals[nearest, feature]) >= 0
    return np.where(outside, 1.0, -1.0) * np.sqrt(dot_rows(offsets, offsets)), sure


def _offsets_from_triangles(
    points: Float[np.ndarray, "n 3"], corners: Float[np.ndarray, "n 3 3"]
) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """From the nearest point of each triangle to each point, and what is nearest, numbered as in :class:`_Surface`.

    The regions are those of Ericson, Real-Time Collision Detection (2005), section 5.1.5.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac = b - a, c - a
    b_a, c_a = dot_rows(ab, points - a), dot_rows(ac, points - a)
    b_b, c_b = dot_rows(ab, points - b), dot_rows(ac, points - b)
    b_c, c_c = dot_rows(ab, points - c), dot_rows(ac, points - c)
    weight_a, weight_b, weight_c = b_b * c_c - b_c * c_b, b_c * c_a - b_a * c_c, b_a * c_b - b_b * c_a
    with np.errstate(divide="ignore", invalid="ignore"):  # of regions that are not chosen
        along_ab, along_ac = b_a / (b_a - b_b), c_a / (c_a - c_c)
        along_bc = (c_b - b_b) / ((c_b - b_b) + (b_c - c_c))
        whole = weight_a + weight_b + weight_c
        face_b, face_c = weight_b / whole, weight_c / whole
    zero, one = np.zeros(len(points)), np.ones(len(points))
    regions = [
        ((b_a <= 0) & (c_a <= 0), 4, zero, zero),
        ((b_b >= 0) & (c_b <= b_b), 5, one, zero),
        ((weight_c <= 0) & (b_a >= 0) & (b_b <= 0), 1, along_ab, zero),
        ((c_c >= 0) & (b_c <= c_c), 6, zero, one),
        ((weight_b <= 0) & (c_a >= 0) & (c_c <= 0), 3, zero, along_ac),
        ((weight_a <= 0) & (c_b >= b_b) & (b_c >= c_c), 2, 1.0 - along_bc, along_bc),
    ]
    chosen = [region[0] for region in regions]
    feature = np.select(chosen, [region[1] for region in regions], 0)
    v = np.select(chosen, [region[2] for region in regions], face_b)
    w = np.select(chosen, [region[3] for region in regions], face_c)
    return points - (a + v[:, None] * ab + w[:, None] * ac), feature
