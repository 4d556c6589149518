"""Surfaces of scanned solids: on the truth, open where nothing was seen, facing outwards."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from rotaline.errors import GeometryError
from rotaline.scanning.cloud import PointCloud
from rotaline.scanning.surface import (
    MAX_REACH,
    MOST_CELLS,
    Surface,
    SurfaceOptions,
    octree_depth,
    oriented_normals,
    reconstruct_surface,
)
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
    normals, reach = oriented_normals(points, eyes, 20)
    lonely = reach > MAX_REACH * np.median(reach)
    inner = np.hypot(points[:, 0], points[:, 1]) < 50
    inner[-1] = False
    # At 50 mm the stripes are 7 mm apart and a neighbourhood of 20 points is a line.
    assert np.quantile(normals[inner, 2], 0.02) > 0.99
    assert lonely[-1]
    assert lonely[:-1].mean() < 0.1


def evenly_strewn(n: int, noise_mm: float) -> PointCloud:
    """A ball of radius 15 with points as likely on one place as on another, seen from outside."""
    rng = np.random.default_rng(4)
    outward = rng.normal(size=(n, 3))
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    angle = np.round(np.arctan2(outward[:, 1], outward[:, 0]), 2)
    frame = np.unique(angle, return_inverse=True)[1].astype(np.int64)
    points = outward * (15.0 + rng.normal(0.0, noise_mm, (n, 1)))
    return PointCloud(points, 300.0 * outward, np.ones(n), angle, frame, np.full(n, 0.005), np.full(n, np.nan))


def test_a_surface_follows_what_the_points_resolve_and_has_no_holes_between_them() -> None:
    noise = 0.0005
    found = [reconstruct_surface(evenly_strewn(n, noise)) for n in (3_000, 30_000)]
    errors = []
    for surface, n in zip(found, (3_000, 30_000), strict=True):
        sides = np.concatenate([np.sort(surface.triangles[:, [i, (i + 1) % 3]], axis=1) for i in range(3)])
        assert np.all(np.unique(sides, axis=0, return_counts=True)[1] == 2)  # closed
        spacing = 15.0 * np.sqrt(4 * np.pi / n)
        errors.append(np.sqrt(np.mean((np.linalg.norm(surface.vertices_table, axis=1) - 15.0) ** 2)))
        # A ball bends away from a chord over two spacings by this much.
        assert errors[-1] < np.hypot(noise, spacing**2 / (2 * 15.0))
    # The octree's cells are half as wide, so chords leave the ball by a quarter.
    assert errors[1] < 0.3 * errors[0]


def test_the_octree_follows_the_spacing_within_memory() -> None:
    assert octree_depth(50.0, 0.25, 50_000) == 8
    assert octree_depth(50.0, 0.2, 50_000) == 9
    assert octree_depth(50.0, 20.0, 100) == 5
    assert octree_depth(50.0, 0.01, 200_000) == 10
    # A large area: cells as wide as the points' spacing, or at most wider by one step.
    depth = octree_depth(100.0, 0.15, 2_000_000)
    assert depth == 9
    assert 2_000_000 * (0.15 / (110.0 / 2**depth)) ** 2 <= MOST_CELLS


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
