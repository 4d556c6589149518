"""How a measured value depends on the points of its fits, and the scatter uncertainty that follows.

A fit minimises ``sum r_i^2`` of signed distances r_i with the Jacobian J by its parameters. If the points move by ``dX_i``, the
distances change by ``dr_i = n_i . dX_i`` and the parameters by ``-inv(J^T J) J^T dr``, that is ``-inv(R) Q^T dr`` with
``J = Q R``: the normal equations are never formed. A value with the gradient g by the parameters therefore changes by ``Q a . dr``
with ``a = -inv(R^T) g``; ``Q a`` are its responses to the points.

The same responses tell how the scatter of the points carries over. Points of one frame share errors (speckle along the
stripe, an angle that was misread, a spindle that was off), so the frames are what repeats independently [1]_: with
``s_f = sum_{i in f} responses_i r_i`` the variance of the value is ``sum_f s_f^2``. A fit draws itself towards its points and
leaves too small residuals, the more so the more of it hangs on one frame; ``inv(I - Q_f^T Q_f)`` undoes this. Then s_f is the
change of the value if the frame f is left out, and the sum is that of the jackknife [2]_.

References
----------
.. [1] Liang and Zeger, Longitudinal data analysis using generalized linear models, Biometrika 73 (1986) 13
.. [2] Bell and McCaffrey, Bias reduction in standard errors for linear regression with multi-stage samples, Survey Methodology 28
   (2002) 169
.. [3] Newey and West, A simple, positive semi-definite, heteroskedasticity and autocorrelation consistent covariance matrix,
   Econometrica 55 (1987) 703
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import solve_triangular

from rotaline.geometry.fitting import across
from rotaline.geometry.primitives import Cylinder, Plane, Sphere
from rotaline.metrology.scene import Scene
from rotaline.metrology.surface_fit import Surface, SurfaceFit

MIN_FRAMES = 8
"""With fewer frames on the feature, neighbours on the surface count as well."""

N_NEIGHBOURS = 3
"""Frames over which errors may be alike, where they are."""

MAX_SHARE = 0.95
"""Largest part of a parameter that one frame alone may determine without being lost in the correction."""


@dataclass(frozen=True, eq=False)
class FittedPoints:
    """The points of a fit, linearised.

    Attributes
    ----------
    used : (m,)   indices into ``scene.points``
    normals : (m, 3)   gradients of the signed distances by the points
    residuals : (m,)   signed distances, mm
    noise : (m,)   standard deviation of each point with the inflation for neighbours that are alike, mm
    basis : (m, p)   Q of the Jacobian of the distances by the parameters
    factor : (p, p)   its R
    """

    used: Int[np.ndarray, " m"]
    normals: Float[np.ndarray, "m 3"]
    residuals: Float[np.ndarray, " m"]
    noise: Float[np.ndarray, " m"]
    basis: Float[np.ndarray, "m p"]
    factor: Float[np.ndarray, "p p"]

    def coefficients(self, gradient: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """How a value with this gradient by the parameters is put together from the columns of the basis."""
        return -np.asarray(solve_triangular(self.factor, gradient, trans="T"))


def linearise(scene: Scene, fit: SurfaceFit) -> FittedPoints:
    """The points of one surface.

    Parameters, in this order: sphere: centre (3), radius; cylinder: axis point towards e1 and e2 (mm, at the foot of the
    centroid), direction towards e1 and e2 (rad), radius, with ``e1, e2 = across(direction)``; plane: shift along the normal
    (mm, at the centroid), normal towards e1 and e2 (rad), with ``e1, e2 = across(normal)``.
    """
    points = scene.points[fit.used]
    normals = outward(fit.surface, points)
    ones = np.ones(len(points))
    if isinstance(fit.surface, Sphere):
        jacobian = np.column_stack([-normals, -ones])
    elif isinstance(fit.surface, Cylinder):
        axis = fit.surface.axis
        sides = normals @ np.column_stack(across(axis.direction))
        along = (points - points.mean(axis=0)) @ axis.direction
        jacobian = np.column_stack([-sides, -along[:, None] * sides, -ones])
    else:
        e1, e2 = across(fit.surface.normal)
        relative = points - points.mean(axis=0)
        jacobian = np.column_stack([-ones, relative @ e1, relative @ e2])
    basis, factor = np.linalg.qr(jacobian)
    return FittedPoints(fit.used, normals, fit.residuals, fit.inflation * fit.rms * ones, basis, factor)


def linearise_parallel(scene: Scene, fits: tuple[SurfaceFit, ...], normal: Float[np.ndarray, "3"]) -> FittedPoints:
    """The points of k planes fitted with one normal.

    Parameters: shift of each plane along the normal (mm, at its centroid), normal towards e1 and e2 (rad), with
    ``e1, e2 = across(normal)``.
    """
    e1, e2 = across(normal)
    groups = [scene.points[fit.used] for fit in fits]
    relative = np.vstack([points - points.mean(axis=0) for points in groups])
    sizes = [len(points) for points in groups]
    own = -np.repeat(np.eye(len(fits)), sizes, axis=0)
    basis, factor = np.linalg.qr(np.column_stack([own, relative @ e1, relative @ e2]))
    return FittedPoints(
        np.concatenate([fit.used for fit in fits]),
        np.tile(normal, (len(relative), 1)),
        relative @ normal,
        np.repeat([fit.inflation * fit.rms for fit in fits], sizes),
        basis,
        factor,
    )


def outward(surface: Surface, points: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3"]:
    """Gradient of the signed distance at each point: unit vectors away from the axis, the centre, or along the normal."""
    if isinstance(surface, Plane):
        return np.tile(surface.normal, (len(points), 1))
    if isinstance(surface, Sphere):
        away = points - surface.centre
    else:
        relative = points - surface.axis.point
        away = relative - (relative @ surface.axis.direction)[:, None] * surface.axis.direction
    return away / np.linalg.norm(away, axis=1)[:, None]


@dataclass(frozen=True, eq=False)
class Dependence:
    """What the values of a feature owe to its points.

    Attributes
    ----------
    used : (m,)   indices into ``scene.points``, those of one fit after those of another
    normals : (m, 3)   gradients of the signed distances
    responses : (m,) each, by key of the value
    u_scatter : standard uncertainty by key, mm
    """

    used: Int[np.ndarray, " m"]
    normals: Float[np.ndarray, "m 3"]
    responses: dict[str, Float[np.ndarray, " m"]]
    u_scatter: dict[str, float]


def depend(
    scene: Scene,
    fits: tuple[FittedPoints, ...],
    gradients: dict[str, tuple[Float[np.ndarray, " _"] | None, ...]],
) -> Dependence:
    """Responses and scatter uncertainty of values.

    Parameters
    ----------
    scene : Scene   with its frames, if they are known
    fits : what the values come from
    gradients : by key, the gradient by the parameters of each of the fits; None: the value does not depend on it
    """
    responses, u_scatter = {}, {}
    scores = None if scene.frame is None else _frame_scores(fits, frames_in_order(scene))
    for key, by_fit in gradients.items():
        weights = [
            np.zeros(fit.basis.shape[1]) if gradient is None else fit.coefficients(gradient)
            for fit, gradient in zip(fits, by_fit, strict=True)
        ]
        parts = [fit.basis @ a for fit, a in zip(fits, weights, strict=True)]
        responses[key] = np.concatenate(parts)
        patches = sum(float(np.sum((r * fit.noise) ** 2)) for fit, r in zip(fits, parts, strict=True))
        if scores is None:
            variance = patches
        else:
            each = sum((s @ a for s, a in zip(scores, weights, strict=True)), np.zeros(len(scores[0])))
            variance = max(_independent_variance(fits, parts), frame_variance(each))
            if np.count_nonzero(each) < MIN_FRAMES:
                variance = max(variance, patches)
        u_scatter[key] = float(np.sqrt(variance))
    return Dependence(
        np.concatenate([fit.used for fit in fits]), np.vstack([fit.normals for fit in fits]), responses, u_scatter
    )


def frame_variance(scores: Float[np.ndarray, " f"]) -> float:
    """Variance of the sum of what each frame, in the order of the turn, adds to a value.

    Frames repeat independently unless the data show otherwise: where neighbours are more alike than chance explains
    (correlation above 2 / sqrt(n), with n counted as if all frames had equal weight), their products count too, with
    falling weights over ``N_NEIGHBOURS`` frames [3]_. These are left out otherwise, because they make the estimate
    scatter and, since the residuals of a fit add up to zero, also too small.
    """
    squares = float(scores @ scores)
    if not squares > 0:
        return 0.0
    n_equal = 3.0 * squares**2 / float(np.sum(scores**4))
    if float(scores @ np.roll(scores, 1)) < 2.0 / np.sqrt(n_equal) * squares:
        return squares
    lags = np.arange(1, min(N_NEIGHBOURS, len(scores) - 1) + 1)
    products = np.array([scores @ np.roll(scores, lag) for lag in lags])
    return max(squares, squares + 2.0 * float((1.0 - lags / (len(lags) + 1.0)) @ products))


def frames_in_order(scene: Scene) -> Int[np.ndarray, " n"]:
    """For each point the place of its frame in the order of the turn, from 0.

    The viewpoints of the frames lie on a circle, and so the order is that about their middle; without viewpoints it is that
    of the frames' indices.
    """
    assert scene.frame is not None
    _, first, place = np.unique(scene.frame, return_index=True, return_inverse=True)
    if scene.viewpoints is None:
        return place
    eyes = scene.viewpoints[first]
    eyes = eyes - eyes.mean(axis=0)
    rank = np.argsort(np.argsort(np.arctan2(eyes[:, 1], eyes[:, 0]), kind="stable"), kind="stable")
    return rank[place]


def _frame_scores(fits: tuple[FittedPoints, ...], place: Int[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "f _"], ...]:
    """For each fit, (f, p): what each frame adds to ``Q^T r``, corrected for the frame's own pull on the fit [2]_.

    This is how much ``Q^T x`` of the fit's parameters changes when the frame is left out.
    """
    n_frames = int(place.max()) + 1
    corrected = []
    for fit in fits:
        frame, p = place[fit.used], fit.basis.shape[1]
        sums, pull = np.empty((n_frames, p)), np.empty((n_frames, p, p))
        for i in range(p):
            sums[:, i] = np.bincount(frame, fit.basis[:, i] * fit.residuals, n_frames)
            for j in range(p):
                pull[:, i, j] = np.bincount(frame, fit.basis[:, i] * fit.basis[:, j], n_frames)
        share, axes = np.linalg.eigh(pull)
        grown = 1.0 / (1.0 - np.minimum(share, MAX_SHARE))
        corrected.append(np.einsum("fij,fj,fkj,fk->fi", axes, grown, axes, sums))
    return tuple(corrected)


def _independent_variance(fits: tuple[FittedPoints, ...], parts: list[Float[np.ndarray, " _"]]) -> float:
    """Variance of a value if no two points shared an error, each as far off as its residual."""
    each = [
        float(np.sum((r * fit.residuals) ** 2)) * len(r) / max(1, len(r) - fit.basis.shape[1])
        for fit, r in zip(fits, parts, strict=True)
    ]
    return sum(each)
