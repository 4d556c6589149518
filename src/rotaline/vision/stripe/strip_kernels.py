"""The pixels of an image in strips across the stripe, and what is read from them directly: the only kernels that see the image.

A strip is that of :func:`rotaline.vision.stripe.plain.strips.pixel_strips`. Its places go line by line, on each line the lower neighbour of the pixel
nearest to the normal, that pixel, the upper neighbour; the line nearest to the point is in the middle. ``BLOCK`` points stand side by side:
place k of point i is ``first[i] + BLOCK * k``, so that sums over strips are made for many points at once, in full vectors. All points of a block
have as many places; those that hold no pixel have a share of 0, and so have the places of the points that the last block lacks.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

BLOCK = 32  # points
_TIE = 1e-6  # px; so that rounding errors do not decide which pixels are taken
_F = np.float32
_ZERO, _ONE, _LEAST = _F(0.0), _F(1.0), _F(1e-5)
_ROUND, _OFFSET = _F(1024.5), np.int32(1024)  # rounding by cutting off works for positive numbers
_X, _FRACTION, _SLOPE, _COSINE, _SINE, _REACH = 0, BLOCK, 2 * BLOCK, 3 * BLOCK, 4 * BLOCK, 5 * BLOCK


@compiled
@no_type_check
def _strip_places(normal: np.ndarray, half_length_px: np.ndarray, lanes: int) -> tuple:
    """First place and number of places of each strip, (n,) each; number of all places."""
    n = len(normal)
    first, count = np.empty(n, np.int64), np.empty(n, np.int64)
    total = 0
    for begin in range(0, n, BLOCK):
        end = min(begin + BLOCK, n)
        steps = 0
        for i in range(begin, end):
            steep = max(abs(normal[i, 0]), abs(normal[i, 1]))
            steps = max(steps, int((half_length_px[i] + _TIE) * steep + 1.0))
        for i in range(begin, end):
            first[i], count[i] = total + i - begin, lanes * (2 * steps + 1)
        total += BLOCK * lanes * (2 * steps + 1)
    return first, count, total


@compiled
@no_type_check
def _shares(form: np.ndarray, line: float, lanes: int, nearest: np.ndarray, d: np.ndarray, w: np.ndarray) -> None:
    """Nearest pixels, distances and weights on one line of a block."""
    for k in range(BLOCK):
        x, c, s, reach = form[_X + k] + line, form[_COSINE + k], form[_SINE + k], form[_REACH + k]
        pixel = np.int32(form[_FRACTION + k] + x * form[_SLOPE + k] + _ROUND) - _OFFSET
        y = _F(pixel) - form[_FRACTION + k]
        along, t = x * c + y * s, y * c - x * s
        nearest[k] = pixel
        if lanes == 1:
            d[k] = along
            w[k] = _ONE if abs(along) <= reach else _ZERO
        else:
            p, q, r = _ONE - abs(t - c), _ONE - abs(t), _ONE - abs(t + c)
            below, above = along - s, along + s
            d[k], d[k + BLOCK], d[k + 2 * BLOCK] = below, along, above
            w[k] = p if (p > _LEAST) & (abs(below) <= reach) else _ZERO
            w[k + BLOCK] = q if (q > _LEAST) & (abs(along) <= reach) else _ZERO
            w[k + 2 * BLOCK] = r if (r > _LEAST) & (abs(above) <= reach) else _ZERO


@compiled
@no_type_check
def read_strips(
    value: np.ndarray,
    source: np.ndarray,
    subtracted: bool,
    limit: float,
    size: tuple,
    uv: np.ndarray,
    normal: np.ndarray,
    half_length_px: np.ndarray,
    lanes: int,
) -> tuple:
    """Read the strips of all points.

    Parameters
    ----------
    value, source : (h * w,)   what is measured; the same before a background was subtracted
    subtracted : value and source differ
    limit : sources from here on are clipped
    size : (width, height)
    half_length_px : (n,)   half length of the strip
    lanes : 3, or 1 for one pixel a line, that nearest to the normal, with a share of 1

    Returns
    -------
    first, count, distance, level, share, clipped, hits
        See :class:`rotaline.vision.stripe.strips.Strips`.
    """
    top = _F(limit)
    first, count, total = _strip_places(normal, half_length_px, lanes)
    distance, level, share = np.empty(total, _F), np.empty(total, _F), np.empty(total, _F)
    clipped, hits = np.empty(total, np.bool_), np.empty(len(uv), np.int64)
    form, nearest = np.zeros(6 * BLOCK, _F), np.zeros(BLOCK, np.int32)
    origin, line_stride, place_stride = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64)
    low, high, last_place = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64)
    bases, inside = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.bool_)
    for begin in range(0, len(uv), BLOCK):
        m, lines = min(BLOCK, len(uv) - begin), count[begin] // lanes
        steps = lines // 2
        for k in range(BLOCK):
            i = min(begin + k, len(uv) - 1)
            if abs(normal[i, 0]) >= abs(normal[i, 1]):
                at, along, n_at, n_along = uv[i, 0], uv[i, 1], normal[i, 0], normal[i, 1]
                last_line, last_place[k], line_stride[k], place_stride[k] = size[0] - 1, size[1] - 1, 1, size[0]
            else:
                at, along, n_at, n_along = uv[i, 1], uv[i, 0], normal[i, 1], normal[i, 0]
                last_line, last_place[k], line_stride[k], place_stride[k] = size[1] - 1, size[0] - 1, size[0], 1
            middle, base = int(np.floor(at + 0.5 - _TIE)), int(np.floor(along))
            slope = n_along / n_at
            one = along + (middle - steps - at) * slope
            other = along + (middle + steps - at) * slope
            low[k], high[k], bases[k] = steps - middle, steps - middle + last_line, base
            inside[k] = (
                low[k] <= 0
                and high[k] >= lines - 1
                and min(one, other) >= 2.0
                and max(one, other) < last_place[k] - 2.0
            )
            origin[k] = (middle - steps) * line_stride[k] + base * place_stride[k]
            form[_X + k], form[_FRACTION + k], form[_SLOPE + k] = middle - steps - at, along - base, slope
            form[_COSINE + k], form[_SINE + k] = n_at, n_along
            form[_REACH + k] = half_length_px[i] + _TIE if k < m else -1.0
        straight = lanes == 1
        for k in range(BLOCK):
            straight &= inside[k] and form[_SLOPE + k] == _ZERO
            nearest[k] = np.int32(form[_FRACTION + k] + _ROUND) - _OFFSET
        most = _ZERO
        if straight:  # along rows or columns
            for k in range(BLOCK):
                origin[k] += nearest[k] * place_stride[k]
            for line in range(lines):
                row = first[begin] + line * BLOCK
                d, p, w = distance[row : row + BLOCK], level[row : row + BLOCK], share[row : row + BLOCK]
                for k in range(BLOCK):
                    d[k] = (form[_X + k] + _F(line)) * form[_COSINE + k]
                    w[k] = _ONE if abs(d[k]) <= form[_REACH + k] else _ZERO
                for k in range(BLOCK):
                    q = _F(value[np.uint64(origin[k] + line * line_stride[k])])
                    p[k] = q
                    most = max(most, q)
            for k in range(BLOCK):
                origin[k] -= nearest[k] * place_stride[k]
        for line in range(0 if straight else lines):
            row = first[begin] + line * lanes * BLOCK
            d, p, w = (
                distance[row : row + lanes * BLOCK],
                level[row : row + lanes * BLOCK],
                share[row : row + lanes * BLOCK],
            )
            _shares(form, _F(line), lanes, nearest, d, w)
            for k in range(BLOCK):
                pixel = origin[k] + line * line_stride[k] + nearest[k] * place_stride[k]
                if not inside[k]:
                    for lane in range(lanes):
                        place = bases[k] + nearest[k] + lane - lanes // 2
                        there = k + lane * BLOCK
                        p[there] = _ZERO
                        if low[k] <= line <= high[k] and 0 <= place <= last_place[k]:
                            p[there] = value[np.uint64(pixel + (lane - lanes // 2) * place_stride[k])]
                            most = max(most, p[there])
                        else:
                            w[there] = _ZERO
                elif lanes == 1:
                    q = _F(value[np.uint64(pixel)])
                    p[k] = q
                    most = max(most, q)
                else:
                    a = _F(value[np.uint64(pixel - place_stride[k])])
                    b = _F(value[np.uint64(pixel)])
                    c = _F(value[np.uint64(pixel + place_stride[k])])
                    p[k], p[k + BLOCK], p[k + 2 * BLOCK] = a, b, c
                    most = max(most, max(a, max(b, c)))
        hits[begin : begin + m] = 0
        if subtracted or most >= top:
            for line in range(lines):
                row = first[begin] + line * lanes * BLOCK
                for k in range(m):
                    x = form[_X + k] + _F(line)
                    place = np.int32(form[_FRACTION + k] + x * form[_SLOPE + k] + _ROUND) - _OFFSET - lanes // 2
                    for lane in range(lanes):
                        there = row + lane * BLOCK + k
                        hit = False
                        if share[there] > _ZERO:
                            pixel = origin[k] + line * line_stride[k] + (place + lane) * place_stride[k]
                            hit = source[np.uint64(pixel)] >= limit
                        clipped[there] = hit
                        hits[begin + k] += hit
    return first, count, distance, level, share, clipped, hits


@compiled
@no_type_check
def side_differences(
    value: np.ndarray,
    size: tuple,
    uv: np.ndarray,
    normal: np.ndarray,
    starts: np.ndarray,
    side_px: np.ndarray,
    half_length_px: np.ndarray,
    lag: int,
    most: int,
) -> tuple:
    """Differences of the image beside the stripe between profiles ``lag`` points apart, scaled to the noise of a pixel.

    The image is interpolated along its rows or columns. At most ``most`` pairs a chain are taken, evenly spread.

    Returns
    -------
    differences : (k,)
    ends : (chains + 1,)   where those of each chain start
    """
    width, height = size
    n_chains = len(starts) - 1
    room = 0
    for c in range(n_chains):
        pairs = min(max(starts[c + 1] - starts[c] - lag, 0), most)
        longest = 0.0
        for i in range(starts[c], starts[c + 1]):
            longest = max(longest, half_length_px[i])
        room += pairs * (2 * int(longest + 1.5) + 1)
    out = np.empty(room)
    ends = np.zeros(n_chains + 1, np.int64)
    m = 0
    for c in range(n_chains):
        n_pairs = starts[c + 1] - starts[c] - lag
        pairs = min(max(n_pairs, 0), most)
        for k in range(pairs):
            i = starts[c] + (k * n_pairs) // pairs
            j = i + lag
            across = abs(normal[i, 0]) >= abs(normal[i, 1])
            if across != (abs(normal[j, 0]) >= abs(normal[j, 1])):
                continue
            axis = 0 if across else 1
            top_line, top_place = (width - 1, height - 1) if across else (height - 1, width - 1)
            at_i, at_j = uv[i, axis], uv[j, axis]
            n_i, n_j = 1.0 / normal[i, axis], 1.0 / normal[j, axis]
            slope_i, slope_j = normal[i, 1 - axis] * n_i, normal[j, 1 - axis] * n_j
            line_i, line_j = int(np.floor(at_i + 0.5 - _TIE)), int(np.floor(at_j + 0.5 - _TIE))
            steps = int(half_length_px[i] * abs(normal[i, axis]) + 1.0)
            for step in range(-steps, steps + 1):
                x, y = line_i + step - at_i, line_j + step - at_j
                far_i, far_j = abs(x * n_i), abs(y * n_j)
                if min(far_i, far_j) <= side_px[i] or far_i > half_length_px[i] or far_j > half_length_px[j]:
                    continue
                place_i, place_j = uv[i, 1 - axis] + x * slope_i, uv[j, 1 - axis] + y * slope_j
                a, b = int(np.floor(place_i)), int(np.floor(place_j))
                if min(line_i, line_j) + step < 0 or max(line_i, line_j) + step > top_line:
                    continue
                if min(a, b) < 0 or max(a, b) >= top_place:
                    continue
                f, g = place_i - a, place_j - b
                if across:
                    r, t, stride = a * width + line_i + step, b * width + line_j + step, width
                else:
                    r, t, stride = (line_i + step) * width + a, (line_j + step) * width + b, 1
                p = (1.0 - f) * value[np.uint64(r)] + f * value[np.uint64(r + stride)]
                q = (1.0 - g) * value[np.uint64(t)] + g * value[np.uint64(t + stride)]
                gain = 1.0 - 2.0 * f * (1.0 - f) + 1.0 - 2.0 * g * (1.0 - g)
                out[m] = abs(p - q) / np.sqrt(gain)
                m += 1
        ends[c + 1] = m
    return out[:m], ends
