"""From a grid that was found to measured points: refine every point, find the missing ones, leave out the wrong ones."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int

from rotaline.errors import DetectionError, GeometryError
from rotaline.vision.targets.centres import Centres, refine_centres
from rotaline.vision.targets.grid_map import GridMap, fit_grid_map_robust
from rotaline.vision.targets.model import CharucoBoard, DotGrid, Target

_CORNER_REACH_PX = 18.0  # half a window; farther out a corner's edges add little and cost time
_EDGE_REACH_PX = 4.5  # half the width of the band along an edge that tells where it is
_LEAST_EDGE_REACH_PX = 2.0
_LARGEST_WINDOW_PX = 26.0  # dots that are larger are measured in a reduced image
LEAST = 0.6  # part of a grid's points that must be found
_OUTLIER_FLOOR_PX = 0.05


@dataclass(frozen=True, eq=False)
class MeasuredGrid:
    """Measured points of a grid.

    Attributes
    ----------
    point_ids : (n,)   ascending
    uv : (n, 2)   px
    u_px : float   standard deviation of a coordinate about the smooth map of the grid
    sign : int   corners: +1 if the sector towards +x +y of point 0 is bright, -1 if it is dark; dots: +1 light, -1 dark
    contrast : float   standard deviation of the grey values about a point, median
    grid_map : GridMap   board (mm) to image (px)
    """

    point_ids: Int[np.ndarray, " n"]
    uv: Float[np.ndarray, "n 2"]
    u_px: float
    sign: int
    contrast: float
    grid_map: GridMap


def measure_grid(
    image: np.ndarray,
    target: Target,
    point_ids: Int[np.ndarray, " n"],
    uv: Float[np.ndarray, "n 2"],
    dot_radius: float | None = None,
) -> MeasuredGrid:
    """Measure the points of a grid whose places are known to a pixel or two.

    Parameters
    ----------
    image : (h, w)   grey values
    target : Target
    point_ids, uv : (n,), (n, 2)   points found so far and where, px; the others are looked for where a smooth map predicts them
    dot_radius : float or None   dots: radius found so far, mm

    Raises
    ------
    DetectionError
        If what is in the image is no such grid: too few points have the looks of a corner or dot.
    """
    xy = target.points_board()[:, :2]
    if isinstance(target, DotGrid) and dot_radius is None:
        raise ValueError("dots are measured with a first value of their radius")
    try:
        floor = 0.08 * _typical_step(xy, point_ids, uv, target.pitch)
        grid_map, kept, _ = fit_grid_map_robust(xy[point_ids], uv, floor_px=floor, max_degree=3)
        known = (point_ids[kept], uv[kept])
        found = np.zeros(0, dtype=int), np.zeros((0, 2))
        sign = 0
        rms, contrast = float("nan"), 0.0
        for first in (True, False):
            centres, ids, radius = _measure(image, target, grid_map, known, dot_radius, first)
            good, sign = _acceptable(target, ids, centres)
            needed = 6 if isinstance(target, CharucoBoard) else LEAST * len(xy)
            if np.count_nonzero(good) < max(6, needed):
                raise DetectionError(_few(int(good.sum()), len(ids)))
            contrast = float(np.median(centres.contrast[good]))
            if radius is not None:
                dot_radius = float(np.median(radius[good]))
            grid_map, kept, rms = fit_grid_map_robust(xy[ids[good]], centres.uv[good], floor_px=_OUTLIER_FLOOR_PX)
            found = ids[good][kept], centres.uv[good][kept]
            known = found
    except GeometryError as error:
        raise DetectionError("The points that were found do not form a grid.") from error
    measured = MeasuredGrid(found[0], found[1], rms, sign, contrast, grid_map)
    if not isinstance(target, CharucoBoard):
        _check_rim(image, target, measured, dot_radius)
    return measured


def _check_rim(image: np.ndarray, target: Target, measured: MeasuredGrid, dot_radius: float | None) -> None:
    """A grid ends where it should: its border lines were found, and there is no further line beside them.

    Raises
    ------
    DetectionError
        If not: the grid is misplaced, or the target has another size.
    """
    columns, rows = target.grid_size
    found = np.zeros((rows, columns), dtype=bool)
    found.ravel()[measured.point_ids] = True
    if min(found[0].mean(), found[-1].mean(), found[:, 0].mean(), found[:, -1].mean()) < 0.35:
        raise DetectionError("A border line of the grid is missing.")
    i, j = np.arange(columns), np.arange(rows)
    sides = [
        np.stack([i, np.full(columns, -1)], axis=1),
        np.stack([i, np.full(columns, rows)], axis=1),
        np.stack([np.full(rows, -1), j], axis=1),
        np.stack([np.full(rows, columns), j], axis=1),
    ]
    for side in sides:
        xy = side * target.pitch
        at = measured.grid_map.apply(xy)
        width = image.shape[1]
        inside = np.all((at > 0) & (at < (width - 1, image.shape[0] - 1)), axis=1)
        if inside.sum() < 0.5 * len(side):
            continue
        xy, cells = xy[inside], side[inside]
        centres, _ = _refine(image, target, measured.grid_map, xy, at[inside], dot_radius, False, max_steps=4)
        signs = np.ones(len(cells)) if isinstance(target, DotGrid) else 1 - 2 * (cells.sum(axis=1) % 2)
        good = (centres.agreement * signs * measured.sign > 0.6) & (centres.asymmetry < 0.25)
        good &= centres.contrast > 0.3 * measured.contrast
        if np.count_nonzero(good & np.isfinite(centres.uv[:, 0])) > 0.5 * len(side):
            raise DetectionError("The grid goes on beyond its expected size.")


def _few(good: int, total: int) -> str:
    return f"Only {good} of {total} points have the looks they should have."


def _typical_step(
    xy: Float[np.ndarray, "m 2"], ids: Int[np.ndarray, " n"], uv: Float[np.ndarray, "n 2"], pitch: float
) -> float:
    """Distance of neighbours in the image, px."""
    spread_mm = np.sqrt(np.linalg.det(np.cov(xy[ids].T)))
    spread_px = np.sqrt(np.linalg.det(np.cov(uv.T)))
    if not (spread_mm > 0 and spread_px > 0):
        raise GeometryError("The points lie on a line.")
    return float(pitch * np.sqrt(spread_px / spread_mm))


def _measure(
    image: np.ndarray,
    target: Target,
    grid_map: GridMap,
    known: tuple[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"]],
    dot_radius: float | None,
    first: bool,
) -> tuple[Centres, Int[np.ndarray, " m"], Float[np.ndarray, " m"] | None]:
    """Refine all points of the grid that lie in the image: centres, their numbers, dots: radius of each, mm.

    The ``first`` time corners are looked for in short, wide windows that catch them from farther away.
    """
    xy = target.points_board()[:, :2]
    start = grid_map.apply(xy)
    start[known[0]] = known[1]
    height, width = image.shape
    with np.errstate(invalid="ignore"):
        inside = np.all((start >= 0) & (start <= (width - 1, height - 1)), axis=1)
    ids = np.flatnonzero(inside)
    centres, radius = _refine(image, target, grid_map, xy[ids], start[ids], dot_radius, first)
    return centres, ids, radius


def _refine(
    image: np.ndarray,
    target: Target,
    grid_map: GridMap,
    xy: Float[np.ndarray, "n 2"],
    start: Float[np.ndarray, "n 2"],
    dot_radius: float | None,
    first: bool,
    max_steps: int = 10,
) -> tuple[Centres, Float[np.ndarray, " n"] | None]:
    """Refine points of the plane of the target; see :func:`_measure`."""
    jacobian, bend = grid_map.jacobian(xy), grid_map.bend(xy, 0.1 * target.pitch)
    px_per_mm = np.linalg.norm(jacobian, axis=1).max(axis=1)
    if dot_radius is None:
        reach, edge_reach = 0.45 * target.pitch, _EDGE_REACH_PX * (2 if first else 1)
        if isinstance(target, CharucoBoard):  # up to the cells of the markers, past their black rim
            gap = (target.pitch - target.marker) / 2
            symmetric = gap + 0.1 * target.marker
            reach = symmetric if first else reach
            gap_px = gap * float(np.median(px_per_mm))
            # a marker's blurred rim on one side only would pull the edge away from it
            edge_reach = (
                min(edge_reach, symmetric / gap * gap_px)
                if first
                else max(min(edge_reach, gap_px / 2), _LEAST_EDGE_REACH_PX)
            )
        reaches = np.minimum(reach, _CORNER_REACH_PX / (2 if first else 1) / px_per_mm)
        half, bent = jacobian * reaches[:, None, None], bend * (reaches**2)[:, None, None, None]
        centres = refine_centres(image, start, half, bent, "corner", edge_reach_px=edge_reach, max_steps=max_steps)
        return centres, None
    gap = max(target.pitch - 2 * dot_radius, 0.0)
    wanted = max(1.5 * dot_radius, dot_radius + 2.5 / float(np.median(px_per_mm)))
    window = min(wanted, dot_radius + 0.45 * gap)
    factor = int(np.ceil(np.median(px_per_mm) * window / _LARGEST_WINDOW_PX))
    if factor > 1:
        image = reduce_image(image, factor)
    start = (start + 0.5) / factor - 0.5
    half, bent = jacobian * (window / factor), bend * (window**2 / factor)
    centres = refine_centres(image, start, half, bent, "dot", dot_radius / window, max_steps=max_steps)
    radius = np.sqrt(np.maximum(centres.filled, 0.0) / np.pi) * window
    full = (centres.uv + 0.5) * factor - 0.5
    return Centres(full, centres.asymmetry, centres.contrast, centres.agreement, centres.filled), radius


def _acceptable(target: Target, ids: Int[np.ndarray, " n"], centres: Centres) -> tuple[np.ndarray, int]:
    """Points that look like a corner or dot of this grid, and the grid's sign (see :class:`MeasuredGrid`)."""
    columns = target.grid_size[0]
    finite = np.all(np.isfinite(centres.uv), axis=1) & np.isfinite(centres.agreement)
    if isinstance(target, DotGrid):
        signs = np.ones(len(ids), dtype=int)
    else:
        signs = 1 - 2 * ((ids % columns + ids // columns) % 2)
    agreement = np.where(finite, centres.agreement * signs, 0.0)
    sign = 1 if np.median(agreement[finite]) > 0 else -1 if finite.any() else 1
    good = finite & (agreement * sign > 0.6)
    if not good.any():
        return good, sign
    contrast, asymmetry = centres.contrast, centres.asymmetry
    good &= (contrast > 0.08 * np.median(contrast[good])) & (asymmetry < 0.35)
    if good.any():
        typical = np.median(contrast[good] * asymmetry[good])  # noise in grey values
        good &= asymmetry * contrast < 4.0 * typical + 0.05 * contrast
    return good, sign


def reduce_image(image: np.ndarray, factor: int) -> np.ndarray:
    """Average over squares of ``factor`` pixels; pixel p of the result stands at (p + 0.5) * factor - 0.5 of the image."""
    height, width = (side // factor for side in image.shape)
    cropped = image[: height * factor, : width * factor]
    return cv2.resize(cropped.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
