"""What the picture of `rotaline rig check` is made from."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rotaline.hardware.camera import Image


@dataclass(frozen=True, eq=False)
class CheckPictures:
    """What the picture shows; None: it was not taken.

    Attributes
    ----------
    off, on : frames without and with the laser
    stripe_uv : (n, 2)   centres of the stripe in ``on``, px
    blur_px : (rows, columns)   blur of the edges in each tile of ``off``, NaN where there is none
    settling : (n, 2)   seconds after moves, and how far the scene then was from where it came to rest, px
    settled_s : from then on it stands
    returns_px : (n,)   where the scene stood after each return, less their mean, px
    """

    off: Image | None = None
    on: Image | None = None
    stripe_uv: Float[np.ndarray, "n 2"] | None = None
    blur_px: Float[np.ndarray, "rows columns"] | None = None
    settling: Float[np.ndarray, "m 2"] | None = None
    settled_s: float | None = None
    returns_px: Float[np.ndarray, " k"] | None = None
