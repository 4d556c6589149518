"""Which pieces of what was found are the stripe."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from rotaline.vision.stripe.curve import Chains
from rotaline.vision.stripe.ends import LEAST_CHECKED
from rotaline.vision.stripe.model import StripePoints
from rotaline.vision.stripe.piece_kernels import (
    ALIKE,
    LEAST_PART,
    NEAR_PX,
    SLENDER,
    medians,
    pieces_that_count,
    points_together,
)

_WIDTH_RATIO = 2.2


def counting(points: StripePoints, min_length_px: float, crowded: bool) -> StripePoints:
    """What :func:`long_enough`, unless short pieces are gone already (``crowded``), and :func:`doubtful_ends` leave."""
    return StripePoints(
        *pieces_that_count(
            points.uv, points.normal, points.width_px, points.intensity, points.u_normal_px, points.saturated, points.segment,
            min_length_px, crowded, LEAST_CHECKED,
        )
    )  # fmt: skip


def long_enough(points: StripePoints, min_length_px: float) -> StripePoints:
    """Without short pieces, except those that make up the length together with others close by.

    On a thread the stripe is a row of short pieces. Each is as wide as the stripe elsewhere in the frame and has a good
    part of its height, is longer than it is wide, and is not alone. Single bright pixels, spots of light and reflections
    lack one of these.

    Parameters
    ----------
    points : StripePoints
    min_length_px : float   least length of a piece, or of several less than 20 px apart
    """
    if len(points) == 0:
        return points
    highest = np.zeros(points.segment.max() + 1)
    np.maximum.at(highest, points.segment, points.intensity)
    strong = points.intensity > LEAST_PART * highest[points.segment]
    count, core = np.bincount(points.segment), np.bincount(points.segment[strong])
    width, height = _medians(points, points.width_px), _medians(points, points.intensity)
    long = count >= min_length_px
    known = long if long.any() else count > 0
    ratio = width / _usual(width[known], count[known])
    alike = (ratio < ALIKE) & (ratio > 1.0 / ALIKE)
    slender = core >= SLENDER * width
    fits = alike & slender & (height > LEAST_PART * _usual(height[known], count[known]))
    fits |= long & (alike | slender)
    together = points_together(points.uv, points.segment, fits, min_length_px, NEAR_PX)
    return _renumber(points.select((fits & (together >= min_length_px))[points.segment]))


def doubtful_ends(points: StripePoints) -> StripePoints:
    """Short pieces without their two outermost points, and with what is not known of the points next to them.

    Where a stripe is cut off at a slant, the blurred end pulls the centre to one side. A long piece shows which points do
    not continue it; a short one cannot. At x from the outermost point, ``sigma exp(-x / sigma)`` is added in square to the uncertainty; it
    covers cuts up to 30 deg from the normal.
    """
    if len(points) == 0:
        return points
    if np.bincount(points.segment).min() >= LEAST_CHECKED:
        return points
    chains = Chains(points.uv, points.segment)
    start, stop = chains.bounds()
    i = np.arange(len(points))
    to_end = np.minimum(i - start, stop - i)
    short = stop - start + 1 < LEAST_CHECKED
    sigma = points.width_px
    u = np.where(short, np.hypot(points.u_normal_px, sigma * np.exp(-to_end / sigma)), points.u_normal_px)
    return replace(points, u_normal_px=u).select(~short | (to_end > 0))


def of_one_width(points: StripePoints) -> StripePoints:
    """Without the segments that are much wider or narrower than most of the stripe: other things in the scene."""
    if len(points) == 0:
        return points
    count = np.bincount(points.segment)
    width = _medians(points, points.width_px)
    usual = _usual(width, count)
    fits = (width > usual / _WIDTH_RATIO) & (width < usual * _WIDTH_RATIO)
    return _renumber(points.select(fits[points.segment]))


def brightest(points: StripePoints) -> StripePoints:
    """Of the points in one row (one column, where the stripe is flat) those of the strongest segment."""
    if len(points) == 0:
        return points
    light = points.intensity * points.width_px
    strength = np.bincount(points.segment, weights=light) / np.bincount(points.segment)
    steep = np.sum(light * (np.abs(points.normal[:, 0]) - np.abs(points.normal[:, 1]))) > 0
    line = np.rint(points.uv[:, 1 if steep else 0]).astype(np.int64)
    best = np.zeros(line.max() - min(line.min(), 0) + 1)
    np.maximum.at(best, line, strength[points.segment])
    return _renumber(points.select(strength[points.segment] >= best[line]))


def _medians(points: StripePoints, values: Float[np.ndarray, " n"]) -> Float[np.ndarray, " k"]:
    """Median of a value over each segment."""
    return medians(values, points.segment)


def _usual(values: Float[np.ndarray, " k"], count: Int[np.ndarray, " k"]) -> float:
    """Median of the segments' values, each counted as often as it has points."""
    order = np.argsort(values)
    return float(values[order][np.searchsorted(np.cumsum(count[order]), 0.5 * count.sum())])


def _renumber(points: StripePoints) -> StripePoints:
    """Segments numbered from 0 without gaps."""
    _, segment = np.unique(points.segment, return_inverse=True)
    return replace(points, segment=segment.astype(np.int64))
