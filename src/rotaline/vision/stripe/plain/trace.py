"""From ridges to curves: ordered centres at a spacing of one pixel, with the stripe's normal and width at each."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from rotaline.vision.stripe.background import side_background
from rotaline.vision.stripe.curve import Chains
from rotaline.vision.stripe.plain.centres import weighted_centroid
from rotaline.vision.stripe.plain.curve import break_chains, join_chains, local_lines, resample
from rotaline.vision.stripe.profiles import Profiles, sample_profiles
from rotaline.vision.stripe.ridges import Ridge

SHORTEST = 4  # points of a piece
_WINDOW = 6  # points on either side that settle the direction
_JOIN_PX = 9.0
_BOTH_SIDES = 0.2  # least fall to the higher side, part of the fall to the lower side
_LEAST_WIDTH_PX, _MOST_WIDTH_PX = 0.4, 20.0


@dataclass(frozen=True, eq=False)
class Trace:
    """The stripe to about a tenth of a pixel, ready to be measured.

    Attributes
    ----------
    chains : Chains   smoothed centres, one a pixel of length
    normal : (n, 2)   unit normals
    width_px : (n,)   standard deviation of the profile, averaged along the stripe
    profiles : Profiles   along the normals
    """

    chains: Chains
    normal: Float[np.ndarray, "n 2"]
    width_px: Float[np.ndarray, " n"]
    profiles: Profiles

    def select(self, keep: Bool[np.ndarray, " n"]) -> "Trace":
        """The points for which ``keep`` is true."""
        chains = Chains(self.chains.uv[keep], self.chains.chain[keep])
        return Trace(chains, self.normal[keep], self.width_px[keep], self.profiles.select(keep))


def trace_ridges(
    ridges: list[Ridge],
    value: Float32[np.ndarray, "h w"],
    clipped: Bool[np.ndarray, "h w"] | None,
    least: int,
    n_passes: int = 2,
) -> Trace | None:
    """Follow the ridges at full resolution; None where no piece of ``least`` points is left.

    Each pass takes profiles along the present normals, moves the points to the centroids, breaks the chains where the
    centres jump, and spaces the points equally again.
    """
    if not ridges:
        return None
    chains, width = _start(ridges, value, clipped)
    if len(chains) == 0:
        return None
    for k in range(n_passes):
        _, tangent = local_lines(chains, _WINDOW, 0.3)
        normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
        profiles = sample_profiles(value, clipped, chains.uv, normal, 3.5 * width + 3.0)
        start = np.zeros(len(width))
        background = side_background(profiles, start, width)
        centres = weighted_centroid(
            profiles, background.at(profiles.offset_px), background.slope_variance, start, width
        )
        good = (np.abs(centres.shift_px) <= 1.5 * width + 1.0) & (centres.height > 0)
        measured = np.where(good, np.clip(centres.width_px, _LEAST_WIDTH_PX, _MOST_WIDTH_PX), width)
        good &= alike(chains, measured, 0.25)
        moved = Chains(chains.uv + normal * np.where(good, centres.shift_px, 0.0)[:, None], chains.chain)
        chains, kept = break_chains(moved, tangent, good, least if k else max(SHORTEST, least // 2))
        if len(chains) == 0:
            return None
        width = chains.window_mean(measured[kept], 10)
        dense = resample(Chains(local_lines(chains, 3)[0], chains.chain))
        width = _carry(chains, width, dense)
        chains = dense
        if k == 0:
            _, tangent = local_lines(chains, _WINDOW, 0.3)
            joined, order = join_chains(chains, tangent, _JOIN_PX)
            chains = resample(joined)
            width = _carry(joined, width[order], chains)
    count = np.bincount(chains.chain)
    long = count[chains.chain] >= least
    if not long.any():
        return None
    chains, width = Chains(chains.uv[long], chains.chain[long]), width[long]
    _, tangent = local_lines(chains, _WINDOW)
    normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    return Trace(chains, normal, width, sample_profiles(value, clipped, chains.uv, normal, 4.0 * width + 4.0))


def alike(chains: Chains, width_px: Float[np.ndarray, " n"], tolerance: float) -> Bool[np.ndarray, " n"]:
    """True where a profile is as wide as its neighbours are; between the two sides of a jump and at corners it is not.

    ``tolerance`` is relative; it grows where the widths scatter.
    """
    usual = chains.window_median(width_px, 12)
    deviation = np.abs(width_px - usual)
    return np.asarray(deviation <= tolerance * usual + 4.0 * chains.window_median(deviation, 20))


def _start(
    ridges: list[Ridge], value: Float32[np.ndarray, "h w"], clipped: Bool[np.ndarray, "h w"] | None
) -> tuple[Chains, Float[np.ndarray, " n"]]:
    """The ridges as chains of points one pixel apart, near the top of the profile, and a first guess of the widths."""
    coarse = Chains(
        np.concatenate([ridge.uv for ridge in ridges]),
        np.concatenate([np.full(len(ridge.uv), k, dtype=np.int64) for k, ridge in enumerate(ridges)]),
    )
    scale = np.array([ridge.scale_px for ridge in ridges])
    smooth, _ = local_lines(coarse, 2, 0.3)
    fine = (scale == 1.0)[coarse.chain]
    chains = resample(Chains(np.where(fine[:, None], coarse.uv, smooth), coarse.chain))
    width = 1.5 * scale[chains.chain]
    wide = scale[chains.chain] > 1.0
    if wide.any():
        part = Chains(chains.uv[wide], chains.chain[wide])
        _, tangent = local_lines(part, _WINDOW, 0.3)
        normal = np.column_stack([-tangent[:, 1], tangent[:, 0]])
        shift, width[wide], stands = _half_maximum(part, normal, value, clipped, width[wide])
        uv, keep = chains.uv.copy(), ~wide
        uv[wide] += normal * shift[:, None]
        keep[wide] = stands
        chains, width = Chains(uv[keep], chains.chain[keep]), width[keep]
    return chains, width


def _half_maximum(
    chains: Chains,
    normal: Float[np.ndarray, "n 2"],
    value: Float32[np.ndarray, "h w"],
    clipped: Bool[np.ndarray, "h w"] | None,
    width_px: Float[np.ndarray, " n"],
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """Middle and standard deviation of the part of each profile above half its height, both averaged along the chain.

    A ridge that was found in another image, or in a smaller one, may lie beside the top and say little about the width.
    The third value is False where there is no such top: the profile falls to one side only, as at an edge.
    """
    profiles = sample_profiles(value, clipped, chains.uv, normal, 3.0 * width_px)
    d = profiles.offset_px
    p = np.where(profiles.valid, np.round(profiles.value, 6), np.nan)  # ties are ties, whatever the rounding errors
    near = np.abs(d) <= 0.8 * width_px[:, None]
    n = np.arange(len(d))
    with np.errstate(invalid="ignore"):
        top = np.argmax(np.where(near & profiles.valid, p, -np.inf), axis=1)
        column = np.arange(d.shape[1])
        left = np.where((column <= top[:, None]) & profiles.valid, p, np.inf).min(axis=1)
        right = np.where((column >= top[:, None]) & profiles.valid, p, np.inf).min(axis=1)
        base = np.maximum(left, right)
        peak = p[n, top]
        stands = peak - base > _BOTH_SIDES * (peak - np.minimum(left, right))
        above = p > (0.5 * (peak + base))[:, None]
    spacing = 1.0 / np.abs(normal).max(axis=1)
    low, high = top.copy(), top.copy()
    for _ in range(d.shape[1]):
        further = (low > 0) & above[n, np.maximum(low - 1, 0)]
        low = np.where(further, low - 1, low)
        beyond = (high < d.shape[1] - 1) & above[n, np.minimum(high + 1, d.shape[1] - 1)]
        high = np.where(beyond, high + 1, high)
        if not (further | beyond).any():
            break
    shift = chains.window_median(0.5 * (d[n, low] + d[n, high]), 6)
    full = chains.window_median((high - low + 1) * spacing, 10)
    mostly = chains.window_mean(stands.astype(float), 6) > 0.5
    return shift, np.clip(full / 2.355, _LEAST_WIDTH_PX, 2.0 * width_px), mostly


def _carry(old: Chains, values: np.ndarray, new: Chains) -> np.ndarray:
    """Values of one set of chains at the points of another set with the same chains, by the place along the chain."""
    out = np.empty(len(new))
    for (a, b), (c, d) in zip(old.spans(), new.spans(), strict=True):
        out[c:d] = np.interp(np.linspace(0.0, 1.0, d - c), np.linspace(0.0, 1.0, b - a), values[a:b])
    return out
