"""The linear problem of one iteration: residuals and derivatives of all frames with their weights, and what is known beforehand."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from rotaline.calibration.joint.data import JointData
from rotaline.calibration.joint.line_width import SHARE_UNKNOWN
from rotaline.calibration.joint.noise import (
    KEPT,
    Noise,
    information_factor,
    robust_weights,
)
from rotaline.calibration.joint.print_errors import (
    PrintView,
)
from rotaline.calibration.joint.rows import MountPoints, Rows, mount_rows, plate_rows, table_rows
from rotaline.calibration.joint.solve import Triangle, press
from rotaline.calibration.joint.state import Layout, State, once_per_turn, table_motions
from rotaline.calibration.joint.surfaces import sizes_of
from rotaline.calibration.lens_prior import lens_prior
from rotaline.geometry.primitives import Artifact

VAGUE = {"angle": 1.0, "run-out": 1e2, "wobble": 1.0, "curvature": 1.0, "pitch": 1.0, "bend": 1e2, "sizes": 1e2}
"""Standard uncertainties (rad, mm, rad, 1/mm, 1, mm, mm) beforehand that say nothing, but keep the problem solvable where the data say nothing either."""


_CHUNK = 24
"""Frames of a mount whose rows are held at a time."""


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
class Effects:
    """Errors that belong to single frames and to single points of targets, as found in the last iteration.

    ``own``: each frame's own parameters; ``offsets`` (k, 2): of all points of all targets, one target after another, mm; ``n_fitted`` (g,): how many
    parameters the residuals of each group have been fitted with, those that are known beforehand by the part that they are not.
    """

    own: tuple[Float[np.ndarray, " _"], ...]
    offsets: Float[np.ndarray, "k 2"]
    n_fitted: Float[np.ndarray, " g"]


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
            factor = np.where(is_stripe(data)[rows.group], noise.frame[len(frames)], 1.0)
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
        frames.append(weighted(rows, rows.residuals, cleaned, noise, mount))

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


def weighted(
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


def press_all(
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


def with_priors(setting: Setting, noise: Noise, triangles: Sequence[Triangle]) -> tuple[Triangle, ...]:
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


def is_stripe(data: JointData) -> Bool[np.ndarray, " g"]:
    """Which groups are stripes."""
    return np.array([g.kind in ("plate-stripe", "artifact") for g in data.groups])
