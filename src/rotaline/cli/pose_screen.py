"""The screen on which a person is guided from pose to pose: what the camera sees, what is wrong, what lacks, what to do next."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.measure import Measurement
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from rotaline.pipeline.acquire.guidance import CELLS, REST_S, Advice, Guide, Rest
from rotaline.pipeline.acquire.sighting import DARK, SATURATED, Sighting, View, view_of
from rotaline.vision.images import Image, small_picture
from rotaline.vision.targets.model import TargetDetection

_MAP_LINES = CELLS[1] + 1
_LEAST_LINES = _MAP_LINES + 11
"""Map, five figures, two sentences of which one takes two lines, frame, and the line in which the cursor stands."""
_MOST_PICTURE_LINES = 18
_LEAST_PICTURE_COLUMNS = 20
_FIGURES_COLUMNS = 38
_MAP_COLUMNS = 2 * CELLS[0] + 3
_FRAME_COLUMNS, _FRAME_LINES = 4, 3
"""What the frame takes; of the lines, one is that in which the cursor stands."""
_KEYS = (
    "Enter: take it as it is    Ctrl-C: end; what was taken is kept",
    "Enter: take it    Ctrl-C: end",
    "Enter, Ctrl-C",
)
_MOST_MARKS = 3
_STYLES = {"bad": "bold red", "move": "bold yellow", "hold": "bold green", "take": "bold reverse green"}
_SCALE_COLUMNS = 24


@dataclass(frozen=True, eq=False)
class PoseScreen:
    """One preview of a pose, as the person sees it.

    Attributes
    ----------
    title : capture and target
    index : number of the pose, from 0 on
    guide : the poses so far
    image : the preview
    seen : what it shows
    rest : how long the target has been there
    advice : what to do
    """

    title: str
    index: int
    guide: Guide
    image: Image
    seen: Sighting
    rest: Rest | None
    advice: Advice

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        """As much as the terminal has room for; 80 columns and 24 lines are enough for all of it, and what to do now is always there."""
        view = None if self.seen.detection is None else view_of(self.seen.detection)
        within = options.update(width=options.max_width - _FRAME_COLUMNS, height=None)
        style = _STYLES[self.advice.level]
        sentences = [
            Text(self.advice.text, style=style),
            Text(
                f"Wanted: {self.guide.goal.text}.", style="dim" if self.advice.level in ("hold", "take") else "yellow"
            ),
        ]
        room = console.size.height - _FRAME_LINES - sum(_n_lines(console, within, text) for text in sentences)
        below = self._tilts() if self.guide.role == "camera" else self._distances(view)
        body: list[RenderableType] = []
        beside = self._beside(within.max_width, max(0, console.size.height - _LEAST_LINES), view, below)
        if beside is not None and Measurement.get(console, options, beside).maximum <= within.max_width:
            body = [beside]
        if not body or _n_lines(console, within, body[0]) > room:
            body = _that_fit(console, within, room, (self._figures(view), self._map(view), below))
        if room > sum(_n_lines(console, within, part) for part in body):
            body.insert(0, Text(""))
        yield Panel(
            Group(*sentences, *body),
            title=f"{self.title}: pose {self.index + 1} of {self.guide.n_poses}",
            title_align="left",
            subtitle=next((keys for keys in _KEYS if len(keys) <= within.max_width), ""),
            subtitle_align="left",
            border_style=style.split()[-1],
            padding=(0, 1),
        )

    def _beside(self, columns: int, spare: int, view: View | None, below: RenderableType) -> Table | None:
        """The picture beside the map, and the figures below; None where there is no room for a picture."""
        picture_rows = min(_MAP_LINES + spare, _MOST_PICTURE_LINES)
        picture_columns = min(columns - _MAP_COLUMNS, round(2 * picture_rows * self._aspect))
        if picture_columns < _LEAST_PICTURE_COLUMNS:
            return None
        table = Table.grid(padding=(0, 3, 0, 0))
        table.add_column(min_width=_FIGURES_COLUMNS)
        table.add_column()
        table.add_row(self._picture(picture_columns), self._map(view))
        table.add_row(self._figures(view), below)
        return table

    @property
    def _aspect(self) -> float:
        return self.seen.image_size[0] / self.seen.image_size[1]

    def _figures(self, view: View | None) -> Table:
        seen, light = self.seen, self.seen.light
        table = Table.grid(padding=(0, 2))
        table.add_column(style="dim", no_wrap=True)
        table.add_column(no_wrap=True)
        if seen.detection is None:
            table.add_row("target", Text("not found", style="red"))
        else:
            n, total = len(seen.detection.point_ids), len(seen.detection.target.points_board())
            table.add_row("target", Text(f"found, {n} of {total} points", style="green"))
        edges = Text("–", style="dim")
        if seen.blur is not None:
            style = "green" if seen.blur.sharp else "red"
            edges = Text(f"{seen.blur.most_px:.1f} px (good to {seen.blur.limit_px:.1f} px)", style=style)
        table.add_row("edges", edges)
        good = light.white >= DARK and light.saturated <= SATURATED
        what = "white" if seen.detection is not None else "brightest"
        table.add_row(
            "light", Text(f"{what} {100 * light.white:.0f} % of full scale", style="green" if good else "red")
        )
        tilt = "–"
        if view is not None:
            attitude = self.guide.attitude(view)
            tilt = f"{attitude.tilt_deg:.0f} deg" + (
                f", {attitude.nearest} edge nearer" if attitude.tilt_deg >= 5 else ""
            )
        table.add_row("tilt", tilt)
        share = 0.0 if self.rest is None or seen.detection is None else min(1.0, self.rest.seconds / REST_S)
        n = round(10 * share)
        table.add_row("at rest", Text("■" * n + "□" * (10 - n), style="green" if share == 1 else ""))
        return table

    def _picture(self, columns: int) -> Text:
        """Half blocks: two pixels, one above the other, in each character; the outer points that were found in green."""
        picture, scale = small_picture(self.image, columns)
        pixels = np.array(picture[: len(picture) // 2 * 2])
        if self.seen.detection is not None:
            u, v = np.floor((_outer(self.seen.detection) + 0.5) * scale).astype(int).T
            inside = (u >= 0) & (v >= 0) & (u < pixels.shape[1]) & (v < pixels.shape[0])
            pixels[v[inside], u[inside]] = (0, 200, 80)
        text = Text()
        for upper, lower in zip(pixels[::2], pixels[1::2], strict=True):
            for a, b in zip(upper, lower, strict=True):
                text.append("▀", style=f"rgb({a[0]},{a[1]},{a[2]}) on rgb({b[0]},{b[1]},{b[2]})")
            text.append("\n")
        text.right_crop(1)
        return text

    def _map(self, view: View | None) -> Group:
        """The image in cells: where the poses so far have measured, where this one does, where it is wanted."""
        guide = self.guide
        here = (
            guide.cells(view) if view is not None and (guide.role == "camera" or view.stripe_uv is not None) else None
        )
        zone = guide.goal.zone
        text = Text()
        for r, row in enumerate(guide.covered):
            for c, covered in enumerate(row):
                wanted = zone == (3 * c // CELLS[0], 3 * r // CELLS[1])
                if here is not None and here[r, c]:
                    text.append("▓▓", style="cyan")
                elif covered:
                    text.append("██", style="green")
                else:
                    text.append("░░" if wanted else "· ", style="yellow" if wanted else "dim")
            text.append("\n")
        text.right_crop(1)
        what = "measured" if guide.role == "camera" else "stripe seen"
        legend = Text.assemble(("██", "green"), f" {what} {100 * guide.share_covered:.0f} %  ")
        if here is not None:
            legend.append_text(Text.assemble(("▓▓", "cyan"), " now  "))
        if zone is not None:
            legend.append_text(Text.assemble(("░░", "yellow"), " wanted"))
        return Group(text, legend)

    def _tilts(self) -> RenderableType:
        """How many poses have which edge towards the camera."""
        guide = self.guide
        marks = {
            e: Text(_marks(n, guide.tilts_wanted), style="green" if n >= guide.tilts_wanted else "yellow")
            for e, n in guide.tilts.items()
        }
        table = Table.grid(padding=(0, 1))
        table.add_column(justify="right")
        table.add_column(justify="center")
        table.add_column()
        table.add_row("", Text.assemble("upper ", marks["upper"]), "")
        table.add_row(
            Text.assemble("left ", marks["left"]),
            Text("towards camera", style="dim"),
            Text.assemble(marks["right"], " right"),
        )
        table.add_row("", Text.assemble("lower ", marks["lower"]), "")
        return table

    def _distances(self, view: View | None) -> Text:
        """Near to far, the poses so far and this one."""
        taken = [a.distance_mm for a in self.guide.attitudes]
        now = None if view is None else self.guide.attitude(view).distance_mm
        every = [*taken, *([now] if now is not None else [])]
        if not every:
            return Text("no pose yet", style="dim")
        middle = float(np.median(every))
        low, high = min(*every, 0.9 * middle), max(*every, 1.1 * middle)
        line = ["─"] * _SCALE_COLUMNS
        for distance in taken:
            line[_place(distance, low, high)] = "●"
        text = Text("near ")
        text.append("".join(line), style="green")
        if now is not None:
            place = 5 + _place(now, low, high)
            text = Text.assemble(text[:place], ("◆", "bold cyan"), text[place + 1 :])
        text.append(" far")
        return text


def _outer(detection: TargetDetection) -> Float[np.ndarray, "k 2"]:
    """The points on the rim of the grid, px."""
    columns, rows = detection.target.grid_size
    r, c = np.divmod(detection.point_ids, columns)
    return np.asarray(detection.uv[(r == 0) | (r == rows - 1) | (c == 0) | (c == columns - 1)])


def _marks(n: int, wanted: int) -> str:
    return "●" * min(n, wanted) + "○" * (wanted - n) if wanted <= _MOST_MARKS else f"{n}/{wanted}"


def _n_lines(console: Console, options: ConsoleOptions, what: RenderableType) -> int:
    return len(console.render_lines(what, options))


def _that_fit(
    console: Console, options: ConsoleOptions, room: int, parts: Sequence[RenderableType]
) -> list[RenderableType]:
    """One below the other, those that still fit; the first ones count most."""
    fitting: list[RenderableType] = []
    for part in parts:
        n = _n_lines(console, options, part)
        if n <= room:
            fitting.append(part)
            room -= n
    return fitting


def _place(distance: float, low: float, high: float) -> int:
    return round((_SCALE_COLUMNS - 1) * (distance - low) / (high - low))


def pose_line(guide: Guide, index: int, seen: Sighting) -> str:
    """A line that stays when a pose has been taken."""
    parts: Sequence[str] = ()
    if seen.detection is not None:
        view = view_of(seen.detection)
        n, total = len(seen.detection.point_ids), len(seen.detection.target.points_board())
        parts = [f"{n} of {total} points"]
        if view is not None:
            attitude = guide.attitude(view)
            parts.append(
                f"tilted by {attitude.tilt_deg:.0f} deg"
                + (f", {attitude.nearest} edge nearer" if attitude.tilt_deg >= 5 else "")
            )
    return f"Pose {index + 1} of {guide.n_poses} is taken: {', '.join(parts)}."
