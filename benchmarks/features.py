"""Errors of measured features on scanned ideal solids, beside their predicted uncertainties, and the time they take.

.venv/bin/python benchmarks/features.py
"""

import time
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.metrology.features import measure_feature
from rotaline.pipeline.summary import machine, versions
from rotaline.simulation.ideal.clouds import (
    Ball,
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
        grooved_block((44.0, 40.0, 30.0), 12.003, 24.0, 15.0, TURNED),
        {"depth": 12.003, "width_top": 24.0, "width_bottom": 15.0},
    ),
    "stepped-cylinder": (
        (upright_cylinder(18.003, 0.0, 25.005, TURNED), upright_cylinder(11.5255, 25.005, 47.008, TURNED)),
        {"diameter_small": 23.051, "diameter_large": 36.006, "height_small": 22.003, "height_large": 25.005},
    ),
}
PLANS = {
    "5 um, 4 deg": ScanPlan(blur_rays=1),
    "5 um, 8 deg": ScanPlan(blur_rays=1, step_deg=8.0),
    "5 um, 0.8 deg": ScanPlan(blur_rays=1, step_deg=0.8),
    "100 um, 5 % strays": ScanPlan(blur_rays=1, noise_mm=0.1, stray_fraction=0.05),
}


@dataclass(frozen=True)
class Measured:
    """One feature of one scan: seconds, points, and the error of each value, mm."""

    scan: str
    feature: str
    n_points: int
    seconds: float
    errors_mm: dict[str, float]


def measure() -> list[Measured]:
    """Print one line a value; a row for each feature."""
    rows = []
    print(f"{'scan':20} {'feature':17} {'value':15} {'error um':>9} {'u um':>7} {'points':>8} {'s':>6}")
    for name, plan in PLANS.items():
        for feature, (solids, truth) in PARTS.items():
            cloud = scan_solids((table_top(), *solids), plan, np.random.default_rng(0))
            start = time.perf_counter()
            found = measure_feature(cloud.points_table, feature, viewpoints=cloud.viewpoints_table)
            seconds = time.perf_counter() - start
            n = len(cloud.points_table)
            errors = {key: found.value[key] - value for key, value in truth.items()}
            for key, error in errors.items():
                u = 1e3 * found.uncertainty[key]
                print(f"{name:20} {feature:17} {key:15} {1e3 * error:9.2f} {u:7.2f} {n:8d} {seconds:6.2f}")
            rows.append(Measured(name, feature, n, seconds, errors))
    return rows


def main() -> None:
    """The table and the machine."""
    measure()
    print(", ".join([machine(), *(f"{name} {version}" for name, version in versions().items())]))


if __name__ == "__main__":
    main()
