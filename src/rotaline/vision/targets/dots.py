"""Detection of a plate of dots."""

import cv2
import numpy as np

from rotaline.errors import DetectionError
from rotaline.vision.targets.blobs import find_blobs
from rotaline.vision.targets.lattice import Candidates, Lattice, Placement, grow_lattices, place_grid
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
    nearly = (0, 0)
    for factor in (first, 1) if first > 1 else (1,):
        coarse = reduce_image(grey, factor)
        coarse8 = cv2.convertScaleAbs(coarse)
        for light in (False, True):
            for window in _WINDOWS_PX:
                candidates = find_blobs(coarse8, window, light)
                for lattice in grow_lattices(candidates, max_seeds=150):
                    placement, size = place_grid(lattice, target.grid_size, sheared=True)
                    if size[0] * size[1] > nearly[0] * nearly[1]:
                        nearly = size
                    if placement is None:
                        continue
                    try:
                        measured = _measure(grey, factor, target, candidates, lattice, placement, light)
                    except DetectionError:
                        continue
                    return canonical(TargetDetection(target, measured.point_ids, measured.uv, measured.u_px))
    raise DetectionError(_nothing(target, nearly))


def _measure(
    grey: np.ndarray,
    factor: int,
    target: DotGrid,
    candidates: Candidates,
    lattice: Lattice,
    placement: Placement,
    light: bool,
) -> MeasuredGrid:
    grid = placement.grid_of(lattice.cells)
    columns, rows = target.grid_size
    inside = np.all((grid >= 0) & (grid < (columns, rows)), axis=1)
    ids = grid[inside, 1] * columns + grid[inside, 0]
    order = np.argsort(ids)
    blobs = lattice.ids[inside][order]
    uv, ids = (candidates.uv[blobs] + 0.5) * factor - 0.5, ids[order]
    step_area = abs(float(np.linalg.det(np.cov(uv.T)) / np.linalg.det(np.cov(target.points_board()[ids, :2].T)))) ** 0.5
    radius = float(np.sqrt(np.median(candidates.size[blobs]) * factor**2 / np.pi / step_area))
    measured = measure_grid(grey, target, ids, uv, min(radius, 0.45 * target.pitch))
    if (measured.sign > 0) != light or len(measured.point_ids) < 0.6 * columns * rows:
        raise DetectionError("Too few dots of the plate can be measured.")
    return measured


def _nothing(target: DotGrid, nearly: tuple[int, int]) -> str:
    columns, rows = target.dots
    wanted = f"{columns} x {rows} dots"
    found_columns, found_rows = nearly
    if (found_columns > found_rows) != (columns > rows):
        found_columns, found_rows = found_rows, found_columns
    if found_columns < 3 or found_rows < 3:
        return f"No plate of dots was found; one of {wanted} was expected. Is it in view, lit and in focus?"
    return (
        f"A plate of {found_columns} x {found_rows} dots was found, {wanted} were expected: "
        "correct dots in session.toml, or show the whole plate."
    )
