"""The iteration of the joint estimate: residuals, robust weights, one linear problem, a step; and the noise learnt on the way."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from rotaline.calibration.joint.data import JointData, PlateFrame, TableFrame
from rotaline.calibration.joint.line_width import SHARE_UNKNOWN
from rotaline.calibration.joint.noise import (
    KEPT,
    Noise,
    correlation_length,
    frame_factor,
    information_factor,
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
from rotaline.calibration.joint.rows import MountPoints, Rows, mount_rows, plate_pivot, plate_rows, table_rows
from rotaline.calibration.joint.solve import Eliminated, Solution, Triangle, eliminate, press, solve
from rotaline.calibration.joint.state import Layout, State, once_per_turn, table_motions
from rotaline.calibration.joint.surfaces import sizes_of
from rotaline.calibration.lens_prior import lens_prior
from rotaline.geometry.primitives import Artifact

MAX_ITERATIONS = 30
_CHUNK = 24
"""Frames of a mount whose rows are held at a time."""
_MAX_VARIANCE_ROUNDS = 6
_SETTLED = 0.02
"""Last step of all global parameters together, in their standard deviations."""
VAGUE = {"angle": 1.0, "run-out": 1e2, "wobble": 1.0, "curvature": 1.0, "pitch": 1.0, "bend": 1e2, "sizes": 1e2}
"""Standard uncertainties (rad, mm, rad, 1/mm, 1, mm, mm) beforehand that say nothing, but keep the problem solvable where the data say nothing either."""
_STEP_LIMITS = {"plane": (0.1, 0.1, 20.0), "axis": (0.1, 0.1, 5.0, 5.0)}


@dataclass(frozen=True, eq=False)
class Setting:
    """What stays the same during the iteration.

    ``artifacts`` of each mount, as stated; ``line_variance`` (mm^2) from the widths of the stripes; ``small_errors``: standard deviations of groups
    of parameters that are random effects.
    """

    data: JointData
    camera_names: tuple[str, ...]
    artifacts: tuple[Artifact, ...]
    image_size: tuple[int, int]
    line_variance: float = 0.0
    small_errors: Mapping[str, float] = field(default_factory=dict)

    def artifact_of(self, group: int) -> Artifact:
        """The artefact whose sizes have this number."""
        return self.artifacts[self.data.artifact_groups.index(group)]


@dataclass(frozen=True, eq=False)
class FrameResiduals:
    """Residuals of one frame: px, standardised by scale and stated uncertainty, robust weights, groups; errors of the frame itself taken off."""

    raw: Float[np.ndarray, " n"]
    cleaned: Float[np.ndarray, " n"]
    standardised: Float[np.ndarray, " n"]
    weight: Float[np.ndarray, " n"]
    rows: Rows
    mount: MountPoints | None = None


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


@dataclass(frozen=True, eq=False)
class Effects:
    """Errors that belong to single frames and to single points of targets, as found in the last iteration.

    ``own``: each frame's own parameters; ``offsets`` (k, 2): of all points of all targets, one target after another, mm; ``n_fitted`` (g,): how many
    parameters the residuals of each group have been fitted with, those that are known beforehand by the part that they are not.
    """

    own: tuple[Float[np.ndarray, " _"], ...]
    offsets: Float[np.ndarray, "k 2"]
    n_fitted: Float[np.ndarray, " g"]


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
    thin = 4 if rough else 1
    n_iterations, settled, steady = 0, False, False
    while n_iterations < MAX_ITERATIONS:
        n_iterations += 1
        frames = linearise(setting, state, noise, band_mm, effects, prints, thin)
        if effects is not None:
            noise = _learn(setting.data, noise, frames, effects.n_fitted, with_correlation=thin == 1)
            frames = tuple(_weighted(f.rows, f.raw, f.cleaned, noise, f.mount) for f in frames)
        triangles = _press_all(setting, layout, state, noise, frames)
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
            triangles = _with_priors(setting, noise, triangles)
        size = float(np.linalg.norm(solution.factor @ solution.step))
        settled = bool(size < _SETTLED * np.sqrt(max(layout.size, 1)))
        state = _step(setting, layout, state, solution)
        if setting.data.mount_frames:
            band_mm = max(0.5 * band_mm, 15.0 * _spread_mm(frames))
        if (settled and steady) or (rough and n_iterations > 2 and size < 0.5 * np.sqrt(layout.size)):
            break
    frames = linearise(setting, state, noise, band_mm, effects, prints, thin)
    triangles = _press_all(setting, layout, state, noise, frames, final=True)
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
    stripes = _is_stripe(data)
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


def linearise(
    setting: Setting,
    state: State,
    noise: Noise,
    band_mm: float,
    effects: Effects | None,
    prints: dict[int, PrintView],
    thin: int,
) -> tuple[FrameResiduals, ...]:
    """Residuals and derivatives of all frames: plates, then targets on the table, then mounts."""
    data, names = setting.data, setting.camera_names
    frames: list[FrameResiduals] = []
    starts = np.concatenate([[0], np.cumsum([len(t.points_board()) for t in data.targets])])

    def add(rows: Rows, mount: MountPoints | None = None) -> None:
        if len(noise.frame) and noise.frame[len(frames)] > 1.0:
            factor = np.where(_is_stripe(data)[rows.group], noise.frame[len(frames)], 1.0)
            rows = replace(rows, u=rows.u * factor)
        cleaned = rows.residuals
        if effects is not None:
            mine = effects.own[len(frames)]
            on_table = len(frames) >= len(data.plates)
            random = slice(0, None) if on_table else slice(6, None)
            cleaned = rows.residuals + rows.local[:, random] @ mine[random]
            view = prints.get(len(frames))
            if view is not None and rows.place is not None:
                offsets = effects.offsets[starts[view.target] + view.numbers] @ view.turn.T
                cleaned[: 2 * len(offsets)] += np.einsum("nij,nj->ni", rows.place, offsets).ravel()
        frames.append(_weighted(rows, rows.residuals, cleaned, noise, mount))

    for frame, pose in zip(data.plates, state.plates, strict=True):
        add(plate_rows(state, frame, pose, data, names))
    for table_frame in data.tables:
        add(table_rows(state, table_frame, names))
    for mount in range(len(data.mount_names)):
        mine = [f for f in data.mount_frames if f.mount == mount]
        for first, last in pairwise([*range(0, len(mine), _CHUNK), len(mine)]):
            chunk = [replace(f, stripe=f.stripe.thinned(thin)) for f in mine[first:last]]
            for rows, points in mount_rows(state, chunk, data, names, band_mm):
                add(rows, points)
    return tuple(frames)


def _weighted(
    rows: Rows,
    raw: Float[np.ndarray, " n"],
    cleaned: Float[np.ndarray, " n"],
    noise: Noise,
    mount: MountPoints | None,
) -> FrameResiduals:
    """Both coordinates of a target point share a weight."""
    standardised = cleaned / (noise.scale[rows.group] * rows.u)
    n = int(rows.point[-1]) + 1 if len(rows.point) else 0
    counts = np.bincount(rows.point, minlength=n)
    size = np.sqrt(np.bincount(rows.point, weights=standardised**2, minlength=n) / np.maximum(counts, 1))
    return FrameResiduals(raw, cleaned, standardised, robust_weights(size)[rows.point], rows, mount)


def _press_all(
    setting: Setting,
    layout: Layout,
    state: State,
    noise: Noise,
    frames: Sequence[FrameResiduals],
    final: bool = False,
) -> tuple[Triangle, ...]:
    """Triangles of all frames; ``final``: weighted by what the robust estimate knows, for the covariance."""
    data = setting.data
    triangles = []
    for k, (frame, weights) in enumerate(zip(frames, row_weights(setting, noise, frames, final), strict=True)):
        on_table = k >= len(data.plates)
        prior = noise.local_prior(frame.rows.local.shape[1], k - len(data.plates))
        triangles.append(press(frame.rows, weights, frame_motions(data, layout, state, k) if on_table else {}, prior))
    return tuple(triangles)


def _with_priors(setting: Setting, noise: Noise, triangles: Sequence[Triangle]) -> tuple[Triangle, ...]:
    """The same rows with other variances of the frames' own errors."""
    first = len(setting.data.plates)
    return tuple(replace(t, prior=noise.local_prior(t.local.shape[1], k - first)) for k, t in enumerate(triangles))


def row_weights(
    setting: Setting, noise: Noise, frames: Sequence[FrameResiduals], final: bool
) -> tuple[Float[np.ndarray, " _"], ...]:
    """Square roots of the weights of all rows of each frame.

    ``final``: outliers left out, the others all with what the robust estimate knows of a residual, for the covariance.
    """
    factors = np.ones(len(setting.data.groups))
    if final:
        for g in range(len(factors)):
            mine = [f.standardised[f.rows.group == g] for f in frames]
            freedom = noise.freedom[g] if len(noise.freedom) else 1.0
            factors[g] = information_factor(np.concatenate(mine) * freedom)
    out = []
    for frame in frames:
        rows = frame.rows
        base = 1.0 / (noise.scale[rows.group] * rows.u * np.sqrt(noise.correlation[rows.group]))
        out.append(
            np.where(frame.weight > KEPT, base * factors[rows.group], 0.0) if final else base * np.sqrt(frame.weight)
        )
    return tuple(out)


def frame_motions(data: JointData, layout: Layout, state: State, k: int) -> dict[str, Float[np.ndarray, "6 _"]]:
    """How the global parameters move frame k, which stands on the table."""
    j = k - len(data.plates)
    if j < len(data.tables):
        frame = data.tables[j]
        pivot = state.boards[frame.board].apply(board_pivot(data, frame.board)[None])[0]
        return table_motions(state, frame.angle_rad, layout, f"board:{frame.board}", pivot)
    mount_frame = data.mount_frames[j - len(data.tables)]
    return table_motions(
        state, mount_frame.angle_rad, layout, f"mount:{mount_frame.mount}", state.mount_pivot(mount_frame.mount)
    )


def board_pivot(data: JointData, board: int) -> Float[np.ndarray, "3"]:
    """The point of a board about which its pose on the table is counted, in its own frame, mm."""
    target = next(data.targets[f.points.target] for f in data.tables if f.board == board)
    columns, rows = target.grid_size
    return np.array([columns - 1, rows - 1, 0.0]) * target.pitch / 2


def prior_rows(setting: Setting, layout: Layout, state: State) -> Float[np.ndarray, "m c"]:
    """What is known beforehand, as rows for the global parameters: what lenses look like, and the stated sizes of artefacts."""
    rows = []
    lens = lens_prior(setting.camera_names, setting.image_size, state.camera, 1.0)
    values = np.array([getattr(state.camera, name) for name in setting.camera_names])
    for row, value in zip(lens.rows, lens.values, strict=True):
        full = np.zeros(layout.size + 1)
        full[layout.of("camera")] = row
        full[-1] = row @ values - value
        rows.append(full)
    for name, _ in layout.slots:
        kind, _, number = name.partition(":")
        place = layout.of(name)
        n = place.stop - place.start
        if kind == "sizes" and setting.artifact_of(int(number)).tolerance > 0:
            stated = setting.artifact_of(int(number))
            sigma = stated.tolerance / np.sqrt(3.0)
            off = sizes_of(state.artifacts[setting.data.artifact_groups.index(int(number))]) - sizes_of(stated)
        elif kind == "line":
            sigma = SHARE_UNKNOWN * setting.line_variance
            off = np.array([state.line_variance - setting.line_variance])
        elif kind in setting.small_errors:
            sigma, off = setting.small_errors[kind], once_per_turn(state, kind)
        elif kind in VAGUE:
            sigma, off = VAGUE[kind], np.zeros(n)
        else:
            continue
        block = np.zeros((n, layout.size + 1))
        block[:, place] = np.eye(n) / sigma
        block[:, -1] = off / sigma
        rows += list(block)
    return np.array(rows).reshape(-1, layout.size + 1)


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


def _is_stripe(data: JointData) -> Bool[np.ndarray, " g"]:
    """Which groups are stripes."""
    return np.array([g.kind in ("plate-stripe", "artifact") for g in data.groups])


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
