"""Detection of a ChArUco board, whole or in part."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from rotaline.errors import DetectionError
from rotaline.vision.targets.grid_map import fit_grid_map_robust, fit_homography
from rotaline.vision.targets.measure import MeasuredGrid, measure_grid, reduce_image
from rotaline.vision.targets.model import CharucoBoard, TargetDetection

_FAMILIES = ("DICT_4X4_1000", "DICT_5X5_1000", "DICT_6X6_1000", "DICT_7X7_1000", "DICT_ARUCO_ORIGINAL")
_FEWEST_CORNERS = 6


def detect_charuco(grey: np.ndarray, target: CharucoBoard, coarse_size_px: int) -> TargetDetection:
    """Find a ChArUco board: markers name the squares, a homography through them the corners, point symmetry measures.

    The board may be partly out of view or covered: two markers and six corners are enough. Both layouts that OpenCV has used
    for boards with an even number of rows are tried.

    Parameters
    ----------
    grey : (h, w)   float32, 0 ... 255
    target : CharucoBoard
    coarse_size_px : int   longer side of the image in which the markers are looked for first

    Raises
    ------
    DetectionError
        If no such board is there; the message says which markers were found instead.
    ValueError
        If OpenCV knows no dictionary of that name.
    """
    number = getattr(cv2.aruco, target.dictionary, None)
    if number is None or not target.dictionary.startswith("DICT_"):
        raise ValueError(f"'{target.dictionary}' is no dictionary of OpenCV; one like 'DICT_5X5_100' is expected.")
    first = max(1, round(max(grey.shape) / coarse_size_px))
    most = 0
    part: DetectionError | None = None
    for scale in _scales(first, grey.size):
        factor = max(1, round(1 / scale))
        numbers, corners = _find_markers(_scaled(grey, scale), int(number))
        most = max(most, len(numbers))
        for legacy in (False, True) if target.squares[1] % 2 == 0 else (False,):
            uv = (corners + 0.5) / scale - 0.5
            agreeing = _agreeing_markers(target, legacy, numbers, uv)
            if agreeing is None:
                continue
            try:
                measured = _measure(grey, target, *agreeing, factor)
            except DetectionError as error:
                part = error
                continue
            return TargetDetection(target, measured.point_ids, measured.uv, measured.u_px)
    if part is not None:
        raise part
    raise DetectionError(_nothing(grey, target, most))


def _scales(first: int, size: int) -> list[float]:
    """Scales of the image to try: reduced as asked, as it is, enlarged by two (small markers)."""
    return [1 / first, *([1.0] if first > 1 else []), *([2.0] if size < 3e6 else [])]


def _scaled(grey: np.ndarray, scale: float) -> np.ndarray:
    if scale > 1:
        return cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    return reduce_image(grey, round(1 / scale))


def _find_markers(image: np.ndarray, dictionary: int) -> tuple[Int[np.ndarray, " k"], Float[np.ndarray, "k 4 2"]]:
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMax = 43
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(dictionary), parameters)
    corners, numbers, _ = detector.detectMarkers(cv2.convertScaleAbs(image))
    if numbers is None or not len(numbers):
        return np.zeros(0, dtype=int), np.zeros((0, 4, 2))
    return numbers.ravel().astype(int), np.concatenate(corners).astype(float)


def _marker_corners(squares: tuple[int, int], side: float, legacy: bool) -> Float[np.ndarray, "k 4 2"]:
    """Corners of the board's markers in units of the pitch, (0, 0) at the first inner corner."""
    columns, rows = squares
    odd = 0 if legacy and rows % 2 == 0 else 1
    j, i = np.nonzero(np.add.outer(np.arange(rows), np.arange(columns)) % 2 == odd)
    centre = np.stack([i - 0.5, j - 0.5], axis=1)
    around = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * side
    return centre[:, None, :] + around


def _agreeing_markers(
    target: CharucoBoard,
    legacy: bool,
    numbers: Int[np.ndarray, " k"],
    uv: Float[np.ndarray, "k 4 2"],
    least: int = 2,
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]] | None:
    """Corners of the markers that agree on one homography: on the board (mm) and in the image; None if there are few."""
    layout = _marker_corners(target.squares, target.marker / target.pitch, legacy) * target.pitch
    known = numbers < len(layout)
    if np.count_nonzero(known) < least:
        return None
    xy, uv = layout[numbers[known]], uv[known]
    best = np.zeros(len(xy), dtype=bool)
    for k in range(len(xy)):  # each marker alone predicts where the others are
        agreeing = np.arange(len(xy)) == k
        for _ in range(5):
            h = fit_homography(xy[agreeing].reshape(-1, 2), uv[agreeing].reshape(-1, 2))
            now = _agreement(h, xy, uv, far=bool(agreeing.sum() < 3))
            if np.array_equal(now, agreeing) or not now.any():
                break
            agreeing = now
        if agreeing.sum() > best.sum():
            best = agreeing
        if best.sum() > 0.8 * len(xy):
            break
    if best.sum() < max(least, 0.4 * len(xy)):
        return None
    return xy[best].reshape(-1, 2), uv[best].reshape(-1, 2)


def _agreement(
    h: Float[np.ndarray, "3 3"], xy: Float[np.ndarray, "k 4 2"], uv: Float[np.ndarray, "k 4 2"], far: bool
) -> Bool[np.ndarray, " k"]:
    """Markers whose corners lie about where the homography puts them; one from a marker or two reaches less far."""
    q = np.concatenate([xy, np.ones((*xy.shape[:2], 1))], axis=2) @ h.T
    with np.errstate(all="ignore"):
        error = np.linalg.norm(q[..., :2] / q[..., 2:] - uv, axis=2).max(axis=1)
    side = np.linalg.norm(uv - np.roll(uv, 1, axis=1), axis=2).mean(axis=1)
    return np.asarray(error < (0.5 if far else 0.3) * side)


def _measure(
    grey: np.ndarray,
    target: CharucoBoard,
    marker_xy: Float[np.ndarray, "n 2"],
    marker_uv: Float[np.ndarray, "n 2"],
    factor: int,
) -> MeasuredGrid:
    """Measure the corners that the markers put into the image, first in the reduced image."""
    points = target.points_board()[:, :2]
    side = float(np.median(np.linalg.norm(marker_uv[1:] - marker_uv[:-1], axis=1)))
    grid_map, _, _ = fit_grid_map_robust(marker_xy, marker_uv, 0.1 * side, max_degree=3 if len(marker_xy) >= 32 else 2)
    uv = grid_map.apply(points)
    with np.errstate(invalid="ignore"):
        front = np.linalg.det(grid_map.jacobian(points)) > 0
    height, width = grey.shape
    ids = np.flatnonzero(front & np.all((uv > 0) & (uv < (width - 1, height - 1)), axis=1))
    if len(ids) < _FEWEST_CORNERS:
        raise DetectionError(_too_few(len(ids)))
    try:
        measured = measure_grid(reduce_image(grey, factor), target, ids, (uv[ids] + 0.5) / factor - 0.5)
    except DetectionError as error:
        raise DetectionError(_too_few(len(ids))) from error
    if factor > 1:
        measured = measure_grid(grey, target, measured.point_ids, (measured.uv + 0.5) * factor - 0.5)
    if len(measured.point_ids) < _FEWEST_CORNERS:
        raise DetectionError(_too_few(len(measured.point_ids)))
    return measured


def _too_few(count: int) -> str:
    return (
        f"The ChArUco board was found, but only {count} of its corners are in view and clear; at least "
        f"{_FEWEST_CORNERS} are needed: show more of the board."
    )


def _nothing(grey: np.ndarray, target: CharucoBoard, most: int) -> str:
    """What is in the image instead of the board."""
    wanted = f"{target.squares[0]} x {target.squares[1]} squares with markers of {target.dictionary}"
    coarse = reduce_image(grey, max(1, round(max(grey.shape) / 1280)))
    if most >= 4:
        numbers, uv = _find_markers(coarse, int(getattr(cv2.aruco, target.dictionary)))
        for columns in range(3, 31):
            rows = 2 * (int(numbers.max(initial=0)) // columns + 1)
            other = CharucoBoard((columns, rows), target.pitch, target.marker, target.dictionary)
            fits = [_agreeing_markers(other, legacy, numbers, uv, least=4) for legacy in (False, True)]
            if columns != target.squares[0] and any(fit is not None for fit in fits):
                return (
                    f"The markers fit a ChArUco board with {columns} squares in a row, {wanted} were expected: "
                    "correct squares in session.toml."
                )
    if most >= 2:
        return f"{most} markers were found, but they do not form a ChArUco board of {wanted}: check squares and marker in session.toml."
    for family in _FAMILIES:
        count = len(_find_markers(coarse, int(getattr(cv2.aruco, family)))[0])
        if count >= 4:
            return (
                f"{count} markers of the family {family} were found, a ChArUco board of {wanted} was expected: "
                "correct dictionary in session.toml."
            )
    return (
        f"No ChArUco board was found ({most} markers); one of {wanted} was expected. Are at least two markers in view?"
    )
