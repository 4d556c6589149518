"""The linear problem of one iteration: frames pressed into triangles, their own parameters eliminated, one small system left.

Everything is done by orthogonal factors; normal equations, which square the condition number, are never formed.

References
----------
.. [1] Björck, Numerical Methods for Least Squares Problems, 1996, sections 6.3 and 9.3
.. [2] Golub, Pereyra, Inverse Problems 19 (2003) R1
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rotaline.calibration.joint.rows import Rows
from rotaline.calibration.joint.state import Layout
from rotaline.calibration.reprojection import covariance_from_factor, upper_factor
from rotaline.geometry.least_squares import triangular_factor


@dataclass(frozen=True, eq=False)
class Triangle:
    """One frame: weighted rows pressed together.

    ``local`` (k, l), ``common`` by groups (k, .), ``rhs`` (k,): residuals. ``motions`` (6, .) by groups of global parameters that move the frame
    like its own first six. ``prior`` (l,): one over the standard deviation of each local parameter, 0 for none.
    """

    local: Float[np.ndarray, "k l"]
    common: dict[str, Float[np.ndarray, "_ _"]]
    motions: dict[str, Float[np.ndarray, "6 _"]]
    rhs: Float[np.ndarray, " k"]
    prior: Float[np.ndarray, " l"]

    def globals(self, layout: Layout) -> Float[np.ndarray, "k p"]:
        """Derivatives by the global parameters."""
        out = np.zeros((len(self.rhs), layout.size))
        for name, columns in self.common.items():
            if name in layout:
                out[:, layout.of(name)] += columns
        for name, motion in self.motions.items():
            if name in layout:
                out[:, layout.of(name)] += self.local[:, :6] @ motion
        return out


def press(
    rows: Rows,
    weights: Float[np.ndarray, " n"],
    motions: dict[str, Float[np.ndarray, "6 _"]],
    prior: Float[np.ndarray, " l"],
) -> Triangle:
    """The triangle of a frame's rows; ``weights`` are square roots of weights, rows of weight 0 do not count."""
    names = list(rows.common)
    used = weights > 0
    w = weights[used, None]
    stacked = np.hstack([rows.local[used], *(rows.common[n][used] for n in names), rows.residuals[used, None]]) * w
    factor = np.asarray(np.linalg.qr(stacked, mode="r")) if len(stacked) > stacked.shape[1] else stacked
    n_local = rows.local.shape[1]
    at, common = n_local, {}
    for name in names:
        k = rows.common[name].shape[1]
        common[name] = factor[:, at : at + k]
        at += k
    return Triangle(factor[:, :n_local], common, motions, factor[:, -1], prior)


@dataclass(frozen=True, eq=False)
class Eliminated:
    """Frames without their own parameters.

    ``own[f]`` (l, l + p + 1) are the rows that fix the own parameters of frame f; ``rests[f]`` (k, p + 1) what is left for the global ones and the
    residuals.
    """

    own: tuple[Float[np.ndarray, "_ _"], ...]
    rests: tuple[Float[np.ndarray, "_ _"], ...]


def eliminate(triangles: Sequence[Triangle], layout: Layout) -> Eliminated:
    """Eliminate each frame's own parameters; frames with equally many of them at once."""
    own: list[np.ndarray] = [np.zeros((0, 0))] * len(triangles)
    rests: list[np.ndarray] = [np.zeros((0, 0))] * len(triangles)
    sizes = {t.local.shape[1] for t in triangles}
    for n_local in sizes:
        members = [f for f, t in enumerate(triangles) if t.local.shape[1] == n_local]
        n_rows = n_local + max(len(triangles[f].rhs) for f in members)
        n_columns = n_local + layout.size + 1
        stack = np.zeros((len(members), max(n_rows, n_local + 1), n_columns))
        for i, f in enumerate(members):
            t = triangles[f]
            k = len(t.rhs)
            stack[i, range(n_local), range(n_local)] = t.prior
            stack[i, n_local : n_local + k, :n_local] = t.local
            stack[i, n_local : n_local + k, n_local:-1] = t.globals(layout)
            stack[i, n_local : n_local + k, -1] = t.rhs
        factors = np.asarray(np.linalg.qr(stack, mode="r"))
        for i, f in enumerate(members):
            own[f] = factors[i, :n_local]
            rests[f] = factors[i, n_local:, n_local:]
    return Eliminated(tuple(own), tuple(rests))


@dataclass(frozen=True, eq=False)
class Solution:
    """The step of all parameters.

    Attributes
    ----------
    step : (p,)
    factor : (p, p)   R of the global parameters: their covariance is (R^T R)^-1
    covariance : (p, p)
    own_steps, own_variances : of each frame's own parameters, (l,)
    squares : weighted sum of squares that is left
    """

    step: Float[np.ndarray, " p"]
    factor: Float[np.ndarray, "p p"]
    covariance: Float[np.ndarray, "p p"]
    own_steps: tuple[Float[np.ndarray, " _"], ...]
    own_variances: tuple[Float[np.ndarray, " _"], ...]
    squares: float


def global_factor(
    rests: Sequence[Float[np.ndarray, "_ _"]], prior: Float[np.ndarray, "m c"]
) -> Float[np.ndarray, "c c"]:
    """R of all rows for the global parameters and the residuals together."""
    stacked = np.vstack([*rests, prior])
    return upper_factor(triangular_factor(stacked)) if len(stacked) > 2 * stacked.shape[1] else upper_factor(stacked)


def solve_factor(factor: Float[np.ndarray, "c c"]) -> Float[np.ndarray, " p"]:
    """The parameters of least squares from R of parameters and residuals; what nothing determines stays where it is."""
    r, rhs = factor[:-1, :-1], factor[:-1, -1]
    lengths = np.linalg.norm(r, axis=0)
    lengths = np.where(lengths > 0, lengths, 1.0)
    return -np.asarray(np.linalg.lstsq(r / lengths, rhs, rcond=1e-13)[0]) / lengths


def solve(eliminated: Eliminated, prior: Float[np.ndarray, "m c"]) -> Solution:
    """Solve for the global parameters, then for each frame's own.

    Parameters
    ----------
    eliminated : Eliminated
    prior : (m, p + 1)   further rows for the global parameters: what is known of them beforehand
    """
    factor = global_factor(eliminated.rests, prior)
    step = solve_factor(factor)
    cov = covariance_from_factor(factor[:-1, :-1], 1.0)
    own_steps, own_variances = back_substitute(eliminated.own, step, cov)
    return Solution(step, factor[:-1, :-1], cov, own_steps, own_variances, float(factor[-1, -1] ** 2))


def back_substitute(
    own: Sequence[Float[np.ndarray, "_ _"]], step: Float[np.ndarray, " p"], covariance: Float[np.ndarray, "p p"]
) -> tuple[tuple[Float[np.ndarray, " _"], ...], tuple[Float[np.ndarray, " _"], ...]]:
    """Each frame's own parameters and their variances, from the global ones; frames with equally many of them at once."""
    steps: list[np.ndarray] = [np.zeros(0)] * len(own)
    variances: list[np.ndarray] = [np.zeros(0)] * len(own)
    for n in {len(rows) for rows in own}:
        members = [f for f, rows in enumerate(own) if len(rows) == n]
        stack = np.array([own[f] for f in members])
        inverse = np.linalg.inv(stack[:, :, :n])
        coupling = inverse @ stack[:, :, n:-1]
        of_members = -(inverse @ stack[:, :, -1:])[:, :, 0] - coupling @ step
        known = np.sum(inverse**2, axis=2) + np.sum((coupling @ covariance) * coupling, axis=2)
        for f, found, variance in zip(members, of_members, known, strict=True):
            steps[f], variances[f] = found, variance
    return tuple(steps), tuple(variances)
