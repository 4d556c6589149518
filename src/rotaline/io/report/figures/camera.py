"""Pictures of the camera calibration: coverage, residuals, poses of the boards."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from rotaline.calibration.model import CameraCalibration, CameraView
from rotaline.io.report import numbers, style
from rotaline.vision.camera import CameraModel

_MEAN_FROM = 12
"""Points that a cell needs for its mean."""


def coverage(calibration: CameraCalibration) -> Figure:
    """Where in the image the camera was observed; cells without any point are shaded."""
    width, height = calibration.camera.image_size
    figure = style.new_figure(style.HALF_INCH, 0.35 + style.HALF_INCH * 0.9 * height / width)
    ax = figure.add_subplot()
    used, _ = _used_points(calibration)
    unused = _stack([v.uv[~_kept(v)] for v in calibration.views])
    counts, u_edges, v_edges = _cells(used, width, height)
    for i, j in zip(*np.nonzero(counts == 0), strict=True):
        cell = (float(u_edges[i]), float(v_edges[j]))
        size = (float(u_edges[i + 1] - u_edges[i]), float(v_edges[j + 1] - v_edges[j]))
        ax.add_patch(Rectangle(cell, *size, facecolor="#fbe3d6", edgecolor="white", linewidth=0.5))
    ax.plot(unused[:, 0], unused[:, 1], "x", color=style.GREY, markersize=2.5, markeredgewidth=0.6, label="left out")
    ax.plot(used[:, 0], used[:, 1], ".", color=style.BLUE, markersize=2.0, alpha=0.6, markeredgewidth=0, label="used")
    _image_axes(ax, width, height)
    return figure


def residual_vectors(calibration: CameraCalibration) -> Figure:
    """Residuals over the image: each point, and the mean of each cell (what the model cannot explain)."""
    return vector_field(*_used_points(calibration), calibration.camera.image_size)


def vector_field(
    uv: Float[np.ndarray, "n 2"], residuals: Float[np.ndarray, "n 2"], image_size: tuple[int, int]
) -> Figure:
    """Residuals (px) at places in the image, drawn longer as stated: single points, and the mean of each cell."""
    width, height = image_size
    figure = style.new_figure(style.FULL_INCH, 0.7 + 0.5 * style.FULL_INCH * 0.92 * height / width)
    ax_all, ax_mean = figure.subplots(1, 2)
    pick = style.thinned(len(uv), 3000)
    _arrows(ax_all, uv[pick], residuals[pick], width, style.BLUE, "single points")
    counts, u_edges, v_edges = _cells(uv, width, height)
    centres, means = [], []
    column = np.clip(np.searchsorted(u_edges, uv[:, 0], side="right") - 1, 0, len(u_edges) - 2)
    row = np.clip(np.searchsorted(v_edges, uv[:, 1], side="right") - 1, 0, len(v_edges) - 2)
    for i, j in zip(*np.nonzero(counts >= _MEAN_FROM), strict=True):
        cell = (column == i) & (row == j)
        centres.append(uv[cell].mean(axis=0))
        means.append(residuals[cell].mean(axis=0))
    _arrows(ax_mean, _stack(centres), _stack(means), width, style.VERMILION, "mean of each cell")
    for ax in (ax_all, ax_mean):
        _image_axes(ax, width, height)
    return figure


def residual_distribution(calibration: CameraCalibration) -> Figure:
    """Residuals as a cloud and as a histogram beside the normal distribution of the same spread."""
    figure = style.new_figure(style.HALF_INCH, 2.75)
    ax_cloud, ax_histogram = figure.subplots(1, 2)
    _, residuals = _used_points(calibration)
    if len(residuals) == 0:
        style.nothing_to_draw(ax_cloud, "no residuals")
        style.nothing_to_draw(ax_histogram, "")
        return figure
    limit = max(float(np.percentile(np.abs(residuals), 99.5)) * 1.15, 1e-9)
    pick = style.thinned(len(residuals), 4000)
    ax_cloud.plot(*residuals[pick].T, ".", color=style.BLUE, markersize=2, alpha=0.35, markeredgewidth=0)
    turn = np.linspace(0, 2 * np.pi, 181)
    ax_cloud.plot(calibration.rms_px * np.cos(turn), calibration.rms_px * np.sin(turn), color=style.VERMILION, lw=1.2)
    ax_cloud.set_aspect("equal")
    ax_cloud.set_xlim(-limit, limit)
    ax_cloud.set_ylim(limit, -limit)
    style.style_axes(ax_cloud, "Residuals, circle: RMS", "along u [px]", "along v [px]")
    bins = np.linspace(-limit, limit, 41)
    for k, (colour, name) in enumerate(((style.BLUE, "u"), (style.AMBER, "v"))):
        ax_histogram.hist(residuals[:, k], bins=bins, histtype="step", color=colour, lw=1.3, label=f"along {name}")
    sigma = float(np.sqrt(np.mean(residuals**2)))
    if sigma > 0.0:
        x = np.linspace(-limit, limit, 201)
        density = np.exp(-0.5 * (x / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
        ax_histogram.plot(
            x, density * len(residuals) * (bins[1] - bins[0]), "--", color=style.INK, lw=0.9, label="normal"
        )
    style.style_axes(ax_histogram, "Distribution", "residual [px]", "points")
    style.legend(ax_histogram, loc="upper right", fontsize=7)
    return figure


def rms_by_view(calibration: CameraCalibration) -> Figure:
    """RMS of every view; views that were left out are grey."""
    figure = style.new_figure(style.HALF_INCH, 2.75)
    ax = figure.add_subplot()
    views = calibration.views
    if not views:
        style.nothing_to_draw(ax, "no views")
        return figure
    at = np.arange(len(views))
    heights = np.array([v.rms_px for v in views])
    ax.bar(at, np.nan_to_num(heights), color=[style.BLUE if v.used else style.LIGHT for v in views], width=0.75)
    ax.axhline(calibration.rms_px, color=style.VERMILION, lw=1.2)
    style.style_axes(ax, "RMS of each view (line: all used views)", "view", "RMS residual [px]")
    _name_ticks(ax, [v.name for v in views])
    return figure


def board_poses(calibration: CameraCalibration) -> Figure:
    """The boards in front of the camera, in the camera frame."""
    figure = style.new_figure(style.HALF_INCH, 0.35 + style.HALF_INCH * 0.9 * _ratio(calibration.camera))
    ax: Any = figure.add_subplot(projection="3d")
    corners = [(v, board_outline(calibration.camera, v)) for v in calibration.views]
    drawn = [(v, c) for v, c in corners if np.isfinite(c).all()]
    for view, outline in drawn:
        colour = style.BLUE if view.used else style.GREY
        ring = np.vstack([outline, outline[:1]])
        ax.plot(ring[:, 0], ring[:, 2], ring[:, 1], color=colour, lw=0.9, alpha=0.9)
    everything = _stack([c for _, c in drawn], 3)
    far = float(everything[:, 2].max()) if len(everything) else 100.0
    frustum = camera_frustum(calibration.camera, 0.18 * far)
    for a, b in ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)):
        ax.plot(*[(frustum[a, i], frustum[b, i]) for i in (0, 2, 1)], color=style.INK, lw=0.8)
    style.style_axes_3d(ax, "", ("x [mm]", "z, depth [mm]", "y [mm]"))
    style.equal_axes_3d(ax, np.vstack([everything, frustum])[:, [0, 2, 1]], zoom=0.95)
    ax.invert_zaxis()
    ax.view_init(elev=18, azim=-58)
    return figure


def board_outline(camera: CameraModel, view: CameraView) -> Float[np.ndarray, "4 3"]:
    """Corners of the rectangle around the observed points of a board, in the camera frame, mm; NaN if it has no pose."""
    board_from_camera = view.camera_from_board.inv()
    rays = camera.rays(view.uv)
    directions = board_from_camera.rotation.apply(rays)
    origin = board_from_camera.translation
    with np.errstate(all="ignore"):
        points = origin + directions * (-origin[2] / directions[:, 2])[:, None]
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return np.full((4, 3), np.nan)
    (x0, y0), (x1, y1) = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    return view.camera_from_board.apply(np.array([[x0, y0, 0.0], [x1, y0, 0.0], [x1, y1, 0.0], [x0, y1, 0.0]]))


def camera_frustum(camera: CameraModel, depth: float) -> Float[np.ndarray, "5 3"]:
    """Projection centre and the corners of the field of view at a depth (without distortion), camera frame, mm."""
    width, height = camera.image_size
    corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
    xy = (corners - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return np.vstack([np.zeros(3), np.column_stack([xy, np.ones(4)]) * depth])


def _kept(view: CameraView) -> Bool[np.ndarray, " n"]:
    """Points that took part: of used views, with a residual."""
    return np.isfinite(view.residuals_px).all(axis=1) & view.used


def _used_points(calibration: CameraCalibration) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 2"]]:
    """Observed pixels and residuals of all points that took part."""
    views = calibration.views
    return _stack([v.uv[_kept(v)] for v in views]), _stack([v.residuals_px[_kept(v)] for v in views])


def _ratio(camera: CameraModel) -> float:
    return max(0.6, camera.image_size[1] / camera.image_size[0])


def _stack(parts: Any, columns: int = 2) -> Float[np.ndarray, "n c"]:
    return np.vstack([np.zeros((0, columns)), *parts])


def _cells(
    uv: Float[np.ndarray, "n 2"], width: int, height: int
) -> tuple[Float[np.ndarray, "a b"], Float[np.ndarray, " p"], Float[np.ndarray, " q"]]:
    """Counts in nearly square cells, about ten along the longer side."""
    side = max(width, height) / 10.0
    bins = (max(1, round(width / side)), max(1, round(height / side)))
    finite = uv[np.isfinite(uv).all(axis=1)]
    return np.histogram2d(finite[:, 0], finite[:, 1], bins=bins, range=((-0.5, width - 0.5), (-0.5, height - 0.5)))


def _arrows(
    ax: Any, uv: Float[np.ndarray, "n 2"], residuals: Float[np.ndarray, "n 2"], width: int, colour: str, title: str
) -> None:
    factor = style.exaggeration(np.linalg.norm(residuals, axis=1), 0.045 * width)
    ax.quiver(
        uv[:, 0],
        uv[:, 1],
        residuals[:, 0] * factor,
        residuals[:, 1] * factor,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color=colour,
        width=0.0022,
        headwidth=3.5,
        headlength=4.0,
        alpha=0.85,
    )
    length_px = style.round_down_125(0.1 * width / factor)
    title = f"{title[0].upper()}{title[1:]}, drawn {numbers.count(round(factor))} times as long"
    ax.set_title(title, fontsize=9, color=style.INK, loc="left", fontweight="bold")
    x0, y0 = 0.03, -0.115
    ax.annotate(
        "", (x0, y0), (x0 + length_px * factor / width, y0), "axes fraction", arrowprops=_KEY | {"color": colour}
    )
    ax.text(
        x0 + length_px * factor / width + 0.015,
        y0,
        f"{length_px:g} px",
        transform=ax.transAxes,
        fontsize=8,
        va="center",
    )


_KEY = {"arrowstyle": "<|-", "lw": 1.4, "shrinkA": 0, "shrinkB": 0, "mutation_scale": 7}


def _image_axes(ax: Any, width: int, height: int) -> None:
    ax.set_xlim(-0.5, width - 0.5)
    ax.set_ylim(height - 0.5, -0.5)
    ax.set_aspect("equal")
    title = ax.get_title(loc="left")
    style.style_axes(ax, title, "u [px]", "v [px]", grid=False)
    for side in ax.spines.values():
        side.set_visible(True)
        side.set_color(style.GREY)


def _name_ticks(ax: Any, names: list[str]) -> None:
    """Names under the bars, thinned so that they do not overlap."""
    step = max(1, -(-len(names) // 20))
    ticks = list(range(0, len(names), step))
    ax.set_xticks(ticks, [style.view_label(names, i) for i in ticks], rotation=90 if len(names) > 6 else 0)
    ax.set_xlim(-0.7, len(names) - 0.3)
