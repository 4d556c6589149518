"""Detection of a plate of dots."""

from collections.abc import Iterator
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float, Int

from rotaline.errors import DetectionError
from rotaline.vision.targets.blobs import find_blobs
from rotaline.vision.targets.locate import Attempt, search_grid
from rotaline.vision.targets.measure import MeasuredGrid, measure_grid, reduce_image
from rotaline.vision.targets.model import DotGrid, Target, TargetDetection
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
    found, other = search_grid(_attempts(grey, coarse_size_px), target, partial(DotGrid, pitch=target.pitch))
    if found is not None:
        return canonical(TargetDetection(target, found.point_ids, found.uv, found.u_px))
    columns, rows = target.dots
    if other is None:
        raise DetectionError(
            f"No plate of dots was found; one of {columns} x {rows} dots was expected. Is it whole in view, lit and in focus?"
        )
    seen = sorted(other, reverse=columns >= rows)
    raise DetectionError(
        f"A plate of {seen[0]} x {seen[1]} dots was found, {columns} x {rows} dots were expected: "
        "correct dots in session.toml, or show the whole plate."
    )


def _attempts(grey: np.ndarray, coarse_size_px: int) -> Iterator[Attempt]:
    """Dark dots, then light ones, against their surroundings near and far; in the reduced, then in the whole image."""
    first = max(1, round(max(grey.shape) / coarse_size_px))
    for factor in (first, 1) if first > 1 else (1,):
        coarse = cv2.convertScaleAbs(reduce_image(grey, factor))
        for light in (False, True):
            for window in _WINDOWS_PX:
                candidates = find_blobs(coarse, window, light)
                yield Attempt(candidates, partial(_measure, grey, factor, light, candidates.size))


def _measure(
    grey: np.ndarray,
    factor: int,
    light: bool,
    sizes: Float[np.ndarray, " k"],
    target: Target,
    ids: Int[np.ndarray, " n"],
    uv: Float[np.ndarray, "n 2"],
    numbers: Int[np.ndarray, " n"],
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
