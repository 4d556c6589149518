"""Section 6 and the abstract: the stepped cylinder before and after (table 2), ball, cylinder and groove (tables 3 to 5), the claims."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from rotaline.calibration.artifact import ArtifactCapture, optimise_axis
from rotaline.calibration.model import SystemCalibration
from rotaline.geometry.primitives import Line, unit
from rotaline.io.report.reproduction import Comparison, ComparisonTable, PartsSection, SensorSection, TableRow
from rotaline.pipeline.options import ARTICLE_OPTIONS, Options
from rotaline.pipeline.parts import artifact_sizes
from rotaline.pipeline.reproduce.article import (
    CLAIMED_REDUCTION_PERCENT,
    CLAIMED_RELATIVE_PERCENT,
    LARGE_CYLINDER,
    PART_TABLES,
    SMALL_CYLINDER,
    STEPPED_CYLINDER,
    STEPWISE_OPTIONS,
    PartTable,
)
from rotaline.pipeline.reproduce.experiments import Calibrations, system_of
from rotaline.pipeline.reproduce.plan import N_MOUNTS, PARTS, Part, mount_names
from rotaline.pipeline.reproduce.rows import average, error_figure, list_table, plain_figure, reduction_percent
from rotaline.pipeline.reproduce.workbench import Workbench
from rotaline.pipeline.summary import fitted_points
from rotaline.simulation.ideal.circles import TABLE_1
from rotaline.simulation.rig import Rig

_DIAMETERS = (
    ("diameter_small", "small cylinder", SMALL_CYLINDER),
    ("diameter_large", "large cylinder", LARGE_CYLINDER),
)
_COLUMNS = tuple(
    f"{name}, {what}"
    for _, name, _ in _DIAMETERS
    for what in ("error before / mm", "error after / mm", "reduced by / %")
)

Errors = dict[str, float]
"""Measured minus reference by quantity, mm; empty where the feature was not found."""


def stepped_table(bench: Workbench, found: Calibrations) -> ComparisonTable:
    """Table 2: errors of both diameters in five mounts, with the initial and the optimised axis."""
    rows = []
    for k, name in enumerate(mount_names()):
        article, initial = found.article[k], found.initial[k]
        errors = (
            _stepped(bench, name, system_of(article, initial=True), ARTICLE_OPTIONS, f"initial axis of {name}"),
            _stepped(bench, name, system_of(article), ARTICLE_OPTIONS, f"axis of {name}"),
            _stepped(bench, name, system_of(initial), STEPWISE_OPTIONS, f"initial axis of {name}, default"),
            _stepped(bench, name, system_of(found.together), STEPWISE_OPTIONS, "axis of all mounts"),
        )
        rows.append(TableRow(name, _before_and_after(k, *errors)))
    printed = [
        value
        for _, _, table in _DIAMETERS
        for value in (table.average_before_mm, table.average_after_mm, table.average_reduced_percent)
    ]
    rows.append(TableRow("Average", _averages(rows, printed)))
    text = (
        "Absolute errors against the true diameters. Before: by the article's method the axis through the circles' centres of the mount's own "
        "checkerboard, by the default method the axis that explains the images of that checkerboard best. After: the axis of the same "
        "mount, and the axis of all mounts. A rig whose initial axis is good leaves little to reduce; see the next table."
    )
    return ComparisonTable("Table 2", "Diameter errors of the stepped cylinder", _COLUMNS, tuple(rows), text)


def disturbed_table(bench: Workbench, found: Calibrations, rig: Rig) -> ComparisonTable:
    """Table 2 for the first mount, with the initial axis disturbed as in table 1: starts as poor as the article's."""
    name = mount_names()[0]
    rows = []
    for case, deltas in TABLE_1.items():
        errors = []
        for parts, options, by in (
            (found.article[0], ARTICLE_OPTIONS, "article"),
            (found.together, STEPWISE_OPTIONS, "default"),
        ):
            system = system_of(parts, initial=True)
            start = replace(system, rotation_axis_camera=_disturbed(rig, *deltas))
            assert parts.artifact is not None
            captures = [
                ArtifactCapture(m.name, m.frame_names, m.angles_rad, m.features_camera, m.frame_reasons)
                for m in parts.artifact.mounts
            ]
            axis = optimise_axis(
                start.rotation_axis_camera, system.turn_sense, captures, STEPPED_CYLINDER, options.artifact
            ).axis_camera
            end = replace(system, rotation_axis_camera=axis)
            errors += [
                _stepped(bench, name, start, options, f"{case}, {by}"),
                _stepped(bench, name, end, options, f"{case} optimised, {by}"),
            ]
        rows.append(TableRow(case, _before_and_after(None, *errors)))
    rows.append(TableRow("Average", _averages(rows, [None] * len(_COLUMNS))))
    text = (
        "The first mount again. The axis starts from the true one, disturbed by the deviations of table 1: as far off as the article's "
        "checkerboard left it. The article has no such table; its averages of table 2 are compared in the claims."
    )
    return ComparisonTable(
        "Table 2, disturbed as in table 1", "Diameter errors from a poor initial axis", _COLUMNS, tuple(rows), text
    )


def _disturbed(rig: Rig, delta_pa: Sequence[float], delta_pb: Sequence[float]) -> Line:
    height = STEPPED_CYLINDER.height_small + STEPPED_CYLINDER.height_large
    ends = rig.camera_from_base.apply(np.array([delta_pa, np.array([0.0, 0.0, height]) + delta_pb], dtype=float))
    return Line(ends[0], unit(ends[1] - ends[0]))


def _stepped(bench: Workbench, mount: str, system: SystemCalibration, options: Options, by: str) -> Errors:
    sizes = artifact_sizes(STEPPED_CYLINDER)
    return bench.measure(f"stepped-{mount}", "stepped-cylinder", sizes, system, options, by).error


def _before_and_after(k: int | None, *errors: Errors) -> tuple[Comparison, ...]:
    """Six cells from the errors before and after by the article's method, before and after by the default method."""
    cells: list[Comparison] = []
    for key, name, table in _DIAMETERS:
        b1, a1, b2, a2 = (abs(e[key]) if key in e else None for e in errors)
        theirs = (None, None, None) if k is None else (table.before_mm[k], table.after_mm[k], table.reduced_percent[k])
        cells += [
            error_figure(f"{name}, error before", "mm", theirs[0], b1, b2),
            error_figure(f"{name}, error after", "mm", theirs[1], a1, a2),
            error_figure(
                f"{name}, reduced by",
                "%",
                theirs[2],
                reduction_percent(b1, a1),
                reduction_percent(b2, a2),
                digits=2,
                more_is_better=True,
            ),
        ]
    return tuple(cells)


def _averages(rows: Sequence[TableRow], printed: Sequence[float | None]) -> tuple[Comparison, ...]:
    """Means of the errors; the reduction of the means, as the article does it."""
    cells: list[Comparison] = []
    for i, theirs in enumerate(printed):
        column = [row.cells[i] for row in rows]
        if column[0].unit != "%":
            cells.append(average(column, theirs))
            continue
        before, after = cells[i - 2], cells[i - 1]
        reduced = (
            reduction_percent(before.by_article_method, after.by_article_method),
            reduction_percent(before.by_default_method, after.by_default_method),
        )
        cells.append(error_figure(column[0].quantity, "%", theirs, *reduced, digits=2, more_is_better=True))
    return tuple(cells)


def parts_section(bench: Workbench, found: Calibrations) -> PartsSection:
    """Tables 3 to 5 and figure 15: ball, cylinder and groove in five positions."""
    article, ours = system_of(found.article[0]), system_of(found.together)
    tables, firsts, clouds = [], [], {}
    for part, table in zip(PARTS, PART_TABLES, strict=True):
        reference = {part.key: table.reference_mm}
        rows, failures = [], []
        for k in range(N_MOUNTS):
            capture = f"{part.name}-{k + 1}"
            pair = (
                bench.measure(capture, part.feature, reference, article, ARTICLE_OPTIONS, "axis of W1"),
                bench.measure(capture, part.feature, reference, ours, STEPWISE_OPTIONS, "axis of all mounts"),
            )
            values = [e.measurement.value[part.key] if e.measurement else None for e in pair]
            rows.append(TableRow(str(k + 1), _part_cells(table, k, values)))
            failures += [f"Position {k + 1}: {e.failure}" for e in pair if e.measurement is None]
            if k == 0 and pair[1].measurement is not None:
                firsts.append(pair[1])
                clouds[capture] = bench.cloud(capture, ours, STEPWISE_OPTIONS)
        columns = tuple(f"{c.quantity} / {c.unit}" for c in rows[0].cells)
        rows.append(TableRow("Average", tuple(average([r.cells[i] for r in rows]) for i in range(len(columns)))))
        tables.append(
            ComparisonTable(table.place, table.title, columns, tuple(rows), _part_text(part, table, failures))
        )
    return PartsSection(tuple(tables), tuple(firsts), fitted_points(firsts, clouds))


def _part_text(part: Part, table: PartTable, failures: Sequence[str]) -> str:
    return (
        f"{table.reference_mm:.3f} mm is the true {part.key}. Errors without sign. By the article's method with the axis of W1, by the default "
        "method with the axis of all mounts." + "".join(f" {text}" for text in dict.fromkeys(failures))
    )


def _part_cells(table: PartTable, k: int, values: Sequence[float | None]) -> tuple[Comparison, ...]:
    errors = [None if v is None else abs(v - table.reference_mm) for v in values]
    relative = [None if e is None else 100.0 * e / table.reference_mm for e in errors]
    return (
        plain_figure(table.quantity, "mm", table.measured_mm[k], *values),
        error_figure("error", "mm", table.error_mm[k], *errors),
        plain_figure("relative error", "%", table.relative_percent[k], *relative),
    )


def claims_table(
    sensor: SensorSection | None,
    mounts: ComparisonTable | None,
    stepped: ComparisonTable | None,
    disturbed: ComparisonTable | None,
    parts: PartsSection | None,
) -> ComparisonTable:
    """What abstract and conclusions state; what could not be done has no figure of ours."""
    figures: list[Comparison] = []
    if sensor is not None:
        figures.append(replace(sensor.table.rows[2].cells[0], quantity="sensor: interval RMSE after cross-ratios"))
    if mounts is not None:
        figures.append(replace(mounts.rows[-1].cells[1], quantity="mean distance of feature points after, average"))
    if stepped is not None:
        averages = stepped.rows[-1].cells
        figures += [replace(averages[i], quantity=f"{averages[i].quantity}, average") for i in (1, 4)]
        figures += [replace(averages[i], quantity=f"{averages[i].quantity}, average") for i in (2, 5)]
    if disturbed is not None:
        averages = disturbed.rows[-1].cells
        for i, (_, name, table) in zip((2, 5), _DIAMETERS, strict=True):
            figures.append(
                error_figure(
                    f"{name}, reduced by, from the axes of table 1",
                    "%",
                    table.average_reduced_percent,
                    averages[i].by_article_method,
                    averages[i].by_default_method,
                    digits=2,
                    more_is_better=True,
                )
            )
    if parts is not None:
        figures.append(_largest_relative(parts.tables))
    text = (
        f"The abstract claims a reduction of the diameter error by more than {CLAIMED_REDUCTION_PERCENT:.0f} % on average, and relative errors below "
        f"{CLAIMED_RELATIVE_PERCENT:.2f} %."
    )
    return list_table("Abstract and conclusions", "Claims", figures, text)


def _largest_relative(tables: Sequence[ComparisonTable]) -> Comparison:
    cells = [row.cells[2] for table in tables for row in table.rows[:-1]]

    def largest(which: Callable[[Comparison], float | None]) -> float | None:
        values = [which(cell) for cell in cells]
        known = [v for v in values if v is not None]
        return max(known) if len(known) == len(values) else None

    return error_figure(
        "largest relative error of ball, cylinder, groove",
        "%",
        largest(lambda c: c.article),
        largest(lambda c: c.by_article_method),
        largest(lambda c: c.by_default_method),
    )
