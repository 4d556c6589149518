"""Geometric values: lines, planes, circles, spheres, cylinders, and the stepped cylinder.

All are frozen; lengths in mm; the frame stands in the name of the variable that holds the value (``plane_camera``).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rotaline.errors import GeometryError


def unit(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """Scale a vector to length 1.

    Raises
    ------
    GeometryError
        If the vector is zero or not finite: it has no direction.
    """
    length = float(np.linalg.norm(vector))
    if not np.isfinite(length) or length == 0.0:
        raise GeometryError(f"A direction is needed, but the vector is {np.asarray(vector).tolist()}.")
    return np.asarray(vector, dtype=float) / length


@dataclass(frozen=True, eq=False)
class Line:
    """Points ``point + s * direction``; ``direction`` has length 1."""

    point: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "3"]

    def distance_to(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Distance of each point from the line, mm."""
        return np.linalg.norm(np.cross(points - self.point, self.direction), axis=1)

    def closest_to(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Foot of the perpendicular from each point, mm."""
        along = (points - self.point) @ self.direction
        return self.point + along[:, None] * self.direction


@dataclass(frozen=True, eq=False)
class Plane:
    """Points with ``normal . X + offset = 0``; ``normal`` has length 1, ``offset`` in mm."""

    normal: Float[np.ndarray, "3"]
    offset: float

    def signed_distance_to(self, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
        """Distance of each point, positive on the side of the normal, mm."""
        return points @ self.normal + self.offset

    def flipped(self) -> "Plane":
        """The same plane with the normal turned round."""
        return Plane(-self.normal, -self.offset)


@dataclass(frozen=True, eq=False)
class Circle:
    """A circle in space: centre, unit normal of its plane, radius (mm)."""

    centre: Float[np.ndarray, "3"]
    normal: Float[np.ndarray, "3"]
    radius: float


@dataclass(frozen=True, eq=False)
class Sphere:
    """Centre and radius (mm)."""

    centre: Float[np.ndarray, "3"]
    radius: float


@dataclass(frozen=True, eq=False)
class Cylinder:
    """An endless cylinder: its axis and radius (mm)."""

    axis: Line
    radius: float


@dataclass(frozen=True)
class SteppedCylinder:
    """The artefact of the article: a small cylinder standing on a large one (figure 5).

    In its own frame (``part``) the axis is z, z = 0 is the bottom of the large cylinder, z points to the small one. Sizes in mm,
    each known to lie within ``tolerance`` of what is stated (0: taken as exact).
    """

    diameter_small: float
    diameter_large: float
    height_small: float
    height_large: float
    tolerance: float = 0.0

    def edge_circles_part(self) -> tuple[Circle, Circle, Circle, Circle]:
        """The four feature circles C1 ... C4 in the ``part`` frame.

        Top edge (r1), inner edge of the step (r1), outer edge of the step (r2), bottom edge (r2), at the heights
        h1 + h2, h2, h2 and 0 (Li et al. 2026, section 4.2 and figure 5).
        """
        z_axis = np.array([0.0, 0.0, 1.0])
        r1, r2 = self.diameter_small / 2, self.diameter_large / 2
        heights = (self.height_small + self.height_large, self.height_large, self.height_large, 0.0)
        c1, c2, c3, c4 = (
            Circle(np.array([0.0, 0.0, z]), z_axis, r) for z, r in zip(heights, (r1, r1, r2, r2), strict=True)
        )
        return c1, c2, c3, c4


@dataclass(frozen=True)
class KnownCylinder:
    """A plain cylinder of known diameter as an artefact; ``height`` (mm) where its top disc may be used too.

    In its own frame (``part``) the axis is z, z = 0 is the bottom. Each size is known to lie within ``tolerance`` (mm).
    """

    diameter: float
    height: float | None = None
    tolerance: float = 0.0


@dataclass(frozen=True)
class KnownSphere:
    """A sphere of known diameter as an artefact, its centre at the origin of its own frame (``part``); mm, within ``tolerance``."""

    diameter: float
    tolerance: float = 0.0


Artifact = SteppedCylinder | KnownCylinder | KnownSphere


@dataclass(frozen=True, eq=False)
class SheetCurvature:
    """How a sheet of light leaves its plane: points X with ``normal . X + offset + (a u^2 + 2 b u v + c v^2) / 2 = 0``.

    ``u, v = e1 . (X - origin), e2 . (X - origin)`` with ``e1, e2 = across(normal)``; ``coefficients`` = (a, b, c) in 1/mm.
    """

    origin: Float[np.ndarray, "3"]
    coefficients: tuple[float, float, float]
