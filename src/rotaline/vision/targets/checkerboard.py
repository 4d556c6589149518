"""Detection of a checkerboard."""

import cv2
import numpy as np

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
    nearly = (0, 0)
    for factor in _factors(first):
        if min(grey.shape) < 20 * factor or (factor == 0 and grey.size > 3e6):
            continue
        coarse = reduce_image(grey, factor) if factor else cv2.resize(grey, None, fx=2, fy=2)

        def measure(ids: np.ndarray, uv: np.ndarray, _: np.ndarray, coarse: np.ndarray = coarse) -> MeasuredGrid:
            scale = coarse.shape[1] / grey.shape[1]
            measured = measure_grid(coarse, target, ids, uv)
            if coarse.shape == grey.shape:
                return measured
            return measure_grid(grey, target, measured.point_ids, (measured.uv + 0.5) / scale - 0.5)

        found, size = locate_grid(find_saddles(coarse), target, measure, max_seeds=400)
        if found is not None:
            return _in_order(target, found)
        if size[0] * size[1] > nearly[0] * nearly[1]:
            nearly = size
    raise DetectionError(_nothing(target, nearly))


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


def _nothing(target: Checkerboard, nearly: tuple[int, int]) -> str:
    columns, rows = target.inner_corners
    wanted = f"{columns} x {rows} inner corners"
    found_columns, found_rows = nearly
    if (found_columns > found_rows) != (columns > rows):
        found_columns, found_rows = found_rows, found_columns
    if found_columns < 2 or found_rows < 2 or found_columns * found_rows < 9:
        return f"No checkerboard was found; one of {wanted} was expected. Is it in view, lit and in focus?"
    return (
        f"A checkerboard of {found_columns} x {found_rows} inner corners was found, {wanted} were expected: "
        "correct inner_corners in session.toml, or show the whole board."
    )
