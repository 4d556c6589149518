"""Camera frames with what was found in them (figure 9 of the article)."""

import numpy as np
from jaxtyping import UInt8
from matplotlib.figure import Figure

from rotaline.io.report import style
from rotaline.io.report.contents import FrameOverlay

_DOTTED_FROM = 700
_DARK = 40


def brightened(image: UInt8[np.ndarray, "h w 3"]) -> tuple[UInt8[np.ndarray, "h w 3"], bool]:
    """A dark picture (a frame in laser light) with its shadows lifted, and whether that was done."""
    if float(np.median(image)) >= _DARK:
        return image, False
    lifted = 255.0 * np.power(np.arange(256) / 255.0, 0.45)
    return np.round(lifted).astype(np.uint8)[image], True


def overlay(frame: FrameOverlay) -> Figure:
    """The image with the found points: crosses for the corners of a target, dots where there are many (a stripe)."""
    height, width = frame.image.shape[:2]
    figure = style.new_figure(style.THIRD_INCH, style.THIRD_INCH * height / width)
    figure.set_layout_engine("none")
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.imshow(brightened(frame.image)[0], interpolation="antialiased", aspect="auto")
    uv = (frame.uv[np.isfinite(frame.uv).all(axis=1)] + 0.5) * frame.scale - 0.5
    if len(uv) >= _DOTTED_FROM or frame.stage in ("scan", "stripe", "laser-plane", "artifact"):
        ax.plot(uv[:, 0], uv[:, 1], ".", color="black", markersize=2.6, markeredgewidth=0, alpha=0.6)
        ax.plot(uv[:, 0], uv[:, 1], ".", color="#ffe600", markersize=1.3, markeredgewidth=0)
    else:
        size = float(np.clip(60.0 / np.sqrt(max(1, len(uv))), 2.2, 9.0))
        ax.plot(uv[:, 0], uv[:, 1], "+", color="#ff3d00", markersize=size, markeredgewidth=0.7)
    ax.set_xlim(-0.5, width - 0.5)
    ax.set_ylim(height - 0.5, -0.5)
    ax.set_axis_off()
    return figure
