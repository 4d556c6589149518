"""Which pixels one ray does not describe: those where faces, parts, prints or shadows meet, and those that the sheet touches.

It is the corners of the pixels that are looked at: a straight edge that crosses a pixel parts its corners.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float, Int

from rotaline.simulation.imaging.scene import LIT, SHADED, Scene, Seen
from rotaline.vision.camera import CameraModel

CHUNK_RAYS = 1 << 15
"""Rays that are worked out together: few enough for the cache."""

EVEN_AMBIENT = 0.01
"""Neighbours whose ambient light differs by less than this (of a white surface) need no more rays."""

_KINK_PX = 0.2


@lru_cache(maxsize=4)
def corner_xy(camera: CameraModel, margin: int) -> Float[np.ndarray, "h w 2"]:
    """Ideal normalised coordinates of the corners of all pixels, and of ``margin`` more pixels on every side."""
    width, height = camera.image_size
    u = np.arange(-margin, width + margin + 1) - 0.5
    rows = [np.column_stack([u, np.full(len(u), v)]) for v in np.arange(-margin, height + margin + 1) - 0.5]
    step = max(CHUNK_RAYS // len(u), 1)
    xy = [camera.rays(np.concatenate(rows[i : i + step]))[:, :2] for i in range(0, len(rows), step)]
    return np.concatenate(xy).reshape(len(rows), len(u), 2)


def seen_at_corners(scene: Scene, xy: Float[np.ndarray, "h w 2"], laser_on: bool) -> Seen:
    """What the corners of all pixels see, as images; in bands of rows, which bounds the memory."""
    height, width = xy.shape[:2]
    kinds = (np.float32, np.float32, np.float32, np.int16, np.int32, np.float32, np.uint8)
    images = Seen(*(np.empty((height, width), kind) for kind in kinds))
    step = max(CHUNK_RAYS // width, 1)
    for row in range(0, height, step):
        band = scene.seen(xy[row : row + step].reshape(-1, 2), laser_on)
        for f in fields(Seen):
            getattr(images, f.name)[row : row + step] = getattr(band, f.name).reshape(-1, width)
    return images


def of_corners(values: np.ndarray, combine: Callable[..., np.ndarray]) -> np.ndarray:
    """Combine the values at the four corners of each pixel."""
    rows = combine(values[:-1], values[1:])
    return combine(rows[:, :-1], rows[:, 1:])


def _differ(values: np.ndarray) -> np.ndarray:
    return np.asarray(of_corners(values, np.maximum) != of_corners(values, np.minimum))


def edge_pixels(corners: Seen, focal_px: float) -> Bool[np.ndarray, "h w"]:
    """Pixels with another part, face or print at one of their corners.

    Faces that go on smoothly into each other, as the triangles of a fine mesh do, are no edge: ``1 / depth`` is linear in
    the image of a plane, so its second differences show jumps and creases.
    """
    nearness = np.where(np.isfinite(corners.depth_mm), 1.0 / corners.depth_mm, np.float32(0.0))
    bend = np.zeros_like(nearness)
    bend[:, 1:-1] = np.abs(nearness[:, :-2] - 2 * nearness[:, 1:-1] + nearness[:, 2:])
    bend[1:-1] = np.maximum(bend[1:-1], np.abs(nearness[:-2] - 2 * nearness[1:-1] + nearness[2:]))
    kink = of_corners(bend > _KINK_PX / focal_px * nearness, np.logical_or)
    uneven = of_corners(corners.ambient, np.maximum) - of_corners(corners.ambient, np.minimum) > EVEN_AMBIENT
    return np.asarray(_differ(corners.part) | uneven | (_differ(corners.face) & kink))


@dataclass(frozen=True, eq=False)
class PixelKinds:
    """Pixels that are not even.

    Attributes
    ----------
    edges : (m, 2)   row, column of pixels that an edge crosses
    edge_runs_along_u : (m,)   whether the edge is nearer to a row of pixels than to a column
    stripe : (k, 2)   row, column of pixels with laser light and without an edge
    """

    edges: Int[np.ndarray, "m 2"]
    edge_runs_along_u: Bool[np.ndarray, " m"]
    stripe: Int[np.ndarray, "k 2"]


def pixel_kinds(corners: Seen, focal_px: float) -> PixelKinds:
    """Sort the pixels by what their corners see."""
    edges = edge_pixels(corners, focal_px)
    lit, shaded = (of_corners(corners.state == state, np.logical_or) for state in (LIT, SHADED))
    crossed = (of_corners(corners.sheet_mm, np.fmin) < 0) & (of_corners(corners.sheet_mm, np.fmax) > 0)
    edges |= lit & shaded
    rows, columns = np.nonzero(edges)

    def differ(dr_1: int, dc_1: int, dr_2: int, dc_2: int) -> Int[np.ndarray, " m"]:
        one, two = (rows + dr_1, columns + dc_1), (rows + dr_2, columns + dc_2)
        other = (corners.part[one] != corners.part[two]) | (corners.state[one] * corners.state[two] == LIT * SHADED)
        return np.asarray(other | (np.abs(corners.ambient[one] - corners.ambient[two]) > EVEN_AMBIENT)).astype(int)

    along_u = differ(0, 0, 0, 1) + differ(1, 0, 1, 1)
    along_v = differ(0, 0, 1, 0) + differ(0, 1, 1, 1)
    return PixelKinds(np.argwhere(edges), along_v > along_u, np.argwhere((lit | shaded | crossed) & ~edges))
