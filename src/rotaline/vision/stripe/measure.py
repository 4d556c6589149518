"""Centres of a traced stripe, measured on the pixels across it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from rotaline.vision.stripe.background import Steps, fit_steps
from rotaline.vision.stripe.centres import Centres
from rotaline.vision.stripe.clear_kernels import clear_points, measure_clear
from rotaline.vision.stripe.curve import Chains
from rotaline.vision.stripe.fit_kernels import fit_gaussians
from rotaline.vision.stripe.found import FoundStripe
from rotaline.vision.stripe.measure_kernels import (
    SIDE_PX,
    SIDE_WIDTHS,
    best_centres,
    clipped_cores,
    read_stripe,
    subtract_lines,
)
from rotaline.vision.stripe.options import StripeOptions
from rotaline.vision.stripe.plane import Plane
from rotaline.vision.stripe.profiles import sample_profiles
from rotaline.vision.stripe.row_kernels import cross_lines, flat_centroids
from rotaline.vision.stripe.steger_kernels import ridge_points
from rotaline.vision.stripe.strips import Strips, strips_of
from rotaline.vision.stripe.trace import SHORTEST, SIMPLE_PX, Trace
from rotaline.vision.stripe.uncertainty_kernels import scatter_and_floor

_REACH = 3.5  # widths of the window
_MOST_HELD_PX = 2.0  # the first strips hold the wider window of a stripe up to this width
_PIXEL_PX = 12.0**-0.5  # standard deviation of a pixel's width
_FIT_REACH = 4.5  # widths


@dataclass(frozen=True, eq=False)
class Measured:
    """What was measured at the n points of a trace, before it is judged.

    Attributes
    ----------
    trace : Trace   the points; ``normal`` is the direction in which they were measured
    normal : (n, 2)   of the stripe
    centres : Centres   shifts along the trace's normals
    noise : (n,)   standard deviation of a pixel
    floor_px : float   of the uncertainty: scatter that the noise does not explain
    u_edge_px : (n,)   uncertainty from an edge under the stripe
    saturated : (n,)   the core is clipped
    """

    trace: Trace
    normal: Float[np.ndarray, "n 2"]
    centres: Centres
    noise: Float[np.ndarray, " n"]
    floor_px: float
    u_edge_px: Float[np.ndarray, " n"]
    saturated: Bool[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class _Ground:
    """What lies under the stripe: a line at every point (level, slope, variance of the slope), and steps at some."""

    line: Float[np.ndarray, "n 3"]
    steps: Steps | None = None
    at: Int[np.ndarray, " m"] | None = None  # points with a step

    def subtract(self, strips: Strips, points: Int[np.ndarray, " k"] | None = None) -> None:
        """Take the ground away from strips across all points, or across some."""
        subtract_lines(
            self.line if points is None else self.line[points],
            strips.first,
            strips.count,
            strips.distance,
            strips.level,
        )
        if points is None:
            points = np.arange(len(self.line))
        if self.at is not None:
            stepped = np.isin(points, self.at)
            self.correct(strips, np.flatnonzero(stepped), np.searchsorted(self.at, points[stepped]))

    def correct(self, strips: Strips, own: Int[np.ndarray, " k"], which: Int[np.ndarray, " k"]) -> None:
        """Put the steps ``which`` in the place of the lines that were taken away from the strips ``own``."""
        if self.steps is None or self.at is None:
            return
        places, strip = strips.places(own)
        d = strips.distance[places].astype(float)
        line = self.line[self.at[which]][strip]
        under = self.steps.at(d, which[strip]) - line[:, 0] - line[:, 1] * d
        strips.level[places] -= under.astype(np.float32)


def measure(trace: Trace, plane: Plane, options: StripeOptions) -> Measured:
    """Centres and uncertainties by the chosen method."""
    if options.method == "improved-gray-gravity":
        measured = _clear(trace, plane)
        if measured is not None:
            return measured
    normal = trace.normal
    if options.method == "gray-gravity":
        uv, starts, width, along, normal = cross_lines(trace.uv, trace.starts, trace.width_px, trace.normal)
        trace = Trace(uv, starts, width, along)
    width = trace.width_px
    value, source = plane.value, plane.source
    *read, line, noise, differ, some, clipped = read_stripe(
        value.reshape(-1), source.reshape(-1), value is not source, float(plane.limit), plane.size, trace.uv, trace.starts,
        trace.normal, width, 1 if options.method == "gray-gravity" else 3, 0.29 * plane.unit,
    )  # fmt: skip
    strips, ground = Strips(*read), _Ground(line)
    zero = u_edge = np.zeros(len(width))
    if options.method in ("improved-gray-gravity", "profile-fit"):
        start = zero
        if some:
            ground, start, u_edge = _with_steps(trace, plane, strips, ground, differ, noise, zero)
        centres, floor = _improved(trace, plane, strips, ground, start, noise)
        if options.method == "profile-fit":
            fit = _fit(trace, plane, ground, np.arange(len(width)), start, width, centres.height, True)
            centres, floor = fit, _floor(trace, fit, noise)
        elif clipped:
            centres, floor = _beside_clipped(trace, plane, ground, strips.hits > 0, start, centres, noise)
        middle = start
    else:
        rough, *_ = _centres(trace, strips, ground, zero, width, noise, 1.0)
        middle = np.where(np.isfinite(rough.shift_px), rough.shift_px, 0.0)
        if options.method == "steger":
            centres = _steger(trace, plane, rough, middle)
        else:
            found = flat_centroids(
                strips.first,
                strips.count,
                strips.distance,
                strips.level,
                strips.share,
                strips.clipped,
                strips.hits,
                width,
                middle,
            )
            centres = Centres(np.where(np.isnan(rough.shift_px), np.nan, found[0]), *found[1:])
        floor = _floor(trace, centres, noise)
    saturated = (
        clipped_cores(strips.hits, middle, width, strips.first, strips.count, strips.distance, strips.clipped)
        if clipped
        else np.zeros(len(width), dtype=bool)
    )
    return Measured(trace, normal, centres, noise, floor, u_edge, saturated)


def measure_clear_stripe(found: FoundStripe, plane: Plane, least: int, options: StripeOptions) -> tuple | None:
    """The points by the default method of a clear stripe that is not wide, traced, measured and judged; None where it is not such a stripe.

    Returns
    -------
    tuple   what :func:`rotaline.vision.stripe.judge_kernels.sound_points` returns
    """
    if len(found.uv) == 0 or not found.clear:
        return None
    value, source = plane.value, plane.source
    known, points = clear_points(
        value.reshape(-1), source.reshape(-1), value is not source, float(plane.limit), plane.size, 0.29 * plane.unit, found.uv,
        found.chain, found.spread_px2, *SIMPLE_PX, 0.5 * options.min_contrast * plane.unit, max(SHORTEST, least // 2), least,
        options.min_length_px,
    )  # fmt: skip
    return points if known else None


def _clear(trace: Trace, plane: Plane) -> Measured | None:
    """Centres by the default method of a stripe that is not wide and has no steps under it; None if it is another."""
    value, source = plane.value, plane.source
    known, (shift, u, wide, height), noise, floor, clipped, hits, saturated, line = measure_clear(
        value.reshape(-1), source.reshape(-1), value is not source, float(plane.limit), plane.size, trace.uv, trace.starts,
        trace.normal, trace.width_px, 0.29 * plane.unit, True,
    )  # fmt: skip
    if not known:
        return None
    centres, zero = Centres(shift, u, wide, height), np.zeros(len(shift))
    if clipped:
        centres, floor = _beside_clipped(trace, plane, _Ground(line), hits, zero, centres, noise)
    return Measured(trace, trace.normal, centres, noise, float(floor), zero, saturated)


def _beside_clipped(
    trace: Trace,
    plane: Plane,
    ground: _Ground,
    hits: Bool[np.ndarray, " n"],
    start: Float[np.ndarray, " n"],
    centres: Centres,
    noise: Float[np.ndarray, " n"],
) -> tuple[Centres, float]:
    """Centres where those that see clipped pixels come from fits to the others; and the floor of their uncertainty."""
    hit, width = np.flatnonzero(hits), trace.width_px
    fit = _fit(trace, plane, ground, hit, start[hit], width[hit], 1.5 * centres.height[hit], False)
    centres = _replaced(centres, hit, fit, start, width)
    return centres, _floor(trace, centres, noise)


def _improved(
    trace: Trace,
    plane: Plane,
    strips: Strips,
    ground: _Ground,
    start: Float[np.ndarray, " n"],
    noise: Float[np.ndarray, " n"],
) -> tuple[Centres, float]:
    """Centres under a window of one width, or of two where these scatter as little; and the floor of their uncertainty."""
    centres, width, scatter, floor, _, wider = _centres(
        trace, strips, ground, start, trace.width_px, noise, 1.0, True, _MOST_HELD_PX
    )
    if wider:
        strips = _strips(trace, plane, _REACH * 2.0 * width + 1.5)
        ground.subtract(strips)
        start = np.where(np.isnan(centres.shift_px), start, centres.shift_px)
        other, _, _, other_floor, better, _ = _centres(
            trace, strips, ground, start, width, noise, 2.0, best_scatter=scatter
        )
        if better:
            return other, other_floor
    return centres, floor


def _centres(
    trace: Trace,
    strips: Strips,
    ground: _Ground,
    start: Float[np.ndarray, " n"],
    width: Float[np.ndarray, " n"],
    noise: Float[np.ndarray, " n"],
    window: float,
    adapt: bool = False,
    most_held_px: float = 0.0,
    best_scatter: float = np.inf,
) -> tuple[Centres, Float[np.ndarray, " n"], float, float, bool, bool]:
    """See :func:`best_centres`."""
    shift, u, measured, height, *more = best_centres(
        trace.uv, trace.starts, trace.normal, width, noise, strips.first, strips.count, strips.distance, strips.level,
        strips.share, ground.line[:, 2], start, window, adapt, most_held_px, best_scatter,
    )  # fmt: skip
    used, scatter, floor, better, wider = more
    return Centres(shift, u, measured, height), used, float(scatter), float(floor), bool(better), bool(wider)


def _floor(trace: Trace, centres: Centres, noise: Float[np.ndarray, " n"]) -> float:
    """The scatter of centres that the noise does not explain."""
    _, floor = scatter_and_floor(trace.uv, trace.starts, trace.normal, centres.shift_px, centres.u_px, noise)
    return float(floor)


def _strips(trace: Trace, plane: Plane, half_length_px: Float[np.ndarray, " n"], lanes: int = 3) -> Strips:
    """Strips across all points of a trace."""
    return strips_of(plane, trace.uv, trace.normal, half_length_px, lanes)


def _with_steps(
    trace: Trace,
    plane: Plane,
    strips: Strips,
    ground: _Ground,
    differ: Bool[np.ndarray, " n"],
    noise: Float[np.ndarray, " n"],
    zero: Float[np.ndarray, " n"],
) -> tuple[_Ground, Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """The ground with steps where the two sides differ; the strips follow. Also the centres so far, and their doubt."""
    rough, *_ = _centres(trace, strips, ground, zero, trace.width_px, noise, 1.0)
    start = np.where(np.isfinite(rough.shift_px), rough.shift_px, 0.0)
    at = np.flatnonzero(differ)
    uv, normal, width = trace.uv[at], trace.normal[at], trace.width_px[at]
    reach = SIDE_WIDTHS * width + SIDE_PX
    part, corner = plane.around(uv, float(reach.max()) + 3.0)
    clipped = part.source >= plane.limit
    profiles = sample_profiles(
        part.value.astype(np.float32), clipped if clipped.any() else None, uv - corner, normal, reach
    )
    steps = fit_steps(profiles, Chains(uv, trace.chain()[at]), start[at], width, noise[at])
    at = at[steps.taken]
    u_edge, start = zero.copy(), start.copy()
    u_edge[at], start[at] = steps.u_edge_px, steps.shift_px
    line = ground.line.copy()
    line[at, 2] = 0.0
    stepped = _Ground(line, steps, at)
    stepped.correct(strips, at, np.arange(len(at)))
    return stepped, start, u_edge


def _fit(
    trace: Trace,
    plane: Plane,
    ground: _Ground,
    which: Int[np.ndarray, " k"],
    start: Float[np.ndarray, " k"],
    width: Float[np.ndarray, " k"],
    height: Float[np.ndarray, " k"],
    fit_background: bool,
) -> Centres:
    """Least-squares fits of a Gaussian at some points; clipped pixels are left out."""
    strips = strips_of(plane, trace.uv[which], trace.normal[which], _FIT_REACH * width + 1.5)
    ground.subtract(strips, which)
    return Centres(
        *fit_gaussians(
            strips.first, strips.count, strips.distance, strips.level, strips.share, strips.clipped, strips.hits,
            start, width, height, fit_background,
        )
    )  # fmt: skip


def _replaced(
    centres: Centres,
    index: Int[np.ndarray, " k"],
    fit: Centres,
    start: Float[np.ndarray, " n"],
    width: Float[np.ndarray, " n"],
) -> Centres:
    """Where pixels are clipped, a Gaussian through the others takes the centroid's place, if there are enough."""
    taken = np.isfinite(fit.shift_px) & (np.abs(fit.shift_px - start[index]) < width[index])
    index = index[taken]
    shift, u, wide = centres.shift_px.copy(), centres.u_px.copy(), centres.width_px.copy()
    shift[index], u[index], wide[index] = fit.shift_px[taken], fit.u_px[taken], fit.width_px[taken]
    return Centres(shift, u, wide, centres.height)


def _steger(trace: Trace, plane: Plane, rough: Centres, middle: Float[np.ndarray, " n"]) -> Centres:
    """Ridge points of the image, smoothed as wide as the stripe is seen by a pixel, at the pixels that the curve passes; height from the centroids."""
    sigma = float(np.clip(np.hypot(np.nanmedian(rough.width_px), _PIXEL_PX), 0.8, 10.0))
    half = int(np.ceil(4 * sigma))
    x = np.arange(-half, half + 1)
    g = np.exp(-0.5 * (x / sigma) ** 2)
    g /= g.sum()
    bells = np.stack([g, g * x / sigma**2, g * (x**2 / sigma**2 - 1.0) / sigma**2]).astype(np.float32)
    uv = trace.uv + middle[:, None] * trace.normal
    shift, u, first = ridge_points(plane.value, uv, trace.normal, trace.width_px, sigma, bells)
    found = first & np.isfinite(rough.shift_px)
    return Centres(np.where(found, shift + middle, np.nan), u, trace.width_px, rough.height)
