"""Which pieces of what was found are the stripe, in compiled loops. See :mod:`rotaline.vision.stripe.pieces`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.chain_kernels import median_of, starts_of

LEAST_PART = 0.25  # of the usual height; of the greatest in a piece: what fades out is no length
SLENDER = 5.0  # widths: a spot of light is not as long
NEAR_PX = 20.0
ALIKE = 1.5  # ratio of widths


@compiled
@no_type_check
def medians(values: np.ndarray, segment: np.ndarray) -> np.ndarray:
    """Median of a value over each segment; the points of a segment stand together, in ascending order."""
    starts = starts_of(segment)
    scratch, out = np.empty(len(values)), np.empty(len(starts) - 1)
    for c in range(len(starts) - 1):
        m = starts[c + 1] - starts[c]
        scratch[:m] = values[starts[c] : starts[c + 1]]
        out[c] = median_of(scratch, m)
    return out


@compiled
@no_type_check
def points_together(uv: np.ndarray, segment: np.ndarray, fits: np.ndarray, least: float, reach_px: float) -> np.ndarray:
    """Number of points of each segment that ``fits``, and of those that fit and are near to it, or to one that is; 0 for the others.

    Near: a point of one is less than ``reach_px`` from a point of the other. Segments of ``least`` points are not asked which of them are near.
    """
    starts = starts_of(segment)
    n = len(starts) - 1
    group = np.arange(n)
    for a in range(n):
        if not fits[a] or starts[a + 1] - starts[a] >= least:
            continue
        for b in range(n):
            if not fits[b] or group[a] == group[b]:
                continue
            near = False
            for j in range(starts[b], starts[b + 1]):
                for i in range(starts[a], starts[a + 1]):
                    du, dv = uv[i, 0] - uv[j, 0], uv[i, 1] - uv[j, 1]
                    near |= du * du + dv * dv <= reach_px * reach_px
                if near:
                    break
            if near:
                one, other = group[a], group[b]
                for c in range(n):
                    if group[c] == other:
                        group[c] = one
    total = np.zeros(n, np.int64)
    for c in range(n):
        if fits[c]:
            total[group[c]] += starts[c + 1] - starts[c]
    out = np.zeros(n, np.int64)
    for c in range(n):
        if fits[c]:
            out[c] = total[group[c]]
    return out


@compiled
@no_type_check
def usual(values: np.ndarray, count: np.ndarray, known: np.ndarray) -> float:
    """Median of the values of known segments, each counted as often as it has points."""
    total, best = 0, np.inf
    for c in range(len(values)):
        total += count[c] if known[c] else 0
    for c in range(len(values)):
        if known[c] and values[c] < best:
            below = 0
            for b in range(len(values)):
                below += count[b] if known[b] and values[b] <= values[c] else 0
            if below >= 0.5 * total:
                best = values[c]
    return best


@compiled
@no_type_check
def pieces_that_count(
    uv: np.ndarray,
    normal: np.ndarray,
    width: np.ndarray,
    height: np.ndarray,
    u_px: np.ndarray,
    saturated: np.ndarray,
    segment: np.ndarray,
    min_length: float,
    all_count: bool,
    least_checked: int,
) -> tuple:
    """As :func:`rotaline.vision.stripe.pieces.long_enough`, unless all count, and then :func:`rotaline.vision.stripe.pieces.doubtful_ends`.

    Returns
    -------
    uv, normal, width, height, u, saturated, segment   of the points that stay
    """
    starts = starts_of(segment)
    k, m, kept = len(starts) - 1, 0, 0
    stays = np.ones(k, np.bool_)
    if not all_count:
        count, long, known = np.empty(k, np.int64), np.empty(k, np.bool_), np.empty(k, np.bool_)
        wide, high = medians(width, segment), medians(height, segment)
        some = False
        for c in range(k):
            count[c] = starts[c + 1] - starts[c]
            long[c] = count[c] >= min_length
            some |= long[c]
        for c in range(k):
            known[c] = long[c] or not some
        usual_width, usual_height = usual(wide, count, known), usual(high, count, known)
        for c in range(k):
            most, core = 0.0, 0
            for i in range(starts[c], starts[c + 1]):
                most = max(most, height[i])
            for i in range(starts[c], starts[c + 1]):
                core += height[i] > LEAST_PART * most
            ratio = wide[c] / usual_width
            alike = 1.0 / ALIKE < ratio < ALIKE
            slender = core >= SLENDER * wide[c]
            stays[c] = (alike and slender and high[c] > LEAST_PART * usual_height) or (long[c] and (alike or slender))
        together = points_together(uv, segment, stays, min_length, NEAR_PX)
        for c in range(k):
            stays[c] &= together[c] >= min_length
    uv, normal, width, height = uv.copy(), normal.copy(), width.copy(), height.copy()
    u, saturated, number = u_px.copy(), saturated.copy(), segment.copy()
    for c in range(k):
        if not stays[c]:
            continue
        start, stop = starts[c], starts[c + 1]
        short = stop - start < least_checked
        for i in range(start, stop):
            to_end = min(i - start, stop - 1 - i)
            if short and to_end == 0:
                continue
            doubt = width[i] * np.exp(-to_end / width[i]) if short else 0.0
            u[m] = np.sqrt(u[i] * u[i] + doubt * doubt)
            uv[m, 0], uv[m, 1], normal[m, 0], normal[m, 1] = uv[i, 0], uv[i, 1], normal[i, 0], normal[i, 1]
            width[m], height[m], saturated[m], number[m] = width[i], height[i], saturated[i], kept
            m += 1
        kept += 1
    return uv[:m], normal[:m], width[:m], height[:m], u[:m], saturated[:m], number[:m]
