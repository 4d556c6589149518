"""What a person sees while a session is taken: placing things, progress frame by frame, the summary at the end."""

import csv
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from rotaline.cli.console import ConsoleObserver
from rotaline.errors import DeviceStateError
from rotaline.io.plan_file import angles_of, poses_of
from rotaline.io.plan_tables import PlanCapture, PlanTables
from rotaline.io.session_access import FRAMES_FILE
from rotaline.pipeline.acquire.acquire import Acquired
from rotaline.pipeline.acquire.sighting import stripe_level
from rotaline.pipeline.acquire.taking import FrameTaken
from rotaline.pipeline.acquire.tasks import wanted_images
from rotaline.pipeline.observer import LOG

_LEVEL_EVERY_S = 0.25
_DIM_LEVEL, _FULL_LEVEL = 0.3, 0.995


def ask(text: str) -> str:
    """Ask, and wait for the answer.

    Raises
    ------
    DeviceStateError
        If there is no terminal.
    """
    if not sys.stdin.isatty():
        raise DeviceStateError(f"This asks a person, but there is no terminal: {text}")
    return input(f"{text} ")


@dataclass(frozen=True)
class _Progress:
    """How far a capture is; ``began_s`` and ``n_before``: when this start began with it, and with how many frames."""

    label: str
    n_done: int
    n_planned: int
    began_s: float
    n_before: int = 0
    taken: FrameTaken | None = None
    level: float | None = None


class AcquisitionScreen(ConsoleObserver):
    """Hears of an acquisition (:class:`rotaline.pipeline.observer.Observer`), and shows one living picture of it at a time.

    Parameters
    ----------
    verbosity : 0 quiet: warnings, errors, and what a person has to do; 1 normal
    console : where; None: standard error
    clock_s : seconds, for the time that is left
    """

    def __init__(
        self, verbosity: int = 1, console: Console | None = None, clock_s: Callable[[], float] = time.monotonic
    ) -> None:
        super().__init__(verbosity)
        self._console = console or Console(stderr=True, highlight=False)
        self._clock_s = clock_s
        self._progress: _Progress | None = None
        self._shown: RenderableType | None = None
        self._live: Live | None = None
        self._level_s = 0.0

    @property
    def console(self) -> Console:
        """Where everything is shown."""
        return self._console

    def stage(self, title: str, stored: bool) -> None:
        """Name the capture that begins, or that is complete already."""
        LOG.info("%s%s", title, " (complete)" if stored else "")
        if self._verbosity >= 1:
            self._console.print(Text(title, style="bold") + Text("  complete already" if stored else "", style="dim"))

    @contextmanager
    def work(self, label: str, total: int) -> Iterator[Callable[[], None]]:
        """Show the progress of a capture while it lasts."""
        self._progress = _Progress(label, 0, total, self._clock_s())
        shown = self._verbosity >= 1 and self._console.is_terminal

        def count() -> None:
            now = self._progress
            assert now is not None
            n_before = now.n_before + (now.taken is None)  # what is counted before any frame has come was there already
            self._progress = _replaced(now, n_done=now.n_done + 1, n_before=n_before)

        try:
            if not shown:
                yield count
                return
            with self._living():
                yield count
        finally:
            self._progress = None

    def watch(self, taken: FrameTaken) -> None:
        """See a frame that was taken."""
        now = self._progress
        if now is None:
            return
        level = now.level
        if taken.laser and (level is None or self._clock_s() - self._level_s >= _LEVEL_EVERY_S):
            level, self._level_s = stripe_level(taken.image), self._clock_s()
        first = now.taken is None
        self._progress = _replaced(
            now,
            n_done=taken.n_done,
            n_planned=taken.n_planned,
            n_before=taken.n_done - 1 if first else now.n_before,
            taken=taken,
            level=level,
        )

    @contextmanager
    def showing(self) -> Iterator[Callable[[RenderableType], None]]:
        """Show something else in place of the progress; the callable that the context gives changes it."""

        def show(what: RenderableType) -> None:
            self._shown = what
            if self._live is not None:
                self._live.refresh()

        self._shown = Text("")
        try:
            with self._living():
                yield show
        finally:
            self._shown = None

    def ask(self, text: str) -> str:
        """Ask, and wait for the answer; nothing moves on the screen meanwhile. Raises as :func:`ask`."""
        with self.still():
            return ask(text)

    @contextmanager
    def still(self) -> Iterator[None]:
        """Nothing moves on the screen within: somebody is asked."""
        live, self._live = self._live, None
        if live is not None:
            live.stop()
        try:
            yield
        finally:
            if live is not None:
                live.start(refresh=True)
            self._live = live

    @contextmanager
    def _living(self) -> Iterator[None]:
        """One living picture, however often it is asked for."""
        if self._live is not None:
            yield
            return
        live = Live(get_renderable=self.picture, console=self._console, refresh_per_second=8, transient=True)
        with live:
            self._live = live
            try:
                yield
            finally:
                self._live = None

    def picture(self) -> RenderableType:
        """What is to be seen now."""
        if self._shown is not None:
            return self._shown
        return Text("") if self._progress is None else self._bar(self._progress)

    def _bar(self, now: _Progress) -> RenderableType:
        taken = now.taken
        bar = Table.grid(padding=(0, 2))
        bar.add_row(
            now.label,
            ProgressBar(now.n_planned, now.n_done, width=36, complete_style="cyan", finished_style="green"),
            f"frame {now.n_done} of {now.n_planned}",
            self._left(now),
        )
        if taken is None:
            return bar
        parts = []
        if taken.angle_deg is not None:
            parts.append(Text(f"angle {taken.angle_deg:.3f} deg"))
        parts.append(Text(f"exposure {_exposure(taken.exposure_us)}"))
        if now.level is not None:
            parts.append(_level_text(now.level))
        parts.append(Text(f"for the disk {taken.n_waiting}", style="yellow" if taken.n_waiting > 8 else ""))
        if taken.n_retaken:
            parts.append(Text(f"taken again {taken.n_retaken}", style="yellow"))
        return Group(bar, Text("  ").join(parts))

    def _left(self, now: _Progress) -> str:
        """Time left, from the frames of this start; not before some have come, and not where a person sets the pace."""
        n_here = now.n_done - now.n_before
        if now.taken is None or now.taken.angle_deg is None or n_here < 3:
            return ""
        left_s = (self._clock_s() - now.began_s) / n_here * (now.n_planned - now.n_done)
        return f"{timedelta(seconds=round(left_s))} left"


def _replaced(now: _Progress, **changes: object) -> _Progress:
    return _Progress(**{**vars(now), **changes})


def _exposure(exposure_us: float) -> str:
    return f"{exposure_us / 1000:.2f} ms" if exposure_us >= 1000 else f"{exposure_us:.0f} us"


def _level_text(level: float) -> Text:
    if level >= _FULL_LEVEL:
        return Text("stripe saturated", style="yellow")
    style = "yellow" if level < _DIM_LEVEL else "green"
    return Text(f"stripe {100 * level:.0f} % of full scale", style=style)


def placing(capture: PlanCapture, n_done: int, n_frames: int) -> Panel:
    """What the person is asked to put in its place."""
    lines = [Text(capture.text or _placing_text(capture), style="bold")]
    if n_done:
        what = f"{n_done} of {n_frames} frames are there already"
        if capture.role in ("camera", "laser-plane"):
            lines.append(Text(f"{what}; it goes on with the next pose."))
        else:
            text = f"{what}: it must stand as it stood. If it was moved, end here (Ctrl-C) and acquire into another folder."
            lines.append(Text(text, style="yellow"))
    if after := _what_follows(capture):
        lines.append(Text(after, style="dim"))
    return Panel(
        Group(*lines), title=f"Your turn: {capture.folder}", title_align="left", border_style="cyan", padding=(0, 1)
    )


def _placing_text(capture: PlanCapture) -> str:
    target = capture.target or capture.folder
    return {
        "camera": f"Have {target} at hand. {poses_of(capture)} poses follow, each guided on the screen.",
        "laser-plane": f"Have {target} at hand. {poses_of(capture)} poses in the light of the laser follow, each guided on the screen.",
        "axis": f"Stand {target} on the table, upright, facing the camera.",
        "artifact": f"Place {target} on the table, where camera and laser see it.",
        "scan": f"Place {target} on the table, where camera and laser see it.",
    }[capture.role]


def _what_follows(capture: PlanCapture) -> str:
    angles = angles_of(capture)
    if not angles:
        return (
            "The laser is on for a moment at each pose: do not look into it." if capture.role == "laser-plane" else ""
        )
    laser = "" if capture.role == "axis" else " The laser goes on: do not look into it."
    low, high = min(angles), max(angles)
    return f"It must not move on the table, which turns from {low:g} to {high:g} deg, {len(angles)} angles.{laser}"


def summary(acquired: Acquired, plan: PlanTables, seconds: float) -> Group:
    """What has been taken, from the tables in the session folder."""
    table = Table(
        "capture", "role", "frames", "angles or poses", "exposure", box=None, padding=(0, 2, 0, 0), header_style="bold"
    )
    for capture in plan.captures:
        rows = _rows(acquired.path / capture.folder, capture)
        angles = sorted(float(r["angle_deg"]) for r in rows if r["angle_deg"])
        places = (
            f"{angles[0]:.2f} to {angles[-1]:.2f} deg"
            if angles
            else f"{len({r['pose'] or r['image'] for r in rows})} poses"
        )
        exposures = []
        for light in ("off", "on"):
            values = sorted({float(r["exposure_us"]) for r in rows if r["laser"] == light and r["exposure_us"]})
            if values:
                span = _exposure(values[0]) + (f" to {_exposure(values[-1])}" if len(values) > 1 else "")
                exposures.append(f"laser {light} {span}")
        table.add_row(capture.folder, capture.role, str(len(rows)), places, ", ".join(exposures))
    parts = [f"{acquired.n_frames} frame{'' if acquired.n_frames == 1 else 's'} in {timedelta(seconds=round(seconds))}"]
    if acquired.n_before:
        parts.append(f"{acquired.n_before} of them by an earlier start")
    if acquired.n_retaken:
        parts.append(f"{acquired.n_retaken} taken again")
    return Group(table, Text(""), Text(", ".join(parts) + ".", style="bold"))


def _rows(folder: Path, capture: PlanCapture) -> list[dict[str, str]]:
    """The rows of the frames that are there and are those of the plan."""
    if not (folder / FRAMES_FILE).exists():
        return []
    with (folder / FRAMES_FILE).open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    listed = [row["image"] for row in rows]
    wanted = wanted_images(capture, listed, [image for image in listed if (folder / image).exists()])
    return [row for row in rows if row["image"] in wanted]
