"""Least-squares fit of a Gaussian to strips of pixels, in compiled loops. See :func:`rotaline.vision.stripe.plain.centres.fit_gaussian`."""

from typing import no_type_check

import numpy as np

from rotaline.geometry.compiled import compiled
from rotaline.vision.stripe.strip_kernels import BLOCK

_STEPS = 8


@compiled
@no_type_check
def _solve(matrix: np.ndarray, right: np.ndarray, n: int) -> None:
    """Solve a positive definite system in place; the solution stands in ``right``."""
    for k in range(n):
        for i in range(k + 1, n):
            f = matrix[i, k] / matrix[k, k]
            for j in range(k, n):
                matrix[i, j] -= f * matrix[k, j]
            right[i] -= f * right[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            right[k] -= matrix[k, j] * right[j]
        right[k] /= matrix[k, k]


@compiled
@no_type_check
def _equations(
    d: np.ndarray, p: np.ndarray, use: np.ndarray, theta: np.ndarray, n: int, normal: np.ndarray, right: np.ndarray
) -> float:
    """Normal equations of a step, and the present sum of squares."""
    normal[:, :] = 0.0
    right[:] = 0.0
    cost = 0.0
    row = np.empty(5)
    for k in range(len(d)):
        w = use[k]
        if w == 0.0:
            continue
        z = (d[k] - theta[0]) / theta[1]
        g = np.exp(-0.5 * z * z)
        rest = p[k] - theta[2] * g - theta[3] - theta[4] * d[k]
        row[0] = theta[2] * g * z / theta[1]
        row[1], row[2], row[3], row[4] = row[0] * z, g, 1.0, d[k]
        cost += w * rest * rest
        for i in range(n):
            right[i] += w * row[i] * rest
            for j in range(i + 1):
                normal[i, j] += w * row[i] * row[j]
    for i in range(n):
        for j in range(i):
            normal[j, i] = normal[i, j]
    return cost


@compiled
@no_type_check
def fit_gaussians(
    first: np.ndarray,
    count: np.ndarray,
    distance: np.ndarray,
    above: np.ndarray,
    share: np.ndarray,
    clipped: np.ndarray,
    hits: np.ndarray,
    start_px: np.ndarray,
    width_px: np.ndarray,
    height: np.ndarray,
    fit_background: bool,
) -> tuple:
    """As :func:`rotaline.vision.stripe.plain.centres.fit_gaussian`: shifts, uncertainties for a noise of 1, widths, heights."""
    n = len(start_px)
    shift, u, wide, high = np.full(n, np.nan), np.empty(n), np.empty(n), np.empty(n)
    p = 5 if fit_background else 3
    theta, trial = np.zeros(5), np.zeros(5)
    normal, kept, right, step = np.empty((5, 5)), np.empty((5, 5)), np.empty(5), np.empty(5)
    for i in range(n):
        m, own = count[i], slice(first[i], first[i] + BLOCK * count[i], BLOCK)
        d, light = distance[own].astype(np.float64), above[own].astype(np.float64)
        weight, top = share[own], clipped[own]
        use = np.zeros(m)
        enough = 0.0
        for k in range(m):
            near = abs(d[k] - start_px[i]) <= 4.5 * width_px[i] + 1.0
            if near and weight[k] > 0.0 and not (hits[i] > 0 and top[k]):
                use[k] = weight[k]
                enough += use[k]
        theta[:] = 0.0
        theta[0], theta[1], theta[2] = start_px[i], width_px[i], height[i]
        damping = 1e-3
        cost = _equations(d, light, use, theta, p, normal, right)
        for _ in range(_STEPS):
            kept[:, :] = normal
            step[:] = right
            for k in range(p):
                kept[k, k] += damping * normal[k, k] + 1e-9
            _solve(kept, step, p)
            step[0] = min(max(step[0], -theta[1]), theta[1])
            step[1] = min(max(step[1], -0.3 * theta[1]), 0.5 * theta[1])
            for k in range(p):
                trial[k] = theta[k] + step[k]
            next_cost = _equations(d, light, use, trial, p, kept, step)
            if next_cost <= cost:
                done = cost - next_cost <= 1e-9 * cost
                theta[:] = trial
                cost = next_cost
                normal[:, :] = kept
                right[:] = step
                damping *= 0.2
                if done:
                    break
            else:
                damping *= 10.0
        # first row of the inverse: what each pixel does to the centre
        step[:] = 0.0
        step[0] = 1.0
        for k in range(p):
            normal[k, k] += 1e-9 * normal[k, k] + 1e-12
        _solve(normal, step, p)
        total = 0.0
        for k in range(m):
            if use[k] > 0.0:
                z = (d[k] - theta[0]) / theta[1]
                g = np.exp(-0.5 * z * z)
                slope = theta[2] * g * z / theta[1]
                pull = slope * step[0] + slope * z * step[1] + g * step[2] + step[3] + step[4] * d[k]
                total += (use[k] * pull) ** 2
        u[i], wide[i], high[i] = np.sqrt(total), theta[1], theta[2]
        if (
            enough >= p + 1
            and theta[2] > 0.0
            and np.isfinite(u[i])
            and u[i] > 0.0
            and theta[1] < 3.0 * width_px[i] + 1.0
        ):
            shift[i] = theta[0]
    return shift, u, wide, high
