"""The camera calibration on the page."""

import numpy as np

from rotaline.calibration.model import CameraCalibration
from rotaline.io.report import numbers
from rotaline.io.report.contents import ReportContents, StageWarning
from rotaline.io.report.figures import camera as figures
from rotaline.io.report.page import Block, Column, Gallery, Level, Paragraph, Row, Section, Table, picture
from rotaline.io.report.sections.overlays import overlay_blocks
from rotaline.io.report.warnings import warnings_of

_GOOD_FOCAL, _POOR_FOCAL = 0.003, 0.05
_UNITS = {"fx": "px", "fy": "px", "cx": "px", "cy": "px", "u0": "px", "v0": "px"}
_MEANING = {
    "fx": "focal length along u",
    "fy": "focal length along v",
    "cx": "principal point, u",
    "cy": "principal point, v",
    "k1": "radial distortion, r²",
    "k2": "radial distortion, r⁴",
    "k3": "radial distortion, r⁶",
    "p1": "tangential distortion",
    "p2": "tangential distortion",
}


def section(contents: ReportContents, warnings: tuple[StageWarning, ...]) -> Section:
    """Parameters, views, coverage, residuals, poses."""
    mine = warnings_of("camera", warnings)
    calibration = contents.camera
    if calibration is None:
        return Section(
            "camera",
            "Camera",
            "Camera",
            warnings=mine,
            missing="The camera was not calibrated: nothing that follows is possible.",
        )
    judgement, level = _judge(calibration)
    blocks: list[Block] = [
        *(Paragraph(text) for text in calibration.notes),
        _parameters(calibration),
        Gallery(
            (
                picture(
                    lambda: figures.coverage(calibration),
                    "Points that were observed, over the image. Shaded cells were never seen: there the distortion is "
                    "extrapolated. The points should reach all four corners.",
                    "half",
                    "png",
                ),
                picture(
                    lambda: figures.board_poses(calibration),
                    "Boards in the camera frame (outline of the points; grey: left out). The boards should be tilted in "
                    "several directions and fill the working distance.",
                    "half",
                ),
                picture(
                    lambda: figures.residual_vectors(calibration),
                    "Residuals (observed − projected) over the image. Left: single points should point anywhere. Right: means of "
                    "cells with a dozen points or more; an orderly pattern there is what the distortion model does not explain.",
                    "full",
                    "png",
                ),
                picture(
                    lambda: figures.residual_distribution(calibration),
                    "Residuals of the used views. The cloud should be round and centred, the histogram near the normal "
                    "distribution; long tails are single wrong points.",
                    "half",
                    "png",
                ),
                picture(
                    lambda: figures.rms_by_view(calibration),
                    "RMS residual of every view. A view that stands out was blurred, moved, or partly misread.",
                    "half",
                ),
            )
        ),
        _views(calibration),
        *overlay_blocks(contents, "camera"),
    ]
    return Section("camera", "Camera", "Camera", judgement, level, mine, tuple(blocks))


def _judge(calibration: CameraCalibration) -> tuple[str, Level]:
    n, used = len(calibration.views), sum(v.used for v in calibration.views)
    text = (
        f"{numbers.fixed(calibration.rms_px, 3)} px RMS over {used} of {numbers.plural(n, 'view')} (mean error "
        f"{numbers.fixed(calibration.mean_error_px, 3)} px); good calibrations are below 0.1 to 0.3 px."
    )
    u_focal = _relative_u_focal(calibration)
    if u_focal is not None:
        text += f" The focal length is known to {numbers.significant(100 * u_focal, 2)} % (k = 1)"
        text += "; the views should determine it to 0.3 % or better." if u_focal > _GOOD_FOCAL else "."
    if not np.isfinite(calibration.rms_px) or calibration.rms_px > 0.8 or (u_focal or 0.0) > _POOR_FOCAL:
        return text, "poor"
    good = calibration.rms_px <= 0.3 and used >= 0.8 * n and (u_focal or 0.0) <= _GOOD_FOCAL
    return text, "good" if good else "fair"


def _relative_u_focal(calibration: CameraCalibration) -> float | None:
    """Standard uncertainty of the focal length as a share of it."""
    u = dict(zip(calibration.parameter_names, calibration.u_parameters, strict=True)).get("fx")
    return float(u) / calibration.camera.fx if u is not None and np.isfinite(u) else None


def _parameters(calibration: CameraCalibration) -> Table:
    camera = calibration.camera
    rows = []
    for name, u in zip(calibration.parameter_names, calibration.u_parameters, strict=True):
        value = getattr(camera, {"u0": "cx", "v0": "cy"}.get(name, name), None)
        value = float(value) if value is not None else None
        rows.append(
            Row(
                (
                    name,
                    _MEANING.get(name, ""),
                    numbers.parameter(value, float(u)),
                    numbers.significant(float(u), 2),
                    _UNITS.get(name, "1"),
                )
            )
        )
    return Table(
        f"Camera parameters for images of {camera.image_size[0]} × {camera.image_size[1]} px.",
        (
            Column("Parameter", numeric=False),
            Column("Meaning", numeric=False),
            Column("Value"),
            Column("u (k = 1)"),
            Column("Unit", numeric=False),
        ),
        tuple(rows),
        "Pixel (0, 0) is the centre of the top-left pixel. Distortion holds for normalised coordinates, eq. (2). u: standard "
        "uncertainty (k = 1) from the residuals.",
    )


def _views(calibration: CameraCalibration) -> Table:
    return Table(
        "Views of the camera calibration.",
        (
            Column("View", numeric=False),
            Column("Points", "n"),
            Column("RMS", "px"),
            Column("Largest residual", "px"),
            Column("Distance", "mm"),
            Column("Tilt", "deg"),
            Column("Used", numeric=False),
        ),
        tuple(
            Row(
                (
                    v.name,
                    numbers.count(int(np.isfinite(v.residuals_px).all(axis=1).sum())),
                    numbers.fixed(v.rms_px, 3),
                    numbers.fixed(_largest(v.residuals_px), 2),
                    numbers.fixed(float(np.linalg.norm(v.camera_from_board.translation)), 1),
                    numbers.fixed(
                        float(
                            np.rad2deg(np.arccos(min(1.0, abs(float(v.camera_from_board.rotation.as_matrix()[2, 2])))))
                        ),
                        1,
                    ),
                    "yes" if v.used else f"no: {v.reason}",
                ),
                "plain" if v.used else "dim",
            )
            for v in calibration.views
        ),
        "Points: without those that were left out. Distance: of the board's first point from the projection centre. Tilt: between the board's normal and the optical axis.",
    )


def _largest(residuals: np.ndarray) -> float | None:
    lengths = np.linalg.norm(residuals, axis=1)
    lengths = lengths[np.isfinite(lengths)]
    return float(lengths.max()) if len(lengths) else None
