"""Centre of the stripe in a profile along its normal, with its standard uncertainty."""

import numpy as np
from jaxtyping import Float

from rotaline.vision.stripe.centres import Centres
from rotaline.vision.stripe.profiles import Profiles

_LEAST_WINDOW_PX = 1.0


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

    With a stripe ``A g(d)`` of Gaussian shape on the background b, the fixed point of ``sum((p - b - A g) w d) = 0`` is sought,
    ``d`` the distance from the centre and ``w`` a Gaussian of ``window`` stripe widths; ``A`` follows from
    ``sum((p - b - A g) w) = 0``. Where the stripe is wider than a pixel, ``sum(g w d)`` vanishes and this is the plain centroid
    ``sum((p - b) w d) = 0``; where it is thinner, that sum is what the coarse samples alone would move the centroid by. The window
    is never narrower than a pixel: what a thin stripe's shape differs from a Gaussian then hardly matters. At ``window = 1`` this is the least-squares centre of a Gaussian stripe. The window is symmetric about the result, so where it
    cuts the profile does not pull the centre to one side.

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
    share = np.where(profiles.valid, profiles.weight, 0.0)
    variance = width_px**2
    window_variance = np.maximum(window * width_px, _LEAST_WINDOW_PX) ** 2
    same = bool(np.array_equal(variance, window_variance))
    by_shape, by_window = -0.5 / variance[:, None], -0.5 / window_variance[:, None]
    shift = start_px.copy()
    with np.errstate(all="ignore"):
        for k in range(n_iterations + 1):
            x = d - shift[:, None]
            square = x * x
            g = np.exp(square * by_shape)
            w = share * (g if same else np.exp(square * by_window))
            wg = w * g
            wp = w * above
            g0, g1, g2 = wg.sum(axis=1), _dot(wg, x), _dot(wg, square)
            p0, p1 = wp.sum(axis=1), _dot(wp, x)
            determinant = g0 * g2 - g1 * g1
            height = (g2 * p0 - g1 * p1) / determinant
            step = variance * (g0 * p1 - g1 * p0) / (g2 * p0 - g1 * p1)
            if k < n_iterations:
                shift = shift + np.clip(np.where(np.isfinite(step), step, 0.0), -1.5 * width_px, 1.5 * width_px)
        noise = w * w * profiles.gain
        k0, k1, k2 = noise.sum(axis=1), _dot(noise, x), _dot(noise, square)
        from_slope = g0 * _dot(w, square) - g1 * _dot(w, x)
        u = variance / (height * determinant)
        u = u * np.sqrt(g0 * g0 * k2 - 2.0 * g0 * g1 * k1 + g1 * g1 * k0 + slope_variance * from_slope**2)
        product = variance * window_variance / (variance + window_variance)
        moment = _dot(wp, square) / p0 - g2 / g0 + product
        width = np.sqrt(
            np.maximum(moment * window_variance / np.maximum(window_variance - moment, 1e-3 * window_variance), 0.1)
        )
    bad = ~((p0 > 0) & (height > 0) & np.isfinite(u) & (u > 0))
    return Centres(np.where(bad, np.nan, shift), u, np.minimum(width, 3.0 * width_px), height)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Sum of products, row by row."""
    return np.asarray(np.einsum("nm,nm->n", a, b))


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
    use = np.where(profiles.valid & ~profiles.clipped, profiles.weight / np.maximum(profiles.gain, 0.05), 0.0)
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
    inverse = np.linalg.inv(normal + (1e-9 * diagonal + 1e-12)[:, :, None] * np.eye(n_parameters))
    influence = (design * use[:, :, None]) @ inverse[:, :, :1]
    u = np.sqrt((influence[:, :, 0] ** 2 * profiles.gain).sum(axis=1))
    enough = np.where(use > 0, profiles.weight, 0.0).sum(axis=1) >= n_parameters + 1
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
