"""What a person sees in the terminal: stages, progress bars, tables. Everything goes to standard error but tables."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console
from rich.padding import Padding
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from rotaline.calibration.verdict.model import Level, Verdict
from rotaline.io.calibration_file import CalibrationFile
from rotaline.io.report.contents import STEP_TITLES
from rotaline.io.report.verdict_words import LEVEL_TITLES, figure_text, gain_text, nothing_found
from rotaline.io.results import MeasurementEntry
from rotaline.io.session import Problem, Session
from rotaline.pipeline.observer import LOG
from rotaline.pipeline.stages import PlannedStage


class ConsoleObserver:
    """Shows a run in the terminal and writes it to the log.

    ``verbosity``: 0 quiet (warnings and errors only), 1 normal, 2 verbose (every figure).
    """

    def __init__(self, verbosity: int = 1) -> None:
        self._verbosity = verbosity
        self._console = Console(stderr=True, highlight=False)

    def stage(self, title: str, stored: bool) -> None:
        """Name the stage that begins."""
        LOG.info("%s%s", title, " (stored result)" if stored else "")
        if self._verbosity >= 1:
            self._console.print(
                f"[bold]{title}[/bold]" + ("  [dim]stored result[/dim]" if stored else ""), soft_wrap=True
            )

    @contextmanager
    def work(self, label: str, total: int) -> Iterator[Callable[[], None]]:
        """Show a progress bar while the work lasts."""
        if self._verbosity < 1 or not self._console.is_terminal:
            yield lambda: None
            return
        bar = Progress(
            TextColumn("  {task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeRemainingColumn(),
            console=self._console,
            transient=True,
        )
        with bar:
            task = bar.add_task(label, total=total)
            yield lambda: bar.advance(task)

    def note(self, text: str) -> None:
        """Show a figure."""
        LOG.info("%s", text)
        if self._verbosity >= 1:
            self._console.print(f"  {text}", markup=False, soft_wrap=True)

    def warning(self, text: str) -> None:
        """Show a warning."""
        LOG.warning("%s", text)
        self._console.print(f"  warning: {text}", style="yellow", markup=False, soft_wrap=True)


def measurement_table(entries: Sequence[MeasurementEntry], initial: Sequence[MeasurementEntry] = ()) -> Table:
    """The measured sizes, in mm; with the errors that the initial axis would have given, where it differs."""
    before = {(e.capture, e.feature, e.name): e for e in initial}
    table = Table(title="Measured features (mm, table frame)", title_justify="left")
    for name, justify in (
        ("capture", "left"),
        ("feature", "left"),
        ("quantity", "left"),
        ("value", "right"),
        ("U (k = 2)", "right"),
        ("reference", "right"),
        ("error", "right"),
        ("error with initial axis", "right"),
        ("rms", "right"),
        ("points", "right"),
    ):
        table.add_column(name, justify=justify)  # type: ignore[arg-type]
    for entry in entries:
        if entry.measurement is None:
            table.add_row(entry.capture, entry.feature, "not measured", *["–"] * 7)
            continue
        earlier = before.get((entry.capture, entry.feature, entry.name))
        for quantity, value in entry.measurement.value.items():
            table.add_row(
                entry.capture,
                entry.feature,
                quantity.replace("_", " "),
                _mm(value),
                _mm(_expanded(entry.measurement.uncertainty.get(quantity))),
                _mm(entry.reference.get(quantity)),
                _mm(entry.error.get(quantity), signed=True),
                _mm(earlier.error.get(quantity) if earlier else None, signed=True),
                _mm(entry.measurement.rms),
                str(entry.measurement.n_points),
            )
    return table


def _expanded(u: float | None) -> float | None:
    """Expanded uncertainty, k = 2."""
    return None if u is None else 2.0 * u


def _mm(value: float | None, signed: bool = False) -> str:
    if value is None or value != value:
        return "–"
    return f"{value:+.4f}" if signed else f"{value:.4f}"


def show_check(path: str, session: Session | None, stages: Sequence[PlannedStage], problems: Sequence[Problem]) -> None:
    """What a session folder holds, which stages it allows, what is wrong with it."""
    console = Console(highlight=False)
    if session is not None:
        width, height = session.image_size
        console.print(f"{path}: {len(session.captures)} captures, images of {width} x {height} pixels", markup=False)
        table = Table("capture", "role", "target", "frames", "laser on", "angles")
        for capture in session.captures:
            angles = [math.degrees(f.angle_rad) for f in capture.frames if f.angle_rad is not None]
            span = f"{min(angles):.2f} to {max(angles):.2f} deg" if angles else "–"
            table.add_row(
                capture.folder,
                capture.role,
                capture.target_name or "–",
                str(len(capture.frames)),
                str(len(capture.on_frames)),
                span,
            )
        console.print(table)
        table = Table("stage", "possible", "why")
        for stage in stages:
            table.add_row(stage.name, "yes" if stage.possible else "no", stage.text)
        console.print(table)
    for problem in problems:
        kind = "error" if problem.fatal else "warning"
        console.print(f"{kind}: {problem}", style="red" if problem.fatal else "yellow", markup=False, soft_wrap=True)
    if session is None:
        console.print(f"{path}: this session cannot be processed; mend the errors first.", markup=False, soft_wrap=True)
    elif not problems:
        console.print("Nothing wrong was found.")


def show_calibration(content: CalibrationFile, path: Path) -> None:
    """The calibrated system in a few lines."""
    console = Console(highlight=False)
    table = Table("quantity", "value", "frame")
    if (camera := content.camera) is not None:
        table.add_row("fx, fy", f"{camera.fx:.2f}, {camera.fy:.2f} px", "image")
        table.add_row("cx, cy", f"{camera.cx:.2f}, {camera.cy:.2f} px", "image")
    if (plane := content.laser_plane_camera) is not None:
        normal = ", ".join(f"{v:+.6f}" for v in plane.normal)
        table.add_row("laser plane", f"normal ({normal}), offset {plane.offset:.4f} mm", "camera")
    if (axis := content.rotation_axis_camera) is not None:
        table.add_row("axis point", ", ".join(f"{v:.4f}" for v in axis.point) + " mm", "camera")
        table.add_row("axis direction", ", ".join(f"{v:+.6f}" for v in axis.direction), "camera")
        table.add_row(
            "sense of angle_deg", "right-handed" if content.turn_sense > 0 else "left-handed", "about the axis"
        )
    console.print(table)
    console.print(f"Calibration: {path}", markup=False, soft_wrap=True)


_LEVEL_STYLES: dict[Level, str] = {"pass": "green", "doubtful": "yellow", "fail": "red", "none": "dim"}


def show_verdict(verdict: Verdict) -> None:
    """The badge with its sentence, the steps, and what to do; wrapped at the width of the terminal."""
    console = Console(highlight=False)
    badge = Text(f" {LEVEL_TITLES[verdict.level].upper()} ", style=f"bold reverse {_LEVEL_STYLES[verdict.level]}")
    console.print(Text.assemble(badge, " ", verdict.text))
    console.print()
    table = Table("step", "verdict", "what the data say", box=None, padding=(0, 2, 0, 0), header_style="bold")
    for step in verdict.steps:
        said = Text(step.text)
        if step.figures:
            said.append("\n" + "; ".join(figure_text(f) for f in step.figures), style="dim")
        level = Text(LEVEL_TITLES[step.level].lower(), style=_LEVEL_STYLES[step.level])
        table.add_row(Text(STEP_TITLES.get(step.step, step.step)), level, said)
    console.print(table)
    console.print()
    console.print(Text("What to do" + (", most useful first" if len(verdict.findings) > 1 else ""), style="bold"))
    for i, finding in enumerate(verdict.findings, 1):
        title = STEP_TITLES.get(finding.step, finding.step)
        console.print(Text(f"{i}. {finding.action}", style="bold"))
        why = Text.assemble(
            (title, _LEVEL_STYLES[finding.level]), ": ", " ".join(filter(None, (finding.text, gain_text(finding.gain))))
        )
        console.print(Padding(why, (0, 0, 0, 3)))
    if not verdict.findings:
        console.print(Text(nothing_found(verdict.level)))
