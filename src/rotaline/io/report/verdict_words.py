"""The words of a verdict, for the report and for the terminal."""

import math

from rotaline.calibration.verdict.model import Figure, Level
from rotaline.io.report import numbers

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
