"""From an image to the centre points of the laser stripe."""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float, Float32

from rotaline.vision.images import Image
from rotaline.vision.stripe.background import Background, side_background, step_background
from rotaline.vision.stripe.centres import Centres
from rotaline.vision.stripe.curve import Chains
from rotaline.vision.stripe.ends import average_along
from rotaline.vision.stripe.model import StripePoints
from rotaline.vision.stripe.options import StripeOptions
from rotaline.vision.stripe.pieces import brightest, doubtful_ends, long_enough, of_one_width
from rotaline.vision.stripe.plain.centres import fit_gaussian, weighted_centroid
from rotaline.vision.stripe.plain.curve import break_chains
from rotaline.vision.stripe.plain.ends import sound_ends
from rotaline.vision.stripe.plain.rows import cross_rows, flat_centroid
from rotaline.vision.stripe.plain.steger import steger_centres
from rotaline.vision.stripe.plain.strips import pixel_strips
from rotaline.vision.stripe.plain.trace import SHORTEST, Trace, alike, trace_ridges
from rotaline.vision.stripe.plain.uncertainty import pixel_noise, scatter_and_floor
from rotaline.vision.stripe.profiles import Profiles
from rotaline.vision.stripe.signal import find_stripe, measuring_plane, split_frame

_DEFAULTS = StripeOptions()
_WINDOWS = (1.0, 2.0)  # widths of the stripe
_WIDER = 1.05  # a wider window, which minds the shape of the profile less, may cost so much scatter
_REACH = 3.5  # widths of the window
_WIDTH_PASSES = 2


def extract_stripe_plain(
    image: Image, background: Image | None = None, options: StripeOptions = _DEFAULTS
) -> StripePoints:
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
    frame = split_frame(image, background)
    ridges, crowded = find_stripe(
        frame, options.laser_colour, options.threshold, options.min_contrast, options.min_length_px
    )
    if not ridges:
        return _empty()
    least = max(SHORTEST, int(options.min_length_px)) if crowded else SHORTEST
    k = measuring_plane(frame, options.channel, ridges)
    trace = trace_ridges(ridges, frame.planes[k], frame.clipped[k], least)
    if trace is None:
        return _empty()
    points = _measure(trace, frame.planes[k], frame.clipped[k], frame.unit, least, options)
    if not crowded:
        points = long_enough(points, options.min_length_px)
    points = doubtful_ends(points)
    if crowded or frame.lit:
        points = of_one_width(points)
    return points if options.keep == "all" else brightest(points)


def _measure(
    trace: Trace,
    image: Float32[np.ndarray, "h w"],
    clipped: Bool[np.ndarray, "h w"] | None,
    unit: float,
    least: int,
    options: StripeOptions,
) -> StripePoints:
    """Centres and uncertainties by the chosen method, of pieces of ``least`` points or more."""
    normal = trace.normal
    if options.method == "gray-gravity":
        trace, normal = cross_rows(trace, image, clipped)
    cosine = np.abs((trace.normal * normal).sum(axis=1))
    profiles, width = trace.profiles, trace.width_px
    zero = u_edge = np.zeros(len(width))
    line = side_background(profiles, zero, width)
    rough = weighted_centroid(profiles, line.at(profiles.offset_px), line.slope_variance, zero, width)
    found = np.isfinite(rough.shift_px)
    start = np.where(found, rough.shift_px, 0.0)
    noise = pixel_noise(profiles, trace.chains, start, width, 0.29 * unit)
    if options.method == "gray-gravity":
        centres = flat_centroid(profiles, width, start)
        floor = _scatter(trace, centres, noise)[1]
    elif options.method == "steger":
        centres, first = steger_centres(image, trace.chains.uv + start[:, None] * normal, normal, width)
        centres = replace(centres, shift_px=centres.shift_px + start, height=rough.height)
        found &= first
        floor = _scatter(trace, centres, noise)[1]
    else:
        ground, start = step_background(profiles, trace.chains, start, width, line, noise)
        centres, floor = _centres(trace, image, clipped, ground, start, rough, noise, options)
        u_edge = ground.u_edge_px
    core = np.abs(profiles.offset_px - start[:, None]) <= 1.5 * width[:, None]
    saturated = (profiles.clipped & core).any(axis=1)
    u = np.sqrt((centres.u_px * noise) ** 2 + floor**2 + u_edge**2) * cosine
    with np.errstate(invalid="ignore"):
        good = found & (np.abs(centres.shift_px) <= width + 1.0) & (u < 1.0) & (centres.height > 2.5 * noise)
        good &= centres.height > 0.5 * options.min_contrast * unit
        good &= alike(trace.chains, centres.width_px, 0.2) & _inside(trace, image)
    shift = np.where(good, centres.shift_px, 0.0)
    moved = Chains(trace.chains.uv + trace.normal * shift[:, None], trace.chains.chain)
    tangent = np.column_stack([normal[:, 1], -normal[:, 0]])
    chains, kept = break_chains(moved, tangent, good, least)
    index = np.flatnonzero(kept)
    sound = sound_ends(chains, centres.width_px[index])
    chains, kept = break_chains(chains, tangent[index], sound, least)
    index = index[kept]
    uv, u = chains.uv, u[index]
    if options.average_px > 0:
        uv, gain = average_along(chains, normal[index], options.average_px)
        u = u * gain
    return StripePoints(
        uv=uv,
        normal=normal[index],
        width_px=(centres.width_px * cosine)[index],
        intensity=centres.height[index],
        u_normal_px=u,
        saturated=saturated[index],
        segment=chains.chain,
    )


def _centres(
    trace: Trace,
    image: Float32[np.ndarray, "h w"],
    clipped: Bool[np.ndarray, "h w"] | None,
    ground: Background,
    start: Float[np.ndarray, " n"],
    rough: Centres,
    noise: Float[np.ndarray, " n"],
    options: StripeOptions,
) -> tuple[Centres, float]:
    """Centres, measured on the pixels, and the floor of their uncertainty."""
    uv = trace.chains.uv + start[:, None] * trace.normal
    shift = zero = np.zeros(len(start))

    def strips(half_length_px: Float[np.ndarray, " n"]) -> tuple[Profiles, Float[np.ndarray, "n m"]]:
        pixels = pixel_strips(image, clipped, uv, trace.normal, half_length_px)
        return pixels, ground.at(pixels.offset_px + start[:, None])

    width = trace.width_px
    if options.method == "profile-fit":
        centres = _moved(fit_gaussian(*strips(4.5 * width + 1.5), zero, width, rough.height), start)
        return centres, _scatter(trace, centres, noise)[1]
    pixels, under = strips(_REACH * width + 1.5)
    for _ in range(_WIDTH_PASSES):
        one = weighted_centroid(pixels, under, ground.slope_variance, shift, width, n_iterations=2)
        usable = np.isfinite(one.shift_px)
        shift = np.where(usable, one.shift_px, 0.0)
        measured = np.where(usable, np.clip(one.width_px, 0.6 * trace.width_px, 1.5 * trace.width_px), width)
        width = trace.chains.window_mean(measured, 10)
    best: tuple[float, float, Centres] | None = None
    for window in _WINDOWS:
        if window > 1.0:
            pixels, under = strips(_REACH * window * width + 1.5)
        centres = _moved(weighted_centroid(pixels, under, ground.slope_variance, shift, width, window, 3), start)
        scatter, floor = _scatter(trace, centres, noise)
        if best is None or scatter < _WIDER * best[0]:
            best = (scatter, floor, centres)
        if floor < 0.5 * scatter:
            break  # the noise of the pixels explains the scatter: the narrow window is the best
    assert best is not None
    _, floor, centres = best
    hit = np.asarray(trace.profiles.clipped.any(axis=1))
    if hit.any():
        pixels, under = strips(4.5 * width + 1.5)
        fit = fit_gaussian(pixels.select(hit), under[hit], zero[hit], width[hit], 1.5 * rough.height[hit], False)
        centres = _replaced(centres, hit, _moved(fit, start[hit]), start, width)
        floor = _scatter(trace, centres, noise)[1]
    return centres, floor


def _moved(centres: Centres, by_px: Float[np.ndarray, " n"]) -> Centres:
    """The centres counted from other origins."""
    return replace(centres, shift_px=centres.shift_px + by_px)


def _replaced(
    centres: Centres,
    which: Bool[np.ndarray, " n"],
    fit: Centres,
    start: Float[np.ndarray, " n"],
    width: Float[np.ndarray, " n"],
) -> Centres:
    """Where pixels are clipped, a Gaussian through the others takes the centroid's place, if there are enough."""
    index = np.flatnonzero(which)
    taken = np.isfinite(fit.shift_px) & (np.abs(fit.shift_px - start[index]) < width[index])
    index = index[taken]
    shift, u, wide = centres.shift_px.copy(), centres.u_px.copy(), centres.width_px.copy()
    shift[index], u[index], wide[index] = fit.shift_px[taken], fit.u_px[taken], fit.width_px[taken]
    return Centres(shift, u, wide, centres.height)


def _scatter(trace: Trace, centres: Centres, noise: Float[np.ndarray, " n"]) -> tuple[float, float]:
    """Scatter of centres along their chains, and its part that the noise does not explain."""
    good = np.isfinite(centres.shift_px)
    uv = trace.chains.uv + trace.normal * np.where(good, centres.shift_px, 0.0)[:, None]
    return scatter_and_floor(Chains(uv, trace.chains.chain), trace.normal, np.where(good, centres.u_px * noise, 9.0))


def _inside(trace: Trace, image: Float32[np.ndarray, "h w"]) -> Bool[np.ndarray, " n"]:
    """True where the image holds the profile to two widths on both sides."""
    top = np.array(image.shape[::-1]) - 1.0
    reach = trace.normal * 2.0 * trace.width_px[:, None]
    ends = np.stack([trace.chains.uv - reach, trace.chains.uv + reach])
    return np.asarray(((ends >= 0.0) & (ends <= top)).all(axis=(0, 2)))


def _empty() -> StripePoints:
    """No points."""
    none = np.zeros(0)
    return StripePoints(
        np.zeros((0, 2)), np.zeros((0, 2)), none, none, none, np.zeros(0, dtype=bool), np.zeros(0, dtype=np.int64)
    )
