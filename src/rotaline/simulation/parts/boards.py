"""Calibration targets as shapes: thin plates with a printed front, and the errors of real ones.

A plate lies in the target's ``board`` frame (see :mod:`rotaline.vision.targets.model`): its corners at z = 0, the front is seen from -z.

A real plate differs from its target in three ways. The print has another scale (``pitch_error``), each of its points has an
offset of its own (``print_offset_um``; between the points the print follows bilinearly), and the plate is bowed
(``flatness_um``): a paraboloid, whose crossing with a ray is a quadratic equation. A session states the target, not the plate.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from rotaline.simulation.parts.material import Material
from rotaline.vision.targets.model import Checkerboard, DotGrid, Target

WHITE, BLACK, BACK = 0.85, 0.06, 0.3
"""Albedo of the unprinted front, of the print and of the back."""

PAPER = Material(WHITE)

_MARKER_PX = 16
"""Side of one bit of a ChArUco marker in its bitmap, px."""

_WARP_STEPS = 3
"""Steps to invert the warp of the print; each reduces the error by offset / pitch, below 1e-6 mm for offsets of 1 % of the pitch."""


@dataclass(frozen=True)
class Plate:
    """A target on a white plate that is ``margin`` mm wider than the print on every side; faces 0 front, 1 back.

    Attributes
    ----------
    target : Target   the nominal one, which a session states
    margin : mm
    pitch_error : the whole print, dots included, is larger by this fraction, about the first point
    print_offset_um : standard deviation, in x and in y, of the offset of each point of the print
    print_seed : of these offsets
    flatness_um : how far the middle of the plate stands out, towards the viewer, over its corners; negative: it is hollow
    material : of the unprinted front
    """

    target: Target
    margin: float = 4.0
    pitch_error: float = 0.0
    print_offset_um: float = 0.0
    print_seed: int = 1
    flatness_um: float = 0.0
    material: Material = PAPER
    _offsets: Float[np.ndarray, "rows columns 2"] = field(init=False, repr=False, compare=False)
    _markers: UInt8[np.ndarray, "..."] | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Draw the offsets of the print, and the bitmap of a ChArUco board; the other targets are formulas.

        Raises
        ------
        ValueError
            For a negative margin or standard deviation, or a print so far off that its squares overlap.
        """
        if self.margin < 0 or self.print_offset_um < 0:
            raise ValueError(f"margin and print_offset_um must not be negative: {self.margin}, {self.print_offset_um}.")
        if abs(self.pitch_error) > 0.1:
            raise ValueError(f"pitch_error is a fraction, at most 0.1, not {self.pitch_error}.")
        if self.print_offset_um * 1e-3 > 0.05 * self.target.pitch:
            raise ValueError(
                f"print_offset_um must be at most 5 % of the pitch ({50 * self.target.pitch:g} um), not {self.print_offset_um}."
            )
        columns, rows = self.target.grid_size
        drawn = np.random.default_rng(self.print_seed).standard_normal((rows, columns, 2))
        object.__setattr__(self, "_offsets", self.print_offset_um * 1e-3 * drawn)
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
        pitch = self._pitch
        edge = self.margin + pitch  # checkerboards: one more square around the inner corners
        return -edge, (columns - 1) * pitch + edge, -edge, (rows - 1) * pitch + edge

    @property
    def _pitch(self) -> float:
        """The pitch that was printed, mm."""
        return self.target.pitch * (1.0 + self.pitch_error)

    @property
    def _middle(self) -> Float[np.ndarray, "2"]:
        x0, x1, y0, y1 = self.extent
        return np.array([(x0 + x1) / 2, (y0 + y1) / 2])

    @property
    def _curvature(self) -> float:
        """Half the curvature of the bow, 1/mm: ``z = _curvature * (distance from the middle^2 - half diagonal^2)``."""
        x0, x1, y0, y1 = self.extent
        return self.flatness_um * 1e-3 / (((x1 - x0) / 2) ** 2 + ((y1 - y0) / 2) ** 2)

    def heights(self, xy_board: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """z of the front at these places, mm, board frame."""
        off_middle = xy_board - self._middle
        return np.asarray(self._curvature * (off_middle[:, 0] ** 2 + off_middle[:, 1] ** 2) - self.flatness_um * 1e-3)

    def centre_board(self) -> Float[np.ndarray, "3"]:
        """Middle of the plate, mm, board frame."""
        return np.array([*self._middle, -self.flatness_um * 1e-3])

    def corners_board(self) -> Float[np.ndarray, "4 3"]:
        """The plate's corners, mm, board frame."""
        x0, x1, y0, y1 = self.extent
        return np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]])

    def print_corners_board(self) -> Float[np.ndarray, "4 3"]:
        """The corners of the print: of a checkerboard's squares, or one pitch beyond the dots, mm, board frame."""
        xy = self.corners_board()[:, :2] - self.margin * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        return np.column_stack([xy, self.heights(xy)])

    def bounds(self) -> Float[np.ndarray, "2 3"]:
        """See :class:`rotaline.simulation.parts.shapes.Shape`."""
        x0, x1, y0, y1 = self.extent
        z = -self.flatness_um * 1e-3
        return np.array([[x0, y0, min(z, 0.0)], [x1, y1, max(z, 0.0)]])

    def points_true_board(self) -> Float[np.ndarray, "n 3"]:
        """Where the points of the print truly are, mm, board frame, in the order of ``target.points_board()``."""
        columns, rows = self.target.grid_size
        r, c = np.mgrid[0:rows, 0:columns]
        xy = np.stack([c, r], axis=-1).reshape(-1, 2) * self._pitch + self._offsets.reshape(-1, 2)
        return np.column_stack([xy, self.heights(xy)])

    def intersect(
        self, origin: Float[np.ndarray, "3"], directions: Float[np.ndarray, "n 3"]
    ) -> tuple[Float[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        """See :class:`rotaline.simulation.parts.shapes.Shape`."""
        x0, x1, y0, y1 = self.extent
        k, (x, y) = self._curvature, origin[:2] - self._middle
        dx, dy, dz = directions.T
        # the front is f = z - heights(x, y) = 0; along the ray f is a t^2 + b t + c
        a = -k * (dx * dx + dy * dy)
        b = dz - 2 * k * (x * dx + y * dy)
        c = origin[2] + self.flatness_um * 1e-3 - k * (x * x + y * y)
        t = np.full(len(directions), np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            q = -0.5 * (b + np.copysign(np.sqrt(b * b - 4 * a * c), b))
            # a bowed plate is met twice by rays that almost run along it
            for root in (c / q, q / a) if k else (c / q,):
                at_x, at_y = origin[0] + root * dx, origin[1] + root * dy
                hit = (root > 0) & (root < t) & (at_x > x0) & (at_x < x1) & (at_y > y0) & (at_y < y1)
                t = np.where(hit, root, t)
            rising = 2 * a * t + b  # f grows along a ray that comes from the front
        return t, np.where(rising > 0, 0, 1)

    def normals(self, points: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, " n"]) -> Float[np.ndarray, "n 3"]:
        """See :class:`rotaline.simulation.parts.shapes.Shape`."""
        slopes = 2 * self._curvature * (points[:, :2] - self._middle)
        front = np.column_stack([slopes, np.full(len(points), -1.0)])
        front /= np.sqrt(1.0 + slopes[:, 0] ** 2 + slopes[:, 1] ** 2)[:, None]
        return np.where((faces == 0)[:, None], front, -front)

    def albedo(self, points: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        """See :class:`rotaline.simulation.parts.shapes.Shape`."""
        return np.where(faces == 0, np.where(self._dark(points[:, 0], points[:, 1]), BLACK, self.material.albedo), BACK)

    def _print_places(self, x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> Float[np.ndarray, "2 n"]:
        """Column and row of the print at a place, in pitches from the first point: the inverse of the print's warp."""
        straight = np.stack([x, y]) / self._pitch
        if not self.print_offset_um:
            return straight
        rows, columns, _ = self._offsets.shape
        upper = np.array([[columns - 1], [rows - 1]])
        place = straight
        for _ in range(_WARP_STEPS):
            inside = np.clip(place, 0, upper)
            cell = np.minimum(inside.astype(int), np.maximum(upper - 1, 0))
            (s, t), (i, j) = inside - cell, cell
            i1, j1 = np.minimum(i + 1, columns - 1), np.minimum(j + 1, rows - 1)
            offset = (
                self._offsets[j, i].T * (1 - s) * (1 - t)
                + self._offsets[j, i1].T * s * (1 - t)
                + self._offsets[j1, i].T * (1 - s) * t
                + self._offsets[j1, i1].T * s * t
            )
            place = straight - offset / self._pitch
        return place

    def _dark(self, x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"]) -> np.ndarray:
        """Where the print is black."""
        target = self.target
        columns, rows = target.grid_size
        if isinstance(target, DotGrid):
            # a dot is moved as a whole, it stays round
            diameter = (target.diameter if target.diameter is not None else target.pitch / 2) * (1.0 + self.pitch_error)
            nearest_c = np.clip(np.round(x / self._pitch), 0, columns - 1).astype(int)
            nearest_r = np.clip(np.round(y / self._pitch), 0, rows - 1).astype(int)
            off_x = x - nearest_c * self._pitch - self._offsets[nearest_r, nearest_c, 0]
            off_y = y - nearest_r * self._pitch - self._offsets[nearest_r, nearest_c, 1]
            return np.asarray(off_x**2 + off_y**2 < (diameter / 2) ** 2)
        c, r = self._print_places(x, y)
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
        """See :class:`rotaline.simulation.parts.shapes.Shape`."""
        return {"pitch": self._pitch}
