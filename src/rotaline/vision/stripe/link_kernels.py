"""Candidates of ridges linked to chains."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

SHORTEST = 4  # points of a chain
GAPS = 3  # lines from one point to the next, at most; the place may differ by one pixel more
_ONE, _EIGHT = np.uint64(1), np.uint64(8)


@compiled
@no_type_check
def link(
    line: np.ndarray,
    place: np.ndarray,
    prominence: np.ndarray,
    above: np.ndarray,
    n: int,
    n_lines: int,
    out_line: np.ndarray,
    out_place: np.ndarray,
    out_prominence: np.ndarray,
    out_above: np.ndarray,
    out_origin: np.ndarray,
    start: np.ndarray,
    n_chains: int,
) -> int:
    """Append the chains of n candidates: those on neighbouring lines are linked where each is the other's nearest.

    ``above`` is how high they are above what is dark around; ``out_origin`` becomes the candidate that each point is.
    Up to two lines may be missing between two linked candidates. ``start[k]`` is where chain k begins in what is appended to. Returns the
    number of chains.
    """
    # unsigned numbers never count from the end, which makes faster loops
    first = np.zeros(n_lines + GAPS + 2, np.uint32)
    for k in range(n):
        first[np.uint64(line[k] + 1)] += np.uint32(1)
    total = np.uint32(0)
    for i in range(len(first)):
        total += first[i]
        first[i] = total
    fill = first.copy()
    lines, places, order = np.empty(n, np.uint32), np.empty(n, np.int32), np.empty(n, np.uint32)
    for k in range(n):
        i, own = np.uint64(line[k]), place[k]
        at = np.uint64(fill[i])
        fill[i] = at + _ONE
        lines[at] = i
        begin = first[i]
        while at > begin and places[at - _ONE] > own:
            places[at], order[at] = places[at - _ONE], order[at - _ONE]
            at -= _ONE
        places[at], order[at] = own, k
    successor, linked = np.full(n, n, np.uint32), np.zeros(n, np.bool_)
    unlinked = np.empty(n, np.uint32)
    left = n
    for gap in range(1, GAPS + 1):
        number, left = left, 0
        for q in range(number):
            k = np.uint64(q) if gap == 1 else np.uint64(unlinked[q])
            i = np.uint64(lines[k])
            j = i + np.uint64(gap)
            low, high = np.uint64(first[j]), np.uint64(first[j + _ONE])
            if low < high:
                m = low if high - low == _ONE else _nearest(places, low, high, places[k])
                if not linked[m] and abs(places[m] - places[k]) <= gap + 1:
                    begin, end = np.uint64(first[i]), np.uint64(first[i + _ONE])
                    if end - begin == _ONE or _nearest(places, begin, end, places[m]) == k:
                        successor[k] = m
                        linked[m] = True
                        continue
            unlinked[left] = k
            left += 1
    to = start[n_chains]
    for k in range(n):
        if linked[k]:
            continue
        begin = to
        m = np.uint64(k)
        while m < n:
            q, r = np.uint64(to), np.uint64(order[m])
            out_line[q], out_place[q] = lines[m], places[m]
            out_prominence[q], out_above[q], out_origin[q] = prominence[r], above[r], order[m]
            to += 1
            m = np.uint64(successor[m])
        if to - begin < SHORTEST:
            to = begin
        else:
            n_chains += 1
            start[n_chains] = to
    return n_chains


@compiled
@no_type_check
def _nearest(places: np.ndarray, low: int, high: int, wanted: int) -> int:
    """Index of the place nearest to the wanted one among the ascending ones from low to high; the smaller of two as near."""
    while high - low > _EIGHT:
        middle = (low + high) >> _ONE
        if places[middle] <= wanted:
            low = middle
        else:
            high = middle + _ONE
    best = low
    for k in range(low + _ONE, high):
        if abs(places[k] - wanted) < abs(places[best] - wanted):
            best = k
    return best
