"""Targets whose points are not where they should be, within the joint estimate.

The offsets go with the target, so all its views share them and more views of the same target do not average them out. They are random effects, drawn
from a normal distribution whose variance comes from the residuals, as in :mod:`rotaline.calibration.print_offsets` (see the references there); here the
frames' own motions, their errors on the table and all that frames share are eliminated together with them.

A symmetric target looks the same after half a turn, and which point is which is a convention of each image. Where the offsets are large enough to
matter they tell: the residuals of two views are alike in one order and not in the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy import linalg, optimize, special

from rotaline.calibration.joint.rows import Rows
from rotaline.calibration.joint.solve import Eliminated, Solution, Triangle, back_substitute, global_factor
from rotaline.calibration.joint.state import Layout
from rotaline.calibration.reprojection import covariance_from_factor
from rotaline.vision.targets.model import Target
from rotaline.vision.targets.ordering import symmetry_permutations

_CHANCE = 1e-4
_SIGMA_RANGE_MM = (1e-5, 1.0)
MIN_VIEWS = 3


@dataclass(frozen=True, eq=False)
class PrintView:
    """Which offsets the target points of one frame have.

    ``numbers`` (n,) are those of the offsets; ``turn`` (2, 2) turns them into the frame's own board frame.
    """

    target: int
    numbers: Int[np.ndarray, " n"]
    turn: Float[np.ndarray, "2 2"]


@dataclass(frozen=True, eq=False)
class PrintModel:
    """The linear problem with offsets: see ``rotaline.calibration.print_offsets``; ``owners`` (l,) is the target of each offset."""

    factor: Float[np.ndarray, "q q"]
    projected: Float[np.ndarray, " q"]
    rest: float
    axes: Float[np.ndarray, "k 2 2"]
    strengths: Float[np.ndarray, " l"]
    by_offset: Float[np.ndarray, "l q"]
    scores: Float[np.ndarray, " l"]
    owners: Int[np.ndarray, " l"]
    members: tuple[int, ...]
    spans: tuple[slice, ...]


def print_views(
    targets: Sequence[Target],
    numbers: Sequence[tuple[int, Int[np.ndarray, "_"]] | None],
    rows: Sequence[Rows],
    together: Sequence[int],
) -> dict[int, PrintView]:
    """Which offsets belong to which points, with the order of symmetric targets settled by the residuals.

    Parameters
    ----------
    targets : of the estimate
    numbers : for each frame its target and the numbers of its points; None for frames without target points
    rows : residuals of each frame
    together : for each frame a label; frames of one label have the same order (those on the table)
    """
    views: dict[int, PrintView] = {}
    for t, target in enumerate(targets):
        mine = [f for f, n in enumerate(numbers) if n is not None and n[0] == t]
        if len(mine) < MIN_VIEWS:
            continue
        symmetries = [(p, _turn_of(target, p)) for p in symmetry_permutations(target)]
        fields = {}
        for f in mine:
            place = rows[f].place
            entry = numbers[f]
            assert place is not None
            assert entry is not None
            field = np.full((len(target.points_board()), 2), np.nan)
            residuals = rows[f].residuals[: 2 * len(place)].reshape(-1, 2)
            field[entry[1]] = -np.linalg.solve(place, residuals[:, :, None])[:, :, 0]
            fields[f] = field - np.nanmedian(field, axis=0)
        labels = sorted({together[f] for f in mine})
        chosen = dict.fromkeys(labels, 0)
        if len(symmetries) > 1:
            chosen = _settle({label: [fields[f] for f in mine if together[f] == label] for label in labels}, symmetries)
        for f in mine:
            permutation, turn = symmetries[chosen[together[f]]]
            entry = numbers[f]
            assert entry is not None
            views[f] = PrintView(t, permutation[entry[1]], turn.T)
    return views


def _turn_of(target: Target, permutation: Int[np.ndarray, " n"]) -> Float[np.ndarray, "2 2"]:
    """The turn of the board that carries each point to the one whose number it gets."""
    places = target.points_board()[:, :2]
    centred = places - places.mean(axis=0)
    return np.round(np.linalg.lstsq(centred, centred[permutation], rcond=None)[0].T, 6)


def _settle(
    fields: dict[int, list[Float[np.ndarray, "n 2"]]],
    symmetries: Sequence[tuple[Int[np.ndarray, " _"], Float[np.ndarray, "2 2"]]],
) -> dict[int, int]:
    """For each label the symmetry that makes its residuals most alike to those of the others."""

    def moved(field: Float[np.ndarray, "n 2"], k: int) -> Float[np.ndarray, "n 2"]:
        permutation, turn = symmetries[k]
        out = np.full_like(field, np.nan)
        out[permutation] = field @ turn.T
        return out

    clipped = {}
    for label, several in fields.items():
        together = np.array(several)
        scale = 4.0 * np.nanmedian(np.abs(together))
        counts = np.sum(np.isfinite(together), axis=0)
        clipped[label] = np.where(counts > 0, np.nansum(np.clip(together, -scale, scale), axis=0), np.nan)
    order = sorted(clipped, key=lambda label: -len(fields[label]))
    chosen = {order[0]: 0}
    for sweep in range(3):
        for label in order[1:] if sweep == 0 else order:
            others = [moved(clipped[o], chosen[o]) for o in chosen if o != label]
            if not others:
                continue
            mean = np.nansum(others, axis=0)
            scores = [float(np.nansum(moved(clipped[label], k) * mean)) for k in range(len(symmetries))]
            chosen[label] = int(np.argmax(scores))
    return chosen


def print_model(
    eliminated: Eliminated,
    triangles: Sequence[Triangle],
    layout: Layout,
    prior: Float[np.ndarray, "m c"],
    rows: Sequence[Rows],
    weights: Sequence[Float[np.ndarray, " _"]],
    views: dict[int, PrintView],
    targets: Sequence[Target],
) -> PrintModel:
    """The linear problem with an offset of every point of the targets that are in ``views``."""
    members = tuple(sorted(views))
    spans, at = [], 0
    for f in members:
        n_local = len(eliminated.own[f])
        spans.append(slice(at, at + n_local))
        at += n_local
    q = at + layout.size
    factor, projected = np.zeros((q, q)), np.zeros(q)
    for f, span in zip(members, spans, strict=True):
        own = eliminated.own[f]
        n_local = len(own)
        factor[span, span], factor[span, at:], projected[span] = own[:, :n_local], own[:, n_local:-1], -own[:, -1]
    together = global_factor(eliminated.rests, prior)
    factor[at:, at:], projected[at:] = together[:-1, :-1], -together[:-1, -1]
    counts = [len(t.points_board()) for t in targets]
    starts = np.concatenate([[0], np.cumsum(counts)])
    k = int(starts[-1])
    gram, cross, scores = np.zeros((k, 2, 2)), np.zeros((k, 2, q)), np.zeros((k, 2))
    for f, span in zip(members, spans, strict=True):
        view, frame_rows = views[f], rows[f]
        assert frame_rows.place is not None
        n = len(frame_rows.place)
        w = weights[f][: 2 * n].reshape(n, 2)
        place = (frame_rows.place @ view.turn) * w[:, :, None]
        transposed = np.swapaxes(place, 1, 2)
        local = frame_rows.local[: 2 * n].reshape(n, 2, -1) * w[:, :, None]
        shared = np.zeros((n, 2, layout.size))
        for name, columns in frame_rows.common.items():
            if name in layout:
                shared[:, :, layout.of(name)] += columns[: 2 * n].reshape(n, 2, -1) * w[:, :, None]
        for name, motion in triangles[f].motions.items():
            if name not in layout:
                continue
            shared[:, :, layout.of(name)] += local[:, :, :6] @ motion
        index = starts[view.target] + view.numbers
        gram[index] += transposed @ place
        cross[index, :, span] += transposed @ local
        cross[index, :, at:] += transposed @ shared
        scores[index] -= (transposed @ (frame_rows.residuals[: 2 * n].reshape(n, 2) * w)[:, :, None])[:, :, 0]
    strengths, axes = np.linalg.eigh(gram)
    to_axes = np.swapaxes(axes, 1, 2)
    by_offset = linalg.solve_triangular(factor, (to_axes @ cross).reshape(2 * k, q).T, trans="T").T
    return PrintModel(
        factor,
        projected,
        float(together[-1, -1] ** 2),
        axes,
        np.maximum(strengths, 0.0).ravel(),
        np.ascontiguousarray(by_offset),
        (to_axes @ scores[:, :, None]).ravel(),
        np.repeat(np.repeat(np.arange(len(targets)), counts), 2),
        members,
        tuple(spans),
    )


def learn_print_errors(
    model: PrintModel, print_mm: Float[np.ndarray, " t"], candidates: Sequence[int]
) -> Float[np.ndarray, " t"]:
    """Standard deviations of the offsets of each target by restricted maximum likelihood; 0 where the views do not show any."""
    found = print_mm.copy()
    for t in candidates:

        def criterion(log_sigma: float, t: int = t) -> float:
            trial = found.copy()
            trial[t] = np.exp(log_sigma)
            return _criterion(model, trial)

        best = optimize.minimize_scalar(
            criterion, bounds=tuple(np.log(_SIGMA_RANGE_MM)), method="bounded", options={"xatol": 0.02}
        )
        without = found.copy()
        without[t] = 0.0
        shown = _criterion(model, without) - float(best.fun) > special.chdtri(1, 2 * _CHANCE)
        found[t] = float(np.exp(best.x)) if shown else 0.0
    return found


def solve_with_print_errors(
    model: PrintModel, eliminated: Eliminated, print_mm: Float[np.ndarray, " t"]
) -> tuple[Solution, Float[np.ndarray, "k 2"]]:
    """The solution with the offsets eliminated, and the offsets (mm) of all points of all targets, one target after another."""
    p = eliminated.rests[0].shape[1] - 1
    x, squares, normal, shrink = _reduced(model, print_mm)
    step = linalg.solve_triangular(model.factor, x)
    along = shrink * (model.scores - model.by_offset @ x)
    offsets = (model.axes @ along.reshape(-1, 2, 1))[:, :, 0]
    whole = np.linalg.cholesky(normal).T @ model.factor
    information = whole[-p:, -p:]
    covariance = covariance_from_factor(information, 1.0)
    own_steps, own_variances = (list(s) for s in back_substitute(eliminated.own, step[-p:], covariance))
    inverse = linalg.solve_triangular(whole, np.eye(len(whole)))
    variances = np.sum(inverse**2, axis=1)
    for f, span in zip(model.members, model.spans, strict=True):
        own_steps[f], own_variances[f] = step[span], variances[span]
    return Solution(step[-p:], information, covariance, tuple(own_steps), tuple(own_variances), squares), offsets


def _reduced(
    model: PrintModel, print_mm: Float[np.ndarray, " t"]
) -> tuple[Float[np.ndarray, " q"], float, Float[np.ndarray, "q q"], Float[np.ndarray, " l"]]:
    """The step ``x``, the squares that are left, the normal matrix of ``x`` and the shrinkage of the offsets."""
    variance = print_mm[model.owners] ** 2
    shrink = variance / (model.strengths * variance + 1.0)
    normal = np.eye(len(model.projected)) - (model.by_offset.T * shrink) @ model.by_offset
    right = model.projected - model.by_offset.T @ (shrink * model.scores)
    x = np.linalg.solve(normal, right)
    squares = model.rest + model.projected @ model.projected - shrink @ model.scores**2 - x @ right
    return x, float(squares), normal, shrink


def _criterion(model: PrintModel, print_mm: Float[np.ndarray, " t"]) -> float:
    """-2 log of the restricted likelihood, but for a constant; the variance of the noise is 1."""
    _, squares, normal, _ = _reduced(model, print_mm)
    spread = np.log1p(model.strengths * print_mm[model.owners] ** 2).sum()
    return float(squares + spread + np.linalg.slogdet(normal)[1])


def information_with_print_errors(
    model: PrintModel, print_mm: Float[np.ndarray, " t"], n_global: int
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"]]:
    """R of the global parameters with all else eliminated, and their step."""
    x, _, normal, _ = _reduced(model, print_mm)
    step = linalg.solve_triangular(model.factor, x)
    whole = np.linalg.cholesky(normal).T @ model.factor
    return whole[-n_global:, -n_global:], step[-n_global:]
