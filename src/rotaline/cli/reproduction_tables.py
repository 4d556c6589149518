"""Tables of ``rotaline reproduce`` in the terminal."""

from rich.console import Console
from rich.table import Table

from rotaline.io.report.reproduction import Budget, Comparison, ComparisonTable, Reproduction

_COLOURS = {"better": "green", "equal": "default", "worse": "red", "none": "dim"}


def show_reproduction(reproduction: Reproduction) -> None:
    """Every table with the article's figures and ours, the budget, the rule of the verdicts, the seeds."""
    console = Console(width=150, highlight=False)
    for table in reproduction.tables():
        _show_table(console, table)
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


def _show_budget(console: Console, budget: Budget) -> None:
    shown = Table(title="Budget: one error of the rig at a time", title_justify="left")
    shown.add_column("error of the rig")
    shown.add_column("setting", justify="right")
    for title in budget.titles.values():
        shown.add_column(title, justify="right")
    for source in budget.sources:
        for number, level in enumerate(source.levels):
            figures = [f"{level.figures[key]:.4f}" if key in level.figures else "–" for key in budget.titles]
            shown.add_row(source.title if number == 0 else "", f"{level.setting:g} {source.unit}", *figures)
        shown.add_section()
    console.print(shown)
    for source in budget.sources:
        console.print(f"{source.title}: {source.text}", soft_wrap=True)
    console.print(budget.text, style="dim", soft_wrap=True)
