"""The drift of the rig on the page, where an acquisition took reference frames."""

import math

from rotaline.io.drift_file import CaptureDrift, ReferenceShift
from rotaline.io.report import numbers
from rotaline.io.report.contents import ReportContents, StageWarning
from rotaline.io.report.figures import drift as figures
from rotaline.io.report.page import Block, Column, Gallery, Level, Paragraph, Row, Section, Table, picture
from rotaline.io.report.warnings import warnings_of


def section(contents: ReportContents, warnings: tuple[StageWarning, ...]) -> Section:
    """How far the stripe moved, capture by capture."""
    mine = warnings_of("drift", warnings)
    drawn = tuple(d for d in contents.drift if len(d.compared) > 1)
    blocks: list[Block] = [
        Paragraph(
            "A reference frame shows the same part at the same angle as the first one of its capture. Where its stripe lies elsewhere, camera, laser "
            "or table have moved since; all points that were taken then have moved with it."
        )
    ]
    if drawn:
        blocks.append(
            Gallery(
                (
                    picture(
                        lambda: figures.shifts(drawn),
                        "Left: shift of the stripe, bars U (k = 2), grey: the standard uncertainty that points have anyway. A curve that "
                        "levels off is a rig that gets warm. Right: brightness; it follows the temperature of the laser, and the exposure if that was changed.",
                    ),
                )
            )
        )
    blocks += [_table(drift) for drift in contents.drift]
    text, level = _judge(drawn)
    return Section("drift", "Drift", "Drift", text, level, mine, tuple(blocks))


def _judge(drifts: tuple[CaptureDrift, ...]) -> tuple[str, Level]:
    found = [(d, d.largest) for d in drifts]
    worst, frame = max(found, key=lambda pair: abs(pair[1].shift.shift_px) if pair[1] else 0.0, default=(None, None))
    if worst is None or frame is None:
        return "No reference frame could be compared with another one.", "none"
    return f"The largest shift is {_size(worst, frame)}, in {worst.folder}.", "good"


def _size(drift: CaptureDrift, frame: ReferenceShift) -> str:
    shift = frame.shift
    text = f"{numbers.fixed(shift.shift_px, 3, signed=True)} px"
    if math.isfinite(drift.mm_per_px):
        text += f", {numbers.um(abs(shift.shift_px) * drift.mm_per_px)} µm at the part"
    return text


def _table(drift: CaptureDrift) -> Table:
    limit = f"a point is uncertain by {numbers.fixed(drift.limit_px, 3)} px"
    if math.isfinite(drift.limit_mm):
        limit = f"points are uncertain by {numbers.um(drift.limit_mm)} µm"
    return Table(
        f"Reference frames of {drift.folder} against the first one.",
        (
            Column("Frame", numeric=False),
            Column("Time", "min"),
            Column("Shift", "px"),
            Column("u (k = 1)", "px"),
            Column("Shift", "µm"),
            Column("u (k = 1)", "µm"),
            Column("Brightness", "%"),
            Column("u (k = 1)", "%"),
            Column("Width", "%"),
        ),
        tuple(_row(frame, drift.mm_per_px) for frame in drift.frames),
        f"Shifts to the right (of a level stripe: downwards) are positive; {limit}." if drift.compared else "",
    )


def _row(frame: ReferenceShift, mm_per_px: float) -> Row:
    if frame.reason:
        return Row((frame.name, numbers.fixed(frame.minutes, 1), f"not compared: {frame.reason}"), "failed")
    s = frame.shift
    return Row(
        (
            frame.name,
            numbers.fixed(frame.minutes, 1),
            numbers.fixed(s.shift_px, 4, signed=True),
            numbers.fixed(s.u_px, 4),
            numbers.um(s.shift_px * mm_per_px, signed=True),
            numbers.um(s.u_px * mm_per_px),
            numbers.percent(s.brightness - 1.0, signed=True),
            numbers.percent(s.u_brightness),
            numbers.percent(s.width - 1.0, signed=True),
        )
    )
