"""From a lattice to a measured grid: try the places where the grid may lie and keep the one that the image confirms."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from rotaline.errors import DetectionError
from rotaline.vision.targets.lattice import Candidates, Lattice, grow_lattices, place_grid
from rotaline.vision.targets.measure import MeasuredGrid
from rotaline.vision.targets.model import DotGrid, Target

_LEAST = 0.6  # of the points of a grid
_ENOUGH = 0.8  # of the points: no other place is tried

Measure = Callable[[Int[np.ndarray, " n"], Float[np.ndarray, "n 2"], Int[np.ndarray, " n"]], MeasuredGrid]
"""Measures a grid from point numbers, their places in the candidates' image (px) and the candidates' numbers."""


def locate_grid(
    candidates: Candidates, target: Target, measure: Measure, max_seeds: int
) -> tuple[MeasuredGrid | None, tuple[int, int]]:
    """Find the grid of a target among candidate points.

    Returns
    -------
    measured : MeasuredGrid or None   the most complete one
    nearly : (columns, rows)   size of the largest grid that was seen
    """
    best: MeasuredGrid | None = None
    nearly = (0, 0)
    total = target.grid_size[0] * target.grid_size[1]
    for lattice in grow_lattices(candidates, max(8, min(total // 7, 40)), max_seeds):
        placements, size = place_grid(lattice, target.grid_size, alternating=not isinstance(target, DotGrid))
        if size[0] * size[1] > nearly[0] * nearly[1]:
            nearly = size
        for placement in placements:
            ids, numbers = _points_inside(lattice, placement.grid_of(lattice.cells), target.grid_size)
            try:
                measured = measure(ids, candidates.uv[numbers], numbers)
            except DetectionError:
                continue
            if len(measured.point_ids) < _LEAST * total:
                continue
            if best is None or len(measured.point_ids) > len(best.point_ids):
                best = measured
            if len(best.point_ids) >= _ENOUGH * total:
                return best, nearly
    return best, nearly


def _points_inside(
    lattice: Lattice, grid: Int[np.ndarray, "n 2"], grid_size: tuple[int, int]
) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Point numbers and candidate numbers of the lattice points that lie in the grid, ascending."""
    columns, rows = grid_size
    inside = np.all((grid >= 0) & (grid < (columns, rows)), axis=1)
    ids = grid[inside, 1] * columns + grid[inside, 0]
    order = np.argsort(ids)
    return ids[order], lattice.ids[inside][order]
