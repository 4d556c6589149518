"""The minimisations that put feature points onto ideal circles, and what the residuals say about the axis.

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, section 4.2, eq. (14)
.. [2] Huber, Robust Statistics, 1981, section 6.3 (covariance of M-estimates)
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from rotaline.calibration.feature_circles import N_AXIS, CircleModel
from rotaline.geometry.robust import CAUCHY, mad_scale

Method = Literal["sqp", "least-squares"]

_BLOCK = 96


@dataclass(frozen=True, eq=False)
class AxisMinimum:
    """Course and end of one optimisation.

    Attributes
    ----------
    before, after : (p,)   unknowns of the model: the start axis with the poses that suit it best, and the optimum
    history_mm : (k,)   mean distance before the first and after each iteration
    converged : bool
    """

    before: Float[np.ndarray, " p"]
    after: Float[np.ndarray, " p"]
    history_mm: Float[np.ndarray, " k"]
    converged: bool

    @property
    def n_iterations(self) -> int:
        """Number of iterations."""
        return len(self.history_mm) - 1


def minimise_axis(
    model: CircleModel, start: Float[np.ndarray, " p"], method: Method, tolerance: float, max_iterations: int
) -> AxisMinimum:
    """Optimise the axis and the poses of all mounts.

    Parameters
    ----------
    model : CircleModel
    start : (p,)   the unknowns: start axis, coarse poses
    method : ``sqp`` (mean distance, eq. (14) of [1]_) or ``least-squares``
    tolerance : float   the SQP stops when the mean distance changes by less, mm
    max_iterations : int
    """
    if method == "sqp":
        before = _pose_of_least_mean_distance(model, start)
        after, history, converged = _minimise_mean_distance(model, before, tolerance, max_iterations)
    else:
        before = _minimise_squares(model, start, max_iterations, first_free=N_AXIS)[0]
        after, history, converged = _minimise_squares(model, before, max_iterations, first_free=0)
    return AxisMinimum(before, after, np.array(history), converged)


def _minimise_mean_distance(
    model: CircleModel, start: Float[np.ndarray, " p"], tolerance: float, max_iterations: int
) -> tuple[Float[np.ndarray, " p"], list[float], bool]:
    """SQP on eq. (14) over the six changes of Pa and Pb; the cylinders' poses are fitted anew for each axis.

    At the best poses the objective does not change with them to first order, so its gradient is the one at fixed poses.
    """
    poses = start

    def objective(axis_changes: Float[np.ndarray, "6"]) -> tuple[float, Float[np.ndarray, "6"]]:
        nonlocal poses
        poses = _pose_of_least_mean_distance(model, np.concatenate([axis_changes, poses[N_AXIS:]]))
        value, slope = model.mean_distance_with_slope(poses)
        return value, slope[:N_AXIS]

    history = [objective(start[:N_AXIS])[0]]
    result = minimize(
        objective,
        start[:N_AXIS],
        jac=True,
        method="SLSQP",
        callback=lambda intermediate_result: history.append(float(intermediate_result.fun)),
        options={"ftol": tolerance, "maxiter": max_iterations},
    )
    # mode 8: no step lowers the objective any more, which is the end of what floating point allows at a kink
    converged = bool(result.success) or (result.status == 8 and result.fun <= history[0])
    return _pose_of_least_mean_distance(model, np.concatenate([result.x, poses[N_AXIS:]])), history, converged


def _pose_of_least_mean_distance(model: CircleModel, unknowns: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
    """Fine alignment: the poses that make the mean distance least while the axis stays.

    Least squares with the weights 1 / distance, repeated until they settle (Weiszfeld's iteration).
    """
    best = unknowns.copy()
    turned = model.turned(unknowns)
    for _ in range(60):
        residuals, slopes = model.pose_residuals_with_slopes(turned, best)
        distance = np.linalg.norm(residuals, axis=1)
        typical = float(np.median(distance))
        root = np.repeat(1.0 / np.sqrt(np.maximum(distance, 1e-3 * typical + 1e-9)), 2)
        system = slopes.reshape(root.size, -1) * root[:, None]
        step = solve_in_blocks(system, -root * residuals.ravel())
        best[N_AXIS:] += step
        if np.abs(step).max() <= 1e-3 * typical + 1e-12:
            break
    return best


def _minimise_squares(
    model: CircleModel, start: Float[np.ndarray, " p"], max_iterations: int, first_free: int
) -> tuple[Float[np.ndarray, " p"], list[float], bool]:
    """Gauss-Newton on the radial and axial distances, with Cauchy weights; the unknowns before ``first_free`` stay.

    The weights come in when the plain squares have settled; each step solves the linear problem by orthogonal factorisation
    and takes the shortest solution, which leaves the idle sliding of Pa and Pb at rest.
    """
    unknowns = start.copy()
    history = [model.mean_distance_with_slope(unknowns)[0]]
    scale = np.inf
    for _ in range(max_iterations):
        residuals, slopes = model.residuals_with_slopes(unknowns)
        root = 1.0 / np.sqrt(1.0 + (residuals / scale) ** 2).ravel()
        system = slopes.reshape(root.size, -1)[:, first_free:] * root[:, None]
        step = solve_in_blocks(system, -root * residuals.ravel())
        unknowns[first_free:] += step
        history.append(model.mean_distance_with_slope(unknowns)[0])
        size = float(np.abs(step).max())
        if np.isinf(scale) and size < 1e-3:
            scale = _cauchy_scale(model.residuals(unknowns))
        elif size < 1e-8:
            return unknowns, history, True
    return unknowns, history, False


def solve_in_blocks(system: Float[np.ndarray, "n q"], right: Float[np.ndarray, " n"]) -> Float[np.ndarray, " q"]:
    """Shortest least-squares solution, by orthogonal factorisation.

    The rows are factorised in blocks, then the factors: blocks this small are not worth a second core, and calls that ask
    for one are slow where other processes use it.
    """
    q = system.shape[1]
    rows = np.column_stack([system, right])
    padded = np.vstack([rows, np.zeros((-len(rows) % _BLOCK, q + 1))])
    blocks = np.asarray(np.linalg.qr(np.asarray(padded.reshape(-1, _BLOCK, q + 1)), mode="r"))
    triangle = np.asarray(np.linalg.qr(blocks.reshape(-1, q + 1), mode="r"))
    return np.asarray(np.linalg.lstsq(triangle[:q, :q], triangle[:q, q], rcond=1e-12)[0])


def _cauchy_scale(residuals: Float[np.ndarray, "n 2"]) -> float:
    """Where the Cauchy weights fall to a half, mm; never so small that rounding errors count as residuals."""
    return max(CAUCHY * mad_scale(residuals.ravel()), 1e-9)


def axis_uncertainty(model: CircleModel, unknowns: Float[np.ndarray, " p"], method: Method) -> tuple[float, float]:
    """Larger standard uncertainties of direction (rad) and of position at mid height (mm), from the residuals.

    The sandwich of an M-estimator [2]_: slopes of the estimating equations outside, their scatter inside. The scatter is summed
    frame by frame, because the four points of a frame share the error of its angle and of the table's run-out.
    """
    residuals, slopes = model.residuals_with_slopes(unknowns)
    free = np.r_[0:2, 3:5, N_AXIS : model.n_unknowns]  # without the sliding of Pa and Pb along the axis
    slopes = slopes[:, :, free]
    if method == "sqp":
        distance = np.linalg.norm(residuals, axis=1)
        soft = np.sqrt(distance**2 + (0.1 * np.median(distance)) ** 2) + 1e-15
        pull = residuals / soft[:, None]
        stiffness = (np.eye(2) - pull[:, :, None] * pull[:, None, :]) / soft[:, None, None]
    else:
        scale = _cauchy_scale(residuals)
        weight = 1.0 / (1.0 + (residuals / scale) ** 2)
        pull = weight * residuals
        stiffness = np.eye(2) * (weight**2 * (1 - (residuals / scale) ** 2))[:, :, None]
    outside = np.einsum("nap,nab,nbq->pq", slopes, stiffness, slopes)
    frames, index = np.unique(model.frame, return_inverse=True)
    sums = np.zeros((len(frames), len(free)))
    np.add.at(sums, index, np.einsum("nap,na->np", slopes, pull))
    few = len(frames) / max(len(frames) - 1, 1) * residuals.size / max(residuals.size - len(free), 1)
    inverse = np.linalg.pinv(outside, hermitian=True)
    cov = (few * inverse @ (sums.T @ sums) @ inverse)[:4, :4]

    middle = float(np.median(model.points[:, 2])) / model.lever
    at_middle = np.hstack([np.eye(2) * (1 - middle), np.eye(2) * middle])
    slope = np.hstack([-np.eye(2), np.eye(2)]) / model.lever
    u_position = float(np.sqrt(max(np.linalg.eigvalsh(at_middle @ cov @ at_middle.T).max(), 0.0)))
    u_direction = float(np.sqrt(max(np.linalg.eigvalsh(slope @ cov @ slope.T).max(), 0.0)))
    return u_direction, u_position
