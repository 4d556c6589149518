"""Shapes that a ray can hit, each in its own ``part`` frame: z up, z = 0 is the face that stands on the table, mm.

Every shape answers three questions about rays and points in its frame: where a ray first enters it (``intersect``), which
way the surface faces there (``normals``), and how much light it sends back (``albedo``, ``material``). Only the entry of a
ray from outside counts: nothing here is transparent.
"""

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from rotaline.geometry.primitives import SteppedCylinder
from rotaline.simulation.material import BRIGHT, MATT, Material

Vectors = Float[np.ndarray, "n 3"]
Distances = Float[np.ndarray, " n"]
Faces = Int[np.ndarray, " n"]


@runtime_checkable
class Shape(Protocol):
    """What the renderer asks of a shape."""

    @property
    def material(self) -> Material:
        """How the surface sends light back; where a print changes that, ``albedo`` knows better."""
        ...

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """Lower and upper corner of a box that holds the whole shape, mm."""
        ...

    def intersect(self, origin: Float[np.ndarray, "3"], directions: Vectors) -> tuple[Distances, Faces]:
        """First entry ``origin + t * direction``: t > 0 (inf where the ray misses) and the number of the face entered."""
        ...

    def normals(self, points: Vectors, faces: Faces) -> Vectors:
        """Outward unit normals at points of the surface."""
        ...

    def albedo(self, points: Vectors, faces: Faces) -> Distances:
        """Fraction of the light that comes back, 0 to 1."""
        ...

    def sizes(self) -> dict[str, float]:
        """The true sizes, mm, with the names that measurements have."""
        ...


def dot_rows(a: Vectors, b: Vectors) -> Distances:
    """Scalar product of each row of a with the same row of b."""
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def _entry(t_in: Distances, t_out: Distances) -> Distances:
    """The entry into a convex solid; inf where the ray misses it or starts inside or behind."""
    return np.where((t_in < t_out) & (t_in > 0), t_in, np.inf)


@dataclass(frozen=True)
class Ball:
    """A sphere that stands on z = 0."""

    diameter: float
    material: Material = BRIGHT

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """See :class:`Shape`."""
        r = self.diameter / 2
        return np.array([[-r, -r, 0.0], [r, r, self.diameter]])

    def intersect(self, origin: Float[np.ndarray, "3"], directions: Vectors) -> tuple[Distances, Faces]:
        """See :class:`Shape`; one face."""
        o = origin - np.array([0.0, 0.0, self.diameter / 2])
        a = dot_rows(directions, directions)
        half_b = directions @ o
        # the discriminant as squared distance from the ray: no difference of large numbers
        nearest = o - (half_b / a)[:, None] * directions
        inside = (self.diameter / 2) ** 2 - dot_rows(nearest, nearest)
        with np.errstate(invalid="ignore"):
            t = (-half_b / a) - np.sqrt(inside / a)
        return np.where((inside > 0) & (t > 0), t, np.inf), np.zeros(len(directions), int)

    def normals(self, points: Vectors, faces: Faces) -> Vectors:
        """See :class:`Shape`."""
        return (points - np.array([0.0, 0.0, self.diameter / 2])) / (self.diameter / 2)

    def albedo(self, points: Vectors, faces: Faces) -> Distances:
        """See :class:`Shape`."""
        return np.full(len(points), self.material.albedo)

    def sizes(self) -> dict[str, float]:
        """See :class:`Shape`."""
        return {"diameter": self.diameter}


@dataclass(frozen=True)
class Rod:
    """An upright cylinder from ``z_bottom`` to ``z_bottom + height``; faces 0 side, 1 top, 2 bottom."""

    diameter: float
    height: float
    z_bottom: float = 0.0
    material: Material = MATT

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """See :class:`Shape`."""
        r = self.diameter / 2
        return np.array([[-r, -r, self.z_bottom], [r, r, self.z_bottom + self.height]])

    def intersect(self, origin: Float[np.ndarray, "3"], directions: Vectors) -> tuple[Distances, Faces]:
        """See :class:`Shape`."""
        dx, dy, dz = directions.T
        with np.errstate(divide="ignore", invalid="ignore"):
            t_top = (self.z_bottom + self.height - origin[2]) / dz
            t_bottom = (self.z_bottom - origin[2]) / dz
            a = dx * dx + dy * dy
            middle = -(origin[0] * dx + origin[1] * dy) / a
            x, y = origin[0] + middle * dx, origin[1] + middle * dy
            half = np.sqrt(((self.diameter / 2) ** 2 - x * x - y * y) / a)  # nan where the ray misses
        flat_in, flat_out = np.minimum(t_top, t_bottom), np.maximum(t_top, t_bottom)
        side_in, side_out = middle - half, middle + half
        with np.errstate(invalid="ignore"):
            t = _entry(np.maximum(flat_in, side_in), np.minimum(flat_out, side_out))
            faces = np.where(side_in >= flat_in, 0, np.where(t_top < t_bottom, 1, 2))
        return t, faces

    def normals(self, points: Vectors, faces: Faces) -> Vectors:
        """See :class:`Shape`."""
        normals = np.zeros_like(points)
        side = faces == 0
        normals[side, :2] = points[side, :2] / (self.diameter / 2)
        normals[faces == 1, 2] = 1.0
        normals[faces == 2, 2] = -1.0
        return normals

    def albedo(self, points: Vectors, faces: Faces) -> Distances:
        """See :class:`Shape`."""
        return np.full(len(points), self.material.albedo)

    def sizes(self) -> dict[str, float]:
        """See :class:`Shape`."""
        return {"diameter": self.diameter, "height": self.height}


def _intersect_union(
    pieces: "tuple[Rod | Polyhedron, ...]", faces_each: int, origin: Float[np.ndarray, "3"], directions: Vectors
) -> tuple[Distances, Faces]:
    """The nearest entry into any of the pieces; face ``k`` of piece ``i`` has the number ``i * faces_each + k``."""
    t, faces = pieces[0].intersect(origin, directions)
    for i, piece in enumerate(pieces[1:], start=1):
        t_piece, faces_piece = piece.intersect(origin, directions)
        faces = np.where(t_piece < t, faces_piece + i * faces_each, faces)
        t = np.minimum(t, t_piece)
    return t, faces


def _normals_union(pieces: "tuple[Rod | Polyhedron, ...]", faces_each: int, points: Vectors, faces: Faces) -> Vectors:
    normals = np.zeros_like(points)
    for i, piece in enumerate(pieces):
        here = faces // faces_each == i
        normals[here] = piece.normals(points[here], faces[here] - i * faces_each)
    return normals


@dataclass(frozen=True)
class SteppedRod:
    """The stepped cylinder of the article, as a solid: the small cylinder stands on the large one."""

    artifact: SteppedCylinder
    material: Material = MATT

    @property
    def _pieces(self) -> tuple[Rod, Rod]:
        a = self.artifact
        return Rod(a.diameter_large, a.height_large), Rod(a.diameter_small, a.height_small, a.height_large)

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """See :class:`Shape`."""
        large, small = (piece.bounds() for piece in self._pieces)
        return np.stack([np.minimum(large[0], small[0]), np.maximum(large[1], small[1])])

    def intersect(self, origin: Float[np.ndarray, "3"], directions: Vectors) -> tuple[Distances, Faces]:
        """See :class:`Shape`."""
        return _intersect_union(self._pieces, 3, origin, directions)

    def normals(self, points: Vectors, faces: Faces) -> Vectors:
        """See :class:`Shape`."""
        return _normals_union(self._pieces, 3, points, faces)

    def albedo(self, points: Vectors, faces: Faces) -> Distances:
        """See :class:`Shape`."""
        return np.full(len(points), self.material.albedo)

    def sizes(self) -> dict[str, float]:
        """See :class:`Shape`."""
        a = self.artifact
        return {
            "diameter_small": a.diameter_small,
            "diameter_large": a.diameter_large,
            "height_small": a.height_small,
            "height_large": a.height_large,
        }


@dataclass(frozen=True, eq=False)
class Polyhedron:
    """A convex solid: all points with ``face_normals . X <= face_offsets``."""

    face_normals: Float[np.ndarray, "k 3"]
    face_offsets: Float[np.ndarray, " k"]
    material: Material = MATT

    def intersect(self, origin: Float[np.ndarray, "3"], directions: Vectors) -> tuple[Distances, Faces]:
        """See :class:`Shape`."""
        n = len(directions)
        t_in, t_out, faces = np.full(n, -np.inf), np.full(n, np.inf), np.zeros(n, int)
        for k, (normal, offset) in enumerate(zip(self.face_normals, self.face_offsets, strict=True)):
            towards = directions @ normal
            outside = offset - float(origin @ normal)
            with np.errstate(divide="ignore", invalid="ignore"):
                t = outside / towards
            entering = (towards < 0) & (t > t_in)
            t_in, faces = np.where(entering, t, t_in), np.where(entering, k, faces)
            t_out = np.where(towards > 0, np.minimum(t_out, t), t_out)
            if outside < 0:  # a ray that runs along this face's plane, outside, never enters
                t_out = np.where(towards == 0, -np.inf, t_out)
        return _entry(t_in, t_out), faces

    def normals(self, points: Vectors, faces: Faces) -> Vectors:
        """See :class:`Shape`."""
        return np.asarray(self.face_normals[faces])

    def albedo(self, points: Vectors, faces: Faces) -> Distances:
        """See :class:`Shape`."""
        return np.full(len(points), self.material.albedo)

    def sizes(self) -> dict[str, float]:
        """See :class:`Shape`."""
        return {}


def _prism(profile_xz: list[tuple[float, float]], length: float) -> Polyhedron:
    """A convex polygon in (x, z), counter-clockwise seen from -y, drawn out over ``-length/2 <= y <= length/2``."""
    corners = np.array(profile_xz)
    edges = np.roll(corners, -1, axis=0) - corners
    outward = np.column_stack([edges[:, 1], -edges[:, 0]]) / np.linalg.norm(edges, axis=1)[:, None]
    sides = np.column_stack([outward[:, 0], np.zeros(len(corners)), outward[:, 1]])
    offsets = np.einsum("ij,ij->i", outward, corners)
    normals = np.vstack([sides, [[0.0, 1.0, 0.0], [0.0, -1.0, 0.0]]])
    return Polyhedron(normals, np.concatenate([offsets, [length / 2, length / 2]]))


@dataclass(frozen=True)
class GrooveBlock:
    """A block with a trapezoidal groove along y, open at the top and at both ends."""

    width: float
    length: float
    height: float
    groove_depth: float
    groove_width_top: float
    groove_width_bottom: float
    material: Material = MATT
    _pieces: tuple[Polyhedron, ...] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Cut the block into three convex pieces: below the groove, left and right of it."""
        w, top, bottom = self.width / 2, self.groove_width_top / 2, self.groove_width_bottom / 2
        h, floor = self.height, self.height - self.groove_depth
        if not (0 < bottom <= top < w and 0 < floor < h):
            raise ValueError("The groove must fit into the block: 0 < bottom <= top < width and 0 < depth < height.")
        profiles: tuple[list[tuple[float, float]], ...] = (
            [(-w, 0.0), (w, 0.0), (w, floor), (-w, floor)],
            [(-w, floor), (-bottom, floor), (-top, h), (-w, h)],
            [(bottom, floor), (w, floor), (w, h), (top, h)],
        )
        object.__setattr__(self, "_pieces", tuple(_prism(profile, self.length) for profile in profiles))

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """See :class:`Shape`."""
        return np.array([[-self.width / 2, -self.length / 2, 0.0], [self.width / 2, self.length / 2, self.height]])

    def intersect(self, origin: Float[np.ndarray, "3"], directions: Vectors) -> tuple[Distances, Faces]:
        """See :class:`Shape`."""
        return _intersect_union(self._pieces, 6, origin, directions)

    def normals(self, points: Vectors, faces: Faces) -> Vectors:
        """See :class:`Shape`."""
        return _normals_union(self._pieces, 6, points, faces)

    def albedo(self, points: Vectors, faces: Faces) -> Distances:
        """See :class:`Shape`."""
        return np.full(len(points), self.material.albedo)

    def sizes(self) -> dict[str, float]:
        """See :class:`Shape`."""
        return {
            "depth": self.groove_depth,
            "width_top": self.groove_width_top,
            "width_bottom": self.groove_width_bottom,
        }
