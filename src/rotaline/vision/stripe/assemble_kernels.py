"""From candidates of ridges to the chains that are the stripe."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.explain_kernels import cover, left_over, too_wide
from rotaline.vision.stripe.link_kernels import link
from rotaline.vision.stripe.settle_kernels import BESIDE, choose, compete

_HALF, _UNIT, _TWO, _THREE, _FOUR = np.float32(0.5), np.float32(1.0), np.float32(2.0), np.float32(3.0), np.float32(4.0)
_LEAST_PART, _MOST_PART = np.float32(0.02), np.float32(0.98)


@compiled
@no_type_check
def assemble(
    n_tiles: int,
    n_steep: int,
    n_flat: int,
    h: int,
    w: int,
    height: np.ndarray,
    order: np.ndarray,
    light: np.ndarray,
    where: np.ndarray,
    what: np.ndarray,
    points: np.ndarray,
    heights: np.ndarray,
    chains: np.ndarray,
    parts: np.ndarray,
    min_length_px: float,
    least: float,
) -> tuple:
    """Link candidates to chains and let these compete.

    Parameters
    ----------
    n_tiles, n_steep, n_flat, height, order, light, where, what
        Of an image of h x w, as they come from :func:`rotaline.vision.stripe.find_kernels.candidates`; ``light`` loses what the chains explain,
        and ``order[2]`` becomes the tiles where some is left.
    points : (3, k)   int32; becomes line and place of the points, in order along each chain, and the candidates that they were; the line is the row
        of steep chains, the column of flat ones
    heights : (4, k)   float32; becomes their prominence, how high they are above what is dark around, what is to be added to the place to get to
        the top, and the variance of the smoothed profile there, along the line, px^2
    chains : (3, m)   int32; becomes where each chain begins (and one more ends), its kind (1 for steep), and 1 as its size
    parts : (3, m)   int32; becomes the parts of chains that no stronger one covers: where they begin and end, and the chains they are of
    min_length_px : float   a chain as long is no speck
    least : float   prominence of a candidate

    Returns
    -------
    n_chains, n_parts : int
    n_left : int   tiles with light that no chain explains, in the first parts of ``order[2]`` and ``light``; -1 if a chain is too wide for its size
    chosen : tuple   what :func:`rotaline.vision.stripe.settle_kernels.choose` makes of them
    """
    rows, columns = height.shape
    line, place, prominence, above = points[0], points[1], heights[0], heights[1]
    start, steep, factor = chains[0], chains[1], chains[2]
    start[0] = 0
    n_chains = of_steep = np.int64(0)  # no constants, for each of which what is called would be compiled
    for kind in range(2):
        of_steep = n_chains
        number, lines = (n_flat, w) if kind else (n_steep, h)
        n_chains = link(
            where[2 * kind], where[2 * kind + 1], what[4 * kind], what[4 * kind + 1], number, lines, line, place,
            prominence, above, points[2], start, n_chains
        )  # fmt: skip
        begin, end = start[of_steep], start[n_chains]
        _tops(what[4 * kind + 2], what[4 * kind + 3], above, points[2], begin, end, heights[2], heights[3])
    for k in range(n_chains):
        steep[k], factor[k] = k < of_steep, 1
    n_parts = compete(
        line, place, prominence, start, steep, factor, n_chains, h, w, parts, np.empty((0, 0), np.float32), BESIDE
    )
    left = 0
    for p in range(n_parts):
        if too_wide(line, place, prominence, above, parts[0, p], parts[1, p]):
            left = -1
    if left == 0:
        for p in range(n_parts):
            cover(line, place, parts[0, p], parts[1, p], steep[parts[2, p]], order[1], columns, h, w, light)
        left = left_over(n_tiles, rows, columns, height.reshape(-1), order[0], order[1], light, order[2])
    chosen = choose(
        line, place, prominence, heights[2], heights[3], steep, factor, parts, n_parts, min_length_px, least
    )  # fmt: skip
    return n_chains, n_parts, left, chosen


@compiled
@no_type_check
def _tops(
    top: np.ndarray,
    fall: np.ndarray,
    above: np.ndarray,
    origin: np.ndarray,
    first: int,
    last: int,
    between: np.ndarray,
    spread: np.ndarray,
) -> None:
    """Where the tops of points lie between the pixels, and the variance of the Gaussian that falls off like the profile over two pixels.

    ``fall`` is the mean of both sides; a top beside the middle of the pixel makes it less.
    """
    for k in range(first, last):
        between[k] = top[origin[k]]
        spread[k] = fall[origin[k]]
    refine_tops(above, first, last, between, spread)


@compiled
@no_type_check
def refine_tops(above: np.ndarray, first: int, last: int, between: np.ndarray, spread: np.ndarray) -> None:
    """Turn ``spread``, the mean fall over two pixels, into the variance of the Gaussian that falls off like that."""
    for k in range(first, last):
        square = between[k] * between[k]
        part = min(max(_UNIT - spread[k] / above[k], _LEAST_PART), _MOST_PART)
        variance = _variance(part)
        part *= (_UNIT - _HALF * square / variance) / (_UNIT + _TWO * square / (variance * variance))
        spread[k] = _variance(part)


@compiled
@no_type_check
def _variance(part: float) -> float:
    """Of a Gaussian that has this part of its height two pixels from its middle: ``-2 / log(part)``, to 1 % from 0.25 on."""
    return _TWO * (part * part + _FOUR * part + _UNIT) / (_THREE * (_UNIT - part * part))
