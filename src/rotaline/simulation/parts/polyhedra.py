"""Surfaces with flat faces: a union of convex solids, each an intersection of half-spaces."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from rotaline.simulation.parts.surface import Box, Distances, Faces, Vectors


@dataclass(frozen=True, eq=False)
class HalfSpaces:
    """A convex solid: all points with ``normals . X <= offsets``; the normals have length 1, offsets in mm."""

    normals: Float[np.ndarray, "k 3"]
    offsets: Float[np.ndarray, " k"]

    def cut(self, normal: Sequence[float], offset: float) -> "HalfSpaces":
        """The part of the solid with ``normal . X <= offset``; the normal may have any length but zero."""
        length = float(np.linalg.norm(normal))
        return HalfSpaces(
            np.vstack([self.normals, np.asarray(normal, dtype=float) / length]),
            np.append(self.offsets, offset / length),
        )


def box_solid(low: Sequence[float], high: Sequence[float]) -> HalfSpaces:
    """All points between two corners."""
    return HalfSpaces(np.vstack([np.eye(3), -np.eye(3)]), np.concatenate([high, -np.asarray(low, dtype=float)]))


def prism(outline_xz: Float[np.ndarray, "k 2"], length: float) -> HalfSpaces:
    """A convex outline in (x, z), from +x over +z to -x in order, drawn out over ``-length/2 <= y <= length/2``."""
    sides = np.roll(outline_xz, -1, axis=0) - outline_xz
    outward = np.column_stack([sides[:, 1], -sides[:, 0]]) / np.linalg.norm(sides, axis=1)[:, None]
    normals = np.column_stack([outward[:, 0], np.zeros(len(sides)), outward[:, 1]])
    offsets = np.einsum("ij,ij->i", outward, outline_xz)
    return HalfSpaces(normals, offsets).cut([0.0, 1.0, 0.0], length / 2).cut([0.0, -1.0, 0.0], length / 2)


@dataclass(frozen=True, eq=False)
class PolyhedraSurface:
    """The surface of a union of convex solids that touch but do not overlap; faces in one plane have the same number.

    Attributes
    ----------
    solids : the convex solids
    box : (2, 3)   lower and upper corner of a box around them
    """

    solids: tuple[HalfSpaces, ...]
    box: Box

    def grown(self, amount: float) -> "PolyhedraSurface":
        """The surface of the solids whose faces all lie ``amount`` further out."""
        solids = tuple(HalfSpaces(solid.normals, solid.offsets + amount) for solid in self.solids)
        return PolyhedraSurface(solids, self.box + amount * np.array([[-1.0], [1.0]]))

    def _planes(self) -> Float[np.ndarray, "k 4"]:
        return np.vstack([np.column_stack([solid.normals, solid.offsets]) for solid in self.solids])

    def _face_numbers(self) -> Int[np.ndarray, " k"]:
        """Number of each half-space of all solids: that of the first one with the same plane."""
        planes = self._planes()
        same = np.abs(planes[:, None, :] - planes[None, :, :]).max(axis=2) < 1e-9
        return np.argmax(same, axis=1)

    def bounds(self) -> Box:
        """See :class:`rotaline.simulation.parts.surface.Surface`."""
        return self.box

    def intersect(self, origin: Float[np.ndarray, "3"], directions: Vectors) -> tuple[Distances, Faces]:
        """See :class:`rotaline.simulation.parts.surface.Surface`."""
        n = len(directions)
        t, faces = np.full(n, np.inf), np.zeros(n, int)
        numbers = iter(self._face_numbers().tolist())
        for solid in self.solids:
            t_in, t_out, face_in = np.full(n, -np.inf), np.full(n, np.inf), np.zeros(n, int)
            for normal, offset in zip(solid.normals, solid.offsets.tolist(), strict=True):
                number = next(numbers)
                towards = directions @ normal
                outside = offset - float(origin @ normal)
                with np.errstate(divide="ignore", invalid="ignore"):
                    t_face = outside / towards
                if outside < 0:  # in front of this face: rays enter here, or run away from it or along it and miss
                    entered = (towards < 0) & (t_face > t_in)
                    np.copyto(t_in, t_face, where=entered)
                    np.copyto(face_in, number, where=entered)
                    np.copyto(t_out, -np.inf, where=towards >= 0)
                else:
                    np.copyto(t_out, t_face, where=(towards > 0) & (t_face < t_out))
            entered = (t_in < t_out) & (t_in > 0) & (t_in < t)
            np.copyto(t, t_in, where=entered)
            np.copyto(faces, face_in, where=entered)
        return t, faces

    def contains(self, points: Vectors) -> Bool[np.ndarray, " n"]:
        """See :class:`rotaline.simulation.parts.surface.Surface`."""
        within = [np.all(points @ solid.normals.T <= solid.offsets, axis=1) for solid in self.solids]
        return np.logical_or.reduce(within)

    def normals(self, points: Vectors, faces: Faces) -> Vectors:
        """See :class:`rotaline.simulation.parts.surface.Surface`."""
        return np.asarray(self._planes()[:, :3][faces])
