"""Scans, surfaces and fitted features on the page."""

from collections.abc import Sequence

import numpy as np

from rotaline.io.report import numbers
from rotaline.io.report.contents import CloudSummary, FittedPoints, ReportContents, StageWarning, SurfaceSummary
from rotaline.io.report.figures import features as feature_figures
from rotaline.io.report.figures import scan as figures
from rotaline.io.report.page import Block, Column, Gallery, Heading, Level, Paragraph, Row, Section, Table, picture
from rotaline.io.report.sections.overlays import overlay_blocks
from rotaline.io.report.sections.results import quantity
from rotaline.io.report.warnings import warnings_of
from rotaline.io.results import MeasurementEntry
from rotaline.metrology.model import FeatureMeasurement


def scan_section(contents: ReportContents, warnings: tuple[StageWarning, ...]) -> Section:
    """The clouds: counts, pictures, stripes in the frames."""
    mine = warnings_of("scan", warnings) + warnings_of("stripe", warnings)
    clouds = contents.clouds
    if not clouds:
        return Section("scan", "Scans", "Scans", warnings=mine, missing="Nothing was scanned.")
    judgement, level = _judge(clouds)
    blocks: list[Block] = [_clouds(clouds)]
    for scan in clouds:
        blocks.append(Heading(scan.folder))
        if len(scan.cloud) == 0:
            blocks.append(Paragraph("This cloud has no points."))
        else:
            blocks.append(_cloud_pictures(scan, contents))
        blocks += overlay_blocks(contents, "scan", scan.folder) + overlay_blocks(contents, "stripe", scan.folder)
    return Section("scan", "Scans", "Scans", judgement, level, mine, tuple(blocks))


def surface_section(contents: ReportContents, warnings: tuple[StageWarning, ...]) -> Section:
    """The meshes from several viewpoints."""
    mine = warnings_of("surface", warnings)
    surfaces = contents.surfaces
    if not surfaces:
        return Section("surface", "Surfaces", "Surfaces", warnings=mine, missing="No surfaces were reconstructed.")
    made = [s for s in surfaces if not s.failure and len(s.triangles)]
    text = (
        f"{len(made)} of {numbers.plural(len(surfaces), 'surface')} reconstructed. A surface is for looking at and for comparison "
        "with a model; sizes are measured in the points."
    )
    blocks: list[Block] = []
    for surface in surfaces:
        blocks.append(Heading(surface.folder))
        blocks += _surface(surface)
    return Section(
        "surface", "Surfaces", "Surfaces", text, "none" if len(made) == len(surfaces) else "fair", mine, tuple(blocks)
    )


def feature_section(contents: ReportContents, warnings: tuple[StageWarning, ...]) -> Section:
    """The fits with their residuals."""
    entries = contents.measurements
    if not entries:
        return Section("fits", "Feature fits", "Fits", missing="No features were fitted.")
    fitted = {(f.capture, f.feature, f.name): f for f in contents.fitted_points}
    blocks: list[Block] = []
    for entry in entries:
        blocks += _fit(entry, fitted.get((entry.capture, entry.feature, entry.name)))
    found = [e.measurement for e in entries if e.measurement is not None]
    text = f"{len(found)} of {numbers.plural(len(entries), 'feature')} fitted."
    if found:
        worst = max((m.rms for m in found if np.isfinite(m.rms)), default=float("nan"))
        text += (
            f" The residuals reach {numbers.um(worst)} µm RMS at most. Random residuals are noise; an orderly pattern is form, "
            "calibration, or a wrong surface among the points."
        )
    level: Level = "none" if len(found) == len(entries) else "fair" if found else "poor"
    return Section("fits", "Feature fits", "Fits", text, level, (), tuple(blocks))


def _judge(clouds: tuple[CloudSummary, ...]) -> tuple[str, Level]:
    points = sum(c.n_points for c in clouds)
    frames = sum(c.n_frames for c in clouds)
    without = sum(c.n_frames_without_stripe for c in clouds)
    text = (
        f"{numbers.plural(points, 'point')} from {numbers.plural(frames, 'frame')} in {numbers.plural(len(clouds), 'scan')}; "
        f"{without} frames without a stripe."
    )
    if any(c.n_points == 0 for c in clouds):
        return text, "poor"
    return text, "good" if without <= 0.02 * frames else "fair"


def _clouds(clouds: tuple[CloudSummary, ...]) -> Table:
    rows = []
    for c in clouds:
        points = c.cloud.points_table[np.isfinite(c.cloud.points_table).all(axis=1)]
        low, high = (
            (points.min(axis=0), points.max(axis=0)) if len(points) else (np.full(3, np.nan), np.full(3, np.nan))
        )
        u = c.cloud.u_mm[np.isfinite(c.cloud.u_mm)]
        rows.append(
            Row(
                (
                    c.folder,
                    numbers.count(c.n_points),
                    numbers.count(c.n_frames),
                    numbers.count(c.n_frames_without_stripe),
                    *(
                        f"{numbers.fixed(float(a), 1)} … {numbers.fixed(float(b), 1)}"
                        for a, b in zip(low, high, strict=True)
                    ),
                    numbers.um(float(np.median(u)) if len(u) else None),
                )
            )
        )
    return Table(
        "Clouds of points in the table frame (z on the rotation axis, up).",
        (
            Column("Capture", numeric=False),
            Column("Points", "n"),
            Column("Frames", "n"),
            Column("Without stripe", "n"),
            Column("x", "mm"),
            Column("y", "mm"),
            Column("z", "mm"),
            Column("Median u (k = 1)", "µm"),
        ),
        tuple(rows),
        "u: standard uncertainty (k = 1) of a single point along its ray, from the stripe's noise only.",
    )


def _cloud_pictures(scan: CloudSummary, contents: ReportContents) -> Gallery:
    table_seen = contents.calibration is not None and contents.calibration.table_seen
    thinned = ""
    if len(scan.cloud) < scan.n_points:
        thinned = f" {numbers.count(len(scan.cloud))} of {numbers.count(scan.n_points)} points are drawn."
    views = picture(
        lambda: figures.cloud_views(scan.cloud, table_seen),
        f"{scan.folder}: the cloud from four viewpoints, coloured by height.{thinned} Doubled or torn surfaces are a sign of a wrong "
        "axis or angle; single points off the surface are reflections.",
        "full",
        "png",
    )
    if scan.folder in {c.folder for c in contents.captures if c.role == "artifact"}:
        return Gallery((views,))
    return Gallery(
        (
            views,
            picture(
                lambda: figures.cloud_attributes(scan.cloud, table_seen),
                f"{scan.folder}: dark regions returned little light, and uncertain points are those with a dim, wide or slanting "
                "stripe; where u from the calibration is known, it is common to neighbouring points and does not average out; "
                "the table angle shows which frames saw a region.",
                "full",
                "png",
            ),
            picture(
                lambda: figures.points_by_frame(scan.cloud, scan.n_points),
                f"{scan.folder}: points of each frame. Gaps are frames without a stripe; sudden drops are shadows, gloss or a "
                "wrong exposure.",
            ),
        )
    )


def _surface(surface: SurfaceSummary) -> list[Block]:
    if surface.failure:
        return [Paragraph(f"No surface: {surface.failure}")]
    vertices, triangles = surface.vertices_table, surface.triangles
    if len(triangles) == 0:
        return [Paragraph("This surface has no triangles.")]
    corners = vertices[triangles]
    with np.errstate(invalid="ignore"):
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    text = (
        f"{numbers.plural(len(vertices), 'vertex', 'vertices')}, {numbers.plural(len(triangles), 'triangle')}, area "
        f"{numbers.fixed(float(np.nansum(areas)) / 100.0, 1)} cm²."
    )
    return [
        Gallery(
            (
                picture(
                    lambda: figures.mesh_views(vertices, triangles),
                    f"{surface.folder}: the surface from four viewpoints (as the article's figure 16). {text} Faces seen from their "
                    "inner side are brownish; holes are places that no frame saw.",
                    "full",
                    "png",
                ),
            )
        )
    ]


def _fit(entry: MeasurementEntry, fitted: FittedPoints | None) -> list[Block]:
    name = f" – {entry.name}" if entry.name and entry.name != entry.feature else ""
    blocks: list[Block] = [Heading(f"{entry.capture}: {entry.feature}{name}")]
    m = entry.measurement
    if m is None:
        return [*blocks, Paragraph(f"Not measured: {entry.failure}")]
    values = ", ".join(
        f"{quantity(key)} {numbers.mm(value)} mm"
        + (f" (error {numbers.mm(entry.error[key], signed=True)} mm)" if key in entry.error else "")
        for key, value in m.value.items()
    )
    blocks.append(
        Paragraph(
            f"{values[:1].upper()}{values[1:]}. {numbers.plural(m.n_points, 'point')}, RMS {numbers.mm(m.rms)} mm, form error "
            f"{numbers.mm(m.form_error)} mm, {numbers.percent(m.coverage, 0)} % of the feature covered."
        )
    )
    if m.line_width_correction:
        added = ", ".join(
            f"{quantity(key)} {numbers.um(mm, signed=True)} µm" for key, mm in m.line_width_correction.items()
        )
        blocks.append(
            Paragraph(
                f"In these values, for the width of the laser line and the blur of the lens: {added}. Stripes on balls and rods are seen "
                "a little inside the surface; residuals and geometry below are those of the fit, before that."
            )
        )
    blocks += [Paragraph(f"Doubtful: {text}") for text in m.warnings]
    if fitted is not None and len(fitted.points_table):
        blocks.append(
            Gallery(
                (
                    picture(
                        lambda: feature_figures.fit(m, fitted),
                        f"{entry.capture}, {entry.feature}: residuals of single points, charted over the feature (where there are "
                        "enough points as means of small cells, which show what the noise hides), and their distribution (red: ± RMS, "
                        "dashed: mean; values beyond the scale stand in the outermost bars). Stripes along one direction are the axis or "
                        "the laser plane; a patch of one colour is form or a foreign surface.",
                        "full",
                        "png",
                    ),
                )
            )
        )
    if m.geometry:
        blocks.append(Paragraph(_geometry(m)))
    return blocks


def _geometry(measurement: FeatureMeasurement) -> str:
    def text(value: float | Sequence[float]) -> str:
        if isinstance(value, Sequence):
            return "(" + ", ".join(numbers.fixed(float(x), 4) for x in value) + ")"
        return numbers.fixed(float(value), 4)

    parts = (f"{key.replace('_', ' ')} {text(value)}" for key, value in measurement.geometry.items())
    return f"Geometry of the fit (table frame, lengths in mm): {', '.join(parts)}."
