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
_U, _V, _NU, _NV, _HALF = 0, BLOCK, 2 * BLOCK, 3 * BLOCK, 4 * BLOCK
_ORIGIN, _PIXEL, _LINE_STRIDE, _PLACE_STRIDE = 0, BLOCK, 2 * BLOCK, 3 * BLOCK
_LOW, _HIGH, _BASE, _LAST = 4 * BLOCK, 5 * BLOCK, 6 * BLOCK, 7 * BLOCK


@compiled
@no_type_check
def _strip_places(normal: np.ndarray, half_length_px: np.ndarray, lanes: int) -> tuple:
    """First place and number of places of each strip, (n,) each; number of all places."""
    n = len(normal)
    first, count = np.empty(n, np.int64), np.empty(n, np.int64)
    total = 0
    for begin in range(0, n, BLOCK):
        end = min(begin + BLOCK, n)
        far = 0.0
        for i in range(begin, end):
            far = max(far, (half_length_px[i] + _TIE) * max(abs(normal[i, 0]), abs(normal[i, 1])))
        steps = int(far + 1.0)
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
def _frames(at: np.ndarray, lines: int, size: tuple, form: np.ndarray, whole: np.ndarray) -> bool:
    """How the strips of a block lie in the image: fractions and slopes, whole numbers. Whether all of them are inside of it.

    The whole numbers are pixel numbers (of the first line at the point's place, of the present line), strides from line to line and from place to
    place, the first and the last line inside the image, and the point's place and the last one.
    """
    steps = lines // 2
    inside = 0
    for k in range(BLOCK):
        rows = abs(at[_NU + k]) >= abs(at[_NV + k])
        on, along = at[_U + k] if rows else at[_V + k], at[_V + k] if rows else at[_U + k]
        n_on, n_along = at[_NU + k] if rows else at[_NV + k], at[_NV + k] if rows else at[_NU + k]
        last_line, last_place = size[0] - 1 if rows else size[1] - 1, size[1] - 1 if rows else size[0] - 1
        line_stride, place_stride = 1 if rows else size[0], size[0] if rows else 1
        first, base = np.floor(on + (0.5 - _TIE)) - steps, np.floor(along)
        slope = n_along / n_on
        one = along + (first - on) * slope
        other = one + 2 * steps * slope
        high = last_line - first
        inside += (first >= 0.0) & (high >= lines - 1) & (min(one, other) >= 2.0) & (max(one, other) < last_place - 2.0)
        form[_X + k], form[_FRACTION + k], form[_SLOPE + k] = first - on, along - base, slope
        form[_COSINE + k], form[_SINE + k], form[_REACH + k] = n_on, n_along, at[_HALF + k]
        whole[_ORIGIN + k] = np.int64(first) * line_stride + np.int64(base) * place_stride
        whole[_LINE_STRIDE + k], whole[_PLACE_STRIDE + k] = line_stride, place_stride
        whole[_LOW + k], whole[_HIGH + k] = -np.int64(first), np.int64(high)
        whole[_BASE + k], whole[_LAST + k] = np.int64(base), last_place
    return inside == BLOCK


@compiled
@no_type_check
def _pixels(whole: np.ndarray, nearest: np.ndarray, line: int) -> None:
    """Numbers of the nearest pixels on one line of a block."""
    for k in range(BLOCK):
        across = np.int64(nearest[k]) * whole[_PLACE_STRIDE + k]
        whole[_PIXEL + k] = whole[_ORIGIN + k] + line * whole[_LINE_STRIDE + k] + across


@compiled
@no_type_check
def _read_inside(value: np.ndarray, whole: np.ndarray, lanes: int, read: np.ndarray) -> None:
    """One line of a block that is inside the image."""
    if lanes == 1:
        for k in range(BLOCK):
            read[k] = value[np.uint64(whole[_PIXEL + k])]
    else:
        for k in range(BLOCK):
            pixel, stride = whole[_PIXEL + k], whole[_PLACE_STRIDE + k]
            read[k] = value[np.uint64(pixel - stride)]
            read[k + BLOCK] = value[np.uint64(pixel)]
            read[k + 2 * BLOCK] = value[np.uint64(pixel + stride)]


@compiled
@no_type_check
def _read_where_inside(
    value: np.ndarray, whole: np.ndarray, nearest: np.ndarray, line: int, lanes: int, read: np.ndarray, w: np.ndarray
) -> None:
    """One line of a block; what is outside the image has no weight."""
    for k in range(BLOCK):
        for lane in range(lanes):
            beside, there = lane - lanes // 2, k + lane * BLOCK
            place = whole[_BASE + k] + nearest[k] + beside
            if whole[_LOW + k] <= line <= whole[_HIGH + k] and 0 <= place <= whole[_LAST + k]:
                read[there] = value[np.uint64(whole[_PIXEL + k] + beside * whole[_PLACE_STRIDE + k])]
            else:
                read[there], w[there] = 0, _ZERO


@compiled
@no_type_check
def _bright(read: np.ndarray, top: float, p: np.ndarray) -> int:
    """What was read, as ``p``; how many are ``top`` or more."""
    bright = 0
    for k in range(len(p)):
        q = _F(read[k])
        p[k] = q
        bright += q >= top
    return bright


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
    form, nearest, read = np.zeros(6 * BLOCK, _F), np.zeros(BLOCK, np.int32), np.empty(3 * BLOCK, value.dtype)
    at, whole = np.empty(5 * BLOCK), np.empty(8 * BLOCK, np.int64)
    for begin in range(0, len(uv), BLOCK):
        m, lines = min(BLOCK, len(uv) - begin), count[begin] // lanes
        for k in range(BLOCK):
            i = min(begin + k, len(uv) - 1)
            at[_U + k], at[_V + k], at[_NU + k], at[_NV + k] = uv[i, 0], uv[i, 1], normal[i, 0], normal[i, 1]
            at[_HALF + k] = half_length_px[i] + _TIE if k < m else -1.0
        inside = _frames(at, lines, size, form, whole)
        bright = 0
        for line in range(lines):
            row = first[begin] + line * lanes * BLOCK
            end = row + lanes * BLOCK
            w = share[row:end]
            _shares(form, _F(line), lanes, nearest, distance[row:end], w)
            _pixels(whole, nearest, line)
            if inside:
                _read_inside(value, whole, lanes, read)
            else:
                _read_where_inside(value, whole, nearest, line, lanes, read, w)
            bright += _bright(read, top, level[row:end])
        hits[begin : begin + m] = 0
        if subtracted or bright:
            for line in range(lines):
                row = first[begin] + line * lanes * BLOCK
                for k in range(m):
                    x = form[_X + k] + _F(line)
                    place = np.int32(form[_FRACTION + k] + x * form[_SLOPE + k] + _ROUND) - _OFFSET
                    nearest[k] = place
                _pixels(whole, nearest, line)
                for k in range(m):
                    for lane in range(lanes):
                        there = row + lane * BLOCK + k
                        hit = False
                        if share[there] > _ZERO:
                            pixel = whole[_PIXEL + k] + (lane - lanes // 2) * whole[_PLACE_STRIDE + k]
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
