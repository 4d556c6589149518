"""Grey gravity straight from the chains that were found: their points stand on whole rows or columns, as the method wants them."""

import numpy as np

from rotaline.vision.stripe.centres import Centres
from rotaline.vision.stripe.found import FoundStripe
from rotaline.vision.stripe.gravity_kernels import centres_on_lines, whole_lines
from rotaline.vision.stripe.measure import NOISE_FROM, Measured
from rotaline.vision.stripe.plane import Plane
from rotaline.vision.stripe.strips import strips_of
from rotaline.vision.stripe.trace import Trace

_SIDE = 3.0  # widths: the background begins
_REACH, _REACH_PX = 3.5, 3.0  # widths and px to both sides


def measure_on_lines(found: FoundStripe, plane: Plane) -> Measured | None:
    """Centroids along the rows or columns in which the points of the chains were found.

    None where there is no point, or where a chain was found in a smaller image, which says less where the stripe is: then it is to be traced.
    """
    if len(found.uv) == 0 or (found.scale_px > 1.0).any():
        return None
    uv, starts, width, along = whole_lines(found.uv, found.chain)
    for again in (True, False):
        reach = _REACH * width + _REACH_PX
        strips = strips_of(plane, uv, along, reach, 1)
        width, enough, normal, shift, u, wide, height, noise, floor, saturated = centres_on_lines(
            uv, starts, width, along, reach, strips.first, strips.count, strips.distance, strips.level, strips.share,
            strips.clipped, strips.hits, 0.29 * plane.unit, NOISE_FROM, _SIDE, again,
        )  # fmt: skip
        if enough:
            break
    return Measured(
        Trace(uv, starts, width, along),
        normal,
        Centres(shift, u, wide, height),
        noise,
        float(floor),
        np.zeros(len(width)),
        saturated,
    )
