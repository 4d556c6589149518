"""Chains of points in compiled loops: equal spacing, windows along a chain, breaks. See :mod:`rotaline.vision.stripe.curve`.

The chains stand one after the other; chain k is the points ``starts[k]`` to ``starts[k + 1]``.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

_STEP = 1e-6  # px; points closer together are one
_FORWARD, _ACROSS, _GAP = 0.3, 1.2, 3.0  # px; least step along a chain; more across it, or more in all, is a jump
_BLOCK, _AROUND = 8, 12  # points that share a median; points on either side that it is of


@compiled
@no_type_check
def kth_smallest(values: np.ndarray, n: int, k: int) -> float:
    """The value that would stand at place ``k`` if the first ``n`` were in order; they are partitioned about it."""
    low, high = 0, n - 1
    while high > low:
        a, b, c = values[low], values[(low + high) >> 1], values[high]
        pivot = max(min(a, b), min(max(a, b), c))
        j = low
        for i in range(low, high + 1):  # without a branch: which way it would go cannot be foretold
            x = values[i]
            values[i] = values[j]
            values[j] = x
            j += x < pivot
        if j > low:
            low, high = (low, j - 1) if k < j else (j, high)
            continue
        for i in range(low, high + 1):
            x = values[i]
            values[i] = values[j]
            values[j] = x
            j += x <= pivot
        if k < j or j == low:
            break
        low = j
    return values[k]


@compiled
@no_type_check
def median_of(values: np.ndarray, n: int) -> float:
    """Median of the first ``n`` values, which change places; NaN of none."""
    if n == 0:
        return np.nan
    upper = kth_smallest(values, n, n // 2)
    if n % 2:
        return upper
    lower = values[0]
    for i in range(1, n // 2):
        if values[i] > lower:
            lower = values[i]
    return 0.5 * (lower + upper)


@compiled
@no_type_check
def copy_values(values: np.ndarray, out: np.ndarray) -> None:
    """Copy values to where ``out`` begins."""
    for i in range(len(values)):
        out[i] = values[i]


@compiled
@no_type_check
def greatest(values: np.ndarray) -> float:
    """The greatest of values in double precision, none negative; 0 of none. Such numbers are in order as their bits are."""
    bits, most = values.view(np.int64), np.int64(0)
    for i in range(len(bits)):
        most = max(most, bits[i])
    return np.int64(most).view(np.float64)


@compiled
@no_type_check
def starts_of(chain: np.ndarray) -> np.ndarray:
    """Where each chain starts, and where the last one stops."""
    n = len(chain)
    k = 0
    for i in range(n):
        k += i == 0 or chain[i] != chain[i - 1]
    starts = np.empty(k + 1, np.int64)
    k = 0
    for i in range(n):
        if i == 0 or chain[i] != chain[i - 1]:
            starts[k] = i
            k += 1
    starts[k] = n
    return starts


@compiled
@no_type_check
def resample(uv: np.ndarray, starts: np.ndarray, values: np.ndarray) -> tuple:
    """Points one pixel of arc length apart along each chain, from its first point on, and a value carried along."""
    n, n_chains = len(uv), len(starts) - 1
    pairs = uv.reshape(-1)
    following, next_value = pairs[2:], values[1:]
    step, slope_u, slope_v, slope_w = np.empty(n), np.empty(n), np.empty(n), np.empty(n)  # from each point to the next
    for i in range(n - 1):
        du, dv = following[2 * i] - pairs[2 * i], following[2 * i + 1] - pairs[2 * i + 1]
        length = np.sqrt(du * du + dv * dv)
        some = length > _STEP
        per_length = 1.0 / (length if some else 1.0)
        step[i] = length if some else 0.0
        slope_u[i], slope_v[i], slope_w[i] = du * per_length, dv * per_length, (next_value[i] - values[i]) * per_length
    for k in range(n_chains):
        if starts[k + 1] > starts[k]:
            step[starts[k + 1] - 1] = 0.0
    size = int(step.sum()) + 2 * n_chains + 2
    place, begin, edges = np.empty(n), np.zeros(size, np.int64), np.empty(n_chains + 1, np.int64)
    m = 0
    for k in range(n_chains):
        edges[k], along = m, float(m)
        for i in range(starts[k], starts[k + 1]):
            begin[m] = i  # the point after which the new points stand, until another is passed
            place[i] = along
            along += step[i]
            m = int(along + (1.0 + _STEP))
    edges[n_chains] = m
    out, carried = np.empty((m, 2)), np.empty(m)
    moved, i = out.reshape(-1), 0
    for o in range(m):
        i = max(i, begin[o])
        past = min(o - place[i], step[i])
        moved[2 * o], moved[2 * o + 1] = pairs[2 * i] + past * slope_u[i], pairs[2 * i + 1] + past * slope_v[i]
        carried[o] = values[i] + past * slope_w[i]
    return out, edges, carried


@compiled
@no_type_check
def window_mean(values: np.ndarray, starts: np.ndarray, half_window: int, out: np.ndarray) -> None:
    """Mean over the neighbours of each point in its chain."""
    size = 2 * half_window + 1
    for k in range(len(starts) - 1):
        start, stop = starts[k], starts[k + 1]
        own, mean = values[start:stop], out[start:stop]
        n, total, high = stop - start, 0.0, 0
        for i in range(min(half_window + 1, n)):
            while high < min(i + half_window + 1, n):
                total += own[high]
                high += 1
            mean[i] = total / high
        inner, entering = mean[half_window + 1 :], own[size:]
        for i in range(n - size):
            total += entering[i] - own[i]
            inner[i] = total / size
        for i in range(max(n - half_window, half_window + 1), n):
            total -= own[i - half_window - 1]
            mean[i] = total / (n + half_window - i)


@compiled
@no_type_check
def window_median(values: np.ndarray, start: int, stop: int, i: int, half_window: int, scratch: np.ndarray) -> float:
    """Median about point ``i`` of a chain, which goes on as :meth:`rotaline.vision.stripe.curve.Chains.window_median` says."""
    n = stop - start
    m = 0
    for j in range(i - half_window, i + half_window + 1):
        at = j - start
        if n <= half_window:  # mirrored about its ends
            at = at % (2 * n)
            if at >= n:
                at = 2 * n - 1 - at
        else:
            at = min(max(at, 0), n - 1)
        value = values[start + at]
        if not np.isnan(value):
            scratch[m] = value
            m += 1
    return median_of(scratch, m)


@compiled
@no_type_check
def _may_deviate(width: np.ndarray, tolerance: float) -> np.ndarray:
    """The first points of those blocks of a chain in which a width may be beyond the tolerance of the median of those around it.

    In the others, the widths around are within the tolerance of each other, or more than half of them are not below what the greatest may deviate
    from, and more than half not above what the least may.
    """
    n = len(width)
    number, m = (n + _BLOCK - 1) // _BLOCK, 0
    blocks, least, most = np.empty(number, np.int64), np.empty(number + 3), np.empty(number + 3)
    for b in range(number if n > _AROUND else 0):
        own, low, high, usable = width[min(b * _BLOCK, n - _BLOCK) :], np.inf, 0.0, 0
        for j in range(_BLOCK):
            w = own[j]
            usable += w > 0.0
            low, high = w if w < low else low, w if w > high else high
        least[b + 1], most[b + 1] = low if usable == _BLOCK else 0.0, high
    least[0], most[0] = least[1], most[1]  # the ends are repeated
    least[number + 1 :], most[number + 1 :] = least[number], most[number]
    for b in range(number):
        lowest, highest = least[b], most[b]
        for j in range(1, 4):
            lowest, highest = min(lowest, least[b + j]), max(highest, most[b + j])
        high, low = most[b + 1] / (1.0 + tolerance), least[b + 1] / (1.0 - tolerance)
        if n > _AROUND and high <= lowest and low >= highest:
            continue
        begin, above, below = b * _BLOCK, 0, 0
        middle = (begin + min(begin + _BLOCK, n) - 1) // 2
        for j in range(middle - _AROUND, middle + _AROUND + 1):
            w = width[min(max(j, 0), n - 1)]
            above += w >= high
            below += w <= low
        blocks[m] = begin
        m += least[b + 1] == 0.0 or min(above, below) <= _AROUND or n <= _AROUND
    return blocks[:m]


@compiled
@no_type_check
def _median_is_below(
    values: np.ndarray, start: int, stop: int, i: int, half_window: int, limit: float, scratch: np.ndarray
) -> bool:
    """Whether :func:`window_median` is below a limit: more than half of the values are."""
    if stop - start <= half_window:
        return window_median(values, start, stop, i, half_window, scratch) < limit
    low, high = max(i - half_window, start), min(i + half_window + 1, stop)
    below = (low - i + half_window) * (values[start] < limit) + (i + half_window + 1 - high) * (
        values[stop - 1] < limit
    )
    for j in range(np.uint64(low), np.uint64(high)):
        below += values[j] < limit
    return below > half_window


@compiled
@no_type_check
def alike(width: np.ndarray, starts: np.ndarray, tolerance: float, good: np.ndarray) -> None:
    """Take ``good`` from points whose profile is not as wide as its neighbours' are.

    As :func:`rotaline.vision.stripe.plain.trace.alike`, with one median for every eight points; none where counting tells that no point deviates.
    """
    scratch, deviation = np.empty(64), np.empty(len(width))
    for c in range(len(starts) - 1):
        start, stop = starts[c], starts[c + 1]
        n, known = stop - start, 0  # the deviations of the points before this one are known, where they are asked for
        if n == 0:
            continue
        for begin in _may_deviate(width[start:stop], tolerance):
            low, high = max(begin - 3 * _BLOCK, known), min(begin + 4 * _BLOCK, n)
            for first in range(low, high, _BLOCK):
                last = min(first + _BLOCK, n)
                usual = window_median(width, start, stop, start + (first + last - 1) // 2, _AROUND, scratch)
                for j in range(start + first, start + last):
                    deviation[j] = abs(width[j] - usual) / usual
            known = high
            for j in range(start + begin, start + min(begin + _BLOCK, n)):
                if not deviation[j] <= tolerance:
                    most = 0.25 * (deviation[j] - tolerance)
                    good[j] &= not (np.isnan(most) or _median_is_below(deviation, start, stop, j, 20, most, scratch))


@compiled
@no_type_check
def _plain_runs(uv: np.ndarray, tangent: np.ndarray, good: np.ndarray, starts: np.ndarray) -> tuple:
    """Runs of good points between which all steps go forwards and none is a jump: first point, where it stops, and chain of each."""
    n, n_chains = len(uv), len(starts) - 1
    plain = np.empty(n, np.bool_)
    place, ahead = uv.reshape(-1), tangent.reshape(-1)
    next_place, next_good, next_plain = place[2:], good[1:], plain[1:]
    for i in range(n - 1):
        du, dv = next_place[2 * i] - place[2 * i], next_place[2 * i + 1] - place[2 * i + 1]
        along, across = du * ahead[2 * i] + dv * ahead[2 * i + 1], abs(du * ahead[2 * i + 1] - dv * ahead[2 * i])
        next_plain[i] = (along >= _FORWARD) & (across <= _ACROSS) & (du * du + dv * dv <= _GAP * _GAP)
    for i in range(n - 1):
        next_plain[i] &= good[i] & next_good[i]
    for k in range(n_chains):
        if starts[k] < n:
            plain[starts[k]] = False
    first, stop, chain = np.empty(n + 1, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    m = r = k = 0
    for i in range(n):
        first[m] = i
        m += not plain[i]
    first[m] = n
    for j in range(m):
        i, following = first[j], first[j + 1]
        if good[i]:
            while starts[k + 1] <= i:
                k += 1
            first[r], stop[r], chain[r] = i, following, k
            r += 1
    return first[:r], stop[:r], chain[:r]


@compiled
@no_type_check
def break_chains(uv: np.ndarray, tangent: np.ndarray, good: np.ndarray, starts: np.ndarray, min_points: int) -> tuple:
    """As :func:`rotaline.vision.stripe.plain.curve.break_chains`: the points that stay, and where their chains start."""
    first, stop, chain = _plain_runs(uv, tangent, good, starts)
    r = len(first)
    for _ in range(3):
        kept, last, last_chain, dropped = 0, -1, -1, False
        for j in range(r):
            i, back = first[j], False
            if chain[j] == last_chain:
                du, dv = uv[i, 0] - uv[last, 0], uv[i, 1] - uv[last, 1]
                forward = max(du * tangent[last, 0] + dv * tangent[last, 1], du * tangent[i, 0] + dv * tangent[i, 1])
                back = forward < _FORWARD
            dropped |= back
            last, last_chain = stop[j] - 1, chain[j]
            first[kept], stop[kept], chain[kept] = i + back, last + 1, last_chain
            kept += i + back <= last
        r = kept
        if not dropped:
            break
    index, edges = np.empty(len(uv), np.int64), np.empty(r + 1, np.int64)
    pieces, out, begin, points = 0, 0, 0, 0
    for j in range(r + 1):
        jump = j == r
        if 0 < j < r:
            a, b = stop[j - 1] - 1, first[j]
            du, dv = uv[b, 0] - uv[a, 0], uv[b, 1] - uv[a, 1]
            across = min(abs(du * tangent[a, 1] - dv * tangent[a, 0]), abs(du * tangent[b, 1] - dv * tangent[b, 0]))
            jump = chain[j] != chain[j - 1] or across > _ACROSS or du * du + dv * dv > _GAP * _GAP
        if jump:
            if points >= min_points:
                edges[pieces] = out
                pieces += 1
                for run in range(begin, j):
                    for i in range(first[run], stop[run]):
                        index[out] = i
                        out += 1
            begin, points = j, 0
        if j < r:
            points += stop[j] - first[j]
    edges[pieces] = out
    return index[:out], edges[: pieces + 1]


@compiled
@no_type_check
def join_chains(uv: np.ndarray, tangent: np.ndarray, starts: np.ndarray, reach_px: float) -> tuple:
    """As :func:`rotaline.vision.stripe.plain.curve.join_chains`: old index of each point, and where the joined chains start."""
    n_chains = len(starts) - 1
    n_ends = 2 * n_chains
    u, v, out_u, out_v = np.empty(n_ends), np.empty(n_ends), np.empty(n_ends), np.empty(n_ends)
    for e in range(n_ends):
        i = starts[e // 2] if e % 2 == 0 else starts[e // 2 + 1] - 1
        sign = -1.0 if e % 2 == 0 else 1.0
        u[e], v[e], out_u[e], out_v[e] = uv[i, 0], uv[i, 1], sign * tangent[i, 0], sign * tangent[i, 1]
    partner = np.full(n_ends, -1)
    pairs, gaps = [(0, 0)][:0], [0.0][:0]
    for a in range(n_ends):
        for b in range(a + 1, n_ends):
            du, dv = u[b] - u[a], v[b] - v[a]
            gap = du * du + dv * dv
            if b // 2 == a // 2 or gap > reach_px * reach_px:
                continue
            ahead, behind = du * out_u[a] + dv * out_v[a], -du * out_u[b] - dv * out_v[b]
            facing = out_u[a] * out_u[b] + out_v[a] * out_v[b]
            side = gap - min(ahead * ahead, behind * behind)
            if facing < -0.85 and ahead >= -1.0 and behind >= -1.0 and side <= 2.25:
                pairs.append((a, b))
                gaps.append(gap)
    for j in np.argsort(np.array(gaps)):
        a, b = pairs[j]
        if partner[a] < 0 and partner[b] < 0:
            partner[a], partner[b] = b, a
    order, edges = np.empty(starts[n_chains], np.int64), np.empty(n_chains + 1, np.int64)
    done = np.zeros(n_chains, np.bool_)
    m, joined = 0, 0
    for turn in range(2):  # open ends first, then rings
        for first in range(n_ends):
            if done[first // 2] or (turn == 0 and partner[first] >= 0):
                continue
            edges[joined] = m
            joined += 1
            entry = first
            while entry >= 0 and not done[entry // 2]:
                k = entry // 2
                done[k] = True
                for j in range(starts[k + 1] - starts[k]):
                    order[m] = starts[k] + j if entry % 2 == 0 else starts[k + 1] - 1 - j
                    m += 1
                entry = partner[entry ^ 1]
    edges[joined] = m
    return order, edges[: joined + 1]
