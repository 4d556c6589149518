"""The ends of a piece of stripe: points there that do not belong to it, and averaging along a piece."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.signal import savgol_filter

from rotaline.vision.stripe.curve import Chains

_REFERENCE = 12  # points that say how the piece goes on
_MOST = 6  # points taken from an end


def sound_ends(chains: Chains, width_px: Float[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """False for points at the ends of chains that do not continue what the next twelve points show.

    Beside a jump, at a corner and where a stripe stops, a profile holds light of two places. Such a point is wider or
    narrower than its neighbours, or lies off the parabola through them. From each end at most six points are taken.
    """
    keep = np.ones(len(chains), dtype=bool)
    for start, stop in chains.spans():
        for order in (np.arange(start, stop), np.arange(start, stop)[::-1]):
            for k in range(_MOST):
                if len(order) < k + 1 + _REFERENCE:
                    break
                if _continues(chains.uv, width_px, order[k], order[k + 1 : k + 1 + _REFERENCE]):
                    break
                keep[order[k]] = False
    return keep


def _continues(uv: np.ndarray, width_px: np.ndarray, point: int, reference: np.ndarray) -> bool:
    """Whether a point has the width of the reference points and lies on the parabola through them."""
    widths = width_px[reference]
    usual = np.median(widths)
    tolerance = 0.06 * usual + 6.0 * np.median(np.abs(widths - usual))
    if abs(width_px[point] - usual) > tolerance:
        return False
    origin, chord = uv[reference[0]], uv[reference[-1]] - uv[reference[0]]
    chord = chord / np.hypot(chord[0], chord[1])
    relative = uv[reference] - origin
    along, across = relative @ chord, relative @ np.array([-chord[1], chord[0]])
    design = np.column_stack([np.ones_like(along), along, along**2])
    coefficients, *_ = np.linalg.lstsq(design, across)
    scatter = float(np.sqrt(np.mean((across - design @ coefficients) ** 2)))
    here = uv[point] - origin
    t = here @ chord
    expected = coefficients @ np.array([1.0, t, t * t])
    return bool(abs(here @ np.array([-chord[1], chord[0]]) - expected) <= 0.1 + 8.0 * scatter)


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
    weights = np.linalg.pinv(np.column_stack([np.ones(size), t, t**2]))[0]
    correlation = _neighbour_correlation(chains, normal)
    ratio = np.sqrt((weights**2).sum() + 2.0 * correlation * (weights[1:] * weights[:-1]).sum())
    for start, stop in chains.spans():
        if stop - start <= size:
            continue
        smooth = savgol_filter(chains.uv[start:stop], size, 2, axis=0)
        n = normal[start:stop]
        uv[start:stop] += n * ((smooth - chains.uv[start:stop]) * n).sum(axis=1)[:, None]
        gain[start + half_window : stop - half_window] = ratio
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
