"""The stripe as ordered chains of points, and windows along a chain."""

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import median_filter


@dataclass(frozen=True, eq=False)
class Chains:
    """Points of several chains, one chain after the other.

    Attributes
    ----------
    uv : (n, 2)   in order along each chain, px
    chain : (n,)   chain of each point, ascending
    """

    uv: Float[np.ndarray, "n 2"]
    chain: Int[np.ndarray, " n"]

    def __len__(self) -> int:
        """Number of points."""
        return len(self.uv)

    def bounds(self) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"]]:
        """First and last index of the chain that each point belongs to."""
        start = np.searchsorted(self.chain, self.chain, side="left")
        stop = np.searchsorted(self.chain, self.chain, side="right") - 1
        return start, stop

    def spans(self) -> list[tuple[int, int]]:
        """Start and stop of each chain."""
        edges = np.concatenate([[0], np.flatnonzero(np.diff(self.chain)) + 1, [len(self.chain)]])
        return [(int(a), int(b)) for a, b in pairwise(edges) if b > a]

    def window_mean(self, values: Float[np.ndarray, " n"], half_window: int) -> Float[np.ndarray, " n"]:
        """Mean of a value over the neighbours of each point in its chain."""
        start, stop = self.bounds()
        i = np.arange(len(self))
        low, high = np.maximum(i - half_window, start), np.minimum(i + half_window, stop)
        total = np.concatenate([[0.0], np.cumsum(values)])
        return (total[high + 1] - total[low]) / (high + 1 - low)

    def window_median(self, values: Float[np.ndarray, " n"], half_window: int) -> Float[np.ndarray, " n"]:
        """Median of a value over the neighbours of each point in its chain.

        The ends are repeated; in a chain no longer than ``half_window`` they would outvote the rest, and it is mirrored.
        """
        out = np.empty(len(self))
        for a, b in self.spans():
            mode: Literal["reflect", "nearest"] = "reflect" if b - a <= half_window else "nearest"
            out[a:b] = median_filter(values[a:b], size=2 * half_window + 1, mode=mode)
        return out
