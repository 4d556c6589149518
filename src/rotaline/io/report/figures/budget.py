"""Pictures of the budget: which error of the rig does what."""

import math
import textwrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from rotaline.io.report import style
from rotaline.io.report.reproduction import Budget, BudgetSource

_PER_ROW = 4


def responses(budget: Budget) -> Figure:
    """One panel for each error of the rig: the figures that the article gives, over the setting of that error alone.

    Dashed: the article's figure; a ring where the curve meets it.
    """
    keys = [k for k in budget.article if k in budget.titles]
    n_rows = -(-max(1, len(budget.sources)) // _PER_ROW)
    figure = style.new_figure(style.FULL_INCH, 0.7 + 2.2 * n_rows)
    axes = figure.subplots(n_rows, _PER_ROW, squeeze=False, sharey=True).ravel()
    for ax, source in zip(axes, budget.sources, strict=False):
        _response(ax, budget, source, keys)
    for ax in axes[len(budget.sources) :]:
        ax.set_axis_off()
    everything = [
        1e3 * level.figures.get(k, math.nan) for source in budget.sources for level in source.levels for k in keys
    ] + [1e3 * budget.article[k] for k in keys]
    if everything:
        style.log_axis(axes[0], np.array(everything, dtype=float))
    for ax in axes[::_PER_ROW]:
        ax.set_ylabel("[µm]", fontsize=8.5, color=style.INK)
    handles, labels = axes[0].get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def _response(ax: Axes, budget: Budget, source: BudgetSource, keys: list[str]) -> None:
    settings = np.array([level.setting for level in source.levels], dtype=float)
    for i, key in enumerate(keys):
        colour = style.series_colour(i)
        values = np.array([level.figures.get(key, math.nan) for level in source.levels], dtype=float)
        article = budget.article[key]
        ax.axhline(article * 1e3, color=colour, lw=0.9, ls="--")
        ax.plot(settings, values * 1e3, "o-", color=colour, lw=1.3, markersize=3, label=budget.titles[key])
        meets = source.reproducing.get(key)
        if meets is not None:
            ax.plot(meets, article * 1e3, "o", color=colour, markersize=9, markerfacecolor="none", markeredgewidth=1.6)
    style.style_axes(ax, textwrap.fill(source.title, 28), f"[{source.unit}]" if source.unit else "")


def matrix(budget: Budget) -> Figure:
    """All figures (columns) under each error alone (rows), at the largest setting that was tried.

    First the errors that were seen in observations, then those that needed images; above each kind a row without any error.
    """
    keys = list(budget.titles)
    rows, names = [], []
    for from_images in (False, True):
        alike = [s for s in budget.sources if s.from_images == from_images and s.levels]
        if alike:
            rows.append(alike[0].levels[0].figures)
            names.append(f"none of these errors, {'images' if from_images else 'observations'}")
        for source in alike:
            largest = max(source.levels, key=lambda level: abs(level.setting))
            rows.append(largest.figures)
            names.append(f"{source.title}, {largest.setting:g} {source.unit}".rstrip())
    figure = style.new_figure(style.FULL_INCH, 0.9 + 0.27 * max(1, len(rows)))
    ax = figure.add_subplot()
    values = np.array([[r.get(k, math.nan) for k in keys] for r in rows], dtype=float).reshape(len(rows), len(keys))
    values = np.abs(values) * 1e3
    positive = values[np.isfinite(values) & (values > 0)]
    if len(positive) == 0:
        style.nothing_to_draw(ax, "nothing was varied")
        return figure
    norm = LogNorm(float(positive.min()), float(positive.max()) * 1.0001)
    ax.imshow(np.clip(values, positive.min(), None), cmap="YlOrRd", norm=norm, aspect="auto")
    for (i, j), value in np.ndenumerate(values):
        if math.isfinite(value):
            share = float(norm(max(value, positive.min())))
            colour = "white" if share > 0.6 else style.INK
            ax.text(j, i, f"{value:.3g}", ha="center", va="center", fontsize=7.5, color=colour)
        else:
            ax.text(j, i, "–", ha="center", va="center", fontsize=7.5, color=style.GREY)
    ax.set_xticks(range(len(keys)), [textwrap.fill(budget.titles[k], 15) for k in keys])
    ax.set_yticks(range(len(names)), names)
    ax.xaxis.tick_top()
    style.style_axes(ax, "", "", "", grid=False)
    ax.spines[:].set_visible(False)
    ax.tick_params(length=0)
    ax.tick_params(axis="x", labelsize=7.5)
    return figure
