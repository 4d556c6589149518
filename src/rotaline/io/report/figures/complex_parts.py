"""Pictures of parts with small details: a frame, the cloud, the surface, its deviation from the truth (figure 16 of the article)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from rotaline.io.report import style
from rotaline.io.report.figures.frames import brightened
from rotaline.io.report.figures.scan import panel
from rotaline.io.report.raster import (
    View,
    hidden,
    picture_position,
    render_mesh,
    render_points,
    view_rotation,
    views_around,
)
from rotaline.io.report.reproduction import ComplexPartResult, DetailResult

VIEWPOINTS_DEG = ((20.0, 25.0), (110.0, 25.0), (200.0, 25.0), (290.0, 25.0))
VIEWPOINT_NAMES = ("20° from x", "110° from x", "200° from x", "290° from x")
_PANEL_PX = (440, 440)
_RATIO = 480.0 / 440.0
DETAILS_A_ROW = 4
_CLOSE_PX = (300, 300)
_CLOSE_RATIO = 327.0 / 300.0
_FACING = 0.25
_MARGIN_PX = 22.0
_UNKNOWN = np.array([0.55, 0.55, 0.55])


def photo_and_cloud(part: ComplexPartResult) -> Figure:
    """A frame of the camera, and the cloud from three viewpoints, coloured by height."""
    figure, axes, (bar,) = style.row_of_panels(4, _RATIO, "last")
    _photo(axes[0], part)
    points = part.points_table[np.isfinite(part.points_table).all(axis=1)]
    if len(points) == 0:
        for ax in axes[1:]:
            style.nothing_to_draw(ax, "no points")
        bar.set_axis_off()
        return figure
    mappable = ScalarMappable(Normalize(*style.robust_range(points[:, 2], 1.0)), colormaps[style.SEQUENTIAL])
    colours = np.asarray(mappable.to_rgba(points[:, 2])[:, :3], dtype=float)
    views = _views(points)[:3]
    radius = float(np.clip(1.6 * np.sqrt(20000.0 / len(points)), 0.8, 2.6))
    for ax, view, name in zip(axes[1:], views, VIEWPOINT_NAMES[:3], strict=True):
        panel(ax, render_points(points, colours, view, radius), view, f"Cloud, {name}")
    style.colour_bar(figure, mappable, None, "z, table frame [mm]", cax=bar)
    return figure


def surface(part: ComplexPartResult) -> Figure:
    """The measured surface from four viewpoints; arrows with the numbers of the details that are seen there."""
    figure, axes, _ = style.row_of_panels(4, _RATIO, "none")
    if not _any_triangle(axes, part):
        return figure
    views = _views(part.vertices_table[np.unique(part.triangles)])
    pictures = render_mesh(part.vertices_table, part.triangles, views)
    for ax, picture, view, name in zip(axes, pictures, views, VIEWPOINT_NAMES, strict=True):
        panel(ax, picture, view, name)
        for number in seen_details(part, view):
            _arrow(ax, part.details[number], number + 1, view)
    return figure


def deviation(part: ComplexPartResult) -> Figure:
    """Signed distance of the measured surface from the true one, from four viewpoints; grey: nothing to compare with."""
    figure, axes, (bar,) = style.row_of_panels(4, _RATIO, "last")
    if not _any_triangle(axes, part):
        bar.set_axis_off()
        return figure
    mappable = _deviation_colours(part)
    views = _views(part.vertices_table[np.unique(part.triangles)])
    pictures = render_mesh(part.vertices_table, part.triangles, views, _vertex_colours(part, mappable))
    for ax, picture, view, name in zip(axes, pictures, views, VIEWPOINT_NAMES, strict=True):
        panel(ax, picture, view, name)
    style.colour_bar(figure, mappable, None, "deviation, outside + [µm]", cax=bar)
    return figure


def details(part: ComplexPartResult, first: int = 0) -> Figure:
    """Up to four details from ``first`` on, straight from outside: the measured surface, beside it its deviation from the truth."""
    shown = part.details[first : first + DETAILS_A_ROW]
    figure, axes, (bar,) = style.row_of_panels(2 * DETAILS_A_ROW, _CLOSE_RATIO, "last")
    for ax in axes:
        ax.set_axis_off()
    if not shown or not _any_triangle(axes, part):
        bar.set_axis_off()
        return figure
    mappable = _deviation_colours(part)
    colours = _vertex_colours(part, mappable)
    for i, detail in enumerate(shown):
        view = close_view(detail)
        close = _near(part, view)
        plain, coloured = (render_mesh(part.vertices_table, close, [view], c)[0] for c in (None, colours))
        panel(axes[2 * i], plain, view, f"{first + i + 1} {detail.name}")
        panel(axes[2 * i + 1], coloured, view, "")
    style.colour_bar(figure, mappable, None, "deviation [µm]", cax=bar)
    return figure


def close_view(detail: DetailResult) -> View:
    """A view straight at the detail from outside, a little from above, about 2.5 times as wide as its surroundings."""
    d = detail.direction_table / max(float(np.linalg.norm(detail.direction_table)), 1e-12)
    azimuth = float(np.rad2deg(np.arctan2(d[1], d[0])))
    elevation = float(np.clip(np.rad2deg(np.arcsin(np.clip(d[2], -1.0, 1.0))) + 15.0, -60.0, 89.0))
    width_mm = 5.0 * max(detail.radius_mm, 0.2)
    return View(view_rotation(azimuth, elevation), detail.position_table, width_mm / _CLOSE_PX[0], _CLOSE_PX)


def seen_details(part: ComplexPartResult, view: View) -> list[int]:
    """Which details face the viewer and stand behind nothing (their indices)."""
    if not part.details:
        return []
    positions = np.stack([d.position_table for d in part.details])
    facing = np.stack([d.direction_table for d in part.details]) @ view.rotation[2] > _FACING
    covered = hidden(positions, part.vertices_table[np.unique(part.triangles)], view)
    return [int(i) for i in np.flatnonzero(facing & ~covered)]


def _views(points: Float[np.ndarray, "n 3"]) -> tuple[View, ...]:
    return views_around(points, VIEWPOINTS_DEG, _PANEL_PX)


def _photo(ax: Axes, part: ComplexPartResult) -> None:
    """The frame, cut to the shape of the panels about its middle."""
    height, width = part.photo.shape[:2]
    side = min(width, height)
    left = (width - side) // 2
    picture, lifted = brightened(part.photo[:, left : left + side])
    ax.imshow(picture, interpolation="antialiased")
    ax.set_axis_off()
    ax.set_anchor("N")
    title = "Camera frame, brightened" if lifted else "Camera frame"
    ax.set_title(title, fontsize=8.5, color=style.INK, loc="left", fontweight="bold")


def _any_triangle(axes: Sequence[Axes], part: ComplexPartResult) -> bool:
    if len(part.triangles):
        return True
    for ax in axes:
        style.nothing_to_draw(ax, "no surface" if ax is axes[0] else "")
    return False


def _deviation_colours(part: ComplexPartResult) -> ScalarMappable:
    limit = style.symmetric_limit(part.deviation_mm[np.unique(part.triangles)] * 1e3)
    return ScalarMappable(Normalize(-limit, limit), style.DIVERGING)


def _vertex_colours(part: ComplexPartResult, mappable: ScalarMappable) -> Float[np.ndarray, "v 3"]:
    known = np.isfinite(part.deviation_mm)
    colours = np.asarray(mappable.to_rgba(np.where(known, part.deviation_mm, 0.0) * 1e3)[:, :3], dtype=float)
    colours[~known] = _UNKNOWN
    return colours


def _near(part: ComplexPartResult, view: View) -> Any:
    """Triangles in the window of a close view, and not on the far side of the part."""
    at = (part.vertices_table - view.centre) @ view.rotation.T
    reach = 0.75 * view.mm_per_px * view.size_px[0]
    near = (np.abs(at[:, :2]) < reach).all(axis=1) & (at[:, 2] > -2.0 * reach)
    return part.triangles[near[part.triangles].all(axis=1)]


def _arrow(ax: Axes, detail: DetailResult, number: int, view: View) -> None:
    """An arrow from outside the part to the detail, with its number; red where it was not resolved."""
    (tip,) = picture_position(detail.position_table[None], view)
    tail = _place_beside(tip[:2], np.array(view.size_px, dtype=float))
    colour = style.INK if detail.resolved else style.VERMILION
    ax.annotate(
        str(number),
        xy=(float(tip[0]), float(tip[1])),
        xytext=(float(tail[0]), float(tail[1])),
        fontsize=8.5,
        fontweight="bold",
        color=colour,
        ha="center",
        va="center",
        bbox={"boxstyle": "circle,pad=0.18", "facecolor": "white", "edgecolor": colour, "linewidth": 0.9},
        arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.2, "shrinkA": 0.0, "shrinkB": 1.0},
    )


def _place_beside(tip: Float[np.ndarray, "2"], size_px: Float[np.ndarray, "2"]) -> Float[np.ndarray, "2"]:
    """Where the number of an arrow stands: away from the middle of the picture, or to a side where there is more room."""
    away = np.arctan2(*(tip - size_px / 2)[::-1])
    length = 0.17 * size_px[0]
    turns = np.deg2rad([0.0, 50.0, -50.0, 100.0, -100.0])
    ideal = tip + length * np.stack([np.cos(away + turns), np.sin(away + turns)], axis=1)
    within = np.clip(ideal, _MARGIN_PX, size_px - _MARGIN_PX)
    enough = np.linalg.norm(within - tip, axis=1) > 0.8 * length
    return np.asarray(within[int(np.argmax(enough))])
