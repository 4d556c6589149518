"""The pixels across the stripe, read from the image once."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from rotaline.vision.stripe.plane import Plane
from rotaline.vision.stripe.strip_kernels import BLOCK, read_strips


@dataclass(frozen=True, eq=False)
class Strips:
    """Strips of pixels across n points, all in m places; those of a point are ``BLOCK`` apart.

    Attributes
    ----------
    first, count : (n,)   first place of each strip and how many it has
    distance : (m,)   from the point along its normal, px
    level : (m,)   grey value
    share : (m,)   weight: the less, the further along the stripe; 0 in places that hold no pixel
    clipped : (m,)   the pixel is at the top of the range; undefined for points without hits
    hits : (n,)   number of clipped pixels
    """

    first: Int[np.ndarray, " n"]
    count: Int[np.ndarray, " n"]
    distance: Float32[np.ndarray, " m"]
    level: Float32[np.ndarray, " m"]
    share: Float32[np.ndarray, " m"]
    clipped: Bool[np.ndarray, " m"]
    hits: Int[np.ndarray, " n"]

    def places(self, points: Int[np.ndarray, " k"]) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
        """The places of the strips of some points, and which of these points each belongs to."""
        count = self.count[points]
        strip = np.repeat(np.arange(len(points)), count)
        before = np.cumsum(count) - count
        return self.first[points][strip] + BLOCK * (np.arange(len(strip)) - before[strip]), strip


def strips_of(
    plane: Plane,
    uv: Float[np.ndarray, "n 2"],
    normal: Float[np.ndarray, "n 2"],
    half_length_px: Float[np.ndarray, " n"],
    lanes: int = 3,
) -> Strips:
    """Strips to ``half_length_px`` on both sides; with one lane of one pixel a line, that nearest to the normal."""
    value, source = plane.value, plane.source
    first, count, distance, level, share, clipped, hits = read_strips(
        value.reshape(-1), source.reshape(-1), value is not source, float(plane.limit), plane.size, uv, normal, half_length_px,
        lanes,
    )  # fmt: skip
    return Strips(first, count, distance, level, share, clipped, hits)
