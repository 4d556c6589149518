"""Parts of triangles, against exact shapes, against a test of every triangle, and across threads."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotaline.simulation.parts.mesh import MeshPart, open_half_edges
from rotaline.simulation.parts.shapes import Ball, Shape

EYE = np.array([240.0, 90.0, 170.0])


def _part(mesh, **options):
    return MeshPart(np.asarray(mesh.vertices, float), np.asarray(mesh.faces), **options)


BALL_MESH = trimesh.creation.icosphere(subdivisions=5, radius=20.0)
BALL_MESH.apply_translation([0.0, 0.0, 20.0])
BALL = _part(BALL_MESH)
CUBE = _part(trimesh.creation.box(extents=[20.0, 20.0, 20.0]))
ROD = _part(trimesh.creation.cylinder(radius=10.0, height=30.0, sections=180))
KNOT = _part(trimesh.creation.torus(major_radius=15.0, minor_radius=6.0, major_sections=40, minor_sections=20))


def _rays(seed, n, reach=25.0):
    return np.random.default_rng(seed).uniform(-reach, reach, (n, 3)) - EYE


def _every_triangle(part, origin, directions):
    """Nearest entry, by Cramer's rule for every ray and triangle (Moeller and Trumbore)."""
    a, b, c = (part.vertices[part.triangles[:, k]] for k in range(3))
    e1, e2 = b - a, c - a
    h = np.cross(directions[:, None], e2[None])
    det = np.einsum("rti,ti->rt", h, e1)
    s = origin - a
    u = np.einsum("rti,ti->rt", h, s) / det
    q = np.cross(s, e1)
    v = directions @ q.T / det
    t = np.einsum("ti,ti->t", e2, q) / det
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
    return np.where(hit, t, np.inf).min(axis=1)


def test_it_is_a_shape():
    assert isinstance(KNOT, Shape)
    assert np.allclose(CUBE.bounds(), [[-10, -10, -10], [10, 10, 10]])
    assert CUBE.sizes() == {}


@pytest.mark.parametrize("part", [CUBE, KNOT, ROD], ids=["cube", "torus", "rod"])
@given(seed=st.integers(0, 10_000), length=st.floats(0.01, 100.0))
@settings(max_examples=10, deadline=None)
def test_the_nearest_triangle_is_hit_to_a_hundred_thousandth_of_a_millimetre(part, seed, length):
    directions = _rays(seed, 200) * length
    t, _ = part.intersect(EYE, directions)
    expected = _every_triangle(part, EYE, directions)
    same = np.isfinite(t) == np.isfinite(expected)
    assert same.mean() > 0.99  # a ray may pass the silhouette by less than single precision
    both = np.isfinite(t) & np.isfinite(expected)
    away = np.abs(t[both] - expected[both]) * np.linalg.norm(directions[both], axis=1)
    assert both.any()
    assert away.max() < 1e-5


def test_hits_lie_on_the_named_triangle():
    directions = _rays(3, 20_000)
    t, faces = KNOT.intersect(EYE, directions)
    hit = np.isfinite(t)
    points = EYE + t[hit, None] * directions[hit]
    corners = KNOT.vertices[KNOT.triangles[faces[hit]]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    height = np.einsum("ni,ni->n", points - corners[:, 0], normals) / np.linalg.norm(normals, axis=1)
    assert np.abs(height).max() < 1e-5
    assert np.median(np.abs(height)) < 1e-12


def test_no_ray_slips_through_where_triangles_meet():
    # aimed at corners and edges themselves, where single precision loses some
    ends = BALL.vertices[BALL_MESH.edges_unique]
    targets = np.concatenate([BALL.vertices, ends.mean(axis=1), 0.3 * ends[:, 0] + 0.7 * ends[:, 1]])
    outward = (targets - [0, 0, 20.0]) / 20.0
    towards = EYE - targets
    seen = np.einsum("ni,ni->n", outward, towards) > 0.05 * np.linalg.norm(towards, axis=1)
    t, _ = BALL.intersect(EYE, -towards[seen])
    assert seen.sum() > 20_000
    assert np.abs(t - 1.0).max() * np.linalg.norm(EYE) < 1e-4


def test_hits_stay_on_the_part_where_a_ray_grazes_it():
    # the eye is nearly in the plane of a face, the targets are a little beside the edge of that face; askew, for rounding
    turned = Rotation.from_rotvec([0.3, 0.5, -0.4]).as_matrix()
    askew = MeshPart(CUBE.vertices @ turned.T, CUBE.triangles)
    rng = np.random.default_rng(4)
    found = 0
    for above in (1e-7, 1e-6, 1e-5):
        eye = np.array([200.0, 10.0 + above, 3.0])
        aside = 10.0 + rng.uniform(-2e-5, 2e-5, 2000)
        targets = np.column_stack([np.full(2000, 10.0), aside, rng.uniform(-9, 9, 2000)])
        t, _ = askew.intersect(turned @ eye, (targets - eye) @ turned.T)
        hit = np.isfinite(t)
        found += hit.sum()
        points = eye + t[hit, None] * (targets - eye)[hit]
        assert np.abs(points).max() < 10.0 + 3e-5
    assert found > 2000


def test_the_triangle_is_right_to_a_ten_thousandth_of_a_millimetre_from_three_metres_away():
    eye = np.array([2400.0, 1700.0, 900.0])
    z = np.linspace(-9.0, 9.0, 500)
    for beside, normal in (([10.0, 10.0 - 5e-5], [1, 0, 0]), ([10.0 - 5e-5, 10.0], [0, 1, 0])):
        targets = np.column_stack([np.tile(beside, (500, 1)), z])
        _, faces = CUBE.intersect(eye, targets - eye)
        assert np.allclose(CUBE.normals(targets, faces), normal)


def test_a_fine_mesh_of_a_ball_looks_like_the_ball():
    directions = _rays(5, 5_000)
    exact = Ball(40.0)
    t, faces = BALL.intersect(EYE, directions)
    t_exact, faces_exact = exact.intersect(EYE, directions)
    both = np.isfinite(t) & np.isfinite(t_exact)
    assert (np.isfinite(t) != np.isfinite(t_exact)).mean() < 0.002
    points = EYE + t[both, None] * directions[both]
    points_exact = EYE + t_exact[both, None] * directions[both]
    normals, normals_exact = BALL.normals(points, faces[both]), exact.normals(points_exact, faces_exact[both])
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)
    central = np.einsum("ni,ni->n", normals_exact, directions[both]) < -0.3 * np.linalg.norm(directions[both], axis=1)
    # the facets are 2 deg apart
    assert np.linalg.norm(normals - normals_exact, axis=1)[central].max() < np.deg2rad(0.2)


def test_creases_stay_sharp_and_curved_faces_are_smooth():
    assert len(np.unique(CUBE.patches)) == 6
    assert len(np.unique(ROD.patches)) == 3  # side and two ends
    directions = _rays(7, 3_000, 12.0)
    t, faces = ROD.intersect(EYE, directions)
    hit = np.isfinite(t)
    points = EYE + t[hit, None] * directions[hit]
    normals = ROD.normals(points, faces[hit])
    top = points[:, 2] > 15.0 - 1e-6
    assert 0 < top.sum() < hit.sum()
    assert np.allclose(normals[top], [0, 0, 1])
    radial = points[~top, :2] / np.linalg.norm(points[~top, :2], axis=1)[:, None]
    assert np.abs(normals[~top, 2]).max() < 1e-9
    assert np.abs(normals[~top, :2] - radial).max() < 1e-4  # facets are 2 deg wide


def test_everything_is_a_crease_if_asked_for():
    faceted = _part(BALL_MESH, crease_deg=0.0)
    assert len(np.unique(faceted.patches)) == len(faceted.triangles)


@pytest.mark.parametrize(
    ("origin", "direction"),
    [([0.0, 0, 0], [1.0, 0, 0]), ([100.0, 0, 0], [1.0, 0, 0]), ([100.0, 0, 0], [0.0, 0, 1.0])],
    ids=["from inside", "away", "past"],
)
def test_rays_that_enter_nothing(origin, direction):
    t, faces = CUBE.intersect(np.array(origin), np.array([direction]))
    assert t[0] == np.inf
    assert faces[0] == 0


def test_rays_along_a_face_and_into_corners_warn_of_nothing():
    directions = np.array([[-1.0, 0, 0], [-1.0, 0.1, 0.1], [-1.0, -0.1, 0.1]])
    t, faces = CUBE.intersect(np.array([100.0, 0.0, 10.0]), directions)
    assert np.isfinite(CUBE.normals(np.array([[10.0, 10.0, 10.0]]), faces[:1])).all()
    assert not np.isnan(t).any()


def test_no_rays():
    t, faces = CUBE.intersect(EYE, np.empty((0, 3)))
    assert len(t) == len(faces) == 0


def test_threads_see_the_same():
    directions = [_rays(seed, 5_000) for seed in range(8)]
    part = _part(BALL_MESH)
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda d: part.intersect(EYE, d), directions))
    for d, (t, faces) in zip(directions, together, strict=True):
        t_alone, faces_alone = part.intersect(EYE, d)
        assert np.array_equal(t, t_alone)
        assert np.array_equal(faces, faces_alone)


def test_a_triangle_without_area_does_no_harm():
    # the cube's edge from vertex 0 to 1 of a tetrahedron, split on one side only by a triangle of three collinear corners
    vertices = np.array([[0.0, 0, 0], [10, 0, 0], [0, 10, 0], [0, 0, 10], [5, 0, 0]])
    triangles = np.array([[0, 2, 1], [0, 1, 4], [0, 4, 3], [4, 1, 3], [0, 3, 2], [1, 2, 3]])
    part = MeshPart(vertices, triangles)
    targets = np.array([[5.0, 0, 0], [3, 1e-3, 1], [2, 2, 2]])
    t, faces = part.intersect(np.array([60.0, -80.0, 70.0]), targets - [60.0, -80.0, 70.0])
    assert np.isfinite(t[1:]).all()
    assert np.isfinite(part.normals(targets, faces)).all()


def test_open_and_twisted_surfaces_are_refused():
    with pytest.raises(ValueError, match="closed"):
        MeshPart(CUBE.vertices, CUBE.triangles[1:])
    twisted = CUBE.triangles.copy()
    twisted[0] = twisted[0][::-1]
    with pytest.raises(ValueError, match="one sense"):
        MeshPart(CUBE.vertices, twisted)
    with pytest.raises(ValueError, match="closed"):
        MeshPart(CUBE.vertices, np.empty((0, 3), int))


def test_open_edges_are_named():
    assert len(open_half_edges(CUBE.triangles)) == 0
    assert len(open_half_edges(CUBE.triangles[2:])) == 4 or len(open_half_edges(CUBE.triangles[2:])) == 6
