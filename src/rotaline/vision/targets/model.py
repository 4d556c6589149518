"""Calibration targets and what was detected of them.

A target's points lie in its own frame ``board``: z = 0, x along the columns, y along the rows, mm, (0, 0) at the first point,
seen from the front x right, y down (so z points away from the viewer). The order is row by row: point ``r * columns + c``
stands at ``(c * pitch, r * pitch)``; near it where the target is known to be bent, or its points to be off.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

Bend = tuple[float, float, float]
"""Coefficients (mm) of the height of a bent target, see :func:`bend_basis`."""

FLAT: Bend = (0.0, 0.0, 0.0)

Offsets = tuple[tuple[float, float], ...]
"""How far (mm, along x and y) each point of a target is off its place in the grid; empty for a target without errors."""


def bend_basis(
    grid_size: tuple[int, int], pitch: float, xy_board: Float[np.ndarray, "k 2"]
) -> Float[np.ndarray, "k 3"]:
    """Heights (along z of the ``board`` frame) for unit coefficients of a target's bend.

    The columns are ``x^2, x y, y^2`` of coordinates about the centre of the grid in units of its half diagonal, each less
    the plane that lies nearest over all points of the grid: a bend does not move or tilt the target.

    Parameters
    ----------
    grid_size : columns, rows
    pitch : mm
    xy_board : (k, 2)   mm, where
    """
    upper = np.array([grid_size[0] - 1, grid_size[1] - 1]) * pitch
    r, c = np.mgrid[0 : grid_size[1], 0 : grid_size[0]]
    grid = np.stack([c.ravel(), r.ravel()], axis=1) * pitch

    def terms(xy: Float[np.ndarray, "k 2"]) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
        x, y = (2 * (xy - upper / 2) / np.linalg.norm(upper)).T
        return np.stack([x * x, x * y, y * y], axis=1), np.stack([np.ones_like(x), x, y], axis=1)

    curved, flat = terms(grid)
    plane = np.linalg.lstsq(flat, curved, rcond=None)[0]
    curved, flat = terms(xy_board)
    return np.asarray(curved - flat @ plane)


def _grid(columns: int, rows: int, pitch: float, bend: Bend, offsets: Offsets) -> Float[np.ndarray, "n 3"]:
    r, c = np.mgrid[0:rows, 0:columns]
    points = np.stack([c.ravel() * pitch, r.ravel() * pitch, np.zeros(rows * columns)], axis=1)
    if bend != FLAT:
        points[:, 2] = bend_basis((columns, rows), pitch, points[:, :2]) @ np.array(bend)
    if offsets:
        points[:, :2] += np.array(offsets)
    return points


@dataclass(frozen=True)
class Checkerboard:
    """Checkerboard by its inner corners (columns, rows); pitch in mm."""

    inner_corners: tuple[int, int]
    pitch: float
    bend: Bend = FLAT
    offsets: Offsets = ()

    @property
    def grid_size(self) -> tuple[int, int]:
        """Columns and rows of the grid of points."""
        return self.inner_corners

    def points_board(self) -> Float[np.ndarray, "n 3"]:
        """All inner corners, mm, in the ``board`` frame."""
        return _grid(*self.inner_corners, self.pitch, self.bend, self.offsets)


@dataclass(frozen=True)
class DotGrid:
    """Plate of round dots (columns, rows); pitch and dot diameter in mm (diameter None: not stated)."""

    dots: tuple[int, int]
    pitch: float
    diameter: float | None = None
    bend: Bend = FLAT
    offsets: Offsets = ()

    @property
    def grid_size(self) -> tuple[int, int]:
        """Columns and rows of the grid of points."""
        return self.dots

    def points_board(self) -> Float[np.ndarray, "n 3"]:
        """All dot centres, mm, in the ``board`` frame."""
        return _grid(*self.dots, self.pitch, self.bend, self.offsets)


@dataclass(frozen=True)
class CharucoBoard:
    """ChArUco board by its squares (columns, rows); square pitch and marker side in mm; OpenCV dictionary name."""

    squares: tuple[int, int]
    pitch: float
    marker: float
    dictionary: str
    bend: Bend = FLAT
    offsets: Offsets = ()

    @property
    def grid_size(self) -> tuple[int, int]:
        """Columns and rows of the grid of points (the inner corners)."""
        return (self.squares[0] - 1, self.squares[1] - 1)

    def points_board(self) -> Float[np.ndarray, "n 3"]:
        """All inner corners, mm, in the ``board`` frame."""
        return _grid(*self.grid_size, self.pitch, self.bend, self.offsets)


Target = Checkerboard | DotGrid | CharucoBoard


def target_height(target: Target, xy_board: Float[np.ndarray, "k 2"]) -> Float[np.ndarray, " k"]:
    """Height (mm) of a target's surface over z = 0 of its frame, 0 for a flat one."""
    if target.bend == FLAT:
        return np.zeros(len(xy_board))
    return np.asarray(bend_basis(target.grid_size, target.pitch, xy_board) @ np.array(target.bend))


@dataclass(frozen=True, eq=False)
class TargetDetection:
    """Points of a target found in one image: the whole grid, or the part of it that can be measured.

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
