"""Pictures of the joint estimate: residuals in the image and on the artefacts, errors of the turntable, where the scatter comes from."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MultipleLocator, NullFormatter

from rotaline.calibration.joint.model import JointCalibration, JointMount, ResidualGroup, TableErrors
from rotaline.calibration.model import AngleError
from rotaline.calibration.scatter import MountScatter
from rotaline.calibration.speckle_limit import SpeckleLimit
from rotaline.io.report import style
from rotaline.io.report.figures.camera import vector_field

_COLUMNS, _ROWS = 72, 40
_MARKERS = "osD^vP*X"


def target_residuals(joint: JointCalibration) -> Figure:
    """Residuals of all target points over the image, of all captures: each point, and the mean of each cell."""
    uv, residuals = target_points(joint.groups)
    return vector_field(uv, residuals, joint.camera.image_size)


def target_points(groups: Sequence[ResidualGroup]) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Pixels and residuals (px) of the target points that took part in the estimate."""
    views = [v for g in groups if g.kind in ("target", "table-target") for v in g.views if v.used]
    kept = [(v.weight > 0.0) & np.isfinite(v.residuals_px).all(axis=1) for v in views]
    empty = np.zeros((0, 2))
    uv = np.vstack([empty, *(v.uv[k] for v, k in zip(views, kept, strict=True))])
    return uv, np.vstack([empty, *(v.residuals_px[k] for v, k in zip(views, kept, strict=True))])


def unrolled(mount: JointMount) -> Figure:
    """Distances from the surfaces of an artefact over the angle and the way down along its profile: means of cells."""
    figure = style.new_figure(style.FULL_INCH, 3.6)
    ax = figure.add_subplot()
    used = mount.used & np.isfinite(mount.distances_mm)
    points, distances = mount.points_part[used], mount.distances_mm[used] * 1e3
    if len(points) == 0:
        style.nothing_to_draw(ax, "no points")
        return figure
    angle = np.rad2deg(np.arctan2(points[:, 1], points[:, 0])) % 360.0
    along = profile_mm(points, len(mount.surfaces))
    means, edges = _cell_means(angle, along, distances)
    reach = style.symmetric_limit(means.ravel())
    shown = ax.pcolormesh(
        np.linspace(0.0, 360.0, _COLUMNS + 1), edges, means.T, cmap=style.DIVERGING, vmin=-reach, vmax=reach
    )
    shown.set_rasterized(True)
    label = "height above the centre [mm]" if mount.surfaces == ("sphere",) else "height [mm]"
    if len(mount.surfaces) > 1:
        label = "up along the profile [mm]"
    style.style_axes(ax, "", "angle about the axis of the artefact [deg]", label, grid=False)
    ax.xaxis.set_major_locator(MultipleLocator(45.0))
    if len(mount.surfaces) > 1:
        _name_surfaces(ax, mount, used, along)
    style.colour_bar(figure, shown, ax, "mean distance, outside + [µm]")
    return figure


def profile_mm(points_part: Float[np.ndarray, "n 3"], n_surfaces: int) -> Float[np.ndarray, " n"]:
    """Height of points, mm; with discs among the surfaces the way up along the profile, which runs inwards on a disc."""
    if n_surfaces == 1:
        return points_part[:, 2]
    radius = np.hypot(points_part[:, 0], points_part[:, 1])
    up = points_part[:, 2] - radius
    return up - up.min()


def _cell_means(
    x: Float[np.ndarray, " n"], y: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, "c r"], Float[np.ndarray, " q"]]:
    """Mean of each cell (NaN below 3 points), and the edges along y."""
    low, high = float(y.min()), float(y.max())
    rows = np.linspace(low, high if high > low else low + 1.0, _ROWS + 1)
    bins = [np.linspace(0.0, 360.0, _COLUMNS + 1), rows]
    counts, _, _ = np.histogram2d(x, y, bins=bins)
    sums, _, _ = np.histogram2d(x, y, bins=bins, weights=values)
    return np.where(counts >= 3, sums / np.maximum(counts, 1), np.nan), rows


def _name_surfaces(ax: Axes, mount: JointMount, used: Bool[np.ndarray, " m"], along: Float[np.ndarray, " n"]) -> None:
    """The names of the surfaces at the right-hand side, with a line between neighbours."""
    surface = mount.surface[used]
    spans = [
        (float(np.median(along[surface == s])), along[surface == s], name)
        for s, name in enumerate(mount.surfaces)
        if np.any(surface == s)
    ]
    spans.sort(key=lambda span: span[0])
    for (_, below, _), (_, above, _) in pairwise(spans):
        ax.axhline((float(below.max()) + float(above.min())) / 2.0, color=style.GREY, lw=0.7, ls="--")
    for middle, _, name in spans:
        ax.text(
            4.0, middle, name, va="center", fontsize=8, color=style.INK,
            bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.2},
        )  # fmt: skip


def table_errors(table: TableErrors, angle_error: AngleError) -> Figure:
    """What the frames say about the turntable: its angle beyond the read-out, and how the axis moved sideways."""
    figure = style.new_figure(style.FULL_INCH, 3.1)
    ax_angle, ax_shift = figure.subplots(1, 2)
    degrees = np.rad2deg(table.angles_rad) % 360.0
    captures = tuple(dict.fromkeys(table.captures))
    for i, capture in enumerate(captures):
        mine = np.array([c == capture for c in table.captures])
        ax_angle.plot(
            degrees[mine],
            table.frame_errors[mine, 2] * 1e6,
            _MARKERS[i % len(_MARKERS)],
            color=style.series_colour(i),
            markersize=3.0,
            markeredgewidth=0,
            label=capture,
        )
        for axis, filled in ((0, True), (1, False)):
            ax_shift.plot(
                degrees[mine],
                table.frame_errors[mine, 3 + axis] * 1e3,
                _MARKERS[i % len(_MARKERS)],
                markersize=3.0,
                color=style.series_colour(i),
                markerfacecolor=style.series_colour(i) if filled else "none",
                markeredgewidth=0.7,
                label=f"{capture}, along {'xy'[axis]}",
            )
    if angle_error != AngleError():
        turn = np.linspace(0.0, 2.0 * np.pi, 181)
        wave = (angle_error.turned_rad(turn) - turn) * 1e6
        ax_angle.plot(np.rad2deg(turn), wave, color=style.INK, lw=1.1, label="once a turn, in the estimate")
    style.style_axes(ax_angle, "Angle of the table beyond the read-out", "table angle [deg]", "[µrad]")
    style.style_axes(ax_shift, "Run-out of the axis", "table angle [deg]", "along x, y of the base [µm]")
    for ax in (ax_angle, ax_shift):
        ax.set_xlim(-5.0, 365.0)
        ax.xaxis.set_major_locator(MultipleLocator(45.0))
        handles, labels = ax.get_legend_handles_labels()
        ax.legend(handles, labels, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=3, fontsize=7.5, frameon=False)
    return figure


def scatter(parts: Sequence[MountScatter], limit: SpeckleLimit | None) -> Figure:
    """The scatter by its origin on one logarithmic axis, with what speckle allows at best."""
    figure = style.new_figure(style.FULL_INCH, 3.4)
    ax = figure.add_subplot()
    n_waves = max((len(p.waves_mm) for p in parts), default=0)
    rows = ["single point, within a frame", "from frame to frame", *(_cycles(k + 1) for k in range(n_waves))]
    for i, part in enumerate(parts):
        values = np.array([part.within_mm, part.between_mm, *part.waves_mm]) * 1e3
        sure = np.concatenate([[True, True], part.waves_mm > part.chance_mm])
        colour = style.series_colour(i)
        at = np.arange(len(rows)) + 0.16 * (i - (len(parts) - 1) / 2)
        shape: dict[str, Any] = {
            "marker": _MARKERS[i % len(_MARKERS)],
            "linestyle": "none",
            "markersize": 6.5,
            "color": colour,
        }
        positive = np.isfinite(values) & (values > 0.0)
        ax.plot(values[positive & sure], at[positive & sure], label=part.name, **shape)
        if np.any(positive & ~sure):
            ax.plot(values[positive & ~sure], at[positive & ~sure], markerfacecolor="none", **shape)
    ax.set_xscale("log")
    if limit is not None and np.isfinite(limit.depth_mm) and limit.lateral_mm > 0.0:
        ax.axvspan(limit.lateral_mm * 1e3, limit.depth_mm * 1e3, color=style.AMBER, alpha=0.35, lw=0, zorder=0.5)
        ax.axvline(limit.depth_mm * 1e3, color=style.AMBER, lw=1.2, label="speckle limit: across the line … in depth")
    _decades(ax)
    ax.set_yticks(np.arange(len(rows)), rows)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    style.style_axes(ax, "", "root mean square [µm]", "")
    ax.grid(True, which="minor", axis="x", color="#f0f2f5", linewidth=0.5)
    handles, labels = ax.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncols=min(len(labels), 5), fontsize=8, frameon=False)
    return figure


def _cycles(k: int) -> str:
    return "once a turn" if k == 1 else f"{k} times a turn"


def _decades(ax: Axes) -> None:
    """At least one whole decade, with plain numbers."""
    low, high = ax.get_xlim()
    middle = np.sqrt(low * high)
    ax.set_xlim(min(low, middle / 4.0), max(high, middle * 4.0))
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
