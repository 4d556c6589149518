"""The session and the rig: captures, targets, and what follows from the calibration about the geometry."""

from rotaline.io.report import numbers
from rotaline.io.report.contents import ReportContents, StageWarning
from rotaline.io.report.figures import rig as rig_figures
from rotaline.io.report.page import Block, Column, Gallery, Heading, Row, Section, Table, picture
from rotaline.io.report.rig_geometry import describe_rig
from rotaline.io.report.warnings import warnings_of


def section(contents: ReportContents, warnings: tuple[StageWarning, ...]) -> Section:
    """Captures, targets and the layout of the rig."""
    blocks: list[Block] = []
    if contents.captures:
        blocks.append(
            Table(
                "Captures of the session.",
                (
                    Column("Folder", numeric=False),
                    Column("Role", numeric=False),
                    Column("Target", numeric=False),
                    Column("Frames", "n"),
                    Column("Laser on", "n"),
                    Column("Image size", "px"),
                ),
                tuple(
                    Row(
                        (
                            c.folder,
                            c.role,
                            c.target or numbers.MISSING,
                            numbers.count(c.n_frames),
                            numbers.count(c.n_laser_on),
                            f"{c.image_size[0]} × {c.image_size[1]}",
                        )
                    )
                    for c in contents.captures
                ),
            )
        )
    if contents.targets:
        blocks.append(
            Table(
                "Targets, with the sizes that the session states: every length in this report goes back to them.",
                (Column("Target", numeric=False), Column("Description", numeric=False)),
                tuple(Row((name, text)) for name, text in contents.targets.items()),
            )
        )
    if contents.calibration is not None:
        blocks += _rig(contents)
    n_frames = sum(c.n_frames for c in contents.captures)
    text = f"{numbers.plural(len(contents.captures), 'capture')} with {numbers.plural(n_frames, 'frame')}."
    if contents.calibration is None:
        text += " The calibration is not complete, so there is no picture of the rig."
    return Section("rig", "Session and rig", "Rig", text, "none", warnings_of("session", warnings), tuple(blocks))


def _rig(contents: ReportContents) -> list[Block]:
    calibration = contents.calibration
    assert calibration is not None
    geometry = describe_rig(calibration)
    plane, axis = calibration.laser_plane_camera, calibration.rotation_axis_camera

    def vector(v: object, decimals: int) -> str:
        return "(" + ", ".join(numbers.fixed(float(x), decimals) for x in v) + ")"  # type: ignore[attr-defined]

    rows = (
        ("Laser plane, normal", "camera", vector(plane.normal, 6), ""),
        ("Laser plane, offset (normal · X + offset = 0)", "camera", numbers.fixed(plane.offset, 4), "mm"),
        ("Rotation axis, direction (up)", "camera", vector(axis.direction, 6), ""),
        ("Rotation axis, point: origin of the base frame", "camera", vector(axis.point, 4), "mm"),
        (
            "Sense of the table's angles about the axis",
            "base",
            "right-handed (+1)" if calibration.turn_sense > 0 else "left-handed (−1)",
            "",
        ),
        (
            "z = 0",
            "base, table",
            "table top" if calibration.table_seen else "point of the axis nearest to the optical axis (table not seen)",
            "",
        ),
        ("Distance of the camera from the rotation axis", "", numbers.fixed(geometry.camera_to_axis_mm, 1), "mm"),
        ("Distance of the axis from the laser plane *", "", numbers.fixed(geometry.axis_to_plane_mm, 3), "mm"),
        ("Angle between laser plane and optical axis", "", numbers.fixed(geometry.plane_to_optical_axis_deg, 2), "deg"),
        (
            "Angle between laser plane and rotation axis",
            "",
            numbers.fixed(geometry.plane_to_rotation_axis_deg, 2),
            "deg",
        ),
        ("One pixel across the line of sight *", "", numbers.fixed(geometry.mm_per_px_across, 4), "mm"),
        (
            "One pixel of stripe shift moves the measured point by *",
            "",
            numbers.fixed(geometry.mm_per_px_triangulation, 4),
            "mm",
        ),
    )
    return [
        Heading("The rig as calibrated"),
        Gallery(
            (
                picture(
                    lambda: rig_figures.layout(calibration),
                    "The rig in the base frame: camera with its field of view (grey), laser plane (red), rotation axis and "
                    "table (blue). Compare it with the real rig: a wrong side or distance shows at once.",
                ),
            )
        ),
        Table(
            "Geometry of the rig.",
            (
                Column("Quantity", numeric=False),
                Column("Frame", numeric=False),
                Column("Value"),
                Column("Unit", numeric=False),
            ),
            tuple(Row(r) for r in rows),
            "* at the point of the axis nearest to the optical axis.",
        ),
    ]
