"""Tables of ``rotaline reproduce`` in the terminal."""

import math

from rich.console import Console
from rich.table import Table

from rotaline.io.report.reproduction import Budget, Comparison, ComparisonTable, ComplexPartsSection, Reproduction

_COLOURS = {"better": "green", "equal": "default", "worse": "red", "none": "dim"}


def show_reproduction(reproduction: Reproduction) -> None:
    """Every table with the article's figures and ours, the budget, the rule of the verdicts, the seeds."""
    console = Console(width=150, highlight=False)
    for table in reproduction.tables():
        _show_table(console, table)
    if reproduction.complex_parts is not None:
        _show_complex_parts(console, reproduction.complex_parts)
    if reproduction.budget is not None:
        _show_budget(console, reproduction.budget)
    info = reproduction.info
    counts = ", ".join(f"{n} {name}" for name, n in reproduction.verdicts().items())
    console.print(f"By the default method: {counts}. {info.rule}", soft_wrap=True)
    seeds = ", ".join(f"{name} {seed}" for name, seed in info.seeds.items())
    console.print(
        f"Rig '{info.rig}', {info.image_size[0]} x {info.image_size[1]} px, {info.n_frames} frames; seeds: {seeds}; "
        f"{info.seconds:.0f} s; {info.machine}",
        style="dim",
        soft_wrap=True,
    )
    for text in info.warnings:
        console.print(f"not done: {text}", style="red", markup=False, soft_wrap=True)


def _show_table(console: Console, table: ComparisonTable) -> None:
    shown = Table(title=f"{table.place}: {table.title}", title_justify="left")
    for name in ("", "", "article", "article's method", "", "default method", ""):
        shown.add_column(name, justify="left" if not name else "right")
    for row in table.rows:
        for name, column, cell in zip((row.name, *[""] * len(row.cells)), table.columns, row.cells, strict=False):
            shown.add_row(
                name,
                column,
                figure_text(cell, cell.article),
                figure_text(cell, cell.by_article_method),
                _verdict(cell.verdict_article_method),
                figure_text(cell, cell.by_default_method),
                _verdict(cell.verdict_default_method),
            )
        if len(table.columns) > 1:
            shown.add_section()
    console.print(shown)
    if table.text:
        console.print(table.text, style="dim", soft_wrap=True)


def figure_text(cell: Comparison, value: float | None) -> str:
    """A figure with the decimals that are worth showing; a dash where there is none."""
    if value is None:
        return "–"
    return f"{value:.3e}" if cell.digits is None else f"{value:.{cell.digits}f}"


def _verdict(verdict: str) -> str:
    return "" if verdict == "none" else f"[{_COLOURS[verdict]}]{verdict}[/]"


def _show_complex_parts(console: Console, section: ComplexPartsSection) -> None:
    shown = Table(title="Section 6.3, figure 16: parts with small details, measured against true", title_justify="left")
    for name in ("part", "detail"):
        shown.add_column(name)
    for name in ("true height / mm", "measured / mm", "deviation, RMS / mm", "resolved"):
        shown.add_column(name, justify="right")
    for part in section.parts:
        shown.add_row(
            part.title, f"whole surface, {100 * part.coverage:.0f} % covered", "", "", f"{part.rms_mm:.4f}", ""
        )
        for detail in part.details:
            heights = (f"{detail.height_mm:.3f}", f"{detail.measured_height_mm:.3f}")
            shown.add_row("", detail.name, *heights, f"{detail.rms_mm:.4f}", "yes" if detail.resolved else "no")
        shown.add_section()
    console.print(shown)
    console.print(section.resolved_rule, style="dim", soft_wrap=True)


def _show_budget(console: Console, budget: Budget) -> None:
    shown = Table(title="Budget: one error of the rig at a time", title_justify="left")
    shown.add_column("error of the rig")
    shown.add_column("setting", justify="right")
    for title in budget.titles.values():
        shown.add_column(title, justify="right")
    for source in budget.sources:
        for number, level in enumerate(source.levels):
            figures = [level.figures.get(key, math.nan) for key in budget.titles]
            texts = ["–" if math.isnan(figure) else f"{figure:.4f}" for figure in figures]
            shown.add_row(source.title if number == 0 else "", f"{level.setting:g} {source.unit}", *texts)
        shown.add_section()
    console.print(shown)
    for source in budget.sources:
        console.print(f"{source.title}: {source.text}", soft_wrap=True)
    console.print(budget.text, style="dim", soft_wrap=True)
