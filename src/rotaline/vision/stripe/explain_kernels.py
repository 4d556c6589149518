"""Whether the chains found at the full size explain all that is bright, so that smaller sizes of the image need not be looked at.

They do where no chain is so wide that a smaller size would suit it better, and no tile with light beside them has a ridge in the half or the
quarter size there. A ridge that only a smaller size shows is nearly as high at the full size, and wider than what a narrow chain explains.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.tile_kernels import (
    BLOCK_COLUMNS,
    BLOCK_ROWS,
    FIRST,
    SMOOTH_SIZE,
    TILE,
    mirrored,
    smooth_block,
    tile_peaks,
)

DIM = 1.2  # limits; what is fainter is not looked at
_BESIDE = 5  # px on both sides of a chain, across it, that it explains
_BEYOND = 4  # px beyond its ends
_FALL = 3.7  # px^2; the fall over 3 px across tells the width: this for a stripe that the half size would suit as well
_WING = 0.05  # of the height of a chain; what is fainter beside it is taken for its foot
_BORDER = 6  # px along the border of the image, where no smaller size has candidates
_FEW = 2  # of every fourth pixel of a tile; a ridge that only a smaller size shows has more
_ROW, _COLUMN = np.uint64(0xFF), np.uint64(0x0101010101010101)
_EVEN, _PACK, _FOUR = (
    np.uint64(0x0001000100010001),
    np.uint64(0x0001000200040008),
    np.uint64(15),
)  # four bits of a word side by side
_ONE, _TWO, _EIGHT = np.uint64(1), np.uint64(2), np.uint64(8)


@compiled
@no_type_check
def lowest(smooth: np.ndarray) -> float:
    """Lowest of eight values around a tile."""
    low = smooth[2]
    for t in (
        12,
        23,
        10 * BLOCK_COLUMNS + 2,
        10 * BLOCK_COLUMNS + 23,
        21 * BLOCK_COLUMNS + 2,
        21 * BLOCK_COLUMNS + 12,
        21 * BLOCK_COLUMNS + 23,
    ):
        low = min(low, smooth[t])
    return low


@compiled
@no_type_check
def highest(smooth: np.ndarray, fold: np.ndarray) -> float:
    """Highest value of a tile; ``fold`` is work space."""
    for j in range(4 * BLOCK_COLUMNS):
        t = FIRST + j
        fold[j] = max(max(smooth[t], smooth[t + 128]), max(smooth[t + 256], smooth[t + 384]))
    for j in range(TILE):
        fold[j] = max(max(fold[j], fold[j + 32]), max(fold[j + 64], fold[j + 96]))
    for n in (8, 4, 2, 1):
        for j in range(n):
            fold[j] = max(fold[j], fold[j + n])
    return fold[0]


@compiled
@no_type_check
def bright_limit(low: float, height: float, dim: float) -> float:
    """What is higher than this, in a tile that is so high above what is dark around, is bright."""
    return low + max(np.float32(dim), np.float32(_WING) * height) if height > dim else np.inf


@compiled
@no_type_check
def bright_pixels(words: np.ndarray, top: int, left: int, h: int, w: int) -> int:
    """Every fourth pixel of a tile that is bright, bit ``8 i + j`` for pixel (2 i, 2 j).

    ``words`` are the marks of :func:`rotaline.vision.stripe.tile_kernels.tile_peaks`, eight bytes each.
    """
    bits = np.uint64(0)
    for i in range(TILE // 2):
        for part in range(2):
            four = ((words[4 * i + part] >> _TWO & _EVEN) * _PACK) >> np.uint64(48) & _FOUR
            bits |= four << np.uint64(8 * i + 4 * part)
    if bits and not (_BORDER <= top <= h - _BORDER - TILE and _BORDER <= left <= w - _BORDER - TILE):
        for i in range(TILE // 2):
            if not _BORDER <= top + 2 * i < h - _BORDER:
                bits &= ~(_ROW << np.uint64(8 * i))
            if not _BORDER <= left + 2 * i < w - _BORDER:
                bits &= ~(_COLUMN << np.uint64(i))
    return bits


@compiled
@no_type_check
def _slope(line: np.ndarray, place: np.ndarray, k: int, begin: int, end: int) -> float:
    """Change of place with the line near point k of a chain."""
    first, last = max(k - 4, begin), min(k + 4, end - 1)
    return (place[last] - place[first]) / (line[last] - line[first])


@compiled
@no_type_check
def too_wide(
    line: np.ndarray, place: np.ndarray, prominence: np.ndarray, above: np.ndarray, begin: int, end: int
) -> bool:
    """Whether a chain falls off so slowly to its sides that a smaller size of the image would suit it better.

    A Gaussian of variance v falls by ``1 - exp(-d^2 / (2 v))`` of its height over d px.
    """
    fall, expected = 0.0, 0.0
    for first in range(begin, end, 8):
        slope = _slope(line, place, first, begin, end)
        part = 1.0 - np.exp(-9.0 / ((1.0 + slope * slope) * 2.0 * _FALL))
        for k in range(first, min(first + 8, end)):
            fall += prominence[k]
            expected += part * above[k]
    return fall < expected


@compiled
@no_type_check
def cover(
    line: np.ndarray,
    place: np.ndarray,
    begin: int,
    end: int,
    steep: bool,
    number: np.ndarray,
    columns: int,
    h: int,
    w: int,
    light: np.ndarray,
) -> None:
    """Take the pixels beside the points of a chain, in its gaps and beyond its ends out of the bright ones."""
    lines, places = (h, w) if steep else (w, h)
    half = _BESIDE
    for k in range(begin, end):
        if (k - begin) % 8 == 0:
            slope = _slope(line, place, k, begin, end)
            half = int(np.ceil(_BESIDE * np.sqrt(1.0 + slope * slope)))
        first = max(line[k] - (_BEYOND if k == begin else 0), 0)
        last = min(line[k + 1] if k + 1 < end else line[k] + _BEYOND + 1, lines)
        low, high = max(place[k] - half, 0), min(place[k] + half, places - 1)
        for at in range(first + first % 2, last, 2):
            for t in range(low // TILE, high // TILE + 1):
                tile = number[at // TILE * columns + t] if steep else number[t * columns + at // TILE]
                if tile < 0:
                    continue
                i, j = (max(low - t * TILE, 0) + 1) // 2, min(high - t * TILE, TILE - 1) // 2
                across, along = np.uint64(i), np.uint64(at % TILE // 2)
                if steep:
                    run = (_TWO << np.uint64(j - i)) - _ONE if j >= i else np.uint64(0)
                    light[tile] &= ~(run << (_EIGHT * along + across))
                else:
                    run = _COLUMN >> np.uint64(8 * (7 - j + i)) if j >= i else np.uint64(0)
                    light[tile] &= ~(run << (_EIGHT * across + along))


@compiled
@no_type_check
def left_over(
    n_tiles: int,
    rows: int,
    columns: int,
    height: np.ndarray,
    queue: np.ndarray,
    number: np.ndarray,
    light: np.ndarray,
) -> int:
    """Move the tiles with bright pixels that are more than the foot of a stripe to the front of the queue; returns how many."""
    n = 0
    for k in range(n_tiles):
        if _count(light[k]) < _FEW:
            continue
        a, b = queue[k] // columns, queue[k] % columns
        highest = np.float32(0.0)
        for i in range(max(a - 1, 0), min(a + 2, rows)):
            for j in range(max(b - 1, 0), min(b + 2, columns)):
                if number[i * columns + j] >= 0:
                    highest = max(highest, height[number[i * columns + j]])
        if height[k] >= _WING * highest:
            queue[n], light[n] = queue[k], light[k]
            n += 1
    return n


@compiled
@no_type_check
def ridges_beside(
    image: np.ndarray, scale: float, tiles: np.ndarray, light: np.ndarray, columns: int, least: float
) -> bool:
    """Whether there are ridges in the half or the quarter size of the image where pixels of these tiles are bright."""
    block, peaks = np.empty((BLOCK_ROWS, BLOCK_COLUMNS), np.float32), np.empty((TILE, TILE), np.uint8)
    half, smooth = np.zeros(SMOOTH_SIZE + 6, np.float32), np.empty(SMOOTH_SIZE, np.float32)
    for k in range(len(tiles)):
        a, b = tiles[k] // columns, tiles[k] % columns
        for factor in (2, 4):
            _smaller_block(image, scale, a // factor, b // factor, factor, block)
            smooth_block(block, 1.0, half, smooth)
            tile_peaks(smooth, least, least, np.inf, peaks)
            if _in_light(peaks, light[k], factor, a % factor, b % factor):
                return True
    return False


@compiled
@no_type_check
def _count(bits: int) -> int:
    """Number of bits that are set."""
    n = 0
    while bits:
        bits &= bits - _ONE
        n += 1
    return n


@compiled
@no_type_check
def _smaller_block(image: np.ndarray, scale: float, a: int, b: int, factor: int, block: np.ndarray) -> None:
    """The block of a tile of the image that is smaller by a factor."""
    h, w = image.shape
    weight = np.float32(scale / (factor * factor))
    for i in range(BLOCK_ROWS):
        top = mirrored(a * TILE - 6 + i, h // factor) * factor
        for j in range(BLOCK_COLUMNS):
            left = mirrored(b * TILE - 8 + j, w // factor) * factor
            total = np.int32(0)
            for y in range(factor):
                for x in range(factor):
                    total += np.int32(image[top + y, left + x])
            block[i, j] = weight * np.float32(total)


@compiled
@no_type_check
def _in_light(peaks: np.ndarray, light: int, factor: int, down: int, right: int) -> bool:
    """Whether ridges of a tile of the smaller image lie where pixels are bright in a tile of the full one; that is ``(down, right)`` in its part."""
    size = TILE // factor
    wide = factor // 2
    n = 0
    for i in range(size):
        for j in range(size):
            if peaks[down * size + i, right * size + j]:
                bright = np.uint64(0)
                for y in range(i * wide, (i + 1) * wide):
                    for x in range(j * wide, (j + 1) * wide):
                        bright |= light >> np.uint64(8 * y + x)
                n += bright & _ONE != 0
    return n >= _FEW
