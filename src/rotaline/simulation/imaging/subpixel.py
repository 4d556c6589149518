"""The light inside a pixel, as that of points in it.

Away from edges light is smooth, and a few rays on a lattice are as good as many. At an edge no lattice is: rows of its points
that run along the edge all jump at once. There, rays go along lines that cross the edge; where two neighbours differ, halving
the distance finds the edge between them, and each cell of the line gets the light of both sides by their lengths. So the light of a
line is exact, and that of a pixel as exact as the mean of its lines.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from rotaline.simulation.imaging.pixels import EVEN_AMBIENT
from rotaline.simulation.imaging.scene import LIT, SHADED, Scene, Seen

_FIBONACCI = (5, 8, 13, 21, 34, 55, 89, 144)
_LINES = 4
"""Lines through a pixel at an edge, and cells of a line."""

_HALVINGS = 5


def lattice_offsets(n_least: int) -> Float[np.ndarray, "n 2"]:
    """Points of a pixel, -0.5 to 0.5, that are spread evenly: a lattice with n different coordinates along u and along v.

    The number is the next one of Fibonacci's, from 8 to 144. The lattice equals its mirror image through the middle.
    """
    k = min(int(np.searchsorted(_FIBONACCI[1:], n_least)) + 1, len(_FIBONACCI) - 1)
    n, step = _FIBONACCI[k], _FIBONACCI[k - 1]
    i = np.arange(n) - (n - 1) / 2
    v = i * step / n
    return np.stack([i / n, v - np.rint(v)], axis=1)


def cell_offsets() -> Float[np.ndarray, "n 2"]:
    """Middles of the cells of a pixel at an edge, row by row."""
    middles = (np.arange(_LINES) + 0.5) / _LINES - 0.5
    u, v = np.meshgrid(middles, middles)
    return np.column_stack([u.ravel(), v.ravel()])


def _within(
    corners_xy: Float[np.ndarray, "m 4 2"], right: Float[np.ndarray, "m *n"], down: Float[np.ndarray, "m *n"]
) -> Float[np.ndarray, "r 2"]:
    """Rays through points of pixels, 0 to 1 from the first corner: linear between the corners, as distortion is in a pixel."""
    shape = (len(right), *(1,) * (right.ndim - 1))
    xy = np.empty((*right.shape, 2))
    for axis in range(2):
        c = [corners_xy[:, k, axis].reshape(shape) for k in range(4)]
        xy[..., axis] = c[0] + right * (c[1] - c[0]) + down * (c[2] - c[0] + right * (c[0] - c[1] - c[2] + c[3]))
    return xy.reshape(-1, 2)


@dataclass(frozen=True, eq=False)
class PixelLight:
    """Light of n points of m pixels, which stand for equal areas.

    Attributes
    ----------
    ambient, laser : (m, n, k)   per unit, divided among k classes of depth
    """

    ambient: Float[np.ndarray, "m n k"]
    laser: Float[np.ndarray, "m n k"]


Shares = Callable[[Float[np.ndarray, " r"]], Float[np.ndarray, "r k"]]
"""How the light of each depth is divided among classes of depth."""


def smooth_light(
    scene: Scene,
    corners_xy: Float[np.ndarray, "m 4 2"],
    offsets: Float[np.ndarray, "n 2"],
    shares: Shares,
    laser_on: bool,
) -> PixelLight:
    """Light of points ``offsets`` px from the middle of pixels with these corners (0, 0), (1, 0), (0, 1), (1, 1)."""
    shape = (len(corners_xy), len(offsets))
    right, down = (np.broadcast_to(along + 0.5, shape) for along in offsets.T)
    seen = scene.seen(_within(corners_xy, right, down), laser_on)
    share = shares(seen.depth_mm)
    return PixelLight(*((light[:, None] * share).reshape(*shape, -1) for light in (seen.ambient, seen.laser)))


def _like_first(seen: Seen, first: Seen, second: Seen) -> Bool[np.ndarray, "*n"]:
    """Whether points look like the first or like the second of two that differ."""
    nearer = np.abs(seen.ambient - first.ambient) <= np.abs(seen.ambient - second.ambient)
    same = (seen.part == first.part) & (seen.state == first.state)
    other = (seen.part == second.part) & (seen.state == second.state)
    return np.where(same == other, nearer, same)


def edge_light(
    scene: Scene,
    corners_xy: Float[np.ndarray, "m 4 2"],
    runs_along_u: Bool[np.ndarray, " m"],
    shares: Shares,
    laser_on: bool,
) -> PixelLight:
    """Light of the cells of pixels that an edge crosses, in the order of :func:`cell_offsets`.

    Parameters
    ----------
    scene : Scene
    corners_xy : (m, 4, 2)   see :func:`smooth_light`
    runs_along_u : (m,)   whether the edge is nearer to a row than to a column: then the lines are columns
    shares : of the depths
    laser_on : see :meth:`Scene.seen`
    """
    shape = (len(corners_xy), _LINES, _LINES + 2)
    # one point more than cells at either end: the edge may be between the last point and the pixel's border
    line, along = np.meshgrid((np.arange(_LINES) + 0.5) / _LINES, (np.arange(_LINES + 2) - 0.5) / _LINES, indexing="ij")
    turned = runs_along_u[:, None, None]

    def rays(pixel: Int[np.ndarray, "*n"], line: Float[np.ndarray, "*n"], along: Float[np.ndarray, "*n"]) -> Seen:
        swap = runs_along_u[pixel]
        return scene.seen(
            _within(corners_xy[pixel], np.where(swap, line, along), np.where(swap, along, line)), laser_on
        )

    pixel = np.broadcast_to(np.arange(len(corners_xy))[:, None, None], shape).ravel()
    seen = rays(pixel, np.broadcast_to(line, shape).ravel(), np.broadcast_to(along, shape).ravel())
    nodes = np.arange(pixel.size).reshape(shape)
    before, after = nodes[:, :, :-1].ravel(), nodes[:, :, 1:].ravel()
    jump = (seen.part[before] != seen.part[after]) | (seen.state[before] * seen.state[after] == LIT * SHADED)
    jump |= np.abs(seen.ambient[before] - seen.ambient[after]) > EVEN_AMBIENT
    before, after = before[jump], after[jump]

    flat_line, flat_along = (np.broadcast_to(values, shape).ravel() for values in (line, along))
    low, high = flat_along[before], flat_along[after]
    first, second = seen.select(before), seen.select(after)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        like_first = _like_first(rays(pixel[before], flat_line[before], middle), first, second)
        low, high = np.where(like_first, middle, low), np.where(like_first, high, middle)
    # the edge is so far, in cells, beyond the border of the two cells
    beyond = ((low + high) / 2 - (flat_along[before] + flat_along[after]) / 2) * _LINES

    share = shares(seen.depth_mm)
    lights = []
    for light in (seen.ambient, seen.laser):
        layers = light[:, None] * share
        shared = layers.copy()
        late, early = beyond > 0, beyond < 0
        step = layers[after] - layers[before]
        shared[after[late]] -= beyond[late, None] * step[late]
        shared[before[early]] -= beyond[early, None] * step[early]
        cells = shared.reshape(*shape, -1)[:, :, 1:-1]
        cells = np.where(turned[..., None], cells.transpose(0, 2, 1, 3), cells)
        lights.append(cells.reshape(len(corners_xy), _LINES**2, -1))
    return PixelLight(*lights)
