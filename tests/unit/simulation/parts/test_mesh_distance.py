"""Distances from a mesh against closed forms, and against every triangle."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.simulation.parts.mesh import MeshPart
from rotaline.simulation.parts.mesh_distance import signed_distances_to_mesh


def _part(mesh):
    return MeshPart(np.asarray(mesh.vertices, float), np.asarray(mesh.faces))


BOX = _part(trimesh.creation.box(extents=[20.0, 30.0, 40.0]))
BALL = _part(trimesh.creation.icosphere(subdivisions=4, radius=10.0))
RING = _part(trimesh.creation.torus(major_radius=15.0, minor_radius=6.0, major_sections=30, minor_sections=16))


def _box_distance(points):
    q = np.abs(points) - [10.0, 15.0, 20.0]
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)


def _nearest_of_all(part, points):
    """The least distance to every triangle: its plane where the foot is inside, else its three sides."""
    best = np.full(len(points), np.inf)
    for corners in part.vertices[part.triangles]:
        n = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        n /= np.linalg.norm(n)
        height = (points - corners[0]) @ n
        foot = points - height[:, None] * n
        inside = np.ones(len(points), bool)
        for p, q in zip(corners, np.roll(corners, -1, axis=0), strict=True):
            inside &= np.cross(q - p, foot - p) @ n >= 0
            s = np.clip((points - p) @ (q - p) / ((q - p) @ (q - p)), 0, 1)
            best = np.minimum(best, np.linalg.norm(points - p - s[:, None] * (q - p), axis=1))
        best = np.where(inside, np.minimum(best, np.abs(height)), best)
    return best


@given(seed=st.integers(0, 10_000), reach=st.sampled_from([20.0, 30.0, 120.0]))
@settings(max_examples=5, deadline=None)
def test_a_box_has_exact_distances_inside_and_outside(seed, reach):
    points = np.random.default_rng(seed).uniform(-reach, reach, (60, 3))
    assert signed_distances_to_mesh(BOX, points) == pytest.approx(_box_distance(points), abs=1e-9)


def test_points_on_faces_edges_and_corners_are_at_zero():
    points = np.array([[10.0, 15, 20], [10, 15, 3], [10, -2, 7], [-10, -15, -20], [0, 0, 20]])
    assert np.abs(signed_distances_to_mesh(BOX, points)).max() < 1e-12


@given(seed=st.integers(0, 10_000))
@settings(max_examples=3, deadline=None)
def test_the_nearest_of_all_triangles_counts(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-22.0, 22.0, (50, 3)) * [1, 1, 0.4]
    found = signed_distances_to_mesh(RING, points)
    assert np.abs(found) == pytest.approx(_nearest_of_all(RING, points), abs=1e-9)
    from_circle = np.hypot(np.hypot(points[:, 0], points[:, 1]) - 15.0, points[:, 2])
    clear = np.abs(from_circle - 6.0) > 0.3
    assert np.array_equal(found[clear] > 0, from_circle[clear] > 6.0)


def test_the_search_goes_on_until_no_other_triangle_can_be_nearer(monkeypatch):
    monkeypatch.setattr("rotaline.simulation.parts.mesh_distance._FIRST_NEIGHBOURS", 1)
    # inside, near the edges, where two faces are almost equally near
    points = np.array([10.0, 15.0, 20.0]) - np.random.default_rng(6).uniform(0.0, 0.3, (1000, 3))
    assert signed_distances_to_mesh(BOX, points) == pytest.approx(_box_distance(points), abs=1e-10)


def test_beyond_a_sharp_edge_is_outside():
    # one of the two faces at the edge looks away from such a point, and is as near
    outline = np.array([[0.0, 0.0], [-10.0, 1.0], [-10.0, -1.0]])
    wedge = trimesh.creation.extrude_triangulation(outline, np.array([[0, 1, 2]]), 20.0)
    along = np.linspace(1.0, 19.0, 400)
    for side in (-1.0, 1.0):
        points = np.column_stack([np.full(400, 0.05), np.full(400, side * 0.03), along])
        assert signed_distances_to_mesh(_part(wedge), points) == pytest.approx(np.hypot(0.05, 0.03), abs=1e-12)


def test_near_a_surface_the_distance_is_the_height_above_it():
    rng = np.random.default_rng(1)
    directions = rng.standard_normal((20_000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    heights = rng.normal(0.0, 0.05, len(directions))
    found = signed_distances_to_mesh(BALL, directions * (10.0 + heights)[:, None])
    # the facets lie up to 0.01 mm below the sphere
    assert ((found - heights) > -1e-6).all()
    assert np.abs(found - heights).max() < 0.02


def test_missing_points_stay_missing_and_in_order():
    points = np.array([[0.0, 0, 30], [np.nan, 0, 0], [0, 0, 0]])
    assert signed_distances_to_mesh(BOX, points) == pytest.approx([10.0, np.nan, -10.0], nan_ok=True)
    assert signed_distances_to_mesh(BOX, np.empty((0, 3))).shape == (0,)
