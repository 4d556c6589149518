"""Which changes explain what the stripes on the mounts show, if the calibrated steps do not.

All explanations are compared about one linearised state (:mod:`rotaline.calibration.verdict.steps_fit`): laser plane and axis are where
the steps before put them, within their covariance, the artefact has its stated sizes, and one explanation after the other is let in,
that which makes the residuals smaller by most first, as long as it is significant against their scatter and large enough to matter.

References
----------
.. [1] Schwarz, Annals of Statistics 6 (1978) 461 (price of a parameter)
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import special

from rotaline.calibration.verdict.steps_fit import LEVER_MM, SIZES, FittedSteps
from rotaline.geometry.primitives import Line, Plane, SteppedCylinder
from rotaline.geometry.transforms import base_from_axis

_CHANCE = 1e-7
"""How often a clean session may seem to need an explanation."""


@dataclass(frozen=True, eq=False)
class Explanation:
    """A change that some columns of the state make: ``columns`` (p, k), mm of the state for a unit of each unknown."""

    name: str
    columns: Float[np.ndarray, "p k"]


@dataclass(frozen=True, eq=False)
class Explained:
    """What was found.

    Attributes
    ----------
    values, covariances : of the unknowns of each explanation that is needed, by name
    alone : how far the residuals fall (chi-square) if each needed explanation is left out, by name
    state, cov_state : (p,), (p, p)   with what is needed
    chi2_dof : of what remains
    """

    values: Mapping[str, Float[np.ndarray, " k"]]
    covariances: Mapping[str, Float[np.ndarray, "k k"]]
    alone: Mapping[str, float]
    state: Float[np.ndarray, " p"]
    cov_state: Float[np.ndarray, "p p"]
    chi2_dof: float


@dataclass(frozen=True, eq=False)
class Expected:
    """What the steps before say: covariance of plane and axis in the coordinates of the state (mm), nominal sizes and their tolerance."""

    cov_plane: Float[np.ndarray, "3 3"]
    cov_axis: Float[np.ndarray, "4 4"]
    nominal_sizes: Float[np.ndarray, "3"]
    tolerance: float


def explain(
    fitted: FittedSteps,
    expected: Expected,
    candidates: Mapping[str, Explanation],
    least_mm: Mapping[str, float],
) -> Explained:
    """Let in one explanation after the other.

    Parameters
    ----------
    fitted : FittedSteps
    expected : Expected
    candidates : by name
    least_mm : length of the vector of unknowns from which an explanation matters, by name
    """
    problem = _Problem(fitted, expected)
    chosen: list[str] = []
    price = np.log(len(fitted.residuals_mm))
    now = problem.solve([])
    while len(chosen) < len(candidates):
        best: tuple[float, str] | None = None
        for name, candidate in candidates.items():
            if name in chosen:
                continue
            k = candidate.columns.shape[1]
            trial = problem.solve([candidates[c] for c in chosen] + [candidate])
            gain = now.chi2 - trial.chi2
            if special.chdtrc(k, max(gain, 0.0)) > _CHANCE or np.linalg.norm(trial.values[-k:]) < least_mm[name]:
                continue
            if best is None or gain - k * price > best[0]:
                best = gain - k * price, name
        if best is None:
            break
        chosen.append(best[1])
        now = problem.solve([candidates[c] for c in chosen])
    # an early choice may be idle once the right ones are in
    for name in list(chosen):
        rest = [c for c in chosen if c != name]
        without = problem.solve([candidates[c] for c in rest])
        if special.chdtrc(candidates[name].columns.shape[1], max(without.chi2 - now.chi2, 0.0)) > _CHANCE:
            chosen, now = rest, without
    return problem.result(chosen, candidates, now)


def tried(
    fitted: FittedSteps, expected: Expected, candidates: Mapping[str, Explanation], explained: Explained, name: str
) -> tuple[float, float]:
    """First unknown of an explanation if it is let in beside those that are needed, and its standard uncertainty, mm."""
    others = [candidates[c] for c in explained.values if c != name]
    problem = _Problem(fitted, expected)
    solution = problem.solve([candidates[name], *others])
    return float(solution.values[problem.n_own]), float(np.sqrt(solution.cov[problem.n_own, problem.n_own]))


@dataclass(frozen=True, eq=False)
class _Solution:
    values: Float[np.ndarray, " m"]
    cov: Float[np.ndarray, "m m"]
    chi2: float


class _Problem:
    """Compressed least squares; unknowns: poses, plane, axis, sizes, then those of the explanations."""

    def __init__(self, fitted: FittedSteps, expected: Expected) -> None:
        p = len(fitted.state)
        scale = np.sqrt(fitted.weights / fitted.clusters) / fitted.sigma_mm
        rows = np.column_stack(
            [scale[:, None] * fitted.jacobian, scale * (fitted.residuals_mm - fitted.jacobian @ fitted.state)]
        )
        factor = np.asarray(np.linalg.qr(rows, mode="r"))
        self._jacobian, self._offset = factor[:, :p], factor[:, p]
        own = [*range(fitted.poses.start, fitted.poses.stop), *range(7), *range(SIZES.start, SIZES.stop)]
        self._own = np.eye(p)[:, own]
        n_pose = fitted.poses.stop - fitted.poses.start
        prior = np.zeros((10, len(own)))
        prior[:3, n_pose : n_pose + 3] = _whitener(expected.cov_plane)
        prior[3:7, n_pose + 3 : n_pose + 7] = _whitener(expected.cov_axis)
        prior[7:, n_pose + 7 :] = np.eye(3) / max(expected.tolerance, 1e-4)
        self._prior = prior
        self._nominal = np.concatenate([np.zeros(7), expected.nominal_sizes / max(expected.tolerance, 1e-4)])
        self._dof = max(len(fitted.residuals_mm) - len(own), 1)
        self.n_own = len(own)

    def solve(self, explanations: list[Explanation]) -> _Solution:
        columns = np.column_stack([self._own, *(e.columns for e in explanations)])
        extra = columns.shape[1] - self.n_own
        rows = np.vstack([self._jacobian @ columns, np.hstack([self._prior, np.zeros((10, extra))])])
        right = np.concatenate([-self._offset, self._nominal])
        scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-12)
        u, singular, vt = np.linalg.svd(rows / scale, full_matrices=False)
        inverse = vt.T / np.maximum(singular, 1e-10 * singular[0])
        values = inverse @ (u.T @ right) / scale
        return _Solution(
            values, inverse @ inverse.T / np.outer(scale, scale), float(np.sum((rows @ values - right) ** 2))
        )

    def result(self, chosen: list[str], candidates: Mapping[str, Explanation], now: _Solution) -> Explained:
        values, covariances, alone, first = {}, {}, {}, self.n_own
        for name in chosen:
            k = candidates[name].columns.shape[1]
            values[name] = now.values[first : first + k]
            covariances[name] = now.cov[first : first + k, first : first + k]
            rest = self.solve([candidates[c] for c in chosen if c != name])
            alone[name] = rest.chi2 - now.chi2
            first += k
        columns = np.column_stack([self._own, *(candidates[c].columns for c in chosen)])
        return Explained(
            values, covariances, alone, columns @ now.values, columns @ now.cov @ columns.T, now.chi2 / self._dof
        )


def _whitener(cov: Float[np.ndarray, "k k"]) -> Float[np.ndarray, "k k"]:
    return np.asarray(np.linalg.inv(np.linalg.cholesky(cov + 1e-12 * np.eye(len(cov)))))


# the explanations that there are ------------------------------------------------------------------------------------


def columns_of(fitted: FittedSteps, where: slice) -> Float[np.ndarray, "p k"]:
    """The unknowns of the state themselves."""
    return np.asarray(np.eye(len(fitted.state))[:, where])


def plane_scaled(fitted: FittedSteps, plane: Plane, unit_mm: float) -> Float[np.ndarray, "p 1"]:
    """The laser plane nearer or farther by a factor; an unknown of 1 mm is the factor that changes ``unit_mm`` by 1 mm."""
    column = np.zeros((len(fitted.state), 1))
    column[2, 0] = -plane.offset / unit_mm
    return column


def axis_scaled(fitted: FittedSteps, axis: Line, unit_mm: float) -> Float[np.ndarray, "p 1"]:
    """The rotation axis nearer or farther by a factor."""
    across = base_from_axis(Line(fitted.pivot_camera, axis.direction)).rotation.as_matrix()[:2]
    column = np.zeros((len(fitted.state), 1))
    column[3:5, 0] = across @ fitted.pivot_camera / unit_mm
    return column


def sizes_scaled(fitted: FittedSteps, artifact: SteppedCylinder) -> Float[np.ndarray, "p 1"]:
    """All sizes of the artefact by one factor; the unknown is the change of the large diameter."""
    column = np.zeros((len(fitted.state), 1))
    radii = np.array([artifact.diameter_small / 2, artifact.diameter_large / 2, artifact.height_small])
    column[SIZES, 0] = radii / artifact.diameter_large
    return column


def camera_moved(fitted: FittedSteps, plane: Plane, axis: Line) -> Float[np.ndarray, "p 6"]:
    """Plane and axis moved together against the camera: shift (mm), turn (rad times ``LEVER_MM``) about the pivot."""
    base = base_from_axis(Line(fitted.pivot_camera, axis.direction)).rotation.as_matrix()
    across = np.linalg.svd(plane.normal[None])[2][1:]
    columns = np.zeros((len(fitted.state), 6))
    for k in range(3):
        e = np.eye(3)[k]
        columns[2, k] = plane.normal @ e
        columns[3:5, k] = base[:2] @ e
        columns[0:2, 3 + k] = across @ np.cross(e, plane.normal)
        columns[5:7, 3 + k] = base[:2] @ np.cross(e, axis.direction)
    return columns


def expected_from(
    plane: Plane,
    axis: Line,
    pivot: Float[np.ndarray, "3"],
    points_camera: Float[np.ndarray, "n 3"],
    u_normal_rad: tuple[float, float],
    u_offset_mm: float,
    u_axis: tuple[float, float],
    floor_mm: float,
) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "4 4"]]:
    """Covariance of plane and axis in the state's coordinates.

    Parameters
    ----------
    plane, axis, pivot : about which the state is
    points_camera : of the stripes on the plates
    u_normal_rad, u_offset_mm : of the plane, larger turn first: about the direction along which the points extend most
    u_axis : direction (rad) and position (mm)
    floor_mm : common errors that these do not hold: those of the camera
    """
    centre = points_camera.mean(axis=0)
    cov_points = np.cov((points_camera - centre).T)
    flat = np.eye(3) - np.outer(plane.normal, plane.normal)
    vectors = np.linalg.eigh(flat @ cov_points @ flat)[1]
    most, least = vectors[:, 2], vectors[:, 1]
    across = np.linalg.svd(plane.normal[None])[2][1:]
    arm = pivot - centre
    columns = []
    for direction, u in ((least, u_normal_rad[0]), (most, u_normal_rad[1])):
        columns.append(u * np.array([*(LEVER_MM * across @ direction), -(direction @ arm)]))
    columns.append(np.array([0.0, 0.0, u_offset_mm]))
    root = np.array(columns).T
    cov_plane = root @ root.T + floor_mm**2 * np.eye(3)
    u_direction, u_position = u_axis
    turn, shift = (
        (LEVER_MM * u_direction) ** 2 + floor_mm**2,
        u_position**2 + (LEVER_MM * u_direction) ** 2 + floor_mm**2,
    )
    return cov_plane, np.diag([shift, shift, turn, turn])
