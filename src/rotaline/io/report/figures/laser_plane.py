"""Pictures of the laser plane and of its optimisation by cross-ratio invariance."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from rotaline.calibration.model import CrossRatioResult, LaserPlaneCalibration, StripeOnBoard
from rotaline.geometry.primitives import Plane
from rotaline.io.report import style


def stripes_3d(calibration: LaserPlaneCalibration) -> Figure:
    """Stripes of all poses in the camera frame with the plane (figure 8a of the article)."""
    figure = style.new_figure(style.HALF_INCH, 3.4)
    ax: Any = figure.add_subplot(projection="3d")
    used = [v for v in calibration.views if v.used and len(v.points_camera)]
    for i, view in enumerate(used):
        points = view.points_camera[style.thinned(len(view.points_camera), 300)]
        colour = _view_colour(i, len(used))
        ax.plot(points[:, 0], points[:, 2], points[:, 1], ".", color=colour, markersize=1.6, markeredgewidth=0)
    everything = np.vstack([np.zeros((0, 3)), *[v.points_camera for v in used]])
    everything = everything[np.isfinite(everything).all(axis=1)]
    if len(everything) >= 3:
        patch = plane_patch(calibration.plane_camera, everything)
        ax.plot_trisurf(
            patch[:, 0], patch[:, 2], patch[:, 1], triangles=[[0, 1, 2], [0, 2, 3]], color=style.GREEN, alpha=0.12
        )
        ring = np.vstack([patch, patch[:1]])
        ax.plot(ring[:, 0], ring[:, 2], ring[:, 1], color=style.GREEN, lw=0.8)
        everything = np.vstack([everything, patch])
    style.style_axes_3d(ax, "", ("x [mm]", "z, depth [mm]", "y [mm]"))
    style.equal_axes_3d(ax, everything[:, [0, 2, 1]], zoom=0.85)
    ax.invert_zaxis()
    ax.view_init(elev=20, azim=-50)
    return figure


def plane_patch(plane: Plane, points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "4 3"]:
    """Rectangle in the plane around the points, along their principal directions; mm, in the frame of the plane."""
    feet = points - plane.signed_distance_to(points)[:, None] * plane.normal
    centre = feet.mean(axis=0)
    _, _, axes = np.linalg.svd(feet[style.thinned(len(feet), 2000)] - centre, full_matrices=False)
    along = axes[0] - (axes[0] @ plane.normal) * plane.normal
    along = along / np.linalg.norm(along)
    across = np.cross(plane.normal, along)
    st = (feet - centre) @ np.stack([along, across]).T
    (s0, t0), (s1, t1) = st.min(axis=0), st.max(axis=0)
    corners = np.array([[s0, t0], [s1, t0], [s1, t1], [s0, t1]])
    return np.asarray(centre + corners @ np.stack([along, across]))


def residuals_by_view(calibration: LaserPlaneCalibration) -> Figure:
    """Distances of the stripe points from the plane, along each stripe, view by view."""
    figure = style.new_figure(style.HALF_INCH, 3.4)
    ax = figure.add_subplot()
    used = _used(calibration)
    if not used:
        style.nothing_to_draw(ax, "no stripe was used")
        return figure
    for i, view in enumerate(used):
        r = view.residuals_mm[style.thinned(len(view.residuals_mm), 400)] * 1e3
        spread = np.linspace(-0.32, 0.32, len(r))
        ax.plot(i + spread, r, ".", color=_view_colour(i, len(used)), markersize=2.2, alpha=0.7, markeredgewidth=0)
        mean = float(np.nanmean(view.residuals_mm)) * 1e3
        ax.plot([i - 0.36, i + 0.36], [mean, mean], color=style.INK, lw=1.3)
    ax.axhline(0.0, color=style.GREY, lw=0.8)
    limit = 1.3 * style.symmetric_limit(np.concatenate([v.residuals_mm for v in used]) * 1e3)
    ax.set_ylim(-limit, limit)
    style.style_axes(ax, "", "view", "distance from the plane [µm]")
    names = [v.name for v in used]
    step = max(1, -(-len(used) // 20))
    ticks = list(range(0, len(used), step))
    ax.set_xticks(ticks, [style.view_label(names, i) for i in ticks], rotation=90 if len(used) > 6 else 0)
    return figure


def residuals_over_image(calibration: LaserPlaneCalibration, image_size: tuple[int, int] | None) -> Figure:
    """Distances of the stripe points from the plane, where they stand in the image."""
    figure = style.new_figure(style.HALF_INCH, 3.4)
    ax = figure.add_subplot()
    used = _used(calibration)
    if not used:
        style.nothing_to_draw(ax, "no stripe was used")
        return figure
    uv = np.vstack([v.uv for v in used])
    _residual_map(figure, ax, uv, np.concatenate([v.residuals_mm for v in used]))
    if image_size is not None:
        ax.set_xlim(-0.5, image_size[0] - 0.5)
        ax.set_ylim(image_size[1] - 0.5, -0.5)
    else:
        ax.invert_yaxis()
    style.style_axes(ax, "", "u [px]", "v [px]")
    return figure


def residuals_over_plane(calibration: LaserPlaneCalibration) -> Figure:
    """Distances of the stripe points from the plane, where they stand in the plane itself."""
    figure = style.new_figure(style.HALF_INCH, 3.4)
    ax = figure.add_subplot()
    used = _used(calibration)
    if not used:
        style.nothing_to_draw(ax, "no stripe was used")
        return figure
    points = np.vstack([v.points_camera for v in used])
    r = np.concatenate([v.residuals_mm for v in used])
    known = np.isfinite(points).all(axis=1)
    points, r = points[known], r[known]
    # away from the camera, and across that
    normal = calibration.plane_camera.normal
    away = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    away = away / np.linalg.norm(away) if np.linalg.norm(away) > 1e-6 else np.array([1.0, 0.0, 0.0])
    across = np.cross(normal, away)
    _residual_map(figure, ax, np.stack([points @ across, points @ away], axis=1), r)
    style.style_axes(ax, "", "across, in the laser plane [mm]", "away from the camera, in the laser plane [mm]")
    return figure


def _used(calibration: LaserPlaneCalibration) -> list[StripeOnBoard]:
    return [v for v in calibration.views if v.used and np.isfinite(v.residuals_mm).any()]


def _residual_map(
    figure: Figure, ax: Axes, at: Float[np.ndarray, "n 2"], residuals_mm: Float[np.ndarray, " n"]
) -> None:
    r = residuals_mm * 1e3
    pick = style.thinned(len(at), 8000)
    limit = style.symmetric_limit(r)
    shown = ax.scatter(
        at[pick, 0], at[pick, 1], c=r[pick], s=4, cmap=style.DIVERGING, vmin=-limit, vmax=limit, linewidths=0
    )
    ax.set_aspect("equal")
    style.colour_bar(figure, shown, ax, "distance from the plane [µm]")


def interval_errors(result: CrossRatioResult) -> Figure:
    """Interval errors before and after the optimisation (figure 8b of the article) and the objective (7) on the way."""
    figure = style.new_figure(style.FULL_INCH, 3.0)
    ax, ax_history = figure.subplots(1, 2, width_ratios=(2.6, 1.0))
    order = np.lexsort((result.row, result.view))
    before = (result.measured_before_mm - result.reference_mm)[order] * 1e3
    after = (result.measured_after_mm - result.reference_mm)[order] * 1e3
    views = result.view[order]
    at = np.arange(len(order))
    for start in np.flatnonzero(np.diff(views, prepend=-1))[1:]:
        ax.axvline(start - 0.5, color=style.LIGHT, lw=0.7)
    ax.axhline(0.0, color=style.GREY, lw=0.8)
    size = 3.5 if len(at) < 150 else 2.2
    ax.plot(
        at,
        before,
        "o",
        color=style.BEFORE,
        markersize=size,
        markerfacecolor="none",
        markeredgewidth=0.9,
        label="before",
    )
    ax.plot(at, after, "o", color=style.AFTER, markersize=size, markeredgewidth=0, label="after")
    if len(at) == 0:
        style.nothing_to_draw(ax, "no intervals")
    style.style_axes(
        ax,
        "Interval errors I_W − I_R (upright lines part the poses)",
        "interval, pose by pose",
        "error [µm]",
        grid=False,
    )
    style.legend(ax, loc="upper right", ncols=2)
    history = result.history_mm * 1e3
    ax_history.plot(np.arange(len(history)), history, "o-", color=style.BLUE, markersize=2.5, lw=1.2)
    style.style_axes(ax_history, "Objective (7)", "iteration", "interval RMSE [µm]")
    style.log_axis(ax_history, history)
    ax_history.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def _view_colour(index: int, n: int) -> Any:
    return colormaps[style.SEQUENTIAL](0.05 + 0.85 * index / max(1, n - 1))
