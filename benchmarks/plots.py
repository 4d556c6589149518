"""The plots of docs/benchmarks.md, from what was measured."""

from collections.abc import Callable, Sequence
from pathlib import Path

import matplotlib as mpl
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import LogFormatterSciNotation

from benchmarks.harness import Measurement, growth, is_time
from benchmarks.per_frame import METHODS

OWN, PLAIN, OTHER = "#1f6fb5", "#9cc3e6", "#9a9a9a"
COLOURS = ("#1f6fb5", "#d97a1d", "#3f8f4f", "#8a5aa8", "#b03a3a", "#7a6a55", "#4aa3a3", "#777777")
DPI = 110


def draw(measurements: Sequence[Measurement], folder: Path) -> list[Path]:
    """Write the plots for which there is something; their paths."""
    mpl.use("Agg")

    def of(*benchmarks: str, unit: Callable[[str], bool] = is_time) -> list[Measurement]:
        return [m for m in measurements if m.benchmark in benchmarks and unit(m.unit)]

    plots = {
        "benchmark-per-frame.png": (_per_frame, [m for m in measurements if m.benchmark == "per-frame"]),
        "benchmark-scanning.png": (_series, of("resolution", "frames")),
        "benchmark-memory.png": (_memory, of("memory", unit=lambda u: u == "MB")),
        "benchmark-points.png": (_series, of("points", "surface", unit=lambda u: u == "s")),
        "benchmark-surface.png": (_series, of("surface", unit=lambda u: u in ("MB", "mm"))),
        "benchmark-joint.png": (_series, of("joint", "mounts")),
        "benchmark-workers.png": (_workers, of("workers")),
    }
    drawn = []
    for name, (function, chosen) in plots.items():
        if chosen:
            figure = function(chosen)
            figure.savefig(folder / name, dpi=DPI)
            plt.close(figure)
            drawn.append(folder / name)
    return drawn


def _per_frame(measurements: Sequence[Measurement]) -> plt.Figure:
    """Time over the limit of each method, and its error, on rendered frames."""
    ratios = {
        m.name.removeprefix("rendered: ").removesuffix(", over the limit"): m
        for m in measurements
        if m.name.startswith("rendered: ") and m.name.endswith(", over the limit")
    }
    errors = {
        m.name.removeprefix("rendered: ").removesuffix(", rms error"): m.median for m in measurements if m.unit == "px"
    }
    names = list(ratios)[::-1]
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 0.36 * len(names) + 1.1), sharey=True, layout="constrained")
    colours = [OWN if n in METHODS else PLAIN if n.startswith("plain") else OTHER for n in names]
    medians = [ratios[n].median for n in names]
    left.barh(names, medians, xerr=[ratios[n].spread for n in names], color=colours)
    left.set(xscale="log", xlabel="time over one pass of np.max")
    for name in names:
        middle, spread = ratios[name].median, ratios[name].spread
        text = f"{middle:.0f}" if middle > 99.5 else f"{middle:.2g}"
        left.annotate(text, (middle + spread, name), xytext=(4, 0), textcoords="offset points", va="center", fontsize=8)
    left.set_xlim(0.8, 5 * max(medians))
    shown = [n for n in names if n in errors]
    right.barh(shown, [errors[n] for n in shown], color=[c for n, c in zip(names, colours, strict=True) if n in errors])
    right.set(xlabel="rms error, px")
    return figure


def _series(measurements: Sequence[Measurement]) -> plt.Figure:
    """Log-log, one panel for each benchmark and unit, a line of the fitted power beside each series."""
    panels: dict[tuple[str, str], dict[str, list[Measurement]]] = {}
    for m in measurements:
        if m.parameter is not None:
            panels.setdefault((m.benchmark, m.unit), {}).setdefault(m.name, []).append(m)
    figure, axes = plt.subplots(1, len(panels), figsize=(5.2 * len(panels), 4.4), squeeze=False, layout="constrained")
    for axis, ((benchmark, unit), series) in zip(axes[0], panels.items(), strict=True):
        for colour, (name, rows) in zip(COLOURS * 2, series.items(), strict=False):
            x = np.array([float(m.parameter or np.nan) for m in rows])
            label = name.removesuffix(", in all")
            if len(rows) > 2:
                g = growth(rows)
                ends = np.array([x.min(), x.max()])
                axis.plot(ends, g.factor * ends**g.exponent, color=colour, linewidth=0.8)
                label += f": power {g.exponent:.2f}"
            axis.errorbar(
                x, [m.median for m in rows], [m.spread for m in rows], fmt="o", color=colour, markersize=4, label=label
            )
        axis.set(xscale="log", yscale="log", xlabel=rows[0].parameter_name, ylabel=unit, title=benchmark)
        sizes = sorted({float(m.parameter or np.nan) for rows in series.values() for m in rows})
        axis.set_xticks(sizes, [f"{size:.2g}" if size > 1e4 else f"{size:g}" for size in sizes])
        axis.xaxis.minorticks_off()
        axis.yaxis.set_minor_formatter(LogFormatterSciNotation(minor_thresholds=(1.5, 0.6)))
        axis.grid(alpha=0.3)
        axis.legend(fontsize=7)
    return figure


def _workers(measurements: Sequence[Measurement]) -> plt.Figure:
    """Speed against one worker."""
    figure, axis = plt.subplots(figsize=(4.6, 3.6), layout="constrained")
    for colour, kind in zip(COLOURS, dict.fromkeys(m.name for m in measurements), strict=False):
        rows = [m for m in measurements if m.name == kind]
        axis.plot(
            [float(m.parameter or 1) for m in rows],
            [rows[0].median / m.median for m in rows],
            "o-",
            color=colour,
            label=kind,
        )
    most = max(float(m.parameter or 1) for m in measurements)
    axis.plot([1, most], [1, most], color=OTHER, linewidth=0.8, label="ideal")
    axis.set(xlabel="workers", ylabel="times as fast as one", xticks=np.arange(1, most + 1))
    axis.legend(fontsize=8)
    return figure


def _memory(measurements: Sequence[Measurement]) -> plt.Figure:
    """Resident memory against the number of frames, from zero."""
    figure, axis = plt.subplots(figsize=(4.6, 3.6), layout="constrained")
    for colour, source in zip(COLOURS, dict.fromkeys(m.name for m in measurements), strict=False):
        rows = [m for m in measurements if m.name == source]
        axis.plot([float(m.parameter or 1) for m in rows], [m.median for m in rows], "o-", color=colour, label=source)
    axis.set(xscale="log", xlabel="frames", ylabel="largest resident memory, MB", ylim=(0, None))
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    return figure
