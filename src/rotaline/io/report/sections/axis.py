"""The initial rotation axis on the page."""

import numpy as np

from rotaline.calibration.model import AxisCalibration
from rotaline.io.report import numbers
from rotaline.io.report.contents import ReportContents, StageWarning
from rotaline.io.report.figures import axis as figures
from rotaline.io.report.page import Block, Column, Gallery, Level, Row, Section, Table, picture
from rotaline.io.report.sections.overlays import overlay_blocks
from rotaline.io.report.warnings import warnings_of


def section(contents: ReportContents, warnings: tuple[StageWarning, ...]) -> Section:
    """Circles, centres, axis, sense, frames."""
    mine = warnings_of("axis", warnings)
    calibration = contents.axis
    if calibration is None:
        return Section(
            "axis",
            "Initial rotation axis",
            "Initial axis",
            warnings=mine,
            missing="No initial axis from a target on the turntable"
            + (": the axis was found from the artefact alone." if _found_from_artifact(contents) else "."),
        )
    judgement, level = _judge(calibration, _what_follows(contents))
    blocks: list[Block] = [
        _parameters(calibration),
        *overlay_blocks(contents, "axis"),
        Gallery(
            (
                picture(
                    lambda: figures.single_circle(calibration),
                    "One corner at all angles in the plane of its circle, deviations exaggerated as stated (the article's figure "
                    "10a). The deviations should be random; waves along the arc are errors of the angles or the poses.",
                    "half",
                ),
                picture(
                    lambda: figures.circles_3d(calibration),
                    "Tracks of some corners (blue), the centres of all circles (red) and the axis (black) in the camera frame "
                    "(the article's figure 10b). The centres should lie on one line.",
                    "half",
                    "png",
                ),
                picture(
                    lambda: figures.checks(calibration),
                    "Left: centres seen along the axis (cross); their spread is what a single circle is worth. Middle: short radii "
                    "or far corners fit worse. Right: how far the board turned beyond the table's reading, median removed; steps "
                    "or waves come from the angle read-out.",
                    "full",
                    "png",
                ),
            )
        ),
        _frames(calibration),
    ]
    return Section("axis", "Initial rotation axis", "Initial axis", judgement, level, mine, tuple(blocks))


def _found_from_artifact(contents: ReportContents) -> bool:
    if contents.joint is not None:
        return contents.joint.axis_camera is not None
    return contents.artifact is not None


def _what_follows(contents: ReportContents) -> str:
    """How the sentence about the uncertainty of the axis ends."""
    if contents.joint is not None:
        return "; the joint estimate below refines it."
    if contents.artifact is not None:
        return "; the stepped cylinder refines it below."
    return ": a stepped cylinder would refine it."


def _used_angles_deg(calibration: AxisCalibration) -> np.ndarray:
    """Table angles of the used frames in one piece, deg: their range is the arc that was seen."""
    return np.rad2deg(figures.unwrapped(np.array([f.angle_rad for f in calibration.frames if f.used])))


def _judge(calibration: AxisCalibration, what_follows: str) -> tuple[str, Level]:
    angles = _used_angles_deg(calibration)
    n, used = len(calibration.frames), len(angles)
    span = float(np.ptp(angles)) if used else 0.0
    text = (
        f"Circles {numbers.um(calibration.rms_mm)} µm RMS over {used} of {numbers.plural(n, 'frame')} that span "
        f"an arc of {numbers.fixed(span, 1)} deg; the axis is known to {numbers.fixed(calibration.u_direction_rad * 1e6, 0)} µrad in "
        f"direction and {numbers.um(calibration.u_position_mm)} µm in position (k = 1). Short arcs make the circle centres, "
        f"and so the axis, uncertain{what_follows}"
    )
    if used < 3 or not np.isfinite(calibration.u_position_mm):
        return text, "poor"
    return text, "good" if used >= 0.8 * n and calibration.u_position_mm <= 0.02 else "fair"


def _parameters(calibration: AxisCalibration) -> Table:
    axis = calibration.axis_camera
    angles = _used_angles_deg(calibration)
    arc = (
        f"{numbers.fixed(float(angles.min()), 1)} … {numbers.fixed(float(angles.max()), 1)}"
        if len(angles)
        else numbers.MISSING
    )
    rows = (
        (
            "axis direction (up), camera frame",
            "(" + ", ".join(numbers.fixed(float(x), 6) for x in axis.direction) + ")",
            numbers.fixed(calibration.u_direction_rad * 1e6, 1) + " µrad",
            "1",
        ),
        (
            "axis point, camera frame",
            "(" + ", ".join(numbers.mm(float(x)) for x in axis.point) + ")",
            numbers.mm(calibration.u_position_mm) + " mm",
            "mm",
        ),
        (
            "sense of the table's angles about the axis",
            "right-handed (+1)" if calibration.turn_sense > 0 else "left-handed (−1)",
            "",
            "",
        ),
        ("circles (corners of the target)", numbers.count(len(calibration.point_ids)), "", ""),
        ("corners from their circles, RMS", numbers.mm(calibration.rms_mm), "", "mm"),
        ("circle centres from the axis, RMS", numbers.mm(calibration.centre_line_rms_mm), "", "mm"),
        ("table angles used", arc, "", "deg"),
    )
    return Table(
        "Initial rotation axis, eq. (8)–(10).",
        (Column("Quantity", numeric=False), Column("Value"), Column("u (k = 1)"), Column("Unit", numeric=False)),
        tuple(Row(r) for r in rows),
    )


def _frames(calibration: AxisCalibration) -> Table:
    return Table(
        "Frames of the target on the turntable.",
        (
            Column("Frame", numeric=False),
            Column("Table angle", "deg"),
            Column("Pose RMS", "px"),
            Column("Used", numeric=False),
        ),
        tuple(
            Row(
                (
                    f.name,
                    numbers.fixed(float(np.rad2deg(f.angle_rad)), 3),
                    numbers.fixed(f.rms_px, 3),
                    "yes" if f.used else f"no: {f.reason}",
                ),
                "plain" if f.used else "dim",
            )
            for f in calibration.frames
        ),
        stacks=2 if len(calibration.frames) > 12 else 1,
    )
