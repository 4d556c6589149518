"""Chains grown along the stripe, for frames that are dark but for it.

A chain begins at a ridge in a bright tile and is followed to both sides (:mod:`rotaline.vision.stripe.follow_kernels`), so that the image is smoothed
along the stripe only, and not in whole tiles. What is bright beside the chains begins the next one.
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
    left_over,
    off_border,
    too_wide,
)
from rotaline.vision.stripe.follow_kernels import follow_ridge
from rotaline.vision.stripe.link_kernels import SHORTEST
from rotaline.vision.stripe.settle_kernels import choose, compete
from rotaline.vision.stripe.tile_kernels import (
    BLOCK_COLUMNS,
    FIRST,
    ONES,
    SMOOTH_SIZE,
    TILE,
    first_byte,
    inside,
    number_tiles,
    smooth_border_tile,
    smooth_tile,
    tile_peaks,
)

# a chain that goes more places a line, or has fewer lines, may be stronger as one of the other kind
_DIAGONAL, _SHORT = 0.8, 16
_BESIDE = 1.0  # px that a chain covers; grown chains meet where one turns into the other
_TRIES = 8  # ridges of a tile that are tried; where there are more, tiles are searched
_FAINT, _EAGER = 3.0, 0.8  # limits: in tiles that are no higher, light begins earlier as long as chains are looked for
_U1, _U2, _U8 = np.uint64(1), np.uint64(2), np.uint64(8)
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
    high = height.reshape(-1)
    for k in range(n_tiles):
        high[k] = scale * stands[0, k]
        least = max(dim * (_EAGER if high[k] < _FAINT * dim else 1.0), WING * high[k])
        light[k] = _light(image, scale, queue[k] // columns, queue[k] % columns, stands[1, k], least)
    start[0] = 0
    n_chains = m = np.int64(0)  # no constants, for each of which what is called would be compiled
    fits = True
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
            tries += 1
            fits = tries <= _TRIES and m + h + w <= points.shape[1] and n_chains + 2 <= chains.shape[1]
            if not fits:
                break
            end = m
            for _ in range(2):
                i, j, own, least = (
                    (row, column, newest[:h], least_steep) if kind == 0 else (column, row, newest[h:], least_flat)
                )
                behind = follow_ridge(image, scale, kind, i, j, least, own, half, smooth, points, heights, end)
                if end > m:
                    kind, end = _stronger(points, heights, m, end, behind, kind)
                    break
                end = behind
                if not _diagonal(line, place, m, end):
                    break
                middle = (m + end) // 2
                row, column = (line[middle], place[middle]) if kind == 0 else (place[middle], line[middle])
                kind = 1 - kind
            own = newest[:h] if kind == 0 else newest[h:]
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
                light[k] &= _light(image, scale, a, b, stands[1, k], max(dim, WING * high[k]))
                light[k] = off_border(light[k], a * TILE, b * TILE, h, w) if high[k] > dim else np.uint64(0)
        left = left_over(n_tiles, rows, columns, high, queue, number, light, order[2])
    chosen = choose(
        line, place, prominence, heights[2], heights[3], steep, factor, parts, n_parts, min_length_px, max(least_steep, least_flat)
    )  # fmt: skip
    return n_chains, n_parts, left, chosen


@compiled
@no_type_check
def _light(image: np.ndarray, scale: float, a: int, b: int, dark: float, least: float) -> int:
    """Bright pixels of a tile, of 2 x 2 each, bit ``8 i + j`` for those from (2 i, 2 j) on; ``least`` is how far they stand above what is dark around."""
    h, w = image.shape
    top, left = a * TILE, b * TILE
    limit, bits = np.int32(4.0 * (dark + least / scale)), np.uint64(0)
    rows, columns = np.uint64(min(TILE, h - top) // 2), np.uint64(min(TILE, w - left) // 2)
    for i in range(rows):
        r, row = np.uint64(top) + _U2 * i, np.uint64(0)
        for j in range(columns):
            c = np.uint64(left) + _U2 * j
            total = np.int32(image[r, c]) + np.int32(image[r, c + _U1])
            total += np.int32(image[r + _U1, c]) + np.int32(image[r + _U1, c + _U1])
            row |= np.uint64(total > limit) << j
        bits |= row << _U8 * i
    return bits


@compiled
@no_type_check
def _strongest(
    smooth: np.ndarray, peaks: np.ndarray, light: int, top: int, left: int, h: int, w: int
) -> tuple[int, int, int]:
    """Kind, row and column of the ridge in the light of a tile, or right beside it, that stands out most; kind -1 if there is none."""
    near = light | (light << _U1) & _NOT_FIRST | (light >> _U1) & _NOT_LAST
    near |= near << _U8 | near >> _U8
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
def _diagonal(line: np.ndarray, place: np.ndarray, begin: int, end: int) -> bool:
    """Whether a chain is so short, or runs so, that it may be stronger as one of the other kind."""
    length = line[end - 1] - line[begin] if end > begin else 0
    return length > 0 and (length < _SHORT or abs(place[end - 1] - place[begin]) > _DIAGONAL * length)


@compiled
@no_type_check
def _stronger(points: np.ndarray, heights: np.ndarray, begin: int, end: int, last: int, kind: int) -> tuple[int, int]:
    """Keep the chain with the larger sum of prominence: the one from ``begin`` to ``end``, or that behind it, of ``kind``; kind and end of it."""
    one, other = np.float32(0.0), np.float32(0.0)
    for k in range(begin, end):
        one += heights[0, k]
    for k in range(end, last):
        other += heights[0, k]
    if one >= other:
        return 1 - kind, end
    for k in range(end, last):
        to = begin + k - end
        points[0, to], points[1, to] = points[0, k], points[1, k]
        for row in range(4):
            heights[row, to] = heights[row, k]
    return kind, begin + last - end
