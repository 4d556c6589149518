"""Points in runs of one table angle each, and the plain values that compiled kernels take."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rotaline.geometry.fitting import across
from rotaline.geometry.primitives import Plane, SheetCurvature
from rotaline.scanning.triangulation_kernels import move_runs
from rotaline.vision.camera import CameraModel

_LONGEST = 4096
_RUNS_AT_A_TIME = 128
"""So many runs, none longer than ``_LONGEST`` points, are in memory at a time."""


@dataclass(frozen=True, eq=False)
class Runs:
    """Run k is the points ``starts[k]:starts[k + 1]``, taken when the table had turned by ``turned_rad[k]``."""

    turned_rad: Float[np.ndarray, " f"]
    starts: Int[np.ndarray, " f+1"]


def runs_of_equal(turned_rad: Float[np.ndarray, " n"]) -> Iterator[tuple[slice, Runs]]:
    """Points with their angles as blocks of runs: where in the points a block stands, and its runs, counted from there."""
    n = len(turned_rad)
    if n == 0:
        return
    change = np.flatnonzero(turned_rad[1:] != turned_rad[:-1]) + 1
    starts = np.unique(np.concatenate([change, np.arange(0, n, _LONGEST), [n]]))
    for first in range(0, len(starts) - 1, _RUNS_AT_A_TIME):
        here = starts[first : first + _RUNS_AT_A_TIME + 1]
        yield slice(int(here[0]), int(here[-1])), Runs(turned_rad[here[:-1]], here - here[0])


def moved_by_runs(
    points: Float[np.ndarray, "n 3"], starts: Int[np.ndarray, " s"], poses: Float[np.ndarray, "f 3 4"]
) -> Float[np.ndarray, "n 3"]:
    """Run k, ``points[starts[k]:starts[k + 1]]``, moved by the rigid motion ``poses[k] = [R | t]``."""
    moved = np.empty((len(points), 3))
    move_runs(np.ascontiguousarray(points, dtype=float), starts, poses, moved)
    return moved


def camera_values(camera: CameraModel) -> tuple[float, ...]:
    """``fx, fy, cx, cy, k1, k2, p1, p2, k3``."""
    c = camera
    return tuple(float(value) for value in (c.fx, c.fy, c.cx, c.cy, c.k1, c.k2, c.p1, c.p2, c.k3))


def sheet_values(plane: Plane, curvature: SheetCurvature | None) -> tuple[float, ...]:
    """Normal, offset, directions of ``u`` and ``v``, their origin, coefficients (zeros for a flat sheet): 16 numbers."""
    flat = SheetCurvature(np.zeros(3), (0.0, 0.0, 0.0))
    curvature = flat if curvature is None else curvature
    vectors = (plane.normal, [plane.offset], *across(plane.normal), curvature.origin, curvature.coefficients)
    return tuple(float(value) for vector in vectors for value in vector)
