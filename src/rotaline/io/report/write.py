"""Writing the report: one HTML file that needs nothing else."""

from pathlib import Path

from rotaline.io.files import whole_file
from rotaline.io.report.contents import ReportContents, StageWarning
from rotaline.io.report.page import Section, finished
from rotaline.io.report.render import render_template
from rotaline.io.report.sections import (
    artifact,
    axis,
    camera,
    drift,
    joint,
    laser_plane,
    parts,
    results,
    run,
    session,
    verdict,
)
from rotaline.io.report.warnings import collect_warnings, grouped


def write_report(contents: ReportContents, path: Path) -> None:
    """Write the report as one self-contained HTML file, whole or not at all.

    Parameters
    ----------
    contents : ReportContents   what the run found
    path : Path   the file, usually ``report.html`` in the folder of results; an older one is replaced

    Raises
    ------
    OutputError
        If the file cannot be written: no space, no permission; an older report is then left as it was.
    """
    page = render_report(contents)
    with whole_file(path) as part:
        part.write_text(page, encoding="utf-8")


def render_report(contents: ReportContents) -> str:
    """The report as HTML text."""
    warnings = collect_warnings(contents)
    return render_template(
        "report.html.jinja",
        ("report.css", "verdict.css"),
        run=contents.run,
        verdict=verdict.verdict_block(contents.verdict) if contents.verdict is not None else None,
        serious=grouped(w for w in warnings if w.serious),
        ordinary=grouped(w for w in warnings if not w.serious),
        key_figures=results.key_figures(contents),
        sections=finished(_sections(contents, warnings)),
    )


def _sections(contents: ReportContents, warnings: tuple[StageWarning, ...]) -> list[Section]:
    """The sections in their order; the first one holds the measured features."""
    if contents.estimated_jointly:
        plane = [laser_plane.plane_section(contents, warnings)]
        axes = [axis.section(contents, warnings), joint.section(contents, warnings)]
    else:
        plane = [laser_plane.plane_section(contents, warnings), laser_plane.cross_ratio_section(contents, warnings)]
        axes = [axis.section(contents, warnings), artifact.section(contents, warnings)]
    return [
        results.section(contents),
        session.section(contents, warnings),
        camera.section(contents, warnings),
        *plane,
        *axes,
        parts.scan_section(contents, warnings),
        *([drift.section(contents, warnings)] if contents.drift else []),
        parts.surface_section(contents, warnings),
        parts.feature_section(contents, warnings),
        run.section(contents.run),
    ]
