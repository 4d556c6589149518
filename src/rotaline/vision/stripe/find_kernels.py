"""Candidates of ridges in the tiles of an image that can hold some, the only part of finding that reads the image, by the definition of :mod:`rotaline.vision.stripe.ridges`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.explain_kernels import DIM, bright_limit, bright_pixels, highest, lowest
from rotaline.vision.stripe.settle_kernels import median
from rotaline.vision.stripe.tile_kernels import (
    BLOCK_COLUMNS,
    FIRST,
    ONES,
    SMOOTH_SIZE,
    TILE,
    bright_tiles,
    first_byte,
    inside,
    number_tiles,
    smooth_border_tile,
    smooth_rows,
    smooth_tile,
    sweep,
    tile_peaks,
)

_FEW, _MANY, _MOST = 16, 96, 400  # tiles that tell the noise
QUICK, CAREFUL, EVERYWHERE = 0, 1, 2
_LEAST_NOISE = 0.08
_SURE = 1.25
_RISE = 1.15  # limits; the thinnest of ridges shows 1.25 of its prominence in the highest values of two columns
_LUCK = 0.2  # of the limit by the noise alone, which raises the highest values more than the lowest ones
_CROWD = 0.06  # of all tiles
_HIGHER = 1.35  # times the limit, where most tiles stand out by chance, as those of noise that is cut off at 0 do
_PER_TILE = 64  # candidates at most: they lie four pixels apart


@compiled
@no_type_check
def look(
    image: np.ndarray,
    scale: float,
    threshold: float,
    floor: float,
    rounding: float,
    effort: int,
    queue: np.ndarray,
    heights: np.ndarray,
) -> tuple:
    """Where in one image ridges can be, and how far they have to stand out.

    Parameters
    ----------
    image : (h, w)   uint8 or uint16, to be read only
    scale : float   grey values for one step of the image
    threshold : float   least prominence as a multiple of the prominence of the noise
    floor : float   least prominence, grey values
    rounding : float   error of the grey values by which a ridge may stand out less in them
    effort : int   QUICK; CAREFUL, with more tiles, for stripes near the limit that the noise sets; or EVERYWHERE, in all tiles
    queue : (rows * columns or more,)   int32; becomes the tiles that are to be searched
    heights : (2, rows * columns)   float32; becomes how high each of these is above the darkest one around, and that one, in steps; not set if all
        tiles are searched

    Returns
    -------
    n_queue : int   how many these are
    least_steep, least_flat : float   least prominence of steep and of flat candidates
    by_noise : float   what it would be by the noise alone
    """
    h, w = image.shape
    rows, columns = (h + TILE - 1) // TILE, (w + TILE - 1) // TILE
    tops, lows = np.empty((rows, columns), image.dtype), np.empty((rows, columns), image.dtype)
    n_tiles = rows * columns
    half, smooth = np.zeros(SMOOTH_SIZE + 6, np.float32), np.empty(SMOOTH_SIZE, np.float32)
    limits = np.empty(2, np.float32)
    if effort != EVERYWHERE:
        sweep(image, tops, lows)
    by_noise = _limits(image, scale, rows, columns, threshold, floor, effort, half, smooth, limits)
    if effort == EVERYWHERE:
        n_queue = n_tiles
        for k in range(n_tiles):
            queue[k] = k
    else:
        least = (_RISE * min(limits[0], limits[1]) + _LUCK * by_noise - 0.25 * rounding) / scale
        n_queue = bright_tiles(tops, lows, least, queue, heights)
        if effort == QUICK and n_queue > _CROWD * n_tiles and by_noise >= floor:
            by_chance = n_queue - bright_tiles(tops, lows, _HIGHER * least, queue, heights)
            n_queue = (
                n_queue - by_chance if 2 * by_chance > n_queue else bright_tiles(tops, lows, least, queue, heights)
            )
    return n_queue, limits[0], limits[1], by_noise


@compiled
@no_type_check
def candidates(
    image: np.ndarray,
    scale: float,
    n_queue: int,
    least_steep: float,
    least_flat: float,
    height: np.ndarray,
    order: np.ndarray,
    light: np.ndarray,
    where: np.ndarray,
    what: np.ndarray,
) -> tuple:
    """Candidates of steep and of flat chains in one image.

    Parameters
    ----------
    image, scale, n_queue, least_steep, least_flat : of :func:`look`, which has put the tiles into ``order[0]``
    height : (rows, columns)   float32; the first ``n_tiles`` values become the heights of the tiles that were searched
    order : (3, (rows + 2) * columns + 2)   int32; becomes the tiles that were searched, and for each tile when that was (-1 where it was not)
    light : (rows * columns + 1,)   uint64; becomes the bright pixels of the tiles that were searched
    where : (4, m)   int32; becomes line and place of steep candidates, then of flat ones; the line is the row of steep ones, the column of flat ones
    what : (8, m)   float32; becomes prominence, height above what is dark around, place of the top between the pixels, and mean fall over two
        pixels, of steep candidates, then of flat ones

    Returns
    -------
    n_tiles : int   tiles that were searched; negative if there is no room for their candidates
    n_steep, n_flat : int   candidates
    """
    h, w = image.shape
    queue, number = order[0], order[1]
    rows, columns = height.shape
    height = height.reshape(-1)
    half, smooth = np.zeros(SMOOTH_SIZE + 6, np.float32), np.empty(SMOOTH_SIZE, np.float32)
    number_tiles(queue, n_queue, number)
    peaks = np.empty((TILE, TILE), np.uint8)
    words = peaks.reshape(-1).view(np.uint64)
    dim = DIM * min(least_steep, least_flat)
    count = np.zeros(2, np.int64)
    done = 0
    while done < n_queue:
        if max(count[0], count[1]) + _PER_TILE > where.shape[1]:
            return -1, 0, 0
        a, b = queue[done] // columns, queue[done] % columns
        if inside(a, b, h, w):
            smooth_tile(image, scale, a, b, half, smooth)
        else:
            smooth_border_tile(image, scale, a, b, half, smooth)
        low = lowest(smooth)
        height[done] = highest(smooth, half) - low
        tile_peaks(smooth, least_steep, least_flat, bright_limit(low, height[done], dim), peaks)
        light[done] = bright_pixels(words, a * TILE, b * TILE, h, w)
        kinds = np.uint64(0)
        for k in range(len(words)):
            kinds |= words[k]
        near = 0
        for kind in range(2):
            if kinds >> np.uint64(kind) & ONES:
                near |= _collect(words, smooth, low, kind, a, b, h, w, where, what, count)
        if near:
            n_queue = _neighbours(near, a, b, rows, columns, number, queue, n_queue)
        done += 1
    return n_queue, count[0], count[1]


@compiled
@no_type_check
def _collect(
    words: np.ndarray,
    smooth: np.ndarray,
    low: float,
    kind: int,
    a: int,
    b: int,
    h: int,
    w: int,
    where: np.ndarray,
    what: np.ndarray,
    count: np.ndarray,
) -> int:
    """Append the candidates of a tile, given as eight bytes a word; returns a bit for each of the nine tiles around that a chain may come from, or
    go to.
    """
    near = 0
    n = count[kind]
    first, second, fact = 2 * kind, 2 * kind + 1, 4 * kind
    step, along, across = (1, 3, 2) if kind == 0 else (BLOCK_COLUMNS, 2, 3)
    edge_rows, edge_columns = (0, 3) if kind == 0 else (3, 0)
    for i in range(TILE):
        y = 0 if i < along else 2 if i >= TILE - along else 1
        for part in range(TILE // 8):
            rest = words[TILE // 8 * i + part] >> np.uint64(kind) & ONES
            while rest:
                j = 8 * part + first_byte(rest)
                rest &= rest - np.uint64(1)
                row, column = a * TILE + i, b * TILE + j
                if row < edge_rows or row >= h - edge_rows or column < edge_columns or column >= w - edge_columns:
                    continue
                t = FIRST + i * BLOCK_COLUMNS + j
                where[first, n], where[second, n] = (row, column) if kind == 0 else (column, row)
                top, before, behind = smooth[t], smooth[t] - smooth[t - step], smooth[t] - smooth[t + step]
                what[fact, n] = top - max(smooth[t - 3 * step], smooth[t + 3 * step])
                what[fact + 1, n] = top - low
                what[fact + 2, n] = np.float32(0.5) * (before - behind) / (before + behind)
                what[fact + 3, n] = top - np.float32(0.5) * (smooth[t - 2 * step] + smooth[t + 2 * step])
                n += 1
                x = 0 if j < across else 2 if j >= TILE - across else 1
                near |= 1 << (3 * y + x) | 1 << (3 * y + 1) | 1 << (3 + x)
    count[kind] = n
    return near


@compiled
@no_type_check
def _neighbours(
    near: int, a: int, b: int, rows: int, columns: int, number: np.ndarray, queue: np.ndarray, n_queue: int
) -> int:
    """Put neighbours of a tile into the queue that are not yet there."""
    for k in range(9):
        if near >> k & 1:
            i, j = a + k // 3 - 1, b + k % 3 - 1
            if 0 <= i < rows and 0 <= j < columns and number[i * columns + j] < 0:
                number[i * columns + j] = n_queue
                queue[n_queue] = i * columns + j
                n_queue += 1
    return n_queue


@compiled
@no_type_check
def _limits(
    image: np.ndarray,
    scale: float,
    rows: int,
    columns: int,
    threshold: float,
    floor: float,
    effort: int,
    half: np.ndarray,
    smooth: np.ndarray,
    limits: np.ndarray,
) -> float:
    """Least prominence of steep and of flat candidates; returns what it would be by the noise alone.

    A few tiles show whether the noise counts at all; if it may, more tell how large it is.
    """
    h, w = image.shape
    many = _MANY if effort == QUICK else _MOST
    samples = np.empty((2, max(many * 3 * TILE, _FEW * 5 * TILE)), np.float32)
    count = np.zeros(2, np.int64)
    least = np.inf
    for tiles in (_FEW, many):
        number, step = min(tiles, rows * columns), 1 if rows * columns <= _FEW else 2
        count[0] = count[1] = 0
        for k in range(number):
            tile = k * rows * columns // number
            tile += k * 7 % ((k + 1) * rows * columns // number - tile)  # not all in the same columns
            top, left = smooth_rows(image, scale, tile // columns, tile % columns, half, smooth)
            for i in range(1, 6, step):
                t, y = 5 + i * BLOCK_COLUMNS, top + 3 * i
                low, high = max(3 - left, 0), min(TILE, w - 3 - left)
                if low < high and y < h:
                    count[0] = _drops(smooth, t + low, t + high, 3, samples[0], count[0])
                if 3 <= y < h - 3:
                    count[1] = _drops(smooth, t, t + min(TILE, w - left), BLOCK_COLUMNS, samples[1], count[1])
        least, most = np.inf, 0.0
        for kind in range(2):
            values = samples[kind, : count[kind]]
            centre = np.float32(median(values))
            for k in range(len(values)):
                values[k] = abs(values[k] - centre)
            noise = 1.4826 * median(values)
            limits[kind] = max(floor, threshold * max(noise, _LEAST_NOISE))
            least, most = min(least, threshold * noise), max(most, threshold * noise)
        if _SURE * most < floor and threshold * _LEAST_NOISE <= floor:
            break
    return least


@compiled
@no_type_check
def _drops(smooth: np.ndarray, begin: int, end: int, away: int, out: np.ndarray, n: int) -> int:
    """Put the heights of values above the higher of two, away to both sides, behind the first n; returns how many there are then."""
    for t in range(begin, end):
        out[n + t - begin] = smooth[t] - max(smooth[t - away], smooth[t + away])
    return n + end - begin
