"""The page of the reproduced article: one HTML file, made for paper too, that needs nothing else."""

from pathlib import Path

from rotaline.io.files import whole_file
from rotaline.io.report import numbers
from rotaline.io.report.contents import StageWarning
from rotaline.io.report.figures.comparison import verdict_bars
from rotaline.io.report.page import Block, Column, Gallery, KeyFigure, Row, Section, Table, finished, picture
from rotaline.io.report.render import render_template
from rotaline.io.report.reproduction import Reproduction, ReproductionInfo
from rotaline.io.report.sections.comparison import seeds_table, table_blocks
from rotaline.io.report.sections.reproduced_calibration import calibration_sections
from rotaline.io.report.sections.reproduced_measurement import measurement_sections
from rotaline.io.report.warnings import grouped


def write_reproduction(reproduction: Reproduction, path: Path) -> None:
    """Write the page as one self-contained HTML file, whole or not at all.

    Parameters
    ----------
    reproduction : Reproduction   the article's figures and ours
    path : Path   the file, usually ``reproduction.html``; an older one is replaced

    Raises
    ------
    OutputError
        If the file cannot be written: no space, no permission; an older page is then left as it was.
    """
    page = render_reproduction(reproduction)
    with whole_file(path) as part:
        part.write_text(page, encoding="utf-8")


def render_reproduction(reproduction: Reproduction) -> str:
    """The page as HTML text."""
    info = reproduction.info
    sections = [
        _claims(reproduction),
        *calibration_sections(reproduction),
        *measurement_sections(reproduction),
        _conditions(info),
    ]
    return render_template(
        "reproduction.html.jinja",
        ("report.css", "reproduction.css"),
        info=info,
        facts=_facts(info),
        warnings=grouped(StageWarning("report", text) for text in info.warnings),
        key_figures=_key_figures(reproduction),
        sections=finished(sections),
    )


def _facts(info: ReproductionInfo) -> dict[str, str]:
    width, height = info.image_size
    return {
        "Finished": info.finished_at,
        "Took": numbers.seconds(info.seconds),
        "Extent": "quick: smaller images, fewer frames" if info.quick else "full",
        "Rig": info.rig,
        "Images": f"{numbers.count(info.n_frames)} rendered, {width} x {height} px",
        "Seeds": ", ".join(f"{name} {seed}" for name, seed in info.seeds.items()) or numbers.MISSING,
        "Machine": info.machine,
        **info.versions,
    }


def _key_figures(reproduction: Reproduction) -> list[KeyFigure]:
    counts = reproduction.verdicts()
    total = sum(counts.values())
    labels = {"better": "better than the article", "equal": "equal to the article", "worse": "worse than the article"}
    return [
        KeyFigure(labels[verdict], numbers.count(n), f"of {numbers.count(total)} figures", "by the default method")
        for verdict, n in counts.items()
    ]


def _claims(reproduction: Reproduction) -> Section:
    blocks: tuple[Block, ...] = (
        *table_blocks(reproduction.claims),
        Gallery(
            (
                picture(
                    lambda: verdict_bars(reproduction.tables()),
                    "All figures that can be compared, table by table: how many of ours are better than the article's, equal, or worse.",
                ),
            )
        ),
    )
    return Section("claims", "The claims of the abstract", "Claims", reproduction.info.rule, blocks=blocks)


def _conditions(info: ReproductionInfo) -> Section:
    options = Table(
        "Where the options of the article's method differ from the default method.",
        (Column("Option", numeric=False), Column("Article's method", numeric=False), Column("Default", numeric=False)),
        tuple(Row((name, ours, default)) for name, (ours, default) in info.changed_options.items()),
    )
    return Section("conditions", "Options and seeds", "Seeds", blocks=(options, seeds_table(info.seeds)))
