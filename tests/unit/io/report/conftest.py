"""Plausible contents of a report and of a reproduced article, made without any estimator."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.joint.model import (
    EstimatedQuantity,
    JointCalibration,
    JointMount,
    OptionalParameters,
    ResidualGroup,
    TableErrors,
    ViewResiduals,
    WeakDirection,
)
from rotaline.calibration.model import (
    AngleError,
    ArtifactCalibration,
    ArtifactMount,
    AxisCalibration,
    AxisFrame,
    CameraCalibration,
    CameraView,
    CrossRatioResult,
    LaserPlaneCalibration,
    StripeOnBoard,
    SystemCalibration,
    SystemCovariance,
)
from rotaline.calibration.speckle_limit import LaserOptics, speckle_limit_at_axis
from rotaline.calibration.verdict.model import Figure, Finding, StepVerdict, Verdict
from rotaline.geometry.primitives import Line, Plane, SteppedCylinder, unit
from rotaline.geometry.transforms import base_from_axis, rotate_about_line
from rotaline.io.report.contents import (
    CaptureSummary,
    CloudSummary,
    FittedPoints,
    FrameOverlay,
    ReportContents,
    RunInfo,
    StageWarning,
    SurfaceSummary,
)
from rotaline.io.report.reproduction import (
    AxisCase,
    Budget,
    BudgetLevel,
    BudgetSource,
    Comparison,
    ComparisonTable,
    ComplexPartResult,
    ComplexPartsSection,
    DetailResult,
    InitialAxisSection,
    MountResult,
    MountsSection,
    PartsSection,
    Reproduction,
    ReproductionInfo,
    SensorSection,
    SimulationSection,
    TableRow,
)
from rotaline.io.results import MeasurementEntry
from rotaline.metrology.model import FeatureMeasurement
from rotaline.scanning.cloud import PointCloud
from rotaline.vision.camera import CameraModel

CAMERA = CameraModel((1280, 960), 2450.0, 2451.5, 642.3, 478.1, -0.11, 0.19, 2e-4, -3e-4)
AXIS = Line(np.array([3.0, 20.0, 300.0]), unit(np.array([0.01, -0.82, -0.57])))
PLANE = Plane(unit(np.array([0.85, 0.03, -0.5])), float(-unit(np.array([0.85, 0.03, -0.5])) @ [3.0, 20.0, 300.0]))
ARTIFACT = SteppedCylinder(23.051, 36.006, 22.003, 25.005)


def _board(columns: int, rows: int, pitch: float) -> np.ndarray:
    r, c = np.mgrid[0:rows, 0:columns]
    return np.stack([c.ravel() * pitch, r.ravel() * pitch, 0.0 * r.ravel()], axis=1)


def _pose(rng: np.random.Generator, size: tuple[float, float], tilt: float = 0.45) -> RigidTransform:
    rotation = Rotation.from_rotvec(rng.uniform(-tilt, tilt, 3))
    middle = rotation.apply(np.array([size[0] / 2, size[1] / 2, 0.0]))
    at = np.array([rng.uniform(-28, 28), rng.uniform(-18, 18), rng.uniform(260, 340)])
    return RigidTransform.from_components(at - middle, rotation)


def make_camera(rng: np.random.Generator) -> CameraCalibration:
    points = _board(18, 16, 4.0)
    views = []
    for i in range(14):
        pose = _pose(rng, (68.0, 60.0))
        uv = CAMERA.project(pose.apply(points))
        residuals = rng.normal(0, 0.05, uv.shape) + 2e-5 * (uv - 500)
        used = i not in (4, 9)
        residuals = residuals if used else residuals * 8
        views.append(
            CameraView(
                f"camera/{i:04d}.png",
                used,
                "" if used else "RMS 0.42 px is more than three times the median of the other views",
                pose,
                float(np.sqrt((residuals**2).sum(axis=1).mean())),
                uv + residuals,
                residuals,
            )
        )
    names = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")
    u = np.array([0.61, 0.60, 0.9, 0.8, 7e-4, 1.1e-2, 3e-5, 4e-5])
    warning = ("The corners of the image were hardly seen: put the board there in two or three more views.",)
    return CameraCalibration(CAMERA, names, u, tuple(views), 0.0712, 0.0631, warning)


def make_laser_plane(rng: np.random.Generator) -> LaserPlaneCalibration:
    views = []
    for i in range(10):
        pose = _pose(rng, (48.0, 48.0))
        x = np.linspace(-5, 53, 220)
        board = pose.apply(np.stack([x, x * 0, x * 0], axis=1))
        normal = pose.rotation.apply([0.0, 0.0, 1.0])
        along = unit(np.cross(normal, PLANE.normal))
        start = board[110] - PLANE.signed_distance_to(board[110:111])[0] * PLANE.normal
        points = start + np.linspace(-24, 24, 220)[:, None] * along
        residuals = rng.normal(0, 0.012, len(points)) + rng.normal(0, 0.004)
        uv = CAMERA.project(points)
        used = i != 7
        views.append(
            StripeOnBoard(
                f"laser/{2 * i + 1:04d}.png",
                used,
                "" if used else "the stripe misses the dots",
                pose,
                uv,
                points + residuals[:, None] * PLANE.normal,
                residuals,
            )
        )
    return LaserPlaneCalibration(PLANE, tuple(views), 0.0126, (2.1e-5, 1.3e-5), 0.0011, ())


def make_cross_ratio(rng: np.random.Generator) -> CrossRatioResult:
    view = np.repeat(np.arange(10), 8)
    row = np.tile(np.arange(8), 10)
    reference = 6.0 + rng.uniform(0, 0.6, 80)
    before = reference + rng.normal(0.008, 0.018, 80)
    after = reference + rng.normal(0, 0.0028, 80)
    return CrossRatioResult(
        Plane(unit(PLANE.normal + np.array([1e-4, 0.0, 2e-4])), PLANE.offset + 0.02),
        PLANE,
        True,
        "",
        tuple(f"laser/{2 * i + 1:04d}.png" for i in range(10)),
        view,
        row,
        reference,
        before,
        after,
        0.0206,
        0.0028,
        14,
        True,
        np.geomspace(0.0206, 0.0028, 15),
        (),
    )


def make_axis(rng: np.random.Generator) -> AxisCalibration:
    points = _board(18, 16, 4.0)
    stand = RigidTransform.from_components(
        AXIS.point + np.array([-34.0, -62.0, -8.0]), Rotation.from_rotvec([0.55, 0.05, 0.02])
    )
    first = stand.apply(points)
    angles = np.deg2rad(np.arange(-20.0, 21.0, 2.0))
    corners, frames = [], []
    for i, angle in enumerate(angles):
        turn = Rotation.from_rotvec(angle * AXIS.direction)
        pose = RigidTransform.from_components(AXIS.point - turn.apply(AXIS.point), turn) * stand
        noise = Rotation.from_rotvec(rng.normal(0, 1e-4, 3))
        pose = RigidTransform.from_components(pose.translation, noise * pose.rotation)
        used = i != 3
        frames.append(
            AxisFrame(f"axis/{i:04d}.png", used, "" if used else "board half out of view", float(angle), pose, 0.05)
        )
        corners.append(rotate_about_line(first, AXIS, float(angle)) + rng.normal(0, 0.01, first.shape))
    track = np.array(corners)
    track[3] = np.nan
    centres = AXIS.closest_to(first) + rng.normal(0, 0.006, first.shape)
    return AxisCalibration(
        AXIS,
        1,
        tuple(frames),
        np.arange(len(points)),
        track,
        centres,
        AXIS.distance_to(first),
        np.abs(rng.normal(0.011, 0.002, len(points))),
        0.0112,
        0.0061,
        2.4e-5,
        0.0031,
        (),
    )


def make_mount(rng: np.random.Generator, name: str, eccentricity: float) -> ArtifactMount:
    angles = np.deg2rad(np.arange(0.0, 360.0, 4.0))
    n = len(angles)
    circles = ARTIFACT.edge_circles_part()
    part = np.array([[c.centre + c.radius * np.array([np.cos(-a), np.sin(-a), 0]) for c in circles] for a in angles])
    pose = RigidTransform.from_components([eccentricity, 0.3, 0.0], Rotation.from_rotvec([0.002, 0.001, 0.0]))
    features = pose.apply(part.reshape(-1, 3)).reshape(n, 4, 3) + rng.normal(0, 0.005, (n, 4, 3))
    wave = 0.25 * np.stack([np.cos(2 * angles), np.sin(angles), 0 * angles], axis=1)[:, None]
    before = features + wave
    features[5, 2] = np.nan
    before[5] = np.nan
    axis = base_from_axis(AXIS)

    def distances(points: np.ndarray) -> np.ndarray:
        local = pose.inv().apply(np.nan_to_num(points).reshape(-1, 3)).reshape(n, 4, 3)
        d = [
            np.hypot(np.hypot(local[:, h, 0], local[:, h, 1]) - c.radius, local[:, h, 2] - c.centre[2])
            for h, c in enumerate(circles)
        ]
        return np.where(np.isfinite(points).all(axis=2), np.stack(d, axis=1), np.nan)

    used = tuple(i != 5 for i in range(n))
    return ArtifactMount(
        name,
        tuple(f"{name}/{i:04d}.png" for i in range(n)),
        angles,
        used,
        tuple("" if u else "only three segments were found" for u in used),
        axis.inv().apply(np.nan_to_num(features).reshape(-1, 3)).reshape(n, 4, 3),
        before,
        features,
        distances(before),
        distances(features),
        pose,
        pose,
        float(np.nanmean(distances(before))),
        float(np.nanmean(distances(features))),
        eccentricity,
    )


def make_artifact(rng: np.random.Generator) -> ArtifactCalibration:
    mounts = (make_mount(rng, "stepped-1", 0.4), make_mount(rng, "stepped-2", 5.1))
    before = float(np.mean([m.mean_distance_before_mm for m in mounts]))
    after = float(np.mean([m.mean_distance_mm for m in mounts]))
    moved = Line(AXIS.point + np.array([0.21, 0.0, -0.13]), unit(AXIS.direction + np.array([4e-4, 0.0, 6e-4])))
    return ArtifactCalibration(
        "sqp", AXIS, moved, mounts, before, after, 22, True, np.geomspace(before, after, 23), 3.1e-5, 0.0013, ()
    )


def make_cloud(points: np.ndarray, rng: np.random.Generator) -> PointCloud:
    angle = np.arctan2(points[:, 1], points[:, 0]) % (2 * np.pi)
    frame = (np.rad2deg(angle) / 2).astype(int)
    n = len(points)
    return PointCloud(
        points,
        np.tile([250.0, 0.0, 120.0], (n, 1)),
        rng.uniform(60, 230, n),
        -angle,
        frame,
        rng.uniform(0.003, 0.02, n),
        np.full(n, 0.002),
    )


def _sphere(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    d = rng.normal(size=(n, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    d[:, 2] = np.abs(d[:, 2]) * 1.4 - 0.4
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    r = rng.normal(0, 0.005, n) + 0.004 * np.sin(3 * np.arctan2(d[:, 1], d[:, 0]))
    return np.array([4.0, -2.0, 24.0]) + (14.2375 + r)[:, None] * d, r


def _cylinder(rng: np.random.Generator, n: int, radius: float, height: float) -> tuple[np.ndarray, np.ndarray]:
    phi, z = rng.uniform(0, 2 * np.pi, n), rng.uniform(0, height, n)
    r = rng.normal(0, 0.006, n) + 0.003 * np.cos(2 * phi)
    return np.stack([(radius + r) * np.cos(phi), (radius + r) * np.sin(phi), z], axis=1), r


def _groove(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray]:
    x, y = rng.uniform(-20, 20, n), rng.uniform(-12, 12, n)
    depth = np.clip((np.abs(x) - 6.0) * 4.0, 0, 12.0)
    r = rng.normal(0, 0.007, n)
    return np.stack([x, y, 30.0 - 12.0 + depth + r], axis=1), r


def _measurement(feature: str, value: dict, r: np.ndarray, geometry: dict, warnings: tuple = ()) -> FeatureMeasurement:
    return FeatureMeasurement(
        feature,
        value,
        dict.fromkeys(value, 0.0004),
        len(r) * 12,
        float(np.sqrt(np.mean(r**2))),
        float(np.ptp(r)),
        np.arange(len(r)),
        r,
        geometry,
        0.83,
        warnings,
    )


def tube_mesh(n: int, m: int) -> tuple[np.ndarray, np.ndarray]:
    phi, z = np.meshgrid(np.linspace(0, 2 * np.pi, n, endpoint=False), np.linspace(0, 50, m), indexing="ij")
    r = 18 + 5 * np.sin(z / 8) + 1.2 * np.cos(7 * phi)
    vertices = np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=-1).reshape(-1, 3)
    i, j = (g.ravel() for g in np.meshgrid(np.arange(n), np.arange(m - 1), indexing="ij"))
    a, b, c, d = i * m + j, (i + 1) % n * m + j, (i + 1) % n * m + j + 1, i * m + j + 1
    return vertices, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def make_contents(scale: int = 1) -> ReportContents:
    """Contents with every field filled; ``scale`` multiplies the points of the scans."""
    rng = np.random.default_rng(11)
    n = 1500 * scale
    ball, r_ball = _sphere(rng, n)
    rod, r_rod = _cylinder(rng, n, 19.002, 40.0)
    groove, r_groove = _groove(rng, n)
    stepped, r_stepped = _cylinder(rng, n, 18.003, 25.0)
    sphere_geometry = {"centre": [4.0, -2.0, 24.0], "radius": 14.2375}
    axis_geometry = {"axis_point": [0.0, 0.0, 0.0], "axis_direction": [0.0, 0.0, 1.0], "radius": 19.002}
    stepped_geometry = {
        "axis_point_large": [0.0, 0.0, 0.0],
        "axis_direction_large": [0.0, 0.0, 1.0],
        "radius_large": 18.003,
    }
    groove_geometry = {"top_normal": [0.0, 0.0, 1.0], "direction": [0.0, 1.0, 0.0], "tilt_deg": 0.031}
    sizes = {"diameter_small": 23.051, "diameter_large": 36.006, "height_small": 22.003, "height_large": 25.005}

    def entries(offset: float) -> tuple[MeasurementEntry, ...]:
        def stepped_values(shift: float) -> dict[str, float]:
            return {k: v + shift * (1 + 0.3 * i) for i, (k, v) in enumerate(sizes.items())}

        return (
            *(
                MeasurementEntry(
                    f"stepped-{i}",
                    "stepped-cylinder",
                    "stepped-cylinder",
                    _measurement("stepped-cylinder", stepped_values(offset + 0.001 * i), r_stepped, stepped_geometry),
                    sizes,
                )
                for i in (1, 2)
            ),
            MeasurementEntry(
                "ball",
                "sphere",
                "ceramic ball",
                _measurement("sphere", {"diameter": 28.475 - 0.0033 + offset}, r_ball, sphere_geometry),
                {"diameter": 28.475},
            ),
            MeasurementEntry(
                "rod",
                "cylinder",
                "rod",
                _measurement(
                    "cylinder",
                    {"diameter": 38.004 - 0.0007 + offset},
                    r_rod,
                    axis_geometry,
                    ("Only 83 % of the turn was seen: turn the table through 360 deg.",),
                ),
                {"diameter": 38.004},
            ),
            MeasurementEntry(
                "groove",
                "groove",
                "groove",
                _measurement(
                    "groove",
                    {"depth": 12.0023 + offset / 5, "width_top": 18.01, "width_bottom": 11.98},
                    r_groove,
                    groove_geometry,
                ),
                {"depth": 12.003},
            ),
            MeasurementEntry("ball", "plane", "table", None, {}, "no plane with more than 50 points; name a region."),
        )

    image = np.zeros((240, 320, 3), np.uint8)
    image[:] = (rng.uniform(20, 60, (240, 320, 1))).astype(np.uint8)
    image[60:180, 80:240] = 150
    corners = np.stack([g.ravel() for g in np.meshgrid(np.linspace(340, 940, 9), np.linspace(260, 700, 7))], axis=1)
    line = np.stack([np.linspace(300, 960, 900), 400 + 80 * np.sin(np.linspace(0, 3, 900))], axis=1)
    vertices, triangles = tube_mesh(120 * scale, 60)
    axis, artifact = make_axis(rng), make_artifact(rng)
    clouds = {"ball": ball, "stepped-1": stepped}
    return ReportContents(
        run=RunInfo(
            "rig-demo",
            "2026-03-14 15:09:26 +0100",
            {"rotaline": "0.1.0", "python": "3.11.9", "numpy": "2.4.6", "opencv": "4.13.0", "scipy": "1.17.1"},
            "Linux x86_64, 2 cores",
            {"camera.max_rms_px": "1.0", "stripe.method": "improved-gray-gravity", "artifact.method": "sqp"},
            {
                "camera": 2.31,
                "laser-plane": 5.62,
                "cross-ratio": 0.41,
                "axis": 3.3,
                "artifact": 14.1,
                "scan": 9.9,
                "surface": 75.0,
            },
        ),
        captures=(
            CaptureSummary("camera", "camera", "checkerboard", 14, 0, (1280, 960)),
            CaptureSummary("laser", "laser-plane", "dots", 20, 10, (1280, 960)),
            CaptureSummary("axis", "axis", "checkerboard", 21, 0, (1280, 960)),
            CaptureSummary("stepped-1", "artifact", "stepped-cylinder", 90, 90, (1280, 960)),
            CaptureSummary("stepped-2", "artifact", "stepped-cylinder", 90, 90, (1280, 960)),
            CaptureSummary("ball", "scan", "", 180, 180, (1280, 960)),
        ),
        targets={
            "checkerboard": "checkerboard, 18 x 16 inner corners, pitch 4 mm",
            "dots": "dot plate, 9 x 9 dots, pitch 6 mm, diameter 3 mm",
            "stepped-cylinder": "stepped cylinder, diameters 23.051 / 36.006 mm, heights 22.003 / 25.005 mm",
        },
        warnings=(
            StageWarning(
                "camera", "no target in 1 of 15 frames of camera: camera/0014.png: 17 x 16 corners were nearly found."
            ),
            StageWarning(
                "artifact",
                "stepped-1 is only 0.4 mm off centre and says little about the axis. Mount it 5 to 8 mm off centre.",
            ),
            StageWarning(
                "scan", "groove: the stripe is missing in 41 of 180 frames. Raise the exposure.", serious=True
            ),
        ),
        camera=make_camera(rng),
        laser_plane=make_laser_plane(rng),
        cross_ratio=make_cross_ratio(rng),
        axis=axis,
        artifact=artifact,
        calibration=SystemCalibration(CAMERA, PLANE, AXIS, 1, True),
        clouds=tuple(CloudSummary(name, make_cloud(p, rng), len(p) * 12, 180, 3) for name, p in clouds.items()),
        surfaces=(
            SurfaceSummary("ball", vertices, triangles),
            SurfaceSummary("rod", np.zeros((0, 3)), np.zeros((0, 3), int), "too few points (12) for a surface."),
        ),
        measurements=entries(0.001),
        measurements_initial_axis=entries(0.31),
        overlays=(
            *(
                FrameOverlay(
                    "axis", f"axis/{i:04d}.png", f"{i * 8 - 16} deg, 63 corners", image, 0.25, corners + 12.0 * i
                )
                for i in range(5)
            ),
            FrameOverlay("laser-plane", "laser/0001.png", "stripe, 900 points", image, 0.25, line),
            FrameOverlay("scan", "ball/0007.png", "stripe, 900 points", image, 0.25, line),
        ),
        fitted_points=(
            FittedPoints("stepped-1", "stepped-cylinder", "stepped-cylinder", stepped, r_stepped),
            FittedPoints("ball", "sphere", "ceramic ball", ball, r_ball),
            FittedPoints("rod", "cylinder", "rod", rod, r_rod),
            FittedPoints("groove", "groove", "groove", groove, r_groove),
        ),
        artifacts={"stepped-1": ARTIFACT, "stepped-2": ARTIFACT},
    )


def make_group(kind: str, name: str, n_views: int, n_points: int, sigma: float, rng: np.random.Generator):
    """Residuals of a capture: noise of ``sigma`` px; one frame is left out of targets."""
    dim = 2 if "target" in kind else 1
    views = []
    for i in range(n_views):
        u = rng.uniform(60, 1220, n_points)
        uv = np.stack([u, rng.uniform(40, 920, n_points)], axis=1)
        residuals = rng.normal(0.0, sigma, (n_points, dim))
        used = not (dim == 2 and i == 3)
        views.append(
            ViewResiduals(
                f"{name}/{i:04d}.png",
                used,
                "" if used else "RMS 0.42 px, seven times that of the others",
                uv,
                residuals * (1.0 if used else 8.0),
                np.ones(n_points) * used,
                float(np.sqrt((residuals**2).sum(axis=1).mean())),
                1.1 * sigma * np.sqrt(dim) if i % 4 == 0 else float("nan"),
                np.deg2rad(4.0 * i),
            )
        )
    n_used = sum(v.used for v in views) * n_points
    return ResidualGroup(
        kind,
        name,
        tuple(views),
        sigma,
        sigma * np.sqrt(dim),
        0.8 * sigma * np.sqrt(dim),
        1.0 if dim == 2 else 3.4,
        n_views * n_points,
        n_used,
    )


def make_joint_mount(rng: np.random.Generator, name: str, eccentricity: float) -> JointMount:
    """Points on all surfaces of the stepped cylinder with noise, frame errors and a wave over the turn."""
    angles = np.deg2rad(np.arange(0.0, 360.0, 4.0))
    r1, r2, h1, h2 = 11.5255, 18.003, 22.003, 25.005
    profile = [
        (np.linspace(1.0, r1 - 0.3, 25), np.full(25, h1 + h2)),
        (np.full(50, r1), np.linspace(h2 + 0.3, h1 + h2 - 0.3, 50)),
        (np.linspace(r1 + 0.3, r2 - 0.3, 15), np.full(15, h2)),
        (np.full(60, r2), np.linspace(0.3, h2 - 0.3, 60)),
    ]
    radius, z = (np.concatenate([p[i] for p in profile]) for i in (0, 1))
    surface = np.repeat(np.arange(4), [len(p[0]) for p in profile])
    f, p = len(angles), len(radius)
    frame = np.repeat(np.arange(f), p)
    turn = np.tile(radius * 0.0, f) - angles[frame] + 0.05 * np.sin(np.tile(z, f))
    points = np.stack([np.tile(radius, f) * np.cos(turn), np.tile(radius, f) * np.sin(turn), np.tile(z, f)], axis=1)
    wave = 0.002 * np.cos(angles) + 0.0007 * np.sin(2 * angles) + rng.normal(0, 0.001, f)
    distances = rng.normal(0.0, 0.005, f * p) + wave[frame]
    weight = np.where(rng.uniform(size=f * p) < 0.01, 0.0, 1.0)
    here = [np.tile(surface, f) == s for s in range(4)]
    return JointMount(
        name,
        ARTIFACT,
        RigidTransform.from_components([eccentricity, 0.3, 0.0], Rotation.from_rotvec([0.002, 0.001, 0.0])),
        eccentricity,
        0.0007,
        0.0022,
        tuple(f"{name}/{i:04d}.png" for i in range(f)),
        angles,
        frame,
        np.tile(surface, f),
        points,
        distances,
        distances * 8.0,
        weight,
        ("top disc", "small side", "step", "large side"),
        np.array([distances[h].mean() for h in here]),
        np.array([distances[h].std() for h in here]),
        0.0058,
    )


def make_joint(rng: np.random.Generator) -> JointCalibration:
    """A joint estimate with every field filled."""
    names = ("fx", "fy", "cx", "cy", "plane_turn_1", "plane_turn_2", "plane_offset", "axis_turn_x", "axis_turn_y",
             "axis_shift_x", "axis_shift_y", "angle_cos", "angle_sin")  # fmt: skip
    u = np.array([0.3, 0.3, 0.4, 0.4, 9e-6, 7e-6, 0.0009, 2.6e-5, 3.1e-5, 0.0011, 0.0013, 4e-6, 4e-6])
    frames = np.concatenate([np.deg2rad(np.arange(0.0, 360.0, 4.0))] * 2)
    errors = rng.normal(0, 1.0, (len(frames), 6)) * [1e-5, 1e-5, 3.5e-5, 0.001, 0.001, 0.0005]
    mounts = (make_joint_mount(rng, "stepped-1", 0.4), make_joint_mount(rng, "stepped-2", 5.1))
    return JointCalibration(
        camera=CAMERA,
        camera_names=names[:4],
        laser_plane_camera=PLANE,
        laser_curvature=None,
        axis_camera=AXIS,
        turn_sense=1,
        angle_error=AngleError(2.1e-5, -4.4e-5),
        covariance=SystemCovariance(names, np.diag(u**2), AXIS.point, AXIS.point),
        parameters=(
            EstimatedQuantity("focal length fx", 2450.02, 0.3, "px", "image"),
            EstimatedQuantity("k1", -0.11021, 6e-4, "", "image"),
            EstimatedQuantity("direction of the laser plane, first", 0.0, 9e-6, "rad", "camera"),
            EstimatedQuantity("distance of the laser plane", 150.0123, 0.0009, "mm", "camera"),
            EstimatedQuantity("direction of the axis about x", 0.0, 2.6e-5, "rad", "base"),
            EstimatedQuantity("place of the axis along x", 0.0, 0.0011, "mm", "base"),
        ),
        groups=(
            make_group("target", "camera", 14, 288, 0.03, rng),
            make_group("target", "laser", 10, 81, 0.011, rng),
            make_group("plate-stripe", "laser", 10, 200, 0.06, rng),
            make_group("table-target", "axis", 21, 288, 0.04, rng),
            make_group("artifact", "stepped-1", 90, 50, 0.07, rng),
            make_group("artifact", "stepped-2", 90, 50, 0.07, rng),
        ),
        mounts=mounts,
        table=TableErrors(
            ("angle", "run-out"),
            np.array([3.5e-5, 0.001]),
            np.array([2e-6, 8e-5]),
            ("stepped-1",) * 90 + ("stepped-2",) * 90,
            tuple(f"stepped-{m}/{i:04d}.png" for m in (1, 2) for i in range(90)),
            frames,
            errors,
        ),
        optional=(
            OptionalParameters(
                "angle harmonics",
                True,
                "chi-square 131 for 2 parameters",
                131.2,
                {"cos": 2.1e-5, "sin": -4.4e-5},
                {"cos": 4e-6, "sin": 4e-6},
                {"cos": "rad", "sin": "rad"},
            ),
            OptionalParameters(
                "pitch of checkerboard",
                False,
                "the pitch and the artefact agree within U",
                1.3,
                {"true over stated": 1.00002},
                {"true over stated": 3e-5},
                {"true over stated": ""},
            ),
        ),
        weak_directions=(
            WeakDirection(
                "axis position across the laser plane",
                0.034,
                "mm",
                "the mounts are too well centred: the axis is uncertain by 34 µm across the laser plane",
                "Mount the cylinder 5 to 8 mm off centre and add the capture.",
                0.83,
            ),
        ),
        n_parameters=312,
        n_observations=61234,
        n_iterations=9,
        converged=True,
        seconds=7.2,
        warnings=("stepped-1: 60 points lie on no surface.",),
    )


def make_verdict() -> Verdict:
    """A doubtful one with two findings."""
    return Verdict(
        "doubtful",
        "The calibration can be used, but the axis is known less well than the rest.",
        (
            StepVerdict("session", "pass", "Complete."),
            StepVerdict(
                "camera",
                "pass",
                "Views that were left out are predicted as well as the others.",
                (Figure("RMS", 0.0421, "px"), Figure("held-out RMS", 0.0452, "px", "below 0.06 px")),
            ),
            StepVerdict("laser-plane", "pass", "Ten poses over 62 mm of depth.", (Figure("depth", 62.0, "mm"),)),
            StepVerdict("axis", "doubtful", "Both mounts are too well centred.", (Figure("u", 34.0, "µm", "< 5 µm"),)),
            StepVerdict("artifact", "pass", "All surfaces fit to 5.2 µm RMS."),
            StepVerdict("table", "none", "No frames of a full turn."),
        ),
        (
            Finding(
                "mount too well centred",
                "axis",
                "doubtful",
                "The mounts stand 0.4 and 0.6 mm off centre, so the axis is uncertain by 34 µm across the laser plane.",
                "Mount the cylinder 5 to 8 mm off centre and add the capture.",
                6.4,
            ),
            Finding(
                "over-exposure",
                "artifact",
                "doubtful",
                "12 % of the stripe points of stepped-2 are saturated.",
                "Shorten the exposure by a third.",
                1.05,
            ),
        ),
        0.0068,
        0.0051,
    )


def make_joint_contents(contents: ReportContents) -> ReportContents:
    """The contents of a run with the joint estimate: no cross-ratio and no SQP, but a verdict, U and a speckle limit."""
    rng = np.random.default_rng(17)
    joint = make_joint(rng)
    system = SystemCalibration(CAMERA, PLANE, AXIS, 1, True, angle_error=joint.angle_error, covariance=joint.covariance)
    entries = []
    for entry in contents.measurements:
        m = entry.measurement
        if m is not None:
            m = dataclasses.replace(m, u_scatter=dict.fromkeys(m.value, 0.0003))
            m = m.with_calibration(dict.fromkeys(m.value, 0.0011))
        entries.append(dataclasses.replace(entry, measurement=m))
    seconds = {stage: s for stage, s in contents.run.stage_seconds.items() if stage not in ("cross-ratio", "artifact")}
    options = contents.run.options | {"calibration.method": "joint"}
    return dataclasses.replace(
        contents,
        run=dataclasses.replace(contents.run, options=options, stage_seconds=seconds | {"joint": 7.2}),
        cross_ratio=None,
        artifact=None,
        joint=joint,
        verdict=make_verdict(),
        speckle_limit=speckle_limit_at_axis(LaserOptics(5.6, 3.75, 650.0, 0.12), system),
        calibration=system,
        measurements=tuple(entries),
    )


@pytest.fixture(scope="session")
def joint_contents(full_contents: ReportContents) -> ReportContents:
    """Every field of a run with the joint estimate filled."""
    return make_joint_contents(full_contents)


@pytest.fixture(scope="session")
def full_contents() -> ReportContents:
    """Every field filled."""
    return make_contents()


@pytest.fixture(scope="session")
def bare_contents(full_contents: ReportContents) -> ReportContents:
    """A run in which no stage got anywhere."""
    return dataclasses.replace(
        full_contents,
        run=RunInfo("empty", "", {}, "", {}, {}),
        captures=(),
        targets={},
        warnings=(),
        camera=None,
        laser_plane=None,
        cross_ratio=None,
        axis=None,
        artifact=None,
        calibration=None,
        clouds=(),
        surfaces=(),
        measurements=(),
        measurements_initial_axis=(),
        overlays=(),
        fitted_points=(),
        artifacts={},
    )


def _comparison(quantity: str, article: float | None, faithful: float, default: float, **more) -> Comparison:
    def verdict(ours: float) -> str:
        if article is None:
            return "none"
        return "better" if ours < 0.8 * article else "equal" if ours <= 1.2 * article else "worse"

    settings = {"unit": "mm"} | more
    unit = settings.pop("unit")
    return Comparison(quantity, unit, article, faithful, default, verdict(faithful), verdict(default), **settings)


def _table(place: str, title: str, columns: tuple[str, ...], n: int, rng: np.random.Generator) -> ComparisonTable:
    """A table whose figures of ours are between 0.3 and 1.6 of the article's."""
    rows = []
    for i in range(n):
        theirs = rng.uniform(0.005, 0.4, len(columns))
        cells = tuple(
            _comparison(
                name.split(" / ")[0], float(t), float(t * rng.uniform(0.3, 1.6)), float(t * rng.uniform(0.3, 1.3))
            )
            for name, t in zip(columns, theirs, strict=True)
        )
        rows.append(TableRow(f"W{i + 1}" if i < n - 1 else "Average", cells))
    return ComparisonTable(place, title, columns, tuple(rows), "Errors against the true diameters.")


def _complex_part(rng: np.random.Generator, name: str, title: str) -> ComplexPartResult:
    vertices, triangles = tube_mesh(140, 60)
    radii = np.hypot(vertices[:, 0], vertices[:, 1])
    deviation = 0.02 * np.sin(vertices[:, 2] / 3) * (radii / 18) + rng.normal(0, 0.004, len(vertices))
    deviation[vertices[:, 2] < 1.0] = np.nan
    details = []
    for i, azimuth in enumerate((20.0, 120.0, 250.0)):
        direction = np.array([np.cos(np.deg2rad(azimuth)), np.sin(np.deg2rad(azimuth)), 0.0])
        at = vertices[np.argmax(vertices @ direction - 0.3 * np.abs(vertices[:, 2] - 10.0 - 12.0 * i))]
        details.append(
            DetailResult(f"bump {i + 1}", at, direction, 1.0, 0.5, 0.46 - 0.2 * i, 0.013, i < 2, "a small sphere")
        )
    photo = np.full((240, 320, 3), 12, np.uint8)
    photo[60:200, 110:210] = 90
    pick = rng.choice(len(vertices), 6000, replace=False)
    return ComplexPartResult(
        name,
        title,
        photo,
        vertices[pick],
        181234,
        vertices,
        triangles,
        deviation,
        0.0141,
        0.0312,
        0.963,
        tuple(details),
    )


def make_budget() -> Budget:
    titles = {
        "mean_distance": "mean distance after",
        "diameter": "diameter error after",
        "ball": "ball, diameter error",
        "groove": "groove, depth error",
    }
    article = {"mean_distance": 0.011, "diameter": 0.0289}
    names = (
        ("readout_noise", "Read-out noise", "deg"),
        ("eccentricity", "Read-out eccentricity", "deg"),
        ("run_out", "Run-out", "mm"),
        ("speckle", "Speckle contrast", ""),
        ("pitch", "Pitch of the target", "%"),
    )
    sources = []
    for i, (key, title, of) in enumerate(names):
        levels = tuple(
            BudgetLevel(
                s,
                {
                    k: 0.002 + s * (i + 1) * (0.3 + 0.2 * j) if (i, j) != (2, 3) else float("nan")
                    for j, k in enumerate(titles)
                },
            )
            for s in (0.0, 0.005, 0.01, 0.02)
        )
        meets = (0.011 - 0.002) / ((i + 1) * 0.3)
        sources.append(
            BudgetSource(
                key,
                title,
                of,
                i > 2,
                levels,
                {"mean_distance": meets if meets <= 0.02 else None, "diameter": None},
                "rises evenly",
            )
        )
    return Budget(titles, article, tuple(sources), "All errors are off but the one that is varied.")


def make_reproduction(contents: ReportContents) -> Reproduction:
    """Every section filled; figures are made up."""
    rng = np.random.default_rng(5)
    axis, artifact = contents.axis, contents.artifact
    claims = ComparisonTable(
        "Abstract and conclusions",
        "Claims",
        ("",),
        tuple(
            TableRow(f"{c.quantity} / {c.unit}", (c,))
            for c in (
                _comparison("interval RMSE after", 0.003, 0.0029, 0.0019),
                _comparison(
                    "largest relative error", 0.1458, 0.031, 0.02, unit="%", note="of ball, cylinder and groove"
                ),
                _comparison("mean distance after", 0.012, 0.019, 0.0051),
            )
        ),
        "The abstract claims a reduction by more than 90 %.",
    )
    stepped_columns = tuple(
        f"{which} cylinder, {what}"
        for which in ("small", "large")
        for what in ("error before / mm", "error after / mm")
    )
    parts = tuple(
        _table(f"Table {i}", name, ("diameter / mm", "error / mm"), 6, rng)
        for i, name in ((3, "Ceramic ball"), (4, "Cylinder"), (5, "Groove"))
    )
    mounts = tuple(
        MountResult(
            f"W{i + 1}",
            dataclasses.replace(artifact, history_mm=np.geomspace(0.2 + 0.1 * i, 0.0112 + 0.0002 * i, 20 + 3 * i)),
            0.21 + 0.03 * i,
            0.006 + 0.001 * i,
        )
        for i in range(5)
    )
    cases = tuple(
        AxisCase(
            f"T{i + 1}", (-0.3, -0.2, -0.1), (0.3, 0.2, 0.1), 0.2, 3e-7, 28, True, 4e-7,
            np.geomspace(0.2 + 0.05 * i, 3e-7, 29), 2e-14, 9, 3e-14, np.geomspace(0.2 + 0.05 * i, 2e-14, 10),
        )
        for i in range(5)
    )  # fmt: skip
    simulated = ComparisonTable(
        "Section 5.4, table 1 and figure 12",
        "Disturbed axes, exact feature points",
        ("mean distance before / mm", "mean distance after / mm"),
        tuple(
            TableRow(
                c.name,
                (
                    Comparison("before", "mm", None, 0.2, 0.2, digits=3),
                    _comparison("after", 2.278e-7, 3e-7, 2e-14, digits=None),
                ),
            )
            for c in cases
        ),
    )
    sensor = ComparisonTable(
        "Section 5.2, figure 8",
        "Camera and laser plane",
        ("",),
        (
            TableRow("interval RMSE before / mm", (_comparison("interval RMSE before", 0.021, 0.0206, 0.0206),)),
            TableRow("interval RMSE after / mm", (_comparison("interval RMSE after", 0.003, 0.0028, 0.0019),)),
        ),
    )
    return Reproduction(
        info=ReproductionInfo(
            True,
            "article",
            (1280, 960),
            {"frames": 7, "noise": 11},
            "A figure is equal to the article's if it lies within 20 % of it.",
            {"artifact.method": ("sqp", "joint"), "axis.method": ("circles", "images")},
            "2026-03-14 15:09:26 +0100",
            754.2,
            {"rotaline": "0.1.0", "python": "3.11.9"},
            "Linux x86_64, 2 cores",
            1834,
            ("W3 is only 1.2 mm off centre.",),
        ),
        claims=claims,
        sensor=SensorSection(
            sensor,
            contents.camera,
            contents.laser_plane,
            contents.cross_ratio,
            contents.laser_plane,
            contents.cross_ratio,
        ),
        initial_axis=InitialAxisSection(
            _table("Section 5.3", "Initial axis", ("off the true axis / mm", "corners off / mm"), 6, rng),
            tuple(o for o in contents.overlays if o.stage == "axis")[:3],
            axis,
            Line(AXIS.point + np.array([0.03, 0.0, -0.02]), unit(AXIS.direction + np.array([1e-3, 0.0, 4e-4]))),
        ),
        simulation=SimulationSection(simulated, cases),
        mounts=MountsSection(
            _table("Section 5.5", "Feature points", ("mean distance before / mm", "mean distance after / mm"), 6, rng),
            ARTIFACT,
            mounts,
            artifact,
            0.0021,
            tuple(o for o in contents.overlays if o.stage == "laser-plane"),
        ),
        stepped=_table("Table 2", "Diameter errors", stepped_columns, 6, rng),
        stepped_disturbed=_table("Table 2, disturbed", "From a poor initial axis", stepped_columns, 6, rng),
        parts=PartsSection(parts, contents.measurements[:5], contents.fitted_points),
        complex_parts=ComplexPartsSection(
            "A detail is resolved if its height is measured within 20 %.",
            (_complex_part(rng, "thread", "pipe connector with a thread"),),
        ),
        budget=make_budget(),
    )


@pytest.fixture(scope="session")
def full_reproduction(full_contents: ReportContents) -> Reproduction:
    """The reproduced article with every section."""
    return make_reproduction(full_contents)
