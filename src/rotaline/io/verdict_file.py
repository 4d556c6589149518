"""``verdict.json``: whether a calibration is good, step by step, what spoils it and what to do; most useful first.

Levels are "pass", "doubtful", "fail", and "none" for a step that the session does not have. ``u_point_mm`` and ``u_noise_mm`` are standard
uncertainties (k = 1). Numbers that are not known are null.
"""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, BeforeValidator, ConfigDict, ValidationError

from rotaline.calibration.verdict.model import Figure, Finding, Level, StepVerdict, Verdict
from rotaline.errors import SessionError
from rotaline.io.files import read_json, write_json

VERDICT_FILE = "verdict.json"
FORMAT = "rotaline verdict"
VERSION = 1

_Number = Annotated[float, BeforeValidator(lambda value: float("nan") if value is None else value)]


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore")


class _Figure(_Part):
    label: str
    value: _Number
    unit: str
    limit: str = ""


class _Step(_Part):
    step: str
    level: Level
    text: str
    figures: list[_Figure] = []


class _Finding(_Part):
    cause: str
    step: str
    level: Level
    text: str
    action: str
    gain: _Number


class _Document(_Part):
    version: int
    level: Level
    text: str
    steps: list[_Step]
    findings: list[_Finding]
    u_point_mm: _Number
    u_noise_mm: _Number


def verdict_document(verdict: Verdict) -> dict[str, object]:
    """The verdict as it stands in the file."""
    return {"format": FORMAT, "version": VERSION} | asdict(verdict)


def write_verdict(path: Path, verdict: Verdict) -> None:
    """Write a verdict, whole or not at all.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    write_json(path, verdict_document(verdict))


def read_verdict(path: Path) -> Verdict:
    """Read what :func:`write_verdict` wrote.

    Raises
    ------
    SessionError
        If the file is missing, no verdict, or of another version.
    """
    try:
        found = _Document.model_validate(read_json(path, "verdict"))
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(str(part) for part in first["loc"]) or "the whole"
        raise SessionError(
            f"{path}: this is not a verdict of this program ({place}: {first['msg']}). Start `rotaline run` again."
        ) from error
    if found.version != VERSION:
        raise SessionError(
            f"{path}: found version {found.version} of the verdict, expected {VERSION}. Start `rotaline run` again."
        )
    return Verdict(
        found.level,
        found.text,
        tuple(
            StepVerdict(s.step, s.level, s.text, tuple(Figure(f.label, f.value, f.unit, f.limit) for f in s.figures))
            for s in found.steps
        ),
        tuple(Finding(f.cause, f.step, f.level, f.text, f.action, f.gain) for f in found.findings),
        found.u_point_mm,
        found.u_noise_mm,
    )
