"""Surfaces of scanned solids: on the truth, open where nothing was seen, facing outwards."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rotaline.errors import GeometryError
from rotaline.scanning.cloud import PointCloud
from rotaline.scanning.surface import Surface, SurfaceOptions, oriented_normals, reconstruct_surface
from rotaline.simulation.ideal.clouds import Ball, ScanPlan, Solid, scan_solids, table_top, upright_cylinder

PLAN = ScanPlan(step_deg=4.0, n_rays=400, blur_rays=1)
FAST = SurfaceOptions(depth=7)


def scan(solids: tuple[Solid, ...], plan: ScanPlan = PLAN) -> PointCloud:
    scanned = scan_solids(solids, plan, np.random.default_rng(1))
    n = len(scanned.points_table)
    eye = scanned.viewpoints_table
    angle = np.round(np.arctan2(eye[:, 1], eye[:, 0]), 9)
    frame = np.unique(angle, return_inverse=True)[1].astype(np.int64)
    return PointCloud(scanned.points_table, eye, np.ones(n), angle, frame, np.full(n, 0.005), np.full(n, np.nan))


@pytest.fixture(scope="module")
def rod() -> Surface:
    return reconstruct_surface(scan((upright_cylinder(19.0, 0.0, 40.0),)), FAST)


def test_the_side_of_a_rod_lies_on_it_and_its_bottom_stays_open(rod: Surface) -> None:
    v = rod.vertices_table
    rho = np.hypot(v[:, 0], v[:, 1])
    side = (v[:, 2] > 3) & (v[:, 2] < 37) & (rho > 15)
    # Stripes are 1.3 mm apart here; between them a circle of 19 mm leaves its chord by 0.011 mm.
    assert np.sqrt(np.mean((rho[side] - 19.0) ** 2)) < 0.03
    assert np.abs(rho[side] - 19.0).max() < 1.3 / 4
    assert not np.any((v[:, 2] < 3) & (rho < 15))
    top = (v[:, 2] > 38) & (rho < 15)
    assert np.sqrt(np.mean((v[top, 2] - 40.0) ** 2)) < 0.03


def test_normals_and_triangles_face_outwards(rod: Surface) -> None:
    v = rod.vertices_table
    rho = np.hypot(v[:, 0], v[:, 1])
    side = (v[:, 2] > 3) & (v[:, 2] < 37) & (rho > 15)
    outward = v[side, :2] / rho[side, None]
    assert np.einsum("ij,ij->i", rod.normals[side, :2], outward).min() > 0.9
    assert np.linalg.norm(rod.normals, axis=1) == pytest.approx(1)
    corners = v[rod.triangles]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    on_side = side[rod.triangles].all(axis=1)
    assert np.einsum("ij,ij->i", facing[on_side, :2], corners[on_side].mean(axis=1)[:, :2]).min() > 0
    assert np.array_equal(np.unique(rod.triangles), np.arange(len(v)))


def test_a_ball_on_the_table_is_whole_where_it_was_seen() -> None:
    ball = Ball(np.array([3.0, -1.0, 15.0]), 15.0)
    surface = reconstruct_surface(scan((table_top(), ball)), FAST)
    outward = surface.vertices_table - ball.centre
    distance = np.linalg.norm(outward, axis=1)
    upper = outward[:, 2] > 2.0
    assert np.sqrt(np.mean((distance[upper] - 15.0) ** 2)) < 0.03
    covered = outward[upper] / distance[upper, None]
    lattice = np.random.default_rng(0).normal(size=(200, 3))
    lattice[:, 2] = np.abs(lattice[:, 2]) + 0.3
    lattice /= np.linalg.norm(lattice, axis=1, keepdims=True)
    assert cKDTree(covered).query(lattice)[0].max() < 0.1
    # The ball hides the table beneath it.
    assert not np.any((surface.vertices_table[:, 2] < 1) & (np.hypot(outward[:, 0], outward[:, 1]) < 2))


def test_normals_point_to_the_camera_and_strays_are_marked() -> None:
    cloud = scan((table_top(),), ScanPlan(step_deg=8.0, n_rays=300, blur_rays=1, stray_fraction=0.0))
    level = np.abs(cloud.points_table[:, 2]) < 0.1
    points = np.vstack([cloud.points_table[level], [[0.0, 0.0, 90.0]]])
    eyes = np.vstack([cloud.viewpoints_table[level], [[0.0, 0.0, 500.0]]])
    normals, lonely = oriented_normals(points, eyes, 20)
    inner = np.hypot(points[:, 0], points[:, 1]) < 50
    inner[-1] = False
    # At 50 mm the stripes are 7 mm apart and a neighbourhood of 20 points is a line.
    assert np.quantile(normals[inner, 2], 0.02) > 0.99
    assert lonely[-1]
    assert lonely[:-1].mean() < 0.1


def test_too_few_points_are_named() -> None:
    cloud = scan((table_top(),))
    few = cloud.select(np.arange(len(cloud)) < 40)
    with pytest.raises(GeometryError, match="at least 100 points; the cloud has 40"):
        reconstruct_surface(few, FAST)


def test_nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    reconstruct_surface(
        scan((upright_cylinder(19.0, 0.0, 40.0),), ScanPlan(step_deg=15.0, n_rays=200)), SurfaceOptions(depth=5)
    )
    out, err = capfd.readouterr()
    assert out == ""
    assert err == ""
