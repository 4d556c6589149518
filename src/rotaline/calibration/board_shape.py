"""Targets that are not flat: a height over the board that is quadratic in its coordinates, common to all views.

Paper on cardboard, or a print that dried, bends and twists by a tenth of a millimetre. A camera that takes such a board for
flat is wrong by more than the noise of its points (see mrcal [1]_, which estimates the shape always; here only where the
views show it).

References
----------
.. [1] Kogan, mrcal: https://mrcal.secretsauce.net/formulation.html ("board deformation")
.. [2] Hotelling, Annals of Mathematical Statistics 2 (1931) 360
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int
from scipy import special

from rotaline.calibration.reprojection import BundleFit, covariance_from_factor
from rotaline.vision.targets.model import Target, TargetDetection, bend_basis
from rotaline.vision.targets.ordering import symmetry_permutations

_CHANCE = 1e-4
"""How often views of a flat board may seem to show a bent one."""


def bend_bases(detections: Sequence[TargetDetection]) -> tuple[Float[np.ndarray, "n m"], ...]:
    """Heights (mm) at the points of each detection for unit parameters of the bend; one set of columns a target.

    The columns are those of :func:`rotaline.vision.targets.model.bend_basis`. A target that may be read from four sides
    has only the one that does not depend on the side, ``x^2 + y^2``.
    """
    targets = _targets(detections)
    columns = {
        target: bend_basis(target.grid_size, target.pitch, target.points_board()[:, :2]) @ _coefficients(target)
        for target in targets
    }
    total = sum(c.shape[1] for c in columns.values())
    bases = []
    for detection in detections:
        start = sum(columns[t].shape[1] for t in targets[: targets.index(detection.target)])
        own = columns[detection.target][detection.point_ids]
        basis = np.zeros((len(detection.point_ids), total))
        basis[:, start : start + own.shape[1]] = own
        bases.append(basis)
    return tuple(bases)


def targets_as_found(
    detections: Sequence[TargetDetection], bend: Float[np.ndarray, " m"], offsets: Float[np.ndarray, "k 2"]
) -> tuple[tuple[Target, ...], tuple[Target, ...]]:
    """The targets as they were stated, and as they were found; those that were found to be as stated are left out.

    Parameters
    ----------
    detections : of all views
    bend : parameters of :func:`bend_bases`; none: the targets are flat
    offsets : mm, of the points with the numbers of :func:`point_numbers`; none: all are where they should be
    """
    targets = _targets(detections)
    starts = _first_numbers(targets)
    found, start = [], 0
    for target in targets:
        now = target
        if len(bend):
            matrix = _coefficients(target)
            a, b, c = (matrix @ bend[start : start + matrix.shape[1]]).tolist()
            start += matrix.shape[1]
            now = replace(now, bend=(a, b, c))
        if target in starts and len(offsets):
            own = offsets[starts[target] : starts[target] + len(target.points_board())]
            now = replace(now, offsets=tuple((x, y) for x, y in own.tolist()))
        found.append(now)
    changed = [k for k, now in enumerate(found) if now != targets[k]]
    return tuple(targets[k] for k in changed), tuple(found[k] for k in changed)


def point_numbers(detections: Sequence[TargetDetection]) -> tuple[Int[np.ndarray, "_"], ...]:
    """A number for each point of all targets together, for each row of each detection.

    It is -1 for targets that may be read from more than one side: which of their points is which, views do not tell.
    """
    starts = _first_numbers(_targets(detections))
    return tuple(
        starts[d.target] + d.point_ids if d.target in starts else np.full(len(d.point_ids), -1) for d in detections
    )


def is_bend_shown(fit: BundleFit, variance_px2: float) -> bool:
    """True if the views show, each for itself, that the board is not flat.

    The bend is compared with what leaving out each view in turn (one linear step) does to it, by Hotelling's test [2]_, and with
    what the noise of the points does to it: a bend that one bad view brings in is none.

    Parameters
    ----------
    fit : BundleFit   with a bend
    variance_px2 : variance of a coordinate, px^2
    """
    n_views, m = len(fit.poses), len(fit.bend)
    if m == 0 or n_views < m + 3:
        return False
    changes = leave_one_out_changes(fit)[:, -m:]
    scatter = (n_views - 1) / n_views * changes.T @ changes
    formal = covariance_from_factor(fit.information, variance_px2)[-m:, -m:]
    by_views = fit.bend @ np.linalg.pinv(scatter) @ fit.bend * (n_views - m) / (m * (n_views - 1))
    by_noise = fit.bend @ np.linalg.pinv(formal) @ fit.bend
    return bool(by_views > special.fdtri(m, n_views - m, 1.0 - _CHANCE) and by_noise > special.chdtri(m, _CHANCE))


def leave_one_out_changes(fit: BundleFit) -> Float[np.ndarray, "v p"]:
    """What leaving out each view does to the parameters (camera, then bend), to first order."""
    normal = fit.information.T @ fit.information
    scale = np.sqrt(np.diag(normal))
    scale = np.where(scale > 0, scale, 1.0)
    return np.array(
        [
            np.linalg.lstsq((normal - block) / np.outer(scale, scale), -gradient / scale, rcond=1e-12)[0] / scale
            for block, gradient in zip(fit.blocks, fit.gradients, strict=True)
        ]
    )


def _targets(detections: Sequence[TargetDetection]) -> tuple[Target, ...]:
    return tuple(dict.fromkeys(d.target for d in detections))


def _first_numbers(targets: Sequence[Target]) -> dict[Target, int]:
    """Number of the first point of each target that can be read from one side only."""
    starts, n = {}, 0
    for target in targets:
        if len(symmetry_permutations(target)) == 1:
            starts[target] = n
            n += len(target.points_board())
    return starts


def _coefficients(target: Target) -> Float[np.ndarray, "3 m"]:
    """From the parameters of a target's bend to its three coefficients: what the points show, from any side."""
    if len(symmetry_permutations(target)) > 2:
        return np.array([[1.0], [0.0], [1.0]])
    heights = bend_basis(target.grid_size, target.pitch, target.points_board()[:, :2])
    return np.eye(3)[:, np.linalg.norm(heights, axis=0) > 1e-6]  # two rows of points show no curvature
