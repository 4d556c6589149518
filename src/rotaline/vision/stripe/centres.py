"""Where the stripe is in profiles along its normal."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True, eq=False)
class Centres:
    """One centre a profile; NaN where none was found.

    Attributes
    ----------
    shift_px : (n,)   centre, from the profile's origin along the normal
    u_px : (n,)   standard uncertainty for a pixel noise of 1 grey value
    width_px : (n,)   standard deviation of the profile
    height : (n,)   height above the background, grey values
    """

    shift_px: Float[np.ndarray, " n"]
    u_px: Float[np.ndarray, " n"]
    width_px: Float[np.ndarray, " n"]
    height: Float[np.ndarray, " n"]
