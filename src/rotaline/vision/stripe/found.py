"""Where the stripe was found, before it is measured."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True, eq=False)
class FoundStripe:
    """Chains of points near the middle of the stripe, strongest chain first.

    Attributes
    ----------
    uv : (n, 2)   px of the full image, to about a pixel, in order along each chain
    chain : (n,)   chain of each point, ascending from 0
    scale_px : (k,)   standard deviation of the smoothing at which each chain was found: 1, 2 or 4
    crowded : bool   there is so much else in the picture that short pieces do not count
    """

    uv: Float[np.ndarray, "n 2"]
    chain: Int[np.ndarray, " n"]
    scale_px: Float[np.ndarray, " k"]
    crowded: bool
