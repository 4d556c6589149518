"""Which piece of a stepped cylinder each point of a stripe lies on.

In the laser plane, in mm, the stripe on a stepped cylinder is a staircase: top disc, small side, step, large side, table
(figure 13 of [1]_). Discs and table are cut in parallel lines at known distances, whatever the mount; the sides are cut in
lines square to them (exactly, if the laser plane is parallel to the axis), at a distance that depends on how far the plane
passes from the cylinder's axis. So the staircase is found by its sizes: neither the rotation axis nor the roll of the camera
needs to be known, and pieces may be missing, broken, or accompanied by reflections.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, section 4.2, figures 5 and 13
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d

from rotaline.geometry.primitives import SteppedCylinder

PIECES = ("top", "small side", "step", "large side", "table")
TOP, SMALL_SIDE, STEP, LARGE_SIDE, TABLE = range(5)

MIN_POINTS = 4
_STEEP = np.radians(25.0)
_N_PEAKS = 4


@dataclass(frozen=True)
class Staircase:
    """Where the staircase lies in the laser plane.

    ``up_rad`` is the direction of up, against x of the plane's coordinates; ``outward`` is +1 if the visible side of the cylinder
    lies clockwise of up (x right when y is up), else -1. The lines of the pieces: ``top`` is the height of the top disc along
    up, ``small`` and ``large`` are the outward positions of the sides (None if not seen), in mm.
    """

    up_rad: float
    outward: int
    top: float
    small: float | None
    large: float | None

    def coordinates(self, xy: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Outward and up coordinates of points of the laser plane, mm."""
        up = np.array([np.cos(self.up_rad), np.sin(self.up_rad)])
        out = self.outward * np.array([up[1], -up[0]])
        return xy @ np.stack([out, up], axis=1)


@dataclass(frozen=True, eq=False)
class IdentifiedProfile:
    """A staircase, the piece of every point (-1: none), and how well it explains the stripe."""

    staircase: Staircase
    piece: Int[np.ndarray, " n"]
    score: float

    @property
    def n_pieces(self) -> int:
        """Number of pieces that were seen."""
        return len(np.unique(self.piece[self.piece >= 0]))


def identify_profile(
    xy: Float[np.ndarray, "n 2"],
    tangent_rad: Float[np.ndarray, " n"],
    artifact: SteppedCylinder,
    tolerance_mm: float,
    up_rad: float | None = None,
    known: Staircase | None = None,
) -> IdentifiedProfile | None:
    """Find the staircase of a stepped cylinder among the points of a stripe.

    Parameters
    ----------
    xy : (n, 2)   points of the stripe in the laser plane, mm
    tangent_rad : (n,)   direction of the stripe there
    artifact : SteppedCylinder   its known sizes
    tolerance_mm : float   how far points may lie from the lines of their piece
    up_rad : float or None   direction of up in the laser plane, within 20 deg, if it is known
    known : Staircase or None   the staircase of other frames of the same mount: same up, outward and top, within the tolerance

    Returns
    -------
    IdentifiedProfile, or None where no three neighbouring pieces (two with ``known``) were seen
    """
    if len(xy) < 3 * MIN_POINTS:
        return None
    best: IdentifiedProfile | None = None
    grid_rad = _main_direction(tangent_rad)
    for up, outward in _orientations(grid_rad, up_rad, known):
        frame = Staircase(up, outward, 0.0, None, None)
        steep = np.abs(np.sin(tangent_rad - up)) < np.sin(_STEEP)
        flat = np.abs(np.cos(tangent_rad - up)) < np.sin(_STEEP)
        points = frame.coordinates(xy)
        for staircase in _candidates(frame, points, flat, steep, artifact, tolerance_mm, known):
            piece = _assign(staircase, points, flat, steep, artifact, tolerance_mm)
            counts = np.bincount(piece[piece >= 0], minlength=5)
            piece[(counts < MIN_POINTS)[piece]] = -1
            counts[counts < MIN_POINTS] = 0
            score = float(np.sqrt(counts).sum())
            run = _longest_run(counts > 0)
            if run >= (3 if known is None else 2) and (best is None or score > best.score):
                best = IdentifiedProfile(staircase, piece, score)
    return best


def _main_direction(tangent_rad: Float[np.ndarray, " n"]) -> float:
    """The direction, modulo a right angle, along or across which most of the stripe runs."""
    quarter = np.pi / 2
    density = np.histogram(np.mod(tangent_rad, quarter), bins=90, range=(0.0, quarter))[0].astype(float)
    peak = (int(np.argmax(gaussian_filter1d(density, 2.0, mode="wrap"))) + 0.5) * quarter / 90
    off = np.mod(tangent_rad - peak + quarter / 2, quarter) - quarter / 2
    near = np.abs(off) < np.radians(6.0)
    return peak + float(np.median(off[near]))


def _orientations(grid_rad: float, up_rad: float | None, known: Staircase | None) -> Iterator[tuple[float, int]]:
    """Directions of up, and sides on which the visible side may lie."""
    if known is not None:
        yield known.up_rad, known.outward
        return
    for quarter in range(4):
        up = grid_rad + quarter * np.pi / 2
        if up_rad is None or np.cos(up - up_rad) > np.cos(np.radians(30.0)):
            yield up, 1
            yield up, -1


def _candidates(
    frame: Staircase,
    points: Float[np.ndarray, "n 2"],
    flat: Bool[np.ndarray, " n"],
    steep: Bool[np.ndarray, " n"],
    artifact: SteppedCylinder,
    tolerance: float,
    known: Staircase | None,
) -> Iterator[Staircase]:
    """Staircases whose flat pieces lie on peaks of the heights, and whose sides lie on peaks of the positions."""
    h1, h2 = artifact.height_small, artifact.height_large
    r1, r2 = artifact.diameter_small / 2, artifact.diameter_large / 2
    narrowest, widest = r2 - r1, float(np.sqrt(r2**2 - r1**2))
    if known is not None:
        tops = [known.top]
    else:
        heights = _peaks(points[flat, 1], tolerance)
        tops = _distinct([height + lift for height in heights for lift in (0.0, h1, h1 + h2)], tolerance / 2)
    for top in tops:
        upper = steep & (points[:, 1] < top + tolerance) & (points[:, 1] > top - h1 - tolerance)
        lower = steep & (points[:, 1] < top - h1 + tolerance) & (points[:, 1] > top - h1 - h2 - tolerance)
        smalls = [*_peaks(points[upper, 0], tolerance), None]
        larges = [*_peaks(points[lower, 0], tolerance), None]
        for small in smalls:
            for large in larges:
                if small is None and large is None:
                    continue
                if (
                    small is not None
                    and large is not None
                    and not narrowest - tolerance < large - small < widest + tolerance
                ):
                    continue
                yield Staircase(frame.up_rad, frame.outward, top, small, large)


def _peaks(values: Float[np.ndarray, " n"], width: float) -> list[float]:
    """Values around which many others lie, densest first."""
    if len(values) < MIN_POINTS:
        return []
    start = float(values.min()) - width
    bins = int(np.ceil((float(values.max()) - start + width) / (width / 4))) + 1
    counts = np.bincount(((values - start) / (width / 4)).astype(int), minlength=bins).astype(float)
    density = gaussian_filter1d(counts, 1.0, mode="constant")
    inside = density[1:-1]
    tops = np.flatnonzero((inside >= density[:-2]) & (inside > density[2:])) + 1
    tops = tops[np.argsort(-density[tops], kind="stable")]
    peaks: list[float] = []
    for top in tops:
        position = start + (top + 0.5) * width / 4
        near = values[np.abs(values - position) < width / 2]
        if len(near) >= MIN_POINTS and all(abs(position - other) > width / 2 for other in peaks):
            peaks.append(float(np.median(near)))
        if len(peaks) == _N_PEAKS:
            break
    return peaks


def _distinct(values: list[float], distance: float) -> list[float]:
    kept: list[float] = []
    for value in values:
        if all(abs(value - other) > distance for other in kept):
            kept.append(value)
    return kept


def _assign(
    staircase: Staircase,
    points: Float[np.ndarray, "n 2"],
    flat: Bool[np.ndarray, " n"],
    steep: Bool[np.ndarray, " n"],
    artifact: SteppedCylinder,
    tolerance: float,
) -> Int[np.ndarray, " n"]:
    """The piece of each point; -1 for points that lie on none."""
    h1, h2 = artifact.height_small, artifact.height_large
    r1, r2 = artifact.diameter_small / 2, artifact.diameter_large / 2
    out, up = points.T
    top, step, bottom = staircase.top, staircase.top - h1, staircase.top - h1 - h2
    # a side that was not seen may lie anywhere that the other side allows
    small_min = small_max = staircase.small
    large_min = large_max = staircase.large
    if small_min is None or small_max is None:
        assert large_min is not None
        small_min, small_max = large_min - float(np.sqrt(r2**2 - r1**2)), large_min - (r2 - r1)
    if large_min is None or large_max is None:
        large_min, large_max = small_min + r2 - r1, small_max + float(np.sqrt(r2**2 - r1**2))

    piece = np.full(len(points), -1)
    piece[flat & (np.abs(up - top) < tolerance) & (out < small_max + tolerance) & (out > small_min - 2 * r1)] = TOP
    piece[flat & (np.abs(up - step) < tolerance) & (out > small_min - tolerance) & (out < large_max + tolerance)] = STEP
    piece[flat & (np.abs(up - bottom) < tolerance) & (out > large_min - tolerance)] = TABLE
    if staircase.small is not None:
        near = steep & (np.abs(out - staircase.small) < tolerance)
        piece[near & (up < top + tolerance) & (up > step - tolerance)] = SMALL_SIDE
    if staircase.large is not None:
        near = steep & (np.abs(out - staircase.large) < tolerance)
        piece[near & (up < step + tolerance) & (up > bottom - tolerance)] = LARGE_SIDE
    return piece


def _longest_run(seen: Bool[np.ndarray, "5"]) -> int:
    longest = run = 0
    for piece_seen in seen:
        run = run + 1 if piece_seen else 0
        longest = max(longest, run)
    return longest
