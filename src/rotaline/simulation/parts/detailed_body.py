"""Smooth bodies with small details, whose places and sizes are known."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rotaline.simulation.parts.loft import Heights, Rings, ring_normals
from rotaline.simulation.parts.mesh import MeshPart


@dataclass(frozen=True, eq=False)
class Detail:
    """A small feature of a part.

    Attributes
    ----------
    name : what it is
    position_part : (3,)   its highest (or deepest) point, on the surface, mm
    size_mm : how far it stands out of its surroundings; negative: a hollow
    direction_part : (3,)   unit normal of its surroundings
    radius_mm : everything of it is within this distance of its position
    """

    name: str
    position_part: Float[np.ndarray, "3"]
    size_mm: float
    direction_part: Float[np.ndarray, "3"]
    radius_mm: float


@dataclass(frozen=True, eq=False)
class ComplexPart:
    """A part made of triangles, and its details."""

    shape: MeshPart
    details: tuple[Detail, ...]


@dataclass(frozen=True, eq=False)
class DetailedBody:
    """A smooth body of rings with heights along its normals; details are found on it by a point nearby."""

    rings: Rings
    normals: Rings
    heights: Heights

    @staticmethod
    def of(rings: Rings, pipe: bool = False) -> "DetailedBody":
        """Without details yet."""
        return DetailedBody(rings, ring_normals(rings, pipe), np.zeros(rings.shape[:2]))

    def nearest(self, point: tuple[float, float, float]) -> tuple[int, int]:
        """Ring and column of the body's point that is nearest to a point."""
        flat = int(np.linalg.norm(self.rings - point, axis=2).argmin())
        return flat // self.rings.shape[1], flat % self.rings.shape[1]

    def distances_from(self, point: tuple[float, float, float]) -> Heights:
        """Distances on the smooth body from its point nearest to ``point``."""
        return np.linalg.norm(self.rings - self.rings[self.nearest(point)], axis=2)

    def raised(self, heights: Heights) -> "DetailedBody":
        """With these heights added, mm."""
        return DetailedBody(self.rings, self.normals, self.heights + heights)

    @property
    def points(self) -> Rings:
        """The surface with all details."""
        return self.rings + self.heights[:, :, None] * self.normals

    def detail(self, name: str, point: tuple[float, float, float], size_mm: float, radius_mm: float) -> Detail:
        """The detail whose middle on the smooth body is nearest to ``point``."""
        at = self.nearest(point)
        return Detail(name, self.points[at], size_mm, self.normals[at], radius_mm)
