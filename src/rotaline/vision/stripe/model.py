"""What a stripe extractor returns."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int


@dataclass(frozen=True, eq=False)
class StripePoints:
    """Sub-pixel centre points of a laser stripe in one image, ordered along each segment.

    Attributes
    ----------
    uv : (n, 2)   centre, px
    normal : (n, 2)   unit normal of the stripe; ``u_normal_px`` holds along it
    width_px : (n,)   standard deviation of the stripe's profile
    intensity : (n,)   height of the profile above the background, in the image's grey values
    u_normal_px : (n,)   standard uncertainty of the centre along the normal, px
    saturated : (n,)   True where the profile's core is clipped
    segment : (n,)   connected pieces of the stripe, numbered from 0; points of a piece stand together, in order
    """

    uv: Float[np.ndarray, "n 2"]
    normal: Float[np.ndarray, "n 2"]
    width_px: Float[np.ndarray, " n"]
    intensity: Float[np.ndarray, " n"]
    u_normal_px: Float[np.ndarray, " n"]
    saturated: Bool[np.ndarray, " n"]
    segment: Int[np.ndarray, " n"]

    def __len__(self) -> int:
        """Number of points."""
        return len(self.uv)

    def select(self, keep: Bool[np.ndarray, " n"]) -> "StripePoints":
        """The points for which ``keep`` is true."""
        return StripePoints(
            self.uv[keep],
            self.normal[keep],
            self.width_px[keep],
            self.intensity[keep],
            self.u_normal_px[keep],
            self.saturated[keep],
            self.segment[keep],
        )
