"""The pixels of an image in strips across the stripe, and what is read from them directly: the only kernels that see the image.

A strip is that of :func:`rotaline.vision.stripe.plain.strips.pixel_strips`. Point i has the places ``spans[i]`` to ``spans[i + 1]``: first those of the
lower neighbours of the pixels nearest to the normal, line by line, then those of the nearest pixels, then those of the upper neighbours. So
the sums over a strip run over full vectors; places that hold no pixel have a share of 0.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

_TIE = 1e-6  # px; so that rounding errors do not decide which pixels are taken
_VECTOR = 8  # places that are worked on at once
_F = np.float32
_ZERO, _ONE, _LEAST = _F(0.0), _F(1.0), _F(1e-5)
_ROUND, _OFFSET = _F(1024.5), 1024  # rounding by cutting off works for positive numbers


@compiled
@no_type_check
def strip_places(normal: np.ndarray, half_length_px: np.ndarray, lanes: int) -> np.ndarray:
    """Where the places of each strip start, (n + 1,): ``lanes`` times as many as it crosses lines, rounded up to full vectors."""
    n = len(normal)
    spans = np.empty(n + 1, np.int64)
    spans[0] = 0
    for i in range(n):
        steep = max(abs(normal[i, 0]), abs(normal[i, 1]))
        lines = 2 * int(half_length_px[i] * steep + 1.0) + 1
        spans[i + 1] = spans[i] + lanes * _VECTOR * ((lines + _VECTOR - 1) // _VECTOR)
    return spans


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
    spans: np.ndarray,
    distance: np.ndarray,
    level: np.ndarray,
    share: np.ndarray,
    clipped: np.ndarray,
    hits: np.ndarray,
) -> None:
    """Read the strips of all points.

    Parameters
    ----------
    value, source : (h * w,)   what is measured; the same before a background was subtracted
    subtracted : value and source differ
    limit : sources from here on are clipped
    size : (width, height)
    half_length_px : (n,)   half length of the strip
    lanes : 3, or 1 for one pixel a line, that nearest to the normal, with a share of 1
    spans : (n + 1,)   of :func:`strip_places`
    distance, level, share : out   from the point along its normal, px; grey value; weight, 0 in an empty place
    clipped : out   the pixel is clipped; written only for points with ``hits``
    hits : (n,) out   number of clipped pixels
    """
    top = _F(limit)
    for i in range(len(uv)):
        across = abs(normal[i, 0]) >= abs(normal[i, 1])
        if across:
            at, along, n_at, n_along = uv[i, 0], uv[i, 1], normal[i, 0], normal[i, 1]
            top_line, top_place, line_stride, place_stride = size[0] - 1, size[1] - 1, 1, size[0]
        else:
            at, along, n_at, n_along = uv[i, 1], uv[i, 0], normal[i, 1], normal[i, 0]
            top_line, top_place, line_stride, place_stride = size[1] - 1, size[0] - 1, size[0], 1
        first = int(np.floor(at + 0.5 - _TIE))
        steps = int((half_length_px[i] + _TIE) * abs(n_at) + 1.0)
        low, high = max(first - steps, 0), min(first + steps, top_line)
        lines, count = max(high - low + 1, 0), (spans[i + 1] - spans[i]) // lanes
        base = int(np.floor(along))
        x0, f0, slope = _F(low - at), _F(along - base), _F(n_along / n_at)
        c, s, reach = _F(n_at), _F(n_along), _F(half_length_px[i] + _TIE)
        one = base + int(np.floor((low - at) * n_along / n_at + 0.5))
        other = base + int(np.floor((high - at) * n_along / n_at + 0.5))
        inside = min(one, other) > 1 and max(one, other) < top_place - 1
        start = low * line_stride + base * place_stride
        below = spans[i]
        middle = below + (count if lanes == 3 else 0)
        above = middle + (count if lanes == 3 else 0)
        most = _ZERO
        found = 0
        for k in range(lines):
            x = x0 + _F(k)
            nearest = np.int64(f0 + x * slope + _ROUND) - _OFFSET
            y = _F(nearest) - f0
            d, t = x * c + y * s, y * c - x * s
            pixel = start + k * line_stride + nearest * place_stride
            if lanes == 1:
                distance[middle + k] = d
                if inside or 0 <= base + nearest <= top_place:
                    v = _F(value[np.uint64(pixel)])
                    level[middle + k], share[middle + k] = v, _ONE if abs(d) <= reach else _ZERO
                    most = max(most, v)
                else:
                    level[middle + k], share[middle + k] = _ZERO, _ZERO
                continue
            p, q, r = _ONE - abs(t - c), _ONE - abs(t), _ONE - abs(t + c)
            distance[below + k], distance[middle + k], distance[above + k] = d - s, d, d + s
            share[below + k] = p if (p > _LEAST) & (abs(d - s) <= reach) else _ZERO
            share[middle + k] = q if (q > _LEAST) & (abs(d) <= reach) else _ZERO
            share[above + k] = r if (r > _LEAST) & (abs(d + s) <= reach) else _ZERO
            if inside:
                u, v, w = (
                    value[np.uint64(pixel - place_stride)],
                    value[np.uint64(pixel)],
                    value[np.uint64(pixel + place_stride)],
                )
                level[below + k], level[middle + k], level[above + k] = _F(u), _F(v), _F(w)
                most = max(most, max(_F(u), max(_F(v), _F(w))))
            else:
                for j in range(-1, 2):
                    place, there = base + nearest + j, middle + j * count + k
                    level[there] = _ZERO
                    if 0 <= place <= top_place:
                        level[there] = value[np.uint64(pixel + j * place_stride)]
                        most = max(most, level[there])
                    else:
                        share[there] = _ZERO
        for lane in range(lanes):
            for k in range(below + lane * count + lines, below + (lane + 1) * count):
                distance[k], level[k], share[k] = _ZERO, _ZERO, _ZERO
        if subtracted or most >= top:
            for lane in range(lanes):
                for k in range(count):
                    there = below + lane * count + k
                    hit = False
                    if share[there] > _ZERO:
                        nearest = np.int64(f0 + (x0 + _F(k)) * slope + _ROUND) - _OFFSET + lane - lanes // 2
                        hit = source[np.uint64(start + k * line_stride + nearest * place_stride)] >= limit
                    clipped[there] = hit
                    found += hit
        hits[i] = found


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
