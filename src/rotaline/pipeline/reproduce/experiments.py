"""Sections 5.2 to 5.5 of the article: sensor, initial axis, simulation, axis optimisation over five mounts."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from rotaline.calibration.model import LaserPlaneCalibration, SystemCalibration
from rotaline.errors import CalibrationError
from rotaline.geometry.primitives import Line, Plane
from rotaline.io.report.reproduction import (
    ComparisonTable,
    InitialAxisSection,
    MountResult,
    MountsSection,
    SensorSection,
    SimulationSection,
    TableRow,
)
from rotaline.pipeline.calibrate import CalibrationParts
from rotaline.pipeline.compare_truth import best_rotation
from rotaline.pipeline.options import ARTICLE_OPTIONS
from rotaline.pipeline.reproduce.article import (
    CAMERA_MEAN_ERROR_PX,
    INTERVAL_RMSE_MM,
    MEAN_DISTANCE_MM,
    SIMULATED_BEFORE_MM,
    SIMULATED_MEAN_DISTANCE_MM,
    STEPPED_CYLINDER,
    STEPWISE_OPTIONS,
)
from rotaline.pipeline.reproduce.plan import mount_names
from rotaline.pipeline.reproduce.rows import average, error_figure, list_table, plain_figure
from rotaline.pipeline.reproduce.workbench import Workbench
from rotaline.pipeline.verify_axis import verify_axis
from rotaline.simulation.rig import Rig

SENSOR = ("camera", "laser")


@dataclass(frozen=True, eq=False)
class Calibrations:
    """Every calibration that the tables need.

    ``article[k]`` knows mount k and its own checkerboard capture only; ``initial[k]`` is the default method with that checkerboard and
    no artefact; ``together`` the default method with all mounts.
    """

    article: tuple[CalibrationParts, ...]
    initial: tuple[CalibrationParts, ...]
    together: CalibrationParts


def calibrate_all(bench: Workbench) -> Calibrations:
    """Calibrate from the five mounts by both methods.

    Raises
    ------
    CalibrationError
        If a calibration lacks a part; the message holds its warnings.
    """
    names, defaults = mount_names(), STEPWISE_OPTIONS
    stepped = [f"stepped-{name}" for name in names]
    article = [bench.calibrate((*SENSOR, f"axis-{n}", f"stepped-{n}"), ARTICLE_OPTIONS) for n in names]
    initial = [bench.calibrate((*SENSOR, f"axis-{n}"), defaults) for n in names]
    together = bench.calibrate((*SENSOR, f"axis-{names[0]}", *stepped), defaults)
    for parts in (*article, together):
        _require(parts, parts.artifact is not None)
    for parts in initial:
        _require(parts, parts.system is not None)
    return Calibrations(tuple(article), tuple(initial), together)


def _require(parts: CalibrationParts, complete: bool) -> None:
    if not complete:
        serious = [warning.text for warning in parts.warnings if warning.serious]
        raise CalibrationError(f"The rendered rig could not be calibrated: {' '.join(serious)}")


def system_of(parts: CalibrationParts, initial: bool = False) -> SystemCalibration:
    """The calibrated system with the final or the initial axis; ``calibrate_all`` made sure that it is there."""
    system = parts.system_initial if initial else parts.system
    assert system is not None
    return system


def to_true_camera(parts: CalibrationParts, rig: Rig) -> Rotation:
    """The rotation from the calibrated camera frame to the true one; see :func:`rotaline.pipeline.compare_truth.best_rotation`."""
    assert parts.camera is not None
    return best_rotation(parts.camera.camera, rig.camera)[0]


def axis_error_mm(parts: CalibrationParts, axis_camera: Line, rig: Rig) -> float:
    """Distance of an axis from the true one, mm: the larger at the bottom and at the top of the stepped cylinder."""
    true, turn = rig.rotation_axis_camera, to_true_camera(parts, rig)
    axis_camera = Line(turn.apply(axis_camera.point), turn.apply(axis_camera.direction))
    heights = np.array([0.0, STEPPED_CYLINDER.height_small + STEPPED_CYLINDER.height_large])
    return float(axis_camera.distance_to(true.point + heights[:, None] * true.direction).max())


def plane_error_mm(parts: CalibrationParts, plane_camera: Plane, calibration: LaserPlaneCalibration, rig: Rig) -> float:
    """RMS distance of a laser plane from the true one where the stripes of the calibration lie, mm."""
    points = np.concatenate([view.points_camera for view in calibration.views if view.used])
    on_plane = points - plane_camera.signed_distance_to(points)[:, None] * plane_camera.normal
    on_plane = to_true_camera(parts, rig).apply(on_plane)
    return float(np.sqrt(np.mean(rig.laser_plane_camera.signed_distance_to(on_plane) ** 2)))


def sensor_section(bench: Workbench, rig: Rig) -> SensorSection:
    """Section 5.2: camera, laser plane, optimisation by cross-ratios.

    Raises
    ------
    CalibrationError
        If one of them failed.
    """
    ours = bench.calibrate(SENSOR, ARTICLE_OPTIONS), bench.calibrate(SENSOR, STEPWISE_OPTIONS)
    for parts in ours:
        _require(parts, None not in (parts.camera, parts.laser_plane, parts.cross_ratio))
    cameras = [parts.camera for parts in ours if parts.camera is not None]
    planes = [parts.laser_plane for parts in ours if parts.laser_plane is not None]
    ratios = [parts.cross_ratio for parts in ours if parts.cross_ratio is not None]
    before, after = INTERVAL_RMSE_MM
    truly = [
        [
            plane_error_mm(found, getattr(ratio, name), plane, rig)
            for found, ratio, plane in zip(ours, ratios, planes, strict=True)
        ]
        for name in ("plane_before_camera", "plane_camera")
    ]
    figures = (
        error_figure(
            "camera, mean reprojection error", "px", CAMERA_MEAN_ERROR_PX, *(c.mean_error_px for c in cameras), digits=4
        ),
        error_figure("interval RMSE before the optimisation", "mm", before, *(r.rmse_before_mm for r in ratios)),
        error_figure("interval RMSE after the optimisation", "mm", after, *(r.rmse_after_mm for r in ratios)),
        plain_figure("intervals", "", 80.0, *(float(len(r.reference_mm)) for r in ratios), digits=0),
        plain_figure("laser plane off the true one before, RMS", "mm", None, *truly[0]),
        plain_figure("laser plane off the true one in use, RMS", "mm", None, *truly[1]),
    )
    use = " and ".join(
        f"{name} {'accepted' if ratio.accepted else f'not accepted ({ratio.reason})'}"
        for name, ratio in zip(("by the article's method", "by the default method"), ratios, strict=True)
    )
    text = f"The plane moved by the cross-ratios was {use}: a plane that does no better on poses it was not made from is not used."
    table = list_table("Section 5.2, figure 8", "Camera and laser plane", figures, text)
    return SensorSection(table, cameras[0], planes[0], ratios[0], planes[1], ratios[1])


def initial_axis_section(bench: Workbench, rig: Rig, found: Calibrations) -> InitialAxisSection:
    """Section 5.3: the axis from the checkerboard, put down anew for each mount."""
    rows = []
    for name, article, initial in zip(mount_names(), found.article, found.initial, strict=True):
        assert article.axis is not None
        assert initial.axis is not None
        pair = ((article, article.axis), (initial, initial.axis))
        true = rig.rotation_axis_camera.direction
        directions = [to_true_camera(p, rig).apply(a.axis_camera.direction) for p, a in pair]
        tilts = [float(1e3 * np.linalg.norm(np.cross(direction, true))) for direction in directions]
        cells = (
            plain_figure(
                "distance from the true axis", "mm", None, *(axis_error_mm(p, a.axis_camera, rig) for p, a in pair)
            ),
            plain_figure("angle to the true axis", "mrad", None, *tilts, digits=3),
            plain_figure("corners off their circles, RMS", "mm", None, *(a.rms_mm for _, a in pair)),
        )
        rows.append(TableRow(name, cells))
    columns = tuple(f"{c.quantity} / {c.unit}" for c in rows[0].cells)
    text = (
        "The article gives no figures here: it could not know the true axis. By its method the axis is the line through the centres of "
        "the corners' circles, by the default method, where no artefact follows, the axis that explains all images best."
    )
    table = ComparisonTable(
        "Section 5.3, figures 9 and 10", "Initial axis from the checkerboard", columns, tuple(rows), text
    )
    axis = found.article[0].axis
    assert axis is not None
    frames = bench.overlays(f"axis-{mount_names()[0]}", ARTICLE_OPTIONS)
    return InitialAxisSection(table, frames, axis, rig.rotation_axis_camera)


def simulation_section() -> SimulationSection:
    """Section 5.4: exact feature points, the axis disturbed as in table 1."""
    cases = verify_axis().cases
    rows = tuple(
        TableRow(
            case.name,
            (
                plain_figure("before", "mm", None, *[case.mean_distance_before_mm] * 2, digits=3),
                error_figure(
                    "after",
                    "mm",
                    SIMULATED_MEAN_DISTANCE_MM,
                    case.sqp_mean_distance_mm,
                    case.least_squares_mean_distance_mm,
                    digits=None,
                ),
                plain_figure(
                    "iterations", "", None, float(case.sqp_iterations), float(case.least_squares_iterations), digits=0
                ),
            ),
        )
        for case in cases
    )
    low, high = SIMULATED_BEFORE_MM
    text = (
        f"The article has {low:.2f} to {high:.2f} mm before, over all cases. Its method is SQP on the mean distance; beside it stands "
        "least squares on the radial and axial distances, which --option artifact.method=least-squares chooses."
    )
    columns = ("mean distance before / mm", "mean distance after / mm", "iterations")
    table = ComparisonTable(
        "Section 5.4, table 1 and figure 12", "Disturbed axes, exact feature points", columns, rows, text
    )
    return SimulationSection(table, cases)


def mounts_section(bench: Workbench, rig: Rig, found: Calibrations) -> MountsSection:
    """Section 5.5: mean distance of the feature points before and after, for each mount."""
    together = found.together.artifact
    assert together is not None
    rows, mounts = [], []
    for k, (name, article) in enumerate(zip(mount_names(), found.article, strict=True)):
        alone, ours = article.artifact, together.mounts[k]
        assert alone is not None
        assert article.axis is not None
        errors = (
            axis_error_mm(article, article.axis.axis_camera, rig),
            axis_error_mm(article, alone.axis_camera, rig),
        )
        mounts.append(MountResult(name, alone, *errors))
        target = MEAN_DISTANCE_MM[0] if k == 0 else MEAN_DISTANCE_MM[1]
        cells = (
            plain_figure(
                "mean distance before", "mm", None, alone.mean_distance_before_mm, ours.mean_distance_before_mm
            ),
            error_figure("mean distance after", "mm", target, alone.mean_distance_mm, ours.mean_distance_mm),
            plain_figure("eccentricity", "mm", None, alone.mounts[0].eccentricity_mm, ours.eccentricity_mm, digits=2),
            plain_figure(
                "distance from the true axis",
                "mm",
                None,
                errors[1],
                axis_error_mm(found.together, together.axis_camera, rig),
            ),
        )
        rows.append(TableRow(name, cells))
    columns = tuple(f"{c.quantity} / {c.unit}" for c in rows[0].cells)
    n_columns = range(len(columns))
    rows.append(TableRow("Average", tuple(average([r.cells[i] for r in rows]) for i in n_columns)))
    low, high = MEAN_DISTANCE_MM
    text = (
        f"The article gives {low:.3f} mm for the first mount and {low:.3f} to {high:.3f} mm for all five; the upper end stands beside W2 to "
        "W5. By the article's method each mount has an axis of its own, from its own checkerboard; by the default method all mounts share one."
    )
    table = ComparisonTable(
        "Section 5.5, figure 14", "Feature points of the stepped cylinder", columns, tuple(rows), text
    )
    frames = bench.overlays(f"stepped-{mount_names()[0]}", ARTICLE_OPTIONS)
    return MountsSection(
        table,
        STEPPED_CYLINDER,
        tuple(mounts),
        together,
        axis_error_mm(found.together, together.axis_camera, rig),
        frames,
    )
