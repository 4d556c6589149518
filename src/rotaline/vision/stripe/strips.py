"""The pixels across the stripe, read from the image once."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from rotaline.vision.stripe.plane import Plane
from rotaline.vision.stripe.strip_kernels import read_strips, strip_places


@dataclass(frozen=True, eq=False)
class Strips:
    """Strips of pixels across n points, all in m places.

    Attributes
    ----------
    spans : (n + 1,)   where the places of each strip start
    distance : (m,)   from the point along its normal, px
    level : (m,)   grey value
    share : (m,)   weight: the less, the further along the stripe; 0 in places that hold no pixel
    clipped : (m,)   the pixel is at the top of the range; undefined for points without hits
    hits : (n,)   number of clipped pixels
    """

    spans: Int[np.ndarray, " n1"]
    distance: Float32[np.ndarray, " m"]
    level: Float32[np.ndarray, " m"]
    share: Float32[np.ndarray, " m"]
    clipped: Bool[np.ndarray, " m"]
    hits: Int[np.ndarray, " n"]

    def places(self, points: Int[np.ndarray, " k"]) -> tuple[Int[np.ndarray, " p"], Int[np.ndarray, " p"]]:
        """The places of the strips of some points, and which of these points each belongs to."""
        count = np.diff(self.spans)[points]
        strip = np.repeat(np.arange(len(points)), count)
        first = np.cumsum(count) - count
        return self.spans[points][strip] + np.arange(len(strip)) - first[strip], strip


def strips_of(
    plane: Plane,
    uv: Float[np.ndarray, "n 2"],
    normal: Float[np.ndarray, "n 2"],
    half_length_px: Float[np.ndarray, " n"],
    lanes: int = 3,
) -> Strips:
    """Strips to ``half_length_px`` on both sides; with one lane of one pixel a line, that nearest to the normal."""
    spans = strip_places(normal, half_length_px, lanes)
    m = int(spans[-1])
    distance, level, share = np.empty(m, np.float32), np.empty(m, np.float32), np.empty(m, np.float32)
    clipped, hits = np.empty(m, dtype=bool), np.empty(len(uv), dtype=np.int64)
    read_strips(
        plane.flat,
        plane.source.reshape(-1),
        plane.value is not plane.source,
        float(plane.limit),
        plane.size,
        uv,
        normal,
        half_length_px,
        lanes,
        spans,
        distance,
        level,
        share,
        clipped,
        hits,
    )
    return Strips(spans, distance, level, share, clipped, hits)
