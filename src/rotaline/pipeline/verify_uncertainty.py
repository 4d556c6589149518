"""Whether stated uncertainties hold: sessions of the twin, calibrated jointly and measured, against their truth.

Every session has a table, plates and poses of its own; each is observed several times with new noise of the detectors. Errors of table and plates
are the same in all realisations of a session, so these are not independent: the uncertainty of a coverage is that of the mean over
sessions (cluster sampling [1]_).

References
----------
.. [1] Cochran, Sampling Techniques, 3rd ed., 1977, section 9A
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from jaxtyping import Float

from rotaline.errors import CalibrationError, GeometryError
from rotaline.io.rig_file import RigFile, read_preset
from rotaline.io.rig_tables import CaptureTable
from rotaline.pipeline.calibrate import calibrate_observations
from rotaline.pipeline.options import CalibrationOptions, Options
from rotaline.pipeline.realisations import WorkPlan
from rotaline.pipeline.twin import TracedTwin, trace_twin
from rotaline.pipeline.twin_errors import (
    QuantityError,
    feature_errors,
    measure_scans,
    plan_requests,
    system_errors,
    truth_of,
)

TARGET_PX, STRIPE_PX = 0.02, 0.05
"""Noise of the points of plates, in u and in v, and of stripe centres, along the normal."""
SPACING_PX = 2.0
STEP_DEG = 8.0
COVERAGE_FACTOR = 1.96
NOMINAL = 0.95
POOLED_BAR, QUANTITY_BAR = (0.93, 0.97), (0.90, 0.985)
N_SESSIONS = 20
LINE_WIDTH_MM = 0.03
"""Of the laser line: a wide one shifts the stripe on curved surfaces, which traced stripes do not show."""
JUDGED_GROUPS = ("axis", "plane", "features")
JOINT_OPTIONS = Options(calibration=CalibrationOptions(method="joint"))


@dataclass(frozen=True)
class SessionUnit:
    """One session and the realisations of its noise."""

    session: int
    noise_seeds: tuple[int, ...]


@dataclass(frozen=True)
class Realisation:
    """Errors of one calibration and of what was measured with it; ``failure`` says why there are none.

    ``optional``: groups of parameters that were switched on.
    """

    session: int
    noise_seed: int
    errors: tuple[QuantityError, ...]
    optional: tuple[str, ...]
    failure: str


@dataclass(frozen=True)
class CoverageRow:
    """How the stated uncertainty of one quantity, or of several pooled, holds.

    Attributes
    ----------
    group, name : ``name`` is "" for all quantities of a group; ``group`` "all" for all that are judged
    unit : "" where several are pooled
    n : errors that were looked at
    coverage, u_coverage : share of the stated 95 % intervals that hold the truth, its standard uncertainty between sessions
    rms_standardised : RMS of error over stated uncertainty
    mean_standardised : mean of error over stated uncertainty: a bias that all sessions share
    noise_share : share of the squares of error over uncertainty that differs between realisations of the same session
    mean_u, rms_error : NaN where several are pooled
    bar : what the coverage should be between
    """

    group: str
    name: str
    unit: str
    n: int
    coverage: float
    u_coverage: float
    rms_standardised: float
    mean_standardised: float
    noise_share: float
    mean_u: float
    rms_error: float
    bar: tuple[float, float]

    @property
    def holds(self) -> bool:
        """Whether the coverage is within the bar."""
        return self.bar[0] <= self.coverage <= self.bar[1]


@dataclass(frozen=True)
class UncertaintyVerification:
    """All rows: pooled over everything, then each group with its quantities; and what was done."""

    rows: tuple[CoverageRow, ...]
    n_realisations: int
    n_sessions: int
    failures: tuple[str, ...]
    optional: dict[str, int]


def verify_uncertainty(n_realisations: int, plan: WorkPlan) -> UncertaintyVerification:
    """Calibrate and measure many realisations of twin sessions.

    Parameters
    ----------
    n_realisations : in all, evenly of twenty sessions
    plan : how the work is done
    """
    n_sessions = min(N_SESSIONS, n_realisations)
    units = {
        f"{session:03d}": SessionUnit(session, tuple(range(session, n_realisations, n_sessions)))
        for session in range(n_sessions)
    }
    found = [r for session in plan.do("uncertainty", session_errors, units) for r in session]
    return summarise(found)


def session_errors(unit: SessionUnit) -> tuple[Realisation, ...]:
    """All realisations of a session."""
    twin = _traced(unit.session)
    return tuple(_realisation(twin, unit.session, seed) for seed in unit.noise_seeds)


def article_session(session: int) -> RigFile:
    """The preset of the article with larger steps, and other prints and another table in each session."""
    file = observed_preset(STEP_DEG, STEP_DEG)
    rng = np.random.default_rng([41, session])
    targets = {
        name: target.model_copy(update={"print_seed": 1000 + 10 * session + k})
        for k, (name, target) in enumerate(file.tables.targets.items())
    }
    turntable = file.tables.turntable.model_copy(update={"run_out_phase_deg": float(rng.uniform(0.0, 360.0))})
    return replace(file, tables=file.tables.model_copy(update={"targets": targets, "turntable": turntable}))


def observed_preset(artifact_deg: float, scan_deg: float) -> RigFile:
    """The preset of the article as stripes are traced: larger steps between the frames of mounts and of scans, and a thin line of the same light."""
    file = read_preset("article")
    tables = file.tables
    steps = {"artifact": artifact_deg, "scan": scan_deg}

    def stepped(capture: CaptureTable) -> CaptureTable:
        return capture.model_copy(update={"step_deg": steps[capture.role]}) if capture.role in steps else capture

    brighter = tables.laser.line_width_mm / LINE_WIDTH_MM
    laser = tables.laser.model_copy(update={"line_width_mm": LINE_WIDTH_MM, "divergence_mrad": 0.0})
    light = tables.light.model_copy(update={"exposure_on_ms": brighter * tables.light.exposure_on_ms})
    captures = [stepped(c) for c in tables.captures]
    return replace(file, tables=tables.model_copy(update={"laser": laser, "light": light, "captures": captures}))


@lru_cache(maxsize=1)
def _traced(session: int) -> TracedTwin:
    file = article_session(session)
    return trace_twin(file.rig(), file.plan(1000 + session), spacing_px=SPACING_PX)


def _realisation(twin: TracedTwin, session: int, seed: int) -> Realisation:
    observed = twin.observed(TARGET_PX, STRIPE_PX, seed)
    truth = truth_of(twin.rig, twin.plan)
    try:
        parts = calibrate_observations(observed.observations, JOINT_OPTIONS)
        if parts.joint is None or parts.system is None:
            return Realisation(session, seed, (), (), "; ".join(w.text for w in parts.warnings) or "no joint estimate")
        entries = measure_scans(observed.scans, plan_requests(twin.plan, False), parts.system, JOINT_OPTIONS.measure)
    except (CalibrationError, GeometryError) as error:
        return Realisation(session, seed, (), (), str(error))
    errors = (*system_errors(truth, parts.system), *feature_errors(truth, entries))
    return Realisation(session, seed, errors, tuple(o.name for o in parts.joint.optional if o.on), "")


def summarise(realisations: Sequence[Realisation]) -> UncertaintyVerification:
    """Coverage of every quantity, of every group, and of all."""
    good = [r for r in realisations if not r.failure]
    sessions = np.array([r.session for r in good])
    names = dict.fromkeys((e.group, e.name, e.unit) for r in good for e in r.errors)
    columns = {key: _column(good, *key[:2]) for key in names}
    rows = []
    if judged := [column for key, column in columns.items() if key[0] in JUDGED_GROUPS]:
        rows.append(_row("all", "", "", judged, sessions, POOLED_BAR))
    for group in (*JUDGED_GROUPS, "camera"):
        mine = {key: column for key, column in columns.items() if key[0] == group}
        if not mine:
            continue
        rows.append(_row(group, "", "", list(mine.values()), sessions, QUANTITY_BAR))
        rows += [_row(*key, [column], sessions, QUANTITY_BAR) for key, column in mine.items()]
    optional: dict[str, int] = {}
    for r in good:
        for name in r.optional:
            optional[name] = optional.get(name, 0) + 1
    failures = tuple(f"session {r.session}, noise {r.noise_seed}: {r.failure}" for r in realisations if r.failure)
    return UncertaintyVerification(
        tuple(rows), len(realisations), len({r.session for r in realisations}), failures, optional
    )


def _column(realisations: Sequence[Realisation], group: str, name: str) -> Float[np.ndarray, "n 2"]:
    """Error and uncertainty in each realisation; NaN where there is none."""
    out = np.full((len(realisations), 2), np.nan)
    for i, r in enumerate(realisations):
        for e in r.errors:
            if (e.group, e.name) == (group, name):
                out[i] = e.error, e.u
    return out


def _row(
    group: str,
    name: str,
    unit: str,
    columns: Sequence[Float[np.ndarray, "n 2"]],
    sessions: np.ndarray,
    bar: tuple[float, float],
) -> CoverageRow:
    errors, u = (np.stack([c[:, k] for c in columns], axis=1) for k in (0, 1))
    known = np.isfinite(errors) & np.isfinite(u)
    z = np.where(known, errors / u, np.nan)
    inside = np.where(known, np.abs(z) <= COVERAGE_FACTOR, np.nan)
    single = len(columns) == 1
    squares, within, freedom = float(np.nansum(z**2)), 0.0, 0
    for s in np.unique(sessions):
        mine = z[sessions == s]
        n = np.sum(np.isfinite(mine), axis=0)
        within += float(np.nansum((mine - np.nansum(mine, axis=0) / np.maximum(n, 1)) ** 2))
        freedom += int(np.sum(np.maximum(n - 1, 0)))
    n_all = int(known.sum())
    return CoverageRow(
        group,
        name,
        unit,
        n_all,
        float(np.nanmean(inside)) if n_all else float("nan"),
        cluster_u(inside, sessions),
        float(np.sqrt(squares / n_all)) if n_all else float("nan"),
        float(np.nanmean(z)) if n_all else float("nan"),
        within / freedom / (squares / n_all) if freedom and squares > 0 else float("nan"),
        float(np.nanmean(u)) if single and n_all else float("nan"),
        float(np.sqrt(np.nanmean(errors**2))) if single and n_all else float("nan"),
        bar,
    )


def cluster_u(values: Float[np.ndarray, "n k"], sessions: np.ndarray) -> float:
    """Standard uncertainty of the mean of all values from the scatter between sessions; NaN for fewer than two sessions."""
    mean, total, squares = float(np.nanmean(values)), np.count_nonzero(np.isfinite(values)), 0.0
    members = np.unique(sessions)
    if len(members) < 2:
        return float("nan")
    for s in members:
        squares += float(np.nansum(values[sessions == s] - mean)) ** 2
    return float(np.sqrt(squares * len(members) / (len(members) - 1)) / total)
