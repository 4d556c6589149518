"""Noise of the pixels beside the stripe, and the scatter of the centres that this noise does not explain."""

import numpy as np
from jaxtyping import Float, Int

from rotaline.vision.stripe.background import SIDE
from rotaline.vision.stripe.curve import Chains
from rotaline.vision.stripe.profiles import Profiles

_LAG = 3  # points between profiles whose pixels are compared
_LAGS = (3, 8)  # points between centres that are compared
_GRAINY = 1.25
_TRIM = 0.9
_TRIMMED_TO_SIGMA = 1.267  # of a Gaussian cut at its 90 % quantile


def pixel_noise(
    profiles: Profiles,
    chains: Chains,
    shift_px: Float[np.ndarray, " n"],
    width_px: Float[np.ndarray, " n"],
    floor: float,
) -> Float[np.ndarray, " n"]:
    """Standard deviation of a pixel beside each chain, from the differences of profiles a few points apart.

    Differences along the stripe leave out the shape of halos and slopes. ``floor`` (grey values) is the least value.
    """
    n = len(chains)
    noise = np.full(n, floor)
    if n <= _LAG:
        return noise
    x = profiles.offset_px - shift_px[:, None]
    outer = profiles.valid & (np.abs(x) > (SIDE + 0.3) * width_px[:, None])
    same = chains.chain[_LAG:] == chains.chain[:-_LAG]
    both = outer[_LAG:] & outer[:-_LAG] & same[:, None]
    scale = np.sqrt(np.maximum(profiles.gain[_LAG:] + profiles.gain[:-_LAG], 0.2))
    difference = np.abs(profiles.value[_LAG:] - profiles.value[:-_LAG]) / scale
    everywhere = _trimmed(difference[both])
    for start, stop in chains.spans():
        own = difference[start : stop - _LAG][both[start : stop - _LAG]]
        noise[start:stop] = max(_trimmed(own) if len(own) >= 40 else everywhere, floor)
    return noise


def _trimmed(values: np.ndarray) -> float:
    """Standard deviation of a zero-mean sample from its smaller 90 %; it also serves where the values are whole numbers."""
    if len(values) == 0:
        return 0.0
    cut = np.partition(values, int(_TRIM * (len(values) - 1)))[: int(_TRIM * (len(values) - 1)) + 1]
    return _TRIMMED_TO_SIGMA * float(np.sqrt(np.mean(cut**2)))


def centre_scatter(
    chains: Chains, normal: Float[np.ndarray, "n 2"], lag: int
) -> tuple[Float[np.ndarray, " m"], Int[np.ndarray, " m"]]:
    """Fourth differences of the centres along the normal, scaled to the standard deviation of one centre.

    They are blind to position, direction, curvature and a change of curvature.

    Returns
    -------
    scatter : (m,)   for each point that has neighbours ``lag`` and ``2 lag`` points away on both sides, px
    index : (m,)   these points
    """
    reach = 2 * lag
    if len(chains) <= 2 * reach:
        return np.zeros(0), np.zeros(0, dtype=np.int64)
    i = np.arange(reach, len(chains) - reach)
    i = i[chains.chain[i - reach] == chains.chain[i + reach]]
    uv = chains.uv
    fourth = uv[i - reach] - 4 * uv[i - lag] + 6 * uv[i] - 4 * uv[i + lag] + uv[i + reach]
    return (fourth * normal[i]).sum(axis=1) / np.sqrt(70.0), i


def scatter_and_floor(
    chains: Chains, normal: Float[np.ndarray, "n 2"], u_noise_px: Float[np.ndarray, " n"]
) -> tuple[float, float]:
    """Scatter of the centres about a smooth curve, and what the noise of the pixels leaves unexplained of it, px.

    Speckle, texture and photon noise make the rest; it is added in square to the uncertainty of every point. The clear half
    of the points decides, since weak points are noisy anyway. The grain of speckle makes neighbours alike, so differences
    over two distances are taken; where the longer one shows clearly more it counts alone, else both do. Both results are 0
    where there are too few points to tell.
    """
    found: list[float] = []
    expected = limit = 0.0
    for lag in _LAGS:
        scatter, index = centre_scatter(chains, normal, lag)
        if len(index) < 40:
            break
        u = u_noise_px[index]
        clear = u <= np.median(u)
        expected = float(np.median(u[clear]))
        limit = expected * (1.0 + 3.5 / np.sqrt(clear.sum()))  # more than such a sample could show by chance
        found.append(1.4826 * float(np.median(np.abs(scatter[clear]))))
    if not found:
        return 0.0, 0.0
    clearly_more = found[-1] > _GRAINY * found[0]
    measured = found[-1] if clearly_more else float(np.sqrt(np.mean(np.square(found))))
    return measured, float(np.sqrt(measured**2 - expected**2)) if measured > limit else 0.0
