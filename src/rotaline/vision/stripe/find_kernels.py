"""Candidates of ridges in the tiles of an image that can hold some, by the definition of :mod:`rotaline.vision.stripe.ridges`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.explain_kernels import explained
from rotaline.vision.stripe.link_kernels import link
from rotaline.vision.stripe.settle_kernels import compete, median
from rotaline.vision.stripe.tile_kernels import (
    BLOCK_COLUMNS,
    BLOCK_ROWS,
    FIRST,
    RAW_SIZE,
    SMOOTH_SIZE,
    TILE,
    bright_tiles,
    smooth_tile,
    sweep,
    tile_peaks,
)

_FEW, _MANY, _MOST = 12, 96, 400  # tiles that tell the noise
_CLEAR = 1.5  # limits: to a stripe as prominent the exact limit, and what stands out by less, does not matter
QUICK, CAREFUL, EVERYWHERE = 0, 1, 2
_LEAST_NOISE = 0.08
_SURE = 1.25
_SPLIT = 0.7  # of the limit: a thin ridge between two pairs of rows shows so little in means of 2 x 2 values
_LUCK = (
    0.35  # of the limit by the noise alone: the highest of the means on top of a ridge is so much above the usual one
)
_CROWD = 0.06  # of all tiles
_HIGHER = 1.35  # times the limit, where most tiles stand out by chance, as those of noise that is cut off at 0 do
_PER_TILE = 64  # candidates at most: they lie four pixels apart


@compiled
@no_type_check
def search(
    pixels: np.ndarray,
    size: int,
    threshold: float,
    floor: float,
    rounding: float,
    effort: int,
    taken: np.ndarray,
    mark: int,
    finest: np.ndarray,
    smooth: np.ndarray,
) -> tuple:
    """Chains of candidates of one image.

    Parameters
    ----------
    pixels : (h, size * w)   bytes of the values of the image
    size : int   bytes of a value: 1 and 2 for whole numbers, 4 for floating point ones
    threshold : float   least prominence as a multiple of the prominence of the noise
    floor : float   least prominence
    rounding : float   step of the values
    effort : int   QUICK; CAREFUL, with more tiles, for stripes near the limit that the noise sets; or EVERYWHERE, in all tiles
    taken : (h, w)   uint8, nowhere ``mark``, which is set here
    finest : (h, w)   float32, zeros; zeros again afterwards
    smooth : (n, SMOOTH_SIZE)   float32, room for the smoothed values of so many tiles

    Returns
    -------
    line, place, prominence : (n,)   of the points, in order along each chain; the line is the row of steep chains, the column of flat ones
    start : (k + 1,)   where each chain begins
    steep, factor : (k,)   the kind of each chain, and 1
    begin, end, chain : (m,)   the parts of chains that no stronger one covers
    plain : bool   nothing in the image needs to be looked at in a smaller size
    clear : bool   more effort would not show more
    """
    h, w = pixels.shape[0], pixels.shape[1] // size
    rows, columns = -(-h // TILE), -(-w // TILE)
    n_tiles = rows * columns
    raw = np.empty(RAW_SIZE, np.uint8)
    block = np.empty(BLOCK_ROWS * BLOCK_COLUMNS, np.float32)
    half = np.empty(SMOOTH_SIZE, np.float32)
    limits = np.empty(2, np.float32)
    tops = np.empty((rows, columns), np.float32)
    lows = np.empty((rows, columns), np.float32)
    if effort != EVERYWHERE:
        sweep(pixels, size, tops, lows)
    by_noise = _limits(pixels, size, rows, columns, threshold, floor, effort, raw, block, half, limits)
    queue = np.empty(n_tiles, np.int32)
    number = np.full(n_tiles, -1, np.int32)
    if effort == EVERYWHERE:
        n_queue = n_tiles
        for k in range(n_tiles):
            queue[k] = k
    else:
        least = _SPLIT * min(limits[0], limits[1]) + _LUCK * by_noise - 0.25 * rounding
        n_queue = bright_tiles(tops, lows, least, queue)
        if effort == QUICK and n_queue > _CROWD * n_tiles and by_noise >= floor:
            by_chance = n_queue - bright_tiles(tops, lows, _HIGHER * least, queue)
            n_queue = n_queue - by_chance if 2 * by_chance > n_queue else bright_tiles(tops, lows, least, queue)
    for k in range(n_queue):
        number[queue[k]] = k
    room = _PER_TILE * 32
    line, place = np.empty((2, room), np.int32), np.empty((2, room), np.int32)
    prominence = np.empty((2, room), np.float32)
    peaks, bit = np.zeros(TILE * BLOCK_COLUMNS, np.uint16), _bits()
    count = np.zeros(2, np.int64)
    done = 0
    while done < n_queue:
        if max(count[0], count[1]) + _PER_TILE > room:
            room *= 4
            line, place, prominence = _larger(line, 2, room), _larger(place, 2, room), _larger(prominence, 2, room)
        a, b = queue[done] // columns, queue[done] % columns
        values = smooth[min(done, len(smooth) - 1)]
        smooth_tile(pixels, size, a, b, raw, block, half, values)
        near = 0
        # the step as a number, not a variable: known beforehand, it makes faster loops
        if tile_peaks(values, 1, limits[0], bit, peaks):
            near |= _collect(peaks, values, 0, a, b, h, w, line[0], place[0], prominence[0], count)
        if tile_peaks(values, BLOCK_COLUMNS, limits[1], bit, peaks):
            near |= _collect(peaks, values, 1, a, b, h, w, line[1], place[1], prominence[1], count)
        if near:
            n_queue = _neighbours(near, a, b, rows, columns, number, queue, n_queue)
        done += 1
    n = count[0] + count[1]
    out_line, out_place, out_prominence = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.float32)
    start = np.zeros(n // 4 + 1, np.int32)
    n_chains, n_steep = 0, 0
    for kind in range(2):
        n_steep = n_chains
        n_chains = link(
            line[kind], place[kind], prominence[kind], count[kind], w if kind else h, out_line, out_place, out_prominence, start,
            n_chains
        )  # fmt: skip
    n = start[n_chains]
    line, place, prominence, start = out_line[:n], out_place[:n], out_prominence[:n], start[: n_chains + 1]
    steep = np.zeros(n_chains, np.bool_)
    for k in range(n_steep):
        steep[k] = True
    factor = np.ones(n_chains, np.int32)
    begin, end, chain = compete(line, place, prominence, start, steep, factor, taken, mark, finest)
    plain = n_queue <= len(smooth) and explained(
        line,
        place,
        prominence,
        steep,
        begin,
        end,
        chain,
        smooth,
        queue[:n_queue],
        number,
        columns,
        limits,
        h,
        w,
    )
    clear = by_noise < floor or _strongest(prominence, begin, end) > _CLEAR * max(limits[0], limits[1])
    return line, place, prominence, start, steep, factor, begin, end, chain, plain, clear


@compiled
@no_type_check
def _strongest(prominence: np.ndarray, begin: np.ndarray, end: np.ndarray) -> float:
    """Usual prominence of the part of a chain with the largest sum of it; 0 if there is none."""
    most, usual = 0.0, 0.0
    for p in range(len(begin)):
        total = prominence[begin[p] : end[p]].sum()
        if total > most:
            most, usual = total, median(prominence[begin[p] : end[p]])
    return usual


@compiled
@no_type_check
def _larger(values: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """The same values in a larger array."""
    out = np.empty((rows, columns), values.dtype)
    for i in range(values.shape[0]):
        for j in range(values.shape[1]):
            out[i, j] = values[i, j]
    return out


@compiled
@no_type_check
def _bits() -> np.ndarray:
    """A number with one bit set for each column of a tile, row after row of its block; 0 beside the tile."""
    bit = np.zeros(TILE * BLOCK_COLUMNS, np.uint16)
    for i in range(TILE):
        for j in range(TILE):
            bit[i * BLOCK_COLUMNS + j] = 1 << j
    return bit


@compiled
@no_type_check
def _collect(
    peaks: np.ndarray,
    smooth: np.ndarray,
    kind: int,
    a: int,
    b: int,
    h: int,
    w: int,
    line: np.ndarray,
    place: np.ndarray,
    prominence: np.ndarray,
    count: np.ndarray,
) -> int:
    """Append the candidates of a tile; returns a bit for each of the nine tiles around that a chain may come from, or go to."""
    near = 0
    n = count[kind]
    step, along, across = (1, 3, 2) if kind == 0 else (BLOCK_COLUMNS, 2, 3)
    edge_rows, edge_columns = (0, 3) if kind == 0 else (3, 0)
    for i in range(TILE):
        bits = np.int64(peaks[i * BLOCK_COLUMNS])
        j = -1
        while bits:
            j += 1
            while bits & 15 == 0:
                bits >>= 4
                j += 4
            while bits & 1 == 0:
                bits >>= 1
                j += 1
            bits >>= 1
            row, column = a * TILE + i, b * TILE + j
            if row < edge_rows or row >= h - edge_rows or column < edge_columns or column >= w - edge_columns:
                continue
            t = FIRST + i * BLOCK_COLUMNS + j
            line[n], place[n] = (row, column) if kind == 0 else (column, row)
            prominence[n] = smooth[t] - max(smooth[t - 3 * step], smooth[t + 3 * step])
            n += 1
            y = 0 if i < along else 2 if i >= TILE - along else 1
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
    pixels: np.ndarray,
    size: int,
    rows: int,
    columns: int,
    threshold: float,
    floor: float,
    effort: int,
    raw: np.ndarray,
    block: np.ndarray,
    half: np.ndarray,
    limits: np.ndarray,
) -> float:
    """Least prominence of steep and of flat candidates; returns what it would be by the noise alone, or something less.

    A few tiles show whether the noise counts at all; if it may, more tell how large it is.
    """
    h, w = pixels.shape[0], pixels.shape[1] // size
    smooth = np.empty(SMOOTH_SIZE, np.float32)
    limits[0] = limits[1] = floor
    quiet = floor / (1.4826 * threshold * _SURE) if threshold > 0.0 else np.inf
    if floor < threshold * _LEAST_NOISE:
        quiet = 0.0
    first, step = (0, 1) if rows * columns <= _FEW else (2, 5)
    many = _MANY if effort == QUICK else _MOST
    samples = np.empty((2, max(many * 3 * TILE, _FEW * TILE * TILE)), np.float32)
    count = np.zeros(2, np.int64)
    for tiles in (_FEW, many):
        number = min(tiles, rows * columns)
        count[0] = count[1] = 0
        for k in range(number):
            tile = k * rows * columns // number
            tile += k * 7 % ((k + 1) * rows * columns // number - tile)  # not all in the same columns
            top, left = tile // columns * TILE, tile % columns * TILE
            smooth_tile(pixels, size, tile // columns, tile % columns, raw, block, half, smooth)
            for i in range(first, min(TILE, h - top), step):
                t = FIRST + i * BLOCK_COLUMNS
                low, high = max(3 - left, 0), min(TILE, w - 3 - left)
                if low < high:
                    count[0] += _drops(smooth, t + low, t + high, 3, samples[0, count[0] :])
                if 3 <= top + i < h - 3:
                    count[1] += _drops(smooth, t, t + min(TILE, w - left), 3 * BLOCK_COLUMNS, samples[1, count[1] :])
        steep, flat = samples[0, : count[0]], samples[1, : count[1]]
        if tiles == _FEW and _within(steep, quiet) and _within(flat, quiet):
            calm = _within(steep, 0.5 * quiet) or _within(flat, 0.5 * quiet)
            return 0.0 if calm else 0.4 * floor
    least = np.inf
    for kind in range(2):
        values = samples[kind, : (count[kind] - 1) | 1]  # an odd number has a quicker median
        centre = median(values)
        for k in range(len(values)):
            values[k] = abs(values[k] - centre)
        noise = 1.4826 * median(values)
        limits[kind] = max(floor, threshold * max(noise, _LEAST_NOISE))
        least = min(least, threshold * noise)
    return least


@compiled
@no_type_check
def _drops(smooth: np.ndarray, begin: int, end: int, away: int, out: np.ndarray) -> int:
    """Heights of values above the higher of two, away to both sides; returns how many."""
    for k in range(end - begin):
        t = begin + k
        out[k] = smooth[t] - max(smooth[t - away], smooth[t + away])
    return end - begin


@compiled
@no_type_check
def _within(values: np.ndarray, tolerance: float) -> bool:
    """Whether three of five values lie about their usual value, the mean of those near 0, by less than the tolerance."""
    near, limit = np.float32(8.0 * tolerance), np.float32(tolerance)
    total, n = np.float32(0.0), np.int32(0)
    for k in range(len(values)):
        close = abs(values[k]) < near
        total += values[k] if close else np.float32(0.0)
        n += np.int32(close)
    usual = np.float32(total / max(n, 1))
    n = np.int32(0)
    for k in range(len(values)):
        n += np.int32(abs(values[k] - usual) < limit)
    return n >= 0.6 * len(values)
