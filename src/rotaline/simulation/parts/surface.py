"""What the surfaces of solids have in common: the questions they answer, the box around them, bevelled outlines.

A surface is closed, and is hit from outside only. All lengths in mm, all coordinates in the ``part`` frame of the solid.
"""

from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int

Vectors = Float[np.ndarray, "n 3"]
Distances = Float[np.ndarray, " n"]
Faces = Int[np.ndarray, " n"]
Box = Float[np.ndarray, "2 3"]


@runtime_checkable
class Surface(Protocol):
    """The skin of a solid, without a material; see :class:`rotaline.simulation.parts.shapes.Shape` for what the methods return."""

    def bounds(self) -> Box:
        """Lower and upper corner of a box that holds the whole surface."""
        ...

    def intersect(self, origin: Float[np.ndarray, "3"], directions: Vectors) -> tuple[Distances, Faces]:
        """First entry of each ray."""
        ...

    def contains(self, points: Vectors) -> Bool[np.ndarray, " n"]:
        """Which points are inside; on the surface itself either may come out."""
        ...

    def normals(self, points: Vectors, faces: Faces) -> Vectors:
        """Outward unit normals."""
        ...


def dot_rows(a: Vectors, b: Vectors) -> Distances:
    """Scalar product of each row of a with the same row of b."""
    return np.asarray(a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2])


def box_interval(box: Box, origin: Float[np.ndarray, "3"], directions: Vectors) -> tuple[Distances, Distances]:
    """Where rays enter a box, 0 or more, and where they leave it; they miss it where they would leave it before."""
    t_in, t_out = np.zeros(len(directions)), np.full(len(directions), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        for axis in range(3):
            slope = 1.0 / directions[:, axis]
            t_low, t_high = (box[0, axis] - origin[axis]) * slope, (box[1, axis] - origin[axis]) * slope
            # a ray in the plane of a face gives 0 * inf = nan, which sets no limit: fmax and fmin pass over it
            t_in = np.fmax(t_in, np.minimum(t_low, t_high))
            t_out = np.fmin(t_out, np.maximum(t_low, t_high))
    return t_in, t_out


def meets_box(box: Box, origin: Float[np.ndarray, "3"], directions: Vectors) -> Bool[np.ndarray, " n"]:
    """Which rays touch a box: never False for one that does."""
    t_in, t_out = box_interval(box, origin, directions)
    return np.asarray(t_in <= t_out * (1 + 1e-12))


def require_lengths(shape: str, **lengths_mm: float) -> None:
    """Refuse sizes that are not above zero.

    Raises
    ------
    ValueError
        Names the shape and the size.
    """
    for name, value in lengths_mm.items():
        if not 0.0 < value < np.inf:
            raise ValueError(f"{name} of a {shape} must be above 0 mm, not {value}.")


def bevelled(outline: Float[np.ndarray, "k 2"], corners: tuple[int, ...], leg: float) -> Float[np.ndarray, "m 2"]:
    """Cut corners off an outline: each is replaced by two points, ``leg`` away from it along both of its sides.

    At a right angle this is a chamfer of 45 deg.

    Parameters
    ----------
    outline : (k, 2)   corners in order; closed, or open if its first and last corner are not cut
    corners : which of them to cut
    leg : mm; 0 leaves the outline as it is

    Raises
    ------
    ValueError
        If the leg is negative, or so long that it uses up a side.
    """
    if not 0.0 <= leg < np.inf:
        raise ValueError(f"A chamfer must be 0 mm or more, not {leg}.")
    if leg == 0.0:
        return outline
    n = len(outline)
    for i in range(n):
        following = (i + 1) % n
        side = float(np.linalg.norm(outline[following] - outline[i]))
        used = leg * ((i in corners) + (following in corners))
        if used > 0 and used >= side:
            raise ValueError(f"A chamfer of {leg} mm uses up a side that is {side:.6g} mm long; make it smaller.")
    rows: list[Float[np.ndarray, "2"]] = []
    for i, corner in enumerate(outline):
        if i not in corners:
            rows.append(corner)
            continue
        for neighbour in (outline[i - 1], outline[(i + 1) % n]):
            along = neighbour - corner
            rows.append(corner + leg / np.linalg.norm(along) * along)
    return np.array(rows)
