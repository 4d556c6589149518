"""The verdict on the first page: a badge, what the rig can measure, the steps, and what to do."""

from dataclasses import dataclass

from rotaline.calibration.verdict.model import Finding, Level, StepVerdict, Verdict
from rotaline.io.report import numbers
from rotaline.io.report.contents import STEP_TITLES
from rotaline.io.report.page import KeyFigure
from rotaline.io.report.verdict_words import LEVEL_TITLES, figure_text, gain_text, nothing_found


@dataclass(frozen=True)
class StepLine:
    """One step for the template; ``figures`` are the numbers behind the judgement, as text."""

    title: str
    level: Level
    label: str
    text: str
    figures: tuple[str, ...]


@dataclass(frozen=True)
class Advice:
    """Something to do, with what shows that it is needed and what is gained."""

    title: str
    level: Level
    text: str
    action: str
    gain: str


@dataclass(frozen=True)
class VerdictBlock:
    """The verdict for the template; ``all_clear`` says in a sentence that nothing is to be done, empty if there is advice."""

    level: Level
    label: str
    text: str
    figures: tuple[KeyFigure, ...]
    steps: tuple[StepLine, ...]
    advice: tuple[Advice, ...]
    all_clear: str


def verdict_block(verdict: Verdict) -> VerdictBlock:
    """All that the first page says."""
    return VerdictBlock(
        verdict.level,
        LEVEL_TITLES[verdict.level],
        verdict.text,
        (
            KeyFigure(
                "U of a point near the axis", expanded(verdict.u_point_mm), "µm", "k = 2, from the calibration alone"
            ),
            KeyFigure("U of a single point", expanded(verdict.u_noise_mm), "µm", "k = 2, from the noise of the stripe"),
        ),
        tuple(_step(s) for s in verdict.steps),
        tuple(_advice(f) for f in verdict.findings),
        "" if verdict.findings else nothing_found(verdict.level),
    )


def expanded(u_mm: float) -> str:
    """U with k = 2 in µm of a standard uncertainty in mm."""
    return numbers.um(2.0 * u_mm)


def _step(step: StepVerdict) -> StepLine:
    return StepLine(
        STEP_TITLES.get(step.step, step.step),
        step.level,
        LEVEL_TITLES[step.level],
        step.text,
        tuple(figure_text(f) for f in step.figures),
    )


def _advice(finding: Finding) -> Advice:
    title = STEP_TITLES.get(finding.step, finding.step)
    return Advice(title, finding.level, finding.text, finding.action, gain_text(finding.gain))
