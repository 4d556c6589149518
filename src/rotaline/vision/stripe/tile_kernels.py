"""One sweep over an image that says where ridges can be, and the smoothing of one tile of it.

A tile is 16 x 16 pixels. Its block, 28 rows of 32 pixels, holds what decides about its pixels: six more on each side, three for the smoothing
and three that a ridge must stand above. Blocks are worked on as one long row of numbers, row after row, which suits the processor; what comes
out at the seams is not used.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled, prefetch

TILE, BLOCK_ROWS, BLOCK_COLUMNS = 16, 28, 32
SMOOTH_SIZE = 22 * BLOCK_COLUMNS
FIRST = 3 * BLOCK_COLUMNS + 5  # of the tile in its smoothed block
_ABOVE, _LEFT = 6, 8  # of the tile in its block
_LINE = 64  # bytes of memory that come at once
_U1, _U2, _U3, _U4, _U5, _U6, _U8, _U12, _U16 = (np.uint64(k) for k in (1, 2, 3, 4, 5, 6, 8, 12, 16))
ONES = np.uint64(0x0101010101010101)  # eight bytes, each of them 1
_weights = np.exp(-0.5 * np.arange(4.0) ** 2)
_G0, _G1, _G2, _G3 = (np.float32(w) for w in _weights / (_weights[0] + 2.0 * _weights[1:].sum()))


@compiled
@no_type_check
def sweep(image: np.ndarray, tops: np.ndarray, lows: np.ndarray) -> None:
    """Highest and lowest of the highest values in the columns of each tile.

    The highest is that of means of two columns, so that a single pixel counts half; the lowest is that of four of the columns.
    """
    h, w = image.shape
    high = np.empty((tops.shape[1] + 1) * TILE, image.dtype)
    means, least = np.empty_like(high), np.empty_like(high)
    for a in range(tops.shape[0]):
        high[:] = 0
        for i in range(a * TILE, min((a + 1) * TILE, h), 4):
            _raise_to(image, i, high)
        for j in range(w, len(high)):
            high[j] = high[w - 1]
        _row_extremes(high, means, least, a, tops, lows)


@compiled
@no_type_check
def _raise_to(image: np.ndarray, i: int, high: np.ndarray) -> None:
    """Raise the values in ``high`` to those of the four rows from row i on; the next four are on their way meanwhile."""
    # unsigned numbers never count from the end, which makes faster loops
    r, last = np.uint64(i), np.uint64(image.shape[0] - 1)
    r1, r2, r3 = min(r + _U1, last), min(r + _U2, last), min(r + _U3, last)
    for j in range(0, image.shape[1], _LINE // image.itemsize):
        for row in range(i + 4, i + 8):
            prefetch(image, row, j)
    for j in range(np.uint64(image.shape[1])):
        high[j] = max(high[j], max(max(image[r, j], image[r1, j]), max(image[r2, j], image[r3, j])))


@compiled
@no_type_check
def _row_extremes(
    high: np.ndarray, means: np.ndarray, least: np.ndarray, a: int, tops: np.ndarray, lows: np.ndarray
) -> None:
    """The largest mean of two neighbours in each 16 values, and the smallest of every fourth of them: row a of ``tops`` and ``lows``."""
    n = np.uint64(len(high) - TILE)
    value = high.dtype.type
    for j in range(n):
        means[j] = value((np.int32(high[j]) + np.int32(high[j + _U1]) + 1) >> 1)
    for j in range(n):
        least[j] = min(min(high[j], high[j + _U4]), min(high[j + _U8], high[j + _U12]))
    for j in range(n):
        high[j] = max(max(means[j], means[j + _U4]), max(means[j + _U8], means[j + _U12]))
    for j in range(n):
        means[j] = max(max(high[j], high[j + _U1]), max(high[j + _U2], high[j + _U3]))
    row = np.uint64(a)
    for b in range(np.uint64(tops.shape[1])):
        tops[row, b] = means[_U16 * b]
        lows[row, b] = least[_U16 * b]


@compiled
@no_type_check
def bright_tiles(tops: np.ndarray, lows: np.ndarray, least: float, queue: np.ndarray, heights: np.ndarray) -> int:
    """Put the tiles whose highest value is more than ``least`` above the lowest of them and the eight around into the queue; returns how many.

    ``heights`` becomes how much it is, and the lowest value, of each tile in the queue.

    The last tiles come first: they have been read most recently.
    """
    rows, columns = tops.shape
    value = tops.dtype.type
    most = value(2 ** (8 * tops.itemsize) - 1)
    height = value(min(max(least, 0.0), most))
    low = np.full(columns + 2, most, tops.dtype)
    marks = np.zeros((columns + 7) // 8 * 8, np.uint8)
    words = marks.view(np.uint64)
    n = 0
    for a in range(rows - 1, -1, -1):
        above, own, below = np.uint64(max(a - 1, 0)), np.uint64(a), np.uint64(min(a + 1, rows - 1))
        for b in range(np.uint64(columns)):
            low[b + _U1] = min(lows[own, b], min(lows[above, b], lows[below, b]))
        for b in range(np.uint64(columns)):
            marks[b] = np.uint8(value(tops[own, b] - min(low[b + _U1], min(low[b], low[b + _U2]))) > height)
        for k in range(len(words)):
            rest = words[k]
            while rest:
                b = np.uint64(8 * k + first_byte(rest))
                rest &= rest - _U1
                dark = min(low[b + _U1], min(low[b], low[b + _U2]))
                queue[n] = a * columns + b
                heights[0, n], heights[1, n] = tops[own, b] - dark, dark
                n += 1
    return n


@compiled
@no_type_check
def number_tiles(queue: np.ndarray, n: int, number: np.ndarray) -> None:
    """Place of each tile in the queue of n, -1 of those that are not in it."""
    for k in range(len(number)):
        number[k] = -1
    for k in range(n):
        number[queue[k]] = k


@compiled
@no_type_check
def first_byte(word: int) -> int:
    """Place of the first byte that is 1, of eight bytes that are 0 or 1."""
    before = (word - _U1) & ~word & ONES
    return np.int64(before * ONES >> np.uint64(56))


@compiled
@no_type_check
def mirrored(i: int, n: int) -> int:
    """Index within n of a place beyond the border, mirrored at the middle of the outermost pixel."""
    while i < 0 or i >= n:
        i = -i if i < 0 else 2 * (n - 1) - i
    return i


@compiled
@no_type_check
def inside(a: int, b: int, h: int, w: int) -> bool:
    """Whether the block of a tile does not go beyond the border of an image of h x w."""
    top, left = a * TILE - _ABOVE, b * TILE - _LEFT
    return top >= 0 and left >= 0 and top + BLOCK_ROWS <= h and left + BLOCK_COLUMNS <= w


@compiled
@no_type_check
def smooth_tile(image: np.ndarray, scale: float, a: int, b: int, half: np.ndarray, smooth: np.ndarray) -> None:
    """Smooth a tile times ``scale``, and three pixels around it, by a Gaussian of one pixel; its block is inside.

    The tile begins at ``smooth[FIRST]``; ``half`` is work space, with six numbers more than ``smooth``.
    """
    smooth_down(image, a * TILE - _ABOVE, b * TILE - _LEFT, 1, BLOCK_ROWS - 6, BLOCK_COLUMNS, scale, half)
    smooth_across(half, SMOOTH_SIZE, smooth)


@compiled
@no_type_check
def smooth_border_tile(image: np.ndarray, scale: float, a: int, b: int, half: np.ndarray, smooth: np.ndarray) -> None:
    """The same for a tile near the border.

    It is a function of its own, since arrays that are used in some branches only would be counted for every tile.
    """
    block = np.empty((BLOCK_ROWS, BLOCK_COLUMNS), image.dtype)
    _mirrored_block(image, a, b, block)
    smooth_block(block, scale, half, smooth)


@compiled
@no_type_check
def _mirrored_block(image: np.ndarray, a: int, b: int, block: np.ndarray) -> None:
    """The block of a tile; what lies beyond the border is mirrored."""
    h, w = image.shape
    for i in range(BLOCK_ROWS):
        row = mirrored(a * TILE - _ABOVE + i, h)
        for j in range(BLOCK_COLUMNS):
            block[i, j] = image[row, mirrored(b * TILE - _LEFT + j, w)]


@compiled
@no_type_check
def smooth_rows(
    image: np.ndarray, scale: float, a: int, b: int, half: np.ndarray, smooth: np.ndarray
) -> tuple[int, int]:
    """Smooth seven rows, three apart, of a tile or one near it with a block that is inside, if there is one.

    Returns
    -------
    row, column : int   of the pixel at ``smooth[5]``; pixel (row + 3 i, column + j) is at ``smooth[5 + 32 i + j]``, i below 7 and j below 16
    """
    h, w = image.shape
    top, left = a * TILE - _ABOVE, b * TILE - _LEFT
    if h < BLOCK_ROWS or w < BLOCK_COLUMNS:
        block = np.empty((BLOCK_ROWS, BLOCK_COLUMNS), image.dtype)
        _mirrored_block(image, a, b, block)
        smooth_down(block, 2, 0, 3, 7, BLOCK_COLUMNS, scale, half)
    else:
        top, left = min(max(top, 0), h - BLOCK_ROWS), min(max(left, 0), w - BLOCK_COLUMNS)
        smooth_down(image, top + 2, left, 3, 7, BLOCK_COLUMNS, scale, half)
    smooth_across(half, 7 * BLOCK_COLUMNS, smooth)
    return top + 5, left + _LEFT


@compiled
@no_type_check
def smooth_block(block: np.ndarray, scale: float, half: np.ndarray, smooth: np.ndarray) -> None:
    """The same for a block."""
    smooth_down(block, 0, 0, 1, BLOCK_ROWS - 6, BLOCK_COLUMNS, scale, half)
    smooth_across(half, SMOOTH_SIZE, smooth)


@compiled
@no_type_check
def _gauss(x0: float, x1: float, x2: float, x3: float, x4: float, x5: float, x6: float) -> float:
    """Seven values in a row, smoothed at the middle one."""
    outer = _G2 * (np.float32(x1) + np.float32(x5)) + _G3 * (np.float32(x0) + np.float32(x6))
    return _G0 * np.float32(x3) + _G1 * (np.float32(x2) + np.float32(x4)) + outer


@compiled
@no_type_check
def smooth_down(
    image: np.ndarray, top: int, left: int, step: int, n: int, columns: int, scale: float, half: np.ndarray
) -> None:
    """Smooth so many columns for n rows; the pixels for the first row begin at (top, left), for the next one ``step`` below."""
    factor, first = np.float32(scale), np.uint64(left)
    for i in range(n):
        r = np.uint64(top + step * i)
        for j in range(columns):
            c = first + np.uint64(j)
            half[i * columns + j] = factor * _gauss(
                image[r, c], image[r + _U1, c], image[r + _U2, c], image[r + _U3, c], image[r + _U4, c],
                image[r + _U5, c], image[r + _U6, c],
            )  # fmt: skip


@compiled
@no_type_check
def smooth_across(half: np.ndarray, size: int, smooth: np.ndarray) -> None:
    """Smooth the rows of a block, of which there are so many values."""
    for t in range(size):
        smooth[t] = _gauss(half[t], half[t + 1], half[t + 2], half[t + 3], half[t + 4], half[t + 5], half[t + 6])


@compiled
@no_type_check
def tile_peaks(smooth: np.ndarray, steep: float, flat: float, bright: float, peaks: np.ndarray) -> None:
    """Mark the pixels of a tile that are ridges, and those that are bright.

    ``peaks[i, j]`` becomes the sum of 1 where pixel (i, j) is the highest within three pixels of its row, and by more than ``steep`` higher than both
    of those three away; 2 where it is the same in its column and by more than ``flat``; and 4 where it is higher than ``bright``.
    """
    least_steep, least_flat, limit = np.float32(steep), np.float32(flat), np.float32(bright)
    for i in range(TILE):
        for j in range(TILE):
            t = FIRST + i * BLOCK_COLUMNS + j
            value = smooth[t]
            one = (value > max(smooth[t - 1], smooth[t - 2])) & (value >= max(smooth[t + 1], smooth[t + 2]))
            one &= value - max(smooth[t - 3], smooth[t + 3]) > least_steep
            two = (value > max(smooth[t - 32], smooth[t - 64])) & (value >= max(smooth[t + 32], smooth[t + 64]))
            two &= value - max(smooth[t - 96], smooth[t + 96]) > least_flat
            three = value > limit
            peaks[i, j] = np.uint8(one) | np.uint8(two) << np.uint8(1) | np.uint8(three) << np.uint8(2)


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
