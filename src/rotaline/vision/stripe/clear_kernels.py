"""Centres of a stripe that is not wide, block by block, in compiled loops. See :mod:`rotaline.vision.stripe.measure`.

All that is done with the pixels across a block of points is done while they are at hand; nothing but what was measured is kept of them.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe import block_kernels as strips
from rotaline.vision.stripe.block_kernels import (
    BLOCK,
    LINE,
    frame_block,
    leave_out,
    place_lines,
    read_pixels,
    take_block,
)
from rotaline.vision.stripe.judge_kernels import sound_points
from rotaline.vision.stripe.measure_kernels import (
    LAG,
    NOISE_FROM,
    SHORT_PX,
    SIDE_PX,
    SIDE_WIDTHS,
    WIDER,
    adapt_widths,
    stepped,
)
from rotaline.vision.stripe.trace_kernels import follow_tops, long_chains
from rotaline.vision.stripe.uncertainty_kernels import pixel_noise, scatter_and_floor
from rotaline.vision.stripe.window_kernels import (
    BEYOND,
    DIFFER,
    LEVEL,
    NARROW,
    SHIFT,
    SIZE,
    SLOPE,
    VARIANCE,
    WIDE,
    WIDTH,
    centres_of_two,
    straight_ground,
)

_F, _I = np.float32, np.int32
_ZERO, _HALF, _UNIT, _TWO, _INFINITE = _F(0.0), _F(0.5), _F(1.0), _F(2.0), _F(np.inf)
_ROUND, _NEAR, _BESIDE = _F(1024.5), _F(1e-4), _F(NOISE_FROM)
_LEAST_PX, _MOST_PX = 0.5, 2.0  # widths of stripes that are measured here
_POINTS_A_LINE, _MOST_APART = (
    80,
    5,
)  # so many times so many points, and every second, third, ... line of the strips tells the noise
_SURE_PX, _MOST_SURE = 0.1, 0.98  # uncertainty of a clear centre; part of the centres that are clear
_SEEN = 6.0  # widths: what is further out has no weight under the wide window
_CORE = 1.5  # widths: a clipped pixel as near makes the point saturated


@compiled
@no_type_check
def _pairs(whole: np.ndarray, a: int, b: int, apart: np.ndarray) -> None:
    """Infinity where a point of a block and the one it is compared with are not both of the points ``a`` to ``b``, on lines of one kind; else 0."""
    for k in range(BLOCK):
        apart[k] = _INFINITE
    for k in range(a, b - LAG):
        same = whole[strips.ROWS + k] == whole[strips.ROWS + k + LAG]
        apart[k] = _ZERO if same else _INFINITE


@compiled
@no_type_check
def _differences(
    form: np.ndarray,
    s: np.ndarray,
    line: int,
    d: np.ndarray,
    w: np.ndarray,
    q: np.ndarray,
    apart: np.ndarray,
    own: np.ndarray,
    out: np.ndarray,
) -> None:
    """Differences on one line between strips of points of a block that are not ``apart``, infinite where there is none.

    As in :func:`rotaline.vision.stripe.strip_kernels.side_differences`.
    """
    beyond = _F(line)
    for k in range(BLOCK):
        place = form[strips.FRACTION + k] + (form[strips.X + k] + beyond) * form[strips.SLOPE + k] + _ROUND
        e = place - _F(_I(place)) - _HALF
        lower, middle, upper = _F(q[k]), _F(q[k + BLOCK]), _F(q[k + 2 * BLOCK])
        under, over = w[k], w[k + 2 * BLOCK]
        beside, there = upper if e > _ZERO else lower, over if e > _ZERO else under
        inside = (w[k + BLOCK] > _ZERO) & ((there > _ZERO) | (abs(e) < _NEAR))
        e = abs(e)
        own[k] = middle + e * (beside - middle)
        own[k + 2 * BLOCK] = _UNIT - _TWO * (e - e * e)
        own[k + 4 * BLOCK] = _ZERO if inside & (abs(d[k + BLOCK]) > _BESIDE * s[WIDTH + k]) else _INFINITE
    for k in range(BLOCK):
        j = k + LAG
        gain = own[2 * BLOCK + k] + own[2 * BLOCK + j]
        out[k] = abs(own[j] - own[k]) / np.sqrt(gain) + own[4 * BLOCK + k] + own[4 * BLOCK + j] + apart[k]


@compiled
@no_type_check
def _clipped(
    read: np.ndarray,
    limit: float,
    d: np.ndarray,
    w: np.ndarray,
    core_px: np.ndarray,
    hits: np.ndarray,
    saturated: np.ndarray,
) -> bool:
    """Make the weights of clipped pixels negative, and mark the points of a block that see any, and those that see them near; whether there are some."""
    brightest, top = read[0], read.dtype.type(limit)
    for value in read:
        brightest = max(brightest, value)
    if brightest < top:
        return False
    some = False
    for k in range(len(hits)):
        for j in range(k, len(read), BLOCK):
            if read[j] >= top and w[j] > _ZERO:
                hits[k], some = True, True
                saturated[k] |= abs(d[j]) <= core_px[k]
                w[j] = -w[j]
    return some


@compiled
@no_type_check
def measure_clear(
    value: np.ndarray,
    source: np.ndarray,
    subtracted: bool,
    limit: float,
    size: tuple,
    uv: np.ndarray,
    starts: np.ndarray,
    normal: np.ndarray,
    width_px: np.ndarray,
    least_noise: float,
    clipped_too: bool,
) -> tuple:
    """Centres under a window of one width, or of two where these scatter as little, of a clear stripe that is not wide and has no steps under it.

    The same as :func:`rotaline.vision.stripe.measure_kernels.read_stripe` and
    :func:`rotaline.vision.stripe.measure_kernels.best_centres`, without strips that are kept.

    Parameters
    ----------
    value, source, subtracted, limit, size, uv, starts, normal, width_px
        See :func:`rotaline.vision.stripe.measure_kernels.read_stripe`.
    least_noise : float   of a pixel
    clipped_too : bool   a stripe with clipped pixels is such

    Returns
    -------
    known : bool   the stripe is such; else the rest says nothing
    centres : (4, n)   shifts, uncertainties for a noise of 1, measured widths, heights
    noise : (n,)   of a pixel
    floor : float   scatter of the centres that the noise does not explain
    clipped : bool   some pixel is
    hits, saturated : (n,) bool   some pixel of the strip is clipped; one in the core is
    line : (n, 3)   level at the point and slope of the background; only around points that are hit
    """
    n, n_chains = len(width_px), len(starts) - 1
    blocks, most = (n + BLOCK - 1) // BLOCK, 2 * int(SIDE_WIDTHS * _MOST_PX + SIDE_PX + 1.0) + 1
    centres, line = np.empty((4, n)), np.empty((n, 3))
    hits, saturated, clipped = np.zeros(n, np.bool_), np.zeros(n, np.bool_), False
    both, differ, width = np.empty((8, blocks * BLOCK), _F), np.empty(n), np.empty(blocks * BLOCK)
    both[0] = _ZERO
    for i in range(len(width)):
        width[i] = width_px[min(i, n - 1)]
    if n == 0 or not _narrow(width):
        return False, centres, differ, 0.0, clipped, hits, saturated, line
    d, w, pixel = np.empty(most * LINE, _F), np.empty(most * LINE, _F), np.empty(most * LINE, np.uint32)
    q, bare = np.empty(most * LINE, value.dtype), np.empty(most * LINE if subtracted else 0, source.dtype)
    at, form, whole = np.empty(4 * BLOCK), np.empty(strips.FORM, _F), np.empty(strips.WHOLE, _I)
    s, own, apart = np.zeros(SIZE, _F), np.zeros(6 * BLOCK, _F), np.empty(BLOCK, _F)
    wanted = np.ones(blocks, np.bool_)
    differences, ends = np.empty((n + (n_chains + 1) * BLOCK) * most, _F), np.zeros(n_chains + 1, np.int64)
    places, across = uv.reshape(-1), normal.reshape(-1)
    m = chain = 0
    noise = differ
    for turn in range(2):
        for block in range(blocks):
            if not wanted[block]:
                continue
            begin = block * BLOCK
            count = take_block(places, across, begin, at)
            far, seen, near = 0.0, 0.0, np.inf
            for k in range(BLOCK):
                w_px = width[begin + k]
                s[WIDTH + k], s[SHIFT + k] = w_px, both[0, begin + k]
                one, other = abs(at[k + 2 * BLOCK]), abs(at[k + 3 * BLOCK])
                cosine, sine = max(one, other), min(one, other)
                far, seen = max(far, (SIDE_WIDTHS * w_px + SIDE_PX) * cosine), max(seen, _SEEN * w_px * cosine)
                near = min(near, (BEYOND * w_px - 1.5 * sine) * cosine - 0.5)
            steps, inner, core = int(far + 1.0), int(seen + 1.0), int(max(near, 0.0))
            end = (2 * steps + 1) * LINE
            inside = frame_block(at, steps, size, form, whole)
            place_lines(form, whole, 2 * steps + 1, d, w, pixel)
            for a in range(0, 0 if inside else end, LINE):
                leave_out(form, whole, a // LINE, size, w[a : a + LINE], pixel[a : a + LINE])
            read_pixels(value, pixel[:end], q)
            i, j = begin, begin + count
            core_px = _CORE * width_px[i:j]
            if subtracted:
                read_pixels(source, pixel[:end], bare)
                hit = _clipped(bare[:end], limit, d, w, core_px, hits[i:j], saturated[i:j])
            else:
                hit = _clipped(q[:end], limit, d, w, core_px, hits[i:j], saturated[i:j])
            straight_ground(s, d, w, q, steps, core)
            if hit:
                if not clipped_too:
                    return False, centres, differ, 0.0, True, hits, saturated, line
                clipped = True
                for k in range(end):
                    w[k] = abs(w[k])
                for k in range(count):
                    line[i + k, 0], line[i + k, 1], line[i + k, 2] = s[LEVEL + k], s[SLOPE + k], s[VARIANCE + k]
            if turn == 0:
                for k in range(count):
                    differ[i + k] = s[DIFFER + k]
                first = 0
                while chain < n_chains and starts[chain] < j:
                    last = min(starts[chain + 1] - begin, BLOCK)
                    every = min(max((starts[chain + 1] - starts[chain]) // _POINTS_A_LINE, 1), _MOST_APART)
                    _pairs(whole, first, last, apart)
                    for row in range(block % every, 2 * steps + 1, every):
                        if abs(row - steps) > 2:
                            a, b = row * LINE, (row + 1) * LINE
                            _differences(form, s, row, d[a:b], w[a:b], q[a:b], apart, own, differences[m : m + BLOCK])
                            m += BLOCK
                    if starts[chain + 1] > begin + BLOCK:
                        break
                    chain, first = chain + 1, last
                    ends[chain] = m
            centres_of_two(s, d, w, q, steps - inner, steps + inner + 1, _F(SHORT_PX))
            for r in range(4):
                for k in range(BLOCK):
                    both[r, begin + k] = s[NARROW + r * BLOCK + k]
                    both[4 + r, begin + k] = s[WIDE + r * BLOCK + k]
        if turn == 0:
            noise = pixel_noise(differences[:m], ends, starts, least_noise)
            _, some = stepped(differ, noise, starts)
            more = adapt_widths(both[2], starts, width_px, width, wanted)
            if some or not _narrow(width[:n]) or _faint(both[1], noise):
                return False, centres, noise, 0.0, clipped, hits, saturated, line
            if not more:
                break
    best, scatter, floor = 0, np.inf, 0.0
    for window in (0, 4):
        scatter_now, floor_now = scatter_and_floor(uv, starts, normal, both[window], both[window + 1], noise)
        if window == 0 or scatter_now < WIDER * scatter:
            best, scatter, floor = window, scatter_now, floor_now
        if floor_now < 0.5 * scatter_now:
            break  # where the noise of the pixels explains the scatter, the narrow window is the best
    for r in range(4):
        for i in range(n):
            centres[r, i] = both[best + r, i]
    return True, centres, noise, floor, clipped, hits, saturated, line


@compiled
@no_type_check
def clear_points(
    value: np.ndarray,
    source: np.ndarray,
    subtracted: bool,
    limit: float,
    size: tuple,
    least_noise: float,
    uv: np.ndarray,
    chain: np.ndarray,
    spread_px2: np.ndarray,
    least_px: float,
    most_px: float,
    least_height: float,
    shortest: int,
    least: int,
    min_length: float,
) -> tuple:
    """Trace a clear stripe that is not wide by the tops that were found, measure it, and judge the points.

    Parameters
    ----------
    value, source, subtracted, limit, size, least_noise : of :func:`measure_clear`
    uv, chain, spread_px2, least_px, most_px, shortest : of :func:`rotaline.vision.stripe.trace_kernels.follow_tops`
    least_height, least, min_length : of :func:`rotaline.vision.stripe.judge_kernels.sound_points`

    Returns
    -------
    known : bool   the stripe is such, and no pixel is clipped; else the rest says nothing
    points   as :func:`rotaline.vision.stripe.judge_kernels.sound_points` returns them
    """
    uv, starts, width, normal, known = follow_tops(uv, chain, spread_px2, least_px, most_px, shortest)
    uv, starts, width, normal = long_chains(uv, starts, width, normal, least)
    if not known:
        uv, starts = uv[:0], starts[:1]
    known, centres, noise, floor, _, _, saturated, _ = measure_clear(
        value, source, subtracted, limit, size, uv, starts, normal, width[: len(uv)], least_noise, np.bool_(False)
    )
    if not known:
        uv, starts = uv[:0], starts[:1]
    shift, u, wide, height = centres
    points = sound_points(
        uv, starts, normal, normal, width, noise, shift, u, wide, height, np.zeros(len(uv)), saturated, floor, least_height, size, least,
        min_length,
    )  # fmt: skip
    return known, points


@compiled
@no_type_check
def _faint(u_px: np.ndarray, noise: np.ndarray) -> bool:
    """Whether more than a few of the centres are so uncertain that the stripe is not clear there; those that were not found are."""
    sure = 0
    for i in range(len(noise)):
        sure += u_px[i] * noise[i] <= _SURE_PX
    return sure < _MOST_SURE * len(noise)


@compiled
@no_type_check
def _narrow(width_px: np.ndarray) -> bool:
    """Whether all widths are such that they can be measured here."""
    beyond = 0
    for w in width_px:
        beyond += (w < _LEAST_PX) | (w > _MOST_PX)
    return beyond == 0
