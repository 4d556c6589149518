"""One sweep over an image that says where ridges can be, and the smoothing of one tile of it.

A tile is 16 x 16 pixels. Its block, 30 rows of 32 pixels, holds what decides about its pixels: seven more on each side, four for the smoothing
and three that a ridge must stand above. Blocks are worked on as one long row of numbers, row after row, which suits the processor; what comes
out at the seams is not used.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

TILE, BLOCK_ROWS, BLOCK_COLUMNS = 16, 30, 32
RAW_SIZE = BLOCK_ROWS * BLOCK_COLUMNS * 4  # bytes
_ABOVE, _LEFT = 7, 8  # of the tile in its block
SMOOTH_SIZE = 22 * BLOCK_COLUMNS
FIRST = 3 * BLOCK_COLUMNS + 4  # of the tile in its smoothed block
_LEVEL_TILES = 2  # tiles on each side that tell how dark it is beside a stripe
_weights = np.exp(-0.5 * np.arange(5.0) ** 2)
_G0, _G1, _G2, _G3, _G4 = (np.float32(w) for w in _weights / (_weights[0] + 2.0 * _weights[1:].sum()))


@compiled
@no_type_check
def sweep(pixels: np.ndarray, size: int, tops: np.ndarray, lows: np.ndarray) -> None:
    """Highest mean of 2 x 2 values in each tile, and the lowest of the highest ones in some of its columns.

    Means of four have half the noise of a value, and a ridge stands out of them about as clearly as out of the smoothed image.
    """
    w = pixels.shape[1] // size
    if size == 1:
        _sweep(pixels, np.empty(w + TILE, np.uint16), 0, tops, lows)
    elif size == 2:
        _sweep(pixels.view(np.uint16), np.empty(w + TILE, np.uint32), 0, tops, lows)
    else:
        _sweep(pixels.view(np.float32), np.empty(w + TILE, np.float32), -np.inf, tops, lows)


@compiled
@no_type_check
def _sweep(image: np.ndarray, sums: np.ndarray, lowest: float, tops: np.ndarray, lows: np.ndarray) -> None:
    """The same, of values of any kind; a number in ``sums`` can hold the sum of four."""
    h, w = image.shape
    half = np.empty(w + TILE, sums.dtype)
    last = h - 1
    for a in range(tops.shape[0]):
        top = a * TILE
        sums[:] = lowest
        for i in range(top, min(top + TILE, h), 4):
            r0, r1, r2, r3 = image[i], image[min(i + 1, last)], image[min(i + 2, last)], image[min(i + 3, last)]
            _raise_to_sums(r0, r1, r2, r3, sums)
        for j in range(w - 1, w + TILE):
            sums[j] = sums[w - 2]
        _row_extremes(sums, half, tops[a], lows[a])


@compiled
@no_type_check
def _raise_to_sums(r0: np.ndarray, r1: np.ndarray, r2: np.ndarray, r3: np.ndarray, sums: np.ndarray) -> None:
    """Raise the numbers in ``sums`` to the sums of 2 x 2 values of the first two rows, and of the last two."""
    wide = sums.dtype.type
    for j in range(len(r0) - 1):
        upper = wide(wide(wide(r0[j]) + wide(r1[j])) + wide(wide(r0[j + 1]) + wide(r1[j + 1])))
        lower = wide(wide(wide(r2[j]) + wide(r3[j])) + wide(wide(r2[j + 1]) + wide(r3[j + 1])))
        sums[j] = max(sums[j], max(upper, lower))


@compiled
@no_type_check
def _row_extremes(high: np.ndarray, half: np.ndarray, top: np.ndarray, low: np.ndarray) -> None:
    """A quarter of the largest of each 16 sums, and of the smallest of four of them."""
    n = len(half) - TILE
    quarter = np.float32(0.25)
    for b in range(len(low)):
        j = b * TILE
        low[b] = quarter * min(min(high[j], high[j + 4]), min(high[j + 8], high[j + 12]))
    for j in range(n + 8):
        half[j] = max(high[j], high[j + 8])
    for j in range(n + 4):
        high[j] = max(half[j], half[j + 4])
    for j in range(n + 2):
        half[j] = max(high[j], high[j + 2])
    for b in range(len(top)):
        j = b * TILE
        top[b] = quarter * max(half[j], half[j + 1])


@compiled
@no_type_check
def bright_tiles(tops: np.ndarray, lows: np.ndarray, least: float, queue: np.ndarray) -> int:
    """Number the tiles in the queue whose highest value is more than ``least`` above the darkest columns around; returns how many."""
    rows, columns = tops.shape
    limit = np.empty(columns, np.float32)
    above = np.full(columns + 2 * _LEVEL_TILES, np.inf, np.float32)
    n = 0
    for a in range(rows):
        for b in range(columns):
            above[b + _LEVEL_TILES] = lows[a, b]
        for i in range(max(a - _LEVEL_TILES, 0), min(a + _LEVEL_TILES + 1, rows)):
            for b in range(columns):
                above[b + _LEVEL_TILES] = min(above[b + _LEVEL_TILES], lows[i, b])
        found = 0
        for b in range(columns):
            lowest = min(min(above[b], above[b + 1]), min(above[b + 3], above[b + 4]))
            limit[b] = min(lowest, above[b + 2]) + least
            found += tops[a, b] > limit[b]
        if found > 0:
            for b in range(columns):
                if tops[a, b] > limit[b]:
                    queue[n] = a * columns + b
                    n += 1
    return n


@compiled
@no_type_check
def _mirrored(i: int, n: int) -> int:
    """Index within n of a place beyond the border, mirrored at the middle of the outermost pixel."""
    while i < 0 or i >= n:
        i = -i if i < 0 else 2 * (n - 1) - i
    return i


@compiled
@no_type_check
def _gather(pixels: np.ndarray, size: int, a: int, b: int, raw: np.ndarray, block: np.ndarray) -> None:
    """The block of a tile."""
    h, w = pixels.shape[0], pixels.shape[1] // size
    top, left = a * TILE - _ABOVE, b * TILE - _LEFT
    length = BLOCK_COLUMNS * size
    if top >= 0 and left >= 0 and top + BLOCK_ROWS <= h and left + BLOCK_COLUMNS <= w:
        # unsigned numbers never count from the end; so this becomes vector instructions
        row, column, n = np.uint64(top), np.uint64(left * size), np.uint64(length)
        for i in range(np.uint64(BLOCK_ROWS)):
            for j in range(n):
                raw[i * n + j] = pixels[row + i, column + j]
    else:
        for i in range(BLOCK_ROWS):
            line = pixels[_mirrored(top + i, h)]
            for j in range(BLOCK_COLUMNS):
                at = _mirrored(left + j, w) * size
                for k in range(size):
                    raw[i * length + j * size + k] = line[at + k]
    if size == 1:
        for t in range(BLOCK_ROWS * BLOCK_COLUMNS):
            block[t] = raw[t]
    elif size == 2:
        words = raw.view(np.uint16)
        for t in range(BLOCK_ROWS * BLOCK_COLUMNS):
            block[t] = words[t]
    else:
        values = raw.view(np.float32)
        for t in range(BLOCK_ROWS * BLOCK_COLUMNS):
            block[t] = values[t]


@compiled
@no_type_check
def smooth_tile(
    pixels: np.ndarray,
    size: int,
    a: int,
    b: int,
    raw: np.ndarray,
    block: np.ndarray,
    half: np.ndarray,
    smooth: np.ndarray,
) -> None:
    """Smooth a tile, and three pixels around it, by a Gaussian of one pixel; the tile begins at ``smooth[FIRST]``."""
    _gather(pixels, size, a, b, raw, block)
    for t in range(SMOOTH_SIZE):
        half[t] = (
            _G0 * block[t + 128]
            + _G1 * (block[t + 96] + block[t + 160])
            + _G2 * (block[t + 64] + block[t + 192])
            + _G3 * (block[t + 32] + block[t + 224])
            + _G4 * (block[t] + block[t + 256])
        )
    for t in range(SMOOTH_SIZE - 8):
        smooth[t] = (
            _G0 * half[t + 4]
            + _G1 * (half[t + 3] + half[t + 5])
            + _G2 * (half[t + 2] + half[t + 6])
            + _G3 * (half[t + 1] + half[t + 7])
            + _G4 * (half[t] + half[t + 8])
        )


@compiled
@no_type_check
def tile_peaks(smooth: np.ndarray, step: int, limit: float, bit: np.ndarray, peaks: np.ndarray) -> bool:
    """Pixels that are the highest within three pixels, and more than the limit higher than both of those three away.

    ``step`` is from one pixel to the next across the ridge: 1 for steep ones, the length of a row for flat ones. ``peaks[32 i]`` has bit j set
    where pixel (i, j) of the tile is one, by ``bit[32 i + j] = 2^j`` (0 beside the tile). Returns whether there is one.
    """
    n = TILE * BLOCK_COLUMNS - 8
    middle, bits, out = smooth[FIRST:], bit[:n], peaks[:n]
    before, after = smooth[FIRST - step :], smooth[FIRST + step :]
    before2, after2 = smooth[FIRST - 2 * step :], smooth[FIRST + 2 * step :]
    before3, after3 = smooth[FIRST - 3 * step :], smooth[FIRST + 3 * step :]
    least = np.float32(limit)
    some = np.uint16(0)
    for k in range(np.uint64(n)):
        value = middle[k]
        highest = (value > max(before[k], before2[k])) & (value >= max(after[k], after2[k]))
        highest &= value - max(before3[k], after3[k]) > least
        out[k] = bits[k] if highest else np.uint16(0)
        some |= out[k]
    if some == 0:
        return False
    for k in range(n):  # ascending, so that what is read has not been written
        peaks[k] |= peaks[k + 8]
    for k in range(n):
        peaks[k] |= peaks[k + 4]
    for k in range(n):
        peaks[k] |= peaks[k + 2]
    for k in range(n):
        peaks[k] |= peaks[k + 1]
    return True


@compiled
@no_type_check
def half_size(pixels: np.ndarray, size: int) -> np.ndarray:
    """Means of 2 x 2 values of an image that is given as bytes, ``size`` of them a value."""
    h, w = pixels.shape[0] // 2, pixels.shape[1] // (2 * size)
    out = np.empty((h, w), np.float32)
    sums = np.empty(2 * w, np.float32)
    for i in range(h):
        if size == 1:
            _add_rows(pixels[2 * i], pixels[2 * i + 1], sums)
        elif size == 2:
            _add_rows(pixels[2 * i].view(np.uint16), pixels[2 * i + 1].view(np.uint16), sums)
        else:
            _add_rows(pixels[2 * i].view(np.float32), pixels[2 * i + 1].view(np.float32), sums)
        row = out[i]
        for j in range(w):
            row[j] = np.float32(0.25) * (sums[2 * j] + sums[2 * j + 1])
    return out


@compiled
@no_type_check
def _add_rows(upper: np.ndarray, lower: np.ndarray, out: np.ndarray) -> None:
    """Sum of two rows."""
    for j in range(len(out)):
        out[j] = np.float32(upper[j]) + np.float32(lower[j])
