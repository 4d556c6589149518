"""The rig as it was calibrated: camera, laser plane and rotation axis."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from rotaline.calibration.model import SystemCalibration
from rotaline.io.report import style
from rotaline.io.report.figures.camera import camera_frustum
from rotaline.io.report.rig_geometry import describe_rig


def layout(calibration: SystemCalibration) -> Figure:
    """Camera, field of view, laser plane and rotation axis in the base frame."""
    figure = style.new_figure(style.FULL_INCH, 4.0)
    ax_3d: Any = figure.add_subplot(1, 2, 1, projection="3d")
    ax_top = figure.add_subplot(1, 2, 2)
    geometry = describe_rig(calibration)
    base_from_camera = calibration.base_from_camera
    reach = 0.35 * geometry.camera_to_axis_mm
    frustum = base_from_camera.apply(camera_frustum(calibration.camera, geometry.camera_to_axis_mm))
    plane = calibration.laser_plane_camera
    normal = base_from_camera.rotation.apply(plane.normal)
    meeting = base_from_camera.apply(geometry.meeting_camera[None])[0]
    down = np.array([0.0, 0.0, 1.0]) - normal[2] * normal
    down = down / np.linalg.norm(down) if np.linalg.norm(down) > 1e-6 else np.array([1.0, 0.0, 0.0])
    side = np.cross(normal, down)
    patch = meeting + reach * (np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) @ np.stack([side, down]))
    axis = np.array([[0.0, 0.0, meeting[2] - reach], [0.0, 0.0, meeting[2] + reach]])
    turn = np.linspace(0, 2 * np.pi, 121)
    table = 0.6 * reach * np.stack([np.cos(turn), np.sin(turn), 0 * turn], axis=1)

    for a, b in ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)):
        ax_3d.plot(*frustum[[a, b]].T, color=style.GREY, lw=0.8)
    ax_3d.plot(*frustum[:1].T, "o", color=style.INK, markersize=5)
    ax_3d.plot_trisurf(*patch.T, triangles=[[0, 1, 2], [0, 2, 3]], color=style.VERMILION, alpha=0.18)
    ax_3d.plot(*np.vstack([patch, patch[:1]]).T, color=style.VERMILION, lw=1.0)
    ax_3d.plot(*axis.T, color=style.BLUE, lw=1.8)
    ax_3d.plot(*table.T, color=style.BLUE, lw=0.8)
    style.style_axes_3d(ax_3d, "Base frame", ("x [mm]", "y [mm]", "z [mm]"))
    style.equal_axes_3d(ax_3d, np.vstack([frustum, patch, axis, table]), zoom=0.95)
    ax_3d.view_init(elev=24, azim=-35)

    for a, b in ((0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)):
        label = "camera and field of view" if (a, b) == (0, 1) else None
        ax_top.plot(*frustum[[a, b], :2].T, color=style.GREY, lw=0.8, label=label)
    ax_top.plot(*frustum[0, :2], "o", color=style.INK, markersize=5)
    ring = np.vstack([patch, patch[:1]])
    ax_top.fill(ring[:, 0], ring[:, 1], color=style.VERMILION, alpha=0.15)
    ax_top.plot(ring[:, 0], ring[:, 1], color=style.VERMILION, lw=1.2, label="laser plane")
    ax_top.plot(0, 0, "+", color=style.BLUE, markersize=10, markeredgewidth=1.6, label="rotation axis")
    ax_top.plot(table[:, 0], table[:, 1], color=style.BLUE, lw=0.8)
    ax_top.set_aspect("equal", adjustable="datalim")
    style.style_axes(ax_top, "Seen along the axis, from above", "x, base frame [mm]", "y, base frame [mm]")
    style.legend(ax_top, loc="best")
    return figure
