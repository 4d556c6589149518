"""Parts made of triangles: rays hit exactly the triangles, and the light does not show them.

Embree finds the triangle that a ray enters, in single precision; where on that triangle, and how far away, is then worked out
in double precision. So a hit is as exact as that of an analytic shape, and what a scan measures is the mesh itself.

The stripe's brightness would show the facets of a curved surface. So the normals that the light uses are interpolated
between the corners of a triangle; across an edge of more than ``crease_deg`` they are not mixed, and it stays sharp.
"""

from dataclasses import dataclass, field

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rotaline.simulation.parts.material import Material
from rotaline.simulation.parts.surface import Box, Distances, Faces, Vectors, dot_rows

Triangles = Int[np.ndarray, "t 3"]

_ASIDE = np.array([0.36, 0.80, 0.48]) * 1e-6
"""A ray that slipped through an edge between two triangles is cast again, moved by this fraction of the part's radius."""


def triangle_normals(vertices: Float[np.ndarray, "v 3"], triangles: Triangles) -> Float[np.ndarray, "t 3"]:
    """Normals by the right-hand rule, as long as twice the triangle's area, mm2."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def unit_rows(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
    """Each vector with length 1; a zero vector stays zero."""
    length = np.sqrt(np.einsum("...i,...i->...", vectors, vectors))
    return np.asarray(vectors / np.where(length > 0, length, 1.0)[..., None])


def corner_angles(vertices: Float[np.ndarray, "v 3"], triangles: Triangles) -> Float[np.ndarray, "t 3"]:
    """The angle at each corner of each triangle, rad."""
    corners = vertices[triangles]
    to_next = unit_rows(corners[:, [1, 2, 0]] - corners)
    return np.arccos(np.clip(-np.einsum("tki,tki->tk", to_next, to_next[:, [2, 0, 1]]), -1.0, 1.0))


@dataclass(frozen=True, eq=False)
class EdgePairs:
    """The edges of a closed mesh: edge ``edge_1[i]`` of triangle ``triangle_1[i]`` is edge ``edge_2[i]`` of ``triangle_2[i]``.

    Edge k of a triangle runs from its corner k to its corner k + 1.
    """

    triangle_1: Int[np.ndarray, " e"]
    edge_1: Int[np.ndarray, " e"]
    triangle_2: Int[np.ndarray, " e"]
    edge_2: Int[np.ndarray, " e"]


def open_half_edges(triangles: Triangles) -> Int[np.ndarray, "e 2"]:
    """Edges, from vertex to vertex, that do not belong to two triangles of opposite sense; none if the surface is closed."""
    starts, ends = triangles.ravel().astype(np.int64), np.roll(triangles, -1, axis=1).ravel().astype(np.int64)
    n = int(triangles.max(initial=0)) + 1
    keys, own, counts = np.unique(starts * n + ends, return_inverse=True, return_counts=True)
    reverse = ends * n + starts
    at = np.minimum(np.searchsorted(keys, reverse), len(keys) - 1)
    single = (keys[at] == reverse) & (counts[at] == 1) & (counts[own] == 1)
    return np.column_stack([starts, ends])[~single]


def pair_edges(triangles: Triangles) -> EdgePairs:
    """Both triangles of every edge of a closed mesh.

    Raises
    ------
    ValueError   if an edge does not belong to exactly two triangles that run along it in opposite senses
    """
    bad = len(open_half_edges(triangles))
    if bad or not len(triangles):
        raise ValueError(
            f"The mesh must be closed and wound in one sense; {bad} edges of {len(triangles)} triangles are not matched."
        )
    starts, ends = triangles.ravel().astype(np.int64), np.roll(triangles, -1, axis=1).ravel().astype(np.int64)
    n = int(triangles.max()) + 1
    order = np.argsort(np.minimum(starts, ends) * n + np.maximum(starts, ends), kind="stable")
    one, two = order[0::2], order[1::2]
    return EdgePairs(one // 3, one % 3, two // 3, two % 3)


@dataclass(frozen=True, eq=False)
class MeshPart:
    """A closed surface of triangles, in its ``part`` frame, mm; see :class:`rotaline.simulation.parts.shapes.Shape`.

    The number of a face is that of the triangle. Triangles that are not separated by a crease share a number in ``patches``.

    Attributes
    ----------
    vertices : (v, 3)   mm
    triangles : (t, 3)   vertices of each triangle, counter-clockwise seen from outside
    material : Material
    crease_deg : edges of more than this angle look sharp
    notes : what was changed in the mesh when it was read
    patches : (t,)   number of the smooth patch of each triangle

    Raises
    ------
    ValueError   if the surface is not closed or not wound in one sense
    """

    vertices: Float[np.ndarray, "v 3"]
    triangles: Triangles
    material: Material = field(default_factory=Material)
    crease_deg: float = 30.0
    notes: tuple[str, ...] = ()
    patches: Int[np.ndarray, " t"] = field(init=False, repr=False)
    _scene: EmbreeScene = field(init=False, repr=False)
    _middle: Float[np.ndarray, "3"] = field(init=False, repr=False)
    _radius: float = field(init=False, repr=False)
    _planes: Float[np.ndarray, "t 3 4"] = field(init=False, repr=False)
    _shading_normals: Float[np.ndarray, "m 3"] = field(init=False, repr=False)
    _shading_index: Int[np.ndarray, "t 3"] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Prepare what rays need; everything is ready before the first thread asks."""
        middle = self.bounds().mean(axis=0)
        normals, index, patches = _shading(self.vertices, self.triangles, self.crease_deg)
        scene = EmbreeScene()
        TriangleMesh(scene, (self.vertices - middle).astype(np.float32), self.triangles.astype(np.int32))
        scene.run(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))  # the first call builds the tree
        for name, value in (
            ("patches", patches),
            ("_scene", scene),
            ("_middle", middle),
            ("_radius", float(np.linalg.norm(self.vertices - middle, axis=1).max())),
            ("_planes", _planes(self.vertices - middle, self.triangles)),
            ("_shading_normals", normals),
            ("_shading_index", index),
        ):
            object.__setattr__(self, name, value)

    def bounds(self) -> Box:
        """Lower and upper corner of the box around the part, mm."""
        return np.stack([self.vertices.min(axis=0), self.vertices.max(axis=0)])

    def sizes(self) -> dict[str, float]:
        """None has a name."""
        return {}

    def albedo(self, points: Vectors, faces: Faces) -> Distances:
        """See :class:`rotaline.simulation.parts.shapes.Shape`."""
        return np.full(len(points), self.material.albedo)

    def _first_triangles(self, starts: Vectors, unit: Vectors) -> Faces:
        """The triangle that each ray meets first, -1 if none; ``starts`` relative to the middle."""
        return self._scene.run(starts.astype(np.float32), unit.astype(np.float32)).astype(np.int64)

    def intersect(self, origin: Float[np.ndarray, "3"], directions: Vectors) -> tuple[Distances, Faces]:
        """See :class:`rotaline.simulation.parts.shapes.Shape`; the number of a face is that of the triangle."""
        length = np.sqrt(dot_rows(directions, directions))
        unit = directions / length[:, None]
        origin_middle = origin - self._middle
        # single precision serves near the part only
        way = max(float(np.linalg.norm(origin_middle)) - 1.001 * self._radius, 0.0)
        starts = origin_middle + way * unit
        triangle = self._first_triangles(starts, unit)
        for side in (1.0, -1.0, 0.0):
            (hit,) = np.nonzero(triangle >= 0)
            slipped = hit[dot_rows(self._planes[triangle[hit], 0, :3], unit[hit]) >= 0]
            if not len(slipped):
                break
            moved = starts[slipped] + side * self._radius * _ASIDE
            triangle[slipped] = self._first_triangles(moved, unit[slipped]) if side else -1
        (hit,) = np.nonzero(triangle >= 0)
        t = np.full(len(directions), np.inf)
        t[hit] = self._distances(origin_middle, unit[hit], triangle[hit]) / length[hit]
        return np.where(t > 0, t, np.inf), np.maximum(triangle, 0)

    def _distances(self, origin_middle: Float[np.ndarray, "3"], unit: Vectors, triangle: Faces) -> Distances:
        """How far along each ray its triangle is, mm, never farther than the triangle reaches."""
        planes = self._planes[triangle]
        normals = planes[:, 0, :3]
        t = -(normals @ origin_middle + planes[:, 0, 3]) / dot_rows(normals, unit)
        inside = _weights(planes, origin_middle + t[:, None] * unit)
        # single precision may name the neighbour of the triangle: a ray that grazes its plane would meet that far away
        (beside,) = np.nonzero(inside.min(axis=1) < 0)
        corners = self.vertices[self.triangles[triangle[beside]]] - self._middle
        t[beside] = _nearest_on_rim(origin_middle, unit[beside], corners)
        return t

    def normals(self, points: Vectors, faces: Faces) -> Vectors:
        """Outward unit normals for the light: interpolated between the corners of the triangle."""
        weights = _on_rim(_weights(self._planes[faces], points - self._middle))
        corners = self._shading_index[faces]
        mixed = sum(weights[:, k, None] * self._shading_normals[corners[:, k]] for k in range(3))
        return unit_rows(np.asarray(mixed))


def _planes(vertices: Float[np.ndarray, "v 3"], triangles: Triangles) -> Float[np.ndarray, "t 3 4"]:
    """For each triangle: ``normal . X + offset``, and the weights of its second and third corner, all linear in X."""
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    square = np.maximum(dot_rows(normals, normals), 1e-300)[:, None]  # a triangle without area has no inside
    rows = np.stack([unit_rows(normals), np.cross(c - a, normals) / square, np.cross(normals, b - a) / square], axis=1)
    return np.concatenate([rows, -np.einsum("tki,ti->tk", rows, a)[:, :, None]], axis=2)


def _weights(planes: Float[np.ndarray, "n 3 4"], points: Vectors) -> Float[np.ndarray, "n 3"]:
    """Weights of the corners at points in the planes of triangles; they sum to 1, and are negative outside the triangle."""
    second = dot_rows(planes[:, 1, :3], points) + planes[:, 1, 3]
    third = dot_rows(planes[:, 2, :3], points) + planes[:, 2, 3]
    return np.stack([1.0 - second - third, second, third], axis=1)


def _nearest_on_rim(origin: Float[np.ndarray, "3"], unit: Vectors, corners: Float[np.ndarray, "n 3 3"]) -> Distances:
    """How far along rays that pass beside triangles the nearest point of the triangle's rim is, mm."""
    from_origin, edges = corners - origin, corners[:, [1, 2, 0]] - corners
    aside, edges_aside = (
        v - np.einsum("nki,ni->nk", v, unit)[:, :, None] * unit[:, None] for v in (from_origin, edges)
    )
    square = np.maximum(np.einsum("nki,nki->nk", edges_aside, edges_aside), 1e-300)
    s = np.clip(-np.einsum("nki,nki->nk", aside, edges_aside) / square, 0.0, 1.0)[:, :, None]
    nearest = np.linalg.norm(aside + s * edges_aside, axis=2).argmin(axis=1)
    rows = np.arange(len(unit))
    return dot_rows((from_origin + s * edges)[rows, nearest], unit)


def _on_rim(weights: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Weights of points beside a triangle, moved to its rim."""
    positive = np.maximum(weights, 0.0)
    return np.asarray(positive / positive.sum(axis=1, keepdims=True))


def _shading(
    vertices: Float[np.ndarray, "v 3"], triangles: Triangles, crease_deg: float
) -> tuple[Float[np.ndarray, "m 3"], Int[np.ndarray, "t 3"], Int[np.ndarray, " t"]]:
    """Normals for the light, which of them each corner of a triangle has, and the smooth patch of each triangle.

    Corners that meet in a vertex share a normal where smooth edges connect their triangles: the mean of the triangles'
    normals, weighted by the angles of the corners.
    """
    normals = unit_rows(triangle_normals(vertices, triangles))
    pairs = pair_edges(triangles)
    cos = dot_rows(normals[pairs.triangle_1], normals[pairs.triangle_2])
    smooth = cos >= np.cos(np.deg2rad(crease_deg))
    one, edge_1, two, edge_2 = (x[smooth] for x in (pairs.triangle_1, pairs.edge_1, pairs.triangle_2, pairs.edge_2))

    def connected(a: Int[np.ndarray, " k"], b: Int[np.ndarray, " k"], n: int) -> tuple[int, Int[np.ndarray, " n"]]:
        count, labels = connected_components(coo_array((np.ones(len(a), bool), (a, b)), shape=(n, n)), directed=False)
        return int(count), np.asarray(labels)

    _, patches = connected(one, two, len(triangles))
    # the start of one edge is the end of the other
    starts, ends = 3 * one + edge_1, 3 * one + (edge_1 + 1) % 3
    starts_2, ends_2 = 3 * two + edge_2, 3 * two + (edge_2 + 1) % 3
    n_groups, group = connected(np.concatenate([starts, ends]), np.concatenate([ends_2, starts_2]), 3 * len(triangles))
    weighted = (corner_angles(vertices, triangles)[:, :, None] * normals[:, None, :]).reshape(-1, 3)
    summed = np.stack([np.bincount(group, weighted[:, k], n_groups) for k in range(3)], axis=1)
    return unit_rows(summed), group.reshape(-1, 3), patches
