"""The verdict on the first page: a badge, what the rig can measure, the steps, and what to do."""

import math
from dataclasses import dataclass

from rotaline.calibration.verdict.model import Figure, Finding, Level, StepVerdict, Verdict
from rotaline.io.report import numbers
from rotaline.io.report.contents import STEP_TITLES
from rotaline.io.report.page import KeyFigure

LEVEL_TITLES: dict[Level, str] = {
    "pass": "Pass",
    "doubtful": "Doubtful",
    "fail": "Fail",
    "none": "Not there",
}
"""How a level is called; ``none``: the session does not have the step."""

_SMALL = 0.1
"""Lengths (mm) and angles (rad) below this are given in millionths of a metre or radian."""
_LEAST_GAIN, _NOT_A_GAIN = 1.1, 30.0
"""A gain is said in between: less is not worth a word, more only says that nothing can be measured before it is done."""


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


def nothing_found(level: Level) -> str:
    """What to say where no cause was found."""
    if level == "pass":
        return "Nothing needs to be done."
    return "No cause could be named; the steps and the warnings say what was found."


def figure_text(figure: Figure) -> str:
    """One number behind a judgement: ``held-out RMS 0.052 px, below 0.08 px``."""
    value, unit = _readable(figure.value, figure.unit)
    return f"{figure.label} {value}{' ' + unit if unit else ''}" + (f", {figure.limit}" if figure.limit else "")


def _readable(value: float, unit: str) -> tuple[str, str]:
    """Counts as whole numbers, small lengths in µm and small angles in µrad, anything else to three digits."""
    name, _, rest = unit.partition(" ")
    if name in ("mm", "rad") and abs(value) < _SMALL:
        scale, small = (1e3, "µm") if name == "mm" else (1e6, "µrad")
        return numbers.significant(scale * value, 3), " ".join(filter(None, (small, rest)))
    if name not in ("mm", "rad", "px", "deg") and math.isfinite(value) and value == round(value):
        return numbers.count(round(value)), unit
    return numbers.significant(value, 3), unit


def gain_text(gain: float) -> str:
    """How much is gained, where that is a matter of degree."""
    if not _LEAST_GAIN <= gain < _NOT_A_GAIN:
        return ""
    times = numbers.fixed(gain, 1) if gain < 9.95 else numbers.count(round(gain))
    return f"The uncertainty of a measured point gets about {times} times smaller."


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
