"""Chains grown along the stripe, for frames that are dark but for it.

A chain begins at a ridge in a bright tile and is followed line by line to both sides, through blocks of some lines that are smoothed around the place
where it is expected. So the image is smoothed along the stripe only, and not in whole tiles. What counts as a ridge, and when two points of one are
linked, is as in :mod:`rotaline.vision.stripe.find_kernels` and :mod:`rotaline.vision.stripe.link_kernels`.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.assemble_kernels import refine_tops
from rotaline.vision.stripe.explain_kernels import (
    DIM,
    WING,
    count_bits,
    cover,
    even_bytes,
    left_over,
    off_border,
    too_wide,
)
from rotaline.vision.stripe.link_kernels import GAPS, SHORTEST
from rotaline.vision.stripe.settle_kernels import choose, compete
from rotaline.vision.stripe.tile_kernels import (
    BLOCK_COLUMNS,
    FIRST,
    ONES,
    SMOOTH_SIZE,
    TILE,
    first_byte,
    inside,
    mirrored,
    number_tiles,
    smooth_across,
    smooth_border_tile,
    smooth_down,
    smooth_tile,
    tile_peaks,
)

_ROWS, _COLUMNS = 8, 10  # lines of a block
_PLACES = 32  # of a block, three more on each side than are used
_WIDTH = 16  # of a block of columns, three more on each side than are used
_MIDDLE = _PLACES // 2
_VALID = _PLACES - 6
_BACK, _STEEPEST = 8, 10  # lines; places: what goes further within so many lines is of the other kind
_BESIDE = 1.0  # px that a chain covers; grown chains meet where one turns into the other
_TRIES = 8  # ridges of a tile that are tried; where there are more, tiles are searched
_FAINT, _EAGER = 3.0, 0.8  # limits: in tiles that are no higher, light begins earlier as long as chains are looked for
_U1 = np.uint64(1)
_NOT_FIRST, _NOT_LAST = np.uint64(0xFEFEFEFEFEFEFEFE), np.uint64(0x7F7F7F7F7F7F7F7F)  # columns of eight


@compiled
@no_type_check
def grow(
    image: np.ndarray,
    scale: float,
    n_tiles: int,
    least_steep: float,
    least_flat: float,
    stands: np.ndarray,
    height: np.ndarray,
    order: np.ndarray,
    light: np.ndarray,
    points: np.ndarray,
    heights: np.ndarray,
    chains: np.ndarray,
    parts: np.ndarray,
    min_length_px: float,
) -> tuple:
    """The chains of an image, grown from ridges in bright tiles until no light is left.

    Parameters
    ----------
    image, scale, n_tiles, least_steep, least_flat, stands : of :func:`rotaline.vision.stripe.find_kernels.look`, which has put the tiles into
        ``order[0]`` and their heights into ``stands``
    height, order, light, points, heights, chains, parts, min_length_px : of :func:`rotaline.vision.stripe.assemble_kernels.assemble`;
        ``order[0]`` stays

    Returns
    -------
    n_chains, n_parts, n_left, chosen : of :func:`rotaline.vision.stripe.assemble_kernels.assemble`; n_left is -1 as well where there is no room, or
        where what is left may be a ridge
    """
    h, w = image.shape
    queue, number = order[0], order[1]
    rows, columns = height.shape
    line, place, prominence, above = points[0], points[1], heights[0], heights[1]
    start, steep, factor = chains[0], chains[1], chains[2]
    half, smooth = np.zeros(SMOOTH_SIZE + 6, np.float32), np.empty(SMOOTH_SIZE, np.float32)
    tile = np.empty(SMOOTH_SIZE, np.float32)
    peaks = np.empty((TILE, TILE), np.uint8)
    newest = np.full(h + w, -9, np.int32)  # place of the last chain on each row, and column
    number_tiles(queue, n_tiles, number)
    dim = DIM * min(least_steep, least_flat)
    high, sums, marks = (
        height.reshape(-1),
        np.zeros(TILE * TILE // 2 + 1, np.int32),
        np.empty(TILE * TILE // 2, np.uint8),
    )
    for k in range(n_tiles):
        high[k] = scale * stands[0, k]
        least = max(dim * (_EAGER if high[k] < _FAINT * dim else 1.0), WING * high[k])
        light[k] = _light(image, scale, queue[k] // columns, queue[k] % columns, stands[1, k], least, sums, marks)
    start[0] = 0
    n_chains, m, fits = 0, 0, True
    for k in range(n_tiles):
        if not fits or count_bits(light[k]) < 2:
            continue
        a, b = queue[k] // columns, queue[k] % columns
        if inside(a, b, h, w):
            smooth_tile(image, scale, a, b, half, tile)
        else:
            smooth_border_tile(image, scale, a, b, half, tile)
        tile_peaks(tile, least_steep, least_flat, np.inf, peaks)
        tries = 0
        while fits:
            kind, row, column = _strongest(tile, peaks, light[k], a * TILE, b * TILE, h, w)
            if kind < 0:
                break
            peaks[row - a * TILE, column - b * TILE] = 0
            i, j, n_lines = (row, column, h) if kind == 0 else (column, row, w)
            tries += 1
            fits = tries <= _TRIES and m + n_lines <= points.shape[1] and n_chains + 2 <= chains.shape[1]
            if not fits:
                break
            own = newest[:h] if kind == 0 else newest[h:]
            end = _grow(
                image, scale, kind, i, j, least_flat if kind else least_steep, own, half, smooth, points, heights, m
            )
            if end - m < SHORTEST:
                continue
            for p in range(m, end):
                own[line[p]] = place[p]
            cover(line, place, m, end, kind == 0, number, columns, h, w, light)
            steep[n_chains], factor[n_chains] = kind == 0, 1
            n_chains, m = n_chains + 1, end
            start[n_chains] = m
    refine_tops(above, 0, m, heights[2], heights[3])
    n_parts = compete(
        line, place, prominence, start, steep, factor, n_chains, h, w, parts, np.empty((0, 0), np.float32), _BESIDE
    )
    left = 0 if fits else -1
    for p in range(n_parts):
        if too_wide(line, place, prominence, above, parts[0, p], parts[1, p]):
            left = -1
    if left == 0:
        for k in range(n_tiles):
            if light[k]:
                a, b = queue[k] // columns, queue[k] % columns
                light[k] &= _light(image, scale, a, b, stands[1, k], max(dim, WING * high[k]), sums, marks)
                light[k] = off_border(light[k], a * TILE, b * TILE, h, w) if high[k] > dim else np.uint64(0)
        left = left_over(n_tiles, rows, columns, high, queue, number, light, order[2])
    chosen = choose(
        line, place, prominence, heights[2], heights[3], steep, factor, parts, n_parts, min_length_px, max(least_steep, least_flat)
    )  # fmt: skip
    return n_chains, n_parts, left, chosen


@compiled
@no_type_check
def _light(
    image: np.ndarray, scale: float, a: int, b: int, dark: float, least: float, sums: np.ndarray, marks: np.ndarray
) -> int:
    """Bright pixels of a tile, of 2 x 2 each, bit ``8 i + j`` for those from (2 i, 2 j) on; ``least`` is how far they stand above what is dark around.

    ``sums``, zeros at first, and ``marks`` are work space.
    """
    h, w = image.shape
    top, left = a * TILE, b * TILE
    limit, bits = np.int32(4.0 * (dark + least / scale)), np.uint64(0)
    if top + TILE < h and left + TILE < w:
        for i in range(TILE // 2):
            r, c = np.uint64(top + 2 * i), np.uint64(left)
            for j in range(np.uint64(TILE)):
                sums[np.uint64(TILE * i) + j] = np.int32(image[r, c + j]) + np.int32(image[r + _U1, c + j])
        for t in range(TILE * TILE // 2):
            marks[t] = np.uint8(sums[t] + sums[t + 1] > limit)
        words = marks.view(np.uint64)
        for i in range(TILE):
            bits |= even_bytes(words[i]) << np.uint64(4 * i)
        return bits
    for i in range(top, min(top + TILE, h - 1), 2):
        for j in range(left, min(left + TILE, w - 1), 2):
            total = np.int32(image[i, j]) + np.int32(image[i, j + 1])
            total += np.int32(image[i + 1, j]) + np.int32(image[i + 1, j + 1])
            bits |= np.uint64(total > limit) << np.uint64(4 * (i - top) + (j - left) // 2)
    return bits


@compiled
@no_type_check
def _strongest(
    smooth: np.ndarray, peaks: np.ndarray, light: int, top: int, left: int, h: int, w: int
) -> tuple[int, int, int]:
    """Kind, row and column of the ridge in the light of a tile, or right beside it, that stands out most; kind -1 if there is none."""
    near = light | (light << _U1) & _NOT_FIRST | (light >> _U1) & _NOT_LAST
    near |= near << np.uint64(8) | near >> np.uint64(8)
    words = peaks.reshape(-1).view(np.uint64)
    best, kind, row, column = np.float32(0.0), -1, 0, 0
    for own in range(2):
        step = 1 if own == 0 else BLOCK_COLUMNS
        for k in range(len(words)):
            rest = words[k] >> np.uint64(own) & ONES
            while rest:
                i, j = k // 2, 8 * (k % 2) + first_byte(rest)
                rest &= rest - _U1
                across = left + j if own == 0 else top + i
                if near >> np.uint64(8 * (i // 2) + j // 2) & _U1 and 3 <= across < (w if own == 0 else h) - 3:
                    t = FIRST + i * BLOCK_COLUMNS + j
                    stands = smooth[t] - max(smooth[t - 3 * step], smooth[t + 3 * step])
                    if stands > best:
                        best, kind, row, column = stands, own, top + i, left + j
    return kind, row, column


@compiled
@no_type_check
def _block(
    image: np.ndarray, scale: float, kind: int, first: int, left: int, half: np.ndarray, smooth: np.ndarray
) -> float:
    """Smooth eight rows (kind 0) or ten columns from the first one on, of 26 places each, the first three more than ``left``.

    Line i and place j of them are at ``smooth[32 i + j]`` of rows, at ``smooth[16 j + i]`` of columns. Returns the lowest of six values at the edges.
    """
    h, w = image.shape
    top, column = (first - 3, left) if kind == 0 else (left, first - 3)
    rows, columns = (_ROWS + 6, _PLACES) if kind == 0 else (_PLACES, _WIDTH)
    if top >= 0 and column >= 0 and top + rows <= h and column + columns <= w:
        if kind == 0:
            smooth_down(image, top, column, 1, _ROWS, _PLACES, scale, half)
        else:
            smooth_down(image, top, column, 1, _VALID, _WIDTH, scale, half)
    else:
        _border_block(image, scale, kind, top, column, half)
    if kind == 0:
        smooth_across(half, _ROWS * _PLACES, smooth)
    else:
        smooth_across(half, _VALID * _WIDTH, smooth)
    n, on, beside = (_ROWS, _PLACES, 1) if kind == 0 else (_COLUMNS, 1, _WIDTH)
    low = np.float32(np.inf)
    for i in (0, n // 2, n - 1):
        low = min(low, min(smooth[i * on], smooth[i * on + (_VALID - 1) * beside]))
    return low


@compiled
@no_type_check
def _border_block(image: np.ndarray, scale: float, kind: int, top: int, column: int, half: np.ndarray) -> None:
    """The columns of a block near the border, smoothed; what lies beyond is mirrored."""
    h, w = image.shape
    block = np.empty((_PLACES, _PLACES), image.dtype)
    for i in range(_ROWS + 6 if kind == 0 else _PLACES):
        row = mirrored(top + i, h)
        for j in range(_PLACES if kind == 0 else _WIDTH):
            block[i, j] = image[row, mirrored(column + j, w)]
    if kind == 0:
        smooth_down(block, 0, 0, 1, _ROWS, _PLACES, scale, half)
    else:
        smooth_down(block, 0, 0, 1, _VALID, _WIDTH, scale, half)


@compiled
@no_type_check
def _grow(
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
    n, on, beside = (_ROWS, _PLACES, 1) if kind == 0 else (_COLUMNS, 1, _WIDTH)
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
        if i < 0 or i >= n or j < reach + 3 or j >= _VALID - reach - 3:
            # the points of this side, or those of the side before, which went the other way, tell how it goes on
            drift = (places[m - 1] - places[m - 1 - _BACK]) // 2 if m - begin > _BACK else 0
            first = line if step > 0 else line - n + 1
            left = place + drift - _MIDDLE
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
