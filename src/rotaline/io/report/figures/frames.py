"""Camera frames with what was found in them (figure 9 of the article)."""

import numpy as np
from matplotlib.figure import Figure

from rotaline.io.report import style
from rotaline.io.report.contents import FrameOverlay

_DOTTED_FROM = 700


def overlay(frame: FrameOverlay) -> Figure:
    """The image with the found points: crosses for the corners of a target, dots where there are many (a stripe)."""
    height, width = frame.image.shape[:2]
    figure = style.new_figure(style.THIRD_INCH, style.THIRD_INCH * height / width)
    figure.set_layout_engine("none")
    ax = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    ax.imshow(frame.image, interpolation="antialiased", aspect="auto")
    uv = (frame.uv[np.isfinite(frame.uv).all(axis=1)] + 0.5) * frame.scale - 0.5
    if len(uv) >= _DOTTED_FROM or frame.stage in ("scan", "stripe", "laser-plane"):
        ax.plot(uv[:, 0], uv[:, 1], ".", color="#00e5ff", markersize=1.1, markeredgewidth=0)
    else:
        size = float(np.clip(60.0 / np.sqrt(max(1, len(uv))), 2.2, 9.0))
        ax.plot(uv[:, 0], uv[:, 1], "+", color="#ff3d00", markersize=size, markeredgewidth=0.7)
    ax.set_xlim(-0.5, width - 0.5)
    ax.set_ylim(height - 0.5, -0.5)
    ax.set_axis_off()
    return figure
