"""Pictures of the axis optimisation with the stepped cylinder (figure 14 of the article)."""

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.spatial.transform import RigidTransform

from rotaline.calibration.model import ArtifactCalibration, ArtifactMount
from rotaline.geometry.primitives import SteppedCylinder
from rotaline.io.report import style

CIRCLE_NAMES = ("C1 top edge", "C2 inner edge of the step", "C3 outer edge of the step", "C4 bottom edge")


def convergence(calibration: ArtifactCalibration) -> Figure:
    """The objective (14) after each iteration (figure 14b)."""
    figure = style.new_figure(style.HALF_INCH, 2.9)
    ax = figure.add_subplot()
    history = calibration.history_mm * 1e3
    ax.plot(np.arange(len(history)), history, "o-", color=style.BLUE, markersize=3, lw=1.3)
    style.style_axes(ax, "", "iteration", "mean distance, eq. (14) [µm]")
    style.log_axis(ax, history)
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    return figure


def mean_distances(calibration: ArtifactCalibration) -> Figure:
    """Mean distance of each mount before and after."""
    figure = style.new_figure(style.HALF_INCH, 2.9)
    ax = figure.add_subplot()
    at = np.arange(len(calibration.mounts))
    before = np.array([m.mean_distance_before_mm for m in calibration.mounts]) * 1e3
    after = np.array([m.mean_distance_mm for m in calibration.mounts]) * 1e3
    ax.bar(at - 0.2, np.nan_to_num(before), 0.38, color=style.BEFORE, label="initial axis")
    ax.bar(at + 0.2, np.nan_to_num(after), 0.38, color=style.AFTER, label="optimised axis")
    for x, value in (*zip(at - 0.2, before, strict=True), *zip(at + 0.2, after, strict=True)):
        if np.isfinite(value):
            ax.text(x, value, f"{value:.3g}", ha="center", va="bottom", fontsize=7.5, color=style.INK)
    ax.margins(y=0.18)
    style.style_axes(ax, "", "", "mean distance [µm]")
    ax.grid(False, axis="x")
    ax.set_xticks(at, [m.name for m in calibration.mounts], rotation=0 if len(at) < 6 else 40)
    style.legend(ax, loc="upper right", ncols=2)
    return figure


def feature_circles(mount: ArtifactMount, artifact: SteppedCylinder | None) -> Figure:
    """Top view of the four feature circles before and after, against the ideal ones, deviations exaggerated (figure 14a)."""
    figure = style.new_figure(style.FULL_INCH, 3.2)
    axes = figure.subplots(1, 4)
    before = _in_part(mount.features_before_base, mount.base_from_part_before)
    after = _in_part(mount.features_base, mount.base_from_part)
    radii = _ideal_radii(after, artifact)
    factor = _common_factor(before, after, radii)
    for h, ax in enumerate(axes):
        radius = radii[h]
        turn = np.linspace(0, 2 * np.pi, 361)
        if np.isfinite(radius):
            ax.plot(radius * np.cos(turn), radius * np.sin(turn), color=style.IDEAL, lw=0.8, label="ideal circle")
        for points, colour, label in ((before, style.BEFORE, "initial axis"), (after, style.AFTER, "optimised axis")):
            r, phi = np.hypot(points[:, h, 0], points[:, h, 1]), np.arctan2(points[:, h, 1], points[:, h, 0])
            drawn = radius + factor * (r - radius)
            ax.plot(
                drawn * np.cos(phi),
                drawn * np.sin(phi),
                ".",
                color=colour,
                markersize=3.5,
                markeredgewidth=0,
                label=label,
            )
        ax.set_aspect("equal")
        style.style_axes(ax, CIRCLE_NAMES[h], "x of the cylinder [mm]", "y [mm]" if h == 0 else "")
    handles, labels = axes[0].get_legend_handles_labels()
    labels = [f"{text} (deviation × {factor:g})" if "axis" in text else text for text in labels]
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    return figure


def distances_by_angle(mount: ArtifactMount) -> Figure:
    """Distance (13) of every feature point from its ideal circle over the table angle, before and after."""
    figure = style.new_figure(style.FULL_INCH, 2.9)
    axes = figure.subplots(1, 2)
    order = np.argsort(mount.angles_rad)
    angles = np.rad2deg(mount.angles_rad[order])
    parts = (("Initial axis", mount.distances_before_mm), ("Optimised axis", mount.distances_mm))
    for ax, (title, distances) in zip(axes, parts, strict=True):
        for h in range(4):
            ax.plot(
                angles,
                distances[order, h] * 1e3,
                ".-",
                color=style.series_colour(h),
                lw=0.8,
                markersize=3.5,
                markeredgewidth=0,
                label=CIRCLE_NAMES[h],
            )
        ax.set_ylim(bottom=0)
        style.style_axes(ax, title, "table angle [deg]", "distance, eq. (13) [µm]")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    return figure


def _in_part(features_base: Float[np.ndarray, "f 4 3"], base_from_part: RigidTransform) -> Float[np.ndarray, "f 4 3"]:
    """Feature points in the frame of the cylinder; NaN rows stay NaN."""
    flat = features_base.reshape(-1, 3)
    found = np.isfinite(flat).all(axis=1)
    out = np.full(flat.shape, np.nan)
    if found.any():
        out[found] = base_from_part.inv().apply(flat[found])
    return out.reshape(features_base.shape)


def _ideal_radii(after: Float[np.ndarray, "f 4 3"], artifact: SteppedCylinder | None) -> list[float]:
    """Radii of the four circles; without the artefact's sizes, the medians of the measured ones."""
    if artifact is not None:
        return [circle.radius for circle in artifact.edge_circles_part()]
    r = np.hypot(after[:, :, 0], after[:, :, 1])
    return [float(np.median(c[np.isfinite(c)])) if np.isfinite(c).any() else float("nan") for c in r.T]


def _common_factor(before: Float[np.ndarray, "f 4 3"], after: Float[np.ndarray, "f 4 3"], radii: list[float]) -> float:
    deviations = np.concatenate(
        [np.hypot(points[:, h, 0], points[:, h, 1]) - radii[h] for points in (before, after) for h in range(4)]
    )
    finite_radii = [r for r in radii if np.isfinite(r)]
    return style.exaggeration(deviations, 0.3 * min(finite_radii)) if finite_radii else 1.0
