"""One look for all figures: sizes, palette, axes, and how a figure becomes a part of the page.

The figures use matplotlib's objects directly (no pyplot, no global state), so reports can be written from several threads.
The palette is that of Okabe and Ito, which the common forms of colour blindness tell apart.
"""

import base64
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter
from PIL import Image

from rotaline.io.files import whole_file

FULL_INCH = 10.4
HALF_INCH = 5.1
THIRD_INCH = 3.4

BLUE, VERMILION, GREEN = "#0072B2", "#D55E00", "#009E73"
SKY, AMBER, PURPLE = "#56B4E9", "#E69F00", "#CC79A7"
INK, GREY, LIGHT = "#1f2933", "#7b8794", "#d5dbe1"
BEFORE, AFTER, IDEAL = VERMILION, BLUE, INK
SERIES = (BLUE, VERMILION, GREEN, AMBER, PURPLE, SKY)
SEQUENTIAL = "viridis"
DIVERGING = LinearSegmentedColormap.from_list(
    "rotaline", ["#08306b", BLUE, "#8fc1de", "#e4e4e0", "#f0b48a", VERMILION, "#6b2400"]
)

CYCLIC = LinearSegmentedColormap.from_list("rotaline-turn", [BLUE, GREEN, AMBER, VERMILION, PURPLE, BLUE])

_TEXT = 8.5


def new_figure(width_inch: float, height_inch: float) -> Figure:
    """An empty figure that arranges its axes by itself."""
    figure = Figure(
        figsize=(width_inch, height_inch), layout=ConstrainedLayoutEngine(w_pad=0.05, h_pad=0.08), facecolor="white"
    )
    FigureCanvasAgg(figure)
    return figure


def row_of_panels(n: int, ratio: float, bars: Literal["none", "last", "each"]) -> tuple[Figure, list[Axes], list[Axes]]:
    """A row of pictures (height ``ratio`` times their width) over the full width, with room for titles and colour bars.

    Returns
    -------
    figure, the axes of the pictures, the axes of the colour bars (none, one at the end, or one each)
    """
    bar_room, gap, title = 0.72, 0.1, 0.26
    n_bars = {"none": 0, "last": 1, "each": n}[bars]
    width = (FULL_INCH - n_bars * bar_room - (n - 1) * gap) / n
    height = width * ratio
    figure = Figure(figsize=(FULL_INCH, height + title), facecolor="white")
    panels, colour_axes = [], []
    x = 0.0
    for i in range(n):
        panels.append(figure.add_axes((x / FULL_INCH, 0.0, width / FULL_INCH, height / (height + title))))
        x += width
        if bars == "each" or (bars == "last" and i == n - 1):
            left, bottom, tall = (x + 0.06) / FULL_INCH, 0.16, 0.66
            colour_axes.append(figure.add_axes((left, bottom, 0.09 / FULL_INCH, tall)))
            x += bar_room
        x += gap
    return figure, panels, colour_axes


def style_axes(ax: Axes, title: str = "", xlabel: str = "", ylabel: str = "", grid: bool = True) -> None:
    """Give a plane axes the common look; labels carry the unit in brackets."""
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        ax.spines[side].set_color(GREY)
        ax.spines[side].set_linewidth(0.8)
    ax.tick_params(which="both", labelsize=_TEXT - 0.5, colors=INK, color=GREY, width=0.8)
    ax.tick_params(which="major", length=3)
    ax.set_axisbelow(True)
    if grid:
        ax.grid(True, color="#e6eaee", linewidth=0.7)
    ax.set_xlabel(xlabel, fontsize=_TEXT, color=INK)
    ax.set_ylabel(ylabel, fontsize=_TEXT, color=INK)
    if title:
        ax.set_title(title, fontsize=_TEXT + 0.5, color=INK, loc="left", fontweight="bold")


def style_axes_3d(ax: Any, title: str, labels: tuple[str, str, str]) -> None:
    """Give a spatial axes the common look."""
    for axis, label in zip((ax.xaxis, ax.yaxis, ax.zaxis), labels, strict=True):
        axis.set_pane_color((0.965, 0.972, 0.98, 1.0))
        axis._axinfo["grid"].update(color="#dde3e8", linewidth=0.6)
        axis.line.set_color(GREY)
        axis.set_label_text(label, fontsize=_TEXT - 0.5, color=INK)
        axis.set_tick_params(labelsize=_TEXT - 1.5, colors=INK, pad=0)
        axis.labelpad = 1
    if title:
        ax.set_title(title, fontsize=_TEXT + 0.5, color=INK, loc="left", fontweight="bold")


def log_axis(ax: Axes, values: Float[np.ndarray, " n"]) -> None:
    """Make the upright axis logarithmic, with plain numbers, if the values are positive and span more than a factor of 3."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0 or finite.min() <= 0.0 or finite.max() <= 3.0 * finite.min():
        ax.set_ylim(bottom=0.0)
        return
    few_decades = finite.max() < 60.0 * finite.min()
    ax.set_yscale("log")
    ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if few_decades else (1.0,)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_formatter(NullFormatter())


def equal_axes_3d(ax: Any, points: Float[np.ndarray, "n 3"], zoom: float = 1.0) -> None:
    """Same scale on all three axes, tight around the points (in the order of the plot's axes)."""
    finite = points[np.isfinite(points).all(axis=1)]
    if len(finite) == 0:
        finite = np.zeros((1, 3))
    low, high = finite.min(axis=0), finite.max(axis=0)
    span = np.maximum(high - low, max(float((high - low).max()) * 0.05, 1e-6))
    middle = (low + high) / 2
    for setter, m, s in zip((ax.set_xlim, ax.set_ylim, ax.set_zlim), middle, span, strict=True):
        setter(m - 0.53 * s, m + 0.53 * s)
    ax.set_box_aspect(span, zoom=zoom)
    for axis, s in zip((ax.xaxis, ax.yaxis, ax.zaxis), span / span.max(), strict=True):
        axis.set_major_locator(MaxNLocator(max(1, round(5 * s))))


def legend(ax: Any, **options: Any) -> None:
    """A legend without a frame, if anything has a label."""
    handles, _ = ax.get_legend_handles_labels()
    if handles:
        settings: dict[str, Any] = {"fontsize": _TEXT - 0.5, "frameon": False, "handlelength": 1.4} | options
        ax.legend(**settings)


def note(ax: Any, text: str, x: float = 0.98, y: float = 0.97, ha: str = "right", va: str = "top") -> None:
    """A small text in the corner of an axes, on a pale ground."""
    ax.text(
        x,
        y,
        text,
        transform=ax.transAxes,
        ha=ha,
        va=va,
        fontsize=_TEXT - 0.5,
        color=INK,
        bbox={"facecolor": "white", "alpha": 0.8, "edgecolor": "none", "pad": 1.5},
        zorder=10,
    )


def nothing_to_draw(ax: Axes, text: str) -> None:
    """Say in an empty axes why it is empty."""
    ax.set_axis_off()
    ax.text(0.5, 0.5, text, transform=ax.transAxes, ha="center", va="center", fontsize=_TEXT, color=GREY)


def colour_bar(figure: Figure, mappable: Any, axes: Any, label: str, **options: Any) -> None:
    """A slim colour bar with its unit, beside ``axes``, or in an axes of its own (``cax``)."""
    settings: dict[str, Any] = {"shrink": 0.85, "aspect": 28, "pad": 0.02} if axes is not None else {}
    bar = figure.colorbar(mappable, ax=axes, **(settings | options))
    bar.outline.set_visible(False)
    bar.ax.tick_params(labelsize=_TEXT - 1, colors=INK, color=GREY, length=2)
    bar.set_label(label, fontsize=_TEXT - 0.5, color=INK)


def round_down_125(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above ``value``.

    Examples
    --------
    >>> round_down_125(737.0), round_down_125(0.03)
    (500.0, 0.02)
    """
    if not math.isfinite(value) or value <= 0.0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value) + 1e-12)
    factor = next(f for f in (5.0, 2.0, 1.0) if f * power <= value * (1.0 + 1e-12))
    return float(f"{factor * power:.6g}")


def exaggeration(deviations: Float[np.ndarray, " n"], length: float) -> float:
    """Factor (1, 2, 5, 10 ...) that shows the larger deviations about ``length`` long; at least 1."""
    finite = np.abs(deviations[np.isfinite(deviations)])
    if len(finite) == 0 or length <= 0.0:
        return 1.0
    large = float(np.percentile(finite, 98.0))
    return max(1.0, round_down_125(length / large)) if large > 0.0 else 1.0


def robust_range(values: Float[np.ndarray, " n"], share: float = 0.5) -> tuple[float, float]:
    """Range of the values without the outermost ``share`` per cent on either side; never empty."""
    finite = values[np.isfinite(values)]
    if len(finite) == 0:
        return (0.0, 1.0)
    low, high = (float(p) for p in np.percentile(finite, [share, 100.0 - share]))
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def symmetric_limit(values: Float[np.ndarray, " n"]) -> float:
    """Limit of a diverging colour scale: the 99th percentile of the magnitude; never 0."""
    finite = np.abs(values[np.isfinite(values)])
    limit = float(np.percentile(finite, 99.0)) if len(finite) else 0.0
    return limit if limit > 0.0 else 1.0


def thinned(n: int, at_most: int) -> Any:
    """Indices of an even selection, always the same one: a fixed-seed sample in ascending order."""
    if n <= at_most:
        return np.arange(n)
    return np.sort(np.random.default_rng(0).choice(n, at_most, replace=False))


def svg_uri(figure: Figure) -> str:
    """The figure as an inline SVG image (for lines and few points)."""
    stream = io.BytesIO()
    with rc_context({"svg.hashsalt": "rotaline"}):  # the same figure gives the same file
        figure.savefig(stream, format="svg", metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


def png_uri(figure: Figure, dpi: float = 160.0) -> str:
    """The figure as an inline PNG image (for many points and pictures); 256 colours are enough for plots."""
    return "data:image/png;base64," + base64.b64encode(_png(figure, dpi, palette=True)).decode("ascii")


def jpeg_uri(figure: Figure, dpi: float = 190.0) -> str:
    """The figure as an inline JPEG image (for camera frames)."""
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    stream = io.BytesIO()
    Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3].copy()).save(stream, format="JPEG", quality=88)
    return "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


def save_png(figure: Figure, path: Path, dpi: float = 160.0) -> None:
    """Write the figure to a file of its own, whole or not at all."""
    with whole_file(path) as part:
        part.write_bytes(_png(figure, dpi, palette=False))


def _png(figure: Figure, dpi: float, palette: bool) -> bytes:
    figure.set_dpi(dpi)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[:, :, :3].copy())
    if palette:
        picture = picture.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        colours = np.array(picture.getpalette()).reshape(-1, 3)
        colours[colours.min(axis=1) >= 249] = 255
        picture.putpalette(colours.ravel().tolist())
    stream = io.BytesIO()
    picture.save(stream, format="PNG", optimize=False, compress_level=5)
    return stream.getvalue()


def series_colour(index: int) -> str:
    """Colour of the n-th of a few series."""
    return SERIES[index % len(SERIES)]


def view_label(names: Sequence[str], index: int) -> str:
    """Short name of a view on an axis: the file name without folder and ending."""
    return names[index].rsplit("/", 1)[-1].rsplit(".", 1)[0]
