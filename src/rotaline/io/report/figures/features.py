"""Pictures of fitted features: the points and their residuals in colour, unrolled or along the profile, and a histogram."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from rotaline.io.report import style
from rotaline.io.report.contents import FittedPoints
from rotaline.io.report.figures.scan import panel
from rotaline.io.report.raster import render_points, views_around
from rotaline.metrology.model import FeatureMeasurement

_MOST_POINTS = 40000
_MEANS_FROM = 4000


@dataclass(frozen=True, eq=False)
class _Chart:
    """Points of a feature in the two coordinates that suit it."""

    title: str
    xlabel: str
    ylabel: str
    x: Float[np.ndarray, " n"]
    y: Float[np.ndarray, " n"]
    equal: bool = False
    surface: bool = True


def fit(measurement: FeatureMeasurement, fitted: FittedPoints) -> Figure:
    """Points in space, a chart of the residuals that suits the feature, and their histogram."""
    figure = style.new_figure(style.FULL_INCH, 3.0)
    ax_space, ax_chart, ax_histogram = figure.subplots(1, 3, width_ratios=(1.1, 1.3, 0.8))
    ok = np.isfinite(fitted.points_table).all(axis=1) & np.isfinite(fitted.residuals_mm)
    pick = np.flatnonzero(ok)[style.thinned(int(ok.sum()), _MOST_POINTS)]
    points, residuals = fitted.points_table[pick], fitted.residuals_mm[pick] * 1e3
    if len(points) == 0:
        for ax in (ax_space, ax_chart, ax_histogram):
            style.nothing_to_draw(ax, "no points")
        return figure
    limit = style.symmetric_limit(residuals)
    mappable = ScalarMappable(Normalize(-limit, limit), style.DIVERGING)
    _space(ax_space, points, residuals, mappable)
    style.colour_bar(figure, mappable, ax_space, "single points, outside + [µm]", shrink=0.7)
    _draw_chart(figure, ax_chart, _chart(measurement, points, residuals / 1e3), residuals, limit)
    _histogram(ax_histogram, residuals, limit)
    return figure


def _draw_chart(figure: Figure, ax: Axes, chart: _Chart, residuals: Float[np.ndarray, " n"], limit: float) -> None:
    """Means of cells where the chart is a surface and the points are many; else the points."""
    style.style_axes(ax, chart.title, chart.xlabel, chart.ylabel)
    if chart.equal:
        ax.set_aspect("equal", adjustable="datalim")
    if chart.surface and len(residuals) >= _MEANS_FROM:
        x_edges, y_edges, means = _cell_means(chart, residuals)
        reach = style.symmetric_limit(means.ravel())
        shown = ax.pcolormesh(
            x_edges, y_edges, means.T, cmap=style.DIVERGING, vmin=-reach, vmax=reach, rasterized=True, linewidth=0
        )
        ax.grid(False)
        style.colour_bar(figure, shown, ax, "means of cells [µm]")
        return
    order = np.argsort(np.abs(residuals))
    size = float(np.clip(9000.0 / len(residuals), 1.2, 9.0))
    ax.scatter(
        chart.x[order],
        chart.y[order],
        c=residuals[order],
        s=size,
        cmap=style.DIVERGING,
        vmin=-limit,
        vmax=limit,
        linewidths=0,
    )


def _cell_means(
    chart: _Chart, residuals: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " q"], Float[np.ndarray, "c r"]]:
    """Edges of the cells and the mean residual in each, NaN below 3 points; as many columns as the frames fill."""
    best: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    filled_coarse = 0.0
    for columns in (24, 36, 48, 72):
        rows = int(np.clip(len(residuals) / (8 * columns), 6, 36))
        sums, x_edges, y_edges = np.histogram2d(chart.x, chart.y, bins=(columns, rows), weights=residuals)
        counts, _, _ = np.histogram2d(chart.x, chart.y, bins=(x_edges, y_edges))
        filled = float((counts >= 3).mean())
        if best is None:
            filled_coarse = filled
        elif filled < 0.85 * filled_coarse:
            break
        best = (x_edges, y_edges, np.where(counts >= 3, sums / np.maximum(counts, 1), np.nan))
    assert best is not None
    return best


def _space(
    ax: Axes, points: Float[np.ndarray, "n 3"], residuals: Float[np.ndarray, " n"], mappable: ScalarMappable
) -> None:
    (view,) = views_around(points, ((25.0, 24.0),), (520, 460))
    colours = np.asarray(mappable.to_rgba(residuals)[:, :3], dtype=float)
    radius = float(np.clip(180.0 / np.sqrt(len(points)), 1.3, 4.0))
    panel(ax, render_points(points, colours, view, radius), view, "Points used by the fit")


def _histogram(ax: Axes, residuals: Float[np.ndarray, " n"], limit: float) -> None:
    reach = 1.3 * limit
    bins = np.linspace(-reach, reach, 61)
    ax.hist(np.clip(residuals, -reach, reach), bins=bins.tolist(), color=style.SKY, edgecolor="none")
    rms = float(np.sqrt(np.mean(residuals**2)))
    for x in (-rms, rms):
        ax.axvline(x, color=style.VERMILION, lw=1.0)
    ax.axvline(float(np.mean(residuals)), color=style.INK, lw=1.0, ls="--")
    style.style_axes(ax, "Distribution", "residual [µm]", "points")


def _chart(
    measurement: FeatureMeasurement, points: Float[np.ndarray, "n 3"], residuals_mm: Float[np.ndarray, " n"]
) -> _Chart:
    geometry = measurement.geometry
    if measurement.feature == "sphere":
        centre = _vector(geometry, "centre")
        if centre is not None:
            d = points - centre
            longitude = np.rad2deg(np.arctan2(d[:, 1], d[:, 0]))
            latitude = np.rad2deg(np.arcsin(np.clip(d[:, 2] / np.linalg.norm(d, axis=1), -1, 1)))
            return _Chart("Residuals over the sphere", "longitude [deg]", "latitude [deg]", longitude, latitude)
    if measurement.feature in ("cylinder", "stepped-cylinder"):
        suffix = "_large" if measurement.feature == "stepped-cylinder" else ""
        point, direction = _vector(geometry, f"axis_point{suffix}"), _vector(geometry, f"axis_direction{suffix}")
        if point is not None and direction is not None:
            return _unrolled(points, point, direction, stepped=bool(suffix))
    if measurement.feature in ("groove", "step"):
        up = _vector(geometry, "normal")
        up = _vector(geometry, "top_normal") if up is None else up
        if up is not None:
            return _profile(points, residuals_mm, up / np.linalg.norm(up), _vector(geometry, "direction"))
    centre = points.mean(axis=0)
    _, _, axes = np.linalg.svd(points[style.thinned(len(points), 3000)] - centre, full_matrices=False)
    flat = (points - centre) @ axes[:2].T
    return _Chart("Residuals, seen along the normal", "[mm]", "[mm]", flat[:, 0], flat[:, 1], equal=True)


def _unrolled(
    points: Float[np.ndarray, "n 3"],
    point: Float[np.ndarray, "3"],
    direction: Float[np.ndarray, "3"],
    stepped: bool,
) -> _Chart:
    """Angle about the axis against the place along it; on a stepped cylinder along its profile, so that discs unroll too."""
    z = direction / np.linalg.norm(direction)
    z = -z if z[2] < 0 else z
    seed = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = seed - (seed @ z) * z
    x = x / np.linalg.norm(x)
    local = (points - point) @ np.stack([x, np.cross(z, x), z]).T
    angle = np.rad2deg(np.arctan2(local[:, 1], local[:, 0]))
    along, label = local[:, 2], "along the axis [mm]"
    if stepped:
        along = along - np.hypot(local[:, 0], local[:, 1])
        along, label = along - along.max(), "down along the profile [mm]"
    return _Chart("Residuals, unrolled", "angle about the fitted axis [deg]", label, angle, along)


def _profile(
    points: Float[np.ndarray, "n 3"],
    residuals_mm: Float[np.ndarray, " n"],
    normal: Float[np.ndarray, "3"],
    along: Float[np.ndarray, "3"] | None,
) -> _Chart:
    """Across a groove or step against the height above its middle, with the residuals exaggerated."""
    along = _main_direction(points, normal) if along is None else along
    across = np.cross(along, normal)
    across = across / np.linalg.norm(across)
    d = points - points.mean(axis=0)
    height = d @ normal
    factor = style.exaggeration(residuals_mm, 0.06 * float(np.ptp(height)))
    return _Chart(
        f"Profile, residuals × {factor:g}",
        "across the feature [mm]",
        "along the normal [mm]",
        d @ across,
        height + (factor - 1.0) * residuals_mm,
        surface=False,
    )


def _vector(geometry: Mapping[str, float | Sequence[float]], key: str) -> Float[np.ndarray, "3"] | None:
    """A vector of the geometry, or None if it is absent or unusable."""
    value = geometry.get(key)
    if not isinstance(value, Sequence) or len(value) != 3 or not np.isfinite(value).all():
        return None
    return np.array(value, dtype=float)


def _main_direction(points: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    """The direction across ``normal`` in which the points reach furthest."""
    flat = points - points.mean(axis=0)
    flat = flat - (flat @ normal)[:, None] * normal
    _, _, axes = np.linalg.svd(flat[style.thinned(len(flat), 3000)], full_matrices=False)
    return np.asarray(axes[0])
