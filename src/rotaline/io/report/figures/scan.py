"""Pictures of scans: clouds and surfaces from several viewpoints (figure 16 of the article), points a frame."""

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure

from rotaline.io.report import style
from rotaline.io.report.raster import View, render_mesh, render_points, views_around
from rotaline.scanning.cloud import PointCloud

VIEWPOINTS_DEG = ((20.0, 22.0), (140.0, 22.0), (260.0, 22.0), (20.0, 89.0))
VIEWPOINT_NAMES = ("20° from x", "140° from x", "260° from x", "from above")
_PANEL_PX = (440, 400)
_SCALE_BAR_SHARE = 0.09
_PANEL_RATIO = _PANEL_PX[1] * (1.0 + _SCALE_BAR_SHARE) / _PANEL_PX[0]
_ABOVE_TABLE_MM = 0.5


def cloud_views(cloud: PointCloud, table_seen: bool) -> Figure:
    """The cloud from four viewpoints, coloured by height; the table (z = 0 if it was seen) does not shrink the part."""
    points, _ = _finite(cloud.points_table)
    figure, axes, (bar,) = style.row_of_panels(4, _PANEL_RATIO, "last")
    if len(points) == 0:
        return _empty(figure, "no points")
    part = _part(points, table_seen)
    values = points[:, 2]
    views = views_around(points[part], VIEWPOINTS_DEG, _PANEL_PX)
    mappable = _mappable(values[part], style.SEQUENTIAL)
    for ax, view, name in zip(axes, views, VIEWPOINT_NAMES, strict=True):
        panel(ax, _draw_points(points, values, mappable, view), view, name)
    style.colour_bar(figure, mappable, None, "z, table frame [mm]", cax=bar)
    return figure


def cloud_attributes(cloud: PointCloud, table_seen: bool) -> Figure:
    """The cloud by intensity, by standard uncertainty (from the stripe; from the calibration, where known) and by table angle."""
    points, pick = _finite(cloud.points_table)
    judged = bool(np.isfinite(cloud.u_calibration_mm).any())
    figure, axes, bars = style.row_of_panels(4 if judged else 3, _PANEL_RATIO, "each")
    if len(points) == 0:
        return _empty(figure, "no points")
    directions = (*([VIEWPOINTS_DEG[0]] * (len(axes) - 1)), VIEWPOINTS_DEG[3])
    part = _part(points, table_seen)
    views = views_around(points[part], directions, _PANEL_PX)
    calibration = (cloud.u_calibration_mm[pick] * 1e3, "plasma", "u, k = 1 [µm]", "u from the calibration")
    shown: tuple[tuple[Float[np.ndarray, " n"], str | Colormap, str, str], ...] = (
        (cloud.intensity[pick], "cividis", "intensity [grey values]", "Intensity"),
        (cloud.u_mm[pick] * 1e3, "plasma", "u, k = 1 [µm]", "u from the stripe"),
        *((calibration,) if judged else ()),
        (np.rad2deg(cloud.angle_rad[pick]) % 360.0, style.CYCLIC, "table angle [deg]", "Table angle"),
    )
    for ax, bar, view, (values, colours, label, title) in zip(axes, bars, views, shown, strict=True):
        mappable = _mappable(values[part], colours)
        if not np.isfinite(values).any():
            style.nothing_to_draw(ax, f"{title}: not known")
            bar.set_axis_off()
            continue
        panel(ax, _draw_points(points, values, mappable, view), view, title)
        style.colour_bar(figure, mappable, None, label, cax=bar)
    return figure


def points_by_frame(cloud: PointCloud, n_points: int) -> Figure:
    """Points of each frame over the table angle (counts scaled up if the cloud was thinned)."""
    figure = style.new_figure(style.FULL_INCH, 2.0)
    ax = figure.add_subplot()
    if len(cloud) == 0:
        style.nothing_to_draw(ax, "no points")
        return figure
    _, first, counts = np.unique(cloud.frame, return_index=True, return_counts=True)
    angles = np.rad2deg(cloud.angle_rad[first]) % 360.0
    order = np.argsort(angles)
    scaled = counts * (n_points / len(cloud))
    ax.plot(angles[order], scaled[order], ".", color=style.BLUE, markersize=4, markeredgewidth=0)
    ax.set_ylim(0.0, 1.12 * float(scaled.max()))
    ax.set_xlim(-3, 363)
    ax.set_xticks(np.arange(0, 361, 45))
    style.style_axes(ax, "", "table angle [deg]", "points a frame")
    return figure


def mesh_views(vertices_table: Float[np.ndarray, "v 3"], triangles: Int[np.ndarray, "t 3"]) -> Figure:
    """The surface from four viewpoints with shading."""
    figure, axes, _ = style.row_of_panels(4, _PANEL_RATIO, "none")
    used = vertices_table[np.unique(triangles)] if len(triangles) else np.zeros((0, 3))
    if len(used) == 0:
        return _empty(figure, "no triangles")
    views = views_around(used, VIEWPOINTS_DEG, _PANEL_PX)
    pictures = render_mesh(vertices_table, triangles, views)
    for ax, picture, view, name in zip(axes, pictures, views, VIEWPOINT_NAMES, strict=True):
        panel(ax, picture, view, name)
    return figure


def _part(points: Float[np.ndarray, "n 3"], table_seen: bool) -> Bool[np.ndarray, " n"]:
    """Points that stand above the table top; all, if it was not seen or hardly anything stands on it."""
    above = points[:, 2] > _ABOVE_TABLE_MM
    return above if table_seen and above.sum() > 0.02 * len(points) else np.ones(len(points), bool)


def _finite(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "m 3"], Int[np.ndarray, " m"]]:
    pick = np.flatnonzero(np.isfinite(points).all(axis=1))
    return points[pick], pick


def _mappable(values: Float[np.ndarray, " n"], colours: str | Colormap) -> ScalarMappable:
    low, high = (0.0, 360.0) if colours is style.CYCLIC else style.robust_range(values, 1.0)
    return ScalarMappable(Normalize(low, high), colormaps[colours] if isinstance(colours, str) else colours)


def _draw_points(
    points: Float[np.ndarray, "n 3"], values: Float[np.ndarray, " n"], mappable: ScalarMappable, view: View
) -> UInt8[np.ndarray, "h w 3"]:
    known = np.isfinite(values)
    colours = np.asarray(mappable.to_rgba(values[known])[:, :3], dtype=float)
    radius = float(np.clip(1.6 * np.sqrt(20000.0 / max(1, len(points))), 0.8, 2.6))
    return render_points(points[known], colours, view, radius)


def panel(ax: Axes, picture: UInt8[np.ndarray, "h w 3"], view: View, title: str) -> None:
    """A rendered picture with a scale bar in mm."""
    height, width = picture.shape[:2]
    strip = round(_SCALE_BAR_SHARE * height)
    ax.imshow(np.vstack([picture, np.full((strip, width, 3), 255, np.uint8)]), interpolation="catrom")
    ax.set_axis_off()
    ax.set_title(title, fontsize=8.5, color=style.INK, loc="left", fontweight="bold")
    length_mm = style.round_down_125(0.3 * width * view.mm_per_px)
    u, v = 0.03 * width, height + 0.5 * strip
    ax.plot([u, u + length_mm / view.mm_per_px], [v, v], color=style.INK, lw=2.0, solid_capstyle="butt")
    ax.text(
        u + length_mm / view.mm_per_px + 0.02 * width,
        v,
        f"{length_mm:g} mm",
        fontsize=7.5,
        color=style.INK,
        va="center",
    )


def _empty(figure: Figure, text: str) -> Figure:
    for ax in figure.axes:
        style.nothing_to_draw(ax, text if ax is figure.axes[0] else "")
    return figure
