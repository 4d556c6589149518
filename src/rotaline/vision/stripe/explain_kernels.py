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
WING = 0.05  # of the height of a chain; what is fainter beside it is taken for its foot
_BORDER = 6  # px along the border of the image, where no smaller size has candidates
_FEW = 2  # of every fourth pixel of a tile; a ridge that only a smaller size shows has more
_ROW, _COLUMN = np.uint64(0xFF), np.uint64(0x0101010101010101)
# four bits of a word side by side
_EVEN, _PACK, _FOUR = np.uint64(0x0001000100010001), np.uint64(0x0001000200040008), np.uint64(15)
_ONE, _TWO, _EIGHT, _SIXTEEN = np.uint64(1), np.uint64(2), np.uint64(8), np.uint64(16)
_SEVEN_BITS, _SPREAD = np.uint64(0x7F), np.uint64(0x0000040810204081)


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
    return low + max(np.float32(dim), np.float32(WING) * height) if height > dim else np.inf


@compiled
@no_type_check
def bright_pixels(words: np.ndarray, top: int, left: int, h: int, w: int) -> int:
    """Every fourth pixel of a tile that is bright, bit ``8 i + j`` for pixel (2 i, 2 j).

    ``words`` are the marks of :func:`rotaline.vision.stripe.tile_kernels.tile_peaks`, eight bytes each.
    """
    bits = np.uint64(0)
    for i in range(TILE // 2):
        for part in range(2):
            bits |= even_bytes(words[4 * i + part] >> _TWO) << np.uint64(8 * i + 4 * part)
    return off_border(bits, top, left, h, w)


@compiled
@no_type_check
def even_bytes(word: int) -> int:
    """The lowest bits of bytes 0, 2, 4 and 6, side by side."""
    return ((word & _EVEN) * _PACK) >> np.uint64(48) & _FOUR


@compiled
@no_type_check
def off_border(bits: int, top: int, left: int, h: int, w: int) -> int:
    """The same bits without those of pixels near the border of the image."""
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

    A Gaussian of variance v falls by ``1 - exp(-x)``, ``x = d^2 / (2 v)``, of its height over d px; to 0.2 % this is ``x / (1 + x / 2 + x^2 / 12)``.
    """
    fall, expected = 0.0, 0.0
    for first in range(begin, end, 8):
        slope = _slope(line, place, first, begin, end)
        x = 9.0 / ((1.0 + slope * slope) * 2.0 * _FALL)
        part = x / (1.0 + x * (0.5 + x / 12.0))
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
    """Take the pixels beside the points of a chain, in its gaps and beyond its ends out of the bright ones.

    ``number`` goes on for two rows of tiles, and ``light`` for one tile, which stands for all that have no number.
    """
    n_lines, n_places = (h, w) if steep else (w, h)
    along, across = (columns, 1) if steep else (1, columns)  # tiles from one to the next
    beside, half = np.uint64(across), _BESIDE
    for k in range(begin, end):
        if (k - begin) % 8 == 0:
            slope = _slope(line, place, k, begin, end)
            half = int(np.ceil(_BESIDE * np.sqrt(1.0 + slope * slope)))
        first = max(line[k] - (_BEYOND if k == begin else 0), 0)
        last = min(line[k + 1] if k + 1 < end else line[k] + _BEYOND + 1, n_lines)
        low, high = (max(place[k] - half, 0) + 1) >> 1, min(place[k] + half, n_places - 1) >> 1
        begins, n = np.uint64(low & 7), np.uint64(max(high - low + 1, 0))
        run = (_ONE << n) - _ONE << begins  # cells of this tile and the next ones
        for at in range(first + (first & 1), last, 2):
            tile, i = np.uint64((at >> 4) * along + (low >> 3) * across), np.uint64(at >> 1 & 7)
            light[number[tile]] &= ~_in_tile(run, i, steep)
            light[number[tile + beside]] &= ~_in_tile(run >> _EIGHT, i, steep)
            if run >> _SIXTEEN:
                light[number[tile + _TWO * beside]] &= ~_in_tile(run >> _SIXTEEN, i, steep)


@compiled
@no_type_check
def _in_tile(run: int, i: int, steep: bool) -> int:
    """The bits of a tile that are a run of eight bits in its row i (steep), or in its column i."""
    own = run & _ROW
    # seven bits are spread to every eighth place at once; they stay apart
    return own << (_EIGHT * i) if steep else (((own & _SEVEN_BITS) * _SPREAD | own << np.uint64(49)) & _COLUMN) << i


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
    left: np.ndarray,
) -> int:
    """Put the tiles with bright pixels that are more than the foot of a stripe into ``left``, their light to the front; returns how many."""
    n = 0
    for k in range(n_tiles):
        if count_bits(light[k]) < _FEW:
            continue
        a, b = queue[k] // columns, queue[k] % columns
        highest = np.float32(0.0)
        for i in range(max(a - 1, 0), min(a + 2, rows)):
            for j in range(max(b - 1, 0), min(b + 2, columns)):
                if number[i * columns + j] >= 0:
                    highest = max(highest, height[number[i * columns + j]])
        if height[k] >= WING * highest:
            left[n], light[n] = queue[k], light[k]
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
def count_bits(bits: int) -> int:
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
