"""Whether the chains found at the full size explain all that is bright, so that smaller sizes of the image need not be looked at.

They do where no chain is so wide that a smaller size would suit it better, and nothing else is bright beside them: a ridge that only a smaller
size shows is nearly as high at the full size, and wider than what a narrow chain explains.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.tile_kernels import BLOCK_COLUMNS, FIRST, TILE

_BESIDE = 5  # px on both sides of a chain, across it, that it explains
_BEYOND = 4  # px beyond its ends
_FALL = 3.7  # px^2; the fall over 3 px across tells the width: this for a stripe that the half size would suit as well
_WING = 0.05  # of the height of a chain; what is fainter beside it is taken for its foot
_DIM = 1.2  # limits
_FEW = 4  # pixels of every other row of a tile; a ridge that only a smaller size shows has more


@compiled
@no_type_check
def explained(
    line: np.ndarray,
    place: np.ndarray,
    prominence: np.ndarray,
    steep: np.ndarray,
    begin: np.ndarray,
    end: np.ndarray,
    chain: np.ndarray,
    smooth: np.ndarray,
    queue: np.ndarray,
    number: np.ndarray,
    columns: int,
    limits: np.ndarray,
    h: int,
    w: int,
) -> bool:
    """Whether the parts of the chains explain what is bright in the tiles of the queue, whose smoothed values are given."""
    height = np.zeros(len(queue), np.float32)
    low = np.empty(len(queue), np.float32)
    for k in range(len(queue)):
        low[k] = _low(smooth[k])
    for p in range(len(begin)):
        if _wide(line, place, prominence, begin[p], end[p], steep[chain[p]], smooth, number, columns, low, height):
            return False
    covered = np.empty((len(queue), TILE * BLOCK_COLUMNS), np.bool_)
    for k in range(len(queue)):
        _start(covered[k], min(TILE, h - queue[k] // columns * TILE), min(TILE, w - queue[k] % columns * TILE))
    for p in range(len(begin)):
        _cover(line, place, begin[p], end[p], steep[chain[p]], number, columns, h, w, covered)
    least = _DIM * min(limits[0], limits[1])
    for k in range(len(queue)):
        a, b = queue[k] // columns, queue[k] % columns
        highest = np.float32(0.0)
        for i in range(max(a - 1, 0), min(a + 2, len(number) // columns)):
            for j in range(max(b - 1, 0), min(b + 2, columns)):
                if number[i * columns + j] >= 0:
                    highest = max(highest, height[number[i * columns + j]])
        if _bright_beside(smooth[k], low[k] + max(least, _WING * highest), covered[k]):
            return False
    return True


@compiled
@no_type_check
def _low(smooth: np.ndarray) -> float:
    """Lowest of eight values around a tile."""
    low = smooth[1]
    for t in (
        11,
        22,
        10 * BLOCK_COLUMNS + 1,
        10 * BLOCK_COLUMNS + 22,
        21 * BLOCK_COLUMNS + 1,
        21 * BLOCK_COLUMNS + 11,
        21 * BLOCK_COLUMNS + 22,
    ):
        low = min(low, smooth[t])
    return low


@compiled
@no_type_check
def _slope(line: np.ndarray, place: np.ndarray, k: int, begin: int, end: int) -> float:
    """Change of place with the line near point k of a chain."""
    first, last = max(k - 4, begin), min(k + 4, end - 1)
    return (place[last] - place[first]) / (line[last] - line[first])


@compiled
@no_type_check
def _wide(
    line: np.ndarray,
    place: np.ndarray,
    prominence: np.ndarray,
    begin: int,
    end: int,
    steep: bool,
    smooth: np.ndarray,
    number: np.ndarray,
    columns: int,
    low: np.ndarray,
    height: np.ndarray,
) -> bool:
    """Whether a chain falls off so slowly to its sides that a smaller size of the image would suit it better; notes its height in the tiles.

    A Gaussian of variance v falls by ``1 - exp(-d^2 / (2 v))`` of its height over d px.
    """
    fall, expected = 0.0, 0.0
    part = 0.0
    for k in range(begin, end):
        if (k - begin) % 8 == 0:
            slope = _slope(line, place, k, begin, end)
            part = 1.0 - np.exp(-9.0 / ((1.0 + slope * slope) * 2.0 * _FALL))
        row, column = (line[k], place[k]) if steep else (place[k], line[k])
        tile = number[row // TILE * columns + column // TILE]
        h = smooth[tile, FIRST + row % TILE * BLOCK_COLUMNS + column % TILE] - low[tile]
        height[tile] = max(height[tile], h)
        fall += prominence[k]
        expected += part * h
    return fall < expected


@compiled
@no_type_check
def _cover(
    line: np.ndarray,
    place: np.ndarray,
    begin: int,
    end: int,
    steep: bool,
    number: np.ndarray,
    columns: int,
    h: int,
    w: int,
    covered: np.ndarray,
) -> None:
    """Mark the pixels beside the points of a chain, in its gaps and beyond its ends; ``covered[k, 32 i + j]`` is pixel (i, j) of tile k."""
    lines, places = (h, w) if steep else (w, h)
    half = _BESIDE
    for k in range(begin, end):
        if (k - begin) % 8 == 0:
            slope = _slope(line, place, k, begin, end)
            half = int(np.ceil(_BESIDE * np.sqrt(1.0 + slope * slope)))
        first = max(line[k] - (_BEYOND if k == begin else 0), 0)
        last = min(line[k + 1] if k + 1 < end else line[k] + _BEYOND + 1, lines)
        low, high = max(place[k] - half, 0), min(place[k] + half, places - 1)
        for at in range(first, last):
            for t in range(low // TILE, high // TILE + 1):
                tile = number[at // TILE * columns + t] if steep else number[t * columns + at // TILE]
                if tile < 0:
                    continue
                i, j = np.uint64(max(low - t * TILE, 0)), np.uint64(min(high - t * TILE, TILE - 1) + 1)
                pixels, line_in_tile = covered[tile], np.uint64(at % TILE)
                if steep:
                    for column in range(i, j):
                        pixels[line_in_tile * np.uint64(BLOCK_COLUMNS) + column] = True
                else:
                    for row in range(i, j):
                        pixels[row * np.uint64(BLOCK_COLUMNS) + line_in_tile] = True


@compiled
@no_type_check
def _start(covered: np.ndarray, height: int, width: int) -> None:
    """Mark what does not count in a tile: every other row, and what lies beside the tile or the image."""
    for i in range(TILE):
        row = covered[i * BLOCK_COLUMNS : (i + 1) * BLOCK_COLUMNS]
        row[:] = True
        if i % 2 == 0 and i < height:
            row[:width] = False


@compiled
@no_type_check
def _bright_beside(smooth: np.ndarray, least: float, covered: np.ndarray) -> bool:
    """Whether a tile has smoothed values above ``least`` that are not covered."""
    n, limit = np.int32(0), np.float32(least)
    values = smooth[FIRST:]
    for t in range(TILE * BLOCK_COLUMNS - TILE):
        n += np.int32((values[t] > limit) & (not covered[t]))
    return n >= _FEW
