"""From found chains to curves: ordered centres at a spacing of one pixel, with the stripe's normal and width at each."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from rotaline.vision.stripe.found import FoundStripe
from rotaline.vision.stripe.plane import Plane
from rotaline.vision.stripe.strips import strips_of
from rotaline.vision.stripe.trace_kernels import begin, follow, follow_tops, half_maximum, lines_across, long_chains

SHORTEST = 4  # points of a piece
_WIDER = 1.5
SIMPLE_PX = (0.75, 2.2)  # widths that the profile two pixels from its top tells


@dataclass(frozen=True, eq=False)
class Trace:
    """The stripe to about a tenth of a pixel, ready to be measured.

    Attributes
    ----------
    uv : (n, 2)   smoothed centres, one a pixel of length, px
    starts : (k + 1,)   where each chain starts, and where the last one stops
    width_px : (n,)   standard deviation of the profile, averaged along the stripe
    normal : (n, 2)   unit normals
    """

    uv: Float[np.ndarray, "n 2"]
    starts: Int[np.ndarray, " k1"]
    width_px: Float[np.ndarray, " n"]
    normal: Float[np.ndarray, "n 2"]

    def chain(self) -> Int[np.ndarray, " n"]:
        """Chain of each point."""
        return np.repeat(np.arange(len(self.starts) - 1), np.diff(self.starts))


def trace_stripe(found: FoundStripe, plane: Plane, least: int) -> Trace | None:
    """Follow the chains at full resolution; None where no piece of ``least`` points is left.

    Where the stripe is clear and not wide, the tops that were found tell enough. Elsewhere the pixels across the chains are taken, one a line of
    the image: along the rows or columns in which the points were found, or, of chains found in a smaller image, along the normals. The
    points move to the centroids. The chains are broken where they jump and joined across gaps, and the points spaced equally. Where the stripe
    is wider than it was thought to be, or was found in a smaller image and is in pieces, this is done once more, along the normals.
    """
    if len(found.uv) == 0:
        return None
    uv, coarse = found.uv, bool((found.scale_px > 1.0).any())
    if found.clear:
        uv, starts, width, normal, known = follow_tops(
            uv, found.chain, found.spread_px2, *SIMPLE_PX, max(SHORTEST, least // 2)
        )
        if known:
            return _long(uv, starts, width, normal, least)
        uv = found.uv
    if coarse:
        uv, starts, width, normal = begin(uv, found.chain, found.scale_px)
        p = strips_of(plane, uv, normal, 3.0 * width, 1)
        uv, starts, width, normal = half_maximum(
            uv, starts, width, normal, p.first, p.count, p.distance, p.level, p.share
        )
        along = normal
    else:
        starts, width, normal, along = lines_across(uv, found.chain)
    for last in (False, True):
        if len(uv) == 0:
            break
        p = strips_of(plane, uv, along, 3.5 * width + 3.0, 1)
        widest = width.max()
        uv, starts, width, normal = follow(
            uv, starts, width, normal, along, p.first, p.count, p.distance, p.level, p.share, p.clipped, p.hits,
            least if last else max(SHORTEST, least // 2), not last,
        )  # fmt: skip
        along = normal
        if width.max(initial=0.0) <= _WIDER * widest and (len(starts) == 2 or not coarse):
            break
    return _long(uv, starts, width, normal, least)


def _long(
    uv: Float[np.ndarray, "n 2"],
    starts: Int[np.ndarray, " k1"],
    width: Float[np.ndarray, " n"],
    normal: Float[np.ndarray, "n 2"],
    least: int,
) -> Trace | None:
    """The chains of ``least`` points or more; None where there is none."""
    uv, starts, width, normal = long_chains(uv, starts, width, normal, least)
    return Trace(uv, starts, width, normal) if len(uv) else None
