"""The sums over a whole frame that :mod:`rotaline.vision.stripe.channels` needs, each in one sweep."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled

_BINS = 1024
_KEYS = -0.5  # of Keys' cubic convolution
_LEAST_PART = 0.05  # of a pixel in a sample


@compiled
@no_type_check
def score(
    image: np.ndarray,
    background: np.ndarray,
    subtracted: bool,
    lines: np.ndarray,
    weights: np.ndarray,
    zero: float,
    white_limit: float,
    out: np.ndarray,
    white: np.ndarray,
) -> int:
    """A weighted sum of three channels, background subtracted, as whole numbers.

    Parameters
    ----------
    image, background : (3, h, w)   red, green, blue; the background is read where it is to be ``subtracted``
    lines : (3, 2)   gain and offset of the background for each channel
    weights : (3,)
    zero : float   the number for a sum of 0; numbers end at 0 and 65535
    white_limit : float   pixels as high in all channels are white
    out : (h, w)   uint16
    white : (h, w)   uint8, for 1 where a pixel is white and 0 elsewhere

    Returns
    -------
    int   number of white pixels
    """
    h, w = out.shape
    w0, w1, w2 = np.float32(weights[0]), np.float32(weights[1]), np.float32(weights[2])
    v0, v1, v2 = np.float32(w0 * lines[0, 0]), np.float32(w1 * lines[1, 0]), np.float32(w2 * lines[2, 0])
    level = w0 * lines[0, 1] + w1 * lines[1, 1] + w2 * lines[2, 1] if subtracted else 0.0
    half, most = np.float32(zero + 0.5 - level), np.float32(65535.0)
    bright = image.dtype.type(np.ceil(white_limit))
    sums = np.empty(w, np.float32)
    n_white = 0
    for i in range(h):
        r0, r1, r2, to, lost = image[0, i], image[1, i], image[2, i], out[i], white[i]
        n = np.int32(0)
        for j in range(w):
            a, b, c = r0[j], r1[j], r2[j]
            lost[j] = np.uint8(min(a, min(b, c)) >= bright)
            n += np.int32(lost[j])
            sums[j] = w0 * np.float32(a) + w1 * np.float32(b) + w2 * np.float32(c) + half
        n_white += n
        if subtracted:
            u0, u1, u2 = background[0, i], background[1, i], background[2, i]
            for j in range(w):
                sums[j] -= v0 * np.float32(u0[j]) + v1 * np.float32(u1[j]) + v2 * np.float32(u2[j])
        for j in range(w):
            to[j] = np.uint16(np.int32(min(max(sums[j], np.float32(0.0)), most)))
    return n_white


@compiled
@no_type_check
def subtract(image: np.ndarray, background: np.ndarray, gain: float, offset: float, out: np.ndarray) -> None:
    """``image - (gain * background + offset)`` of (h, w) planes, as float32."""
    g, o = np.float32(gain), np.float32(offset)
    for i in range(out.shape[0]):
        row, under, to = image[i], background[i], out[i]
        for j in range(len(to)):
            to[j] = np.float32(row[j]) - (g * np.float32(under[j]) + o)


@compiled
@no_type_check
def to_steps(values: np.ndarray, scale: float, zero: float, out: np.ndarray) -> None:
    """``scale * values + zero`` of (h, w) float32 values as whole numbers, which end at 0 and 65535."""
    factor, half, most = np.float32(scale), np.float32(zero + 0.5), np.float32(65535.0)
    for i in range(out.shape[0]):
        row, to = values[i], out[i]
        for j in range(len(to)):
            to[j] = np.uint16(np.int32(min(max(factor * row[j] + half, np.float32(0.0)), most)))


@compiled
@no_type_check
def take_pairs(
    image: np.ndarray,
    background: np.ndarray,
    channel: int,
    n_channels: int,
    step: int,
    limit: float,
    x: np.ndarray,
    y: np.ndarray,
    times: np.ndarray,
) -> int:
    """Values that every ``step``-th pixel in rows and columns has in the background (x) and in the image (y), and how many times; returns how many
    pairs.

    Left out are pixels that are 0 in the background, and those at the limit or above. Of 8 bit images equal pairs are counted together. The images
    are (h, w * n_channels), x, y and times long enough for all pixels.
    """
    together = image.itemsize == 1
    count = np.zeros((256, 256) if together else (1, 1), np.int32)
    n = 0
    for i in range(0, image.shape[0], step):
        row, under = image[i], background[i]
        for j in range(channel, len(row), step * n_channels):
            a, b = under[j], row[j]
            usable = (a > 0) & (max(a, b) < limit)
            if together:
                count[a, b] += usable
            else:
                x[n], y[n], times[n] = a, b, 1
                n += usable
    if together:
        for a in range(256):
            for b in range(256):
                if count[a, b]:
                    x[n], y[n], times[n] = a, b, count[a, b]
                    n += 1
    return n


@compiled
@no_type_check
def fit_line(
    x: np.ndarray,
    y: np.ndarray,
    times: np.ndarray,
    unit: float,
    passes: int,
    least: int,
    least_spread: float,
    lit: float,
) -> tuple:
    """Gain and offset of y over x, by the definition of :func:`rotaline.vision.stripe.signal.match_exposure`."""
    n = len(x)
    rest, inner, inner_times = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.int32)
    count = np.empty(_BINS, np.int32)
    for i in range(n):
        rest[i] = y[i] - x[i]
    gain, offset = 1.0, _middle(rest, times, inner, inner_times, count)
    for _ in range(passes):
        for i in range(n):
            rest[i] = abs(y[i] - gain * x[i] - offset)
        limit = 3.0 * max(1.4826 * _middle(rest, times, inner, inner_times, count), unit)
        m, sx, sy, sxx, sxy = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(n):
            t = np.float64(times[i]) if rest[i] <= limit else 0.0
            a, b = np.float64(x[i]), np.float64(y[i])
            m += t
            sx += t * a
            sy += t * b
            sxx += t * a * a
            sxy += t * a * b
        spread = sxx - sx * sx / max(m, 1.0)
        if m < least or spread < least_spread * least_spread * m:
            bright = _middle(x, times, inner, inner_times, count)
            dark = bright < lit
            return (1.0 if dark else _middle(y, times, inner, inner_times, count) / bright), 0.0
        gain = (sxy - sx * sy / m) / spread
        offset = (sy - gain * sx) / m
    return gain, offset


@compiled
@no_type_check
def _middle(
    values: np.ndarray, times: np.ndarray, inner: np.ndarray, inner_times: np.ndarray, count: np.ndarray
) -> float:
    """Median of values that stand for so many each.

    They are counted in bins; those in the bin with the median again in finer bins, until all in it are equal.
    """
    n = len(values)
    total = 0
    for i in range(n):
        inner[i], inner_times[i] = values[i], times[i]
        total += times[i]
    lower, upper = (total - 1) // 2, total // 2
    while True:
        low = high = inner[0]
        for i in range(n):
            low, high = min(low, inner[i]), max(high, inner[i])
        if low == high:
            return np.float64(low)
        scale = np.float32((_BINS - 1) / (high - low))
        for b in range(_BINS):
            count[b] = 0
        for i in range(n):
            count[np.int32((inner[i] - low) * scale)] += inner_times[i]
        own, before = 0, 0
        while before + count[own] <= lower:
            before += count[own]
            own += 1
        if before + count[own] <= upper:  # the two in the middle of an even number lie in two bins
            below, above = low, high
            for i in range(n):
                if np.int32((inner[i] - low) * scale) <= own:
                    below = max(below, inner[i])
                else:
                    above = min(above, inner[i])
            return 0.5 * (np.float64(below) + np.float64(above))
        m = 0
        for i in range(n):
            b = np.int32((inner[i] - low) * scale)
            inner[m], inner_times[m] = inner[i], inner_times[i]
            m += b == own
        n, lower, upper = m, lower - before, upper - before


@compiled
@no_type_check
def heights(
    image: np.ndarray,
    background: np.ndarray,
    subtracted: bool,
    lines: np.ndarray,
    limit: float,
    uv: np.ndarray,
    steep: np.ndarray,
    scale: np.ndarray,
    height: np.ndarray,
    clipped: np.ndarray,
) -> None:
    """How high a stripe stands above its sides at n points, and where it is clipped, in each of three channels.

    The profiles run along the row of steep points and the column of the others, over six times the scale.

    Parameters
    ----------
    image, background : (h, 3 w)   red, green, blue of each pixel; the background is read where it is to be ``subtracted``
    lines : (3, 2)   gain and offset of the background for each channel
    limit : float   values from here on are clipped
    uv : (n, 2)
    steep : (n,)
    scale : (n,)
    height : (3, n)   for the result
    clipped : (3, n)   bool, for the result
    """
    h, w = image.shape[0], image.shape[1] // 3
    weight = np.empty(4)
    tie = 1e-6
    for p in range(len(uv)):
        along, across = (uv[p, 0], uv[p, 1]) if steep[p] else (uv[p, 1], uv[p, 0])
        size_along, size_across = (w, h) if steep[p] else (h, w)
        low = int(np.floor(across))
        _cubic(across - low, weight)
        middle = int(np.floor(along + 0.5 - tie))
        reach = int(np.ceil(6.0 * scale[p]))
        inside = 0 <= across <= size_across - 1
        for k in range(3):
            peak, side, n_side = -np.inf, 0.0, 0
            hit = False
            for line in range(max(middle - reach, 0), min(middle + reach + 1, size_along)):
                distance = abs(line - along)
                if not inside or distance > 6.0 * scale[p] + tie:
                    continue
                near, far = distance <= 2.0 * scale[p], distance >= 4.0 * scale[p]
                if not near and not far:
                    continue
                value = 0.0
                for q in range(4):
                    if weight[q] == 0.0:
                        continue
                    place = min(max(low + q - 1, 0), size_across - 1)
                    i, j = (place, 3 * line + k) if steep[p] else (line, 3 * place + k)
                    pixel = np.float64(image[i, j])
                    hit |= near and (q == 1 or q == 2) and weight[q] > _LEAST_PART and pixel >= limit
                    if subtracted:
                        pixel -= lines[k, 0] * background[i, j] + lines[k, 1]
                    value += weight[q] * pixel
                if near:
                    peak = max(peak, value)
                if far:
                    side += value
                    n_side += 1
            height[k, p] = max(peak - side / max(n_side, 1), 0.0)
            clipped[k, p] = hit


@compiled
@no_type_check
def _cubic(f: float, weight: np.ndarray) -> None:
    """Weights of four pixels at the fraction ``f`` between the second and the third."""
    f2 = f * f
    f3 = f2 * f
    weight[0] = _KEYS * (f3 - 2.0 * f2 + f)
    weight[1] = 1.5 * f3 - 2.5 * f2 + 1.0
    weight[2] = -1.5 * f3 + 2.0 * f2 + 0.5 * f
    weight[3] = 0.5 * (f3 - f2)
