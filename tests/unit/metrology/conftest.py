"""Scanned solids that several tests measure."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.simulation.ideal.clouds import (
    Ball,
    ScannedPoints,
    ScanPlan,
    box,
    grooved_block,
    scan_solids,
    table_top,
    upright_cylinder,
)

SHIFTED = RigidTransform.from_components([3.0, 2.0, 0.0], Rotation.from_euler("z", 35, degrees=True))

SOLIDS = {
    "ball": (Ball(np.array([3.5, -0.7, 14.2375]), 14.2375),),
    "rod": (upright_cylinder(19.002, 0.0, 40.0, SHIFTED),),
    "block": (
        box((-20.0, -15.0, 0.0), (20.0, 15.0, 10.0), SHIFTED),
        box((-20.0, -15.0, 10.0), (0.0, 15.0, 17.0), SHIFTED),
    ),
    "groove": grooved_block((44.0, 40.0, 30.0), 12.0, 24.0, 15.0, SHIFTED),
    "stepped": (
        upright_cylinder(18.003, 0.0, 25.005, SHIFTED),
        upright_cylinder(11.5255, 25.005, 47.008, SHIFTED),
    ),
    "empty": (),
}


@pytest.fixture(scope="session")
def scans() -> dict[str, ScannedPoints]:
    """One scan of each part on the table, noise 5 um, 3 deg steps."""
    plan = ScanPlan(step_deg=3.0, n_rays=450, blur_rays=1)
    return {
        name: scan_solids((table_top(), *solids), plan, np.random.default_rng(7)) for name, solids in SOLIDS.items()
    }
