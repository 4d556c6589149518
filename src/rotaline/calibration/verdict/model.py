"""What the verdict consists of."""

from dataclasses import dataclass
from typing import Literal

Level = Literal["pass", "doubtful", "fail", "none"]
"""``none``: the session does not have the step."""

CAUSES = (
    "session cannot be read",
    "over-exposure",
    "defocus",
    "boards nearly parallel",
    "camera uncertain",
    "lens model",
    "views disagree",
    "too few depths",
    "target moved between off and on",
    "drift",
    "sheet not flat",
    "wrong sense",
    "sense assumed",
    "wrong angle scale",
    "wrong pitch",
    "wrong artefact sizes",
    "camera moved",
    "steps disagree",
    "mount too well centred",
    "turntable eccentricity",
    "weak direction",
    "stage failed",
    "wrong result",
)
"""What may be named as the cause of a bad calibration."""

STEPS = ("session", "camera", "laser-plane", "axis", "artifact", "table", "scan", "measure")


@dataclass(frozen=True)
class Figure:
    """One number behind a judgement: ``value`` in ``unit``, and what it should be (``limit``, as text; empty if there is none)."""

    label: str
    value: float
    unit: str
    limit: str = ""


@dataclass(frozen=True)
class Finding:
    """A cause that was found, what shows it, and what to do.

    Attributes
    ----------
    cause : one of ``CAUSES``
    step : of ``STEPS``: the step that it spoils
    level : doubtful or fail
    text : what was found, with numbers
    action : what to do
    gain : how useful it is to do that, larger first: about how many times smaller the uncertainty of a measured point gets
    """

    cause: str
    step: str
    level: Level
    text: str
    action: str
    gain: float


@dataclass(frozen=True)
class StepVerdict:
    """The judgement of one step: from residuals, held-out data, identifiability, consistency with the other steps."""

    step: str
    level: Level
    text: str
    figures: tuple[Figure, ...] = ()


@dataclass(frozen=True)
class Verdict:
    """Of the whole: the worst of its steps; ``findings`` most useful first.

    ``u_point_mm`` is the standard uncertainty of a point near the axis from the calibration alone, ``u_noise_mm`` that of a single
    point from the stripe's noise: what the rig can measure.
    """

    level: Level
    text: str
    steps: tuple[StepVerdict, ...]
    findings: tuple[Finding, ...]
    u_point_mm: float
    u_noise_mm: float
