"""Detection of a checkerboard."""

from collections.abc import Callable
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float, Int

from rotaline.errors import DetectionError
from rotaline.vision.targets.locate import locate_grid
from rotaline.vision.targets.measure import MeasuredGrid, measure_grid, reduce_image
from rotaline.vision.targets.model import Checkerboard, TargetDetection
from rotaline.vision.targets.ordering import canonical, grid_rotations, permuted
from rotaline.vision.targets.saddles import find_saddles


def detect_checkerboard(grey: np.ndarray, target: Checkerboard, coarse_size_px: int) -> TargetDetection:
    """Find a checkerboard: saddle points, grown to a lattice, measured by point symmetry.

    Parameters
    ----------
    grey : (h, w)   float32, 0 ... 255
    target : Checkerboard
    coarse_size_px : int   longer side of the image in which the corners are looked for first

    Raises
    ------
    DetectionError
        If no board of this size is there; the message says which size was nearly found.
    """
    longer = max(grey.shape)
    first = max(1, round(longer / coarse_size_px))
    nearly = Checkerboard((0, 0), target.pitch)
    confirm: Callable[[], tuple[MeasuredGrid | None, tuple[int, int]]] | None = None
    for factor in _factors(first):
        if min(grey.shape) < 20 * factor or (factor == 0 and grey.size > 3e6):
            continue
        coarse = reduce_image(grey, factor) if factor else cv2.resize(grey, None, fx=2, fy=2)

        candidates = find_saddles(coarse)
        found, size = locate_grid(candidates, target, partial(_measure, grey, coarse, target), 400)
        if found is not None:
            return _in_order(target, found)
        if min(size) >= 3 and size[0] * size[1] > nearly.inner_corners[0] * nearly.inner_corners[1]:
            nearly = Checkerboard(size, target.pitch)
            confirm = partial(locate_grid, candidates, nearly, partial(_measure, grey, coarse, nearly), 400)
    if confirm is not None and confirm()[0] is not None:
        raise DetectionError(_another_size(target, nearly.inner_corners))
    raise DetectionError(
        f"No checkerboard was found; one of {target.inner_corners[0]} x {target.inner_corners[1]} inner corners was expected. "
        "Is it whole in view, lit and in focus?"
    )


def _measure(
    grey: np.ndarray,
    coarse: np.ndarray,
    target: Checkerboard,
    ids: Int[np.ndarray, " n"],
    uv: Float[np.ndarray, "n 2"],
    _: Int[np.ndarray, " n"],
) -> MeasuredGrid:
    """Measure in the image in which the corners were looked for, then in the image itself."""
    measured = measure_grid(coarse, target, ids, uv)
    if coarse.shape == grey.shape:
        return measured
    scale = coarse.shape[1] / grey.shape[1]
    return measure_grid(grey, target, measured.point_ids, (measured.uv + 0.5) / scale - 0.5)


def _factors(first: int) -> list[int]:
    """Reductions of the image to try: as asked, coarser (blur, glare), finer (small squares); 0 = enlarged by two."""
    finer = [first // k for k in (2, 4, 8) if first // k >= 1]
    return [first, first * 2, *finer, first * 4, 0]


def _in_order(target: Checkerboard, measured: MeasuredGrid) -> TargetDetection:
    """Number the points so that the square before the first corner is dark, where a turn can bring that about."""
    detection = TargetDetection(target, measured.point_ids, measured.uv, measured.u_px)
    columns, rows = target.inner_corners
    if measured.sign > 0 and ((columns + rows) % 2 or (columns == rows and columns % 2)):
        detection = permuted(detection, grid_rotations(target.grid_size)[1])
    return canonical(detection)


def _another_size(target: Checkerboard, size: tuple[int, int]) -> str:
    columns, rows = target.inner_corners
    found = sorted(size, reverse=columns >= rows)
    return (
        f"A checkerboard of {found[0]} x {found[1]} inner corners was found, {columns} x {rows} inner corners were expected: "
        "correct inner_corners in session.toml, or show the whole board."
    )
