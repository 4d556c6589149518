"""Nonlinear least squares for few parameters and many observations.

Levenberg-Marquardt in the form that the fits of this layer need: the unknown may be any value (a cylinder, say) with a
local linearisation and a way to take a step; the observations may be a million. Every step solves the problem by
orthogonal factorisation; normal equations, which square the condition number, are never formed.

References
----------
.. [1] Moré, The Levenberg-Marquardt algorithm: implementation and theory, 1978
.. [2] Björck, Numerical Methods for Least Squares Problems, 1996, chapter 9
.. [3] Demmel, Grigori, Hoemmen and Langou, Communication-optimal parallel and sequential QR, SIAM J. Sci. Comput. 34 (2012)
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from jaxtyping import Float

from rotaline.errors import GeometryError

State = TypeVar("State")

MAX_ITERATIONS = 100
MAX_CONDITION = 1e10
BLOCK_ROWS = 128


@dataclass(frozen=True, eq=False)
class Solution(Generic[State]):
    """Where the iteration ended: the state, its residuals (unweighted) and the (p, p) triangular factor of the Jacobian."""

    state: State
    residuals: Float[np.ndarray, " n"]
    factor: Float[np.ndarray, "p p"]
    n_iterations: int


def minimise(
    linearise: Callable[[State], tuple[np.ndarray, np.ndarray]],
    retract: Callable[[State, np.ndarray], State],
    start: State,
    weights: Float[np.ndarray, " n"] | None = None,
) -> Solution[State]:
    """Minimise ``sum(weights * residuals**2)`` over a state with p local parameters.

    Parameters
    ----------
    linearise : state -> residuals (n,), Jacobian (n, p) with respect to the local parameters at the state; data and
        parameters of the order of 1 (centred and scaled)
    retract : state, step (p,) -> state
    start : State
    weights : (n,), of the squared residuals, >= 0

    Raises
    ------
    GeometryError
        If the Jacobian has no full rank at the end (the observations do not determine the parameters), or the iteration does
        not settle.
    """
    root = None if weights is None else np.sqrt(weights)

    def factorise(state: State) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
        residuals, jacobian = linearise(state)
        stacked = np.column_stack([jacobian, residuals])
        if root is not None:
            stacked *= root[:, None]
        triangle = triangular_factor(stacked)
        p = jacobian.shape[1]
        weighted = stacked[:, -1]
        return residuals, float(weighted @ weighted), triangle[:p, :p], triangle[:p, p]

    state = start
    residuals, cost, factor, projected = factorise(state)
    damping = 1e-6
    n_iterations, settled = 0, False
    while n_iterations < MAX_ITERATIONS and not settled:
        n_iterations += 1
        p = len(projected)
        lengths = np.maximum(np.linalg.norm(factor, axis=0), 1e-12)
        while True:
            damped = np.vstack([factor, np.diag(np.sqrt(damping) * lengths)])
            step = -np.linalg.lstsq(damped, np.concatenate([projected, np.zeros(p)]), rcond=None)[0]
            remaining = factor @ step + projected
            predicted = float(projected @ projected - remaining @ remaining)
            candidate = retract(state, step)
            new_residuals, new_cost, new_factor, new_projected = factorise(candidate)
            if np.isfinite(new_cost) and new_cost < cost:
                settled = float(np.linalg.norm(step)) < 1e-14 or predicted < 1e-14 * cost
                damping = max(damping / 10, 1e-15)
                state, residuals, cost = candidate, new_residuals, new_cost
                factor, projected = new_factor, new_projected
                break
            if predicted < 1e-14 * cost or float(np.linalg.norm(step)) < 1e-9 or damping > 1e12:
                settled = True
                break
            damping *= 10
    singular = np.linalg.svd(factor, compute_uv=False)
    if not (np.all(np.isfinite(singular)) and singular[-1] * MAX_CONDITION > singular[0]):
        raise GeometryError("The points do not determine the parameters.")
    if not settled:
        raise GeometryError(
            f"The fit did not settle in {MAX_ITERATIONS} iterations, so the points hardly determine the parameters."
        )
    return Solution(state, residuals, factor, n_iterations)


def triangular_factor(matrix: Float[np.ndarray, "n p"]) -> Float[np.ndarray, "k p"]:
    """R of the orthogonal factorisation of a tall matrix (k = min(n, p) rows, up to their signs).

    Blocks of rows are factorised one by one, then their factors together [3]_: small, cache-sized steps, and for a million
    rows no second copy of the matrix.
    """
    n, p = matrix.shape
    rows = max(BLOCK_ROWS, 4 * p)
    while n > 2 * rows:
        whole = n - n % rows
        factors = np.asarray(np.linalg.qr(matrix[:whole].reshape(-1, rows, p), mode="r")).reshape(-1, p)
        matrix = np.vstack([factors, matrix[whole:]])
        n = len(matrix)
    return np.asarray(np.linalg.qr(matrix, mode="r"))


def covariance(factor: Float[np.ndarray, "p p"], variance: float) -> Float[np.ndarray, "p p"]:
    """``variance * inv(J^T J)`` from the triangular factor of J, by its singular values."""
    _, singular, right = np.linalg.svd(factor)
    scaled = right / singular[:, None]
    return variance * (scaled.T @ scaled)


def variance_of_unit_weight(
    residuals: Float[np.ndarray, " n"], weights: Float[np.ndarray, " n"] | None, n_parameters: int
) -> float:
    """Sum of the weighted squared residuals over the degrees of freedom; NaN if there are none.

    Points of weight 0 do not count.
    """
    n = len(residuals) if weights is None else int(np.count_nonzero(weights))
    total = float(residuals @ residuals) if weights is None else float(weights @ residuals**2)
    return total / (n - n_parameters) if n > n_parameters else float("nan")
