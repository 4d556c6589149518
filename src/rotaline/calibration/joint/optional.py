"""Parameters that are estimated only where the data carry them: by how much they would lower the sum of squares.

The linear problem at the end of an iteration holds the columns of all of them. Adding a group to those that are estimated lowers the weighted sum of
squares by the squares of a few numbers of one more orthogonal factorisation; no iteration is needed to know that. The errors of single frames are in
the problem, so a group has to explain what these would otherwise have to.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import special

from rotaline.calibration.joint.data import JointData
from rotaline.calibration.joint.iterate import Iterated
from rotaline.calibration.joint.linear import VAGUE, Setting, prior_rows, row_weights
from rotaline.calibration.joint.model import OptionalParameters
from rotaline.calibration.joint.print_errors import information_with_print_errors, print_model
from rotaline.calibration.joint.solve import eliminate, global_factor, solve_factor
from rotaline.calibration.joint.state import Layout
from rotaline.calibration.joint.surfaces import size_names
from rotaline.calibration.reprojection import covariance_from_factor, upper_factor
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, Target

CHANCE = 1e-4
"""How often a group may be switched on where there is nothing."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """A group that could be estimated: how it is called, its slot, its values with units; ``never``: only to tell what it would be."""

    name: str
    slot: str
    keys: tuple[str, ...]
    units: tuple[str, ...]
    never: str = ""

    @property
    def of_table(self) -> bool:
        """An error of the turntable once per turn."""
        return self.slot in ("angle", "run-out", "wobble")


def candidates(data: JointData, setting: Setting) -> tuple[Candidate, ...]:
    """All groups that the session could carry."""
    out = []
    on_table = bool(data.tables or data.mount_frames)
    if on_table:
        out += [
            Candidate("angle harmonics", "angle", ("cos", "sin"), ("rad", "rad")),
            Candidate("run-out once per turn", "run-out", ("x", "y"), ("mm", "mm")),
            Candidate("wobble once per turn", "wobble", ("x", "y"), ("rad", "rad")),
        ]
    striped = {f.points.target for f in data.plates if f.stripe is not None}
    if striped or data.mount_frames:
        out.append(Candidate("sheet curvature", "curvature", ("uu", "uv", "vv"), ("1/mm",) * 3))
    for t, target in enumerate(data.targets):
        if data.mount_frames and (t in striped or t in {f.points.target for f in data.tables}):
            out.append(Candidate(f"pitch of {describe(target)}", f"pitch:{t}", ("relative",), ("1",)))
        out.append(Candidate(f"bend of {describe(target)}", f"bend:{t}", ("xx", "xy", "yy"), ("mm",) * 3))
    for group in sorted(set(data.artifact_groups)):
        artifact = setting.artifact_of(group)
        names = size_names(artifact)
        never = "" if artifact.tolerance > 0 else "the sizes are stated without a tolerance, so they are taken as exact"
        out.append(Candidate("artefact sizes", f"sizes:{group}", names, ("mm",) * len(names), never))
    return tuple(out)


def describe(target: Target) -> str:
    """A target in words."""
    columns, rows = target.grid_size
    if isinstance(target, Checkerboard):
        return f"checkerboard {columns} x {rows}"
    if isinstance(target, CharucoBoard):
        return f"ChArUco board {target.squares[0]} x {target.squares[1]}"
    return f"dots {columns} x {rows}"


@dataclass(frozen=True, eq=False)
class Assessment:
    """What adding a group would do: chi-square, the step of its parameters, their standard uncertainties."""

    candidate: Candidate
    improvement: float
    chance: float
    step: Float[np.ndarray, " k"]
    u: Float[np.ndarray, " k"]


def assess(setting: Setting, found: Iterated, groups: Sequence[Candidate]) -> tuple[Assessment, ...]:
    """What adding each of these groups, which are not estimated, would do."""
    layout = found.layout
    for c in groups:
        layout = layout.with_slot(c.slot, len(c.keys))
    factor, right = _information(setting, found, layout)
    p = found.layout.size
    return tuple(_assess(c, factor, right, p, layout.of(c.slot)) for c in groups)


def _information(
    setting: Setting, found: Iterated, layout: Layout
) -> tuple[Float[np.ndarray, "p p"], Float[np.ndarray, " p"]]:
    """R of all parameters and ``R step``."""
    eliminated = eliminate(found.triangles, layout)
    prior = prior_rows(setting, layout, found.state)
    if found.prints:
        weights = row_weights(setting, found.noise, found.frames, final=True)
        rows = [f.rows for f in found.frames]
        model = print_model(
            eliminated, found.triangles, layout, prior, rows, weights, found.prints, setting.data.targets
        )
        factor, step = information_with_print_errors(model, found.noise.print_mm, layout.size)
        return factor, factor @ step
    whole = global_factor(eliminated.rests, prior)
    return whole[:-1, :-1], whole[:-1, :-1] @ solve_factor(whole)


def _assess(
    candidate: Candidate,
    factor: Float[np.ndarray, "p p"],
    right: Float[np.ndarray, " p"],
    n_base: int,
    place: slice,
) -> Assessment:
    columns = [*range(n_base), *range(place.start, place.stop)]
    stacked = np.column_stack([factor[:, columns], right])
    reduced = upper_factor(stacked)
    k = len(candidate.keys)
    n = n_base + k
    block, rhs = reduced[n_base:n, n_base:n], reduced[n_base:n, n]
    strength = np.linalg.norm(factor[:, columns[n_base:]], axis=0)
    if not np.all(np.abs(np.diag(block)) > 1e-9 * np.maximum(strength, 1e-300)):
        return Assessment(candidate, 0.0, 1.0, np.zeros(k), np.full(k, np.inf))  # the data do not show it at all
    improvement = float(rhs @ rhs)
    step = np.linalg.solve(block, rhs)
    u = np.sqrt(np.diag(covariance_from_factor(block, 1.0)))
    return Assessment(candidate, improvement, float(special.chdtrc(k, max(improvement, 0.0))), step, u)


def likely_size(assessment: Assessment) -> float:
    """Standard deviation of parameters that are too small to be sure of: what their values scatter beyond their uncertainties.

    Errors that all frames share do not average out, so those that may be there have to stand in the covariance even where none is clear to
    see. They are then random effects, with this size.
    """
    if not np.isfinite(assessment.u).all():
        return 0.0
    return float(np.sqrt(max(np.mean(assessment.step**2 - assessment.u**2), 0.0)))


def described(
    assessment: Assessment, on: bool, values: Float[np.ndarray, " k"], u: Float[np.ndarray, " k"], reason: str
) -> OptionalParameters:
    """For the result; values that the data do not show at all are left out."""
    c = assessment.candidate
    known = u < 0.5 * VAGUE[c.slot.partition(":")[0]]
    shown = [
        (k, v, s, unit)
        for k, v, s, unit, ok in zip(c.keys, values.tolist(), u.tolist(), c.units, known, strict=True)
        if ok
    ]
    return OptionalParameters(
        c.name,
        on,
        reason,
        assessment.improvement,
        {key: value for key, value, _, _ in shown},
        {key: size for key, _, size, _ in shown},
        {key: unit for key, _, _, unit in shown},
    )
