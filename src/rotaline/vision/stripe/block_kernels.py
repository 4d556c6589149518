"""A block of points side by side: the pixels across the stripe at each, in compiled loops.

``BLOCK`` points stand side by side, so that all that is done is done for many points at once, in full vectors. Place ``lane`` of line ``l`` of point k
is ``(LANES * l + lane) * BLOCK + k``: on each line of the image that a strip crosses, the lower neighbour of the pixel nearest to the normal, that pixel,
the upper neighbour. See :func:`rotaline.vision.stripe.plain.strips.pixel_strips`.
"""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.strip_kernels import BLOCK

LANES = 3
LINE = LANES * BLOCK  # places on a line
_TIE = 1e-6  # px; so that rounding errors do not decide which pixels are taken
_F, _I = np.float32, np.int32
_ZERO, _UNIT = _F(0.0), _F(1.0)
_ROUND, _OFFSET = _F(1024.5), _I(1024)  # rounding by cutting off works for positive numbers
X, FRACTION, SLOPE, COSINE, SINE = (k * BLOCK for k in range(5))
FORM = 5 * BLOCK
ROWS, _ORIGIN, _LINE_STRIDE, _PLACE_STRIDE, _BASE, _FIRST = (k * BLOCK for k in range(6))
WHOLE = 6 * BLOCK


@compiled
@no_type_check
def take_block(uv: np.ndarray, normal: np.ndarray, begin: int, at: np.ndarray) -> int:
    """Points and normals of a block, side by side in ``at``; how many points it has. The last point stands in the places that it lacks."""
    m = min(BLOCK, len(uv) // 2 - begin)
    own, across = uv[2 * begin :], normal[2 * begin :]
    for k in range(m):
        at[k], at[k + BLOCK] = own[2 * k], own[2 * k + 1]
        at[k + 2 * BLOCK], at[k + 3 * BLOCK] = across[2 * k], across[2 * k + 1]
    for k in range(m, BLOCK):
        for j in range(4):
            at[k + j * BLOCK] = at[m - 1 + j * BLOCK]
    return m


@compiled
@no_type_check
def frame_block(at: np.ndarray, steps: int, size: tuple, form: np.ndarray, whole: np.ndarray) -> bool:
    """How the strips of a block lie in the image; whether all of them are inside of it."""
    inside = _I(0)
    for k in range(BLOCK):
        u, v, nu, nv = at[k], at[k + BLOCK], at[k + 2 * BLOCK], at[k + 3 * BLOCK]
        rows = abs(nu) >= abs(nv)
        on, along = u if rows else v, v if rows else u
        n_on, n_along = nu if rows else nv, nv if rows else nu
        last_line, last_place = size[0] - 1.0 if rows else size[1] - 1.0, size[1] - 1.0 if rows else size[0] - 1.0
        first, base = np.floor(on + (0.5 - _TIE)) - steps, np.floor(along)
        slope = n_along / n_on
        reach = abs(slope) * (steps + 1.0) + 2.0
        fits = (first >= 0.0) & (first + 2 * steps <= last_line) & (along >= reach) & (along < last_place - reach)
        inside = _I(inside + fits)
        form[X + k], form[FRACTION + k], form[SLOPE + k] = first - on, along - base, slope
        form[COSINE + k], form[SINE + k] = n_on, n_along
        line_stride, place_stride = _I(1) if rows else _I(size[0]), _I(size[0]) if rows else _I(1)
        whole[_ORIGIN + k] = _I(_I(first) * line_stride + _I(base) * place_stride)
        whole[_LINE_STRIDE + k], whole[_PLACE_STRIDE + k] = line_stride, place_stride
        whole[_BASE + k], whole[_FIRST + k], whole[ROWS + k] = _I(base), _I(first), _I(rows)
    return inside == BLOCK


@compiled
@no_type_check
def place_lines(
    form: np.ndarray, whole: np.ndarray, lines: int, d: np.ndarray, w: np.ndarray, pixel: np.ndarray
) -> None:
    """Distances from the points, weights, and numbers of the pixels on the lines of a block."""
    for line in range(np.uint64(lines)):
        beyond, ahead, at = _F(line), _I(line), line * np.uint64(LINE)
        for k in range(BLOCK):
            lower, middle, upper = at + np.uint64(k), at + np.uint64(k + BLOCK), at + np.uint64(k + 2 * BLOCK)
            x, c, s = form[X + k] + beyond, form[COSINE + k], form[SINE + k]
            nearest = _I(_I(form[FRACTION + k] + x * form[SLOPE + k] + _ROUND) - _OFFSET)
            y = _F(nearest) - form[FRACTION + k]
            along, t = x * c + y * s, y * c - x * s
            d[lower], d[middle], d[upper] = along - s, along, along + s
            w[lower] = max(_UNIT - abs(t - c), _ZERO)
            w[middle] = max(_UNIT - abs(t), _ZERO)
            w[upper] = max(_UNIT - abs(t + c), _ZERO)
            stride = whole[_PLACE_STRIDE + k]
            own = _I(_I(whole[_ORIGIN + k] + ahead * whole[_LINE_STRIDE + k]) + _I(nearest * stride))
            pixel[lower], pixel[middle], pixel[upper] = _I(own - stride), own, _I(own + stride)


@compiled
@no_type_check
def leave_out(form: np.ndarray, whole: np.ndarray, line: int, size: tuple, w: np.ndarray, pixel: np.ndarray) -> None:
    """Take the weight from what is outside of the image on one line of a block."""
    for k in range(BLOCK):
        rows, on = whole[ROWS + k] == 1, whole[_FIRST + k] + line
        last_line, last_place = (size[0] - 1, size[1] - 1) if rows else (size[1] - 1, size[0] - 1)
        x = form[X + k] + _F(line)
        nearest = _I(_I(form[FRACTION + k] + x * form[SLOPE + k] + _ROUND) - _OFFSET)
        for lane in range(LANES):
            place = whole[_BASE + k] + nearest + lane - 1
            if not (0 <= on <= last_line and 0 <= place <= last_place):
                w[k + lane * BLOCK], pixel[k + lane * BLOCK] = _ZERO, 0


@compiled
@no_type_check
def read_pixels(value: np.ndarray, pixel: np.ndarray, read: np.ndarray) -> None:
    """Read pixels by their numbers."""
    for j in range(len(pixel)):
        read[j] = value[np.uint64(pixel[j])]
