"""Grey gravity straight from the chains that were found: their points stand on whole rows or columns, as the method wants them."""

import numpy as np

from rotaline.vision.stripe.centres import Centres
from rotaline.vision.stripe.found import FoundStripe
from rotaline.vision.stripe.gravity_kernels import centres_on_lines
from rotaline.vision.stripe.line_kernels import read_lines
from rotaline.vision.stripe.measure import Measured
from rotaline.vision.stripe.plane import Plane
from rotaline.vision.stripe.row_kernels import whole_lines
from rotaline.vision.stripe.trace import Trace

_WIDTH_PX = 1.5  # of the stripe, to begin with


def measure_on_lines(found: FoundStripe, plane: Plane) -> Measured | None:
    """Centroids along the rows or columns in which the points of the chains were found.

    None where there is no point, or where a chain was found in a smaller image, which says less where the stripe is: then it is to be traced.
    """
    if len(found.uv) == 0 or (found.scale_px > 1.0).any():
        return None
    uv, starts, width, along = whole_lines(found.uv, found.chain, _WIDTH_PX)
    value, source = plane.value, plane.source
    for again in (True, False):
        strips = read_lines(
            value.reshape(-1), source.reshape(-1), value is not source, float(plane.limit), plane.size, uv, along, width
        )
        width, enough, normal, shift, u, wide, height, noise, floor, saturated = centres_on_lines(
            uv, starts, width, along, *strips, 0.29 * plane.unit, again
        )
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
