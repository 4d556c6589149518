"""Closed surfaces from rings of points, and small details on them.

A body is a stack of rings, each counter-clockwise seen from above, from the bottom up the outside; it is closed by a point in the
middle of the first and of the last ring, or, for a pipe, by joining the last ring to the first. Details are heights along the
normals of the smooth body, so they look the same on a slanted surface.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from rotaline.simulation.parts.mesh import unit_rows

Rings = Float[np.ndarray, "m n 3"]
Heights = Float[np.ndarray, "m n"]
Spacing = Callable[[Float[np.ndarray, " k"]], Float[np.ndarray, " k"]]
"""The wanted distance between neighbours, at values."""


def graded(start: float, end: float, spacing: Spacing) -> Float[np.ndarray, " n"]:
    """Increasing values from start to end, about ``spacing(value)`` apart."""
    fine = np.linspace(start, end, 4000)
    density = 1.0 / spacing(fine)
    steps = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(fine))])
    return np.interp(np.linspace(0.0, steps[-1], int(np.ceil(steps[-1])) + 1), steps, fine)


def fine_near(coarse: float, fine: float, *places: tuple[float, float]) -> Spacing:
    """A spacing for :func:`graded`: ``fine`` within a half width of some places, ``coarse`` far from them."""

    def spacing(values: Float[np.ndarray, " k"]) -> Float[np.ndarray, " k"]:
        away = np.min([np.maximum(np.abs(values - place) - half, 0.0) for place, half in places], axis=0)
        return np.minimum(coarse, fine + 0.25 * away)

    return spacing


def level(x: float | np.ndarray, y: float | np.ndarray, z: float | np.ndarray) -> Rings:
    """Rings from coordinates that broadcast to (m, n)."""
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1).astype(float)


def round_rings(phi: Float[np.ndarray, " n"], radius: np.ndarray, z: np.ndarray) -> Rings:
    """Rings about the z axis: radius and height broadcast to (m, n)."""
    return level(radius * np.cos(phi), radius * np.sin(phi), z)


def circle(phi: Float[np.ndarray, " n"], radius: float, z: float) -> Float[np.ndarray, "1 n 3"]:
    """One ring about the z axis."""
    return round_rings(phi, np.array([[radius]]), np.array([[z]]))


def between(lower: Float[np.ndarray, "1 n 3"], upper: Float[np.ndarray, "1 n 3"], n_rings: int) -> Rings:
    """Straight lines from one ring to another, without the last ring."""
    s = np.linspace(0.0, 1.0, n_rings, endpoint=False)[:, None, None]
    return np.asarray(lower + s * (upper - lower))


def ring_normals(rings: Rings, pipe: bool = False) -> Rings:
    """Outward unit normals of the surface through the rings."""
    around = np.roll(rings, -1, axis=1) - np.roll(rings, 1, axis=1)
    up = np.roll(rings, -1, axis=0) - np.roll(rings, 1, axis=0) if pipe else np.gradient(rings, axis=0)
    return unit_rows(np.cross(around, up))


def skin(rings: Rings, pipe: bool = False) -> tuple[Float[np.ndarray, "v 3"], Int[np.ndarray, "t 3"]]:
    """Vertices and triangles of the closed surface; the quads between rings are split along their shorter diagonal."""
    m, n, _ = rings.shape
    number = np.arange(m * n).reshape(m, n)
    lower, upper = (number, np.roll(number, -1, axis=0)) if pipe else (number[:-1], number[1:])
    a, b, c, d = (x.ravel() for x in (lower, np.roll(lower, -1, axis=1), np.roll(upper, -1, axis=1), upper))
    vertices = rings.reshape(-1, 3)
    first = np.linalg.norm(vertices[a] - vertices[c], axis=1) <= np.linalg.norm(vertices[b] - vertices[d], axis=1)
    one = np.where(first[:, None], np.stack([a, b, c], axis=1), np.stack([a, b, d], axis=1))
    two = np.where(first[:, None], np.stack([a, c, d], axis=1), np.stack([b, c, d], axis=1))
    triangles = np.concatenate([one, two])
    if pipe:
        return vertices, triangles
    vertices = np.concatenate([vertices, rings[0].mean(axis=0, keepdims=True), rings[-1].mean(axis=0, keepdims=True)])
    first_ring, last_ring = number[0], number[-1]
    below = np.stack([np.roll(first_ring, -1), first_ring, np.full(n, m * n)], axis=1)
    above = np.stack([last_ring, np.roll(last_ring, -1), np.full(n, m * n + 1)], axis=1)
    return vertices, np.concatenate([triangles, below, above])


def plateau(distance: np.ndarray, half_width: float, edge: float) -> np.ndarray:
    """1 within ``half_width``, 0 beyond ``half_width + edge``, a smooth step between."""
    s = np.clip((half_width + edge - np.abs(distance)) / edge, 0.0, 1.0)
    return np.asarray(s * s * (3 - 2 * s))


def half_ball(distance: np.ndarray, radius: float) -> np.ndarray:
    """Height of a half ball over its base, at a distance from its middle."""
    return np.sqrt(np.maximum(radius**2 - distance**2, 0.0))
