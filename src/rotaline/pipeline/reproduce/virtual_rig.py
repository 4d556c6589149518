"""The article's whole procedure on observations instead of images: what ideal detectors would return, and the chain behind them.

For the budget: one error of the rig at a time, without rendering. Target points are those of the printed plate, stripes are
traced; the errors of plates, laser sheet and turntable are in them, those of pixels are not, apart from a stated noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import RigidTransform

from rotaline.calibration.artifact import ArtifactCapture, optimise_axis
from rotaline.calibration.cross_ratio import optimise_plane_cross_ratio
from rotaline.calibration.feature_points import extract_mount_features
from rotaline.calibration.intrinsics import calibrate_camera
from rotaline.calibration.laser_plane import StripeView, calibrate_laser_plane
from rotaline.calibration.model import SystemCalibration, TargetView
from rotaline.calibration.rotation_axis import calibrate_axis
from rotaline.geometry.primitives import Line, Plane
from rotaline.io.session_file import MeasurementRequest
from rotaline.metrology.features import MeasureOptions
from rotaline.pipeline.options import Options
from rotaline.pipeline.parts import artifact_sizes, measure_request, system_at_optical_axis
from rotaline.pipeline.reproduce.article import STEPPED_CYLINDER
from rotaline.scanning.triangulation import scan_points
from rotaline.simulation.ideal.observed_scan import IdealScan, trace_scan
from rotaline.simulation.ideal.stripe_trace import trace_stripe
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.mechanics import base_from_table
from rotaline.simulation.parts.boards import Plate
from rotaline.simulation.plan import CapturePlan
from rotaline.simulation.rig import Rig
from rotaline.vision.camera import CameraModel
from rotaline.vision.stripe.model import StripePoints
from rotaline.vision.targets.model import TargetDetection

TITLES = {
    "mean_distance": "mean distance of feature points after",
    "mean_distance_before": "mean distance of feature points before",
    "diameters": "diameter error, stepped cylinder after",
    "diameters_before": "diameter error, stepped cylinder before",
    "ball": "diameter error, ball",
    "cylinder": "diameter error, cylinder",
    "groove": "depth error, groove",
}
"""What the chain ends with, mm, errors without sign; the diameter error is the mean of both diameters'."""

CORNER_SHARE = 0.5
"""Noise of target points over that of stripe centres."""


@dataclass(frozen=True, eq=False)
class PartScan:
    """A part of tables 3 to 5 as it was scanned: its stripes, and what is measured in it."""

    name: str
    feature: str
    key: str
    reference_mm: float
    stripes: tuple[StripePoints, ...]
    angles_rad: Float[np.ndarray, " f"]


@dataclass(frozen=True, eq=False)
class SensorAndAxis:
    """What the chain knows before it sees the stepped cylinder."""

    camera: CameraModel
    laser_plane_camera: Plane
    axis_camera: Line
    turn_sense: int


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise of the detectors: standard deviation of stripe centres, px; ``seed`` of it and of the turntable."""

    centre_px: float
    seed: int


def observe_sensor_and_axis(
    rig: Rig,
    camera_plan: CapturePlan,
    laser_plan: CapturePlan,
    axis_plan: CapturePlan,
    noise: Noise,
    options: Options,
) -> SensorAndAxis:
    """Camera, laser plane and initial axis from the plates in the poses of the plans.

    Raises
    ------
    CalibrationError
        If the observations do not determine them.
    """
    rng = np.random.default_rng([noise.seed, 21])
    corner_px = CORNER_SHARE * noise.centre_px

    def detect(base_from_table: RigidTransform, placed: Placed) -> TargetDetection:
        plate = placed.shape
        assert isinstance(plate, Plate)
        points_base = base_from_table.apply(placed.frame_from_part.apply(plate.points_true_board()))
        uv = rig.camera.project(rig.camera_from_base.apply(points_base))
        noisy = uv + corner_px * rng.standard_normal(uv.shape)
        return TargetDetection(plate.target, np.arange(len(uv)), noisy, corner_px)

    still = RigidTransform.identity()
    views = [TargetView(f"camera/{i:04d}", detect(still, shot.held[0])) for i, shot in enumerate(camera_plan.shots)]
    calibration = calibrate_camera(views, rig.camera.image_size, options.camera)
    stripes = []
    for i, shot in enumerate(shot for shot in laser_plan.shots if shot.laser):
        trace = trace_stripe(rig, shot.held)
        n = len(trace.uv)
        stripe = StripePoints(
            trace.uv + noise.centre_px * rng.standard_normal(n)[:, None] * trace.normal,
            trace.normal,
            trace.width_px,
            trace.intensity_dn,
            np.full(n, noise.centre_px),
            trace.saturated,
            trace.segment,
        )
        stripes.append(StripeView(f"laser/{i:04d}", detect(still, shot.held[0]), stripe))
    plane = calibrate_laser_plane(calibration.camera, stripes, options.laser_plane)
    ratio = optimise_plane_cross_ratio(calibration.camera, plane, stripes, options.cross_ratio)
    turned = []
    for i, shot in enumerate(axis_plan.shots):
        assert shot.angle_deg is not None
        frame_rng = np.random.default_rng([noise.seed, 22, i])
        pose = base_from_table(rig.turn_sense, rig.mechanics, shot.angle_deg, frame_rng)
        turned.append(TargetView(f"axis/{i:04d}", detect(pose, shot.on_table[0]), float(np.radians(shot.angle_deg))))
    axis = calibrate_axis(calibration.camera, turned, options.axis)
    return SensorAndAxis(calibration.camera, ratio.plane_camera, axis.axis_camera, axis.turn_sense)


def observe_capture(rig: Rig, plan: CapturePlan, noise: Noise, number: int) -> tuple[StripePoints, ...]:
    """The stripes of a scan as an ideal extractor would return them; ``number`` tells captures of one seed apart."""
    angles = [float(shot.angle_deg) for shot in plan.shots if shot.angle_deg is not None]
    scan: IdealScan = trace_scan(rig, plan.shots[0].on_table, angles, seed=1000 * noise.seed + number, spacing_px=1.0)
    return scan.observed(noise.centre_px, [noise.seed, number])


def resulting_figures(
    known: SensorAndAxis,
    stepped: Sequence[StripePoints],
    stepped_angles_rad: Float[np.ndarray, " f"],
    parts: Sequence[PartScan],
    options: Options,
) -> dict[str, float]:
    """The figures of :data:`TITLES`; a feature that is not found is NaN.

    Raises
    ------
    CalibrationError
        If the stepped cylinder does not determine the axis.
    """
    features = extract_mount_features(
        stepped, known.camera, known.laser_plane_camera, STEPPED_CYLINDER, known.axis_camera
    )
    capture = ArtifactCapture(
        "stepped",
        tuple(f"stepped/{i:04d}" for i in range(len(features))),
        stepped_angles_rad,
        np.array([f.points_camera for f in features]).reshape(-1, 4, 3),
        tuple(f.reason for f in features),
    )
    optimised = optimise_axis(known.axis_camera, known.turn_sense, [capture], STEPPED_CYLINDER, options.artifact)

    def measured(
        axis: Line,
        stripes: Sequence[StripePoints],
        angles_rad: Float[np.ndarray, " f"],
        feature: str,
        sizes: dict[str, float],
    ) -> dict[str, float]:
        system = SystemCalibration(known.camera, known.laser_plane_camera, axis, known.turn_sense, table_seen=False)
        cloud = scan_points(stripes, angles_rad, system_at_optical_axis(system))
        request = MeasurementRequest(capture="scan", feature=feature, reference=sizes, nominal=sizes)  # type: ignore[arg-type]
        return measure_request(request, cloud, MeasureOptions()).error

    def diameters(axis: Line) -> float:
        sizes = artifact_sizes(STEPPED_CYLINDER)
        error = measured(axis, stepped, stepped_angles_rad, "stepped-cylinder", sizes)
        return float(np.mean([abs(error.get(key, np.nan)) for key in ("diameter_small", "diameter_large")]))

    figures = {
        "mean_distance": optimised.mean_distance_mm,
        "mean_distance_before": optimised.mean_distance_before_mm,
        "diameters": diameters(optimised.axis_camera),
        "diameters_before": diameters(known.axis_camera),
    }
    for part in parts:
        error = measured(
            optimised.axis_camera, part.stripes, part.angles_rad, part.feature, {part.key: part.reference_mm}
        )
        figures[part.name] = abs(error.get(part.key, float("nan")))
    return figures
