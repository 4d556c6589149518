"""The iteration of the joint estimate: residuals, robust weights, one linear problem, a step; and the noise learnt on the way."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from rotaline.calibration.joint.data import JointData, PlateFrame, TableFrame
from rotaline.calibration.joint.linear import (
    Effects,
    FrameResiduals,
    Setting,
    board_pivot,
    is_stripe,
    linearise,
    press_all,
    prior_rows,
    row_weights,
    weighted,
    with_priors,
)
from rotaline.calibration.joint.noise import (
    KEPT,
    Noise,
    frame_factor,
    robust_scale,
    robust_weights,
    slow_variance,
    update_variances,
)
from rotaline.calibration.joint.print_errors import (
    PrintModel,
    PrintView,
    print_model,
    solve_with_print_errors,
)
from rotaline.calibration.joint.rows import plate_pivot
from rotaline.calibration.joint.solve import Eliminated, Solution, Triangle, eliminate, solve
from rotaline.calibration.joint.state import Layout, State
from rotaline.geometry.correlation import correlation_length

MAX_ITERATIONS = 30


_MAX_VARIANCE_ROUNDS = 6


_SETTLED = 0.02
"""Last step of all global parameters together, in their standard deviations."""


_STEP_LIMITS = {"plane": (0.1, 0.1, 20.0), "axis": (0.1, 0.1, 5.0, 5.0)}


@dataclass(frozen=True, eq=False)
class Iterated:
    """The end of an iteration: residuals and triangles belong to ``state``, the solution is what they say about it."""

    layout: Layout
    state: State
    noise: Noise
    solution: Solution
    eliminated: Eliminated
    triangles: tuple[Triangle, ...]
    frames: tuple[FrameResiduals, ...]
    effects: "Effects"
    prints: dict[int, PrintView]
    model: PrintModel | None
    band_mm: float
    n_iterations: int
    converged: bool


def iterate(
    setting: Setting,
    layout: Layout,
    state: State,
    noise: Noise,
    band_mm: float,
    effects: Effects | None = None,
    prints: dict[int, PrintView] | None = None,
    rough: bool = False,
) -> Iterated:
    """Steps until they no longer matter.

    Parameters
    ----------
    setting : Setting
    layout : which global parameters are estimated
    state, noise : where to start
    band_mm : how far from its surface a stripe point on an artefact may be at first
    effects : errors of frames and points, if they are known from before; then all points are used from the start
    prints : for the frames that show a target with errors of its points: which
    rough : every fourth point of the stripes, and an end as soon as the steps are as small as the uncertainties
    """
    prints = prints or {}
    noise = replace(noise, angle_excess=setting.data.angle_excess_rad)
    thin = 4 if rough else 1
    n_iterations, settled, steady = 0, False, False
    while n_iterations < MAX_ITERATIONS:
        n_iterations += 1
        frames = linearise(setting, state, noise, band_mm, effects, prints, thin)
        if effects is not None:
            noise = _learn(setting.data, noise, frames, effects.n_fitted, with_correlation=thin == 1)
            frames = tuple(weighted(f.rows, f.raw, f.cleaned, noise, f.mount) for f in frames)
        triangles = press_all(setting, layout, state, noise, frames)
        known, steady = effects is not None, False
        for _ in range(_MAX_VARIANCE_ROUNDS):
            eliminated = eliminate(triangles, layout)
            solution, effects, _ = solve_all(setting, layout, state, noise, frames, triangles, eliminated, prints)
            if not known:  # the scales are not learnt yet: they would swallow the errors of the frames
                break
            last, noise = noise, _learn_variances(setting.data, noise, solution)
            steady = bool(np.all(np.abs(np.log(np.maximum(noise.table, 1e-8) / np.maximum(last.table, 1e-8))) < 0.1))
            if steady:
                break
            triangles = with_priors(setting, noise, triangles)
        size = float(np.linalg.norm(solution.factor @ solution.step))
        settled = bool(size < _SETTLED * np.sqrt(max(layout.size, 1)))
        state = _step(setting, layout, state, solution)
        if setting.data.mount_frames:
            band_mm = max(0.5 * band_mm, 15.0 * _spread_mm(frames))
        if (settled and steady) or (rough and n_iterations > 2 and size < 0.5 * np.sqrt(layout.size)):
            break
    frames = linearise(setting, state, noise, band_mm, effects, prints, thin)
    triangles = press_all(setting, layout, state, noise, frames, final=True)
    eliminated = eliminate(triangles, layout)
    solution, effects, model = solve_all(
        setting, layout, state, noise, frames, triangles, eliminated, prints, final=True
    )
    return Iterated(
        layout,
        state,
        noise,
        solution,
        eliminated,
        triangles,
        frames,
        effects,
        prints,
        model,
        band_mm,
        n_iterations,
        settled and steady,
    )


def solve_all(
    setting: Setting,
    layout: Layout,
    state: State,
    noise: Noise,
    frames: Sequence[FrameResiduals],
    triangles: Sequence[Triangle],
    eliminated: Eliminated,
    prints: dict[int, PrintView],
    final: bool = False,
) -> tuple[Solution, Effects, PrintModel | None]:
    """The linear problem, with the errors of the targets' points where there are any."""
    data = setting.data
    prior = prior_rows(setting, layout, state)
    n_points = sum(len(t.points_board()) for t in data.targets)
    if not prints:
        solution = solve(eliminated, prior)
        n_fitted = _count_fitted(setting, noise, frames, solution, None)
        return solution, Effects(solution.own_steps, np.zeros((n_points, 2)), n_fitted), None
    weights = row_weights(setting, noise, frames, final)
    model = print_model(eliminated, triangles, layout, prior, [f.rows for f in frames], weights, prints, data.targets)
    solution, offsets = solve_with_print_errors(model, eliminated, noise.print_mm)
    return solution, Effects(solution.own_steps, offsets, _count_fitted(setting, noise, frames, solution, model)), model


def _count_fitted(
    setting: Setting,
    noise: Noise,
    frames: Sequence[FrameResiduals],
    solution: Solution,
    model: PrintModel | None,
) -> Float[np.ndarray, " g"]:
    """Parameters that the residuals of each group have been fitted with: of frames, and of the points of targets."""
    data = setting.data
    stripes = is_stripe(data)
    fitted = np.zeros(len(data.groups))
    for k, (frame, variances) in enumerate(zip(frames, solution.own_variances, strict=True)):
        if not len(frame.rows.group):
            continue
        prior = noise.local_prior(len(variances), k - len(data.plates))
        shares = np.clip(1.0 - variances * prior**2, 0.0, 1.0)
        fitted[frame.rows.group[0]] += float(shares[:6].sum())
        fitted[frame.rows.group[-1]] += float(shares[6:].sum())
    if model is not None:
        shared = model.strengths * noise.print_mm[model.owners] ** 2
        for t in np.unique(model.owners):
            of_points = float(np.sum((shared / (1.0 + shared))[model.owners == t]))
            counts = np.zeros(len(data.groups))
            shown: list[PlateFrame | TableFrame] = [*data.plates, *data.tables]
            for f in shown:
                if f.points.target == t:
                    counts[f.points.group] += len(f.points.numbers)
            fitted += of_points * counts / max(counts.sum(), 1.0)
    values = np.bincount(np.concatenate([f.rows.group for f in frames]), minlength=len(fitted))
    everywhere = len(solution.step) * values / max(values.sum(), 1) * ~stripes
    return np.asarray(fitted + everywhere)


def _step(setting: Setting, layout: Layout, state: State, solution: Solution) -> State:
    """The state after a step, which is shortened where it would leave the range in which the linear problem means something."""
    factor = 1.0
    for name, limits in _STEP_LIMITS.items():
        if name in layout:
            largest = np.max(np.abs(solution.step[layout.of(name)]) / np.array(limits))
            factor = min(factor, 1.0 / max(largest, 1.0))
    data = setting.data
    plate_steps = {
        k: (factor * solution.own_steps[k][:6], plate_pivot(state, data.plates[k], pose))
        for k, pose in enumerate(state.plates)
    }
    pivots = [board_pivot(data, b) for b in range(data.n_boards)]
    return state.after(layout, factor * solution.step, setting.camera_names, plate_steps, pivots, data.artifact_groups)


def _learn(
    data: JointData,
    noise: Noise,
    frames: Sequence[FrameResiduals],
    n_fitted: Float[np.ndarray, " g"],
    with_correlation: bool,
) -> Noise:
    """Scales of the groups and correlations along the stripes from the residuals."""
    freedom = noise.freedom.copy() if len(noise.freedom) else np.ones(len(data.groups))
    scale, correlation = noise.scale.copy(), noise.correlation.copy()
    factors = noise.frame.copy() if len(noise.frame) else np.ones(len(frames))
    for g, info in enumerate(data.groups):
        values, pieces, n_pieces = [], [], 0
        for frame in frames:
            mine = frame.rows.group == g
            if not mine.any():
                continue
            values.append(frame.cleaned[mine] / frame.rows.u[mine])
            pieces.append(frame.rows.piece[mine] + n_pieces)
            n_pieces = int(pieces[-1].max()) + 1
        if not values:
            continue
        together = np.concatenate(values)
        freedom[g] = np.sqrt(len(together) / max(len(together) - n_fitted[g], 0.25 * len(together)))
        scale[g] = max(robust_scale(together) * freedom[g], 1e-6)
        if with_correlation and info.kind in ("plate-stripe", "artifact"):
            mine_frames = [f for f, frame in enumerate(frames) if np.any(frame.rows.group == g)]
            slow = [slow_variance(v / scale[g], p) for v, p in zip(values, pieces, strict=True)]
            usual = float(np.nanmedian(slow)) if np.isfinite(slow).any() else 0.0
            for f, variance in zip(mine_frames, slow, strict=True):
                factors[f] = frame_factor(float(factors[f]), variance, usual)
            kept = robust_weights(together / scale[g]) > KEPT
            correlation[g] = correlation_length(together, np.concatenate(pieces), kept)
    return replace(noise, scale=scale, correlation=correlation, frame=factors, freedom=freedom)


def _learn_variances(data: JointData, noise: Noise, solution: Solution) -> Noise:
    """Standard deviations of the errors of table and plates from what was found in each frame."""
    first = len(data.plates)
    table = [(s, v) for s, v in zip(solution.own_steps[first:], solution.own_variances[first:], strict=True)]
    plates = [
        (s[6:], v[6:])
        for s, v in zip(solution.own_steps[:first], solution.own_variances[:first], strict=True)
        if len(s) > 6
    ]
    return update_variances(
        noise,
        np.array([s for s, _ in table]).reshape(-1, 6),
        np.array([v for _, v in table]).reshape(-1, 6),
        np.array([s for s, _ in plates]).reshape(-1, 3),
        np.array([v for _, v in plates]).reshape(-1, 3),
    )


def _spread_mm(frames: Sequence[FrameResiduals]) -> float:
    """Robust standard deviation of the distances of points on artefacts from their surfaces."""
    distances = [f.mount.distances_mm for f in frames if f.mount is not None]
    return robust_scale(np.concatenate(distances)) if distances else 0.0
