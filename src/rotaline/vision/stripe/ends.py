"""Which points are ends of a piece of stripe, and averaging along a piece."""

import numpy as np
from jaxtyping import Float

from rotaline.vision.stripe.curve import Chains

REFERENCE = 12  # points that say how the piece goes on
MOST = 6  # points taken from an end
LEAST_CHECKED = MOST + REFERENCE  # points of a piece whose ends can be checked


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
    from scipy.signal import savgol_filter  # takes long to load, and few want it

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
