"""The ends of a piece of stripe: points there that do not belong to it, and averaging along a piece."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import savgol_filter

from rotaline.vision.stripe.curve import Chains

_REFERENCE = 12  # points that say how the piece goes on
_MOST = 6  # points taken from an end
LEAST_CHECKED = _MOST + _REFERENCE  # points of a piece whose ends can be checked


def sound_ends(chains: Chains, width_px: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """False for points at the ends of chains that do not continue what the piece shows further in.

    Beside a jump, at a corner and where a stripe stops, a profile holds light of two places. Such a point is wider or
    narrower than the twelve points further in, or lies off the parabola through them. An end is cut behind the last such
    point among its outermost six.
    """
    keep = np.ones(len(chains), dtype=bool)
    for start, stop in chains.spans():
        if stop - start < LEAST_CHECKED:
            continue
        for order in (np.arange(start, stop), np.arange(start, stop)[::-1]):
            end, reference = order[:_MOST], order[_MOST : _MOST + _REFERENCE]
            unsound = np.flatnonzero(~_continue(chains.uv, width_px, end, reference))
            keep[end[: unsound[-1] + 1 if len(unsound) else 0]] = False
    return keep


def _continue(uv: np.ndarray, width_px: np.ndarray, end: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Whether points have the width of the reference points and lie on the parabola through them."""
    widths = width_px[reference]
    usual = np.median(widths)
    alike = np.abs(width_px[end] - usual) <= 0.06 * usual + 6.0 * np.median(np.abs(widths - usual))
    chord = uv[reference[-1]] - uv[reference[0]]
    axes = np.array([chord, [-chord[1], chord[0]]]) / max(np.hypot(chord[0], chord[1]), 1e-9)
    along, across = axes @ (uv[reference] - uv[reference[0]]).T
    design = np.column_stack([np.ones_like(along), along, along**2])
    inverse = np.linalg.pinv(design)
    coefficients = inverse @ across
    scatter = np.sqrt(np.mean((across - design @ coefficients) ** 2))
    t, place = axes @ (uv[end] - uv[reference[0]]).T
    beyond = np.column_stack([np.ones_like(t), t, t**2])
    doubt = scatter * np.sqrt(1.0 + ((beyond @ inverse) ** 2).sum(axis=1))
    return np.asarray(alike & (np.abs(place - beyond @ coefficients) <= 0.1 + 5.0 * doubt))


def average_along(
    chains: Chains, normal: Float[np.ndarray, "n 2"], half_window: int
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, " n"]]:
    """Centres moved along their normals to the parabola through the neighbours, and the gain in uncertainty.

    Savitzky-Golay of second order within each chain. The gain counts neighbours as correlated as their first and
    fourth differences show them to be.

    Returns
    -------
    uv : (n, 2)
    gain : (n,)   standard uncertainty after over before, for points of equal uncertainty
    """
    uv, gain = chains.uv.copy(), np.ones(len(chains))
    size = 2 * half_window + 1
    t = np.arange(size) - half_window
    design = np.column_stack([np.ones(size), t, t**2])
    weights = design @ np.linalg.pinv(design)  # row k: of the points of a window, for its point k
    correlation = _neighbour_correlation(chains, normal)
    ratio = np.sqrt((weights**2).sum(axis=1) + 2.0 * correlation * (weights[:, 1:] * weights[:, :-1]).sum(axis=1))
    for start, stop in chains.spans():
        if stop - start < size:
            continue
        smooth = savgol_filter(chains.uv[start:stop], size, 2, axis=0)
        n = normal[start:stop]
        uv[start:stop] += n * ((smooth - chains.uv[start:stop]) * n).sum(axis=1)[:, None]
        gain[start:stop] = ratio[half_window]
        gain[start : start + half_window] = ratio[:half_window]
        gain[stop - half_window : stop] = ratio[half_window + 1 :]
    return uv, gain


def _neighbour_correlation(chains: Chains, normal: np.ndarray) -> float:
    """Correlation of the errors of neighbouring centres, from second differences at spacings of one and of four points."""
    same = chains.chain[:-8] == chains.chain[8:]
    if same.sum() < 20:
        return 0.0
    i = np.flatnonzero(same) + 4
    uv = chains.uv
    near = ((uv[i - 1] - 2 * uv[i] + uv[i + 1]) * normal[i]).sum(axis=1)
    far = ((uv[i - 4] - 2 * uv[i] + uv[i + 4]) * normal[i]).sum(axis=1)
    near, far = near - np.median(near), far - np.median(far)
    # variances: (6 - 8 r) s2 with r to the next point and none beyond; 6 s2
    return float(
        np.clip(0.75 * (1.0 - np.median(np.abs(near)) ** 2 / max(np.median(np.abs(far)) ** 2, 1e-12)), 0.0, 0.7)
    )
