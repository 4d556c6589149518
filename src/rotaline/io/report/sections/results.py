"""The results at the top of the report: the table of measured features, and before / after the axis optimisation."""

from collections import defaultdict

import numpy as np

from rotaline.calibration.joint.model import JointCalibration
from rotaline.io.report import numbers
from rotaline.io.report.contents import ReportContents
from rotaline.io.report.page import Block, Column, KeyFigure, Level, Paragraph, Row, Section, Table
from rotaline.io.report.warnings import warnings_of
from rotaline.io.results import MeasurementEntry

_KIND_TITLES = {
    "stepped-cylinder": "Stepped cylinder (the article's table 2)",
    "sphere": "Sphere (the article's table 3)",
    "cylinder": "Cylinder (the article's table 4)",
    "groove": "Groove (the article's table 5)",
    "step": "Step",
    "plane": "Plane",
}
_BEFORE_AND_AFTER = (
    "The same scans, evaluated with the initial rotation axis (before) and with the axis optimised by the stepped cylinder "
    "(after). Errors are value minus reference; averages are those of their magnitudes."
)
_BEFORE_AND_AFTER_JOINT = (
    "The same scans, evaluated with the initial rotation axis (before) and with the axis of the joint estimate (after). Errors are "
    "value minus reference; averages are those of their magnitudes."
)
_ONE_AXIS = (
    "Errors are value minus reference; averages are those of their magnitudes. There is only one axis, so there is no before "
    "and after."
)


def section(contents: ReportContents) -> Section:
    """The summary table and the tables with the initial and the optimised axis."""
    entries = contents.measurements
    if not entries:
        return Section(
            "results",
            "Measured features",
            "Results",
            missing="Nothing was to be measured: the session names no [[measurements]] and has no artefact captures.",
        )
    n_failed = sum(e.measurement is None for e in entries)
    judgement, level = _judge(contents, n_failed)
    blocks: list[Block] = [_summary_with_u(entries) if _calibration_is_known(entries) else _summary(entries)]
    refined = contents.artifact is not None or contents.joint is not None
    before = contents.measurements_initial_axis if refined else ()
    comparisons = _comparisons(entries, before)
    if comparisons:
        how = _BEFORE_AND_AFTER if contents.joint is None else _BEFORE_AND_AFTER_JOINT
        blocks.append(Paragraph(how if before else _ONE_AXIS))
        blocks += comparisons
    return Section(
        "results",
        "Measured features",
        "Results",
        judgement,
        level,
        warnings_of("measure", contents.warnings),
        tuple(blocks),
    )


def key_figures(contents: ReportContents) -> tuple[KeyFigure, ...]:
    """The figures that a reader looks for first."""
    figures = []
    if contents.camera is not None:
        used = sum(v.used for v in contents.camera.views)
        figures.append(
            KeyFigure(
                "Camera, reprojection RMS",
                numbers.fixed(contents.camera.rms_px, 3),
                "px",
                f"{used} of {numbers.plural(len(contents.camera.views), 'view')}",
            )
        )
    if contents.laser_plane is not None:
        used = sum(v.used for v in contents.laser_plane.views)
        figures.append(
            KeyFigure(
                "Laser plane, RMS",
                numbers.um(contents.laser_plane.rms_mm),
                "µm",
                f"{used} of {numbers.plural(len(contents.laser_plane.views), 'pose')}",
            )
        )
    if contents.cross_ratio is not None:
        result = contents.cross_ratio
        figures.append(
            KeyFigure(
                "Laser plane, interval RMSE",
                f"{numbers.um(result.rmse_before_mm)} → {numbers.um(result.rmse_after_mm)}",
                "µm",
                "optimised plane used" if result.accepted else "optimised plane not used",
            )
        )
    if contents.joint is not None:
        figures += _joint_figures(contents.joint)
    elif contents.artifact is not None:
        result_a = contents.artifact
        figures.append(
            KeyFigure(
                "Axis, mean distance",
                f"{numbers.um(result_a.mean_distance_before_mm)} → {numbers.um(result_a.mean_distance_mm)}",
                "µm",
                numbers.plural(len(result_a.mounts), "mount"),
            )
        )
    elif contents.axis is not None:
        figures.append(KeyFigure("Initial axis, circles RMS", numbers.um(contents.axis.rms_mm), "µm", "not optimised"))
    errors = _errors(contents.measurements)
    if errors:
        figures.append(
            KeyFigure(
                "Largest error against a reference",
                numbers.um(max(abs(e) for e in errors)),
                "µm",
                f"of {numbers.plural(len(errors), 'quantity', 'quantities')}",
            )
        )
    return tuple(figures)


def _joint_figures(joint: JointCalibration) -> list[KeyFigure]:
    targets = [g for g in joint.groups if g.kind in ("target", "table-target") and g.n_used]
    figures = []
    if targets:
        squares = sum(g.n_used * g.rms_px**2 for g in targets)
        rms = float(np.sqrt(squares / sum(g.n_used for g in targets)))
        n = numbers.count(sum(g.n_used for g in targets))
        figures.append(KeyFigure("Joint estimate, target points RMS", numbers.fixed(rms, 3), "px", f"{n} points"))
    distances = [m.distances_mm[m.used] for m in joint.mounts]
    if sum(len(d) for d in distances):
        rms_mm = float(np.sqrt(np.mean(np.concatenate(distances) ** 2)))
        remark = numbers.plural(len(joint.mounts), "mount")
        figures.append(KeyFigure("Joint estimate, artefact surfaces RMS", numbers.um(rms_mm), "µm", remark))
    return figures


def quantity(key: str) -> str:
    """How a key of a measurement is called: ``diameter_small`` -> ``diameter (small)``."""
    name, _, which = key.partition("_")
    return f"{name} ({which.replace('_', ' ')})" if which else name


def _errors(entries: tuple[MeasurementEntry, ...]) -> list[float]:
    return [error for entry in entries for error in entry.error.values() if np.isfinite(error)]


def _judge(contents: ReportContents, n_failed: int) -> tuple[str, Level]:
    entries = contents.measurements
    n = len(entries)
    text = f"{n - n_failed} of {numbers.plural(n, 'feature')} measured."
    errors = _errors(entries)
    if errors:
        text += (
            f" Against {numbers.plural(len(errors), 'reference value')} the mean magnitude of the error is "
            f"{numbers.um(float(np.mean(np.abs(errors))))} µm, the largest {numbers.um(max(abs(e) for e in errors))} µm."
        )
    else:
        text += " No reference values were given, so nothing here says how true the values are."
    return text, "poor" if n_failed == n else "fair" if n_failed else "none"


def _calibration_is_known(entries: tuple[MeasurementEntry, ...]) -> bool:
    """The uncertainty of some value has the part that comes from the calibration."""
    return any(e.measurement is not None and e.measurement.u_calibration for e in entries)


def _label(entry: MeasurementEntry) -> str:
    name = entry.name if entry.name and entry.name != entry.feature else ""
    return f"{entry.feature} – {name}" if name else entry.feature


def _summary_with_u(entries: tuple[MeasurementEntry, ...]) -> Table:
    """Value, U and its two parts, reference, error, and whether the error is within U."""
    columns = (
        Column("Capture", numeric=False),
        Column("Feature", numeric=False),
        Column("Quantity", numeric=False),
        Column("Value", "mm"),
        Column("U", "µm, k = 2"),
        Column("of scatter", "µm"),
        Column("of calibration", "µm"),
        Column("Reference", "mm"),
        Column("Error", "µm"),
        Column("Within U", numeric=False),
        Column("RMS", "µm"),
        Column("Points", "n"),
    )
    rows = []
    for entry in entries:
        m = entry.measurement
        if m is None:
            rows.append(Row((entry.capture, _label(entry), f"not measured: {entry.failure}"), "failed"))
            continue
        for i, (key, value) in enumerate(m.value.items()):
            first = i == 0
            u, error = m.uncertainty.get(key), entry.error.get(key)
            cells = (
                entry.capture if first else "",
                _label(entry) if first else "",
                quantity(key),
                numbers.mm(value),
                _expanded(u),
                _expanded(m.u_scatter.get(key)),
                _expanded(m.u_calibration.get(key)),
                numbers.mm(entry.reference.get(key)),
                numbers.um(error, signed=True),
                _within(error, u),
                numbers.um(m.rms) if first else "",
                numbers.count(m.n_points) if first else "",
            )
            rows.append(Row(cells, "plain" if first else "continued"))
    return Table(
        "Measured features with their expanded uncertainty U (k = 2), with the final calibration.",
        columns,
        tuple(rows),
        "Error: value minus reference. U: expanded uncertainty, twice the standard one; about 95 of 100 errors should be within it. Its "
        "parts add as squares: the scatter of the points, frame by frame, and the calibration, whose errors are common to all "
        "points and do not average out. The reference is taken as exact. RMS: residuals of all points.",
    )


def _expanded(u_mm: float | None) -> str:
    return numbers.um(None if u_mm is None else 2.0 * u_mm)


def _within(error_mm: float | None, u_mm: float | None) -> str:
    """Whether an error is within U; empty where either is not known."""
    if error_mm is None or u_mm is None or not np.isfinite(error_mm) or not np.isfinite(u_mm):
        return ""
    if abs(error_mm) <= 2.0 * u_mm:
        return "yes"
    return f"no, {numbers.fixed(abs(error_mm) / (2.0 * u_mm), 2)} U" if u_mm > 0.0 else "no"


def _summary(entries: tuple[MeasurementEntry, ...]) -> Table:
    columns = (
        Column("Capture", numeric=False),
        Column("Feature", numeric=False),
        Column("Quantity", numeric=False),
        Column("Value", "mm"),
        Column("u (k = 1)", "µm"),
        Column("Reference", "mm"),
        Column("Error", "mm"),
        Column("RMS", "mm"),
        Column("Form error", "mm"),
        Column("Coverage", "%"),
        Column("Points", "n"),
    )
    rows = []
    for entry in entries:
        label = _label(entry)
        m = entry.measurement
        if m is None:
            rows.append(Row((entry.capture, label, f"not measured: {entry.failure}"), "failed"))
            continue
        for i, (key, value) in enumerate(m.value.items()):
            first = i == 0
            head = (entry.capture, label) if first else ("", "")
            tail = (
                (numbers.mm(m.rms), numbers.mm(m.form_error), numbers.percent(m.coverage, 0), numbers.count(m.n_points))
                if first
                else ("", "", "", "")
            )
            rows.append(
                Row(
                    (
                        *head,
                        quantity(key),
                        numbers.mm(value),
                        numbers.um(m.uncertainty.get(key)),
                        numbers.mm(entry.reference.get(key)),
                        numbers.mm(entry.error.get(key), signed=True),
                        *tail,
                    ),
                    "plain" if first else "continued",
                )
            )
    return Table(
        "Measured features, with the final calibration.",
        columns,
        tuple(rows),
        "Error: value minus reference. u: standard uncertainty (k = 1) from the scatter of the points about the fit only; errors of "
        "the calibration are common to all points and not in it, so an error may well be larger than u. RMS: residuals of "
        "all points. Form error: their range without the outermost 0.5 % on either side.",
    )


def _comparisons(after: tuple[MeasurementEntry, ...], before: tuple[MeasurementEntry, ...]) -> list[Table]:
    """One table a kind of feature, a row for each quantity that has a reference."""
    earlier = {(e.capture, e.feature, e.name): e for e in before}
    kinds: dict[str, dict[str, list[tuple[MeasurementEntry, float | None]]]] = defaultdict(lambda: defaultdict(list))
    for entry in after:
        first = earlier.get((entry.capture, entry.feature, entry.name))
        for key in entry.error:
            kinds[entry.feature][key].append((entry, first.error.get(key) if first is not None else None))
    return [_comparison(kind, by_key, bool(before)) for kind, by_key in kinds.items()]


def _comparison(kind: str, by_key: dict[str, list[tuple[MeasurementEntry, float | None]]], with_before: bool) -> Table:
    columns = [
        Column("Quantity", numeric=False),
        Column("Capture", numeric=False),
        Column("Reference", "mm"),
        Column("Error before", "mm"),
        Column("Value after", "mm"),
        Column("Error after", "mm"),
        Column("Relative error", "%"),
        Column("Reduced by", "%"),
    ]
    rows = []
    for key, pairs in by_key.items():
        for i, (entry, error_before) in enumerate(pairs):
            assert entry.measurement is not None
            error, reference = entry.error[key], entry.reference[key]
            rows.append(
                Row(
                    (
                        quantity(key) if i == 0 else "",
                        entry.capture,
                        numbers.mm(reference),
                        numbers.mm(error_before, signed=True),
                        numbers.mm(entry.measurement.value[key]),
                        numbers.mm(error, signed=True),
                        numbers.percent(abs(error) / abs(reference) if reference else None, 4),
                        numbers.percent(_reduction(error_before, error), 2),
                    ),
                    "plain" if i == 0 else "continued",
                )
            )
        if len(pairs) > 1:
            mean_after = float(np.mean([abs(entry.error[key]) for entry, _ in pairs]))
            known = [abs(b) for _, b in pairs if b is not None]
            mean_before = float(np.mean(known)) if len(known) == len(pairs) else None
            relative = float(
                np.mean([abs(e.error[key] / e.reference[key]) for e, _ in pairs if e.reference[key]] or [np.nan])
            )
            rows.append(
                Row(
                    (
                        "",
                        "Average of |error|",
                        "",
                        numbers.mm(mean_before),
                        "",
                        numbers.mm(mean_after),
                        numbers.percent(relative, 4),
                        numbers.percent(_reduction(mean_before, mean_after), 2),
                    ),
                    "total",
                )
            )
    if not with_before:
        drop = {3, 7}
        columns = [
            Column(c.label.replace(" after", ""), c.unit, c.numeric) for i, c in enumerate(columns) if i not in drop
        ]
        rows = [Row(tuple(c for i, c in enumerate(r.cells) if i not in drop), r.kind) for r in rows]
    title = _KIND_TITLES.get(kind, kind)
    when = ": errors with the initial axis (before) and the optimised axis (after)" if with_before else ": errors"
    return Table(f"{title}{when}.", tuple(columns), tuple(rows))


def _reduction(before: float | None, after: float) -> float | None:
    """Share by which the magnitude of an error went down; negative where it grew."""
    return 1.0 - abs(after) / abs(before) if before else None
