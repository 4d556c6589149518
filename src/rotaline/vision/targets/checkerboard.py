"""Detection of a checkerboard."""

import cv2
import numpy as np

from rotaline.errors import DetectionError
from rotaline.vision.targets.lattice import Candidates, Lattice, Placement, grow_lattices, place_grid
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
        scale = 1 / factor if factor else 2.0
        candidates = find_saddles(coarse)
        for lattice in grow_lattices(candidates):
            placement, size = place_grid(lattice, target.grid_size, sheared=False)
            if size[0] * size[1] > nearly[0] * nearly[1]:
                nearly = size
            if placement is None:
                continue
            try:
                measured = _measure(grey, coarse, scale, target, candidates, lattice, placement)
            except DetectionError:
                continue
            return _in_order(target, measured)
        if nearly[0] * nearly[1] >= 0.5 * target.grid_size[0] * target.grid_size[1]:
            break
    raise DetectionError(_nothing(target, nearly))


def _factors(first: int) -> list[int]:
    """Reductions of the image to try: as asked, coarser (blur, glare), finer (small squares); 0 = enlarged by two."""
    finer = [first // k for k in (2, 4, 8) if first // k >= 1]
    return [first, first * 2, *finer, first * 4, 0]


def _measure(
    grey: np.ndarray,
    coarse: np.ndarray,
    scale: float,
    target: Checkerboard,
    candidates: Candidates,
    lattice: Lattice,
    placement: Placement,
) -> MeasuredGrid:
    grid = placement.grid_of(lattice.cells)
    columns, rows = target.grid_size
    inside = np.all((grid >= 0) & (grid < (columns, rows)), axis=1)
    ids = grid[inside, 1] * columns + grid[inside, 0]
    order = np.argsort(ids)
    uv = candidates.uv[lattice.ids[inside]][order]
    measured = measure_grid(coarse, target, ids[order], uv)
    if coarse.shape != grey.shape:
        uv = (measured.uv + 0.5) / scale - 0.5
        measured = measure_grid(grey, target, measured.point_ids, uv)
    if len(measured.point_ids) < 0.6 * columns * rows:
        raise DetectionError("Too few corners of the board can be measured.")
    return measured


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
