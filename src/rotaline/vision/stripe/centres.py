"""Centre of the stripe in a profile along its normal, with its standard uncertainty."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

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
    """

    shift_px: Float[np.ndarray, " n"]
    u_px: Float[np.ndarray, " n"]
    width_px: Float[np.ndarray, " n"]
    height: Float[np.ndarray, " n"]


def weighted_centroid(
    profiles: Profiles,
    background: Float[np.ndarray, "n m"],
    slope_variance: Float[np.ndarray, " n"],
    start_px: Float[np.ndarray, " n"],
    width_px: Float[np.ndarray, " n"],
    window: float = 1.0,
    n_iterations: int = 5,
) -> Centres:
    """Centroid of the grey values under a Gaussian window that moves with it.

    The fixed point of ``sum((p - b) w d) = 0`` is sought, ``d`` the distance from the centre and ``w`` a Gaussian of
    ``window`` stripe widths. At ``window = 1`` this is the least-squares centre of a Gaussian stripe. The window is
    symmetric about the result, so where it cuts the profile does not pull the centre to one side.

    Parameters
    ----------
    profiles : Profiles   n profiles
    background : (n, m)   grey values under the stripe
    slope_variance : (n,)   of the background, for a pixel variance of 1
    start_px : (n,)   centres to start from
    width_px : (n,)   standard deviation of the stripe
    window : float   width of the window over the width of the stripe
    """
    d = profiles.offset_px
    above = np.where(profiles.valid, profiles.value - background, 0.0)
    sigma = np.maximum(window * width_px, 0.5)
    shift = start_px.copy()
    gain = 1.0 + window**2  # Newton's step for a Gaussian stripe
    with np.errstate(all="ignore"):
        for _ in range(n_iterations):
            x = d - shift[:, None]
            weighted = above * np.exp(-0.5 * (x / sigma[:, None]) ** 2)
            step = gain * (weighted * x).sum(axis=1) / weighted.sum(axis=1)
            shift = shift + np.clip(np.where(np.isfinite(step), step, 0.0), -1.5 * width_px, 1.5 * width_px)
        x = d - shift[:, None]
        weight = np.where(profiles.valid, np.exp(-0.5 * (x / sigma[:, None]) ** 2), 0.0)
        score = weight * x
        weighted = above * weight
        mass = weighted.sum(axis=1)
        variance = (score**2 * profiles.gain).sum(axis=1) + slope_variance * (score * x).sum(axis=1) ** 2
        steepness = (weighted * (1.0 - (x / sigma[:, None]) ** 2)).sum(axis=1)
        u = np.sqrt(variance) / steepness
        moment = (weighted * x * x).sum(axis=1) / mass
        width = np.sqrt(np.maximum(moment * sigma**2 / np.maximum(sigma**2 - moment, 1e-3 * sigma**2), 0.1))
        # the height of the Gaussian that holds as much under the window
        spacing = mass / np.maximum(weight.sum(axis=1), 1e-9)
        height = spacing * np.sqrt(1.0 + (sigma / width) ** 2)
    bad = ~((mass > 0) & (steepness > 0) & np.isfinite(u))
    return Centres(np.where(bad, np.nan, shift), u, np.minimum(width, 3.0 * width_px), height)


def fit_gaussian(
    profiles: Profiles,
    background: Float[np.ndarray, "n m"],
    start_px: Float[np.ndarray, " n"],
    width_px: Float[np.ndarray, " n"],
    height: Float[np.ndarray, " n"],
    fit_background: bool = True,
    n_iterations: int = 8,
) -> Centres:
    """Least-squares fit of a Gaussian on a line; clipped samples are left out.

    Parameters
    ----------
    profiles : Profiles   n profiles
    background : (n, m)   grey values under the stripe, subtracted before
    start_px, width_px, height : (n,)   start values
    fit_background : bool   also fit a level and a slope
    """
    d = profiles.offset_px
    use = np.where(profiles.valid & ~profiles.clipped, 1.0 / np.maximum(profiles.gain, 0.05), 0.0)
    target = np.where(profiles.valid, profiles.value - background, 0.0)
    n_parameters = 5 if fit_background else 3
    theta = np.zeros((len(d), 5))
    theta[:, 0], theta[:, 1], theta[:, 2] = start_px, width_px, height
    use = use * (np.abs(d - start_px[:, None]) <= 4.5 * width_px[:, None] + 1.0)
    damping = np.full(len(d), 1e-3)
    cost = _cost(theta, d, target, use)
    for _ in range(n_iterations):
        design, rest = _design(theta, d, target, n_parameters)
        weighted = design * use[:, :, None]
        normal = weighted.transpose(0, 2, 1) @ design
        right = (weighted.transpose(0, 2, 1) @ rest[:, :, None])[:, :, 0]
        diagonal = np.einsum("nii->ni", normal)
        damped = normal + (damping[:, None] * diagonal + 1e-9)[:, :, None] * np.eye(n_parameters)
        step = np.linalg.solve(damped, right[:, :, None])[:, :, 0]
        step[:, 0] = np.clip(step[:, 0], -theta[:, 1], theta[:, 1])
        step[:, 1] = np.clip(step[:, 1], -0.3 * theta[:, 1], 0.5 * theta[:, 1])
        trial = theta.copy()
        trial[:, :n_parameters] += step
        trial_cost = _cost(trial, d, target, use)
        better = trial_cost <= cost
        theta[better], cost[better] = trial[better], trial_cost[better]
        damping = np.where(better, damping * 0.2, damping * 10.0)
    design, _ = _design(theta, d, target, n_parameters)
    normal = (design * use[:, :, None]).transpose(0, 2, 1) @ design
    diagonal = np.einsum("nii->ni", normal)
    covariance = np.linalg.inv(normal + (1e-9 * diagonal + 1e-12)[:, :, None] * np.eye(n_parameters))
    u = np.sqrt(np.maximum(covariance[:, 0, 0], 0.0))
    enough = (use > 0).sum(axis=1) >= n_parameters + 1
    bad = ~(enough & (theta[:, 2] > 0) & np.isfinite(u) & (u > 0) & (theta[:, 1] < 3.0 * width_px + 1.0))
    return Centres(np.where(bad, np.nan, theta[:, 0]), u, theta[:, 1], theta[:, 2])


def _model(theta: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Normalised distance, Gaussian, and the whole model."""
    z = (d - theta[:, :1]) / theta[:, 1:2]
    g = np.exp(-0.5 * z * z)
    return z, g, theta[:, 2:3] * g + theta[:, 3:4] + theta[:, 4:5] * d


def _cost(theta: np.ndarray, d: np.ndarray, target: np.ndarray, use: np.ndarray) -> np.ndarray:
    return (use * (target - _model(theta, d)[2]) ** 2).sum(axis=1)


def _design(theta: np.ndarray, d: np.ndarray, target: np.ndarray, n_parameters: int) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives with respect to centre, width, height, level, slope; and the residuals."""
    z, g, model = _model(theta, d)
    by_centre = theta[:, 2:3] * g * z / theta[:, 1:2]
    columns = [by_centre, by_centre * z, g, np.ones_like(d), d][:n_parameters]
    return np.stack(columns, axis=2), target - model
