"""Surfaces that are round about z: a sphere, and whatever an outline in (r, z) makes when it turns about the axis."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from rotaline.simulation.parts.surface import Box, Distances, Faces, Vectors, dot_rows

_SEAM_MM = 1e-9
"""How far a face reaches over its edges, so that no ray slips through between two of them."""

_TANGENT = 1e-14
"""A discriminant this little below zero, relative to its terms, is a rounded zero."""


@dataclass(frozen=True)
class SphereSurface:
    """A sphere about (0, 0, ``centre_z``); one face."""

    radius: float
    centre_z: float

    def grown(self, amount: float) -> "SphereSurface":
        """The surface that lies ``amount`` outside of this one."""
        return SphereSurface(self.radius + amount, self.centre_z)

    def bounds(self) -> Box:
        """See :class:`rotaline.simulation.parts.surface.Surface`."""
        r, z = self.radius, self.centre_z
        return np.array([[-r, -r, z - r], [r, r, z + r]])

    def intersect(self, origin: Float[np.ndarray, "3"], directions: Vectors) -> tuple[Distances, Faces]:
        """See :class:`rotaline.simulation.parts.surface.Surface`."""
        o = origin - np.array([0.0, 0.0, self.centre_z])
        a = dot_rows(directions, directions)
        half_b = directions @ o
        # the discriminant as squared distance from the ray: no difference of large numbers
        nearest = o - (half_b / a)[:, None] * directions
        inside = self.radius**2 - dot_rows(nearest, nearest)
        t = (-half_b / a) - np.sqrt(np.maximum(inside, 0.0) / a)
        return np.where((inside > 0) & (t > 0), t, np.inf), np.zeros(len(directions), int)

    def contains(self, points: Vectors) -> Bool[np.ndarray, " n"]:
        """See :class:`rotaline.simulation.parts.surface.Surface`."""
        relative = points - np.array([0.0, 0.0, self.centre_z])
        return dot_rows(relative, relative) < self.radius**2

    def normals(self, points: Vectors, faces: Faces) -> Vectors:
        """See :class:`rotaline.simulation.parts.surface.Surface`."""
        return (points - np.array([0.0, 0.0, self.centre_z])) / self.radius


@dataclass(frozen=True, eq=False)
class RevolutionSurface:
    """The surface that an outline makes when it turns about z.

    Every side of the outline is a face, numbered from the lower end: a disc or ring where z stays, a cylinder where r stays,
    a cone elsewhere.

    Attributes
    ----------
    outline_rz : (k, 2)   corners from the axis at the bottom to the axis at the top: r from 0 to 0, z never falls, mm
    """

    outline_rz: Float[np.ndarray, "k 2"]

    def __post_init__(self) -> None:
        """Refuse outlines that do not close a solid.

        Raises
        ------
        ValueError
            If the outline does not start and end on the axis, goes down, or crosses the axis.
        """
        r, z = self.outline_rz.T
        if len(r) < 3 or r[0] != 0.0 or r[-1] != 0.0 or np.any(r < 0) or np.any(np.diff(z) < 0) or z[0] == z[-1]:
            raise ValueError("An outline must go up from the axis to the axis, with r >= 0 between.")
        if np.any((np.diff(r) == 0) & (np.diff(z) == 0)):
            raise ValueError("An outline must not hold the same corner twice in a row.")

    def _face_normals_rz(self) -> Float[np.ndarray, "f 2"]:
        dr, dz = np.diff(self.outline_rz, axis=0).T
        return np.column_stack([dz, -dr]) / np.hypot(dr, dz)[:, None]

    def grown(self, amount: float) -> "RevolutionSurface":
        """The surface whose radius is larger by ``amount`` everywhere; heights stay."""
        moved = self.outline_rz + np.array([amount, 0.0])
        ends = self.outline_rz[[0, -1]]
        return RevolutionSurface(np.vstack([ends[:1], moved, ends[1:]]))

    def bounds(self) -> Box:
        """See :class:`rotaline.simulation.parts.surface.Surface`."""
        r = float(self.outline_rz[:, 0].max())
        return np.array([[-r, -r, self.outline_rz[0, 1]], [r, r, self.outline_rz[-1, 1]]])

    def intersect(self, origin: Float[np.ndarray, "3"], directions: Vectors) -> tuple[Distances, Faces]:
        """See :class:`rotaline.simulation.parts.surface.Surface`.

        With ``w(z)`` the radius of a cone at z, a ray ``o + t d`` meets it where ``x^2 + y^2 = w(z)^2``:
        ``A t^2 + 2 B t + C = 0``. The ray enters where ``A t + B = -sqrt(B^2 - A C)``: there is one such root.
        """
        ox, oy, oz = (float(o) for o in origin)
        dx, dy, dz = np.ascontiguousarray(directions.T)
        flat_a, flat_b = dx * dx + dy * dy, ox * dx + oy * dy
        t, faces = np.full(len(directions), np.inf), np.zeros(len(directions), int)
        corners = self.outline_rz.tolist()
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            for face, (normal_r, normal_z) in enumerate(self._face_normals_rz().tolist()):
                (r0, z0), (r1, z1) = corners[face], corners[face + 1]
                if normal_r * (np.hypot(ox, oy) - r0) + normal_z * (oz - z0) <= 0:
                    continue  # the ray's origin is behind this face, all around
                if normal_r == 0.0:
                    t_face = (z0 - oz) / dz
                    x, y = ox + t_face * dx, oy + t_face * dy
                    # the outline goes up: who meets a ring within its inner edge has entered above or below before
                    entered = (dz * normal_z < 0) & (x * x + y * y <= (max(r0, r1) + _SEAM_MM) ** 2)
                else:
                    slope = (r1 - r0) / (z1 - z0)
                    w = r0 + slope * (oz - z0)
                    a, b = flat_a - slope**2 * dz * dz, flat_b - slope * w * dz
                    c = ox * ox + oy * oy - w * w
                    square = b * b - a * c
                    root = np.sqrt(np.where(square > -_TANGENT * b * b, np.maximum(square, 0.0), np.nan))
                    # the same root in two ways, each without a difference of like numbers
                    t_face = np.where(b < 0, c / (root - b), -(b + root) / a)
                    z = oz + t_face * dz
                    entered = (z >= z0 - _SEAM_MM) & (z <= z1 + _SEAM_MM)
                entered &= (t_face > 0) & (t_face < t)
                np.copyto(t, t_face, where=entered)
                np.copyto(faces, face, where=entered)
        return t, faces

    def contains(self, points: Vectors) -> Bool[np.ndarray, " n"]:
        """See :class:`rotaline.simulation.parts.surface.Surface`."""
        r, z = self.outline_rz.T
        return np.hypot(points[:, 0], points[:, 1]) < np.interp(points[:, 2], z, r, left=0.0, right=0.0)

    def normals(self, points: Vectors, faces: Faces) -> Vectors:
        """See :class:`rotaline.simulation.parts.surface.Surface`."""
        normals_rz = self._face_normals_rz()[faces]
        r = np.hypot(points[:, 0], points[:, 1])
        on_axis = r == 0.0
        scale = normals_rz[:, 0] / np.where(on_axis, 1.0, r)
        normals = np.column_stack([points[:, 0] * scale, points[:, 1] * scale, normals_rz[:, 1]])
        normals[on_axis, 0] = normals_rz[on_axis, 0]  # at the apex of a cone any of its normals will do
        return normals
