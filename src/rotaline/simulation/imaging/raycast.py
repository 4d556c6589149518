"""Parts in place, and which of them a ray meets first."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import RigidTransform

from rotaline.simulation.parts.shapes import Shape


@dataclass(frozen=True, eq=False)
class Placed:
    """A shape and where it is: ``frame_from_part``, with ``frame`` the table or the base."""

    shape: Shape
    frame_from_part: RigidTransform

    def moved(self, outer_from_frame: RigidTransform) -> "Placed":
        """The same shape, seen from another frame."""
        return Placed(self.shape, outer_from_frame * self.frame_from_part)


@dataclass(frozen=True, eq=False)
class Hits:
    """First hits of rays.

    Attributes
    ----------
    t : (n,)   distance in lengths of the ray; inf: nothing is hit
    part : (n,)   index of the part; -1: nothing
    face : (n,)   number of the part's face
    """

    t: Float[np.ndarray, " n"]
    part: Int[np.ndarray, " n"]
    face: Int[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class PosedPart:
    """A placed shape with its pose as plain arrays: a pose object costs more than the few thousand rays of a chunk.

    Attributes
    ----------
    shape : Shape
    base_from_part : (3, 3)   rotation
    origin_base : (3,)   mm
    box_base : (8, 3)   corners of the box around the shape, mm
    """

    shape: Shape
    base_from_part: Float[np.ndarray, "3 3"]
    origin_base: Float[np.ndarray, "3"]
    box_base: Float[np.ndarray, "8 3"]

    @staticmethod
    def of(part: Placed) -> "PosedPart":
        """The same part."""
        rotation, origin = part.frame_from_part.rotation.as_matrix(), np.asarray(part.frame_from_part.translation)
        bounds = part.shape.bounds()
        corners = np.stack([bounds[pick, [0, 1, 2]] for pick in np.ndindex(2, 2, 2)])
        return PosedPart(part.shape, rotation, origin, corners @ rotation.T + origin)

    def to_part(self, points_base: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
        """Points in the part's frame."""
        return np.asarray((points_base - self.origin_base) @ self.base_from_part)


@dataclass(frozen=True, eq=False)
class View:
    """Parts as seen from a point; its frame is x right, y down, z forward.

    Attributes
    ----------
    parts : of the scene
    origin_base : (3,)   the point, mm
    base_from_view : (3, 3)   rotation
    windows : (k, 2, 2)   of each part, least and largest ``x / z`` and ``y / z`` that it may cover; infinite if it reaches behind the point
    """

    parts: tuple[PosedPart, ...]
    origin_base: Float[np.ndarray, "3"]
    base_from_view: Float[np.ndarray, "3 3"]
    windows: Float[np.ndarray, "k 2 2"]

    @staticmethod
    def of(
        parts: tuple[PosedPart, ...], origin_base: Float[np.ndarray, "3"], base_from_view: Float[np.ndarray, "3 3"]
    ) -> "View":
        """The view of parts from a point."""
        windows = np.empty((len(parts), 2, 2))
        windows[:] = np.array([[-np.inf, -np.inf], [np.inf, np.inf]])
        for window, part in zip(windows, parts, strict=True):
            corners = (part.box_base - origin_base) @ base_from_view
            if corners[:, 2].min() > 1e-6:
                xy = corners[:, :2] / corners[:, 2:]
                window[:] = xy.min(axis=0) - 1e-9, xy.max(axis=0) + 1e-9
        return View(parts, origin_base, base_from_view, windows)

    def directions_base(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
        """Rays ``(x, y, 1)`` of the view, in the base frame."""
        return np.asarray(xy @ self.base_from_view[:, :2].T + self.base_from_view[:, 2])

    def hits(self, xy: Float[np.ndarray, "n 2"], directions_base: Float[np.ndarray, "n 3"] | None = None) -> Hits:
        """What the rays ``(x, y, 1)`` of the view meet first; ``t`` is the depth. A part is asked about its window only.

        Parameters
        ----------
        xy : (n, 2)   in the view's frame
        directions_base : (n, 3)   the same rays in the base frame, where they are known already
        """
        n = len(xy)
        directions = self.directions_base(xy) if directions_base is None else directions_base
        x, y = np.ascontiguousarray(xy.T)
        t, index, faces = np.full(n, np.inf), np.full(n, -1), np.zeros(n, int)
        for i, (part, (low, high)) in enumerate(zip(self.parts, self.windows, strict=True)):
            (rays,) = np.nonzero((x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1]))
            if len(rays) == 0:
                continue
            origin = part.to_part(self.origin_base[None])[0]
            t_part, face_part = part.shape.intersect(origin, directions[rays] @ part.base_from_part)
            nearer = t_part < t[rays]
            rays = rays[nearer]
            t[rays], index[rays], faces[rays] = t_part[nearer], i, face_part[nearer]
        return Hits(t, index, faces)
