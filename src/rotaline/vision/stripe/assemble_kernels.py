"""From candidates of ridges to the chains that are the stripe."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.explain_kernels import cover, left_over, too_wide
from rotaline.vision.stripe.link_kernels import link
from rotaline.vision.stripe.settle_kernels import choose, compete


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
    taken : (h, w)   uint8, nowhere ``mark``, which is set here
    finest : (h, w)   float32, zeros; zeros again afterwards

    Returns
    -------
    line, place, prominence : (n,)   of the points, in order along each chain; the line is the row of steep chains, the column of flat ones
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
    start = np.zeros(n // 4 + 2, np.int32)
    n_chains, of_steep = 0, 0
    for kind in range(2):
        of_steep = n_chains
        number, lines = (n_flat, w) if kind else (n_steep, h)
        n_chains = link(
            where[2 * kind], where[2 * kind + 1], what[2 * kind], what[2 * kind + 1], number, lines, line, place,
            prominence, above, start, n_chains
        )  # fmt: skip
    n = start[n_chains]
    line, place, prominence, start = line[:n], place[:n], prominence[:n], start[: n_chains + 1]
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
    chosen = choose(line, place, prominence, steep, factor, begin, end, chain, min_length_px)
    return line, place, prominence, start, steep, factor, begin, end, chain, chosen, left
