"""Calibration targets as shapes: thin plates with a printed front.

A plate lies in the target's ``board`` frame (see :mod:`rotaline.vision.targets.model`): z = 0, the front is seen from -z.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from rotaline.simulation.material import Material
from rotaline.vision.targets.model import Checkerboard, DotGrid, Target

WHITE, BLACK, BACK = 0.85, 0.06, 0.3
_MARKER_PX = 16
"""Side of one bit of a ChArUco marker in its bitmap, px."""


@dataclass(frozen=True)
class Plate:
    """A target on a white plate that is ``margin`` mm wider than the print on every side; faces 0 front, 1 back."""

    target: Target
    margin: float = 4.0
    _markers: UInt8[np.ndarray, "..."] | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Draw the bitmap of a ChArUco board; the other targets are formulas."""
        markers = None
        if not isinstance(self.target, Checkerboard | DotGrid):
            t = self.target
            dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, t.dictionary))
            board = cv2.aruco.CharucoBoard(t.squares, t.pitch, t.marker, dictionary)
            bits = dictionary.markerSize + 2
            square_px = max(round(_MARKER_PX * bits * t.pitch / t.marker), 1)
            markers = board.generateImage((t.squares[0] * square_px, t.squares[1] * square_px), None, 0, 1)
        object.__setattr__(self, "_markers", markers)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """x_min, x_max, y_min, y_max of the plate, mm, board frame."""
        columns, rows = self.target.grid_size
        pitch = self.target.pitch
        edge = self.margin + pitch  # checkerboards: one more square around the inner corners
        return -edge, (columns - 1) * pitch + edge, -edge, (rows - 1) * pitch + edge

    def centre_board(self) -> Float[np.ndarray, "3"]:
        """Middle of the plate, mm, board frame."""
        x0, x1, y0, y1 = self.extent
        return np.array([(x0 + x1) / 2, (y0 + y1) / 2, 0.0])

    @property
    def material(self) -> Material:
        """The unprinted front."""
        return Material(WHITE)

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """See :class:`rotaline.simulation.shapes.Shape`."""
        x0, x1, y0, y1 = self.extent
        return np.array([[x0, y0, 0.0], [x1, y1, 0.0]])

    def intersect(
        self, origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        """See :class:`rotaline.simulation.shapes.Shape`."""
        x0, x1, y0, y1 = self.extent
        with np.errstate(divide="ignore", invalid="ignore"):
            t = -origin[2] / directions[:, 2]
            x, y = origin[0] + t * directions[:, 0], origin[1] + t * directions[:, 1]
            hit = (t > 0) & (x > x0) & (x < x1) & (y > y0) & (y < y1)
        return np.where(hit, t, np.inf), np.where(directions[:, 2] > 0, 0, 1)

    def normals(self, points: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """See :class:`rotaline.simulation.shapes.Shape`."""
        normals = np.zeros_like(points)
        normals[:, 2] = np.where(faces == 0, -1.0, 1.0)
        return normals

    def albedo(self, points: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """See :class:`rotaline.simulation.shapes.Shape`."""
        return np.where(faces == 0, np.where(self._dark(points[:, 0], points[:, 1]), BLACK, WHITE), BACK)

    def _dark(self, x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> np.ndarray:
        """Where the print is black."""
        target = self.target
        columns, rows = target.grid_size
        c, r = x / target.pitch, y / target.pitch
        if isinstance(target, DotGrid):
            diameter = target.diameter if target.diameter is not None else target.pitch / 2
            nearest_c, nearest_r = np.clip(np.round(c), 0, columns - 1), np.clip(np.round(r), 0, rows - 1)
            return np.asarray((c - nearest_c) ** 2 + (r - nearest_r) ** 2 < (diameter / target.pitch / 2) ** 2)
        printed = (c > -1) & (c < columns) & (r > -1) & (r < rows)
        if isinstance(target, Checkerboard):
            # the outermost squares at the corner (0, 0) are black
            return np.asarray(printed & ((np.floor(c) + np.floor(r)) % 2 == 0))
        bitmap = self._markers
        assert bitmap is not None
        scale = bitmap.shape[1] / (columns + 1)
        u = np.clip(((c + 1) * scale).astype(int), 0, bitmap.shape[1] - 1)
        v = np.clip(((r + 1) * scale).astype(int), 0, bitmap.shape[0] - 1)
        return np.asarray(printed & (bitmap[v, u] < 128))

    def sizes(self) -> dict[str, float]:
        """See :class:`rotaline.simulation.shapes.Shape`."""
        return {"pitch": self.target.pitch}
