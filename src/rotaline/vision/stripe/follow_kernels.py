"""Following one ridge through an image line by line, in blocks of some lines that are smoothed around the place where it is expected.

What counts as a ridge, and when two points of one are linked, is as in :mod:`rotaline.vision.stripe.find_kernels` and
:mod:`rotaline.vision.stripe.link_kernels`.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.link_kernels import GAPS
from rotaline.vision.stripe.tile_kernels import mirrored, smooth_across, smooth_down

_ROWS, _COLUMNS = 8, 10  # lines of a block
_PLACES, _HEIGHT = 32, 26  # places of a block of rows, and of columns, three more on each side than are used
_WIDTH = 16  # of a block of columns, three more on each side than are used
_BACK, _STEEPEST = 8, 10  # lines; places: what goes further within so many lines is of the other kind


@compiled
@no_type_check
def _block(
    image: np.ndarray, scale: float, kind: int, first: int, left: int, half: np.ndarray, smooth: np.ndarray
) -> float:
    """Smooth eight rows (kind 0) of 26 places, or ten columns of 20, from the first one on; the first place is three more than ``left``.

    Line i and place j of them are at ``smooth[32 i + j]`` of rows, at ``smooth[16 j + i]`` of columns. Returns the lowest of six values at the edges.
    """
    h, w = image.shape
    top, column = (first - 3, left) if kind == 0 else (left, first - 3)
    rows, columns = (_ROWS + 6, _PLACES) if kind == 0 else (_HEIGHT, _WIDTH)
    if top >= 0 and column >= 0 and top + rows <= h and column + columns <= w:
        if kind == 0:
            smooth_down(image, top, column, 1, _ROWS, _PLACES, scale, half)
        else:
            smooth_down(image, top, column, 1, _HEIGHT - 6, _WIDTH, scale, half)
    else:
        _border_block(image, scale, kind, top, column, half)
    if kind == 0:
        smooth_across(half, _ROWS * _PLACES, smooth)
    else:
        smooth_across(half, (_HEIGHT - 6) * _WIDTH, smooth)
    n, on, beside, used = (_ROWS, _PLACES, 1, _PLACES - 6) if kind == 0 else (_COLUMNS, 1, _WIDTH, _HEIGHT - 6)
    low = np.float32(np.inf)
    for i in (0, n // 2, n - 1):
        low = min(low, min(smooth[i * on], smooth[i * on + (used - 1) * beside]))
    return low


@compiled
@no_type_check
def _border_block(image: np.ndarray, scale: float, kind: int, top: int, column: int, half: np.ndarray) -> None:
    """The columns of a block near the border, smoothed; what lies beyond is mirrored."""
    h, w = image.shape
    block = np.empty((_PLACES, _PLACES), image.dtype)
    for i in range(_ROWS + 6 if kind == 0 else _HEIGHT):
        row = mirrored(top + i, h)
        for j in range(_PLACES if kind == 0 else _WIDTH):
            block[i, j] = image[row, mirrored(column + j, w)]
    if kind == 0:
        smooth_down(block, 0, 0, 1, _ROWS, _PLACES, scale, half)
    else:
        smooth_down(block, 0, 0, 1, _HEIGHT - 6, _WIDTH, scale, half)


@compiled
@no_type_check
def follow_ridge(
    image: np.ndarray,
    scale: float,
    kind: int,
    line: int,
    place: int,
    least: float,
    newest: np.ndarray,
    half: np.ndarray,
    smooth: np.ndarray,
    points: np.ndarray,
    heights: np.ndarray,
    m: int,
) -> int:
    """Put the points of a chain behind the first m, from the one at (line, place) on to both sides; returns how many there are then."""
    end = m
    for side in range(2):
        first, step = (line, 1) if side else (line + 1, -1)
        end = _follow(image, scale, kind, first, place, step, least, newest, half, smooth, points, heights, m, end)
        if end == m:
            break
        for k in range(0 if side else (end - m) // 2):
            i, j = m + k, end - 1 - k
            for row in range(2):
                points[row, i], points[row, j] = points[row, j], points[row, i]
            for row in range(4):
                heights[row, i], heights[row, j] = heights[row, j], heights[row, i]
    return end


@compiled
@no_type_check
def _is_ridge(smooth: np.ndarray, t: int, beside: int, limit: float) -> bool:
    """Whether a value is the highest of its line within three places, and far enough above those three away."""
    at, one, two, three = np.uint64(t), np.uint64(beside), np.uint64(2 * beside), np.uint64(3 * beside)
    top = smooth[at]
    higher = (top > max(smooth[at - one], smooth[at - two])) & (top >= max(smooth[at + one], smooth[at + two]))
    return higher & (top - max(smooth[at - three], smooth[at + three]) > limit)


@compiled
@no_type_check
def _nearest_ridge(smooth: np.ndarray, t: int, beside: int, limit: float, reach: int) -> int:
    """How many places from one to the nearest ridge of its line; one more than ``reach`` if there is none as near."""
    for d in range(reach + 1):
        for sign in (-1, 1):
            if _is_ridge(smooth, t + sign * d * beside, beside, limit):
                return sign * d
    return reach + 1


@compiled
@no_type_check
def _follow(
    image: np.ndarray,
    scale: float,
    kind: int,
    line: int,
    place: int,
    step: int,
    least: float,
    newest: np.ndarray,
    half: np.ndarray,
    smooth: np.ndarray,
    points: np.ndarray,
    heights: np.ndarray,
    begin: int,
    m: int,
) -> int:
    """Append the points of a chain that lie beyond a line, step by step (1 or -1); ``begin`` is its first point. Returns how many there are then."""
    n_lines, n_places = image.shape if kind == 0 else (image.shape[1], image.shape[0])
    n, on, beside, used = (_ROWS, _PLACES, 1, _PLACES - 6) if kind == 0 else (_COLUMNS, 1, _WIDTH, _HEIGHT - 6)
    lines, places = points[0], points[1]
    prominence, above, between, fall = heights[0], heights[1], heights[2], heights[3]
    first, left, low, gap = -n, 0, np.float32(0.0), 0
    limit = np.float32(least)
    one, two, three = np.uint64(beside), np.uint64(2 * beside), np.uint64(3 * beside)
    while gap < GAPS:
        line += step
        gap += 1
        if not 0 <= line < n_lines:
            break
        reach = gap + 1
        i, j = line - first, place - left - 3
        if i < 0 or i >= n or j < reach + 3 or j >= used - reach - 3:
            # the points of this side, or those of the side before, which went the other way, tell how it goes on
            drift = (places[m - 1] - places[m - 1 - _BACK]) // 2 if m - begin > _BACK else 0
            first = line if step > 0 else line - n + 1
            left = place + drift - used // 2 - 3
            low = _block(image, scale, kind, first, left, half, smooth)
            i, j = line - first, place - left - 3
        t = np.uint64(i * on + j * beside)
        v0, v1, v2, v3, v4 = smooth[t - two], smooth[t - one], smooth[t], smooth[t + one], smooth[t + two]
        # around one top the values rise before it and fall behind it
        at = np.int64(v1 > v0) + np.int64(v2 > v1) + np.int64(v3 > v2) + np.int64(v4 > v3) - 2
        if not _is_ridge(smooth, i * on + (j + at) * beside, beside, limit):
            at = _nearest_ridge(smooth, i * on + j * beside, beside, limit, reach)
            if abs(at) > reach:
                continue
        now = place + at
        if now < 3 or now >= n_places - 3:
            continue
        if abs(newest[np.uint64(line)] - now) <= 1:
            break
        to, t = np.uint64(m), np.uint64(i * on + (j + at) * beside)
        top, before, behind = smooth[t], smooth[t - one], smooth[t + one]
        lines[to], places[to], above[to] = line, now, top - low
        prominence[to] = top - max(smooth[t - three], smooth[t + three])
        between[to] = np.float32(0.5) * (behind - before) / (np.float32(2.0) * top - before - behind)
        fall[to] = top - np.float32(0.5) * (smooth[t - two] + smooth[t + two])
        place, gap = now, 0
        m += 1
        if m - begin > _BACK and abs(now - places[np.uint64(m - 1 - _BACK)]) > _STEEPEST:
            return m - _BACK
    return m
