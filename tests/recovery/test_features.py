"""Features of scanned solids: sizes, noise and strays of many kinds, and the spread of repeats as predicted."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.model import SystemCalibration
from rotaline.geometry.primitives import Cylinder, Line, Plane, Sphere
from rotaline.metrology.features import MeasureOptions, measure_feature
from rotaline.metrology.groove import groove_measurement
from rotaline.metrology.model import FeatureMeasurement
from rotaline.metrology.rounds import cylinder_measurement, sphere_measurement
from rotaline.metrology.scene import Scene, build_scene
from rotaline.metrology.surface_fit import Surface, SurfaceFit, fit_surface, signed_distance
from rotaline.scanning.cloud import PointCloud
from rotaline.scanning.triangulation import scan_points
from rotaline.simulation.ideal.clouds import (
    Ball,
    ScannedPoints,
    ScanPlan,
    Solid,
    grooved_block,
    scan_solids,
    table_top,
    upright_cylinder,
)
from rotaline.simulation.ideal.observed_scan import IdealScan, trace_scan
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.plan import full_turn, mount
from rotaline.simulation.rig import build_rig
from rotaline.simulation.small_session import BALL, GROOVE, ROD

TURNED = RigidTransform.from_components([2.0, -3.0, 0.0], Rotation.from_euler("z", 20, degrees=True))

PARTS: dict[str, tuple[tuple[Solid, ...], dict[str, float]]] = {
    "sphere": ((Ball(np.array([3.5, -0.7, 14.2375]), 14.2375),), {"diameter": 28.475}),
    "cylinder": ((upright_cylinder(19.002, 0.0, 40.0, TURNED),), {"diameter": 38.004}),
    "groove": (
        grooved_block((44.0, 40.0, 30.0), 12.0, 24.0, 15.0, TURNED),
        {"depth": 12.0, "width_top": 24.0, "width_bottom": 15.0},
    ),
    "step": ((upright_cylinder(15.0, 0.0, 12.0, TURNED),), {"height": 12.0}),
    "stepped-cylinder": (
        (upright_cylinder(18.003, 0.0, 25.005, TURNED), upright_cylinder(11.5255, 25.005, 47.008, TURNED)),
        {"diameter_small": 23.051, "diameter_large": 36.006, "height_small": 22.003, "height_large": 25.005},
    ),
}


def scan(feature: str, plan: ScanPlan, seed: int = 3) -> ScannedPoints:
    return scan_solids((table_top(), *PARTS[feature][0]), plan, np.random.default_rng(seed))


@pytest.mark.parametrize("feature", PARTS)
@pytest.mark.parametrize(
    "plan",
    [
        ScanPlan(step_deg=8.0, blur_rays=1),
        ScanPlan(step_deg=-5.0, turn_deg=-360.0, blur_rays=1),
        ScanPlan(noise_mm=0.1, stray_fraction=0.05, blur_rays=1),
        ScanPlan(camera=(-150.0, -100.0, 230.0), laser=(-130.0, 90.0, 160.0), step_deg=3.0, blur_rays=1),
    ],
    ids=["few frames", "other sense", "noise and strays", "other rig"],
)
def test_values_lie_within_their_uncertainties(feature: str, plan: ScanPlan) -> None:
    cloud = scan(feature, plan)
    measured = measure_feature(cloud.points_table, feature, viewpoints=cloud.viewpoints_table)
    for key, truth in PARTS[feature][1].items():
        # Strays and rays that graze an edge add to the noise that the uncertainty knows of.
        assert abs(measured.value[key] - truth) < 4 * measured.uncertainty[key] + 0.02 * measured.rms


@pytest.mark.parametrize("scale", [0.1, 8.0])
def test_small_and_large_parts(scale: float) -> None:
    def sized(lengths: tuple[float, float, float]) -> tuple[float, float, float]:
        return (scale * lengths[0], scale * lengths[1], scale * lengths[2])

    base = ScanPlan()
    plan = ScanPlan(
        laser=sized(base.laser), camera=sized(base.camera), aim_height=20 * scale, noise_mm=0.001 * scale, blur_rays=1
    )
    post = (
        upright_cylinder(60 * scale, -5 * scale, 0.0),
        upright_cylinder(10 * scale, 0.0, 10 * scale),
        upright_cylinder(3 * scale, 10 * scale, 20 * scale),
    )
    ball = Ball(np.array([scale, 0.0, 34 * scale]), 15 * scale)
    cloud = scan_solids((*post, ball), plan, np.random.default_rng(2))
    measured = measure_feature(cloud.points_table, "sphere")
    assert abs(measured.value["diameter"] - 30 * scale) < 4 * measured.uncertainty["diameter"]


@pytest.mark.parametrize("feature", ["cylinder", "groove"])
def test_repeats_scatter_as_predicted(feature: str) -> None:
    n_repeats = 16
    plan = ScanPlan(step_deg=6.0, n_rays=250, noise_mm=0.0, blur_rays=1, stray_fraction=0.0)
    cloud = scan(feature, plan)
    rays = cloud.points_table - cloud.viewpoints_table
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    truth = PARTS[feature][1]
    z = []
    for seed in range(n_repeats):
        noise = np.random.default_rng(seed).normal(0, 0.01, len(rays))
        measured = measure_feature(cloud.points_table + noise[:, None] * rays, feature)
        z.append([(measured.value[key] - truth[key]) / measured.uncertainty[key] for key in truth])
    spread = np.std(z, axis=0)
    # The noise is along the rays, so that steep places are more precise than one common variance says: the predicted
    # spread may be up to 30 % too large, and it is never too small.
    assert np.all(spread < 1 + 4 / np.sqrt(2 * n_repeats))
    assert np.all(spread > 0.7 - 4 / np.sqrt(2 * n_repeats))
    assert np.all(np.abs(np.mean(z, axis=0)) < 4 / np.sqrt(n_repeats))


RIG = build_rig((640, 480))
SYSTEM = SystemCalibration(RIG.camera, RIG.laser_plane_camera, RIG.rotation_axis_camera, RIG.turn_sense, True)
SCANNED = {
    "sphere": Placed(BALL, mount(3.1, -1.2)),
    "cylinder": Placed(ROD, mount(-2.4, 0.8, tilt_deg=0.02, tilt_towards_deg=70.0)),
    "groove": Placed(GROOVE, mount(0.9, 1.6, turn_deg=34.0)),
}


@dataclass(frozen=True, eq=False)
class Realisations:
    """A scan whose noise is drawn again and again: a point moves in proportion to its stripe's shift in the image."""

    scan: IdealScan
    cloud: PointCloud
    mm_per_px: np.ndarray

    @staticmethod
    @cache
    def of(feature: str) -> "Realisations":
        scan = trace_scan(RIG, [SCANNED[feature]], full_turn(36), spacing_px=4.0)
        clean = scan.observed(0.0, 0)
        cloud = scan_points(clean, scan.angles_rad, SYSTEM)
        shifted = scan_points([replace(s, uv=s.uv + 0.05 * s.normal) for s in clean], scan.angles_rad, SYSTEM)
        return Realisations(scan, cloud, (shifted.points_table - cloud.points_table) / 0.05)

    def points(self, seed: int, noise: dict[str, float]) -> np.ndarray:
        uv = np.concatenate([stripe.uv for stripe in self.scan.observed(seed=seed, **noise)])
        shift_px = np.sum((uv - self.scan.uv) * self.scan.normal, axis=1)
        return self.cloud.points_table + shift_px[:, None] * self.mm_per_px


def _shaken(cloud: PointCloud, points: np.ndarray, angle_noise_deg: float, run_out_um: float, seed: int) -> np.ndarray:
    """The points as if the table stood elsewhere in each frame: turned about z, and moved in the base frame."""
    rng = np.random.default_rng(seed)
    n_frames = cloud.frame.max() + 1
    turn = np.radians(rng.normal(0, angle_noise_deg, n_frames))[cloud.frame]
    x, y = rng.normal(0, 1e-3 * run_out_um, (2, n_frames))[:, cloud.frame]
    cos, sin = np.cos(cloud.angle_rad), np.sin(cloud.angle_rad)
    return points + np.column_stack(
        [cos * x + sin * y - turn * points[:, 1], cos * y - sin * x + turn * points[:, 0], 0 * x]
    )


def _fitted_again(scene: Scene, first: FeatureMeasurement) -> FeatureMeasurement:
    """The same feature fitted to the same points of another realisation of the scan, without any search."""

    def fit(start: Surface, used: np.ndarray) -> SurfaceFit:
        surface, found = fit_surface(start, scene.points[used])
        residuals = signed_distance(surface, scene.points[used])
        return SurfaceFit(surface, found, used, residuals, float(np.std(residuals)), 1.0)

    if first.feature == "sphere":
        sphere = Sphere(np.array(first.geometry["centre"]), first.value["diameter"] / 2)
        return sphere_measurement(scene, fit(sphere, first.indices))
    if first.feature == "cylinder":
        axis = Line(np.array(first.geometry["axis_point"]), np.array(first.geometry["axis_direction"]))
        return cylinder_measurement(scene, fit(Cylinder(axis, first.value["diameter"] / 2), first.indices))
    up, along = np.array(first.geometry["top_normal"]), np.array(first.geometry["direction"])
    to_right = np.array(first.geometry["corner_top_right"]) - np.array(first.geometry["corner_top_left"])
    height = scene.points[first.indices] @ up
    level = np.all(first.normals == up, axis=1)
    place = (scene.points[first.indices] - np.array(first.geometry["bottom_centroid"])) @ to_right
    middle = (height[level].max() + height[level].min()) / 2
    assert abs(along @ to_right) < 1e-6
    pieces = (level & (height > middle), level & (height < middle), ~level & (place < 0), ~level & (place > 0))
    top, bottom, left, right = (
        fit(Plane(normal, 0.0), first.indices[piece]) for piece in pieces for normal in [first.normals[piece][0]]
    )
    return groove_measurement(scene, top, bottom, (left, right), to_right)


@pytest.mark.parametrize(
    ("noise", "shake", "low", "high"),
    [
        ({"sigma_px": 0.05}, (0.0, 0.0), 0.85, 1.2),
        ({"sigma_px": 0.0, "correlated_px": 0.05, "correlation_px": 10.0}, (0.0, 0.0), 0.85, 1.2),
        ({"sigma_px": 0.01}, (0.003, 1.0), 0.75, 1.3),
    ],
    ids=["independent", "alike along the stripe", "frames that are off"],
)
def test_the_scatter_uncertainty_holds_where_points_share_errors(
    noise: dict[str, float], shake: tuple[float, float], low: float, high: float
) -> None:
    n_repeats = 80
    ratios = []
    for feature in SCANNED:
        realisations, values, stated = Realisations.of(feature), [], []
        cloud = realisations.cloud
        points = realisations.points(n_repeats, {"sigma_px": 0.01})
        eyes = np.asarray(cloud.viewpoints_table)
        first = measure_feature(points, feature, viewpoints=eyes, frame=cloud.frame)
        scene = build_scene(points, eyes, cloud.frame, None, MeasureOptions())
        for seed in range(n_repeats):
            points = _shaken(cloud, realisations.points(seed, noise), *shake, seed)
            again = _fitted_again(replace(scene, points=points), first)
            assert set(again.value) == set(first.value)
            values.append(list(again.value.values()))
            stated.append([again.u_scatter[key] for key in again.value])
        ratios += list(np.std(values, axis=0, ddof=1) / np.mean(stated, axis=0))
    assert len(ratios) == 5
    # Each ratio is known to 1 / sqrt(2 n) = 8 % only, their mean to 4 %.
    assert low < np.mean(ratios) < high
    assert np.all(np.abs(np.array(ratios) - 1.0) < 4 / np.sqrt(2 * n_repeats))
