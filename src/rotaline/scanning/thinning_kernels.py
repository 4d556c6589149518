"""What thinning counts in compiled loops (see :mod:`rotaline.geometry.compiled`)."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled


@compiled
@no_type_check
def sum_in_and_around(cells: np.ndarray, known: np.ndarray, values: np.ndarray, total: np.ndarray) -> None:
    """Add to ``total`` the values of the known cells in and next to each cell. Both lists of keys are sorted.

    The three cells in a row along x have keys that follow each other; the nine rows around a cell lie at fixed distances. For each of
    the nine, one walk through both lists finds all of them.
    """
    for z in range(-1, 2):
        for y in range(-1, 2):
            shift = (z << 40) + (y << 20)
            first = 0
            for i in range(len(cells)):
                low = cells[i] + shift - 1
                while first < len(known) and known[first] < low:
                    first += 1
                at = first
                while at < len(known) and known[at] <= low + 2:
                    total[i] += values[at]
                    at += 1
