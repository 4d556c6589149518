"""Which chains stay: they compete for the pixels that they cover, and what is faint beside the strongest one goes."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

BESIDE = 4.5  # px on both sides of its points that a chain covers
_MAX_CHAINS = 400
_SHORTEST = 4  # points of a chain
_CROWD = 20  # chains; a stripe alone makes fewer
_CLEAR, _MOST_OF_ALL = 5.0, 0.9
_CROWD_PART, _CROWD_SHARE, _FAINT_PART = 0.25, 0.04, 0.035


@compiled
@no_type_check
def compete(
    line: np.ndarray,
    place: np.ndarray,
    prominence: np.ndarray,
    start: np.ndarray,
    steep: np.ndarray,
    factor: np.ndarray,
    n: int,
    h: int,
    w: int,
    parts: np.ndarray,
    finest: np.ndarray,
    beside: float,
) -> int:
    """Give every pixel of an image of h x w to one of n chains only, the chain with the larger sum of prominence first.

    What a chain covers is a run of pixels in each of its rows (steep) or columns. The runs of a row or column hang together: from the last one
    that was covered to the one before, and so on.

    Parameters
    ----------
    line, place, prominence : (k,)   points of the chains, in px of the size of the image in which they were found
    start : (n + 1,)   where each chain begins
    steep, factor : (n,)   kind of each chain, and px of the full image for one of its own
    parts : (3, m)   becomes the parts that stay: where they begin and end, and the chains they are of
    finest : (h, w)   float32, zeros; zeros again afterwards; not used where all chains are of the full size
    beside : float   px on both sides of its points that a chain of the full size covers

    Returns
    -------
    n_parts : int
    """
    strength = np.zeros(n, np.float64)
    for c in range(n):
        for k in range(np.uint64(start[c]), np.uint64(start[c + 1])):
            strength[c] += prominence[k]
        strength[c] *= factor[c]
    order = _descending(strength)[:_MAX_CHAINS]
    coarse, room = False, 0
    for c in order:
        coarse |= factor[c] > 1
        room += (line[start[c + 1] - 1] - line[start[c]] + 1) * factor[c]
    if coarse:
        order = _coarse_back(line, place, prominence, start, steep, factor, strength, order, finest, beside)
    newest, before = np.zeros(h + w, np.uint32), np.empty(room + 1, np.uint32)
    low, high = np.empty(room + 1, np.int32), np.empty(room + 1, np.int32)
    n_runs, m = 1, 0
    for c in order:
        first, last, is_steep, size = m, start[c + 1], steep[c], factor[c]
        free = start[c]
        for k in range(start[c], last + 1):
            if k < last:
                row, column = _pixel(line[k], place[k], is_steep, size, h, w)
                if not (
                    _in_run(newest[np.uint64(row)], column, before, low, high)
                    or _in_run(newest[np.uint64(h + column)], row, before, low, high)
                ):
                    continue
            if k - free >= _SHORTEST:
                parts[0, m], parts[1, m], parts[2, m] = free, k, c
                m += 1
            free = k + 1
        for p in range(first, m):
            n_runs = _cover(
                line, place, parts[0, p], parts[1, p], size, beside, 0 if is_steep else h, h if is_steep else w,
                newest, before, low, high, n_runs,
            )  # fmt: skip
    return m


@compiled
@no_type_check
def _in_run(run: int, at: int, before: np.ndarray, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether a place is in a run, or one of those before it."""
    while run:
        if low[run] <= at <= high[run]:
            return True
        run = before[run]
    return False


@compiled
@no_type_check
def _cover(
    line: np.ndarray,
    place: np.ndarray,
    begin: int,
    end: int,
    factor: int,
    beside: float,
    offset: int,
    n_lines: int,
    newest: np.ndarray,
    before: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    n_runs: int,
) -> int:
    """Append the runs that a part of a chain covers; returns how many there are then.

    ``offset`` is the place of line 0 in ``newest``, which counts rows first and then columns.
    """
    first, last, half = _reach(line, begin, end, factor, beside, n_lines)
    run = np.uint64(n_runs)
    k = begin
    for at in range(first, last):
        if factor == 1 and last - first == end - begin:  # the usual case, without gaps
            middle = place[begin + at - first]
        else:
            middle, k = _middle(line, place, k, end, factor, at)
        own = np.uint64(offset + at)
        low[run], high[run], before[run] = middle - half, middle + half, newest[own]
        newest[own] = run
        run += np.uint64(1)
    return run


@compiled
@no_type_check
def _descending(values: np.ndarray) -> np.ndarray:
    """Order of the values, largest first, by Shell's method."""
    order = np.arange(len(values))
    gap = len(values) // 2
    while gap > 0:
        for i in range(gap, len(order)):
            moved = order[i]
            j = i
            while j >= gap and (
                values[order[j - gap]] < values[moved]
                or (values[order[j - gap]] == values[moved] and order[j - gap] > moved)
            ):
                order[j] = order[j - gap]
                j -= gap
            order[j] = moved
        gap //= 2
    return order


@compiled
@no_type_check
def median(values: np.ndarray) -> float:
    """Median of float32 values; of an even number of them the mean of the two in the middle.

    The range of whole numbers in the same order is halved until one is left, and ends at those that there are: counting them is quick.
    """
    n = len(values)
    keys, result = values.view(np.int32).copy(), np.empty(2, np.int32)
    for k in range(n):
        keys[k] ^= (keys[k] >> np.int32(31)) & np.int32(0x7FFFFFFF)
    low, high = keys[0], keys[0]
    for k in range(n):
        low, high = min(low, keys[k]), max(high, keys[k])
    least = low
    while low < high:
        middle = np.int32((np.int64(low) + np.int64(high)) >> 1)
        count, under, over = np.int32(0), low, high
        for k in range(n):
            lower = keys[k] <= middle
            count += np.int32(lower)
            under, over = max(under, keys[k] if lower else low), min(over, high if lower else keys[k])
        if 2 * count > n:
            high = under
        else:
            low = over
    count, before = np.int32(0), least
    for k in range(n):
        count += np.int32(keys[k] < low)
        before = max(before, keys[k] if keys[k] < low else least)
    result[0], result[1] = before if 2 * count == n else low, low
    for k in range(2):
        result[k] ^= (result[k] >> np.int32(31)) & np.int32(0x7FFFFFFF)
    middles = result.view(np.float32)
    return 0.5 * (np.float64(middles[0]) + np.float64(middles[1]))


@compiled
@no_type_check
def _coarse_back(
    line: np.ndarray,
    place: np.ndarray,
    prominence: np.ndarray,
    start: np.ndarray,
    steep: np.ndarray,
    factor: np.ndarray,
    strength: np.ndarray,
    order: np.ndarray,
    finest: np.ndarray,
    beside: float,
) -> np.ndarray:
    """The order with those chains last that cover finer ones which are clearly stronger together.

    The finer ones are counted once for each row (column) of the coarse one.
    """
    h, w = finest.shape
    back = np.zeros(len(order), np.bool_)
    for scale in (1, 2, 4):
        if scale > 1:
            for i in range(len(order)):
                c = order[i]
                if factor[c] == scale:
                    inside = _sum(line, place, start[c], start[c + 1], steep[c], scale, beside, finest)
                    back[i] = inside > np.sqrt(scale) * strength[c]
        for c in order:
            if factor[c] == scale:
                for k in range(start[c], start[c + 1]):
                    row, column = _pixel(line[k], place[k], steep[c], scale, h, w)
                    finest[row, column] = max(finest[row, column], prominence[k] * scale)
    for c in order:
        for k in range(start[c], start[c + 1]):
            row, column = _pixel(line[k], place[k], steep[c], factor[c], h, w)
            finest[row, column] = 0.0
    out = np.empty_like(order)
    n = 0
    for late in (False, True):
        for i in range(len(order)):
            if back[i] == late:
                out[n] = order[i]
                n += 1
    return out


@compiled
@no_type_check
def _pixel(line: int, place: int, steep: bool, factor: int, h: int, w: int) -> tuple[int, int]:
    """Row and column of the pixel of the full image at a point."""
    middle = factor >> 2 << 1
    row, column = (line, place) if steep else (place, line)
    return min(row * factor + middle, h - 1), min(column * factor + middle, w - 1)


@compiled
@no_type_check
def _middle(line: np.ndarray, place: np.ndarray, k: int, end: int, factor: int, at: int) -> tuple[int, int]:
    """Place of a chain on line ``at`` of the full image, and the last point that does not lie beyond it; k is one before."""
    middle = 0.5 * (factor - 1)
    while k + 1 < end and line[k + 1] * factor + middle <= at:
        k += 1
    between = at - line[k] * factor - middle
    middle += place[k] * factor
    if k + 1 < end:
        middle += between * (place[k + 1] - place[k]) / (line[k + 1] - line[k])
    return int(np.rint(middle)), k


@compiled
@no_type_check
def _reach(line: np.ndarray, begin: int, end: int, factor: int, beside: float, n_lines: int) -> tuple[int, int, int]:
    """First line of the full image that a chain covers, the first that it does not cover any more, and how far it covers to both sides."""
    first = line[begin] * factor + factor // 2
    last = line[end - 1] * factor + (factor - 1) // 2
    return first, min(last, n_lines - 1) + 1, int(np.rint(2.5 * (factor - 1) + beside))


@compiled
@no_type_check
def _sum(
    line: np.ndarray,
    place: np.ndarray,
    begin: int,
    end: int,
    steep: bool,
    factor: int,
    beside: float,
    field: np.ndarray,
) -> float:
    """Sum over the pixels that a chain covers."""
    h, w = field.shape
    first, last, half = _reach(line, begin, end, factor, beside, h if steep else w)
    k = begin
    total = 0.0
    for at in range(first, last):
        middle, k = _middle(line, place, k, end, factor, at)
        if steep:
            for j in range(max(middle - half, 0), min(middle + half + 1, w)):
                total += field[at, j]
        else:
            for i in range(max(middle - half, 0), min(middle + half + 1, h)):
                total += field[i, at]
    return total


@compiled
@no_type_check
def _mostly_above(values: np.ndarray, begin: int, end: int, limit: float) -> bool:
    """Whether more than half of the values from begin to end are above a limit, as their median then is."""
    least = np.float32(limit)
    n = np.int32(0)
    for k in range(np.uint64(begin), np.uint64(end)):
        n += np.int32(values[k] > least)
    return 2 * n > end - begin


@compiled
@no_type_check
def choose(
    line: np.ndarray,
    place: np.ndarray,
    prominence: np.ndarray,
    between: np.ndarray,
    spread: np.ndarray,
    steep: np.ndarray,
    factor: np.ndarray,
    parts: np.ndarray,
    n: int,
    min_length_px: float,
    least: float,
) -> tuple:
    """Those of n parts of chains that are the stripe, strongest first.

    In a crowd, which shows the scene itself, only those stay that have a quarter of the prominence of the strongest one and a twenty-fifth of
    its strength, and are not short. Elsewhere a thirtieth of the prominence is enough.

    Returns
    -------
    uv : (n, 2)   px of the full image
    prominence, chain, spread : (n,)
    scale_px : (k,)
    is_steep : (k,)
    crowded : bool
    clear : bool   all were found at the full size, and nine in ten points stand out by so many times the ``least`` prominence
    strength, prominence, length_px : of the strongest part: the sum and the median of its prominence, and its length
    """
    begin, end, chain = parts[0], parts[1], parts[2]
    strength = np.zeros(n, np.float64)
    n_long = 0
    for p in range(n):
        for k in range(np.uint64(begin[p]), np.uint64(end[p])):
            strength[p] += prominence[k]
        strength[p] *= factor[chain[p]]
        n_long += (end[p] - begin[p]) * factor[chain[p]] >= min_length_px
    order = _descending(strength)
    best, usual, length = 0.0, 0.0, 0.0
    if n > 0:
        first = order[0]
        best, usual = strength[first], median(prominence[begin[first] : end[first]])
        length = float((end[first] - begin[first]) * factor[chain[first]])
    crowded = n_long > _CROWD
    part, share = (_CROWD_PART, _CROWD_SHARE) if crowded else (_FAINT_PART, 0.0)
    kept = np.empty(n, np.int64)
    m, size = 0, 0
    for p in order:
        if crowded and (end[p] - begin[p]) * factor[chain[p]] < min_length_px:
            continue
        if strength[p] > share * best and _mostly_above(prominence, begin[p], end[p], part * usual):
            kept[m] = p
            m += 1
            size += end[p] - begin[p]
    uv = np.empty((size, 2), np.float64)
    number = np.empty(size, np.int64)
    heights, wide = np.empty(size, np.float64), np.empty(size, np.float64)
    scale = np.empty(m, np.float64)
    is_steep = np.empty(m, np.bool_)
    to, fine, n_clear = np.uint64(0), True, 0
    for q in range(m):
        p = kept[q]
        c = chain[p]
        fine &= factor[c] == 1
        off_top = 1.0 if factor[c] == 1 else 0.0  # a pixel of a smaller image is too large for its top to say more
        scale[q], is_steep[q] = factor[c], steep[c]
        off, across, along = 0.5 * (scale[q] - 1.0), np.uint64(1 - is_steep[q]), np.uint64(is_steep[q])
        for k in range(np.uint64(begin[p]), np.uint64(end[p])):
            uv[to, across] = place[k] * scale[q] + off + off_top * between[k]
            uv[to, along] = line[k] * scale[q] + off
            number[to] = q
            heights[to], wide[to] = prominence[k], spread[k]
            n_clear += prominence[k] > _CLEAR * least
            to += np.uint64(1)
    clear = fine and n_clear >= _MOST_OF_ALL * size
    return uv, heights, number, wide, scale, is_steep, crowded, clear, best, usual, length
