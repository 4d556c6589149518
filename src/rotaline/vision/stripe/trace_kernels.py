"""Following chains to curves in compiled loops. See :mod:`rotaline.vision.stripe.trace`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.centre_kernels import subtract_sides, weighted_centroids
from rotaline.vision.stripe.chain_kernels import (
    alike,
    break_chains,
    join_chains,
    resample,
    starts_of,
    window_mean,
    window_median,
)
from rotaline.vision.stripe.direction_kernels import local_lines
from rotaline.vision.stripe.judge_kernels import sound_ends
from rotaline.vision.stripe.strip_kernels import BLOCK

_WINDOW, _SMOOTHING = 6, 3  # points on either side that settle the direction, the place
_ROUGH_PX, _FINE_PX = 0.3, 0.05  # misfit of a line that is not worth a one-sided window
_SHORT_PX = 0.02  # a step is the last when it is shorter
_JOIN_PX = 9.0
_BOTH_SIDES = 0.2  # least fall to the higher side, part of the fall to the lower side
_STRAIGHT = 4  # points whose mean tells where an end goes on, and as many before them whereto
_BESIDE_PX = 12.0  # to the end of another chain, at a jump
_LEG, _ALIGNED = 12, 0.9  # points that tell the direction of an end; cosine
_LEAST_WIDTH_PX, _MOST_WIDTH_PX = 0.4, 20.0


@compiled
@no_type_check
def normals(uv: np.ndarray, starts: np.ndarray, noise_px: float) -> np.ndarray:
    """Unit normals of chains, (n, 2)."""
    smooth, tangent = np.empty_like(uv), np.empty_like(uv)
    local_lines(uv, starts, _WINDOW, noise_px, smooth, tangent)
    for i in range(len(uv)):
        tangent[i, 0], tangent[i, 1] = -tangent[i, 1], tangent[i, 0]
    return tangent


@compiled
@no_type_check
def begin(uv: np.ndarray, chain: np.ndarray, scale_px: np.ndarray) -> tuple:
    """The found chains one pixel apart, those found in smaller images smoothed: points, starts, widths to begin with, normals."""
    starts = starts_of(chain)
    width = np.empty(len(uv))
    wide = False
    for i in range(len(uv)):
        width[i] = 1.5 * scale_px[chain[i]]
        wide |= width[i] > 1.5
    if wide:
        smooth, tangent = np.empty_like(uv), np.empty_like(uv)
        local_lines(uv, starts, 2, _ROUGH_PX, smooth, tangent)
        for i in range(len(uv)):
            if width[i] == 1.5:
                smooth[i, 0], smooth[i, 1] = uv[i, 0], uv[i, 1]
        uv = smooth
    dense, edges, wide_px = resample(uv, starts, width)
    return dense, edges, wide_px, normals(dense, edges, _ROUGH_PX)


@compiled
@no_type_check
def _steep(uv: np.ndarray, start: int, stop: int) -> bool:
    """Whether each point of a chain that was found stands on another row; otherwise each stands on another column."""
    steep = True
    for i in range(start + 1, stop):
        steep &= abs(uv[i, 1] - uv[i - 1, 1]) >= 1.0
    return steep


@compiled
@no_type_check
def lines_across(uv: np.ndarray, chain: np.ndarray) -> tuple:
    """The found chains as they are, to be looked at along the rows or columns in which their points were found.

    Returns
    -------
    starts, widths to begin with, normals; along : (n, 2)   direction of the row or column
    """
    starts = starts_of(chain)
    normal = normals(uv, starts, _ROUGH_PX)
    along, width = np.empty_like(normal), np.empty(len(uv))
    for c in range(len(starts) - 1):
        steep = _steep(uv, starts[c], starts[c + 1])
        for i in range(starts[c], starts[c + 1]):
            along[i, 0], along[i, 1] = (1.0, 0.0) if steep else (0.0, 1.0)
            cosine = abs(normal[i, 0]) if steep else abs(normal[i, 1])
            width[i] = 1.5 / max(cosine, 0.6)
    return starts, width, normal, along


@compiled
@no_type_check
def half_maximum(
    uv: np.ndarray,
    starts: np.ndarray,
    width_px: np.ndarray,
    normal: np.ndarray,
    first: np.ndarray,
    count: np.ndarray,
    distance: np.ndarray,
    level: np.ndarray,
    share: np.ndarray,
) -> tuple:
    """The chains that are wider than a chain of the full image, moved to the middle of what stands above half the height.

    A ridge that was found in another image, or in a smaller one, may lie beside the top and say little about the width.
    Middle and width are averaged along the chain. Points without such a top, as at an edge, are left out.

    Returns
    -------
    points, starts, widths, normals
    """
    n = len(uv)
    shift, full, stands = np.zeros(n), np.zeros(n), np.ones(n)
    for i in range(n):
        if width_px[i] <= 1.5:
            continue
        a, b = 0, count[i]
        own = slice(first[i], first[i] + BLOCK * count[i], BLOCK)
        place, value, there = distance[own], level[own], share[own]
        while b > a and there[b - 1] == 0.0:
            b -= 1
        while a < b and there[a] == 0.0:
            a += 1
        stands[i] = 0.0
        top = -1
        for k in range(a, b):
            if abs(place[k]) <= 0.8 * width_px[i] and (top < 0 or value[k] > value[top]):
                top = k
        if top < 0:
            continue
        peak = left = right = value[top]
        for k in range(a, top):
            left = min(left, value[k])
        for k in range(top + 1, b):
            right = min(right, value[k])
        base = max(left, right)
        if peak - base > _BOTH_SIDES * (peak - min(left, right)):
            stands[i] = 1.0
        half = 0.5 * (float(peak) + float(base))
        low = high = top
        while low > a and value[low - 1] > half:
            low -= 1
        while high < b - 1 and value[high + 1] > half:
            high += 1
        shift[i] = 0.5 * (place[low] + place[high])
        full[i] = (high - low + 1) / max(abs(normal[i, 0]), abs(normal[i, 1]))
    moved, width, edges = np.empty_like(uv), np.empty(n), np.empty(len(starts), np.int64)
    mean = np.empty(n)
    window_mean(stands, starts, 6, mean)
    scratch = np.empty(64)
    m = 0
    for c in range(len(starts) - 1):
        edges[c] = m
        for i in range(starts[c], starts[c + 1]):
            along = 0.0
            width[m] = width_px[i]
            if width_px[i] > 1.5:
                if mean[i] <= 0.5:
                    continue
                along = window_median(shift, starts[c], starts[c + 1], i, 6, scratch)
                wide = window_median(full, starts[c], starts[c + 1], i, 10, scratch) / 2.355
                width[m] = min(max(wide, _LEAST_WIDTH_PX), 2.0 * width_px[i])
            moved[m, 0], moved[m, 1] = uv[i, 0] + along * normal[i, 0], uv[i, 1] + along * normal[i, 1]
            m += 1
    edges[len(starts) - 1] = m
    return moved[:m], edges, width[:m], normals(moved[:m], edges, _ROUGH_PX)


@compiled
@no_type_check
def _straighten(uv: np.ndarray, index: np.ndarray, edges: np.ndarray, width_px: np.ndarray) -> None:
    """Let ends beside the end of a chain of the same direction go straight on, where they do not yet: at a jump centroids are drawn to the other side."""
    begin, stop = sound_ends(uv, width_px, index, edges)
    for c in range(len(edges) - 1):
        for end in range(2):
            sign = 1 if end else -1
            at = edges[c + 1] - 1 if end else edges[c]
            taken = edges[c + 1] - stop[c] if end else begin[c] - edges[c]
            beside = False
            for other in range(2 * (len(edges) - 1) if taken else 0):
                a, b = edges[other // 2], edges[other // 2 + 1] - 1
                one, two = (
                    uv[index[b if other % 2 else a]],
                    uv[index[max(b - _LEG, a) if other % 2 else min(a + _LEG, b)]],
                )
                mine, far = uv[index[at]], uv[index[at - sign * _LEG]]
                away = (one[0] - mine[0]) ** 2 + (one[1] - mine[1]) ** 2
                au, av, bu, bv = one[0] - two[0], one[1] - two[1], mine[0] - far[0], mine[1] - far[1]
                aligned = abs(au * bu + av * bv) > _ALIGNED * np.sqrt((au * au + av * av) * (bu * bu + bv * bv))
                beside |= other // 2 != c and b - a >= _LEG and aligned and away < _BESIDE_PX * _BESIDE_PX
            if not beside:
                continue
            last = at - sign * taken
            for k in range(2):
                near, far = 0.0, 0.0
                for j in range(_STRAIGHT):
                    near += uv[index[last - sign * j], k] / _STRAIGHT
                    far += uv[index[last - sign * (j + _STRAIGHT)], k] / _STRAIGHT
                step = (near - far) / _STRAIGHT
                for j in range(1, taken + 1):
                    uv[index[last + sign * j], k] = near + step * (min(j, taken - 1.0) + 0.5 * (_STRAIGHT - 1))


@compiled
@no_type_check
def _end_tangents(uv: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Tangents at the first and last point of each chain, of the line through so many; zeros elsewhere."""
    tangent = np.zeros_like(uv)
    for c in range(len(starts) - 1):
        m = min(starts[c + 1] - starts[c], _WINDOW + 1)
        for end in range(2):
            first = starts[c + 1] - m if end else starts[c]
            du = dv = 0.0
            for j in range(m):
                du += (j - 0.5 * (m - 1)) * uv[first + j, 0]
                dv += (j - 0.5 * (m - 1)) * uv[first + j, 1]
            length, at = np.sqrt(du * du + dv * dv), starts[c + 1] - 1 if end else starts[c]
            if m > 0:
                tangent[at, 0], tangent[at, 1] = (du / length, dv / length) if length > 1e-9 else (1.0, 0.0)
    return tangent


@compiled
@no_type_check
def follow(
    uv: np.ndarray,
    starts: np.ndarray,
    width_px: np.ndarray,
    normal: np.ndarray,
    along: np.ndarray,
    first: np.ndarray,
    count: np.ndarray,
    distance: np.ndarray,
    level: np.ndarray,
    share: np.ndarray,
    clipped: np.ndarray,
    hits: np.ndarray,
    least: int,
    join: bool,
) -> tuple:
    """Move the points to the centroids, break the chains where these jump, join what goes on, and space the points equally again.

    Parameters
    ----------
    along : (n, 2)   direction of the strips, in which the points move
    width_px : (n,)   as seen in that direction

    Returns
    -------
    points, starts, widths, normals
    """
    n = len(uv)
    line, sides = np.empty((n, 3)), np.empty((n, 2))
    subtract_sides(first, count, distance, level, share, clipped, hits, width_px, line, sides)
    shift, measured, good = np.empty(n), np.empty(n), np.empty(n, np.bool_)
    height = np.empty(n)
    weighted_centroids(
        first, count, distance, level, share, line[:, 2], np.zeros(n), width_px, 1.0, _SHORT_PX,
        np.ones(n // BLOCK + 1, np.bool_), shift, np.empty(0), measured, height,
    )  # fmt: skip
    for i in range(n):
        good[i] = abs(shift[i]) <= 1.5 * width_px[i] + 1.0
        wide = measured[i] if good[i] else width_px[i]
        wide *= abs(along[i, 0] * normal[i, 0] + along[i, 1] * normal[i, 1])
        measured[i] = min(max(wide, _LEAST_WIDTH_PX), _MOST_WIDTH_PX)
    moved, tangent = np.empty((n, 2)), np.empty((n, 2))
    for i in range(n):
        s = shift[i] if good[i] else 0.0
        moved[i, 0], moved[i, 1] = uv[i, 0] + s * along[i, 0], uv[i, 1] + s * along[i, 1]
        tangent[i, 0], tangent[i, 1] = normal[i, 1], -normal[i, 0]
    alike(measured, starts, 0.25, good)
    return _curves(moved, moved, tangent, measured, good, starts, least, True, join)


@compiled
@no_type_check
def follow_tops(
    uv: np.ndarray, chain: np.ndarray, spread_px2: np.ndarray, least_px: float, most_px: float, least: int
) -> tuple:
    """As :func:`follow` does with centroids, with the tops of the smoothed image, without another look at it.

    Points stay whatever their width, and ends as they are: the spread of single points scatters, and no jump draws a top aside.

    Parameters
    ----------
    spread_px2 : (n,)   variance of the smoothed profile along the row or column
    least_px, most_px : float   widths between which it tells the width

    Returns
    -------
    points, starts, widths, normals
    known : bool   all widths are between these
    """
    n = len(uv)
    starts = starts_of(chain)
    smooth, tangent = np.empty_like(uv), np.empty_like(uv)
    local_lines(uv, starts, _SMOOTHING, _FINE_PX, smooth, tangent)
    measured = np.empty(n)
    for c in range(len(starts) - 1):
        start, stop = starts[c], starts[c + 1]
        k = 1 if _steep(uv, start, stop) else 0
        own, ahead, spread = measured[start:stop], tangent.reshape(-1)[2 * start + k : 2 * stop], spread_px2[start:stop]
        for i in range(stop - start):
            variance = spread[i] * ahead[2 * i] * ahead[2 * i] - 1.0
            own[i] = np.sqrt(min(max(variance, _LEAST_WIDTH_PX * _LEAST_WIDTH_PX), _MOST_WIDTH_PX * _MOST_WIDTH_PX))
    points, edges, width, normal = _curves(
        uv, smooth, tangent, measured, np.ones(n, np.bool_), starts, least, False, True
    )
    known = True
    for w in width:
        known &= least_px <= w <= most_px
    return points, edges, width, normal, known


@compiled
@no_type_check
def _curves(
    moved: np.ndarray,
    smooth: np.ndarray,
    tangent: np.ndarray,
    measured: np.ndarray,
    good: np.ndarray,
    starts: np.ndarray,
    least: int,
    straight: bool,
    join: bool,
) -> tuple:
    """The end of :func:`follow`, from the points where they have moved to; those that are good are to stay.

    Where ends are to go ``straight`` on at jumps, ``moved`` changes. Otherwise, ``smooth`` are these points smoothed along the chains, for where
    these stay as they are.
    """
    index, edges = break_chains(moved, tangent, good, starts, least)
    if straight:
        _straighten(moved, index, edges, measured)
    if straight or len(index) < len(moved) or len(edges) != len(starts):
        moved, measured = moved[index], measured[index]
        smooth = np.empty_like(moved)
        local_lines(moved, edges, _SMOOTHING, _FINE_PX, smooth, np.empty_like(moved))
    width = np.empty(len(measured))
    window_mean(measured, edges, 10, width)
    while True:
        dense, edges, wide = resample(smooth, edges, width)
        if not join or len(edges) <= 2:
            break
        join = False
        order, joined = join_chains(dense, _end_tangents(dense, edges), edges, _JOIN_PX)
        if len(joined) == len(edges):
            break
        smooth, edges, width = dense[order], joined, wide[order]
    return dense, edges, wide, normals(dense, edges, _FINE_PX)


@compiled
@no_type_check
def long_chains(uv: np.ndarray, starts: np.ndarray, width_px: np.ndarray, normal: np.ndarray, least: int) -> tuple:
    """The chains of ``least`` points or more."""
    shortest = least
    for c in range(len(starts) - 1):
        shortest = min(shortest, starts[c + 1] - starts[c])
    if shortest == least:
        return uv, starts, width_px, normal
    keep = np.zeros(len(uv), np.bool_)
    edges = np.empty_like(starts)
    m, kept = 0, 0
    for c in range(len(starts) - 1):
        if starts[c + 1] - starts[c] >= least:
            edges[kept] = m
            kept += 1
            m += starts[c + 1] - starts[c]
            keep[starts[c] : starts[c + 1]] = True
    edges[kept] = m
    return uv[keep], edges[: kept + 1], width_px[keep], normal[keep]
