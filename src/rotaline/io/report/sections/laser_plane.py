"""The laser plane and its optimisation on the page."""

import numpy as np

from rotaline.calibration.model import CrossRatioResult, LaserPlaneCalibration
from rotaline.io.report import numbers
from rotaline.io.report.contents import ReportContents, StageWarning
from rotaline.io.report.figures import laser_plane as figures
from rotaline.io.report.page import Block, Column, Gallery, Level, Row, Section, Table, picture
from rotaline.io.report.sections.overlays import overlay_blocks
from rotaline.io.report.warnings import warnings_of

_GOOD_RELATIVE, _POOR_RELATIVE = 1 / 3000, 1 / 1000
"""RMS of the laser plane as a share of the distance from the camera."""


def plane_section(contents: ReportContents, warnings: tuple[StageWarning, ...]) -> Section:
    """Plane, stripes in the camera frame, residuals."""
    mine = warnings_of("laser-plane", warnings)
    calibration = contents.laser_plane
    if calibration is None:
        return Section(
            "laser-plane",
            "Laser plane",
            "Laser plane",
            warnings=mine,
            missing="The laser plane was not calibrated: no captures with the role laser-plane were usable.",
        )
    judgement, level = _judge_plane(calibration)
    plane = calibration.plane_camera
    image_size = contents.camera.camera.image_size if contents.camera is not None else None
    blocks: list[Block] = [
        Table(
            "Laser plane fitted to all stripes, camera frame: normal · X + offset = 0.",
            (Column("Parameter", numeric=False), Column("Value"), Column("u (k = 1)"), Column("Unit", numeric=False)),
            (
                Row(
                    (
                        "normal",
                        "(" + ", ".join(numbers.fixed(float(x), 6) for x in plane.normal) + ")",
                        " / ".join(numbers.fixed(u * 1e6, 1) for u in calibration.u_normal_rad),
                        "1; u in µrad",
                    )
                ),
                Row(("offset", numbers.mm(plane.offset), numbers.mm(calibration.u_offset_mm), "mm")),
            ),
            "u of the normal: along the two main directions of the points; u of the offset: of the plane at the points' centroid.",
        ),
        Gallery(
            (
                picture(
                    lambda: figures.stripes_3d(calibration),
                    "Stripe points of all poses in the camera frame with the fitted plane (the article's figure 8a). The stripes should "
                    "be spread over the depth and width where parts will stand.",
                    "half",
                    "png",
                ),
                picture(
                    lambda: figures.residuals_by_view(calibration),
                    "Signed distances of the stripe points from the plane, along each stripe (bar: mean). A mean away from zero is a "
                    "wrong pose of that board; a slope or a bend is an error of the pose or of the lens model.",
                    "half",
                    "png",
                ),
                picture(
                    lambda: figures.residuals_over_image(calibration, image_size),
                    "The same distances over the image. One colour in one part of the image is remaining lens distortion.",
                    "half",
                    "png",
                ),
                picture(
                    lambda: figures.residuals_over_plane(calibration),
                    "The same distances in the laser plane. A bend along it means that the laser sheet is not flat.",
                    "half",
                    "png",
                ),
            )
        ),
        _views(calibration),
        *overlay_blocks(contents, "laser-plane"),
    ]
    return Section("laser-plane", "Laser plane", "Laser plane", judgement, level, mine, tuple(blocks))


def cross_ratio_section(contents: ReportContents, warnings: tuple[StageWarning, ...]) -> Section:
    """Interval errors before and after."""
    mine = warnings_of("cross-ratio", warnings)
    result = contents.cross_ratio
    title = "Laser plane optimisation (cross-ratio invariance)"
    if result is None:
        return Section(
            "cross-ratio",
            title,
            "Cross-ratio",
            warnings=mine,
            missing="No optimisation by cross-ratio invariance: it needs a dot plate.",
        )
    judgement, level = _judge_cross_ratio(result)
    before = result.measured_before_mm - result.reference_mm
    after = result.measured_after_mm - result.reference_mm
    turn = float(np.clip(abs(result.plane_camera.normal @ result.plane_before_camera.normal), 0.0, 1.0))
    rows = (
        ("interval RMSE", "µm", numbers.um(result.rmse_before_mm), numbers.um(result.rmse_after_mm)),
        ("mean error", "µm", numbers.um(_mean(before), signed=True), numbers.um(_mean(after), signed=True)),
        ("largest magnitude of an error", "µm", numbers.um(_largest(before)), numbers.um(_largest(after))),
        (
            "offset of the plane",
            "mm",
            numbers.mm(result.plane_before_camera.offset),
            numbers.mm(result.plane_camera.offset),
        ),
        ("turn of the normal against before", "µrad", "", numbers.fixed(float(np.arccos(turn)) * 1e6, 1)),
    )
    blocks: tuple[Block, ...] = (
        Gallery(
            (
                picture(
                    lambda: figures.interval_errors(result),
                    "Errors of the distances between the stripe's crossings of neighbouring dot rows (the article's figure 8b), and "
                    "the objective after each iteration. After the optimisation they should scatter closely about zero in every "
                    "pose; a pose that stays off has a wrong dot or a wrong pose.",
                ),
            )
        ),
        Table(
            f"{numbers.plural(len(result.reference_mm), 'interval')} in {numbers.plural(len(result.names), 'pose')}; "
            f"{numbers.plural(result.n_iterations, 'iteration')}, {'converged' if result.converged else 'not converged'}.",
            (Column("Quantity", numeric=False), Column("Unit", numeric=False), Column("Before"), Column("After")),
            tuple(Row(r) for r in rows),
        ),
    )
    return Section("cross-ratio", title, "Cross-ratio", judgement, level, mine, blocks)


def _judge_plane(calibration: LaserPlaneCalibration) -> tuple[str, Level]:
    n, used = len(calibration.views), sum(v.used for v in calibration.views)
    points = sum(len(v.points_camera) for v in calibration.views if v.used)
    text = (
        f"{numbers.um(calibration.rms_mm)} µm RMS over {numbers.plural(points, 'stripe point')} in {used} of "
        f"{numbers.plural(n, 'pose')}; the plane is known to {numbers.um(calibration.u_offset_mm)} µm at its middle and "
        f"{numbers.fixed(max(calibration.u_normal_rad) * 1e6, 0)} µrad in its direction (k = 1)."
    )
    relative = _relative_rms(calibration)
    if relative is not None:
        text += (
            f" The RMS is 1/{numbers.count(max(1, round(1 / relative)))} of the distance from the camera; better than "
            f"1/{numbers.count(round(1 / _GOOD_RELATIVE))} counts as good here."
        )
    if relative is None or used < 2 or relative > _POOR_RELATIVE:
        return text, "poor"
    return text, "good" if relative < _GOOD_RELATIVE and used >= 0.8 * n and used >= 4 else "fair"


def _relative_rms(calibration: LaserPlaneCalibration) -> float | None:
    """RMS over the mean distance of the points from the camera."""
    distances = [np.linalg.norm(v.points_camera, axis=1) for v in calibration.views if v.used and len(v.points_camera)]
    everything = np.concatenate([np.zeros(0), *distances])
    everything = everything[np.isfinite(everything)]
    if len(everything) == 0 or not np.isfinite(calibration.rms_mm) or calibration.rms_mm <= 0.0:
        return None
    return calibration.rms_mm / float(everything.mean())


def _judge_cross_ratio(result: CrossRatioResult) -> tuple[str, Level]:
    text = f"Interval RMSE {numbers.um(result.rmse_before_mm)} → {numbers.um(result.rmse_after_mm)} µm"
    if result.rmse_before_mm > 0:
        text += f" (reduced by {numbers.percent(1 - result.rmse_after_mm / result.rmse_before_mm)} %)"
    text += "; the article reports 21 → 3 µm on its rig."
    if not result.accepted:
        return f"{text} The optimised plane is not used: {result.reason.rstrip('.')}.", "none"
    return f"{text} The optimised plane is used from here on.", "good" if result.converged else "fair"


def _mean(values: np.ndarray) -> float | None:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if len(finite) else None


def _largest(values: np.ndarray) -> float | None:
    finite = values[np.isfinite(values)]
    return float(np.abs(finite).max()) if len(finite) else None


def _views(calibration: LaserPlaneCalibration) -> Table:
    rows = []
    for v in calibration.views:
        r = v.residuals_mm[np.isfinite(v.residuals_mm)]
        rows.append(
            Row(
                (
                    v.name,
                    numbers.count(len(v.uv)),
                    numbers.mm(float(np.sqrt(np.mean(r**2))) if len(r) else None),
                    numbers.mm(_mean(r), signed=True),
                    numbers.mm(_largest(r)),
                    "yes" if v.used else f"no: {v.reason}",
                ),
                "plain" if v.used else "dim",
            )
        )
    return Table(
        "Stripes on the target, distances from the laser plane.",
        (
            Column("View", numeric=False),
            Column("Points", "n"),
            Column("RMS", "mm"),
            Column("Mean", "mm"),
            Column("Largest magnitude", "mm"),
            Column("Used", numeric=False),
        ),
        tuple(rows),
    )
