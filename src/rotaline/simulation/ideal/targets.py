"""Pictures of calibration targets: a posed plate seen through the camera model, integrated over each pixel.

Every pixel is traced back: through the inverse of the lens distortion to a viewing ray, along the ray to the plate, and there
the print is looked up. Pixels that no edge of the print comes near take one sample, the others ``samples`` x ``samples``.
Blur belongs into this integration (``blur_px``): blurring the finished picture cannot undo the aliasing of sharp edges, which
shifts centres by about 0.01 px. Within a pixel the map to the plate is taken as linear, which is exact to 1e-5 px for real lenses.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.transform import RigidTransform
from scipy.special import ndtr

from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid, Target


@dataclass(frozen=True, eq=False)
class TargetPicture:
    """A rendered plate before noise and digitisation.

    Attributes
    ----------
    grey : (h, w)   grey value of the plate, averaged over the part of the pixel that the plate covers; 0 where there is none
    coverage : (h, w)   part of the pixel that the plate covers, 0 to 1
    """

    grey: Float[np.ndarray, "h w"]
    coverage: Float[np.ndarray, "h w"]

    def over(self, background: float | Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
        """The plate in front of a background."""
        return np.asarray(self.grey * self.coverage + background * (1.0 - self.coverage))


def pixel_rays(camera: CameraModel) -> Float[np.ndarray, "h w 2"]:
    """Ideal normalised coordinates of every pixel's centre: the slow half of the tracing, the same for all poses."""
    width, height = camera.image_size
    v, u = np.mgrid[0:height, 0:width]
    uv = np.stack([u.ravel(), v.ravel()], axis=1).astype(float)
    return camera.rays(uv)[:, :2].reshape(height, width, 2)


def plate_size(target: Target, margin: float | None = None) -> tuple[float, float, float, float]:
    """Edges of the plate in the ``board`` frame: x_min, y_min, x_max, y_max, mm.

    ``margin`` is the white rim outside the print; by default one pitch for a checkerboard and for dots (from the outermost
    centre), a quarter for a ChArUco board.
    """
    columns, rows = target.grid_size
    p = target.pitch
    if isinstance(target, DotGrid):
        rim = p if margin is None else margin + (target.diameter or 0.5 * p) / 2
    else:
        rim = p + ((0.25 if isinstance(target, CharucoBoard) else 1.0) * p if margin is None else margin)
    return -rim, -rim, (columns - 1) * p + rim, (rows - 1) * p + rim


@dataclass(frozen=True, eq=False)
class _Cells:
    """Small cells of a pixel: their centres, how wide they are and how far the blur reaches, in one unit of length."""

    xy: Float[np.ndarray, "m 2"]
    width: Float[np.ndarray, "m 2"]
    blur: Float[np.ndarray, "m 2"] | None

    def scaled(self, unit: float) -> "_Cells":
        return _Cells(self.xy / unit, self.width / unit, None if self.blur is None else self.blur / unit)

    def beyond(self, distance: Float[np.ndarray, " m"], axis: int) -> Float[np.ndarray, " m"]:
        """Part of each cell (0 to 1) on the positive side of a straight edge across the axis, after blur."""
        return self._step(distance, self.width[:, axis], None if self.blur is None else self.blur[:, axis])

    def beyond_along(
        self, distance: Float[np.ndarray, " m"], direction: Float[np.ndarray, "m 2"]
    ) -> Float[np.ndarray, " m"]:
        """The same for an edge whose normal is ``direction``."""
        blur = None if self.blur is None else np.linalg.norm(direction * self.blur, axis=1)
        return self._step(distance, np.linalg.norm(direction * self.width, axis=1), blur)

    @staticmethod
    def _step(
        distance: Float[np.ndarray, " m"], width: Float[np.ndarray, " m"], blur: Float[np.ndarray, " m"] | None
    ) -> Float[np.ndarray, " m"]:
        if blur is None:
            return np.clip(distance / np.maximum(width, 1e-12) + 0.5, 0.0, 1.0)
        return np.asarray(ndtr(distance / np.sqrt(blur**2 + width**2 / 12)))


def _squares_dark(columns: int, rows: int, cells: _Cells) -> Float[np.ndarray, " m"]:
    """Print of a checkerboard in units of its pitch; (0, 0) is the first inner corner, the square before it is dark."""
    nearest = np.clip(np.round(cells.xy), 0, (columns - 1, rows - 1))  # the outer edges are no change of colour
    sign = 1 - 2 * np.mod(nearest, 2)
    beyond = cells.xy - nearest
    wave = [sign[:, axis] * (2 * cells.beyond(beyond[:, axis], axis) - 1) for axis in (0, 1)]
    dark = (1.0 + wave[0] * wave[1]) / 2
    for axis, count in ((0, columns), (1, rows)):
        dark *= cells.beyond(cells.xy[:, axis] + 1, axis) * cells.beyond(count - cells.xy[:, axis], axis)
    return dark


def _marker_bits(target: CharucoBoard) -> Int[np.ndarray, "k n n"]:
    """Black (1) and white (0) cells of the board's markers, with their black rim."""
    dictionary = cv2.aruco.getPredefinedDictionary(int(getattr(cv2.aruco, target.dictionary)))
    cells = dictionary.markerSize + 2
    count = (target.squares[0] * target.squares[1]) // 2
    images = [dictionary.generateImageMarker(k, cells) for k in range(count)]
    return (np.stack(images) == 0).astype(int)


def _charuco_dark(
    target: CharucoBoard,
    bits: Int[np.ndarray, "k n n"],
    places: _Cells,
) -> Float[np.ndarray, " m"]:
    columns, rows = target.squares
    xy = places.xy
    dark = _squares_dark(columns - 1, rows - 1, places)
    square = np.floor(xy).astype(int)
    i, j = square[:, 0] + 1, square[:, 1] + 1
    number = np.full((rows, columns), -1)
    light = (np.add.outer(np.arange(rows), np.arange(columns)) % 2) == 1
    number[light] = np.arange(light.sum())
    inside = (i >= 0) & (i < columns) & (j >= 0) & (j < rows)
    marker = np.where(inside, number[np.clip(j, 0, rows - 1), np.clip(i, 0, columns - 1)], -1)
    cells = bits.shape[1]
    side = target.marker / target.pitch
    cell = np.floor((xy - square - (1 - side) / 2) / side * cells).astype(int)
    on = (marker >= 0) & np.all((cell >= 0) & (cell < cells), axis=1)
    dark[on] = bits[marker[on], cell[on, 1], cell[on, 0]]
    return dark


def _dots_dark(target: DotGrid, cells: _Cells) -> Float[np.ndarray, " m"]:
    from_centre = cells.xy - np.clip(np.round(cells.xy), 0, np.array(target.dots) - 1)
    radius = np.linalg.norm(from_centre, axis=1)
    direction = from_centre / np.maximum(radius, 1e-12)[:, None]
    edge = (target.diameter or 0.5 * target.pitch) / 2 / target.pitch
    inside = edge - radius
    if cells.blur is not None:  # blur along a curved edge draws it in, so that the disc keeps its light
        inside = inside - np.sum((direction[:, ::-1] * cells.blur) ** 2, axis=1) / (2 * edge)
    return cells.beyond_along(inside, direction)


def _edge_distance(
    target: Target,
    edges: tuple[float, float, float, float],
    x: Float[np.ndarray, " m"],
    y: Float[np.ndarray, " m"],
) -> Float[np.ndarray, " m"]:
    """Distance to the nearest line where the print may change, mm (a lower bound)."""
    p = target.pitch
    rim = np.minimum(
        np.minimum(np.abs(x - edges[0]), np.abs(x - edges[2])), np.minimum(np.abs(y - edges[1]), np.abs(y - edges[3]))
    )
    to_x, to_y = np.abs(x / p - np.round(x / p)) * p, np.abs(y / p - np.round(y / p)) * p
    if isinstance(target, DotGrid):
        return np.minimum(rim, np.abs(np.hypot(to_x, to_y) - (target.diameter or 0.5 * p) / 2))
    if isinstance(target, CharucoBoard):
        cell = target.marker / (_marker_bits(target).shape[1])
        start = (p - target.marker) / 2
        inner_x, inner_y = (np.mod(x, p) - start) / cell, (np.mod(y, p) - start) / cell
        to_x = np.minimum(to_x, np.abs(inner_x - np.round(inner_x)) * cell)
        to_y = np.minimum(to_y, np.abs(inner_y - np.round(inner_y)) * cell)
    return np.minimum(rim, np.minimum(to_x, to_y))


def render_target(
    camera: CameraModel,
    camera_from_board: RigidTransform,
    target: Target,
    *,
    white: float = 170.0,
    black: float = 15.0,
    margin: float | None = None,
    blur_px: float = 0.0,
    samples: int = 4,
    rays: Float[np.ndarray, "h w 2"] | None = None,
) -> TargetPicture:
    """Render a posed target.

    Parameters
    ----------
    camera : CameraModel
    camera_from_board : RigidTransform   pose of the plate, mm
    target : Target   a dot without a stated diameter is drawn half a pitch wide
    white, black : float   grey values of plate and print (swap them for light dots on a dark plate)
    margin : float or None   rim of the plate outside the print, mm; see :func:`plate_size`
    blur_px : float   blur of the lens, standard deviation in px; it acts before the pixels do, as in a camera
    samples : int   cells a pixel and direction near edges
    rays : (h, w, 2) or None   :func:`pixel_rays` of this camera, to share them between pictures

    Returns
    -------
    TargetPicture   without noise and shading; all zero where the plate is out of view or seen from behind
    """
    width, height = camera.image_size
    grey, coverage = np.zeros((height, width)), np.zeros((height, width))
    edges = plate_size(target, margin)
    matrix = camera_from_board.as_matrix()
    plane_from_ray = np.linalg.inv(matrix[:3, [0, 1, 3]])  # (x, y, 1) * s = plane_from_ray @ ray
    if not matrix[:3, 2] @ matrix[:3, 3] > 0:  # z of the board points away from the viewer when seen from the front
        return TargetPicture(grey, coverage)
    xy_all = pixel_rays(camera) if rays is None else rays

    # the window of pixels that may see the plate
    s = np.linspace(0.0, 1.0, 40)
    rim_x = np.concatenate([edges[0] + s * (edges[2] - edges[0])] * 2 + [np.full(40, edges[0]), np.full(40, edges[2])])
    rim_y = np.concatenate([np.full(40, edges[1]), np.full(40, edges[3])] + [edges[1] + s * (edges[3] - edges[1])] * 2)
    rim = camera.project(camera_from_board.apply(np.column_stack([rim_x, rim_y, np.zeros(160)])))
    if np.all(np.isfinite(rim)):
        u0, v0 = np.maximum(np.floor(rim.min(axis=0)).astype(int) - 2, 0)
        u1, v1 = np.minimum(np.ceil(rim.max(axis=0)).astype(int) + 3, (width, height))
    else:
        u0, v0, u1, v1 = 0, 0, width, height
    if u1 <= u0 or v1 <= v0:
        return TargetPicture(grey, coverage)

    xy = xy_all[v0:v1, u0:u1].reshape(-1, 2)
    with np.errstate(all="ignore"):
        jacobian = np.linalg.inv(camera.distort_jacobian(xy)) / np.array([camera.fx, camera.fy])[None, None, :]
        homogeneous = np.column_stack([xy, np.ones(len(xy))]) @ plane_from_ray.T
        board = homogeneous[:, :2] / homogeneous[:, 2:]
        slope = (plane_from_ray[None, :2, :2] - board[:, :, None] * plane_from_ray[None, 2:, :2]) / homogeneous[
            :, 2, None, None
        ]
        board_per_px = slope @ jacobian
        footprint = (0.75 + 4.0 * blur_px) * np.linalg.norm(board_per_px, axis=(1, 2))
        seen = (homogeneous[:, 2] > 0) & np.all(np.isfinite(board), axis=1)
        seen &= (board[:, 0] > edges[0] - footprint) & (board[:, 0] < edges[2] + footprint)
        seen &= (board[:, 1] > edges[1] - footprint) & (board[:, 1] < edges[3] + footprint)
    indices = np.flatnonzero(seen)
    bits = _marker_bits(target) if isinstance(target, CharucoBoard) else np.zeros((1, 1, 1), dtype=int)

    def look_up(cells: _Cells) -> tuple[np.ndarray, np.ndarray]:
        part = cells.beyond(cells.xy[:, 0] - edges[0], 0) * cells.beyond(edges[2] - cells.xy[:, 0], 0)
        part *= cells.beyond(cells.xy[:, 1] - edges[1], 1) * cells.beyond(edges[3] - cells.xy[:, 1], 1)
        scaled = cells.scaled(target.pitch)
        match target:
            case Checkerboard():
                dark = _squares_dark(*target.grid_size, scaled)
            case CharucoBoard():
                dark = _charuco_dark(target, bits, scaled)
            case DotGrid():
                dark = _dots_dark(target, scaled)
        return part, white + (black - white) * dark

    near = _edge_distance(target, edges, board[indices, 0], board[indices, 1]) < footprint[indices]
    weight, value = look_up(_Cells(board[indices], np.full((len(indices), 2), 1e-9), None))
    fine = indices[near]
    mm_per_px = np.linalg.norm(board_per_px[fine], axis=2)
    blur = mm_per_px * blur_px if blur_px > 0 else None
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    total_weight, total_value = np.zeros(len(fine)), np.zeros(len(fine))
    for dv in offsets:
        for du in offsets:
            part, sample = look_up(
                _Cells(board[fine] + board_per_px[fine] @ np.array([du, dv]), mm_per_px / samples, blur)
            )
            total_weight += part
            total_value += part * sample
    weight[near] = total_weight / samples**2
    value[near] = np.where(total_weight > 0, total_value / np.maximum(total_weight, 1e-12), 0.0)
    flat_grey, flat_coverage = np.zeros(len(xy)), np.zeros(len(xy))
    flat_grey[indices] = value * (weight > 0)
    flat_coverage[indices] = weight
    grey[v0:v1, u0:u1] = flat_grey.reshape(v1 - v0, u1 - u0)
    coverage[v0:v1, u0:u1] = flat_coverage.reshape(v1 - v0, u1 - u0)
    return TargetPicture(grey, coverage)
