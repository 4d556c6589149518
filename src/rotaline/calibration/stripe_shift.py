"""How far the centre of a stripe lies from the image of the middle of the sheet, on a curved surface.

Seen from the camera, the surface is ``t`` mm off the middle of the sheet: ``t(s, q) = a s + b s^2 / 2 + d q^2 / 2``, s px along the stripe's normal
and q along the stripe (:func:`rotaline.calibration.joint.line_width.crossing`). Two things shift the centre from ``s = 0``:

- The line has a width, standard deviation ``sigma`` mm, ``w = sigma / a`` px in the image. The centre of gravity of ``exp(-t^2 / (2 sigma^2))`` lies at
  ``-3 b w^2 / (2 a)``. The profile is skew besides, and a centre found under a Gaussian window of ``m`` stripe widths is not the centre of
  gravity: with ``B`` the square of the blur (px), ``W^2 = w^2 + B`` that of the width, it is shifted ``1 - w^2 / ((1 + m^2) W^2)`` times as far.
  The extractor takes windows of one and of two widths, as each image suits (:mod:`rotaline.vision.stripe.extract`); here the mean of both counts.
- A stripe that is curved in the image, by ``-d / a`` per px, is blurred towards the inner side of its curve: by ``-d B / (2 a)``. The strip in which
  the extractor gathers a profile blurs it along the stripe a little more.

Both make balls and rods come out small. To first order in ``b`` and ``d``. What the brightness of the surface changes across the line is left out: it is
nothing where the sheet passes through the axis, and of opposite sign on both sides of it.
"""

import numpy as np
from jaxtyping import Float

WINDOW_SHARE = 0.35
"""Mean of ``1 / (1 + m^2)`` over the two windows."""

STRIP_VARIANCE_PX2 = 1.0 / 6.0
"""Variance along the stripe of the weights (a triangle of half width 1 px) with which pixels count in a profile."""


def stripe_shift(
    a: Float[np.ndarray, " n"],
    b: Float[np.ndarray, " n"],
    d: Float[np.ndarray, " n"],
    line_sigma_mm: float,
    blur_px: float,
) -> Float[np.ndarray, " n"]:
    """Shift of the stripe's centre along its normal, px.

    Parameters
    ----------
    a, b : (n,)   mm/px, mm/px^2 along the normal
    d : (n,)   mm/px^2 along the stripe
    line_sigma_mm : standard deviation of the line across the sheet
    blur_px : standard deviation of the image of a line without width: lens and pixels
    """
    line = (line_sigma_mm / a) ** 2
    width = line + blur_px**2
    share = 1.0 - WINDOW_SHARE * np.divide(line, width, out=np.zeros_like(line), where=width > 0)
    return np.asarray(-1.5 * b / a * line * share - d / (2.0 * a) * (blur_px**2 + STRIP_VARIANCE_PX2))
