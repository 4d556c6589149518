"""Scanned solids: points on their surfaces, seen from where the camera stood."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.simulation.ideal.clouds import (
    Ball,
    ScanPlan,
    box,
    grooved_block,
    scan_solids,
    table_top,
    upright_cylinder,
)

CLEAN = ScanPlan(step_deg=30.0, n_rays=200, noise_mm=0.0, blur_rays=1, stray_fraction=0.0)


def test_every_point_lies_on_a_surface_and_faces_the_camera() -> None:
    ball = Ball(np.array([2.0, 1.0, 15.0]), 15.0)
    scan = scan_solids((table_top(), ball), CLEAN, np.random.default_rng(0))
    outward = scan.points_table - ball.centre
    on_ball = np.abs(np.linalg.norm(outward, axis=1) - 15.0) < 1e-9
    on_table = np.abs(scan.points_table[:, 2]) < 1e-9
    on_rim = np.abs(np.hypot(*scan.points_table[:, :2].T) - 60.0) < 1e-9
    assert np.all(on_ball | on_table | on_rim)
    assert on_ball.sum() > 50
    assert on_table.sum() > 50
    towards = np.einsum("ij,ij->i", scan.viewpoints_table - scan.points_table, outward)
    assert np.all(towards[on_ball] > 0)
    assert np.linalg.norm(scan.viewpoints_table, axis=1) == pytest.approx(np.linalg.norm(CLEAN.camera))


def test_what_lies_in_the_shadow_or_behind_is_not_seen() -> None:
    rod = upright_cylinder(10.0, 0.0, 30.0)
    scan = scan_solids((table_top(), rod), CLEAN, np.random.default_rng(0))
    rho = np.hypot(*scan.points_table[:, :2].T)
    assert rho[scan.points_table[:, 2] < 29.9].min() > 10.0 - 1e-9
    assert scan.points_table[:, 2].max() == pytest.approx(30.0)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rays_meet_the_faces_of_a_turned_groove(sign: float) -> None:
    pose = RigidTransform.from_components([1.0, 2.0, 0.0], Rotation.from_euler("z", 30, degrees=True))
    solids = grooved_block((44.0, 40.0, 30.0), 12.0, 24.0, 15.0, pose)
    down = np.array([0.0, 0.0, -1.0])

    def height_at(x: float, y: float) -> float:
        start = pose.apply([x, y, 100.0])[None]
        return 100.0 - float(min(solid.first_hit(start, down[None])[0] for solid in solids))

    assert height_at(sign * 18, 5) == pytest.approx(30)
    assert height_at(sign * 3, -5) == pytest.approx(18)
    assert height_at(sign * 9.75, 0) == pytest.approx(24)
    assert height_at(sign * 23, 0) == -np.inf


def test_a_box_is_hit_where_a_ray_enters_and_missed_from_behind() -> None:
    block = box((-1.0, -2.0, 0.0), (1.0, 2.0, 3.0))
    origins = np.array([[5.0, 0.0, 1.0], [5.0, 0.0, 1.0], [5.0, 3.0, 1.0]])
    rays = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    assert block.first_hit(origins, rays).tolist() == [4.0, np.inf, np.inf]
