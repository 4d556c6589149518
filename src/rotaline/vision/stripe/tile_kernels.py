"""One sweep over an image that says where ridges can be, and the smoothing of one tile of it.

A tile is 16 x 16 pixels. Its block, 28 rows of 32 pixels, holds what decides about its pixels: six more on each side, three for the smoothing
and three that a ridge must stand above. Blocks are worked on as one long row of numbers, row after row, which suits the processor; what comes
out at the seams is not used.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

TILE, BLOCK_ROWS, BLOCK_COLUMNS = 16, 28, 32
BLOCK_SIZE = BLOCK_ROWS * BLOCK_COLUMNS
SMOOTH_SIZE = 22 * BLOCK_COLUMNS
FIRST = 3 * BLOCK_COLUMNS + 5  # of the tile in its smoothed block
_ABOVE, _LEFT = 6, 8  # of the tile in its block
_weights = np.exp(-0.5 * np.arange(4.0) ** 2)
_G0, _G1, _G2, _G3 = (np.float32(w) for w in _weights / (_weights[0] + 2.0 * _weights[1:].sum()))


@compiled
@no_type_check
def sweep(image: np.ndarray, scale: float, tops: np.ndarray, lows: np.ndarray) -> None:
    """Highest and lowest of the highest values in the columns of each tile, times ``scale``.

    The highest is that of means of two columns, so that a single pixel counts half; the lowest is that of four of the columns.
    """
    h, w = image.shape
    high = np.empty((tops.shape[1] + 1) * TILE, image.dtype)
    half = np.empty(len(high), image.dtype)
    last = h - 1
    for a in range(tops.shape[0]):
        top = a * TILE
        high[:] = 0
        for i in range(top, min(top + TILE, h), 4):
            _raise_to(image[i], image[min(i + 1, last)], image[min(i + 2, last)], image[min(i + 3, last)], high[:w])
        for j in range(w, len(high)):
            high[j] = high[w - 1]
        _row_extremes(high, half, np.float32(scale), tops[a], lows[a])


@compiled
@no_type_check
def _raise_to(r0: np.ndarray, r1: np.ndarray, r2: np.ndarray, r3: np.ndarray, high: np.ndarray) -> None:
    """Raise the values in ``high`` to those of four rows."""
    for j in range(len(high)):
        high[j] = max(high[j], max(max(r0[j], r1[j]), max(r2[j], r3[j])))


@compiled
@no_type_check
def _row_extremes(high: np.ndarray, half: np.ndarray, scale: float, top: np.ndarray, low: np.ndarray) -> None:
    """The largest mean of two neighbours in each 16 values, and the smallest of four of them."""
    n = len(high) - TILE
    value = high.dtype.type
    for b in range(len(low)):
        j = b * TILE
        low[b] = scale * np.float32(min(min(high[j], high[j + 4]), min(high[j + 8], high[j + 12])))
    for j in range(n + 15):
        half[j] = value((np.int32(high[j]) + np.int32(high[j + 1]) + 1) >> 1)
    for j in range(n + 7):
        high[j] = max(half[j], half[j + 8])
    for j in range(n + 3):
        half[j] = max(high[j], high[j + 4])
    for b in range(len(top)):
        j = b * TILE
        top[b] = scale * np.float32(max(max(half[j], half[j + 1]), max(half[j + 2], half[j + 3])))


@compiled
@no_type_check
def bright_tiles(tops: np.ndarray, lows: np.ndarray, least: float, queue: np.ndarray) -> int:
    """Number the tiles in the queue whose highest value is more than ``least`` above the lowest of them and the eight around; returns how many.

    The last tiles come first: they have been read most recently.
    """
    rows, columns = tops.shape
    low = np.empty(columns + 2, np.float32)
    limit = np.empty(columns, np.float32)
    low[0] = low[columns + 1] = np.inf
    height = np.float32(least)
    n = 0
    for a in range(rows - 1, -1, -1):
        above, own, below, top = lows[max(a - 1, 0)], lows[a], lows[min(a + 1, rows - 1)], tops[a]
        for b in range(columns):
            low[b + 1] = min(own[b], min(above[b], below[b]))
        found = np.int32(0)
        for b in range(columns):
            limit[b] = min(low[b + 1], min(low[b], low[b + 2])) + height
            found += np.int32(top[b] > limit[b])
        if found > 0:
            for b in range(columns):
                if top[b] > limit[b]:
                    queue[n] = a * columns + b
                    n += 1
    return n


@compiled
@no_type_check
def mirrored(i: int, n: int) -> int:
    """Index within n of a place beyond the border, mirrored at the middle of the outermost pixel."""
    while i < 0 or i >= n:
        i = -i if i < 0 else 2 * (n - 1) - i
    return i


@compiled
@no_type_check
def smooth_tile(
    image: np.ndarray,
    scale: float,
    a: int,
    b: int,
    block: np.ndarray,
    half: np.ndarray,
    smooth: np.ndarray,
) -> None:
    """Smooth a tile times ``scale``, and three pixels around it, by a Gaussian of one pixel; the tile begins at ``smooth[FIRST]``."""
    h, w = image.shape
    top, left = a * TILE - _ABOVE, b * TILE - _LEFT
    factor = np.float32(scale)
    if top >= 0 and left >= 0 and top + BLOCK_ROWS <= h and left + BLOCK_COLUMNS <= w:
        part = image[top : top + BLOCK_ROWS, left : left + BLOCK_COLUMNS]
        for i in range(0, BLOCK_ROWS, 4):
            rows = block[i * BLOCK_COLUMNS : (i + 4) * BLOCK_COLUMNS]
            _scale_rows(part[i], part[i + 1], part[i + 2], part[i + 3], factor, rows)
    else:
        for i in range(BLOCK_ROWS):
            line = image[mirrored(top + i, h)]
            for j in range(BLOCK_COLUMNS):
                block[i * BLOCK_COLUMNS + j] = factor * np.float32(line[mirrored(left + j, w)])
    smooth_block(block, half, smooth)


@compiled
@no_type_check
def _scale_rows(r0: np.ndarray, r1: np.ndarray, r2: np.ndarray, r3: np.ndarray, scale: float, out: np.ndarray) -> None:
    """Four rows of a block, one after the other: so many at once, since each loop has to be prepared."""
    n = np.uint64(BLOCK_COLUMNS)  # unsigned numbers never count from the end; so this becomes vector instructions
    for j in range(n):
        out[j], out[j + n] = scale * np.float32(r0[j]), scale * np.float32(r1[j])
        out[j + n + n], out[j + n + n + n] = scale * np.float32(r2[j]), scale * np.float32(r3[j])


@compiled
@no_type_check
def smooth_block(block: np.ndarray, half: np.ndarray, smooth: np.ndarray) -> None:
    """Smooth a block; ``half`` has six numbers more than ``smooth``."""
    for t in range(SMOOTH_SIZE):
        half[t] = (
            _G0 * block[t + 96]
            + _G1 * (block[t + 64] + block[t + 128])
            + _G2 * (block[t + 32] + block[t + 160])
            + _G3 * (block[t] + block[t + 192])
        )
    for t in range(SMOOTH_SIZE):
        smooth[t] = (
            _G0 * half[t + 3]
            + _G1 * (half[t + 2] + half[t + 4])
            + _G2 * (half[t + 1] + half[t + 5])
            + _G3 * (half[t] + half[t + 6])
        )


@compiled
@no_type_check
def tile_peaks(smooth: np.ndarray, steep: float, flat: float, peaks: np.ndarray) -> int:
    """Pixels that are the highest within three pixels of their row, and by more than ``steep`` higher than both of those three away; or the same
    in their column and by more than ``flat``.

    ``peaks[32 i + j]`` is 1 where pixel (i, j) of the tile is of the first kind, 2 where it is of the second, 3 where it is both. Returns what there
    is of all of them together.
    """
    n = TILE * BLOCK_COLUMNS - 16
    middle, out = smooth[FIRST:], peaks[:n]
    left, left2, left3 = smooth[FIRST - 1 :], smooth[FIRST - 2 :], smooth[FIRST - 3 :]
    right, right2, right3 = smooth[FIRST + 1 :], smooth[FIRST + 2 :], smooth[FIRST + 3 :]
    up, up2, up3 = smooth[FIRST - 32 :], smooth[FIRST - 64 :], smooth[FIRST - 96 :]
    down, down2, down3 = smooth[FIRST + 32 :], smooth[FIRST + 64 :], smooth[FIRST + 96 :]
    least_steep, least_flat = np.float32(steep), np.float32(flat)
    some = np.uint8(0)
    for k in range(np.uint64(n)):
        value = middle[k]
        one = (value > max(left[k], left2[k])) & (value >= max(right[k], right2[k]))
        one &= value - max(left3[k], right3[k]) > least_steep
        two = (value > max(up[k], up2[k])) & (value >= max(down[k], down2[k]))
        two &= value - max(up3[k], down3[k]) > least_flat
        out[k] = np.uint8(one) | np.uint8(two) << np.uint8(1)
        some |= out[k]
    return some


@compiled
@no_type_check
def half_size(image: np.ndarray, divisor: int, out: np.ndarray) -> None:
    """Sums of 2 x 2 values, divided by 1 or 4."""
    bits, half = (0, 0) if divisor == 1 else (2, 2)
    for i in range(out.shape[0]):
        upper, lower, to = image[2 * i], image[2 * i + 1], out[i]
        for j in range(len(to)):
            total = (
                np.int32(upper[2 * j])
                + np.int32(upper[2 * j + 1])
                + np.int32(lower[2 * j])
                + np.int32(lower[2 * j + 1])
            )
            to[j] = np.uint16((total + half) >> bits)
