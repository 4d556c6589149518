"""Detection of a checkerboard."""

from collections.abc import Iterator
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float, Int

from rotaline.errors import DetectionError
from rotaline.vision.targets.locate import Attempt, search_grid
from rotaline.vision.targets.measure import MeasuredGrid, measure_grid, reduce_image
from rotaline.vision.targets.model import Checkerboard, Target, TargetDetection
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
    found, other = search_grid(_attempts(grey, coarse_size_px), target, partial(Checkerboard, pitch=target.pitch))
    if found is not None:
        return _in_order(target, found)
    columns, rows = target.inner_corners
    if other is None:
        raise DetectionError(
            f"No checkerboard was found; one of {columns} x {rows} inner corners was expected. "
            "Is it whole in view, lit and in focus?"
        )
    seen = sorted(other, reverse=columns >= rows)
    raise DetectionError(
        f"A checkerboard of {seen[0]} x {seen[1]} inner corners was found, {columns} x {rows} inner corners were expected: "
        "correct inner_corners in session.toml, or show the whole board."
    )


def _attempts(grey: np.ndarray, coarse_size_px: int) -> Iterator[Attempt]:
    """The reduced image, coarser ones (blur, glare), finer ones (small squares)."""
    for factor in _factors(max(1, round(max(grey.shape) / coarse_size_px))):
        if min(grey.shape) < 20 * factor or (factor == 0 and grey.size > 3e6):
            continue
        coarse = reduce_image(grey, factor) if factor else cv2.resize(grey, None, fx=2, fy=2)
        yield Attempt(find_saddles(coarse), partial(_measure, grey, coarse))


def _measure(
    grey: np.ndarray,
    coarse: np.ndarray,
    target: Target,
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
    """Reductions of the image to try; 0 stands for enlarged by two."""
    finer = [first // k for k in (2, 4, 8) if first // k >= 1]
    return [first, first * 2, *finer, first * 4, 0]


def _in_order(target: Checkerboard, measured: MeasuredGrid) -> TargetDetection:
    """Number the points so that the square before the first corner is dark, where a turn can bring that about."""
    detection = TargetDetection(target, measured.point_ids, measured.uv, measured.u_px)
    columns, rows = target.inner_corners
    if measured.sign > 0 and ((columns + rows) % 2 or (columns == rows and columns % 2)):
        detection = permuted(detection, grid_rotations(target.grid_size)[1])
    return canonical(detection)
