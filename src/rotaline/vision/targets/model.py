"""Calibration targets and what was detected of them.

A target's points lie in its own frame ``board``: z = 0, x along the columns, y along the rows, mm, (0, 0) at the first point,
seen from the front x right, y down (so z points away from the viewer). The order is row by row: point ``r * columns + c``
stands at ``(c * pitch, r * pitch)``.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


def _grid(columns: int, rows: int, pitch: float) -> Float[np.ndarray, "n 3"]:
    r, c = np.mgrid[0:rows, 0:columns]
    return np.stack([c.ravel() * pitch, r.ravel() * pitch, np.zeros(rows * columns)], axis=1)


@dataclass(frozen=True)
class Checkerboard:
    """Checkerboard by its inner corners (columns, rows); pitch in mm."""

    inner_corners: tuple[int, int]
    pitch: float

    @property
    def grid_size(self) -> tuple[int, int]:
        """Columns and rows of the grid of points."""
        return self.inner_corners

    def points_board(self) -> Float[np.ndarray, "n 3"]:
        """All inner corners, mm, in the ``board`` frame."""
        return _grid(*self.inner_corners, self.pitch)


@dataclass(frozen=True)
class DotGrid:
    """Plate of round dots (columns, rows); pitch and dot diameter in mm (diameter None: not stated)."""

    dots: tuple[int, int]
    pitch: float
    diameter: float | None = None

    @property
    def grid_size(self) -> tuple[int, int]:
        """Columns and rows of the grid of points."""
        return self.dots

    def points_board(self) -> Float[np.ndarray, "n 3"]:
        """All dot centres, mm, in the ``board`` frame."""
        return _grid(*self.dots, self.pitch)


@dataclass(frozen=True)
class CharucoBoard:
    """ChArUco board by its squares (columns, rows); square pitch and marker side in mm; OpenCV dictionary name."""

    squares: tuple[int, int]
    pitch: float
    marker: float
    dictionary: str

    @property
    def grid_size(self) -> tuple[int, int]:
        """Columns and rows of the grid of points (the inner corners)."""
        return (self.squares[0] - 1, self.squares[1] - 1)

    def points_board(self) -> Float[np.ndarray, "n 3"]:
        """All inner corners, mm, in the ``board`` frame."""
        return _grid(*self.grid_size, self.pitch)


Target = Checkerboard | DotGrid | CharucoBoard


@dataclass(frozen=True, eq=False)
class TargetDetection:
    """Points of a target found in one image; the whole grid, or (ChArUco) a part of it.

    Attributes
    ----------
    target : Target   what was looked for
    point_ids : (n,)   index into ``target.points_board()``, ascending
    uv : (n, 2)   px; for dots the image of the dot's *centre*, free of the bias of perspective and distortion
    u_px : float   standard uncertainty of a coordinate, as far as the image tells (residual of a smooth map of the grid)
    """

    target: Target
    point_ids: Int[np.ndarray, " n"]
    uv: Float[np.ndarray, "n 2"]
    u_px: float

    @property
    def points_board(self) -> Float[np.ndarray, "n 3"]:
        """The detected points in the ``board`` frame, mm, in the order of ``uv``."""
        return self.target.points_board()[self.point_ids]
