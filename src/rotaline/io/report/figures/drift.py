"""The drift of a rig: where the stripe lies in the reference frames, against time."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rotaline.io.drift_file import CaptureDrift
from rotaline.io.report import style

_HEIGHT_INCH = 2.9
_MARKERS = "osD^v<>"


def shifts(drifts: Sequence[CaptureDrift]) -> Figure:
    """Shift and brightness against the time since the first reference frame of each capture, with bars of k = 2."""
    figure = style.new_figure(style.FULL_INCH, _HEIGHT_INCH)
    ax_shift, ax_light = figure.subplots(1, 2, width_ratios=(2, 1))
    in_mm = all(np.isfinite(d.mm_per_px) for d in drifts)
    timed = all(np.isfinite(f.minutes) for d in drifts for f in d.frames)
    for k, drift in enumerate(drifts):
        compared = drift.compared
        at = [f.minutes if timed else drift.frames.index(f) for f in compared]
        scale = 1e3 * drift.mm_per_px if in_mm else 1.0
        shift = scale * np.array([f.shift.shift_px for f in compared])
        bars = 2.0 * scale * np.array([f.shift.u_px for f in compared])
        light = 100.0 * (np.array([f.shift.brightness for f in compared]) - 1.0)
        look = {"color": style.series_colour(k), "marker": _MARKERS[k % len(_MARKERS)], "markersize": 3.5, "lw": 1.0}
        ax_shift.errorbar(at, shift, bars, label=drift.folder, capsize=2.0, elinewidth=0.9, **look)
        bars_light = 200.0 * np.array([f.shift.u_brightness for f in compared])
        ax_light.errorbar(at, light, bars_light, capsize=2.0, elinewidth=0.9, **look)
    _limits(ax_shift, drifts, in_mm)
    when = "since the first reference frame [min]" if timed else "reference frame"
    style.style_axes(ax_shift, "Shift along the stripe's normal", when, "shift [µm]" if in_mm else "shift [px]")
    style.style_axes(ax_light, "Brightness of the stripe", when, "change [%]")
    style.legend(ax_shift, loc="best")
    ax_light.set_ylim(min(ax_light.get_ylim()[0], -1.0), max(ax_light.get_ylim()[1], 1.0))
    for ax in (ax_shift, ax_light):
        ax.axhline(0.0, color=style.GREY, lw=0.8, zorder=0)
    return figure


def _limits(ax: Axes, drifts: Sequence[CaptureDrift], in_mm: bool) -> None:
    """The uncertainty that points have anyway, as a band: the smallest of the captures."""
    limits = [1e3 * d.limit_mm if in_mm else d.limit_px for d in drifts]
    finite = [limit for limit in limits if np.isfinite(limit)]
    if finite:
        ax.axhspan(-min(finite), min(finite), color=style.LIGHT, alpha=0.45, lw=0, zorder=0)
