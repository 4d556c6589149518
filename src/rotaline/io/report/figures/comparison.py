"""Pictures of the article's figures beside ours: verdicts, tables as bars, curves of convergence."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator

from rotaline.io.report import style
from rotaline.io.report.figures.axis import across
from rotaline.io.report.reproduction import Comparison, ComparisonTable, InitialAxisSection, Verdict

ARTICLE, ARTICLE_METHOD, DEFAULT_METHOD = style.GREY, style.AMBER, style.BLUE
VERDICT_COLOURS: dict[Verdict, str] = {"better": style.GREEN, "equal": style.SKY, "worse": style.VERMILION}
_FLOOR_MM = 1e-15


def verdict_bars(tables: Sequence[ComparisonTable]) -> Figure:
    """How many figures of each table are better, equal and worse, by the article's method and by the default one."""
    compared = [t for t in tables if any(c.verdict_default_method != "none" for c in t.comparisons())]
    figure = style.new_figure(style.FULL_INCH, 0.85 + 0.21 * max(1, len(compared)))
    left, right = figure.subplots(1, 2, sharey=True)
    at = np.arange(len(compared))
    sides: tuple[tuple[Axes, str, Callable[[Comparison], Verdict]], ...] = (
        (left, "The article's method", lambda c: c.verdict_article_method),
        (right, "The default method", lambda c: c.verdict_default_method),
    )
    for ax, title, verdict_of in sides:
        start = np.zeros(len(compared))
        for verdict, colour in VERDICT_COLOURS.items():
            n = np.array([sum(verdict_of(c) == verdict for c in t.comparisons()) for t in compared], dtype=float)
            ax.barh(at, n, 0.62, left=start, color=colour, label=verdict)
            for y, (x, count) in enumerate(zip(start, n, strict=True)):
                if count:
                    ax.text(x + count / 2, y, f"{count:.0f}", ha="center", va="center", fontsize=7.5, color="white")
            start += n
        style.style_axes(ax, title, "figures")
        ax.grid(False, axis="y")
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    left.set_yticks(at, [_place(t) for t in compared])
    left.invert_yaxis()
    handles, labels = left.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def _place(table: ComparisonTable) -> str:
    return table.place if len(table.place) <= 36 else f"{table.place[:35]}…"


def columns(panels: Sequence[tuple[ComparisonTable, int]]) -> Figure:
    """Columns of tables, row by row: the magnitude in the article, by its method and by the default method."""
    figure = style.new_figure(style.FULL_INCH, 2.8)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    series: tuple[tuple[str, str, str, Callable[[Comparison], float | None]], ...] = (
        ("article", ARTICLE, "s", lambda c: c.article),
        ("ours, the article's method", ARTICLE_METHOD, "D", lambda c: c.by_article_method),
        ("ours, default method", DEFAULT_METHOD, "o", lambda c: c.by_default_method),
    )
    for ax, (table, column) in zip(axes, panels, strict=True):
        rows = [r for r in table.rows if len(r.cells) > column]
        at = np.arange(len(rows))
        everything = []
        for shift, (label, colour, marker, value_of) in zip((-0.12, 0.0, 0.12), series, strict=True):
            found = np.abs(np.array([_in_um(r.cells[column], value_of) for r in rows], dtype=float))
            if not np.isfinite(found).any():
                continue
            ax.plot(at + shift, found, marker, color=colour, markersize=5.5, markeredgewidth=0, label=label)
            everything.append(found)
        unit = next((r.cells[column].unit for r in rows if r.cells[column].unit), "")
        title = table.columns[column].split(" / ")[0]
        title = title if len(panels) > 3 else f"{table.place}: {title}"
        style.style_axes(ax, title, "", f"[{'µm' if unit == 'mm' else unit}]" if ax is axes[0] else "")
        style.log_axis(ax, np.concatenate([np.zeros(0), *everything]))
        ax.set_xlim(-0.5, len(rows) - 0.5)
        ax.set_xticks(at, [r.name.replace("Average", "mean") for r in rows])
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def _in_um(comparison: Comparison, value_of: Callable[[Comparison], float | None]) -> float:
    value = value_of(comparison)
    if value is None:
        return float("nan")
    return value * 1e3 if comparison.unit == "mm" else value


def convergence(
    panels: Mapping[str, Mapping[str, Float[np.ndarray, " _"]]], article_mm: tuple[float, float] | None
) -> Figure:
    """Mean distance after each iteration, one panel a method, one curve a start (figures 12 and 14b of the article).

    Parameters
    ----------
    panels : titles to curves, curves by name, mm
    article_mm : the lowest and the highest value at which the article's curves end
    """
    figure = style.new_figure(style.FULL_INCH, 3.2)
    axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
    lowest = [float(np.nanmin(h)) for curves in panels.values() for h in curves.values() if len(h)]
    many_decades = bool(lowest) and min(lowest) < 1e-5
    scale, unit = (1.0, "mm") if many_decades else (1e3, "µm")
    for ax, (title, curves) in zip(axes, panels.items(), strict=True):
        if article_mm is not None:
            low, high = (v * scale for v in article_mm)
            label = f"article, {low:.4g} {unit}" if low == high else f"article, {low:.4g} to {high:.4g} {unit}"
            if low == high:
                ax.axhline(low, color=style.GREY, lw=1.0, ls="--", label=label)
            else:
                ax.axhspan(low, high, color=style.LIGHT, label=label)
        for i, (name, history) in enumerate(curves.items()):
            drawn = np.maximum(history, _FLOOR_MM) * scale
            colour = style.series_colour(i)
            ax.plot(np.arange(len(drawn)), drawn, ".-", color=colour, lw=1.1, markersize=4, label=name)
        ax.set_yscale("log")
        style.style_axes(ax, title, "iteration", f"mean distance, eq. (14) [{unit}]" if ax is axes[0] else "")
        if many_decades:
            ax.yaxis.set_major_locator(LogLocator(numticks=9))
        else:
            style.log_axis(ax, np.concatenate([np.zeros(0), *curves.values()]) * scale)
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    style.legend(axes[0], loc="upper right", ncols=2)
    return figure


def centres_and_truth(section: InitialAxisSection) -> Figure:
    """Circle centres and the fitted axis, seen along the true axis, which is the origin; mean radii of the offsets by height."""
    figure = style.new_figure(style.FULL_INCH, 3.2)
    ax, ax_height = figure.subplots(1, 2)
    true, fitted = section.true_axis_camera, section.axis.axis_camera
    u, w = across(true)
    centres = section.axis.circle_centres_camera
    offset = centres[np.isfinite(centres).all(axis=1)] - true.point
    if len(offset) == 0:
        for empty in (ax, ax_height):
            style.nothing_to_draw(empty, "no circle was fitted")
        return figure
    height = offset @ true.direction
    height -= height.min()
    low = (true.point + (offset @ true.direction).min() * true.direction - fitted.point) @ fitted.direction
    along = low + np.linspace(0.0, float(height.max()), 2) * float(np.sign(fitted.direction @ true.direction))
    line = fitted.point + along[:, None] * fitted.direction - true.point
    shown = ax.scatter(offset @ u * 1e3, offset @ w * 1e3, c=height, s=8, cmap=style.SEQUENTIAL, linewidths=0)
    ax.plot(line @ u * 1e3, line @ w * 1e3, color=style.VERMILION, lw=1.6, label="initial axis, bottom to top")
    ax.plot(*(line[:1] @ np.stack([u, w]).T * 1e3).T, "o", color=style.VERMILION, markersize=4)
    ax.plot(0, 0, "+", color=style.INK, markersize=11, markeredgewidth=1.6, label="true axis")
    ax.set_aspect("equal", adjustable="datalim")
    style.style_axes(ax, "Seen along the true axis", "[µm]", "[µm]")
    style.colour_bar(figure, shown, ax, "height on the axis [mm]")
    style.legend(ax, loc="best")
    for direction, colour, label in ((u, style.BLUE, "across, first direction"), (w, style.GREEN, "across, second")):
        ax_height.plot(height, offset @ direction * 1e3, ".", color=colour, markersize=3.5, markeredgewidth=0)
        ax_height.plot([0.0, height.max()], line @ direction * 1e3, color=colour, lw=1.4, label=label)
    ax_height.axhline(0.0, color=style.INK, lw=1.0, label="true axis")
    style.style_axes(ax_height, "Along the true axis", "height on the axis [mm]", "distance from the true axis [µm]")
    style.legend(ax_height, loc="best")
    return figure
