"""Detection of a plate of dots."""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float, Int

from rotaline.errors import DetectionError
from rotaline.vision.targets.blobs import find_blobs
from rotaline.vision.targets.locate import locate_grid
from rotaline.vision.targets.measure import MeasuredGrid, measure_grid, reduce_image
from rotaline.vision.targets.model import DotGrid, TargetDetection
from rotaline.vision.targets.ordering import canonical

_WINDOWS_PX = (61, 151, 25, 301)  # surroundings for the threshold; larger than two dots


def detect_dots(grey: np.ndarray, target: DotGrid, coarse_size_px: int) -> TargetDetection:
    """Find a plate of dots: blobs, grown to a lattice, measured by point symmetry.

    Dark dots on a light plate are looked for first, then light ones on a dark plate. The radius of the dots is measured in the
    image: what blur and exposure made of it is what perspective acts upon.

    Parameters
    ----------
    grey : (h, w)   float32, 0 ... 255
    target : DotGrid
    coarse_size_px : int   longer side of the image in which the dots are looked for first

    Raises
    ------
    DetectionError
        If no plate of this size is there; the message says which size was nearly found.
    """
    first = max(1, round(max(grey.shape) / coarse_size_px))
    best: MeasuredGrid | None = None
    nearly = DotGrid((0, 0), target.pitch)
    confirm: Callable[[], tuple[MeasuredGrid | None, tuple[int, int]]] | None = None
    for factor in (first, 1) if first > 1 else (1,):
        coarse = cv2.convertScaleAbs(reduce_image(grey, factor))
        for light in (False, True):
            for window in _WINDOWS_PX:
                candidates = find_blobs(coarse, window, light)
                measure = partial(_measure, grey, factor, light, candidates.size)
                found, size = locate_grid(candidates, target, partial(measure, target=target), 150)
                if found is not None and (best is None or len(found.point_ids) > len(best.point_ids)):
                    best = found
                if best is not None and len(best.point_ids) > 0.8 * target.dots[0] * target.dots[1]:
                    return canonical(TargetDetection(target, best.point_ids, best.uv, best.u_px))
                if min(size) >= 3 and size[0] * size[1] > nearly.dots[0] * nearly.dots[1]:
                    nearly = DotGrid(size, target.pitch)
                    confirm = partial(locate_grid, candidates, nearly, partial(measure, target=nearly), 150)
    if best is not None:
        return canonical(TargetDetection(target, best.point_ids, best.uv, best.u_px))
    if confirm is not None and confirm()[0] is not None:
        raise DetectionError(_another_size(target, nearly.dots))
    raise DetectionError(
        f"No plate of dots was found; one of {target.dots[0]} x {target.dots[1]} dots was expected. "
        "Is it whole in view, lit and in focus?"
    )


def _measure(
    grey: np.ndarray,
    factor: int,
    light: bool,
    sizes: Float[np.ndarray, " k"],
    ids: Int[np.ndarray, " n"],
    uv: Float[np.ndarray, "n 2"],
    numbers: Int[np.ndarray, " n"],
    target: DotGrid,
) -> MeasuredGrid:
    """Measure the dots, starting with the radius (mm) that the areas of the blobs tell."""
    spread_mm, spread_px = np.cov(target.points_board()[ids, :2].T), np.cov(uv.T)
    with np.errstate(all="ignore"):
        area_scale = np.sqrt(np.linalg.det(spread_px) / np.linalg.det(spread_mm))  # px^2 a mm^2
        radius = float(np.sqrt(np.median(sizes[numbers]) / np.pi / area_scale))
    if not np.isfinite(radius) or radius == 0.0:
        raise DetectionError("The dots that were found lie on a line.")
    measured = measure_grid(grey, target, ids, (uv + 0.5) * factor - 0.5, min(radius, 0.45 * target.pitch))
    if (measured.sign > 0) != light:
        raise DetectionError("The dots have the wrong brightness.")
    return measured


def _another_size(target: DotGrid, size: tuple[int, int]) -> str:
    columns, rows = target.dots
    found = sorted(size, reverse=columns >= rows)
    return (
        f"A plate of {found[0]} x {found[1]} dots was found, {columns} x {rows} dots were expected: "
        "correct dots in session.toml, or show the whole plate."
    )
