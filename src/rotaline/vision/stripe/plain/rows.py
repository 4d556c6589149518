"""Grey gravity: the centroid of the grey values along a row or a column of the image."""

import numpy as np
from jaxtyping import Bool, Float, Float32

from rotaline.vision.stripe.background import side_background
from rotaline.vision.stripe.centres import Centres
from rotaline.vision.stripe.curve import Chains
from rotaline.vision.stripe.plain.trace import Trace
from rotaline.vision.stripe.profiles import Profiles, sample_profiles

_REACH = 3.0  # widths on either side
_UNDECIDED = 0.15  # difference of the normal's components


def cross_rows(
    trace: Trace, image: Float32[np.ndarray, "h w"], clipped: Bool[np.ndarray, "h w"] | None
) -> tuple[Trace, Float[np.ndarray, "n 2"]]:
    """The traced stripe where it crosses whole rows (where it is steep) or whole columns (where it is flat).

    Returns
    -------
    trace : Trace   points on whole rows or columns, with profiles along the row or column and widths as seen there
    normal : (n, 2)   the stripe's own normals
    """
    uv: list[np.ndarray] = []
    chain: list[np.ndarray] = []
    normal, axis, width = [], [], []
    steep = _steep(trace)
    runs = 2 * trace.chains.chain + steep
    for start, stop in Chains(trace.chains.uv, np.cumsum(np.diff(runs, prepend=-1) != 0)).spans():
        along = 1 if steep[start] else 0
        points = trace.chains.uv[start:stop]
        sense = 1.0 if points[-1, along] >= points[0, along] else -1.0
        line = np.maximum.accumulate(sense * points[:, along])
        whole = np.arange(np.ceil(line[0]), np.floor(line[-1]) + 1)
        if len(whole) < 2:
            continue
        found = np.empty((len(whole), 2))
        found[:, along] = sense * whole
        found[:, 1 - along] = np.interp(whole, line, points[:, 1 - along])
        own = np.column_stack([np.interp(whole, line, trace.normal[start:stop, k]) for k in (0, 1)])
        uv.append(found)
        normal.append(own / np.hypot(own[:, 0], own[:, 1])[:, None])
        chain.append(np.full(len(whole), len(chain), dtype=np.int64))
        axis.append(np.tile([float(along), 1.0 - along], (len(whole), 1)))
        width.append(np.interp(whole, line, trace.width_px[start:stop]))
    if not uv:
        return trace.select(np.zeros(len(trace.chains), dtype=bool)), np.zeros((0, 2))
    chains = Chains(np.concatenate(uv), np.concatenate(chain))
    own_normal, across = np.concatenate(normal), np.concatenate(axis)
    cosine = np.abs((own_normal * across).sum(axis=1)).clip(0.5)
    across = across * np.sign((own_normal * across).sum(axis=1))[:, None]
    wide = np.concatenate(width) / cosine
    profiles = sample_profiles(image, clipped, chains.uv, across, 4.0 * wide + 4.0)
    return Trace(chains, across, wide, profiles), own_normal


def _steep(trace: Trace) -> Bool[np.ndarray, " n"]:
    """True where rows suit the stripe better than columns; near 45 deg what held before goes on."""
    balance = trace.chains.window_mean(np.abs(trace.normal[:, 0]) - np.abs(trace.normal[:, 1]), 10)
    start, _ = trace.chains.bounds()
    decided = np.where(np.abs(balance) > _UNDECIDED, np.arange(len(balance)), start)
    return np.asarray(balance[np.maximum.accumulate(decided)] >= 0)


def flat_centroid(profiles: Profiles, width_px: Float[np.ndarray, " n"], start_px: Float[np.ndarray, " n"]) -> Centres:
    """Centroid of what stands above the background within three widths; all grey values count alike.

    The window follows the result; its ends fall on whole pixels, as the samples do.
    """
    shift = start_px.copy()
    with np.errstate(all="ignore"):
        for _ in range(3):
            background = side_background(profiles, shift, width_px)
            x = profiles.offset_px - shift[:, None]
            near = profiles.valid & (np.abs(x) <= _REACH * width_px[:, None])
            above = np.where(near, np.maximum(profiles.value - background.at(profiles.offset_px), 0.0), 0.0)
            mass = above.sum(axis=1)
            moment = (above * profiles.offset_px).sum(axis=1) / mass
            shift = np.where(mass > 0, moment, shift)
        x = profiles.offset_px - shift[:, None]
        u = np.sqrt((near * profiles.gain * x**2).sum(axis=1)) / mass
        width = np.sqrt(np.maximum((above * x**2).sum(axis=1) / mass, 0.1))
        height = mass / (np.sqrt(2.0 * np.pi) * width)
    return Centres(np.where(mass > 0, shift, np.nan), u, width, height)
