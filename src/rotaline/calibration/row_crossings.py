"""Where a stripe crosses the rows of a dot plate, by cross-ratios alone: eq. (4)-(6).

All lengths on a row are signed and taken in the undistorted image, where rows and stripe are straight. No pose enters: a
cross-ratio is the same on the plate and in its image.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, section 3.2, eq. (4)-(6), figure 3
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from rotaline.calibration.stripe_on_board import PlacedStripe
from rotaline.errors import GeometryError
from rotaline.geometry.fitting_lines import Line2DFit, fit_line_2d
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import DotGrid, TargetDetection

Dots = Literal["row", "triple"]
_MIN_DOTS = 3
_MIN_STRIPE_POINTS = 4


@dataclass(frozen=True, eq=False)
class StripeIntervals:
    """Crossings of one stripe with neighbouring rows (or columns) of a dot plate.

    Attributes
    ----------
    row : (m,)   the first of the two rows
    reference_mm : (m,)   distance of the two crossings, eq. (6)
    first, second : (m, 2)   images of the crossings, normalised coordinates without distortion
    by_columns : bool   True where the stripe runs across columns rather than rows
    """

    row: Int[np.ndarray, " m"]
    reference_mm: Float[np.ndarray, " m"]
    first: Float[np.ndarray, "m 2"]
    second: Float[np.ndarray, "m 2"]
    by_columns: bool


def distance_from_cross_ratio(
    c1: float | Float[np.ndarray, " n"],
    c2: float | Float[np.ndarray, " n"],
    c3: float | Float[np.ndarray, " n"],
    c4: float | Float[np.ndarray, " n"],
    interval_mm: float,
) -> float | Float[np.ndarray, " n"]:
    """Signed distance D2D4 on the plate, from signed positions on the image of a row, eq. (4) and (5).

    ``lambda = (C1C3 / C2C3) / (C1C4 / C2C4)``, ``D2D4 = lambda I / (2 - lambda)``. Numerator and denominator of lambda are kept
    apart, so D4 may lie anywhere, also on a dot. Positive towards D3.

    Examples
    --------
    >>> round(distance_from_cross_ratio(0.0, 1.0, 2.0, 1.5, 6.0), 12)
    3.0
    >>> round(distance_from_cross_ratio(0.0, 1.0, 2.0, 0.0, 6.0), 12)
    -6.0
    """
    numerator = (c3 - c1) * (c4 - c2)
    denominator = (c3 - c2) * (c4 - c1)
    return interval_mm * numerator / (2 * denominator - numerator)


def find_intervals(
    camera: CameraModel, detection: TargetDetection, stripe: PlacedStripe, dots: Dots, window_pitches: float | None
) -> StripeIntervals:
    """Crossings of the stripe with the rows, or with the columns if it crosses these more steeply, and their distances.

    Parameters
    ----------
    camera : CameraModel
    detection : TargetDetection   of a DotGrid
    stripe : PlacedStripe   the points of the stripe that are clear of the dots
    dots : "triple": D2 is the dot nearest to the crossing that has a neighbour on either side, as in [1]_; "row": all dots of
        the row, by the least squares of the same relation (three dots give the same result)
    window_pitches : stripe points this far from the row make the straight piece that crosses it; None: all points

    Returns
    -------
    StripeIntervals   of neighbouring rows that both have a crossing; empty if there are none
    """
    target = detection.target
    assert isinstance(target, DotGrid)
    uv = np.where(stripe.pose.used[:, None], detection.uv, np.nan)
    dots_xy = camera.rays(uv)[:, :2]
    columns, rows = target.dots
    by_columns = bool(abs(stripe.line_board.direction[0]) > abs(stripe.line_board.direction[1]))
    n_lines = columns if by_columns else rows
    line_of = detection.point_ids % columns if by_columns else detection.point_ids // columns
    step_of = detection.point_ids // columns if by_columns else detection.point_ids % columns
    from_row = stripe.xy_board[:, 0 if by_columns else 1] / target.pitch
    whole = fit_line_2d(stripe.xy_undistorted)
    positions = np.full(n_lines, np.nan)
    images = np.full((n_lines, 2), np.nan)
    for m in range(n_lines):
        chosen = (line_of == m) & np.isfinite(dots_xy[:, 0])
        if chosen.sum() < _MIN_DOTS:
            continue
        row_line = fit_line_2d(dots_xy[chosen])
        piece = whole if window_pitches is None else _piece(stripe, from_row - m, window_pitches)
        if piece is None or not from_row.min() - 0.5 < m < from_row.max() + 0.5:
            continue
        crossing = _meet(row_line, piece)
        along = (dots_xy[chosen] - row_line.point) @ row_line.direction
        position = _position_on_row(
            along, step_of[chosen], float((crossing - row_line.point) @ row_line.direction), target.pitch, dots
        )
        if np.isfinite(position):
            positions[m], images[m] = position, crossing
    pairs = np.flatnonzero(np.isfinite(positions[:-1]) & np.isfinite(positions[1:]))
    reference = np.hypot(target.pitch, positions[pairs] - positions[pairs + 1])  # eq. (6)
    return StripeIntervals(pairs, reference, images[pairs], images[pairs + 1], by_columns)


def _piece(stripe: PlacedStripe, from_row: Float[np.ndarray, " n"], window_pitches: float) -> Line2DFit | None:
    """Line through the undistorted stripe points near a row; None unless they stand on both sides of it."""
    near = np.abs(from_row) <= window_pitches
    if near.sum() < _MIN_STRIPE_POINTS or from_row[near].min() > 0.25 or from_row[near].max() < -0.25:
        return None
    try:
        return fit_line_2d(stripe.xy_undistorted[near])
    except GeometryError:
        return None


def _meet(a: Line2DFit, b: Line2DFit) -> Float[np.ndarray, "2"]:
    """Crossing of two lines; they are never parallel here, since the stripe crosses the rows steeply."""
    steps = np.linalg.solve(np.stack([a.direction, -b.direction], axis=1), b.point - a.point)
    return np.asarray(a.point + steps[0] * a.direction)


def _position_on_row(
    along: Float[np.ndarray, " k"], steps: Int[np.ndarray, " k"], c4: float, pitch: float, dots: Dots
) -> float:
    """Position of the crossing on the plate, mm from dot 0 of the row; NaN where the dots do not give one."""
    order = np.argsort(steps)
    along, steps = along[order], steps[order]
    if dots == "row":
        return _projective_position(along, steps * pitch, c4)
    middle = [k for k in range(1, len(steps) - 1) if steps[k + 1] - steps[k] == 1 == steps[k] - steps[k - 1]]
    if not middle:
        return float("nan")
    k = min(middle, key=lambda i: abs(along[i] - c4))
    d2d4 = distance_from_cross_ratio(float(along[k - 1]), float(along[k]), float(along[k + 1]), c4, pitch)
    return float(steps[k] * pitch + d2d4)


def _projective_position(along: Float[np.ndarray, " k"], positions: Float[np.ndarray, " k"], c4: float) -> float:
    """Map of the row to the plate ``X = (a s + b) / (g s + 1)``, which keeps all cross-ratios, by least squares in the image."""
    scale = float(np.abs(along).max())
    s = along / scale
    weights = np.ones(len(s))
    a = b = g = 0.0
    for _ in range(3):
        system = np.stack([s, np.ones(len(s)), -s * positions], axis=1)
        a, b, g = np.linalg.lstsq(system * weights[:, None], positions * weights, rcond=None)[0]
        # the algebraic residual is (g s + 1) dX/ds times the residual in the image
        weights = np.abs((g * s + 1) / (a - b * g))
    x = c4 / scale
    return float((a * x + b) / (g * x + 1))
