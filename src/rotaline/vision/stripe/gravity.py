"""Grey gravity straight from the chains that were found: their points stand on whole rows or columns, as the method wants them."""

import numpy as np

from rotaline.vision.stripe.centres import Centres
from rotaline.vision.stripe.found import FoundStripe
from rotaline.vision.stripe.gravity_kernels import clear_points, measure_found
from rotaline.vision.stripe.measure import Measured
from rotaline.vision.stripe.options import StripeOptions
from rotaline.vision.stripe.plane import Plane
from rotaline.vision.stripe.trace import SIMPLE_PX, Trace

_LEAST_NOISE = 0.29  # grey values of an 8 bit image: that of rounding
_LEAST_SIZE = 48  # px; the strips of a stripe that is not wide have room


def clear_points_of(found: FoundStripe, plane: Plane, least: int, options: StripeOptions) -> tuple | None:
    """The points of a clear stripe that is not wide, measured and judged; None where it is not such a stripe.

    Returns
    -------
    tuple   what :func:`rotaline.vision.stripe.judge_kernels.sound_points` returns
    """
    if len(found.uv) == 0 or not found.clear or min(plane.size) < _LEAST_SIZE:
        return None
    value, source = plane.value, plane.source
    known, points = clear_points(
        value.reshape(-1), source.reshape(-1), value is not source, float(plane.limit), plane.size, _LEAST_NOISE * plane.unit,
        found.uv, found.chain, found.spread_px2, *SIMPLE_PX, 0.5 * options.min_contrast * plane.unit, least, options.min_length_px,
    )  # fmt: skip
    return points if known else None


def measure_on_lines(found: FoundStripe, plane: Plane) -> Measured | None:
    """Centroids along the rows or columns in which the points of the chains were found.

    None where there is no point, or where a chain was found in a smaller image, which says less where the stripe is: then it is to be traced.
    """
    if len(found.uv) == 0 or (found.scale_px > 1.0).any():
        return None
    value, source = plane.value, plane.source
    uv, starts, width, along, normal, shift, u, wide, height, noise, floor, saturated = measure_found(
        value.reshape(-1), source.reshape(-1), value is not source, float(plane.limit), plane.size, _LEAST_NOISE * plane.unit,
        found.uv, found.chain, found.spread_px2,
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
