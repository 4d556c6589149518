"""The article's method against the joint estimate, side by side, on sessions of the twin whose table has realistic errors.

The sessions are drawn like those that a good workshop's table would give: noise and eccentricity of the read-out, run-out, wobble, plates with
print errors, one mount nearly centred and one 4.5 to 6.5 mm off centre. They are observed without images, or they were rendered before and
are processed from their images.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from rotaline.errors import RotalineError, SessionError
from rotaline.io.rig_file import RigFile
from rotaline.io.session import read_session
from rotaline.io.truth_file import Truth, read_truth
from rotaline.pipeline.calibrate import calibrate_observations
from rotaline.pipeline.compare_truth import CalibrationErrors, calibration_errors
from rotaline.pipeline.observer import Silent
from rotaline.pipeline.options import ARTICLE_OPTIONS, Method, Options
from rotaline.pipeline.realisations import WorkPlan
from rotaline.pipeline.run import Run
from rotaline.pipeline.twin import trace_twin
from rotaline.pipeline.twin_errors import (
    QuantityError,
    feature_errors,
    measure_scans,
    plan_requests,
    system_errors,
    truth_of,
)
from rotaline.pipeline.verify_uncertainty import JOINT_OPTIONS, STRIPE_PX, TARGET_PX, observed_preset
from rotaline.simulation.truth import truth_path

METHODS: tuple[Method, ...] = ("article", "joint")
N_SESSIONS = 20
ARTIFACT_STEP_DEG, SCAN_STEP_DEG, SPACING_PX = 6.0, 8.0, 2.0
ANGLE_NOISE_DEG, RUN_OUT_NOISE_UM = 0.003, 1.0
ECCENTRICITY_DEG, RUN_OUT_UM, WOBBLE_URAD = (0.005, 0.02), (2.0, 5.0), (10.0, 30.0)
ARTIFACT_OFF_MM = ((0.1, 0.6), (4.5, 6.5))
"""Distances of the mounts from the rotation axis, smallest and largest."""

AXIS_ROWS = (
    ("axis, position at the table", "mm", "axis_low_mm", ("axis_shift_x", "axis_shift_y")),
    ("axis, position 50 mm above", "mm", "axis_high_mm", ()),
    ("axis, direction", "rad", "axis_urad", ("axis_turn_x", "axis_turn_y")),
)
"""Title, unit, field of :class:`rotaline.pipeline.compare_truth.CalibrationErrors`, parameters of the covariance that say the same."""
FEATURE_ROWS = (
    ("stepped cylinder, diameters", ("diameter_small", "diameter_large"), ("stepped-1", "stepped-2")),
    ("rod, diameter", ("diameter",), ("rod",)),
    ("ball, diameter", ("diameter",), ("ball",)),
    ("groove, depth", ("depth",), ("groove",)),
)


@dataclass(frozen=True)
class MethodUnit:
    """One session, by one method: the session's number, or the folder of a rendered one and where its results go."""

    method: Method
    session: int = 0
    rendered: str = ""
    results: str = ""


@dataclass(frozen=True)
class MethodErrors:
    """Errors of one method on one session; ``failure`` says why there are none.

    ``stated`` holds the errors of the system as its covariance counts them; empty where it has none.
    """

    method: str
    session: str
    calibration: CalibrationErrors
    features: tuple[QuantityError, ...]
    stated: tuple[QuantityError, ...]
    failure: str


@dataclass(frozen=True)
class MethodsRow:
    """RMS errors of one quantity over the sessions that both methods did.

    ``ratio``: article over joint. ``rms_standardised``: RMS of the joint method's error over its stated uncertainty. ``n``: errors of each method.
    """

    quantity: str
    unit: str
    n: int
    article: float
    joint: float
    ratio: float
    rms_standardised: float


@dataclass(frozen=True)
class MethodsVerification:
    """All rows, and what could not be done."""

    rows: tuple[MethodsRow, ...]
    n_sessions: int
    rendered: bool
    failures: tuple[str, ...]


def verify_methods(n_sessions: int, rendered: Sequence[Path], plan: WorkPlan) -> MethodsVerification:
    """Both methods on the same sessions.

    Parameters
    ----------
    n_sessions : drawn and observed without images, if none are rendered
    rendered : folders of rendered sessions, each with its truth beside it
    plan : how the work is done; results of rendered sessions go into its folder

    Raises
    ------
    SessionError
        If a rendered session, its truth, or a folder for results is missing.
    """
    if rendered and plan.folder is None:
        raise SessionError("rendered sessions need a folder for their results. Name one with --out DIR.")
    units = {}
    for folder in (path.resolve() for path in rendered):
        read_truth(truth_path(folder))
        for method in METHODS:
            name = f"{folder.name}-{method}"
            results = (plan.folder or Path()).resolve() / name
            units[name] = MethodUnit(method, rendered=str(folder), results=str(results))
    if not rendered:
        units = {f"{k:03d}-{method}": MethodUnit(method, session=k) for k in range(n_sessions) for method in METHODS}
    found = plan.do("methods", method_errors, units)
    return compare_methods(found, rendered=bool(rendered))


def realistic_session(session: int) -> RigFile:
    """The preset of the article with errors of the table drawn anew, and mounts elsewhere."""
    file = observed_preset(ARTIFACT_STEP_DEG, SCAN_STEP_DEG)
    rng = np.random.default_rng([4, session])
    turntable = file.tables.turntable.model_copy(
        update={
            "angle_noise_deg": ANGLE_NOISE_DEG,
            "angle_eccentricity_deg": float(rng.uniform(*ECCENTRICITY_DEG)),
            "run_out_um": float(rng.uniform(*RUN_OUT_UM)),
            "run_out_noise_um": RUN_OUT_NOISE_UM,
            "wobble_urad": float(rng.uniform(*WOBBLE_URAD)),
            "angle_eccentricity_phase_deg": float(rng.uniform(0.0, 360.0)),
            "run_out_phase_deg": float(rng.uniform(0.0, 360.0)),
            "wobble_phase_deg": float(rng.uniform(0.0, 360.0)),
        }
    )
    targets = {
        name: target.model_copy(update={"print_seed": 2000 + 10 * session + k})
        for k, (name, target) in enumerate(file.tables.targets.items())
    }
    off = iter(ARTIFACT_OFF_MM)
    captures = []
    for capture in file.tables.captures:
        if capture.role == "artifact":
            distance, towards, turn = rng.uniform(*next(off)), rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.0, 360.0)
            position = (float(distance * np.cos(towards)), float(distance * np.sin(towards)))
            moved = capture.mount.model_copy(update={"position_mm": position, "turn_deg": float(turn)})
            captures.append(capture.model_copy(update={"mount": moved}))
        else:
            captures.append(capture)
    tables = file.tables.model_copy(update={"turntable": turntable, "targets": targets, "captures": captures})
    return replace(file, tables=tables)


def method_errors(unit: MethodUnit) -> MethodErrors:
    """Calibrate and measure one session by one method."""
    options = JOINT_OPTIONS if unit.method == "joint" else ARTICLE_OPTIONS
    try:
        return _from_images(unit, options) if unit.rendered else _from_observations(unit, options)
    except RotalineError as error:
        return MethodErrors(unit.method, _name(unit), CalibrationErrors(), (), (), str(error))


def _name(unit: MethodUnit) -> str:
    return Path(unit.rendered).name if unit.rendered else f"{unit.session:03d}"


def _from_observations(unit: MethodUnit, options: Options) -> MethodErrors:
    file = realistic_session(unit.session)
    twin = trace_twin(file.rig(), file.plan(2000 + unit.session), spacing_px=SPACING_PX)
    observed = twin.observed(TARGET_PX, STRIPE_PX, unit.session)
    truth = truth_of(twin.rig, twin.plan)
    parts = calibrate_observations(observed.observations, options)
    refined = parts.joint if unit.method == "joint" else parts.artifact
    if parts.system is None or refined is None:
        text = "; ".join(w.text for w in parts.warnings) or "no calibration"
        return MethodErrors(unit.method, _name(unit), CalibrationErrors(), (), (), text)
    system = parts.system
    entries = measure_scans(observed.scans, plan_requests(twin.plan, artifacts=True), system, options.measure)
    calibration = calibration_errors(
        truth,
        system.camera,
        system.laser_plane_camera,
        system.rotation_axis_camera,
        None,
        system.turn_sense,
    )
    stated = system_errors(truth, system) if system.covariance is not None else ()
    return MethodErrors(unit.method, _name(unit), calibration, feature_errors(truth, entries), stated, "")


def _from_images(unit: MethodUnit, options: Options) -> MethodErrors:
    session = Path(unit.rendered)
    truth: Truth = read_truth(truth_path(session))
    chosen = replace(options, scan=replace(options.scan, surface=False))
    run = Run(read_session(session), Path(unit.results), chosen, Silent())
    parts, content = run.calibrate()
    system = content.system()
    refined = parts.joint if unit.method == "joint" else parts.artifact
    if system is None or refined is None:
        text = "; ".join(w.text for w in parts.warnings) or "no calibration"
        return MethodErrors(unit.method, _name(unit), CalibrationErrors(), (), (), text)
    entries, _ = run.measure(run.scan(content), content)
    calibration = calibration_errors(
        truth, content.camera, content.laser_plane_camera, content.rotation_axis_camera, None, content.turn_sense
    )
    stated = system_errors(truth, system) if system.covariance is not None else ()
    return MethodErrors(unit.method, _name(unit), calibration, feature_errors(truth, entries), stated, "")


def compare_methods(found: Sequence[MethodErrors], rendered: bool) -> MethodsVerification:
    """RMS errors of both methods over the sessions that both could do."""
    by_method = {m: {e.session: e for e in found if e.method == m and not e.failure} for m in METHODS}
    sessions = [s for s in by_method["article"] if s in by_method["joint"]]
    article, joint = ([by_method[m][s] for s in sessions] for m in METHODS)
    rows = []
    for title, unit, key, parameters in AXIS_ROWS:
        scale = 1e-6 if unit == "rad" else 1.0
        a, j = (scale * np.array([getattr(e.calibration, key) for e in side]) for side in (article, joint))
        z = np.array([q.standardised for e in joint for q in e.stated if q.name in parameters])
        rows.append(_row(title, unit, a, j, z))
    for title, keys, captures in FEATURE_ROWS:
        names = [f"{capture} {key}" for capture in captures for key in keys]
        a, j = (np.array([q.error for e in side for q in e.features if q.name in names]) for side in (article, joint))
        z = np.array([q.standardised for e in joint for q in e.features if q.name in names])
        rows.append(_row(title, "mm", a, j, z))
    failures = tuple(f"{e.session}, {e.method}: {e.failure}" for e in found if e.failure)
    return MethodsVerification(tuple(rows), len(sessions), rendered, failures)


def _row(quantity: str, unit: str, article: np.ndarray, joint: np.ndarray, z: np.ndarray) -> MethodsRow:
    a, j = _rms(article), _rms(joint)
    return MethodsRow(quantity, unit, int(np.isfinite(joint).sum()), a, j, a / j if j > 0 else float("nan"), _rms(z))


def _rms(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("nan")
