"""Strips of pixels along rows and columns, and the centroid of the light in them, in compiled loops. See :mod:`rotaline.vision.stripe.plain.rows`.

Points stand on whole rows or columns, and a strip is a run of pixels of one of these. ``BLOCK`` points stand side by side, so that sums over strips are
made for many points at once, in full vectors, and for two pixels of each. All strips of a block are as long: ``half`` pixels before the point and as many
behind it. Pixel ``t``, counted from the first one behind point k of a block, stands ``BLOCK * t + k`` behind the block's middle in ``level``, and is
``t + off[k]`` px from the point. Where the image ends the level is NaN; in ``ground`` it is also NaN where a pixel is clipped, as that says nothing about
the background.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

BLOCK = 64  # points
_F = np.float32
_ZERO, _HALF, _UNIT, _TWO, _MOST_STEP = _F(0.0), _F(0.5), _F(1.0), _F(2.0), _F(1.5)  # the last in widths
_NARROW, _ROOT_2PI = _F(0.1), _F(np.sqrt(2.0 * np.pi))
_HUGE, _THIN, _NONE = _F(1e30), _F(1e-3), _F(np.nan)
_SIDE = 3.0  # widths: the background begins, the window ends
_REACH, _REACH_PX = 3.5, 5.5  # widths and px to both sides
_MOST_STEPS = 3
_SHORT_PX = _F(0.3)  # a step is the last when it is shorter: good enough to know the width
_WIDTH, _CENTRE, _LIMIT, _STEP, _LEVEL, _SLOPE = (k * BLOCK for k in range(6))
_N, _X, _XX, _Q, _XQ = (k * BLOCK for k in range(6, 11))  # of all pixels of a strip
_S0, _S1, _S2, _S3, _S4, _S5 = (k * BLOCK for k in range(11, 17))
_SIZE = 17 * BLOCK


@compiled
@no_type_check
def _run_of_pixels(uv: np.ndarray, along: np.ndarray, size: tuple, i: int) -> tuple:
    """The row or column of a point: the first pixel behind it, pixels from one to the next, place of that pixel, last place, that pixel minus the point."""
    axis = 0 if along[i, 0] != 0.0 else 1
    place, line = int(np.floor(uv[i, axis])) + 1, int(np.floor(uv[i, 1 - axis] + 0.5))
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
    width_px : (n,)   of the stripe along it: the strips reach 3.5 of it and 5.5 px to both sides

    Returns
    -------
    middle, half : (blocks,)   where the first pixels behind the points of each block stand, and the pixels on either side of a point
    off : (blocks * BLOCK,)   first pixel behind a point minus the point, px
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
        total += 2 * half[b] * BLOCK
    level, hits = np.empty(total, _F), np.zeros(n, np.int64)
    ground, apart = level, False
    runs = np.empty((4, BLOCK), np.int64)
    pixel, step, place, last = runs[0], runs[1], runs[2], runs[3]
    top = _F(limit)
    for b in range(blocks):
        h, bright = half[b], 0
        begin, end = middle[b] - h * BLOCK, middle[b] + h * BLOCK
        for k in range(BLOCK):
            pixel[k], step[k], place[k], last[k], off[b * BLOCK + k] = _run_of_pixels(
                uv, along, size, min(b * BLOCK + k, n - 1)
            )
        for k in range(BLOCK):
            at, there, stride = np.uint64(pixel[k] - h * step[k]), np.uint64(begin + k), np.uint64(step[k])
            if h <= place[k] <= last[k] + 1 - h:
                for _ in range(h):
                    level[there], level[there + np.uint64(BLOCK)] = value[at], value[at + stride]
                    at += stride + stride
                    there += np.uint64(2 * BLOCK)
            else:
                for t in range(-h, h):
                    inside = 0 <= place[k] + t <= last[k]
                    level[middle[b] + t * BLOCK + k] = value[np.uint64(pixel[k] + t * step[k])] if inside else _NONE
        for j in range(begin, end):
            bright += level[np.uint64(j)] >= top
        if apart or subtracted or bright > 0:
            if not apart:
                apart, ground = True, level.copy()
            ground[begin:end] = level[begin:end]
            for k in range(min(BLOCK, n - b * BLOCK)):
                for t in range(max(-h, -place[k]), min(h, last[k] + 1 - place[k])):
                    if source[np.uint64(pixel[k] + t * step[k])] >= limit:
                        ground[np.uint64(middle[b] + t * BLOCK + k)] = _NONE
                        hits[b * BLOCK + k] += 1
    return middle, half, off, level, ground, hits


@compiled
@no_type_check
def _add_all(s: np.ndarray, level: np.ndarray, at: int, t: float) -> None:
    """Pixels ``t`` and ``t + 1`` of a block: the sums for a line through all of them."""
    for k in range(BLOCK):
        n = x1 = x2 = q0 = q1 = _ZERO
        for j in range(2):
            q, x = level[at + np.uint64(j * BLOCK + k)], t + _F(j)
            use, light = (_UNIT, q) if q == q else (_ZERO, _ZERO)
            n, x1, x2 = n + use, x1 + use * x, x2 + use * (x * x)
            q0, q1 = q0 + light, q1 + light * x
        s[_N + k] += n
        s[_X + k] += x1
        s[_XX + k] += x2
        s[_Q + k] += q0
        s[_XQ + k] += q1


@compiled
@no_type_check
def _sums_of_all(s: np.ndarray, level: np.ndarray, at: int, h: int) -> None:
    """The sums of all pixels of a block."""
    s[_N:_S0] = _ZERO
    for t in range(-h, h, 2):
        _add_all(s, level, np.uint64(at + t * BLOCK), _F(t))


@compiled
@no_type_check
def _add_window(s: np.ndarray, level: np.ndarray, at: int, t: float) -> None:
    """The same sums of what lies within the window."""
    for k in range(BLOCK):
        n = x1 = x2 = q0 = q1 = _ZERO
        centre, limit = s[_CENTRE + k], s[_LIMIT + k]
        for j in range(2):
            q, x = level[at + np.uint64(j * BLOCK + k)], t + _F(j)
            use, light = (_UNIT, q) if (q == q) & (abs(x - centre) <= limit) else (_ZERO, _ZERO)
            n, x1, x2 = n + use, x1 + use * x, x2 + use * (x * x)
            q0, q1 = q0 + light, q1 + light * x
        s[_S0 + k] += n
        s[_S1 + k] += x1
        s[_S2 + k] += x2
        s[_S3 + k] += q0
        s[_S4 + k] += q1


@compiled
@no_type_check
def _inner(s: np.ndarray, h: int) -> int:
    """How many of the ``h`` pixels on either side of the points the windows of a block reach."""
    reach = np.int32(0)
    for k in range(BLOCK):
        reach = max(reach, np.int32(abs(s[_CENTRE + k]) + s[_LIMIT + k]))
    return min(int(reach) + 1, h)


@compiled
@no_type_check
def _background(s: np.ndarray, ground: np.ndarray, at: int, h: int) -> None:
    """A line through what lies outside of the windows of a block."""
    inner = _inner(s, h)
    s[_S0:] = _ZERO
    for t in range(-inner, inner, 2):
        _add_window(s, ground, np.uint64(at + t * BLOCK), _F(t))
    for k in range(BLOCK):
        count, x, q = s[_N + k] - s[_S0 + k], s[_X + k] - s[_S1 + k], s[_Q + k] - s[_S3 + k]
        mean, light = x / max(count, _UNIT), q / max(count, _UNIT)
        spread = s[_XX + k] - s[_S2 + k] - mean * x
        slope = (s[_XQ + k] - s[_S4 + k] - mean * q) / max(spread, _HALF)
        slope = slope if abs(mean - s[_CENTRE + k]) < s[_LIMIT + k] else _ZERO  # one side alone tells no slope
        s[_LEVEL + k], s[_SLOPE + k] = light - slope * mean, slope


@compiled
@no_type_check
def _add_bell(s: np.ndarray, level: np.ndarray, at: int, t: float) -> None:
    """Pixels ``t`` and ``t + 1`` of a block: the sums of :func:`rotaline.vision.stripe.centre_kernels.weighted_centroids`."""
    for k in range(BLOCK):
        s0 = s1 = s2 = s3 = s4 = s5 = _ZERO
        centre, limit, ground, slope = s[_CENTRE + k], s[_LIMIT + k], s[_LEVEL + k], s[_SLOPE + k]
        for j in range(2):
            q, x = level[at + np.uint64(j * BLOCK + k)], t + _F(j)
            above = q - ground - slope * x if q == q else _ZERO
            x -= centre
            square = x * x
            e = min(square * limit, _UNIT)
            e = _UNIT - e + _HALF * e * e  # about exp(-e); 16 times itself that is the bell, to 0.1 % where it matters
            e *= e
            e *= e
            e *= e
            e = e * e if q == q else _ZERO
            shape, light = e * e, e * above
            s0, s1, s2 = s0 + shape, s1 + shape * x, s2 + shape * square
            s3, s4, s5 = s3 + light, s4 + light * x, s5 + light * square
        s[_S0 + k] += s0
        s[_S1 + k] += s1
        s[_S2 + k] += s2
        s[_S3 + k] += s3
        s[_S4 + k] += s4
        s[_S5 + k] += s5


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
    """
    n, blocks = len(width_px), len(middle)
    out = np.empty((2, blocks * BLOCK), _F)
    s = np.zeros(_SIZE, _F)
    for b in range(blocks):
        at, h, first = middle[b], half[b], b * BLOCK
        for k in range(min(BLOCK, n - first)):
            s[_WIDTH + k], s[_CENTRE + k] = width_px[first + k], -off[first + k]
        widest = np.int32(0)
        for k in range(BLOCK):
            s[_LIMIT + k] = _F(_SIDE) * s[_WIDTH + k]
            widest = max(widest, np.int32(_F(_REACH) * s[_WIDTH + k]))
        _sums_of_all(s, ground, at, h)
        _background(s, ground, at, h)
        for k in range(BLOCK):
            s[_LIMIT + k] = _F(0.03125) / (s[_WIDTH + k] * s[_WIDTH + k])
        reach = min(int(widest) + 1, h)
        for _ in range(_MOST_STEPS):
            s[_S0:] = _ZERO
            for t in range(-reach, reach, 2):
                _add_bell(s, level, np.uint64(at + t * BLOCK), _F(t))
            far = 0
            for k in range(BLOCK):
                g0, g1, p0, p1, w = s[_S0 + k], s[_S1 + k], s[_S3 + k], s[_S4 + k], s[_WIDTH + k]
                step = w * w * (g0 * p1 - g1 * p0) / (s[_S2 + k] * p0 - g1 * p1)
                step = min(max(step, -_MOST_STEP * w), _MOST_STEP * w) if abs(step) < _HUGE else _ZERO
                s[_CENTRE + k] += step
                far += abs(step) > _SHORT_PX
            if far == 0:
                break
        for k in range(BLOCK):
            g0, g1, g2 = s[_S0 + k], s[_S1 + k], s[_S2 + k]
            p0, p1, p2 = s[_S3 + k], s[_S4 + k], s[_S5 + k]
            variance = s[_WIDTH + k] * s[_WIDTH + k]
            high = (g2 * p0 - g1 * p1) / (g0 * g2 - g1 * g1)
            middle_off, own = p1 / p0, g1 / g0  # the same but for the last step
            moment = p2 / p0 - middle_off * middle_off - g2 / g0 + own * own + _HALF * variance
            wide = moment * variance / max(variance - moment, _THIN * variance)
            out[0, first + k] = s[_CENTRE + k] + off[first + k] if (p0 > _ZERO) & (high > _ZERO) else _NONE
            out[1, first + k] = min(np.sqrt(max(wide, _NARROW)), _TWO * _MOST_STEP * s[_WIDTH + k])
    return out[0], out[1]


@compiled
@no_type_check
def _add_light(s: np.ndarray, level: np.ndarray, at: int, t: float) -> None:
    """Pixels ``t`` and ``t + 1`` of a block: moments of the window itself, and of what stands above the background in it."""
    for k in range(BLOCK):
        n = x1 = x2 = q0 = q1 = q2 = _ZERO
        centre, limit, ground, slope = s[_CENTRE + k], s[_LIMIT + k], s[_LEVEL + k], s[_SLOPE + k]
        for j in range(2):
            q, x = level[at + np.uint64(j * BLOCK + k)], t + _F(j)
            light = q - ground - slope * x
            x -= centre
            use = (q == q) & (abs(x) <= limit)
            one, light = _UNIT if use else _ZERO, max(light, _ZERO) if use else _ZERO
            n, x1, x2 = n + one, x1 + one * x, x2 + one * (x * x)
            q0, q1, q2 = q0 + light, q1 + light * x, q2 + light * (x * x)
        s[_S0 + k] += n
        s[_S1 + k] += x1
        s[_S2 + k] += x2
        s[_S3 + k] += q0
        s[_S4 + k] += q1
        s[_S5 + k] += q2


@compiled
@no_type_check
def flat_centroids(
    middle: np.ndarray,
    half: np.ndarray,
    off: np.ndarray,
    level: np.ndarray,
    ground: np.ndarray,
    width_px: np.ndarray,
    start_px: np.ndarray,
    passes: int,
) -> tuple:
    """Centroid of what stands above the background within three widths; all grey values count alike.

    The window follows the result; its ends fall on whole pixels. The background is a line through what lies outside of it.

    Parameters
    ----------
    passes : int   windows, each about the result of the one before

    Returns
    -------
    shifts, uncertainties for a noise of 1, widths, heights
    """
    n = len(start_px)
    out = np.empty((4, len(off)))
    s = np.zeros(_SIZE, _F)
    for b in range(len(middle)):
        at, h, first = middle[b], half[b], b * BLOCK
        for k in range(min(BLOCK, n - first)):
            s[_CENTRE + k], s[_LIMIT + k] = start_px[first + k] - off[first + k], _SIDE * width_px[first + k]
        _sums_of_all(s, ground, at, h)
        for _ in range(passes):
            _background(s, ground, at, h)
            inner = _inner(s, h)
            s[_S0:] = _ZERO
            for t in range(-inner, inner, 2):
                _add_light(s, level, np.uint64(at + t * BLOCK), _F(t))
            for k in range(BLOCK):
                step = s[_S4 + k] / s[_S3 + k] if s[_S3 + k] > _ZERO else _ZERO
                s[_STEP + k] = step
                s[_CENTRE + k] += step
        for k in range(BLOCK):
            mass, step = s[_S3 + k], s[_STEP + k]
            near = s[_S2 + k] - _TWO * step * s[_S1 + k] + step * step * s[_S0 + k]
            width = np.sqrt(max(s[_S5 + k] / mass - step * step, _NARROW))
            out[0, first + k] = s[_CENTRE + k] + off[first + k] if mass > _ZERO else _NONE
            out[1, first + k] = np.sqrt(max(near, _ZERO)) / mass
            out[2, first + k] = width
            out[3, first + k] = mass / (_ROOT_2PI * width)
    return out[0, :n], out[1, :n], out[2, :n], out[3, :n]
