"""Which point is which: the symmetries of a target, and how to resolve them.

A grid of dots, and a checkerboard with an even sum of columns and rows, look the same after half a turn; square ones after a
quarter turn too (checkerboards if the number of corners in a row is even). A mirrored order never arises: a target is seen from
the front. From one image the order of a symmetric target is a convention (:func:`canonical`); a laser-off / laser-on pair and
a turntable sequence have more to say (:func:`match_order`, :func:`order_sequence`).
"""

import numpy as np
from jaxtyping import Float, Int

from rotaline.vision.targets.grid_map import fit_homography
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid, Target, TargetDetection

Permutation = Int[np.ndarray, " n"]
"""``permutation[k]`` is the number that the point with the number k gets."""


def grid_rotations(grid_size: tuple[int, int]) -> tuple[Permutation, ...]:
    """Turns of a grid onto itself: identity and half turn; for a square grid also the quarter turns."""
    columns, rows = grid_size
    r, c = np.divmod(np.arange(columns * rows), columns)
    half = (rows - 1 - r) * columns + (columns - 1 - c)
    if columns != rows:
        return np.arange(columns * rows), half
    quarter = (columns - 1 - c) * columns + r
    return np.arange(columns * rows), quarter, half, quarter[half]


def symmetry_permutations(target: Target) -> tuple[Permutation, ...]:
    """Renumberings under which the target looks the same; the identity comes first.

    Examples
    --------
    >>> [len(symmetry_permutations(t)) for t in (Checkerboard((5, 8), 4.0), Checkerboard((6, 8), 4.0), DotGrid((7, 7), 5.0))]
    [1, 2, 4]
    """
    rotations = grid_rotations(target.grid_size)
    if isinstance(target, DotGrid):
        return rotations
    if isinstance(target, CharucoBoard):
        return rotations[:1]
    return tuple(p for k, p in enumerate(rotations) if _keeps_colours(target, k * (4 // len(rotations))))


def _keeps_colours(target: Checkerboard, quarter_turns: int) -> bool:
    columns, rows = target.inner_corners
    if quarter_turns % 2:
        return columns % 2 == 0
    return quarter_turns == 0 or (columns + rows) % 2 == 0


def permuted(detection: TargetDetection, permutation: Permutation) -> TargetDetection:
    """The same points under other numbers (and again in ascending order)."""
    numbers = permutation[detection.point_ids]
    order = np.argsort(numbers)
    return TargetDetection(detection.target, numbers[order], detection.uv[order], detection.u_px)


def canonical(detection: TargetDetection) -> TargetDetection:
    """The order in which the first point of the grid is nearest to the top left of the image (least u + v)."""
    candidates = [permuted(detection, p) for p in symmetry_permutations(detection.target)]
    if len(candidates) == 1:
        return detection
    first_points = [_first_point(c) for c in candidates]
    return candidates[int(np.argmin([p.sum() for p in first_points]))]


def _first_point(detection: TargetDetection) -> Float[np.ndarray, "2"]:
    if detection.point_ids[0] == 0:
        return detection.uv[0]
    h = fit_homography(detection.points_board[:, :2], detection.uv)
    return h[:2, 2] / h[2, 2]


def match_order(reference: TargetDetection, detection: TargetDetection) -> TargetDetection:
    """Number the points of a symmetric target as in another image in which the target stands at the same place.

    Parameters
    ----------
    reference : TargetDetection   for example from the laser-off frame
    detection : TargetDetection   for example from the laser-on frame of the same pose

    Returns
    -------
    TargetDetection   ``detection`` under the symmetry that brings equal numbers closest together
    """
    best, best_distance = detection, np.inf
    for permutation in symmetry_permutations(detection.target):
        candidate = permuted(detection, permutation)
        _, a, b = np.intersect1d(reference.point_ids, candidate.point_ids, assume_unique=True, return_indices=True)
        if not len(a):
            continue
        distance = float(np.median(np.linalg.norm(reference.uv[a] - candidate.uv[b], axis=1)))
        if distance < best_distance:
            best, best_distance = candidate, distance
    return best
