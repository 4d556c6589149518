"""The joint estimate: one robust least-squares problem over all that a session shows.

The article estimates camera, laser plane and axis one after another, each frozen into the next, and refines the axis from four corner points a frame. Here
everything that shares a parameter is estimated at once, with residuals in pixels where the noise arises: target points, stripes on plates, targets on the
table under one axis, and every stripe point on an artefact against the surface that it lies on.

The iteration stands in ``iterate``, its linear algebra in ``solve``, rows and derivatives in ``rows``; scales, correlations and the errors of table, plates and
targets are learnt from the residuals (``noise``, ``print_errors``); groups of parameters are switched on where the data carry them (``optional``).

References
----------
.. [1] Li et al., Sensors 2026, 26(13), 4275, whose stages are the start
.. [2] Triggs et al., Bundle adjustment - a modern synthesis, 2000
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rotaline.calibration.joint.begin import in_one_order, start_noise, start_state
from rotaline.calibration.joint.data import gather
from rotaline.calibration.joint.iterate import Iterated, iterate
from rotaline.calibration.joint.line_width import line_and_blur
from rotaline.calibration.joint.linear import Setting, prior_rows, row_weights
from rotaline.calibration.joint.model import JointCalibration, JointStart, OptionalParameters
from rotaline.calibration.joint.noise import Noise
from rotaline.calibration.joint.optional import CHANCE, Assessment, assess, candidates, described, likely_size
from rotaline.calibration.joint.print_errors import PrintView, learn_print_errors, print_model, print_views
from rotaline.calibration.joint.result import slot_values, to_result
from rotaline.calibration.joint.state import Layout, State, n_mount_parameters
from rotaline.calibration.joint.surfaces import size_names, size_scale
from rotaline.calibration.observations import SessionObservations
from rotaline.errors import CalibrationError
from rotaline.geometry.primitives import Artifact, SteppedCylinder

_MAX_ROUNDS = 4
MIN_FRAMES = 3


@dataclass(frozen=True)
class JointOptions:
    """How everything is estimated together."""

    optional_parameters: bool = field(
        default=True,
        metadata={
            "help": "estimate angle and run-out errors once per turn, curvature of the laser sheet, pitch and bend of targets where the data show them"
        },
    )
    print_errors: bool = field(
        default=True,
        metadata={"help": "estimate the errors of the single points of a target where its views show them"},
    )


def estimate_jointly(
    observations: SessionObservations, start: JointStart, options: JointOptions | None = None
) -> JointCalibration:
    """Camera, target poses, laser plane, axis, errors of the table and mounts of least robust squares, with their covariance.

    Parameters
    ----------
    observations : SessionObservations
    start : JointStart   what the stages found; views that they left out take no part
    options : JointOptions

    Returns
    -------
    JointCalibration   the point of ``axis_camera`` is the one nearest to the optical axis

    Raises
    ------
    CalibrationError
        If the iteration does not settle, or no stripe point lies on an artefact.
    """
    began = time.perf_counter()
    options = options or JointOptions()
    setting, layout, state, noise, band = begin(observations, start)
    found = iterate(setting, layout, state, noise, band, rough=True)
    _require(setting, found)
    n_iterations = found.n_iterations
    state, noise = found.state, found.noise
    prints: dict[int, PrintView] = {}
    sigma, blur_px = _line_and_blur(found)
    if sigma > 0:
        setting = replace(setting, line_variance=sigma**2)
        layout = layout.with_slot("line", 1)
        state = replace(state, line_variance=sigma**2, stripe_blur_px=blur_px)
    if options.print_errors:
        noise, prints = _print_errors(setting, found)
    found = iterate(setting, layout, state, noise, found.band_mm, found.effects, prints)
    n_iterations += found.n_iterations
    optional: tuple[OptionalParameters, ...] = ()
    if options.optional_parameters:
        setting, found, optional, more = _with_optional(setting, found)
        n_iterations += more
    result = to_result(setting, found, start, optional, n_iterations)
    return replace(result, seconds=time.perf_counter() - began)


def begin(observations: SessionObservations, start: JointStart) -> tuple[Setting, Layout, State, Noise, float]:
    """Observations, parameters and values at the start, the noise that is assumed, and how far from its surface a stripe point may be (mm)."""
    data = in_one_order(gather(observations, start), start)
    state = start_state(observations, start, data)
    setting = Setting(data, start.camera.parameter_names, state.artifacts, observations.image_size)
    return setting, _base_layout(setting, state), state, start_noise(data), _start_band(state.artifacts)


def _with_optional(setting: Setting, found: Iterated) -> tuple[Setting, Iterated, tuple[OptionalParameters, ...], int]:
    """Groups of parameters switched on one after another, the clearest first; then errors of the table too small to be sure of.

    Returns
    -------
    setting, found : with the groups that are on
    optional : all groups, on and off
    n_iterations : that it took
    """
    groups = setting.data.artifact_groups
    possible = [c for c in candidates(setting.data, setting) if c.slot not in found.layout]
    chosen: dict[str, Assessment] = {}
    n_iterations = 0
    while True:
        assessed = assess(setting, found, [c for c in possible if c.slot not in found.layout])
        best = _best(assessed) if len(chosen) < _MAX_ROUNDS else None
        if best is None:
            break
        chosen[best.candidate.slot] = best
        found = _wider(setting, found, [best])
        n_iterations += found.n_iterations
    small = {a.candidate.slot: s for a in assessed if a.candidate.of_table and (s := likely_size(a)) > 0}
    off = [
        described(a, False, slot_values(found.state, a.candidate.slot, groups) + a.step, a.u, _why_not(a, small))
        for a in assessed
    ]
    if small:
        setting = replace(setting, small_errors=small)
        found = _wider(setting, found, [a for a in assessed if a.candidate.slot in small])
        n_iterations += found.n_iterations
    on = []
    for slot, a in chosen.items():
        u = np.sqrt(np.diag(found.solution.covariance)[found.layout.of(slot)])
        reason = f"the sum of squares falls by {a.improvement:.0f} with {len(u)} parameters"
        on.append(described(a, True, slot_values(found.state, slot, groups), u, reason))
    return setting, found, (*on, *off), n_iterations


def _wider(setting: Setting, found: Iterated, groups: Sequence[Assessment]) -> Iterated:
    """The estimate with more groups of parameters."""
    layout = found.layout
    for a in groups:
        layout = layout.with_slot(a.candidate.slot, len(a.candidate.keys))
    return iterate(setting, layout, found.state, found.noise, found.band_mm, found.effects, found.prints)


def _base_layout(setting: Setting, state: State) -> Layout:
    """What is always estimated."""
    data = setting.data
    slots = [("camera", len(setting.camera_names))]
    if state.plane is not None:
        slots.append(("plane", 3))
    if data.tables or data.mount_frames:
        slots.append(("axis", 4))
    slots += [(f"board:{b}", 6) for b in range(data.n_boards)]
    for k, artifact in enumerate(state.artifacts):
        slots.append((f"mount:{k}", n_mount_parameters(artifact)))
    for group in sorted(set(data.artifact_groups)):
        artifact = setting.artifact_of(group)
        if artifact.tolerance > 0:
            slots.append((f"sizes:{group}", len(size_names(artifact))))
    slots += [(f"bend:{t}", 3) for t, bend in enumerate(state.bends) if bend.any()]
    return Layout(tuple(slots))


def _start_band(artifacts: tuple[Artifact, ...]) -> float:
    """How far from its surface a stripe point may be at first, mm: less than what separates the surfaces."""
    bands = [1.5]
    for artifact in artifacts:
        if isinstance(artifact, SteppedCylinder):
            bands.append(0.25 * (artifact.diameter_large - artifact.diameter_small) / 2)
        bands.append(0.15 * size_scale(artifact))
    return min(bands)


def _require(setting: Setting, found: Iterated) -> None:
    """Every mount needs points on its surfaces, and the iteration an end."""
    for k, name in enumerate(setting.data.mount_names):
        mine = [
            f.mount
            for f, frame in zip(
                [f for f in found.frames if f.mount is not None], setting.data.mount_frames, strict=True
            )
            if frame.mount == k
        ]
        n = sum(len(m.surface) for m in mine if m is not None)
        if n < 50:
            raise CalibrationError(
                f"{name}: hardly any stripe points ({n} of every fourth) lie on the surfaces of the artefact. Check its sizes in session.toml."
            )
    if not np.isfinite(found.solution.squares):
        raise CalibrationError("The joint estimate did not settle.")


def _line_and_blur(found: Iterated) -> tuple[float, float]:
    """Standard deviations of the laser line (mm) and of the blur (px) from the widths of the stripes on all artefacts."""
    points = [f.mount for f in found.frames if f.mount is not None]
    if not points:
        return 0.0, 0.0
    return line_and_blur(np.concatenate([p.width_px for p in points]), np.concatenate([p.steepness for p in points]))


def _print_errors(setting: Setting, found: Iterated) -> tuple[Noise, dict[int, PrintView]]:
    """Whether the views show errors of the targets' points: their standard deviations, and which points of which frames have them."""
    data = setting.data
    numbers = [
        *((f.points.target, f.points.numbers) for f in data.plates),
        *((f.points.target, f.points.numbers) for f in data.tables),
        *(None for _ in data.mount_frames),
    ]
    together = [*range(len(data.plates)), *(-1 - f.board for f in data.tables), *([0] * len(data.mount_frames))]
    rows = [f.rows for f in found.frames]
    views = print_views(data.targets, numbers, rows, together)
    if not views:
        return found.noise, {}
    weights = row_weights(setting, found.noise, found.frames, final=True)
    prior = prior_rows(setting, found.layout, found.state)
    model = print_model(found.eliminated, found.triangles, found.layout, prior, rows, weights, views, data.targets)
    print_mm = learn_print_errors(model, found.noise.print_mm, sorted({v.target for v in views.values()}))
    shown = {f: v for f, v in views.items() if print_mm[v.target] > 0}
    return replace(found.noise, print_mm=print_mm), shown


def _best(assessed: tuple[Assessment, ...]) -> Assessment | None:
    """The group that is least likely to be chance, among those that may be estimated."""
    allowed = [a for a in assessed if not a.candidate.never and a.chance < CHANCE]
    return min(allowed, key=lambda a: (a.chance, -a.improvement)) if allowed else None


def _why_not(a: Assessment, small: dict[str, float]) -> str:
    if not np.isfinite(a.u).all():
        return "the data do not show it"
    if a.candidate.never:
        return a.candidate.never
    text = f"the sum of squares would fall by {a.improvement:.1f} only: as much as chance does"
    if a.candidate.slot in small:
        text += "; what there may be of it is allowed for in the uncertainties"
    return text
