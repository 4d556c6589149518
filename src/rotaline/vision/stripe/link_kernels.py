"""Candidates of ridges linked to chains."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

_SHORTEST = 4  # points of a chain
_GAPS = 3  # lines from one point to the next, at most; the place may differ by one pixel more


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
    first = np.zeros(n_lines + _GAPS + 2, np.int32)
    for k in range(n):
        first[line[k] + 1] += 1
    for i in range(len(first) - 1):
        first[i + 1] += first[i]
    fill = first.copy()
    lines, places, order = np.empty(n, np.int32), np.empty(n, np.int32), np.empty(n, np.int32)
    for k in range(n):
        i, own = line[k], place[k]
        at = fill[i]
        fill[i] += 1
        while at > first[i] and places[at - 1] > own:
            places[at], order[at] = places[at - 1], order[at - 1]
            at -= 1
        lines[fill[i] - 1], places[at], order[at] = i, own, k
    successor, linked = np.full(n, -1, np.int32), np.zeros(n, np.bool_)
    unlinked = np.arange(n)
    left = n
    for gap in range(1, _GAPS + 1):
        number, left = left, 0
        for q in range(number):
            k = unlinked[q]
            i = lines[k]
            low, high = first[i + gap], first[i + gap + 1]
            if low < high:
                m = low if high - low == 1 else _nearest(places, low, high, places[k])
                near = not linked[m] and abs(places[m] - places[k]) <= gap + 1
                alone = first[i + 1] - first[i] == 1
                if near and (alone or _nearest(places, first[i], first[i + 1], places[m]) == k):
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
        m = k
        while m >= 0:
            out_line[to], out_place[to] = lines[m], places[m]
            out_prominence[to], out_above[to], out_origin[to] = prominence[order[m]], above[order[m]], order[m]
            to += 1
            m = successor[m]
        if to - begin < _SHORTEST:
            to = begin
        else:
            n_chains += 1
            start[n_chains] = to
    return n_chains


@compiled
@no_type_check
def _nearest(places: np.ndarray, low: int, high: int, wanted: int) -> int:
    """Index of the place nearest to the wanted one among the ascending ones from low to high; the smaller of two as near."""
    while high - low > 8:
        middle = (low + high) // 2
        if places[middle] <= wanted:
            low = middle
        else:
            high = middle + 1
    best = low
    for k in range(low + 1, high):
        if abs(places[k] - wanted) < abs(places[best] - wanted):
            best = k
    return best
