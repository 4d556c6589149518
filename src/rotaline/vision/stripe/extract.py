"""From an image to the centre points of the laser stripe.

The same as :func:`rotaline.vision.stripe.plain.extract.extract_stripe_plain`, which works on whole images and profiles with NumPy, in compiled
loops that touch little more of the image than the stripe.
"""

import numpy as np

from rotaline.vision.images import Image
from rotaline.vision.stripe.curve import Chains
from rotaline.vision.stripe.ends import average_along
from rotaline.vision.stripe.find import find
from rotaline.vision.stripe.found import FoundStripe
from rotaline.vision.stripe.gravity import clear_points_of, measure_on_lines
from rotaline.vision.stripe.judge_kernels import sound_points
from rotaline.vision.stripe.measure import Measured, measure, measure_clear_stripe
from rotaline.vision.stripe.model import StripePoints
from rotaline.vision.stripe.options import StripeOptions as StripeOptions
from rotaline.vision.stripe.pieces import brightest, counting, of_one_width
from rotaline.vision.stripe.plane import Plane
from rotaline.vision.stripe.trace import SHORTEST, trace_stripe

_DEFAULTS = StripeOptions()


def extract_stripe(image: Image, background: Image | None = None, options: StripeOptions = _DEFAULTS) -> StripePoints:
    """Centre points of the laser stripe, about one a pixel of its length.

    Parameters
    ----------
    image : (h, w) or (h, w, 3)   uint8 or uint16
    background : same shape and type, or None   the same view with the laser off
    options : StripeOptions

    Returns
    -------
    StripePoints
        Empty if the image shows no stripe.

    Raises
    ------
    ValueError
        If the two images differ in shape or type.
    """
    return measure_stripe(*find(image, background, options), options)


def measure_stripe(found: FoundStripe, plane: Plane, options: StripeOptions) -> StripePoints:
    """Centre points of a stripe that was found: what is left to do for :func:`extract_stripe`."""
    least = max(SHORTEST, int(options.min_length_px)) if found.crowded else SHORTEST
    on_lines = options.method == "gray-gravity"
    judged = None
    if on_lines:
        judged = clear_points_of(found, plane, least, options)
    elif options.method == "improved-gray-gravity":
        judged = measure_clear_stripe(found, plane, least, options)
    if judged is None:
        measured = measure_on_lines(found, plane) if on_lines else None
        if measured is None:
            trace = trace_stripe(found, plane, least)
            if trace is None:
                return _empty()
            measured = measure(trace, plane, options)
        judged = _judged(measured, plane, least, options)
    uv, normal, width, height, u, saturated, segment, plain = judged
    if options.average_px > 0:
        uv, gain = average_along(Chains(uv, segment), normal, options.average_px)
        u = u * gain
    points = StripePoints(uv, normal, width, height, u, saturated, segment)
    if not plain:
        points = counting(points, options.min_length_px, found.crowded)
    if found.crowded or plane.lit:
        points = of_one_width(points)
    return points if options.keep == "all" else brightest(points)


def _judged(measured: Measured, plane: Plane, least: int, options: StripeOptions) -> tuple:
    """The measured points that are what a stripe gives: what :func:`rotaline.vision.stripe.judge_kernels.sound_points` returns."""
    m, c, trace = measured, measured.centres, measured.trace
    return sound_points(
        trace.uv, trace.starts, trace.normal, m.normal, trace.width_px, m.noise, c.shift_px, c.u_px, c.width_px,
        c.height, m.u_edge_px, m.saturated, m.floor_px, 0.5 * options.min_contrast * plane.unit, plane.size, least,
        options.min_length_px,
    )  # fmt: skip


def _empty() -> StripePoints:
    """No points."""
    none = np.zeros(0)
    return StripePoints(
        np.zeros((0, 2)), np.zeros((0, 2)), none, none, none, np.zeros(0, dtype=bool), np.zeros(0, dtype=np.int64)
    )
