"""Pictures of the initial rotation axis: circles of the corners, their centres and the axis (figure 10 of the article)."""

from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from rotaline.calibration.model import AxisCalibration
from rotaline.geometry.primitives import Line
from rotaline.io.report import style


def circles_3d(calibration: AxisCalibration) -> Figure:
    """Corner tracks, circle centres and the axis in the camera frame (figure 10b)."""
    figure = style.new_figure(style.HALF_INCH, 3.9)
    ax: Any = figure.add_subplot(projection="3d")
    axis, corners, centres = calibration.axis_camera, calibration.corners_camera, calibration.circle_centres_camera
    known = np.flatnonzero(np.isfinite(centres).all(axis=1))
    shown = (
        known[np.unique(np.linspace(0, len(known) - 1, min(len(known), 8)).round().astype(int))]
        if len(known)
        else known
    )
    heights = (centres - axis.point) @ axis.direction
    shown = shown[np.argsort(heights[shown])]
    turn = np.linspace(0.0, 2.0 * np.pi, 121)
    everything = [centres[known]]
    u, w = across(axis)
    for i in shown:
        circle = centres[i] + calibration.circle_radii_mm[i] * (np.cos(turn)[:, None] * u + np.sin(turn)[:, None] * w)
        ax.plot(*_plot(circle), color=style.LIGHT, lw=0.8)
        track = corners[:, i][np.isfinite(corners[:, i]).all(axis=1)]
        ax.plot(*_plot(track), ".", color=style.BLUE, markersize=2.2, markeredgewidth=0)
        everything += [circle]
    c = centres[known]
    ax.plot(*_plot(c), ".", color=style.VERMILION, markersize=4.5, markeredgewidth=0)
    if len(known):
        s = heights[known]
        margin = 0.15 * max(float(s.max() - s.min()), 10.0)
        ends = axis.point + np.array([s.min() - margin, s.max() + margin])[:, None] * axis.direction
        ax.plot(*_plot(ends), color=style.INK, lw=0.9)
        everything += [ends]
    style.style_axes_3d(ax, "", ("x [mm]", "z, depth [mm]", "y [mm]"))
    style.equal_axes_3d(ax, np.vstack([np.zeros((0, 3)), *everything])[:, [0, 2, 1]], zoom=0.88)
    ax.invert_zaxis()
    ax.view_init(elev=22, azim=-62)
    return figure


def single_circle(calibration: AxisCalibration) -> Figure:
    """One corner's track in the plane of its circle, deviations exaggerated (figure 10a)."""
    figure = style.new_figure(style.HALF_INCH, 3.9)
    ax = figure.add_subplot()
    known = np.isfinite(calibration.circle_centres_camera).all(axis=1) & np.isfinite(calibration.circle_radii_mm)
    if not known.any():
        style.nothing_to_draw(ax, "no circle was fitted")
        return figure
    seen = np.isfinite(calibration.corners_camera).all(axis=2).sum(axis=0)
    i = int(np.argmax(np.where(known, seen * 1e6 + calibration.circle_radii_mm, -1.0)))
    axis, centre, radius = (
        calibration.axis_camera,
        calibration.circle_centres_camera[i],
        float(calibration.circle_radii_mm[i]),
    )
    u, w = across(axis)
    track = calibration.corners_camera[:, i][np.isfinite(calibration.corners_camera[:, i]).all(axis=1)] - centre
    x, y = track @ u, track @ w
    r, phi = np.hypot(x, y), np.arctan2(y, x)
    factor = style.exaggeration(r - radius, 0.12 * radius)
    turn = np.linspace(0, 2 * np.pi, 361)
    ax.plot(radius * np.cos(turn), radius * np.sin(turn), color=style.INK, lw=0.9, label="fitted circle")
    drawn = radius + factor * (r - radius)
    ax.plot(
        drawn * np.cos(phi),
        drawn * np.sin(phi),
        "o",
        color=style.BLUE,
        markersize=3,
        markeredgewidth=0,
        label=f"corner {int(calibration.point_ids[i])}, deviation × {factor:g}",
    )
    ax.plot(0, 0, "+", color=style.VERMILION, markersize=8, markeredgewidth=1.4, label="centre")
    ax.set_aspect("equal")
    style.style_axes(ax, "", "in the plane of the circle [mm]", "[mm]")
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def checks(calibration: AxisCalibration) -> Figure:
    """Centres seen along the axis, RMS of each circle against its radius, and the table's angles against the board's."""
    figure = style.new_figure(style.FULL_INCH, 3.1)
    ax_centres, ax_circles, ax_angles = figure.subplots(1, 3)
    axis, centres = calibration.axis_camera, calibration.circle_centres_camera
    known = np.isfinite(centres).all(axis=1)
    u, w = across(axis)
    offset = centres[known] - axis.point
    height = offset @ axis.direction
    shown = ax_centres.scatter(offset @ u * 1e3, offset @ w * 1e3, c=height, s=7, cmap=style.SEQUENTIAL, linewidths=0)
    ax_centres.plot(0, 0, "+", color=style.VERMILION, markersize=9, markeredgewidth=1.4)
    ax_centres.set_aspect("equal", adjustable="datalim")
    style.style_axes(ax_centres, "Circle centres, seen along the axis", "[µm]", "[µm]")
    if known.any():
        style.colour_bar(figure, shown, ax_centres, "height [mm]")

    ax_circles.plot(
        calibration.circle_radii_mm,
        calibration.circle_rms_mm * 1e3,
        ".",
        color=style.BLUE,
        markersize=4,
        markeredgewidth=0,
    )
    ax_circles.set_ylim(bottom=0)
    style.style_axes(ax_circles, "RMS of each circle", "radius of the circle [mm]", "RMS distance [µm]")

    angles, residuals = board_angle_residuals(calibration)
    ax_angles.axhline(0.0, color=style.GREY, lw=0.8)
    ax_angles.plot(
        np.rad2deg(unwrapped(angles)), np.rad2deg(residuals), "o", color=style.BLUE, markersize=3, markeredgewidth=0
    )
    style.style_axes(ax_angles, "Angle of the board − table", "table angle [deg]", "difference [deg]")
    return figure


def board_angle_residuals(calibration: AxisCalibration) -> tuple[Float[np.ndarray, " f"], Float[np.ndarray, " f"]]:
    """Table angles of the used frames, and by how much the board turned further than the table says (mean 0), rad."""
    frames = [f for f in calibration.frames if f.used]
    if len(frames) < 2:
        return np.zeros(0), np.zeros(0)
    angles = np.array([f.angle_rad for f in frames])
    first = frames[0].camera_from_board.rotation
    turned = np.array([(f.camera_from_board.rotation * first.inv()).as_rotvec() for f in frames])
    board = turned @ calibration.axis_camera.direction * calibration.turn_sense
    difference = board - (angles - angles[0])
    difference = (difference + np.pi) % (2 * np.pi) - np.pi
    return angles, difference - np.median(difference)


def unwrapped(angles_rad: Float[np.ndarray, " f"]) -> Float[np.ndarray, " f"]:
    """The same angles (order kept) in one turn that begins after the largest gap, so that their range is the arc covered.

    Examples
    --------
    >>> import numpy as np
    >>> np.rad2deg(unwrapped(np.deg2rad([350.0, 10.0, 30.0]))).round(6).tolist()
    [-10.0, 10.0, 30.0]
    """
    turn = 2.0 * np.pi
    wrapped = np.asarray(angles_rad, dtype=float) % turn
    if len(wrapped) < 2:
        return wrapped
    ordered = np.sort(wrapped)
    gaps = np.diff(ordered, append=ordered[0] + turn)
    start = ordered[(int(np.argmax(gaps)) + 1) % len(ordered)]
    begun = (wrapped - start) % turn + start
    return np.asarray(begun - turn if begun.mean() > np.pi else begun)


def across(axis: Line) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Two unit vectors that make a right-handed frame with the axis' direction."""
    seed = np.eye(3)[int(np.argmin(np.abs(axis.direction)))]
    u = np.cross(axis.direction, seed)
    u = u / np.linalg.norm(u)
    return u, np.cross(axis.direction, u)


def _plot(points: Float[np.ndarray, "n 3"]) -> tuple[Any, Any, Any]:
    """Camera frame as it is drawn: x to the right, z to the back, y upright (and turned over by the axes)."""
    return points[:, 0], points[:, 2], points[:, 1]
