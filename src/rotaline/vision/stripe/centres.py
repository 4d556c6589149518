"""Centre of the stripe in a profile along its normal, with its standard uncertainty."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from rotaline.vision.stripe.profiles import Profiles


@dataclass(frozen=True, eq=False)
class Centres:
    """One centre a profile; NaN where none was found.

    Attributes
    ----------
    shift_px : (n,)   centre, from the profile's origin along the normal
    u_px : (n,)   standard uncertainty for a pixel noise of 1 grey value
    width_px : (n,)   standard deviation of the profile
    height : (n,)   height above the background, grey values
    background : (n,)   level beside the stripe
    noise : (n,)   standard deviation of the pixels beside the stripe, grey values; NaN where too few
    saturated : (n,)   the core is clipped
    """

    shift_px: Float[np.ndarray, " n"]
    u_px: Float[np.ndarray, " n"]
    width_px: Float[np.ndarray, " n"]
    height: Float[np.ndarray, " n"]
    background: Float[np.ndarray, " n"]
    noise: Float[np.ndarray, " n"]
    saturated: Bool[np.ndarray, " n"]


def weighted_centroid(profiles: Profiles, width_px: Float[np.ndarray, " n"], n_iterations: int = 6) -> Centres:
    """Centroid of the grey values under a Gaussian window that moves with it.

    The background is a line through the samples beyond 2.5 widths on both sides. The window ``w`` has the stripe's own
    width, so the fixed point ``sum((p - b) w d) = 0`` is the least-squares centre of a Gaussian stripe, and since the window
    is symmetric about the result, cutting the profile does not pull it to one side.

    Parameters
    ----------
    profiles : Profiles   n profiles
    width_px : (n,)   standard deviation of the stripe, px
    """
    d, p, valid = profiles.offset_px, profiles.value, profiles.valid
    w = width_px[:, None]
    shift = np.zeros(len(d))
    x = d
    level = slope = np.zeros(len(d))
    spread = np.zeros(len(d))
    above = p
    with np.errstate(all="ignore"):
        for k in range(n_iterations):
            x = d - shift[:, None]
            if k % 2 == 0:
                outer = valid & (np.abs(x) > 2.5 * w)
                level, slope, spread, var_slope = _side_line(x, p, profiles.gain, outer)
                above = np.where(valid, p - level[:, None] - slope[:, None] * x, 0.0)
            else:
                above = np.where(valid, above, 0.0)
            weight = np.exp(-0.5 * (x / w) ** 2)
            mass = (above * weight).sum(axis=1)
            step = 2.0 * (above * weight * x).sum(axis=1) / mass
            step = np.clip(np.where(mass > 0, step, 0.0), -1.5 * width_px, 1.5 * width_px)
            shift = shift + step
        x = d - shift[:, None]
        weight = np.where(valid, np.exp(-0.5 * (x / w) ** 2), 0.0)
        score = weight * x
        slope_score = -(above * weight * (1.0 - (x / w) ** 2)).sum(axis=1)
        mass = (above * weight).sum(axis=1)
        variance = (score**2 * profiles.gain).sum(axis=1) + var_slope * (score * x).sum(axis=1) ** 2
        # d(score sum)/d(shift) = -sum(above (1 - x2/w2) weight) = sum(above' score), here from the profile itself
        steepness = _steepness(above, weight, x, width_px)
        u = np.sqrt(variance) / np.abs(steepness)
        moment = (above * weight * x * x).sum(axis=1) / mass
        measured = np.sqrt(np.maximum(moment * width_px**2 / np.maximum(width_px**2 - moment, 1e-3), 0.05))
        peak = np.where((np.abs(x) <= np.maximum(1.0, 0.5 * w)) & valid, above, -np.inf).max(axis=1)
    del slope_score
    core = np.abs(x) <= 1.5 * w
    saturated = (profiles.clipped & core).any(axis=1)
    bad = ~((mass > 0) & (steepness > 0) & np.isfinite(shift) & np.isfinite(u))
    shift = np.where(bad, np.nan, shift)
    return Centres(shift, u, np.minimum(measured, 3.0 * width_px), peak, level, spread, saturated)


def _steepness(above: np.ndarray, weight: np.ndarray, x: np.ndarray, width_px: np.ndarray) -> np.ndarray:
    """Negative derivative of ``sum(above * weight * x)`` with respect to the shift."""
    return (above * weight * (1.0 - (x / width_px[:, None]) ** 2)).sum(axis=1)


def _side_line(
    x: np.ndarray, p: np.ndarray, gain: np.ndarray, outer: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Level and slope of the background, the noise of its pixels and the variance of the slope (pixel variance 1)."""
    n_left = (outer & (x < 0)).sum(axis=1)
    n_right = (outer & (x > 0)).sum(axis=1)
    both = (n_left >= 2) & (n_right >= 2)
    o = outer.astype(float)
    count = np.maximum(o.sum(axis=1), 1.0)
    mean_x = (o * x).sum(axis=1) / count
    mean_p = (o * p).sum(axis=1) / count
    dx = (x - mean_x[:, None]) * o
    s_xx = np.maximum((dx * dx).sum(axis=1), 1e-9)
    slope = np.where(both, (dx * p).sum(axis=1) / s_xx, 0.0)
    var_slope = np.where(both, 1.0 / s_xx, 0.0)
    level = mean_p - slope * mean_x
    rest = (p - level[:, None] - slope[:, None] * x) * o
    dof = count - np.where(both, 2, 1)
    spread = np.sqrt((rest**2 / np.maximum(gain, 0.1)).sum(axis=1) / np.maximum(dof, 1.0))
    return level, slope, np.where(dof >= 2, spread, np.nan), var_slope
