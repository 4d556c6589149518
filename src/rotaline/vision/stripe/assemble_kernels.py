"""From candidates of ridges to the chains that are the stripe."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.explain_kernels import cover, left_over, too_wide
from rotaline.vision.stripe.link_kernels import link
from rotaline.vision.stripe.settle_kernels import choose, compete

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
    tiles: np.ndarray,
    order: np.ndarray,
    light: np.ndarray,
    where: np.ndarray,
    what: np.ndarray,
    min_length_px: float,
    least: float,
    taken: np.ndarray,
    mark: int,
    finest: np.ndarray,
) -> tuple:
    """Link candidates to chains and let these compete.

    Parameters
    ----------
    n_tiles, n_steep, n_flat, tiles, order, light, where, what
        Of an image of h x w, as they come from :func:`rotaline.vision.stripe.find_kernels.candidates`; ``light`` loses what the chains explain,
        and ``order`` its first part.
    min_length_px : float   a chain as long is no speck
    least : float   prominence of a candidate
    taken : (h, w)   uint8, nowhere ``mark``, which is set here
    finest : (h, w)   float32, zeros; zeros again afterwards

    Returns
    -------
    line, place, prominence, between, spread : (n,)   of the points, in order along each chain, see :class:`rotaline.vision.stripe.find.Chains`
    start : (k + 1,)   where each chain begins
    steep, factor : (k,)   the kind of each chain, and 1
    begin, end, chain : (m,)   the parts of chains that no stronger one covers
    chosen : tuple   what :func:`rotaline.vision.stripe.settle_kernels.choose` makes of them
    n_left : int   tiles with light that no chain explains, in the first parts of ``order`` and ``light``; -1 if a chain is too wide for its size
    """
    rows, columns = tiles.shape[1], tiles.shape[2]
    n = n_steep + n_flat
    line, place = np.empty(n, np.int32), np.empty(n, np.int32)
    prominence, above = np.empty(n, np.float32), np.empty(n, np.float32)
    between, spread, origin = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.int32)
    start = np.zeros(n // 4 + 2, np.int32)
    n_chains, of_steep = 0, 0
    for kind in range(2):
        of_steep = n_chains
        number, lines = (n_flat, w) if kind else (n_steep, h)
        n_chains = link(
            where[2 * kind], where[2 * kind + 1], what[4 * kind], what[4 * kind + 1], number, lines, line, place,
            prominence, above, origin, start, n_chains
        )  # fmt: skip
        _tops(what[4 * kind + 2], what[4 * kind + 3], above, origin, start[of_steep], start[n_chains], between, spread)
    n = start[n_chains]
    line, place, prominence, start = line[:n], place[:n], prominence[:n], start[: n_chains + 1]
    between, spread = between[:n], spread[:n]
    steep, factor = np.zeros(n_chains, np.bool_), np.ones(n_chains, np.int32)
    for k in range(of_steep):
        steep[k] = True
    begin, end, chain = compete(line, place, prominence, start, steep, factor, taken, mark, finest)
    left = 0
    for p in range(len(begin)):
        if too_wide(line, place, prominence, above, begin[p], end[p]):
            left = -1
    if left == 0:
        for p in range(len(begin)):
            cover(line, place, begin[p], end[p], steep[chain[p]], order[1], columns, h, w, light)
        left = left_over(n_tiles, rows, columns, tiles[2].reshape(-1), order[0], order[1], light)
    chosen = choose(line, place, prominence, between, spread, steep, factor, begin, end, chain, min_length_px, least)
    return line, place, prominence, between, spread, start, steep, factor, begin, end, chain, chosen, left


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
