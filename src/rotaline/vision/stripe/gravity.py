"""Grey gravity straight from the chains that were found: their points stand on whole rows or columns, as the method wants them."""

import numpy as np

from rotaline.vision.stripe.centres import Centres
from rotaline.vision.stripe.found import FoundStripe
from rotaline.vision.stripe.gravity_kernels import noise_and_floor, rough_centres
from rotaline.vision.stripe.measure import LAG, NOISE_FROM, PAIRS, SIDE_PX, SIDE_WIDTHS, Measured
from rotaline.vision.stripe.measure_kernels import clipped_cores
from rotaline.vision.stripe.plane import Plane
from rotaline.vision.stripe.row_kernels import cross_lines, flat_centroids
from rotaline.vision.stripe.strip_kernels import side_differences
from rotaline.vision.stripe.strips import strips_of
from rotaline.vision.stripe.trace import Trace
from rotaline.vision.stripe.trace_kernels import lines_across

_SIDE = 3.0  # widths: the background begins
_WIDTH_PX = 1.5  # of the stripe, to begin with


def measure_on_lines(found: FoundStripe, plane: Plane) -> Measured | None:
    """Centroids along the rows or columns in which the points of the chains were found.

    None where there is no point, or where a chain was found in a smaller image, which says less where the stripe is: then it is to be traced.
    """
    if len(found.uv) == 0 or (found.scale_px > 1.0).any():
        return None
    starts, width, normal, _ = lines_across(found.uv, found.chain)
    uv, starts, width, along, normal = cross_lines(found.uv, starts, np.full(len(width), _WIDTH_PX), normal)
    for _ in range(2):
        reach = 3.5 * width + 3.0
        strips = strips_of(plane, uv, along, reach, 1)
        shift, good, moved, normal, width = rough_centres(
            uv, starts, width, along, strips.first, strips.count, strips.distance, strips.level, strips.share,
            strips.clipped, strips.hits,
        )  # fmt: skip
        if (_SIDE * width + SIDE_PX <= reach + 2.0).all():
            break
    differences, ends = side_differences(
        plane.flat, plane.size, moved, along, starts, NOISE_FROM * width, SIDE_WIDTHS * width + SIDE_PX, LAG, PAIRS
    )
    centres = Centres(
        *flat_centroids(
            strips.first, strips.count, strips.distance, strips.level, strips.share, strips.clipped, strips.hits, width, shift
        )
    )  # fmt: skip
    noise, floor = noise_and_floor(
        uv, starts, along, centres.shift_px, centres.u_px, good, differences, ends, 0.29 * plane.unit
    )
    saturated = (
        clipped_cores(strips.hits, shift, width, strips.first, strips.count, strips.distance, strips.clipped)
        if strips.hits.any()
        else np.zeros(len(width), dtype=bool)
    )
    trace = Trace(uv, starts, width, along)
    return Measured(trace, normal, centres, noise, float(floor), np.zeros(len(width)), saturated)
