"""Strips of pixels along rows and columns, and the centroid of the light in them, in compiled loops. See :mod:`rotaline.vision.stripe.plain.rows`.

Points stand on whole rows or columns, and a strip is a run of pixels of one of these. ``BLOCK`` points stand side by side, so that sums over strips are
made for many points at once, in full vectors; all strips of a block are as long. Pixel ``t`` from the middle pixel of point k of a block stands
``BLOCK * t + k`` behind the block's middle in ``level``, and is ``t + off[k]`` px from the point. Where the image ends the level is NaN; in ``ground`` it is
also NaN where a pixel is clipped, as that says nothing about the background.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

BLOCK = 32  # points
_F = np.float32
_ZERO, _HALF, _UNIT, _TWO, _MOST_STEP = _F(0.0), _F(0.5), _F(1.0), _F(2.0), _F(1.5)  # the last in widths
_NARROW, _ROOT_2PI = _F(0.1), _F(np.sqrt(2.0 * np.pi))
_HUGE, _THIN, _NONE = _F(1e30), _F(1e-3), _F(np.nan)
_SIDE = 3.0  # widths: the background begins, the window ends
_REACH, _REACH_PX = 3.5, 4.0  # widths and px to both sides
_PASSES, _MOST_STEPS = 3, 8
_SHORT_PX = _F(0.3)  # a step is the last when it is shorter: good enough to know the width
_STILL_PX = _F(0.003)  # the same for the centroid itself
_OFF, _CENTRE, _LIMIT, _LEVEL, _SLOPE, _STEP = (k * BLOCK for k in range(6))
_N, _X, _XX, _Q, _XQ = (k * BLOCK for k in range(6, 11))  # of all pixels of a strip
_SUMS, _S0, _S1, _S2, _S3, _S4, _S5 = 11 * BLOCK, *(k * BLOCK for k in range(11, 17))
_SIZE = 17 * BLOCK


@compiled
@no_type_check
def _run_of_pixels(uv: np.ndarray, along: np.ndarray, size: tuple, i: int) -> tuple:
    """The row or column of a point: its middle pixel, pixels from one to the next, place of the middle pixel, last place, middle minus point."""
    axis = 0 if along[i, 0] != 0.0 else 1
    place, line = int(np.floor(uv[i, axis] + 0.5)), int(np.floor(uv[i, 1 - axis] + 0.5))
    if axis == 0:
        return line * size[0] + place, 1, place, size[0] - 1, place - uv[i, 0]
    return place * size[0] + line, size[0], place, size[1] - 1, place - uv[i, 1]


@compiled
@no_type_check
def read_lines(
    value: np.ndarray,
    source: np.ndarray,
    subtracted: bool,
    limit: float,
    size: tuple,
    uv: np.ndarray,
    along: np.ndarray,
    width_px: np.ndarray,
) -> tuple:
    """Read the strips of all points.

    Parameters
    ----------
    value, source : (h * w,)   what is measured; the same before a background was subtracted
    subtracted : value and source differ
    limit : sources from here on are clipped
    size : (width, height)
    along : (n, 2)   direction of the row or column
    width_px : (n,)   of the stripe along it: the strips reach 3.5 of it and 4 px to both sides

    Returns
    -------
    middle, half : (blocks,)   where the middle pixels of each block stand, and the pixels to either side of them
    off : (blocks * BLOCK,)   middle pixel minus point, px
    level, ground : (m,)   grey values; the same array where no pixel is clipped
    hits : (n,)   number of clipped pixels
    """
    n = len(uv)
    blocks = (n + BLOCK - 1) // BLOCK
    middle, half, off = np.empty(blocks, np.int64), np.empty(blocks, np.int64), np.empty(blocks * BLOCK, _F)
    total = 0
    for b in range(blocks):
        widest = 0.0
        for i in range(b * BLOCK, min((b + 1) * BLOCK, n)):
            widest = max(widest, width_px[i])
        half[b] = int(_REACH * widest + _REACH_PX)
        middle[b] = total + half[b] * BLOCK
        total += (2 * half[b] + 1) * BLOCK
    level, hits = np.empty(total, _F), np.zeros(n, np.int64)
    ground, apart = level, False
    top = _F(limit)
    for b in range(blocks):
        h, bright = half[b], 0
        begin, end = middle[b] - h * BLOCK, middle[b] + (h + 1) * BLOCK
        for k in range(BLOCK):
            pixel, stride, place, last, off[b * BLOCK + k] = _run_of_pixels(uv, along, size, min(b * BLOCK + k, n - 1))
            at, there = np.uint64(pixel - h * stride), np.uint64(begin + k)
            if h <= place <= last - h:
                for _ in range(2 * h + 1):
                    level[there] = value[at]
                    at += np.uint64(stride)
                    there += np.uint64(BLOCK)
            else:
                for t in range(-h, h + 1):
                    inside = 0 <= place + t <= last
                    level[middle[b] + t * BLOCK + k] = value[np.uint64(pixel + t * stride)] if inside else _NONE
        for j in range(begin, end):
            bright += level[np.uint64(j)] >= top
        if apart or subtracted or bright > 0:
            if not apart:
                apart, ground = True, level.copy()
            ground[begin:end] = level[begin:end]
            for k in range(min(BLOCK, n - b * BLOCK)):
                i = b * BLOCK + k
                pixel, stride, place, last, _ = _run_of_pixels(uv, along, size, i)
                for t in range(max(-h, -place), min(h, last - place) + 1):
                    if source[np.uint64(pixel + t * stride)] >= limit:
                        ground[np.uint64(middle[b] + t * BLOCK + k)] = _NONE
                        hits[i] += 1
    return middle, half, off, level, ground, hits


@compiled
@no_type_check
def _add_ground(s: np.ndarray, p: np.ndarray, t: float) -> None:
    """Pixel ``t`` of a block: the sums for a line through the background."""
    for k in range(BLOCK):
        q, x = p[k], s[_OFF + k] + t
        use, light = (_UNIT, q) if q == q else (_ZERO, _ZERO)
        ux = use * x
        s[_N + k] += use
        s[_X + k] += ux
        s[_XX + k] += ux * x
        s[_Q + k] += light
        s[_XQ + k] += x * light


@compiled
@no_type_check
def _add_bell(s: np.ndarray, p: np.ndarray, t: float) -> None:
    """Pixel ``t`` of a block: the sums of :func:`rotaline.vision.stripe.centre_kernels.weighted_centroids`."""
    for k in range(BLOCK):
        q, x = p[k], s[_OFF + k] + t
        above = q - s[_LEVEL + k] - s[_SLOPE + k] * x if q == q else _ZERO
        x -= s[_CENTRE + k]
        square = x * x
        e = min(square * s[_LIMIT + k], _UNIT)
        e = _UNIT - e + _HALF * e * e  # about exp(-e); 16 times itself that is the bell, to 0.1 % where it matters
        e *= e
        e *= e
        e *= e
        e = e * e if q == q else _ZERO
        shape, light = e * e, e * above
        s[_S0 + k] += shape
        s[_S1 + k] += shape * x
        s[_S2 + k] += shape * square
        s[_S3 + k] += light
        s[_S4 + k] += light * x
        s[_S5 + k] += light * square


@compiled
@no_type_check
def rough_centres(
    middle: np.ndarray, half: np.ndarray, off: np.ndarray, level: np.ndarray, ground: np.ndarray, width_px: np.ndarray
) -> tuple:
    """Centroid under a Gaussian bell as wide as the stripe is thought to be, above a line through the background beyond three widths.

    As :func:`rotaline.vision.stripe.plain.centres.weighted_centroid`, but for the uncertainty.

    Returns
    -------
    shift, measured width : (blocks * BLOCK,)   shifts are NaN where nothing stands above the background
    total : (blocks, 5 * BLOCK)   sums for a line through all pixels
    """
    n, blocks = len(width_px), len(middle)
    shift, measured = np.empty(blocks * BLOCK, _F), np.empty(blocks * BLOCK, _F)
    total, width = np.empty((blocks, 5 * BLOCK), _F), np.empty(BLOCK, _F)
    s = np.zeros(_SIZE, _F)
    for b in range(blocks):
        at, h, widest = middle[b], half[b], 0.0
        for k in range(BLOCK):
            w = width_px[min(b * BLOCK + k, n - 1)]
            width[k], widest = w, max(widest, w)
            s[_OFF + k], s[_LIMIT + k], s[_CENTRE + k] = off[b * BLOCK + k], 0.03125 / (w * w), 0.0
        inner = min(int(_SIDE * widest + 0.5), h - 2)
        s[_N:_SUMS] = _ZERO
        for t in range(inner + 1, h + 1):
            _add_ground(s, ground[at - t * BLOCK : at - (t - 1) * BLOCK], _F(-t))
            _add_ground(s, ground[at + t * BLOCK : at + (t + 1) * BLOCK], _F(t))
        for k in range(BLOCK):
            count = max(s[_N + k], _UNIT)
            x, q = s[_X + k] / count, s[_Q + k] / count
            slope = (s[_XQ + k] - x * s[_Q + k]) / max(s[_XX + k] - x * s[_X + k], _HALF)
            slope = slope if abs(x) < _F(inner) else _ZERO  # one side alone tells no slope
            s[_LEVEL + k], s[_SLOPE + k] = q - slope * x, slope
        for t in range(-inner, inner + 1):
            _add_ground(s, ground[at + t * BLOCK : at + (t + 1) * BLOCK], _F(t))
        total[b] = s[_N:_SUMS]
        reach = min(int(_REACH * widest + 1.0), h)
        for _ in range(_MOST_STEPS):
            s[_SUMS:] = _ZERO
            for t in range(-reach, reach + 1):
                _add_bell(s, level[at + t * BLOCK : at + (t + 1) * BLOCK], _F(t))
            far = 0
            for k in range(BLOCK):
                g0, g1, p0, p1 = s[_S0 + k], s[_S1 + k], s[_S3 + k], s[_S4 + k]
                step = width[k] * width[k] * (g0 * p1 - g1 * p0) / (s[_S2 + k] * p0 - g1 * p1)
                most = _MOST_STEP * width[k]
                step = min(max(step, -most), most) if abs(step) < _HUGE else _ZERO
                s[_STEP + k] = step
                s[_CENTRE + k] += step
                far += abs(step) > _SHORT_PX
            if far == 0:
                break
        for k in range(BLOCK):
            g0, g1, g2 = s[_S0 + k], s[_S1 + k], s[_S2 + k]
            p0, p1, p2 = s[_S3 + k], s[_S4 + k], s[_S5 + k]
            variance = width[k] * width[k]
            high = (g2 * p0 - g1 * p1) / (g0 * g2 - g1 * g1)
            middle_off, own = p1 / p0, g1 / g0  # the same but for the last step
            moment = p2 / p0 - middle_off * middle_off - g2 / g0 + own * own + _HALF * variance
            wide = moment * variance / max(variance - moment, _THIN * variance)
            shift[b * BLOCK + k] = s[_CENTRE + k] if (p0 > _ZERO) & (high > _ZERO) else _NONE
            measured[b * BLOCK + k] = min(np.sqrt(max(wide, _NARROW)), _TWO * _MOST_STEP * width[k])
    return shift, measured, total


@compiled
@no_type_check
def _add_window(s: np.ndarray, p: np.ndarray, t: float) -> None:
    """Pixel ``t`` of a block: the sums of :func:`_add_ground`, of what lies within the window."""
    for k in range(BLOCK):
        q, x = p[k], s[_OFF + k] + t
        use, light = (_UNIT, q) if (q == q) & (abs(x - s[_CENTRE + k]) <= s[_LIMIT + k]) else (_ZERO, _ZERO)
        ux = use * x
        s[_S0 + k] += use
        s[_S1 + k] += ux
        s[_S2 + k] += ux * x
        s[_S3 + k] += light
        s[_S4 + k] += x * light


@compiled
@no_type_check
def _add_light(s: np.ndarray, p: np.ndarray, t: float) -> None:
    """Pixel ``t`` of a block: moments of the window itself, and of what stands above the background in it."""
    for k in range(BLOCK):
        q, x = p[k], s[_OFF + k] + t
        light = q - s[_LEVEL + k] - s[_SLOPE + k] * x
        x -= s[_CENTRE + k]
        use = (q == q) & (abs(x) <= s[_LIMIT + k])
        one, light = _UNIT if use else _ZERO, max(light, _ZERO) if use else _ZERO
        ux, lx = one * x, light * x
        s[_S0 + k] += one
        s[_S1 + k] += ux
        s[_S2 + k] += ux * x
        s[_S3 + k] += light
        s[_S4 + k] += lx
        s[_S5 + k] += lx * x


@compiled
@no_type_check
def flat_centroids(
    middle: np.ndarray,
    half: np.ndarray,
    off: np.ndarray,
    level: np.ndarray,
    ground: np.ndarray,
    total: np.ndarray,
    width_px: np.ndarray,
    start_px: np.ndarray,
) -> tuple:
    """Centroid of what stands above the background within three widths; all grey values count alike.

    The window follows the result; its ends fall on whole pixels. The background is a line through what lies outside of it.

    Returns
    -------
    shifts, uncertainties for a noise of 1, widths, heights
    """
    n = len(start_px)
    shift, u, wide, high = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    s = np.zeros(_SIZE, _F)
    for b in range(len(middle)):
        at, h = middle[b], half[b]
        for k in range(BLOCK):
            i = min(b * BLOCK + k, n - 1)
            s[_OFF + k], s[_CENTRE + k], s[_LIMIT + k] = off[b * BLOCK + k], start_px[i], _SIDE * width_px[i]
        s[_N:_SUMS] = total[b]
        for _ in range(_PASSES):
            reach = _ZERO
            for k in range(BLOCK):
                reach = max(reach, abs(s[_CENTRE + k]) + s[_LIMIT + k])
            inner = min(int(reach + 0.5), h)
            s[_SUMS:] = _ZERO
            for t in range(-inner, inner + 1):
                _add_window(s, ground[at + t * BLOCK : at + (t + 1) * BLOCK], _F(t))
            for k in range(BLOCK):
                count, x = s[_N + k] - s[_S0 + k], s[_X + k] - s[_S1 + k]
                q = s[_Q + k] - s[_S3 + k]
                mean, light = x / max(count, _UNIT), q / max(count, _UNIT)
                spread = s[_XX + k] - s[_S2 + k] - mean * x
                slope = (s[_XQ + k] - s[_S4 + k] - mean * q) / max(spread, _HALF)
                slope = slope if abs(mean - s[_CENTRE + k]) < s[_LIMIT + k] else _ZERO
                s[_LEVEL + k], s[_SLOPE + k] = light - slope * mean, slope
            s[_SUMS:] = _ZERO
            for t in range(-inner, inner + 1):
                _add_light(s, level[at + t * BLOCK : at + (t + 1) * BLOCK], _F(t))
            far = 0
            for k in range(BLOCK):
                step = s[_S4 + k] / s[_S3 + k] if s[_S3 + k] > _ZERO else _ZERO
                s[_STEP + k] = step
                s[_CENTRE + k] += step
                far += abs(step) >= _STILL_PX
            if far == 0:
                break
        for k in range(min(BLOCK, n - b * BLOCK)):
            i, mass, step = b * BLOCK + k, s[_S3 + k], s[_STEP + k]
            near = s[_S2 + k] - _TWO * step * s[_S1 + k] + step * step * s[_S0 + k]
            width = np.sqrt(max(s[_S5 + k] / mass - step * step, _NARROW))
            shift[i] = s[_CENTRE + k] if mass > _ZERO else _NONE
            u[i], wide[i], high[i] = np.sqrt(max(near, _ZERO)) / mass, width, mass / (_ROOT_2PI * width)
    return shift, u, wide, high
