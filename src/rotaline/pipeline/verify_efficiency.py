"""How close the joint estimate comes to the Cramér-Rao bound: many realisations of one ideal session.

Table, plates and print are perfect, and the noise is Gaussian and of known size, so that the bound is known: the inverse of the information
of all points that were given, those near the edges of an artefact included. The estimate does not know any of this: it learns the size of the
noise, and looks for the errors that there are not. Points that are elsewhere add nothing to the information; the bound stays that
without them.
"""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from rotaline.calibration.joint.begin import in_one_order, start_noise, start_state
from rotaline.calibration.joint.data import JointData, gather
from rotaline.calibration.joint.iterate import iterate
from rotaline.calibration.joint.linear import FrameResiduals, Setting, board_pivot, linearise, prior_rows
from rotaline.calibration.joint.model import JointCalibration, JointStart
from rotaline.calibration.joint.solve import eliminate, press, solve
from rotaline.calibration.joint.state import Layout, State, table_motions
from rotaline.calibration.observations import SessionObservations
from rotaline.errors import CalibrationError
from rotaline.io.rig_file import RigFile
from rotaline.pipeline.calibrate import CalibrationParts, calibrate_observations
from rotaline.pipeline.calibrate_joint import start_joint_estimate
from rotaline.pipeline.realisations import WorkPlan
from rotaline.pipeline.stage_runner import StageRunner
from rotaline.pipeline.twin import TracedTwin, trace_twin
from rotaline.pipeline.twin_errors import system_errors, truth_of
from rotaline.pipeline.verify_uncertainty import JOINT_OPTIONS, STRIPE_PX, TARGET_PX, observed_preset

SPACING_PX, STEP_DEG = 4.0, 12.0
OUTLIER_FRACTION, OUTLIER_PX = 0.03, 10.0
GAUSSIAN_BAR, OUTLIER_BAR = 1.1, 1.3
N_PER_UNIT = 10
GROUPS = ("camera", "plane", "axis")
_EXACT = 1e9
"""One over the standard deviation of what is perfect, 1/rad or 1/mm."""


@dataclass(frozen=True)
class NoiseUnit:
    """Some realisations of the noise."""

    outlier_fraction: float
    seeds: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class SystemErrors:
    """Errors of camera, plane and axis in some realisations; ``groups`` and ``names`` of the columns."""

    groups: tuple[str, ...]
    names: tuple[str, ...]
    errors: Float[np.ndarray, "n p"]
    failures: tuple[str, ...]


@dataclass(frozen=True)
class EfficiencyRow:
    """Variance over the bound, mean over ``p`` parameters (``trace(C_bound^-1 C) / p``), for camera, plane, axis, and all together.

    ``u_ratio``: standard uncertainty of the ratio for Gaussian errors. ``bias``: mean error in units of its own standard uncertainty, RMS over
    the parameters: 1 where there is no bias.
    """

    noise: str
    group: str
    n: int
    p: int
    ratio: float
    u_ratio: float
    bias: float
    bar: float

    @property
    def holds(self) -> bool:
        """Whether the ratio is not above the bar."""
        return self.ratio <= self.bar


@dataclass(frozen=True)
class EfficiencyVerification:
    """Rows of both kinds of noise; ``used_fraction``: of the points on the artefacts that count in the bound, how many the estimate uses."""

    rows: tuple[EfficiencyRow, ...]
    used_fraction: float
    failures: tuple[str, ...]


def verify_efficiency(n_realisations: int, plan: WorkPlan) -> EfficiencyVerification:
    """Spread of the joint estimate beside the bound, with Gaussian noise and with outliers as well.

    Parameters
    ----------
    n_realisations : of each kind of noise
    plan : how the work is done
    """
    rows: list[EfficiencyRow] = []
    failures: list[str] = []
    bound = plan.do("bound", _bound_of_session, {"gaussian": NoiseUnit(0.0, (0,))})[0]
    for noise, fraction, bar in (
        ("Gaussian", 0.0, GAUSSIAN_BAR),
        (f"with {100 * OUTLIER_FRACTION:g} % outliers", OUTLIER_FRACTION, OUTLIER_BAR),
    ):
        units = {
            f"{fraction:g}-{first:04d}": NoiseUnit(
                fraction, tuple(range(first, min(first + N_PER_UNIT, n_realisations)))
            )
            for first in range(0, n_realisations, N_PER_UNIT)
        }
        pieces = plan.do("efficiency", noise_errors, units)
        failures += [text for piece in pieces for text in piece.failures]
        rows += efficiency_rows(noise, pieces, bound, bar)
    return EfficiencyVerification(tuple(rows), bound.used_fraction, tuple(failures))


def ideal_session() -> RigFile:
    """The preset of the article without any error of table and plates."""
    file = observed_preset(STEP_DEG, STEP_DEG)
    exact = {"print_offset_um": 0.0, "pitch_error_ppm": 0.0, "flatness_um": 0.0}
    targets = {
        name: t.model_copy(update={k: v for k, v in exact.items() if k in type(t).model_fields})
        for name, t in file.tables.targets.items()
    }
    turntable = file.tables.turntable.model_copy(
        update={"angle_noise_deg": 0.0, "run_out_um": 0.0, "run_out_noise_um": 0.0, "wobble_urad": 0.0}
    )
    return replace(file, tables=file.tables.model_copy(update={"targets": targets, "turntable": turntable}))


def noise_errors(unit: NoiseUnit) -> SystemErrors:
    """Errors of the joint estimate in some realisations."""
    twin = _traced()
    truth = truth_of(twin.rig, twin.plan)
    rows, failures, groups, names = [], [], tuple[str, ...](), tuple[str, ...]()
    for seed in unit.seeds:
        observed = twin.observed(
            TARGET_PX, STRIPE_PX, seed, outlier_fraction=unit.outlier_fraction, outlier_px=OUTLIER_PX
        )
        try:
            parts = calibrate_observations(observed.observations, JOINT_OPTIONS)
        except CalibrationError as error:
            failures.append(f"noise {seed}: {error}")
            continue
        if parts.joint is None or parts.system is None:
            failures.append(f"noise {seed}: " + "; ".join(w.text for w in parts.warnings))
            continue
        found = [e for e in system_errors(truth, parts.system) if e.group in GROUPS]
        groups, names = tuple(e.group for e in found), tuple(e.name for e in found)
        rows.append([e.error for e in found])
    return SystemErrors(groups, names, np.array(rows).reshape(len(rows), len(names)), tuple(failures))


@lru_cache(maxsize=1)
def _traced() -> TracedTwin:
    file = ideal_session()
    return trace_twin(file.rig(), file.plan(), spacing_px=SPACING_PX)


@dataclass(frozen=True, eq=False)
class Bound:
    """The Cramér-Rao bound of camera, plane and axis, with the names of :class:`rotaline.calibration.model.SystemCovariance`."""

    names: tuple[str, ...]
    matrix: Float[np.ndarray, "p p"]
    used_fraction: float


def _bound_of_session(unit: NoiseUnit) -> Bound:
    twin = _traced()
    observations = twin.observed(TARGET_PX, STRIPE_PX, unit.seeds[0]).observations
    parts = calibrate_observations(observations, JOINT_OPTIONS)
    if parts.camera is None or parts.joint is None:
        raise CalibrationError(
            "The ideal session could not be calibrated: " + "; ".join(w.text for w in parts.warnings)
        )
    return information_bound(observations, joint_start(parts, observations), parts.joint)


def joint_start(parts: CalibrationParts, observations: SessionObservations) -> JointStart:
    """Where the joint estimate of calibrated observations started."""
    assert parts.camera is not None
    start, _ = start_joint_estimate(
        parts.camera, parts.laser_plane, parts.axis, observations.mounts, JOINT_OPTIONS, StageRunner()
    )
    return start


def information_bound(observations: SessionObservations, start: JointStart, joint: JointCalibration) -> Bound:
    """The least covariance that an unbiased estimate from all given points can have when table, plates and print are perfect.

    The information is that at the estimate: its errors, some millionths of the parameters, change it by as little. What lenses look like and
    how wide the line is enter as they do in the estimate.
    """
    data = in_one_order(gather(observations, start), start)
    state = start_state(observations, start, data)
    variance = joint.line_sigma_mm**2
    setting = Setting(data, start.camera.parameter_names, state.artifacts, observations.image_size, variance)
    slots = [("camera", len(setting.camera_names)), ("plane", 3), ("axis", 4)]
    slots += [(f"board:{b}", 6) for b in range(data.n_boards)] + [(f"mount:{k}", 5) for k in range(len(state.mounts))]
    layout = Layout((*slots, ("line", 1)) if variance > 0 else tuple(slots))
    found = iterate(setting, layout, replace(state, line_variance=variance), start_noise(data), band_mm=1.5)
    everywhere = replace(setting, data=_without_margins(data))
    frames = linearise(everywhere, found.state, found.noise, found.band_mm, None, {}, 1)
    used = sum(len(f.raw) for f in found.frames if f.mount is not None)
    given = sum(len(f.raw) for f in frames if f.mount is not None)
    triangles = []
    for k, frame in enumerate(frames):
        on_table = k >= len(data.plates)
        motions = _motions(data, layout, found.state, k) if on_table else {}
        n_local = frame.rows.local.shape[1]
        prior = np.full(n_local, _EXACT) if on_table else np.concatenate([np.zeros(6), np.full(n_local - 6, _EXACT)])
        triangles.append(press(frame.rows, _true_weights(data, frame), motions, prior))
    solution = solve(eliminate(triangles, layout), prior_rows(setting, layout, found.state))
    covariance = joint.covariance
    columns = np.arange(layout.of("camera").start, layout.of("axis").stop)
    names = covariance.names[: len(columns)]
    return Bound(names, solution.covariance[np.ix_(columns, columns)], used / given)


def _without_margins(data: JointData) -> JointData:
    """Stripes without width keep no distance from the edges of an artefact."""
    frames = tuple(
        replace(f, stripe=replace(f.stripe, width_px=np.zeros_like(f.stripe.width_px))) for f in data.mount_frames
    )
    return replace(data, mount_frames=frames)


def _true_weights(data: JointData, frame: FrameResiduals) -> Float[np.ndarray, " n"]:
    """One over the standard deviation of each residual."""
    sigma = {"target": TARGET_PX, "table-target": TARGET_PX, "plate-stripe": STRIPE_PX, "artifact": STRIPE_PX}
    return 1.0 / np.array([sigma[info.kind] for info in data.groups])[frame.rows.group]


def _motions(data: JointData, layout: Layout, state: State, k: int) -> dict[str, Float[np.ndarray, "6 _"]]:
    """How axis and poses on the table move frame k."""
    j = k - len(data.plates)
    if j < len(data.tables):
        table = data.tables[j]
        pivot = state.boards[table.board].apply(board_pivot(data, table.board)[None])[0]
        return table_motions(state, table.angle_rad, layout, f"board:{table.board}", pivot)
    mount = data.mount_frames[j - len(data.tables)]
    return table_motions(state, mount.angle_rad, layout, f"mount:{mount.mount}", state.mount_pivot(mount.mount))


def efficiency_rows(noise: str, pieces: list[SystemErrors], bound: Bound, bar: float) -> tuple[EfficiencyRow, ...]:
    """Camera, plane, axis, and all together; the bar is for all together."""
    some = next((p for p in pieces if len(p.errors)), None)
    if some is None:
        return ()
    errors = np.concatenate([p.errors for p in pieces if p.names == some.names])
    place = [bound.names.index(name) for name in some.names]
    matrix = bound.matrix[np.ix_(place, place)]
    rows = []
    for group in ("all", *GROUPS):
        chosen = [i for i, g in enumerate(some.groups) if group in ("all", g)]
        mine, least = errors[:, chosen], matrix[np.ix_(chosen, chosen)]
        n, p = mine.shape
        spread = np.atleast_2d(np.cov(mine, rowvar=False))
        mean = mine.mean(axis=0) / np.sqrt(np.diag(spread) / n)
        rows.append(
            EfficiencyRow(
                noise,
                group,
                n,
                p,
                float(np.trace(np.linalg.solve(least, spread)) / p),
                float(np.sqrt(2.0 / (p * (n - 1)))),
                float(np.sqrt(np.mean(mean**2))),
                bar,
            )
        )
    return tuple(rows)
