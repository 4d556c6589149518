"""The axis optimisation with the stepped cylinder on the page."""

import numpy as np

from rotaline.calibration.model import ArtifactCalibration, ArtifactMount
from rotaline.geometry.primitives import SteppedCylinder
from rotaline.io.report import numbers
from rotaline.io.report.contents import ReportContents, StageWarning
from rotaline.io.report.figures import artifact as figures
from rotaline.io.report.page import Block, Column, Gallery, Heading, Level, Paragraph, Row, Section, Table, picture
from rotaline.io.report.sections.overlays import overlay_blocks
from rotaline.io.report.warnings import warnings_of

_WELL_CENTRED_MM = 2.0


def section(contents: ReportContents, warnings: tuple[StageWarning, ...]) -> Section:
    """Convergence, mounts, feature circles before and after."""
    mine = warnings_of("artifact", warnings)
    calibration = contents.artifact
    title = "Axis optimisation (stepped cylinder)"
    if calibration is None:
        tried = any(c.role == "artifact" for c in contents.captures)
        return Section(
            "artifact",
            title,
            "Axis optimisation",
            warnings=mine,
            missing="The axis was not optimised, although there are artefact captures: see the warnings. The initial axis is final."
            if tried
            else "No artefact captures: the initial axis is final.",
        )
    judgement, level = _judge(calibration)
    blocks: list[Block] = [
        _mounts(calibration),
        Gallery(
            (
                picture(
                    lambda: figures.convergence(calibration),
                    "The objective (14) after each iteration (the article's figure 14b). It should fall and then stay level.",
                    "half",
                ),
                picture(
                    lambda: figures.mean_distances(calibration),
                    "Mean distance of the feature points from their ideal circles, by mount. The article's mounts end at 11 to 12 µm.",
                    "half",
                ),
            )
        ),
        _axis(calibration),
    ]
    for mount in calibration.mounts:
        blocks += _mount(mount, contents.artifacts.get(mount.name))
        blocks += overlay_blocks(contents, "artifact", mount.name)
    return Section("artifact", title, "Axis optimisation", judgement, level, mine, tuple(blocks))


def _judge(calibration: ArtifactCalibration) -> tuple[str, Level]:
    before, after = calibration.mean_distance_before_mm, calibration.mean_distance_mm
    text = f"Mean distance to the ideal circles {numbers.um(before)} → {numbers.um(after)} µm"
    if before > 0:
        text += f" (reduced by {numbers.percent(1 - after / before)} %)"
    text += (
        f" over {numbers.plural(len(calibration.mounts), 'mount')}; the article reports 11 to 12 µm after. The axis is known to "
        f"{numbers.fixed(calibration.u_direction_rad * 1e6, 0)} µrad in direction and {numbers.um(calibration.u_position_mm)} µm in "
        "position (k = 1)."
    )
    eccentricities = [m.eccentricity_mm for m in calibration.mounts if np.isfinite(m.eccentricity_mm)]
    centred = bool(eccentricities) and max(eccentricities) < _WELL_CENTRED_MM
    if centred:
        text += " Every mount is well centred, which says little about the axis: add a mount 5 to 8 mm off centre."
    if not np.isfinite(after) or after > before:
        return text, "poor"
    return text, "fair" if centred or not calibration.converged else "good"


def _mounts(calibration: ArtifactCalibration) -> Table:
    return Table(
        f"Mounts of the stepped cylinder. Method {calibration.method}, {numbers.plural(calibration.n_iterations, 'iteration')}, "
        f"{'converged' if calibration.converged else 'not converged'}.",
        (
            Column("Mount", numeric=False),
            Column("Frames used", "n"),
            Column("Frames", "n"),
            Column("Eccentricity", "mm"),
            Column("Mean distance before", "mm"),
            Column("Mean distance after", "mm"),
            Column("Reduced by", "%"),
        ),
        tuple(
            Row(
                (
                    m.name,
                    numbers.count(sum(m.frame_used)),
                    numbers.count(len(m.frame_used)),
                    numbers.fixed(m.eccentricity_mm, 3),
                    numbers.mm(m.mean_distance_before_mm),
                    numbers.mm(m.mean_distance_mm),
                    numbers.percent(
                        1 - m.mean_distance_mm / m.mean_distance_before_mm if m.mean_distance_before_mm else None, 2
                    ),
                )
            )
            for m in calibration.mounts
        )
        + (
            (
                Row(
                    (
                        "All mounts",
                        numbers.count(sum(sum(m.frame_used) for m in calibration.mounts)),
                        numbers.count(sum(len(m.frame_used) for m in calibration.mounts)),
                        "",
                        numbers.mm(calibration.mean_distance_before_mm),
                        numbers.mm(calibration.mean_distance_mm),
                        numbers.percent(
                            1 - calibration.mean_distance_mm / calibration.mean_distance_before_mm
                            if calibration.mean_distance_before_mm
                            else None,
                            2,
                        ),
                    ),
                    "total",
                ),
            )
            if len(calibration.mounts) > 1
            else ()
        ),
        "Distance: eq. (13). Eccentricity: distance of the cylinder's axis from the rotation axis at mid height; 5 to 8 mm determine "
        "the axis best.",
    )


def _axis(calibration: ArtifactCalibration) -> Table:
    axis, before = calibration.axis_camera, calibration.axis_before_camera
    turn = float(np.clip(axis.direction @ before.direction, -1.0, 1.0))
    shift = _distance_between(before.point, axis.point, axis.direction)
    rows = (
        ("direction (up), camera frame", *(_vector(a.direction, 6) for a in (before, axis)), "1"),
        ("point, camera frame", *(_vector(a.point, 4) for a in (before, axis)), "mm"),
        ("turned against before", "", numbers.fixed(float(np.arccos(turn)) * 1e6, 1), "µrad"),
        ("shifted against before (across the axis, at the point)", "", numbers.mm(shift), "mm"),
        ("u of the direction (k = 1)", "", numbers.fixed(calibration.u_direction_rad * 1e6, 1), "µrad"),
        ("u of the position (k = 1)", "", numbers.mm(calibration.u_position_mm), "mm"),
    )
    return Table(
        "Rotation axis before and after.",
        (Column("Quantity", numeric=False), Column("Before"), Column("After"), Column("Unit", numeric=False)),
        tuple(Row(r) for r in rows),
    )


def _distance_between(a: np.ndarray, b: np.ndarray, direction: np.ndarray) -> float:
    """Distance of two points across a direction."""
    return float(np.linalg.norm(np.cross(a - b, direction)))


def _vector(values: np.ndarray, decimals: int) -> str:
    return "(" + ", ".join(numbers.fixed(float(x), decimals) for x in values) + ")"


def _mount(mount: ArtifactMount, artifact: SteppedCylinder | None) -> list[Block]:
    blocks: list[Block] = [
        Heading(f"Mount {mount.name}"),
        Gallery(
            (
                picture(
                    lambda: figures.feature_circles(mount, artifact),
                    f"{mount.name}: feature points turned back to angle 0, seen from above in the frame of the cylinder, against "
                    "the ideal circles (the article's figure 14a). Radial deviations are exaggerated as stated; after the "
                    "optimisation the points should lie on the circles.",
                ),
                picture(
                    lambda: figures.distances_by_angle(mount),
                    f"{mount.name}: distance of every feature point from its ideal circle. Note the two scales. Before, one or two "
                    "waves a turn are the signature of a wrong axis; after, what remains should not depend on the angle.",
                ),
            )
        ),
    ]
    left_out = [
        (n, r) for n, used, r in zip(mount.frame_names, mount.frame_used, mount.frame_reasons, strict=True) if not used
    ]
    if left_out:
        shown = "; ".join(f"{name}: {reason}" for name, reason in left_out[:12])
        more = f"; and {len(left_out) - 12} more" if len(left_out) > 12 else ""
        blocks.append(Paragraph(f"Frames left out: {shown}{more}."))
    return blocks
