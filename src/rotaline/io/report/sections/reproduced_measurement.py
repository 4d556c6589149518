"""Section 6 of the article beside ours, and the budget: stepped cylinder, parts, parts with small details, errors of the rig."""

from rotaline.io.report import numbers
from rotaline.io.report.figures import budget as budget_figures
from rotaline.io.report.figures import comparison as figures
from rotaline.io.report.figures import complex_parts as part_figures
from rotaline.io.report.figures import features as feature_figures
from rotaline.io.report.page import Block, Column, Gallery, Heading, Paragraph, Picture, Row, Section, Table, picture
from rotaline.io.report.reproduction import (
    Budget,
    ComparisonTable,
    ComplexPartResult,
    ComplexPartsSection,
    PartsSection,
    Reproduction,
)
from rotaline.io.report.sections.comparison import NOT_DONE, levels_table, reproducing_table, table_blocks


def measurement_sections(reproduction: Reproduction) -> list[Section]:
    """Sections 6.1 to 6.3 of the article, and the budget."""
    return [
        _stepped(reproduction),
        _parts(reproduction.parts),
        _complex_parts(reproduction.complex_parts),
        _budget(reproduction.budget),
    ]


def _stepped(reproduction: Reproduction) -> Section:
    title, short = "Section 6.1: diameters of the stepped cylinder", "6.1 Stepped"
    tables = [t for t in (reproduction.stepped, reproduction.stepped_disturbed) if t is not None]
    blocks: list[Block] = []
    for table in tables:
        lengths = [(table, i) for i in _length_columns(table)]
        blocks += [*table_blocks(table)]
        if lengths:
            blocks.append(Gallery((_column_picture(table, lengths),)))
    return Section("stepped", title, short, blocks=tuple(blocks), missing="" if tables else NOT_DONE)


def _column_picture(table: ComparisonTable, lengths: list[tuple[ComparisonTable, int]]) -> Picture:
    place = table.place[:1].lower() + table.place[1:]
    caption = f"The article's {place}: magnitudes of the diameter errors in µm, before and after the optimisation of the axis."
    return picture(lambda: figures.columns(lengths), caption)


def _parts(section: PartsSection | None) -> Section:
    title, short = "Section 6.2: ball, cylinder, groove", "6.2 Parts"
    if section is None:
        return Section("parts", title, short, missing=NOT_DONE)
    blocks: list[Block] = [block for table in section.tables for block in table_blocks(table)]
    errors = [
        (t, i) for t in section.tables for i, name in enumerate(t.columns) if "error" in name and "relative" not in name
    ]
    if errors:
        blocks.append(
            Gallery(
                (
                    picture(
                        lambda: figures.columns(errors),
                        "Magnitudes of the errors of the article's tables 3 to 5 (ball, cylinder, groove), in µm, in five positions and on average.",
                    ),
                )
            )
        )
    fitted = {(f.capture, f.feature, f.name): f for f in section.fitted}
    for entry in section.entries:
        points = fitted.get((entry.capture, entry.feature, entry.name))
        measurement = entry.measurement
        if measurement is None or points is None or len(points.points_table) == 0:
            continue
        blocks += [
            Heading(f"{_capital(entry.feature)}, first position"),
            Gallery(
                (
                    picture(
                        lambda m=measurement, p=points: feature_figures.fit(m, p),  # type: ignore[misc]
                        f"As the article's figure 15: points of the fit (default method), coloured by their distance from it, unrolled or along the profile, "
                        f"and their distribution, in µm. {numbers.plural(measurement.n_points, 'point')}, RMS {numbers.um(measurement.rms)} µm. "
                        "Table frame, mm.",
                        "full",
                        "png",
                    ),
                )
            ),
        ]
    return Section("parts", title, short, blocks=tuple(blocks))


def _complex_parts(section: ComplexPartsSection | None) -> Section:
    title, short = "Section 6.3: parts with small details", "6.3 Complex"
    if section is None:
        return Section("complex-parts", title, short, missing=NOT_DONE)
    found = sum(d.resolved for p in section.parts for d in p.details)
    n = sum(len(p.details) for p in section.parts)
    judgement = f"{found} of {numbers.plural(n, 'detail')} resolved. {section.resolved_rule}"
    summary = Table(
        "Deviation of the measured surface from the true one, which the article could not measure.",
        (
            Column("Part", numeric=False),
            Column("Points", "n"),
            Column("Triangles", "n"),
            Column("Surface measured", "%"),
            Column("RMS", "µm"),
            Column("95 % within", "µm"),
            Column("Details resolved", "n"),
        ),
        tuple(
            Row(
                (
                    p.title,
                    numbers.count(p.n_points),
                    numbers.count(len(p.triangles)),
                    numbers.percent(p.coverage),
                    numbers.um(p.rms_mm),
                    numbers.um(p.p95_mm),
                    f"{sum(d.resolved for d in p.details)} of {len(p.details)}",
                )
            )
            for p in section.parts
        ),
    )
    blocks: list[Block] = [summary]
    for part in section.parts:
        blocks += _complex_part(part)
    return Section("complex-parts", title, short, judgement, blocks=tuple(blocks))


def _complex_part(part: ComplexPartResult) -> list[Block]:
    pictures = [
        picture(
            lambda: part_figures.photo_and_cloud(part),
            f"As the article's figure 16, {part.title}: a frame of the camera, and the cloud from three viewpoints, coloured by height. "
            f"{numbers.plural(part.n_points, 'point')}. Table frame, mm.",
            "full",
            "png",
        ),
        picture(
            lambda: part_figures.surface(part),
            f"{_capital(part.title)}: the measured surface from four viewpoints. Arrows mark the details of the table below where they are seen; red: "
            "not resolved. Holes are places that no frame saw.",
            "full",
            "png",
        ),
        picture(
            lambda: part_figures.deviation(part),
            f"{_capital(part.title)}: signed distance of the measured surface from the true one, in µm (outside positive; grey: nothing to compare "
            f"with). RMS {numbers.um(part.rms_mm)} µm, 95 % within {numbers.um(part.p95_mm)} µm.",
            "full",
            "png",
        ),
    ]
    for first in range(0, len(part.details), part_figures.DETAILS_A_ROW):
        pictures.append(
            picture(
                lambda n=first: part_figures.details(part, n),  # type: ignore[misc]
                f"{_capital(part.title)}: details close up, straight from outside; left the measured surface, right its deviation in the colours of the bar.",
                "full",
                "png",
            )
        )
    return [Heading(_capital(part.title)), Gallery(tuple(pictures)), *((_details(part),) if part.details else ())]


def _details(part: ComplexPartResult) -> Table:
    return Table(
        f"Details of the {part.title}: how far each stands out of its surroundings (negative: a hollow).",
        (
            Column("No."),
            Column("Detail", numeric=False),
            Column("True height", "mm"),
            Column("Measured height", "mm"),
            Column("RMS around it", "µm"),
            Column("Resolved", numeric=False),
            Column("Remark", numeric=False),
        ),
        tuple(
            Row(
                (
                    str(i + 1),
                    d.name,
                    numbers.fixed(d.height_mm, 3),
                    numbers.fixed(d.measured_height_mm, 3),
                    numbers.um(d.rms_mm),
                    "yes" if d.resolved else "no",
                    d.text,
                )
            )
            for i, d in enumerate(part.details)
        ),
    )


def _budget(budget: Budget | None) -> Section:
    title, short = "What limits the method: the errors of the rig, one at a time", "Budget"
    if budget is None:
        return Section("budget", title, short, missing=NOT_DONE)
    text: tuple[Block, ...] = (Paragraph(budget.text),) if budget.text else ()
    pictures = Gallery(
        (
            picture(
                lambda: budget_figures.responses(budget),
                "The figures that the article gives, in µm, over the setting of one error of the rig alone. Dashed: the article's figure, in the "
                "colour of its curve; ring: where the curve meets it.",
            ),
            picture(
                lambda: budget_figures.matrix(budget),
                "All figures under each error alone at the largest setting that was tried, magnitudes in µm; darker is larger. A column shows which "
                "error spoils a figure, a row what an error spoils.",
            ),
        )
    )
    return Section("budget", title, short, blocks=(*text, pictures, reproducing_table(budget), levels_table(budget)))


def _length_columns(table: ComparisonTable) -> list[int]:
    """Columns of lengths that have a figure in some row."""
    return [
        i
        for i in range(len(table.columns))
        if any(
            i < len(r.cells) and r.cells[i].unit == "mm" and r.cells[i].by_default_method is not None
            for r in table.rows
        )
    ]


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
