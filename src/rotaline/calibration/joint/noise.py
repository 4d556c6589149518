"""How large the noise is: of the observations, group by group, and of the table and the plates, frame by frame.

Nothing of it is assumed: scales come from the residuals. A frame on the table has errors of its own (angle, run-out, lift, wobble), a plate may not be
flat; these are random effects with variances from the data [1]_ [2]_, estimated together with everything else. Neighbours along a stripe err alike: a
stripe counts as many points as are independent, by the autocorrelation of its residuals.

Where the session states that the angles of some frames are less certain than those of others, by an excess ``e``
(:attr:`rotaline.calibration.joint.data.JointData.angle_excess_rad`), the error of an angle has two parts, the known one and that of all frames, ``sigma``, which is
estimated: its variance is ``sigma^2 + e^2``. Of an error with mean m and variance v (given the data), ``k m`` and ``k^2 v + (1 - k) sigma^2`` with
``k = sigma^2 / (sigma^2 + e^2)`` are the mean and the variance of the second part.

References
----------
.. [1] Harville, Journal of the American Statistical Association 72 (1977) 320
.. [2] MacKay, Neural Computation 4 (1992) 415 (section 4, the number of well-determined parameters)
"""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float, Int

TABLE_ERRORS = ("angle", "run-out", "lift", "wobble")
TABLE_CLASSES = np.array([3, 3, 0, 1, 1, 2])
"""Class (index into ``TABLE_ERRORS``) of a frame's turn about x, y, z and shift along x, y, z."""
_ANGLE = 2
CAUCHY = 4.0
"""Residuals of this many standard deviations count half: 98 % efficient for Gaussian noise, indifferent to gross outliers."""
KEPT = 0.1
"""Points with a smaller robust weight are outliers (beyond 12 standard deviations)."""
_RUN = 24
_FAR = 10.0
_MUCH = 4.0
_LEAST_SIGMA = 1e-9


@dataclass(frozen=True, eq=False)
class Noise:
    """Scales of all that is random.

    Attributes
    ----------
    scale : (g,)   standard deviation of a residual in units of its stated uncertainty (target points: px), of each group
    correlation : (g,)   how many neighbours along a stripe count as one
    table : (4,)   standard deviations of the errors of ``TABLE_ERRORS``: rad, mm, mm, rad
    plate_mm : of the surface of a plate off the plane of its points
    print_mm : (t,)   of the places of a target's points, along x and y
    freedom : (g,)   by how much the noise is larger than the residuals, because parameters have been fitted to these; empty before that is known
    table_weight : (t,)   of what is known beforehand of each frame on the table, see :func:`frame_weights`; empty before that is known
    angle_excess : (m,)   standard deviation of the known part of the angle's error of each frame on the table, rad; empty: there is none
    frame : (f,)   by how much the stripe of a frame errs more than those of the other frames of its group, >= 1; empty before that is known
    """

    scale: Float[np.ndarray, " g"]
    correlation: Float[np.ndarray, " g"]
    table: Float[np.ndarray, "4"] = field(default_factory=lambda: np.array([1e-3, 3e-2, 1e-2, 3e-4]))
    plate_mm: float = 2e-2
    print_mm: Float[np.ndarray, " t"] = field(default_factory=lambda: np.zeros(0))
    table_weight: Float[np.ndarray, " n"] = field(default_factory=lambda: np.ones(0))
    freedom: Float[np.ndarray, " h"] = field(default_factory=lambda: np.ones(0))
    frame: Float[np.ndarray, " f"] = field(default_factory=lambda: np.ones(0))
    angle_excess: Float[np.ndarray, " m"] = field(default_factory=lambda: np.zeros(0))

    def table_sigma(self, excess_rad: float | Float[np.ndarray, " f"]) -> Float[np.ndarray, "*f 6"]:
        """Standard deviation of a frame's turn about x, y, z and shift along x, y, z, with what is known of its angle."""
        sigma = np.broadcast_to(np.maximum(self.table[TABLE_CLASSES], _LEAST_SIGMA), (*np.shape(excess_rad), 6)).copy()
        sigma[..., _ANGLE] = np.hypot(sigma[..., _ANGLE], excess_rad)
        return sigma

    def local_prior(self, n_local: int, number: int) -> Float[np.ndarray, " l"]:
        """One over the standard deviation of each of a frame's own parameters; 0 where nothing is known beforehand.

        ``number`` counts the frames on the table; a negative one stands for a plate.
        """
        if number >= 0:
            weight = self.table_weight[number] if len(self.table_weight) else 1.0
            return np.sqrt(weight) / self.table_sigma(
                float(self.angle_excess[number]) if len(self.angle_excess) else 0.0
            )
        return np.concatenate([np.zeros(6), np.full(n_local - 6, 1.0 / max(self.plate_mm, _LEAST_SIGMA))])


def robust_weights(standardised: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Cauchy weights of squared residuals."""
    return 1.0 / (1.0 + (standardised / CAUCHY) ** 2)


def robust_scale(values: Float[np.ndarray, " n"]) -> float:
    """Standard deviation about zero of the middle of the values."""
    return 1.4826 * float(np.median(np.abs(values))) if len(values) else 1.0


def information_factor(standardised: Float[np.ndarray, " n"]) -> float:
    """What the robust estimate knows of a residual in units of ``1 / scale``: ``E[psi'] / sqrt(E[psi^2])``, outliers left out."""
    t = standardised[robust_weights(standardised) > KEPT]
    if len(t) < 3:
        return 1.0
    ratio = (t / CAUCHY) ** 2
    slope = float(np.mean((1.0 - ratio) / (1.0 + ratio) ** 2))
    power = float(np.mean((t / (1.0 + ratio)) ** 2))
    return slope / np.sqrt(power) if power > 0 else 1.0


def slow_variance(values: Float[np.ndarray, " n"], piece: Int[np.ndarray, " n"]) -> float:
    """Variance of standardised residuals as their means over runs of neighbours show it; 1 for independent ones, NaN for too few."""
    limited = np.clip(values, -CAUCHY, CAUCHY)
    new = np.diff(piece, prepend=piece[0] - 1) != 0
    first = np.flatnonzero(new)
    within = np.arange(len(piece)) - np.repeat(first, np.diff(np.append(first, len(piece))))
    starts = np.flatnonzero(within % _RUN == 0)
    full = np.diff(np.append(starts, len(piece))) == _RUN
    if np.count_nonzero(full) < 4:
        return float("nan")
    return float(np.mean(np.add.reduceat(limited, starts)[full] ** 2) / _RUN)


def frame_factor(before: float, variance: float, usual: float) -> float:
    """How much more a frame errs than the others: it counts only where it is beyond what the frames scatter by chance."""
    ratio = variance / usual if usual > 0 and np.isfinite(variance) else 1.0
    if before == 1.0 and ratio < _MUCH:
        return 1.0
    return float(max(before * np.sqrt(ratio), 1.0))


def update_variances(
    noise: Noise,
    table_means: Float[np.ndarray, "f 6"],
    table_variances: Float[np.ndarray, "f 6"],
    plate_means: Float[np.ndarray, "v 3"],
    plate_variances: Float[np.ndarray, "v 3"],
) -> Noise:
    """Standard deviations of the frames' own errors, from what was found in each frame and how well that is known [2]_."""
    everywhere, weights = np.ones(len(plate_means)), frame_weights(noise, table_means)
    table_means, table_variances = of_all_frames(noise, table_means, table_variances, weights)
    table = noise.table.copy()
    for c in range(len(TABLE_ERRORS)):
        mine = c == TABLE_CLASSES
        table[c] = _updated(table[c], table_means[:, mine], table_variances[:, mine], weights)
    plate = _updated(noise.plate_mm, plate_means, plate_variances, everywhere)
    return replace(noise, table=table, plate_mm=plate, table_weight=weights)


def determined(sigma: float, variances: Float[np.ndarray, "..."]) -> float:
    """How many of the frames' errors the data determine: each counts by the part that is not from the prior."""
    return float(np.sum(np.clip(1.0 - variances / max(sigma, _LEAST_SIGMA) ** 2, 0.0, 1.0)))


def of_all_frames(
    noise: Noise,
    table_means: Float[np.ndarray, "f 6"],
    table_variances: Float[np.ndarray, "f 6"],
    weights: Float[np.ndarray, " f"],
) -> tuple[Float[np.ndarray, "f 6"], Float[np.ndarray, "f 6"]]:
    """Means and variances of the part of the frames' errors that all have: without what is known of their angles."""
    if not len(noise.angle_excess):
        return table_means, table_variances
    own = max(float(noise.table[0]), _LEAST_SIGMA) ** 2
    share = own / (own + noise.angle_excess**2)
    means, variances = table_means.copy(), table_variances.copy()
    means[:, _ANGLE] *= share
    variances[:, _ANGLE] = share**2 * variances[:, _ANGLE] + (1.0 - share) * own / weights
    return means, variances


def frame_weights(noise: Noise, table_means: Float[np.ndarray, "f 6"]) -> Float[np.ndarray, " f"]:
    """How much a frame's own errors are like those of the others: robust weights of what is known of them beforehand.

    A frame whose table stood elsewhere (a wrong angle, a part that was pushed) is so given up by itself, and does not pull at the rest.
    """
    excess = noise.angle_excess if len(noise.angle_excess) else np.zeros(len(table_means))
    largest = np.max(np.abs(table_means) / noise.table_sigma(excess), axis=1, initial=0.0)
    return np.asarray(1.0 / (1.0 + (largest / _FAR) ** 2))


def _updated(
    sigma: float, means: Float[np.ndarray, "f k"], variances: Float[np.ndarray, "f k"], weights: Float[np.ndarray, " f"]
) -> float:
    """Half a step of expectation-maximisation, half one of MacKay's: the first cannot fail, the second is fast."""
    if means.size == 0:
        return sigma
    w = weights[:, None]
    expected = float(np.sum(w * (means**2 + variances)) / np.sum(w * np.ones_like(means)))
    shares = np.clip(1.0 - variances * w / max(sigma, _LEAST_SIGMA) ** 2, 0.0, 1.0)
    if float(np.sum(shares)) < 1.0:
        return sigma
    fast = float(np.sum(w * means**2)) / float(np.sum(shares))
    return float(np.sqrt(np.clip(fast, 0.1 * expected, 4.0 * expected)))
