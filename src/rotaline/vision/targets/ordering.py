"""Which point is which: the symmetries of a target, and how to resolve them.

A grid of dots, and a checkerboard with an even sum of columns and rows, look the same after half a turn; square ones after a
quarter turn too (checkerboards if the number of corners in a row is even). A mirrored order never arises: a target is seen from
the front. From one image the order of a symmetric target is a convention (:func:`canonical`); a laser-off / laser-on pair and
a turntable sequence have more to say (:func:`match_order`, :func:`order_sequence`).
"""

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from rotaline.vision.targets.grid_map import fit_homography
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid, Target, TargetDetection
from rotaline.vision.targets.turning import choose_by_rotation

Permutation = Int[np.ndarray, " n"]
"""``permutation[k]`` is the number that the point with the number k gets."""

_SMALL_STEP_RAD = np.deg2rad(20.0)  # less than half of the smallest angle at which motion misleads (45 deg)
_SEED_GROUPS = 5


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
    return _match(reference, detection, np.zeros(2))


def _match(reference: TargetDetection, detection: TargetDetection, shift: Float[np.ndarray, "2"]) -> TargetDetection:
    """Closest numbering after the points of ``detection`` were moved by ``shift``."""
    best, best_distance = detection, np.inf
    for permutation in symmetry_permutations(detection.target):
        candidate = permuted(detection, permutation)
        _, a, b = np.intersect1d(reference.point_ids, candidate.point_ids, assume_unique=True, return_indices=True)
        if not len(a):
            continue
        distance = float(np.median(np.linalg.norm(reference.uv[a] - candidate.uv[b] - shift, axis=1)))
        if distance < best_distance:
            best, best_distance = candidate, distance
    return best


def order_sequence(
    detections: Sequence[TargetDetection | None], angles_rad: Sequence[float]
) -> tuple[TargetDetection | None, ...]:
    """Number the points of a symmetric target in the same way in all frames of a turntable sequence.

    Frames that are less than 20 deg apart follow each other: the numbering is the one with the least motion about the
    middle of the plate. So the usual sequence, in small steps, falls into one group or a few.

    Groups are joined by the rotation itself. The plate is fixed to the table, so its homography to the image is
    ``H(t) ~ G0 + cos(t) G1 + sin(t) G2`` with constant matrices, whatever the camera, the axis and the sense of the turn;
    and ``G1 + i G2`` has rank one, since all points turn the same way. The right numbering is the one under which one such set
    of matrices explains all frames. Five neighbouring groups are tried in all combinations, the others join one by one. So
    steps may be uneven and wide, as long as there are about five different views.

    With fewer views there is no such test, and every group follows its neighbour by the least motion; that holds for steps
    below half the angle of the symmetry (90 deg; square dot plates 45 deg). The numbering of the whole sequence remains a
    convention: that of its first frame.

    Parameters
    ----------
    detections : n entries   None where nothing was found
    angles_rad : n numbers   angle of the table, of either sense; unsorted, uneven, beyond a full turn

    Returns
    -------
    n entries   None where there was None

    Raises
    ------
    ValueError
        If the two sequences differ in length.
    """
    if len(detections) != len(angles_rad):
        raise ValueError(f"{len(detections)} detections, but {len(angles_rad)} angles.")
    seen = [k for k, d in enumerate(detections) if d is not None]
    found = [d for d in detections if d is not None]
    if not found or len(symmetry_permutations(found[0].target)) == 1:
        return tuple(detections)
    turn = np.mod(np.array([angles_rad[k] for k in seen], dtype=float), 2 * np.pi)
    ordered, groups = _order_by_motion(found, turn)
    if len(groups) > 1 and len(found) >= _SEED_GROUPS:
        ordered = _order_by_rotation(ordered, turn, groups)
    back = next(p for p in symmetry_permutations(found[0].target) if _same(permuted(ordered[0], p), found[0]))
    result: list[TargetDetection | None] = [None] * len(detections)
    for k, detection in zip(seen, ordered, strict=True):
        result[k] = permuted(detection, back)
    return tuple(result)


def _same(a: TargetDetection, b: TargetDetection) -> bool:
    return np.array_equal(a.point_ids, b.point_ids) and bool(np.allclose(a.uv, b.uv))


def _order_by_motion(
    found: list[TargetDetection], turn: Float[np.ndarray, " n"]
) -> tuple[list[TargetDetection], list[list[int]]]:
    """Let every frame follow its neighbour in angle, starting behind the widest gap; and the groups without wide gaps."""
    by_angle = np.argsort(turn, kind="stable")
    gaps = np.mod(np.diff(np.append(turn[by_angle], turn[by_angle[0]] + 2 * np.pi)), 2 * np.pi)
    by_angle = np.roll(by_angle, -(int(np.argmax(gaps)) + 1))
    ordered = list(found)
    groups = [[int(by_angle[0])]]
    for before, now in itertools.pairwise(by_angle.tolist()):
        shift = ordered[before].uv.mean(axis=0) - found[now].uv.mean(axis=0)
        ordered[now] = _match(ordered[before], found[now], shift)
        if np.mod(turn[now] - turn[before], 2 * np.pi) > _SMALL_STEP_RAD:
            groups.append([])
        groups[-1].append(now)
    return ordered, groups


def _order_by_rotation(
    found: list[TargetDetection], turn: Float[np.ndarray, " n"], groups: list[list[int]]
) -> list[TargetDetection]:
    """Renumber whole groups so that one rotation explains all frames; see :func:`order_sequence`."""
    target = found[0].target
    symmetries = symmetry_permutations(target)
    half = np.array([target.grid_size[0] - 1, target.grid_size[1] - 1]) * target.pitch / 2
    places = np.array([[x, y] for y in (-1.0, 0.0, 1.0) for x in (-1.0, 0.0, 1.0)]) * half
    images = np.array([[_images_of(permuted(d, p), places + half) for p in symmetries] for d in found])
    images = (images - images.mean(axis=(0, 1, 2))) / images.std()
    choices = choose_by_rotation(turn, places / half.max(), images, groups, _SEED_GROUPS)
    ordered = list(found)
    for group, choice in zip(groups, choices, strict=True):
        for k in group:
            ordered[k] = permuted(found[k], symmetries[choice])
    return ordered


def _images_of(detection: TargetDetection, places: Float[np.ndarray, "m 2"]) -> Float[np.ndarray, "m 2"]:
    """Images of places on the plate (mm) by the homography of a detection, px."""
    h = fit_homography(detection.points_board[:, :2], detection.uv)
    q = np.column_stack([places, np.ones(len(places))]) @ h.T
    return q[:, :2] / q[:, 2:]
