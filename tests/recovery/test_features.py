"""Features of scanned solids: sizes, noise and strays of many kinds, and the spread of repeats as predicted."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.metrology.features import measure_feature
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
