"""From a lattice to a measured grid: try the places where the grid may lie and keep the one that the image confirms."""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rotaline.errors import DetectionError
from rotaline.vision.targets.lattice import Candidates, Lattice, grow_lattices, place_grid
from rotaline.vision.targets.measure import LEAST, MeasuredGrid
from rotaline.vision.targets.model import DotGrid, Target

_ENOUGH = 0.8  # of the points: no other place is tried

Measure = Callable[[Target, Int[np.ndarray, " n"], Float[np.ndarray, "n 2"], Int[np.ndarray, " n"]], MeasuredGrid]
"""Measures a target's grid from point numbers, their places in the candidates' image (px) and the candidates' numbers."""


@dataclass(frozen=True, eq=False)
class Attempt:
    """One way to look for a grid: candidate points, and how a grid that was found among them is measured."""

    candidates: Candidates
    measure: Measure


def search_grid(
    attempts: Iterable[Attempt], target: Target, of_size: Callable[[tuple[int, int]], Target]
) -> tuple[MeasuredGrid | None, tuple[int, int] | None]:
    """Look for the grid of a target, one attempt after the other, until it is found nearly complete.

    Parameters
    ----------
    attempts : iterable of Attempt   the cheapest and most promising first
    target : Target
    of_size : function   the same kind of target with another number of columns and rows

    Returns
    -------
    measured : MeasuredGrid or None   the most complete one
    other_size : (columns, rows) or None   of a target that is there instead: seen in two attempts, or in the end the largest
        one seen, and confirmed by measuring it
    """
    total = target.grid_size[0] * target.grid_size[1]
    best: MeasuredGrid | None = None
    largest: tuple[int, tuple[int, int], Attempt] | None = None
    sightings: Counter[tuple[int, ...]] = Counter()
    for attempt in attempts:
        found, size = locate_grid(attempt, target)
        if found is not None and (best is None or len(found.point_ids) > len(best.point_ids)):
            best = found
        if best is not None and len(best.point_ids) >= _ENOUGH * total:
            return best, None
        if best is not None or min(size) < 3 or sorted(size) == sorted(target.grid_size):
            continue
        sightings[tuple(sorted(size))] += 1
        if sightings[tuple(sorted(size))] == 2 and locate_grid(attempt, of_size(size))[0] is not None:
            return None, size
        if largest is None or size[0] * size[1] > largest[0]:
            largest = (size[0] * size[1], size, attempt)
    if best is None and largest is not None and locate_grid(largest[2], of_size(largest[1]))[0] is not None:
        return None, largest[1]
    return best, None


def locate_grid(attempt: Attempt, target: Target) -> tuple[MeasuredGrid | None, tuple[int, int]]:
    """Find the grid of a target among candidate points.

    Returns
    -------
    measured : MeasuredGrid or None   the most complete one
    nearly : (columns, rows)   size of the largest grid that was seen
    """
    best: MeasuredGrid | None = None
    nearly = (0, 0)
    total = target.grid_size[0] * target.grid_size[1]
    candidates = attempt.candidates
    for lattice in grow_lattices(candidates, max(8, min(total // 7, 40))):
        placements, size = place_grid(lattice, target.grid_size, alternating=not isinstance(target, DotGrid))
        if size[0] * size[1] > nearly[0] * nearly[1]:
            nearly = size
        for placement in placements:
            ids, numbers = _points_inside(lattice, placement.grid_of(lattice.cells), target.grid_size)
            try:
                measured = attempt.measure(target, ids, candidates.uv[numbers], numbers)
            except DetectionError:
                continue
            if len(measured.point_ids) < LEAST * total:
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
