"""Section 5 of the article beside ours: laser plane, initial axis, and its optimisation."""

import math

from rotaline.io.report import numbers
from rotaline.io.report.figures import artifact as artifact_figures
from rotaline.io.report.figures import axis as axis_figures
from rotaline.io.report.figures import comparison as figures
from rotaline.io.report.figures import laser_plane as plane_figures
from rotaline.io.report.page import Block, Column, Gallery, Row, Section, Table, picture
from rotaline.io.report.reproduction import (
    InitialAxisSection,
    MountsSection,
    Reproduction,
    SensorSection,
    SimulationSection,
)
from rotaline.io.report.sections.comparison import NOT_DONE, table_blocks
from rotaline.io.report.sections.overlays import overlay_picture

ARTICLE_SIMULATION_MM = (2.278e-7, 2.278e-7)
"""Where all curves of the article's figure 12 end."""
ARTICLE_MOUNTS_MM = (0.011, 0.012)
"""Between which figures the curves of the article's figure 14b end."""


def calibration_sections(reproduction: Reproduction) -> list[Section]:
    """Sections 5.2 to 5.5 of the article."""
    return [
        _sensor(reproduction.sensor),
        _initial_axis(reproduction.initial_axis),
        _simulation(reproduction.simulation),
        _mounts(reproduction.mounts),
    ]


def _sensor(section: SensorSection | None) -> Section:
    title, short = "Section 5.2: camera and laser plane", "5.2 Laser plane"
    if section is None:
        return Section("sensor", title, short, missing=NOT_DONE)
    s = section
    judgement = (
        f"Interval RMSE, before → after the optimisation by cross-ratios: {_arrow_um(s.cross_ratio.rmse_before_mm, s.cross_ratio.rmse_after_mm)} "
        f"by the article's method, {_arrow_um(s.cross_ratio_default.rmse_before_mm, s.cross_ratio_default.rmse_after_mm)} by the default "
        f"method. Camera: mean reprojection error {numbers.fixed(s.camera.mean_error_px, 3)} px."
    )
    pictures = Gallery(
        (
            picture(
                lambda: plane_figures.interval_errors(s.cross_ratio),
                "As the article's figure 8b, by its method: errors of the distances between the stripe's crossings of neighbouring dot rows, "
                "before and after the optimisation of the laser plane, in µm; right: the interval RMSE after each iteration.",
            ),
            picture(
                lambda: plane_figures.interval_errors(s.cross_ratio_default),
                "The same intervals by the default method.",
            ),
            picture(
                lambda: plane_figures.stripes_3d(s.laser_plane),
                "As the article's figure 8a: stripe points of all poses of the dot plate, one colour a pose, and the fitted plane. Camera frame, mm.",
                "half",
                "png",
            ),
            picture(
                lambda: plane_figures.residuals_over_plane(s.laser_plane_default),
                "Signed distances of the stripe points from the plane by the default method, in the laser plane, in µm. A bend would be a laser "
                "sheet that is not flat.",
                "half",
                "png",
            ),
        )
    )
    return Section("sensor", title, short, judgement, blocks=(*table_blocks(s.table), pictures))


def _initial_axis(section: InitialAxisSection | None) -> Section:
    title, short = "Section 5.3: initial rotation axis", "5.3 Initial axis"
    if section is None:
        return Section("initial-axis", title, short, missing=NOT_DONE)
    s = section
    blocks: list[Block] = [*table_blocks(s.table)]
    if s.frames:
        blocks.append(Gallery(tuple(overlay_picture(f) for f in s.frames)))
    blocks.append(
        Gallery(
            (
                picture(
                    lambda: axis_figures.single_circle(s.axis),
                    "As the article's figure 10a: one corner at all angles in the plane of its circle, mm; deviations drawn larger as stated.",
                    "half",
                ),
                picture(
                    lambda: axis_figures.circles_3d(s.axis),
                    "As the article's figure 10b: tracks of some corners (blue), the centres of their circles (red) and the axis through the centres "
                    "(black). Camera frame, mm.",
                    "half",
                    "png",
                ),
                picture(
                    lambda: figures.centres_and_truth(s),
                    "What the article could not know: the circle centres and the initial axis beside the true axis of the rig. Left: seen along "
                    "the true axis. Right: distances from it over the height; lines are the initial axis. Lengths in µm, heights in mm.",
                ),
            )
        )
    )
    judgement = (
        f"{numbers.plural(len(s.axis.point_ids), 'corner')} in {numbers.plural(sum(f.used for f in s.axis.frames), 'frame')}: "
        f"{numbers.um(s.axis.rms_mm)} µm RMS from their circles, {numbers.um(s.axis.centre_line_rms_mm)} µm of the centres from the axis."
    )
    return Section("initial-axis", title, short, judgement, blocks=tuple(blocks))


def _simulation(section: SimulationSection) -> Section:
    cases = section.cases
    curves = {
        "SQP on the mean distance (article)": {c.name: c.sqp_history_mm for c in cases},
        "Least squares": {c.name: c.least_squares_history_mm for c in cases},
    }
    pictures = Gallery(
        (
            picture(
                lambda: figures.convergence(curves, ARTICLE_SIMULATION_MM),
                "As the article's figure 12: mean distance of the ideal feature points from the ideal circles after each iteration, from the five disturbed "
                "axes of table 1, in mm. Dashed: where all curves of the article end.",
            ),
        )
    )
    rows = tuple(
        Row(
            (
                c.name,
                *(numbers.fixed(v, 1, signed=True) for v in (*c.delta_pa_mm, *c.delta_pb_mm)),
                numbers.significant(c.sqp_axis_error_mm, 3),
                numbers.significant(c.least_squares_axis_error_mm, 3),
            )
        )
        for c in cases
    )
    deltas = ("Δax", "Δay", "Δaz", "Δbx", "Δby", "Δbz")
    table = Table(
        "As the article's table 1: deviations added to two points of the true axis (base frame), and how far off the axis is after the optimisation (the larger of both points).",
        (
            Column("No.", numeric=False),
            *(Column(d, "mm") for d in deltas),
            Column("Axis off the true one after, SQP", "mm"),
            Column("Axis off the true one after, least squares", "mm"),
        ),
        rows,
    )
    return Section(
        "simulation",
        "Section 5.4: the optimisation on ideal points",
        "5.4 Simulation",
        blocks=(*table_blocks(section.table), table, pictures),
    )


def _mounts(section: MountsSection | None) -> Section:
    title, short = "Section 5.5: axis optimisation with the stepped cylinder", "5.5 Optimisation"
    if section is None:
        return Section("mounts", title, short, missing=NOT_DONE)
    s = section
    after = [m.calibration.mean_distance_mm for m in s.mounts]
    judgement = (
        f"Mean distance after the optimisation: {numbers.um(min(after, default=math.nan))} to {numbers.um(max(after, default=math.nan))} µm over "
        f"{numbers.plural(len(after), 'mount')} by the article's method (article: 11 to 12 µm); "
        f"{numbers.um(s.together.mean_distance_mm)} µm by the default method, all mounts together. The axis is then "
        f"{numbers.um(s.together_axis_error_mm)} µm from the true one."
    )
    blocks: list[Block] = [*table_blocks(s.table)]
    if s.frames:
        blocks.append(Gallery(tuple(overlay_picture(f) for f in s.frames)))
    pictures = []
    if s.mounts and s.mounts[0].calibration.mounts:
        first = s.mounts[0].calibration.mounts[0]
        pictures += [
            picture(
                lambda: artifact_figures.feature_circles(first, s.artifact),
                f"As the article's figure 14a, mount {s.mounts[0].name}: feature points turned back about the initial (red) and the optimised axis (blue) "
                "around the ideal circles (black), deviations drawn larger as stated. Frame of the cylinder, seen from above, mm.",
            ),
            picture(
                lambda: artifact_figures.distances_by_angle(first),
                "The distances of the same points from their circles over the table angle, in µm: what is left after the optimisation is noise, "
                "edges, and errors of the turntable.",
            ),
        ]
    curves = {
        "The article's method, each mount alone": {m.name: m.calibration.history_mm for m in s.mounts},
        "The default method, all mounts together": {"all mounts": s.together.history_mm},
    }
    pictures.append(
        picture(
            lambda: figures.convergence(curves, ARTICLE_MOUNTS_MM),
            "As the article's figure 14b: mean distance after each iteration, from the initial axis of each mount's own checkerboard, in µm. Grey: "
            "between these figures the article's curves end.",
        )
    )
    blocks.append(Gallery(tuple(pictures)))
    return Section("mounts", title, short, judgement, blocks=tuple(blocks))


def _arrow_um(before_mm: float, after_mm: float) -> str:
    return f"{numbers.um(before_mm)} → {numbers.um(after_mm)} µm"
