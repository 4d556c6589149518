"""Grey gravity straight from the chains that were found: their points stand on whole rows or columns, as the method wants them."""

import numpy as np

from rotaline.vision.stripe.centres import Centres
from rotaline.vision.stripe.found import FoundStripe
from rotaline.vision.stripe.gravity_kernels import measure_found
from rotaline.vision.stripe.measure import Measured
from rotaline.vision.stripe.plane import Plane
from rotaline.vision.stripe.trace import SIMPLE_PX, Trace


def measure_on_lines(found: FoundStripe, plane: Plane) -> Measured | None:
    """Centroids along the rows or columns in which the points of the chains were found.

    None where there is no point, or where a chain was found in a smaller image, which says less where the stripe is: then it is to be traced.
    """
    if len(found.uv) == 0 or (not found.clear and (found.scale_px > 1.0).any()):
        return None
    value, source = plane.value, plane.source
    uv, starts, width, along, normal, shift, u, wide, height, noise, floor, saturated = measure_found(
        value.reshape(-1), source.reshape(-1), value is not source, float(plane.limit), plane.size, 0.29 * plane.unit,
        found.uv, found.chain, found.spread_px2, found.clear, *SIMPLE_PX,
    )  # fmt: skip
    return Measured(
        Trace(uv, starts, width, along),
        normal,
        Centres(shift, u, wide, height),
        noise,
        float(floor),
        np.zeros(len(width)),
        saturated,
    )
