"""The picture of `rotaline rig check`: frames, stripe, focus, grey values, settling and return."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rotaline.hardware.camera import Image
from rotaline.io.report import style
from rotaline.io.report.figures.frames import brightened
from rotaline.io.rig_check_pictures import CheckPictures
from rotaline.vision.images import small_picture, to_grey

_WIDTH_PX = 640
_SOFT_PX = 3.0
"""Blur at the end of the scale."""
_LEAST_AWAY_PX = 0.1


def rig_check_figure(pictures: CheckPictures) -> Figure:
    """Six panels; what was not taken says so."""
    figure = style.new_figure(style.FULL_INCH, 6.4)
    axes = figure.subplots(2, 3)
    _frame(axes[0, 0], pictures.off, "Laser off", "no frame")
    _stripe(axes[0, 1], pictures)
    _focus(figure, axes[0, 2], pictures)
    _histogram(axes[1, 0], pictures)
    _settling(axes[1, 1], pictures)
    _returns(axes[1, 2], pictures)
    return figure


def _frame(ax: Axes, image: Image | None, title: str, otherwise: str) -> float:
    """Show an image; returns the scale of the picture."""
    if image is None:
        style.nothing_to_draw(ax, otherwise)
        ax.set_title(title, fontsize=9, loc="left", fontweight="bold", color=style.INK)
        return 1.0
    picture, scale = small_picture(image, _WIDTH_PX)
    shown, lifted = brightened(picture)
    ax.imshow(shown, interpolation="antialiased")
    ax.set_axis_off()
    added = " (shadows lifted)" if lifted else ""
    ax.set_title(title + added, fontsize=9, loc="left", fontweight="bold", color=style.INK)
    return scale


def _stripe(ax: Axes, pictures: CheckPictures) -> None:
    scale = _frame(ax, pictures.on, "Laser on, stripe", "no frame with the laser on")
    if pictures.on is not None and pictures.stripe_uv is not None:
        uv = (pictures.stripe_uv + 0.5) * scale - 0.5
        ax.plot(uv[:, 0], uv[:, 1], ".", color=style.VERMILION, markersize=1.2, markeredgewidth=0)


def _focus(figure: Figure, ax: Axes, pictures: CheckPictures) -> None:
    title = "Blur of edges"
    if pictures.off is None or pictures.blur_px is None or not np.isfinite(pictures.blur_px).any():
        _frame(ax, None, title, "no edges in view")
        return
    height, width = pictures.off.shape[:2]
    _frame(ax, pictures.off, title, "")
    small, _ = small_picture(pictures.off, _WIDTH_PX)
    extent = (-0.5, small.shape[1] - 0.5, small.shape[0] - 0.5, -0.5)
    rows, columns = pictures.blur_px.shape
    tile = min(height // rows, width // columns)
    covered = (
        extent[0],
        extent[0] + (extent[1] - extent[0]) * columns * tile / width,
        extent[3] + (extent[2] - extent[3]) * rows * tile / height,
        extent[3],
    )
    shown = np.ma.masked_invalid(pictures.blur_px)
    map_ = ax.imshow(shown, extent=covered, cmap="viridis_r", vmin=0.0, vmax=_SOFT_PX, alpha=0.75)
    ax.set_xlim(extent[0], extent[1])
    ax.set_ylim(extent[2], extent[3])
    style.colour_bar(figure, map_, ax, "standard deviation [px]", shrink=0.7)


def _histogram(ax: Axes, pictures: CheckPictures) -> None:
    drawn = False
    for image, colour, name in ((pictures.off, style.BLUE, "laser off"), (pictures.on, style.VERMILION, "laser on")):
        if image is None:
            continue
        share = to_grey(image).astype(float).ravel()[::3] * (100.0 / np.iinfo(image.dtype).max)
        ax.hist(share, bins=np.linspace(0.0, 100.0, 102).tolist(), histtype="step", color=colour, lw=1.2, label=name)
        drawn = True
    if not drawn:
        style.nothing_to_draw(ax, "no frame")
        return
    ax.set_yscale("log")
    style.style_axes(ax, "Grey values", "share of full scale [%]", "pixels (each third)")
    style.legend(ax, loc="upper right")


def _settling(ax: Axes, pictures: CheckPictures) -> None:
    if pictures.settling is None:
        style.nothing_to_draw(ax, "settling was not measured")
        return
    ax.plot(pictures.settling[:, 0] * 1e3, pictures.settling[:, 1], ".", color=style.BLUE, markersize=4)
    ax.axhline(0.0, color=style.GREY, lw=0.8)
    seen = np.abs(pictures.settling[:, 1][np.isfinite(pictures.settling[:, 1])])
    largest = max(1.15 * float(np.max(seen, initial=0.0)), _LEAST_AWAY_PX)
    ax.set_ylim(-largest, largest)
    if pictures.settled_s is not None:
        ax.axvline(pictures.settled_s * 1e3, color=style.VERMILION, lw=1.2)
        style.note(ax, f"stands after {pictures.settled_s * 1e3:.0f} ms")
    style.style_axes(ax, "After a move", "time after the move [ms]", "away from rest [px]")


def _returns(ax: Axes, pictures: CheckPictures) -> None:
    if pictures.returns_px is None:
        style.nothing_to_draw(ax, "no moves and returns")
        return
    n = len(pictures.returns_px)
    ax.plot(np.arange(1, n + 1), pictures.returns_px, "o", color=style.BLUE, markersize=4)
    ax.axhline(0.0, color=style.GREY, lw=0.8)
    largest = max(float(np.max(np.abs(pictures.returns_px))) * 1.6, 0.02)
    ax.set_ylim(-largest, largest)
    ax.set_xticks(np.arange(1, n + 1))
    style.style_axes(ax, "Returns to the same angle", "return", "off their mean [px]")
