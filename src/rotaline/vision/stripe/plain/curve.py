"""Chains of points: directions, equal spacing, breaks, joining."""

import numpy as np
from jaxtyping import Bool, Float, Int

from rotaline.vision.stripe.curve import Chains


def local_lines(
    chains: Chains, half_window: int, noise_px: float = 0.05
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Smoothed position and unit tangent at every point.

    A line is fitted to the points of a window that is centred on the point, of one that ends at it and of one that begins
    at it. A one-sided window wins only where the centred one fits clearly worse, at a corner or a jump, so that the
    direction does not bend around it. No window leaves its chain.

    Parameters
    ----------
    chains : Chains   about equally spaced points
    half_window : int   points on either side
    noise_px : float   misfit that is not worth a one-sided window
    """
    n = len(chains)
    start, stop = chains.bounds()
    i = np.arange(n)
    before, after = np.maximum(i - half_window, start), np.minimum(i + half_window, stop)
    # a window at an end of its chain keeps half the length of a centred one
    first, last = np.maximum(stop - half_window, start), np.minimum(start + half_window, stop)
    windows = (
        (np.minimum(before, first), np.maximum(after, last)),
        (before, np.maximum(i, last)),
        (np.minimum(i, first), after),
    )
    t = (i - start).astype(float)
    origin = chains.uv[start]
    x = chains.uv - origin
    terms = np.column_stack([np.ones(n), t, t * t, x, x * t[:, None], (x * x).sum(axis=1)])
    total = np.vstack([np.zeros(terms.shape[1]), np.cumsum(terms, axis=0)])
    best = np.full(n, np.inf)
    smooth, tangent = chains.uv.copy(), np.zeros_like(chains.uv)
    for rank, (low, high) in enumerate(windows):
        s = total[high + 1] - total[low]
        count, mean_t = s[:, 0], s[:, 1] / s[:, 0]
        var_t = np.maximum(s[:, 2] - count * mean_t**2, 1e-9)
        mean = s[:, 3:5] / count[:, None]
        slope = (s[:, 5:7] - mean_t[:, None] * s[:, 3:5]) / var_t[:, None]
        rest = s[:, 7] - count * (mean**2).sum(axis=1) - var_t * (slope**2).sum(axis=1)
        misfit = np.maximum(rest, 0.0) / np.maximum(count - 2, 1) + noise_px**2
        misfit *= 1.0 if rank == 0 else 4.0
        better = misfit < best
        best[better] = misfit[better]
        smooth[better] = (origin + mean + slope * (t - mean_t)[:, None])[better]
        tangent[better] = slope[better]
    norm = np.hypot(tangent[:, 0], tangent[:, 1])[:, None]
    return smooth, np.where(norm > 1e-9, tangent / np.maximum(norm, 1e-9), np.array([1.0, 0.0]))


def resample(chains: Chains, spacing_px: float = 1.0) -> Chains:
    """Points at equal arc length along the polyline of each chain, from its first point on."""
    uv, chain = [], []
    for number, (a, b) in enumerate(chains.spans()):
        points = chains.uv[a:b]
        step = np.hypot(*np.diff(points, axis=0).T)
        points = points[np.concatenate([[True], step > 1e-6])]
        length = np.concatenate([[0.0], np.cumsum(step[step > 1e-6])])
        at = np.arange(0.0, length[-1] + 1e-6, spacing_px)
        uv.append(np.column_stack([np.interp(at, length, points[:, k]) for k in (0, 1)]))
        chain.append(np.full(len(at), number, dtype=np.int64))
    if not uv:
        return chains
    return Chains(np.concatenate(uv), np.concatenate(chain))


def break_chains(
    chains: Chains, tangent: Float[np.ndarray, "n 2"], good: Bool[np.ndarray, " n"], min_points: int
) -> tuple[Chains, Bool[np.ndarray, " n"]]:
    """Break chains at jumps and leave out points that are not good, that go backwards, or that stand in short pieces.

    A jump is a gap of more than 3 px, or a move of more than 1.2 px across the stripe from one point to the next.

    Returns
    -------
    chains : Chains   renumbered from 0
    kept : (n,) bool   which of the points these are
    """
    index = np.flatnonzero(good)
    for _ in range(3):
        uv, t, chain = chains.uv[index], tangent[index], chains.chain[index]
        move = np.diff(uv, axis=0)
        forward = (move * t[:-1]).sum(axis=1)
        back = (chain[1:] == chain[:-1]) & (np.maximum(forward, (move * t[1:]).sum(axis=1)) < 0.3)
        if not back.any():
            break
        index = index[np.concatenate([[True], ~back])]
    uv, t, chain = chains.uv[index], tangent[index], chains.chain[index]
    move = np.diff(uv, axis=0)
    across = np.minimum(
        np.abs(move[:, 0] * t[:-1, 1] - move[:, 1] * t[:-1, 0]), np.abs(move[:, 0] * t[1:, 1] - move[:, 1] * t[1:, 0])
    )
    jump = (chain[1:] != chain[:-1]) | (across > 1.2) | (np.hypot(move[:, 0], move[:, 1]) > 3.0)
    label = np.concatenate([[0], np.cumsum(jump)]) if len(index) else np.zeros(0, dtype=np.int64)
    count = np.bincount(label) if len(index) else np.zeros(0, dtype=np.int64)
    long = count[label] >= min_points if len(index) else np.zeros(0, dtype=bool)
    index, label = index[long], label[long]
    kept = np.zeros(len(chains), dtype=bool)
    kept[index] = True
    _, number = np.unique(label, return_inverse=True)
    return Chains(chains.uv[index], number.astype(np.int64)), kept


def join_chains(
    chains: Chains, tangent: Float[np.ndarray, "n 2"], reach_px: float
) -> tuple[Chains, Int[np.ndarray, " n"]]:
    """Join chains end to end where one goes on in the direction of the other, at most ``reach_px`` away.

    Returns
    -------
    chains : Chains   renumbered; some may run the other way now
    order : (n,)   old index of each point
    """
    spans = chains.spans()
    if len(spans) < 2:
        return chains, np.arange(len(chains))
    # two ends a chain: 2k its start, 2k + 1 its stop; outward directions
    ends = np.array([i for a, b in spans for i in (a, b - 1)])
    out = tangent[ends] * np.tile([-1.0, 1.0], len(spans))[:, None]
    at = chains.uv[ends]
    move = at[None, :] - at[:, None]
    gap = np.hypot(move[..., 0], move[..., 1])
    ahead = np.einsum("ijk,ik->ij", move, out)
    facing = np.einsum("ik,jk->ij", out, out)
    fits = (gap <= reach_px) & (facing < -0.85) & (ahead >= -1.0) & (gap**2 - ahead**2 <= 1.5**2)
    chain = np.arange(len(ends)) // 2
    fits &= fits.T & (chain[:, None] != chain[None, :])
    partner = np.full(len(ends), -1)
    i, j = np.nonzero(np.triu(fits))
    for k in np.argsort(gap[i, j]):
        if partner[i[k]] < 0 and partner[j[k]] < 0:
            partner[i[k]], partner[j[k]] = j[k], i[k]
    order: list[np.ndarray] = []
    label: list[np.ndarray] = []
    done = np.zeros(len(spans), dtype=bool)
    starts = [e for e in range(len(ends)) if partner[e] < 0] + list(range(len(ends)))  # open ends first, then rings
    for entry in starts:
        if done[entry // 2]:
            continue
        number = int(label[-1][0]) + 1 if label else 0
        while entry >= 0 and not done[entry // 2]:
            a, b = spans[entry // 2]
            done[entry // 2] = True
            piece = np.arange(a, b)
            order.append(piece if entry % 2 == 0 else piece[::-1])
            label.append(np.full(b - a, number, dtype=np.int64))
            entry = int(partner[entry ^ 1])
    index = np.concatenate(order)
    return Chains(chains.uv[index], np.concatenate(label)), index
