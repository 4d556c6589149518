"""Where the stripe was found, before it is measured."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True, eq=False)
class FoundStripe:
    """Chains of points near the middle of the stripe, strongest chain first.

    Attributes
    ----------
    uv : (n, 2)   tops of the smoothed image, px of the full image, in order along each chain; one of the two is a whole row or column of the size
        in which it was found
    chain : (n,)   chain of each point, ascending from 0
    spread_px2 : (n,)   variance of the smoothed profile along that row or column
    scale_px : (k,)   standard deviation of the smoothing at which each chain was found: 1, 2 or 4
    crowded : bool   there is so much else in the picture that short pieces do not count
    clear : bool   it was found at the full size, in the values in which it is to be measured, and stands out far more than it had to
    """

    uv: Float[np.ndarray, "n 2"]
    chain: Int[np.ndarray, " n"]
    spread_px2: Float[np.ndarray, " n"]
    scale_px: Float[np.ndarray, " k"]
    crowded: bool
    clear: bool
