"""The joint estimate on the page: parameters with U, residuals of every group and surface, errors of the table, weak directions."""

from functools import partial

import numpy as np

from rotaline.calibration.joint.model import JointCalibration, JointMount, OptionalParameters
from rotaline.calibration.scatter import MountScatter, mount_scatter
from rotaline.calibration.speckle_limit import SpeckleLimit
from rotaline.io.report import numbers
from rotaline.io.report.contents import ReportContents, StageWarning
from rotaline.io.report.figures import joint as figures
from rotaline.io.report.page import Block, Column, Gallery, Heading, Level, Paragraph, Row, Section, Table, picture
from rotaline.io.report.sections.overlays import overlay_blocks
from rotaline.io.report.warnings import warnings_of

_GROUP_TITLES = {
    "target": "target points",
    "plate-stripe": "stripes on the plates",
    "table-target": "target on the turntable",
    "artifact": "stripes on the artefact",
}
_TITLE = "Joint estimate"


def section(contents: ReportContents, warnings: tuple[StageWarning, ...]) -> Section:
    """Everything that was estimated together."""
    mine = warnings_of("artifact", warnings) + warnings_of("joint", warnings)
    joint = contents.joint
    if joint is None:
        return Section(
            "joint",
            _TITLE,
            _TITLE,
            warnings=mine,
            missing="There is no joint estimate: see the warnings. What the stages before found is final.",
        )
    judgement, level = _judge(joint)
    blocks: list[Block] = [_parameters(joint), *_optional(joint), *_weak_directions(joint), _groups(joint)]
    blocks.append(
        Gallery(
            (
                picture(
                    lambda: figures.target_residuals(joint),
                    "Residuals of the target points of all captures over the image, drawn longer as stated; left single points, "
                    "right the mean of each cell. Order in the means is what the camera model cannot explain.",
                    form="png",
                ),
            )
        )
    )
    blocks += _left_out(joint)
    if joint.mounts:
        blocks += _artifact_blocks(contents, joint)
    if joint.table is not None:
        blocks += _table_blocks(joint)
    return Section("joint", _TITLE, _TITLE, judgement, level, mine, tuple(blocks))


def _judge(joint: JointCalibration) -> tuple[str, Level]:
    text = (
        f"{numbers.count(joint.n_parameters)} parameters from {numbers.count(joint.n_observations)} observations, "
        f"{numbers.plural(joint.n_iterations, 'iteration')}, {'converged' if joint.converged else 'not converged'}."
    )
    if joint.mounts:
        text += f" The surfaces of {numbers.plural(len(joint.mounts), 'mount')} fit to {numbers.um(_rms_of_mounts(joint))} µm RMS."
    return text, "good" if joint.converged else "poor"


def _rms_of_mounts(joint: JointCalibration) -> float:
    squares = np.concatenate([np.zeros(0), *(m.distances_mm[m.used] ** 2 for m in joint.mounts)])
    return float(np.sqrt(squares.mean())) if len(squares) else float("nan")


def _shown(value: float, u: float, unit: str) -> tuple[str, str, str]:
    """Value, U (k = 2) and unit; small angles in µrad, small lengths in µm."""
    if unit == "rad":
        return numbers.parameter(value, 2.0 * u), numbers.significant(2e6 * u), "µrad"
    if unit == "mm":
        return numbers.parameter(value, 2.0 * u), numbers.significant(2e3 * u), "µm"
    if unit == "relative":
        return numbers.parameter(value, 2.0 * u), numbers.significant(2e6 * u), "ppm"
    return numbers.parameter(value, 2.0 * u), numbers.significant(2.0 * u), unit


def _unit(unit: str) -> str:
    """Nothing for a number without unit."""
    return "" if unit == "1" else unit


def _parameters(joint: JointCalibration) -> Table:
    rows = []
    for q in joint.parameters:
        value, expanded, unit = _shown(q.value, q.u, q.unit)
        value = value if np.isfinite(q.value) else numbers.MISSING
        rows.append(Row((q.name, value, _unit(q.unit), expanded, _unit(unit), q.frame)))
    return Table(
        "Calibrated quantities with their expanded uncertainty U (k = 2).",
        (
            Column("Quantity", numeric=False),
            Column("Value"),
            Column("Unit", numeric=False),
            Column("U (k = 2)"),
            Column("Unit of U", numeric=False),
            Column("Frame", numeric=False),
        ),
        tuple(rows),
        "From the covariance of the whole estimate, so each U holds with all other quantities unknown. Directions and places have no single value; "
        "the laser plane and the axis themselves stand in their sections and in calibration.json.",
    )


def _groups(joint: JointCalibration) -> Table:
    rows = []
    for g in joint.groups:
        held_out = np.array([v.held_out_rms_px for v in g.views])
        known = held_out[np.isfinite(held_out)]
        n_views = sum(v.used for v in g.views)
        rows.append(
            Row(
                (
                    g.name,
                    _GROUP_TITLES[g.kind],
                    numbers.fixed(g.rms_px, 4),
                    numbers.fixed(g.sigma_px, 4),
                    numbers.fixed(g.predicted_px, 4),
                    numbers.fixed(float(np.sqrt(np.mean(known**2))) if len(known) else None, 4),
                    numbers.fixed(g.correlation_length, 1),
                    f"{numbers.count(n_views)} of {numbers.count(len(g.views))}",
                    numbers.count(g.n_used),
                    numbers.count(g.n_points - g.n_used),
                )
            )
        )
    return Table(
        "Residuals of each group of observations.",
        (
            Column("Capture", numeric=False),
            Column("What", numeric=False),
            Column("RMS", "px"),
            Column("Sigma", "px"),
            Column("Stated", "px"),
            Column("Held out", "px"),
            Column("Correlation", "points"),
            Column("Frames used"),
            Column("Points used", "n"),
            Column("Left out", "n"),
        ),
        tuple(rows),
        "RMS: of the points used. Sigma: robust standard deviation, which gives the group its weight. Stated: what the detectors say. Held out: "
        "RMS of frames that took no part in the estimate; much more than the RMS means that the frames do not agree with each "
        "other. Correlation: neighbours along a stripe that count as one.",
    )


def _left_out(joint: JointCalibration) -> list[Block]:
    left_out = [f"{v.name}: {v.reason}" for g in joint.groups for v in g.views if not v.used]
    if not left_out:
        return []
    more = f"; and {len(left_out) - 12} more" if len(left_out) > 12 else ""
    return [Paragraph(f"Frames left out: {'; '.join(left_out[:12])}{more}.")]


def _optional(joint: JointCalibration) -> list[Block]:
    if not joint.optional:
        return []
    rows = []
    for option in joint.optional:
        values = _optional_values(option)
        rows.append(
            Row(
                (
                    option.name,
                    "yes" if option.on else "no",
                    values,
                    numbers.fixed(option.improvement, 1),
                    option.reason,
                ),
                "plain" if option.on else "dim",
            )
        )
    return [
        Table(
            "Parameters that are estimated only where the data carry them.",
            (
                Column("Parameters", numeric=False),
                Column("Estimated", numeric=False),
                Column("Value ± U (k = 2)", numeric=False),
                Column("Improvement", "chi²"),
                Column("Why", numeric=False),
            ),
            tuple(rows),
            "Improvement: how much the weighted sum of squares falls with them. Values of parameters that are not estimated are what they would be.",
        )
    ]


def _optional_values(option: OptionalParameters) -> str:
    parts = []
    for key, value in option.values.items():
        u, stated = option.u.get(key, float("nan")), option.units.get(key, "")
        scale, unit = 1.0, _unit(stated)
        if stated == "rad" or (stated == "mm" and abs(value) < 1.0):
            scale, unit = {"rad": (1e6, "µrad"), "mm": (1e3, "µm")}[stated]
        shown = numbers.parameter(scale * value, 2.0 * scale * u)
        name = key.replace("_", " ")
        parts.append(f"{name} {shown} ± {numbers.significant(2.0 * scale * u, 2)}{' ' + unit if unit else ''}")
    return "; ".join(parts) or numbers.MISSING


def _weak_directions(joint: JointCalibration) -> list[Block]:
    if not joint.weak_directions:
        return []
    rows = []
    for weak in sorted(joint.weak_directions, key=lambda w: -w.share):
        _, expanded, unit = _shown(0.0, weak.u, weak.unit)
        rows.append(
            Row(
                (
                    weak.quantity,
                    f"{expanded} {unit}",
                    numbers.percent(weak.share, 0),
                    weak.text,
                    weak.action,
                )
            )
        )
    return [
        Table(
            "What limits a measured point, the largest share first.",
            (
                Column("Direction", numeric=False),
                Column("U (k = 2)"),
                Column("Share", "%"),
                Column("Why", numeric=False),
                Column("What to do", numeric=False),
            ),
            tuple(rows),
            "Share: part of the variance of a measured point near the axis that comes from it.",
        )
    ]


def _artifact_blocks(contents: ReportContents, joint: JointCalibration) -> list[Block]:
    lengths = {g.name: g.correlation_length for g in joint.groups if g.kind == "artifact"}
    parts = [mount_scatter(m, lengths.get(m.name, 1.0)) for m in joint.mounts]
    blocks: list[Block] = [Heading("Artefacts"), _surfaces(joint)]
    blocks.append(_scatter_picture(parts, contents.speckle_limit))
    for mount in joint.mounts:
        blocks.append(Heading(f"Mount {mount.name}"))
        blocks.append(Paragraph(_mount_text(mount)))
        blocks.append(
            Gallery(
                (
                    picture(
                        partial(figures.unrolled, mount),
                        f"{mount.name}: mean distance of the stripe points from the surfaces, unrolled. A band around the turn is a wrong size, a "
                        "wave an axis or angle error, upright stripes are single frames, slopes along the height the laser plane. Oblique bands "
                        "that cross each other: the centre of the stripe is drawn towards the pixel grid.",
                    ),
                )
            )
        )
        blocks += overlay_blocks(contents, "artifact", mount.name)
    return blocks


def _scatter_picture(parts: list[MountScatter], limit: SpeckleLimit | None) -> Gallery:
    if limit is None:
        known = "The speckle limit is not known: the session does not state its optics."
    else:
        known = (
            f"Speckle limits a single point to {numbers.um(limit.lateral_mm)} µm across the line and {numbers.um(limit.depth_mm)} µm in depth, for "
            f"a contrast of {numbers.fixed(limit.contrast, 2)}, sin u = {numbers.fixed(limit.sin_aperture, 4)} and a triangulation angle of "
            f"{numbers.fixed(float(np.rad2deg(limit.triangulation_rad)), 1)} deg (Dorsch, Häusler, Herrmann 1994); surfaces that "
            "are seen obliquely show less of it."
        )
    caption = (
        "Where the scatter on the artefacts comes from, root mean squares. Waves over the turn come from the axis, the angle read-out or the "
        f"artefact; open symbols may be chance (5 %), and a symbol that is missing stands for less than the noise of the single points leaves. {known}"
    )
    return Gallery((picture(lambda: figures.scatter(parts, limit), caption),))


def _mount_text(mount: JointMount) -> str:
    text = (
        f"{numbers.plural(len(mount.frame_names), 'frame')}, {numbers.count(int(mount.used.sum()))} of "
        f"{numbers.plural(len(mount.used), 'point')} used; {numbers.fixed(mount.eccentricity_mm, 3)} mm off centre "
        f"(U = {numbers.um(2.0 * mount.u_eccentricity_mm)} µm)"
    )
    if np.isfinite(mount.tilt_rad):
        text += f", tilted by {numbers.fixed(float(np.rad2deg(mount.tilt_rad)), 3)} deg against the axis"
    if np.isfinite(mount.held_out_rms_mm):
        text += f". With camera, plane and axis from the other captures its distances are {numbers.um(mount.held_out_rms_mm)} µm RMS"
    return text + "."


def _surfaces(joint: JointCalibration) -> Table:
    rows = []
    for mount in joint.mounts:
        for s, name in enumerate(mount.surfaces):
            here = mount.surface == s
            cells = (
                mount.name if s == 0 else "",
                name,
                numbers.um(float(mount.mean_mm[s]), signed=True),
                numbers.um(float(mount.rms_mm[s])),
                numbers.count(int((here & mount.used).sum())),
                numbers.count(int((here & ~mount.used).sum())),
            )
            rows.append(Row(cells, "plain" if s == 0 else "continued"))
    return Table(
        "Distances of the stripe points from the surfaces of the artefacts.",
        (
            Column("Mount", numeric=False),
            Column("Surface", numeric=False),
            Column("Mean", "µm"),
            Column("RMS", "µm"),
            Column("Points used", "n"),
            Column("Left out", "n"),
        ),
        tuple(rows),
        "Outside is positive. A mean that differs from zero on one surface alone: its size, or light that does not come from it.",
    )


def _table_blocks(joint: JointCalibration) -> list[Block]:
    table = joint.table
    assert table is not None
    rows = []
    for name, sigma, u in zip(table.names, table.sigma, table.u_sigma, strict=True):
        scale, unit = (1e6, "µrad") if name in ("angle", "wobble") else (1e3, "µm")
        rows.append(
            Row(
                (
                    name,
                    numbers.significant(scale * float(sigma)),
                    numbers.significant(2.0 * scale * float(u), 2),
                    unit,
                )
            )
        )
    return [
        Heading("Turntable"),
        Table(
            "Errors of the turntable from frame to frame: standard deviations.",
            (
                Column("Error", numeric=False),
                Column("Sigma"),
                Column("U of sigma (k = 2)"),
                Column("Unit", numeric=False),
            ),
            tuple(rows),
            "Angle: beyond the read-out. Run-out: sideways, along x and along y of the base frame. Lift: along the axis. Wobble: about x and about y.",
        ),
        Gallery(
            (
                picture(
                    lambda: figures.table_errors(table, joint.angle_error),
                    "What each frame says about the table. Left: how far it turned beyond the read-out. Right: how far the axis moved along x "
                    "(filled) and y (open). Points without order are noise of the table; a wave once a turn is an eccentric scale or bearing.",
                ),
            )
        ),
    ]
