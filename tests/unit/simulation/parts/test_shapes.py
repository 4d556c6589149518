"""Shapes against a reference that walks along each ray in small steps and asks whether it is inside."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.geometry.primitives import SteppedCylinder
from rotaline.simulation.parts.form_error import FormError
from rotaline.simulation.parts.material import Material
from rotaline.simulation.parts.shapes import Ball, Block, Cone, GrooveBlock, Rod, Shape, SteppedRod

STEPPED = SteppedCylinder(12.0, 24.0, 9.0, 11.0)
FORM = FormError(100.0, 5, 40.0)
BOW = FormError(100.0, 2, 40.0)


def _r(p):
    return np.hypot(p[..., 0], p[..., 1])


def _wave(p):
    """Height of FORM on a round part."""
    return 0.1 * np.cos(5 * np.arctan2(p[..., 1], p[..., 0]) + np.radians(40.0))


def _in_rod(r, z, radius, z0, z1, c=0.0):
    return (r < radius) & (z > z0) & (z < z1) & (r + z < radius + z1 - c) & (r - z < radius - z0 - c)


def _in_stepped(r, z, c=0.0):
    large = (r < 12) & (z > 0) & (z < 11) & (r + z < 23 - c) & (r - z < 12 - c)
    return large | ((r < 6) & (z > 10) & (z < 20) & (r + z < 26 - c))


def _in_block(p, c):
    x, y, z = np.abs(p[..., 0]) - 15, np.abs(p[..., 1]) - 10, np.abs(p[..., 2] - 3) - 3
    return (np.maximum(np.maximum(x, y), z) < 0) & (np.maximum(np.maximum(x + y, y + z), x + z) < -c)


def _in_groove_block(p, c=0.0):
    x, y, z = np.abs(p[..., 0]), np.abs(p[..., 1]), p[..., 2]
    wall = np.array([4.0, 8.0]) / np.hypot(4.0, 8.0)  # one flank, upwards
    half_gap = np.interp(z, [7.0, 15.0 - c * wall[1], 15.0], [3.0, 7.0 - c * wall[0], 7.0 + c])
    return (
        (x < 15)
        & (y < 10)
        & (z > 0)
        & (z < 15)
        & ~((z > 7) & (x < half_gap))
        & (np.maximum(x + 15, y + 10) + z + c < 45)
        & ((y + z < 25 - c) | (z < 7))
    )


def _bent(p):
    """A point of a part that BOW bends along x, 30 mm long, in exact space."""
    z = p[..., 2] - 0.1 * np.cos(2 * np.pi * p[..., 0] / 30.0 + np.radians(40.0))
    return np.stack([p[..., 0], p[..., 1], z], axis=-1)


def _in_wavy_ball(p):
    q = p - [0.0, 0.0, 10.0]
    distance = np.linalg.norm(q, axis=-1)
    return distance < 10.0 + _wave(p) * (_r(p) / np.maximum(distance, 1e-9)) ** 5


@dataclass(frozen=True)
class Case:
    shape: Shape
    inside: object


CASES = {
    "ball": Case(Ball(20.0), lambda p: np.linalg.norm(p - [0, 0, 10.0], axis=-1) < 10.0),
    "ball, form": Case(Ball(20.0, form_error=FORM), _in_wavy_ball),
    "rod": Case(Rod(16.0, 30.0, 2.0), lambda p: _in_rod(_r(p), p[..., 2], 8.0, 2.0, 32.0)),
    "rod, chamfer, form": Case(
        Rod(16.0, 30.0, 2.0, chamfer=1.0, form_error=FORM),
        lambda p: _in_rod(_r(p) - _wave(p), p[..., 2], 8.0, 2.0, 32.0, 1.0),
    ),
    "stepped": Case(SteppedRod(STEPPED), lambda p: _in_stepped(_r(p), p[..., 2])),
    "stepped, chamfer": Case(SteppedRod(STEPPED, chamfer=0.8), lambda p: _in_stepped(_r(p), p[..., 2], 0.8)),
    "stepped, chamfer, form": Case(
        SteppedRod(STEPPED, chamfer=0.8, form_error=FORM), lambda p: _in_stepped(_r(p) - _wave(p), p[..., 2], 0.8)
    ),
    "cone": Case(Cone(20.0, 0.0, 24.0), lambda p: (p[..., 2] > 0) & (_r(p) < 10.0 * (1 - p[..., 2] / 24.0))),
    "funnel": Case(
        Cone(10.0, 20.0, 12.0), lambda p: (p[..., 2] > 0) & (p[..., 2] < 12) & (_r(p) < 5 + 5 * p[..., 2] / 12)
    ),
    "frustum, form": Case(
        Cone(20.0, 12.0, 12.0, form_error=FORM),
        lambda p: (p[..., 2] > 0) & (p[..., 2] < 12) & (_r(p) - _wave(p) < 10 - 4 * p[..., 2] / 12),
    ),
    "block": Case(Block(30.0, 20.0, 6.0), lambda p: _in_block(p, 0.0)),
    "block, chamfer": Case(Block(30.0, 20.0, 6.0, chamfer=1.0), lambda p: _in_block(p, 1.0)),
    "block, chamfer, form": Case(
        Block(30.0, 20.0, 6.0, chamfer=1.0, form_error=BOW), lambda p: _in_block(_bent(p), 1.0)
    ),
    "groove": Case(GrooveBlock(30.0, 20.0, 15.0, 8.0, 14.0, 6.0), _in_groove_block),
    "groove, chamfer": Case(
        GrooveBlock(30.0, 20.0, 15.0, 8.0, 14.0, 6.0, chamfer=1.0), lambda p: _in_groove_block(p, 1.0)
    ),
    "groove, chamfer, form": Case(
        GrooveBlock(30.0, 20.0, 15.0, 8.0, 14.0, 6.0, chamfer=1.0, form_error=BOW),
        lambda p: _in_groove_block(_bent(p), 1.0),
    ),
}
STEP_MM = 0.03


def _rays(seed, n, spread=18.0):
    """Rays of any length from a point outside towards the part, from above, from the side and from below."""
    rng = np.random.default_rng(seed)
    origin = rng.normal(size=3)
    origin = 60.0 * origin / np.linalg.norm(origin) + [0.0, 0.0, 10.0]
    directions = rng.uniform(-spread, spread, (n, 3)) - (origin - np.array([0.0, 0.0, 10.0]))
    return origin, directions * rng.uniform(0.01, 2.0, (n, 1))


def _hits(shape, origin, directions):
    t, faces = shape.intersect(origin, directions)
    hit = np.isfinite(t)
    return origin + t[hit, None] * directions[hit], faces[hit], hit


@pytest.mark.parametrize("name", CASES)
@given(seed=st.integers(0, 10_000))
@settings(max_examples=5, deadline=None)
def test_rays_enter_where_a_walk_along_them_first_gets_inside(name, seed):
    case = CASES[name]
    origin, directions = _rays(seed, 25)
    directions /= np.linalg.norm(directions, axis=1)[:, None]

    t, _ = case.shape.intersect(origin, directions)

    walk = np.arange(20.0, 100.0, STEP_MM)
    within = case.inside(origin + walk[:, None] * directions[:, None, :])
    expected = np.where(within.any(axis=1), walk[np.argmax(within, axis=1)], np.inf)
    # a ray that only scrapes an edge may be inside for less than a step
    long_enough = (within.sum(axis=1) > 3) | ~np.isfinite(t)
    np.testing.assert_allclose(t[long_enough], expected[long_enough], atol=1.1 * STEP_MM)


@pytest.mark.parametrize("name", CASES)
@given(seed=st.integers(0, 10_000))
@settings(max_examples=5, deadline=None)
def test_hits_lie_on_the_surface_in_the_box_and_normals_point_out(name, seed):
    case = CASES[name]
    origin, directions = _rays(seed, 200)
    points, faces, hit = _hits(case.shape, origin, directions)
    normals = case.shape.normals(points, faces)

    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
    facing = -np.sum(normals * directions[hit], axis=1) / np.linalg.norm(directions[hit], axis=1)
    assert np.all(facing > 0), "a ray enters through a face that looks towards it"
    assert np.all(case.inside(points - 1e-6 * normals))
    assert not np.any(case.inside(points + 1e-6 * normals)[facing > 0.05])
    low, high = case.shape.bounds()
    assert np.all((points > low - 1e-9) & (points < high + 1e-9))


@pytest.mark.parametrize("name", CASES)
@given(seed=st.integers(0, 10_000))
@settings(max_examples=5, deadline=None)
def test_normals_are_at_right_angles_to_what_neighbouring_rays_see(name, seed):
    shape = CASES[name].shape
    origin, directions = _rays(seed, 100)
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    rng = np.random.default_rng(seed)
    t, faces = shape.intersect(origin, directions)
    checked = np.isfinite(t)
    points = origin + np.where(checked, t, 0.0)[:, None] * directions
    normals = shape.normals(points[checked], faces[checked])
    for _ in range(2):
        beside = directions + 2e-6 * rng.normal(size=directions.shape)
        t_beside, faces_beside = shape.intersect(origin, beside)
        same = (
            checked & (faces_beside == faces) & np.isfinite(t_beside) & (_r(points) > 0.5)
        )  # not at the apex of a cone
        tangents = origin + t_beside[same, None] * beside[same] - points[same]
        length = np.linalg.norm(tangents, axis=1)
        sine = np.sum(tangents * normals[same[checked]], axis=1) / length
        assert np.all(np.abs(sine)[length < 5e-3] < 5e-4)


@pytest.mark.parametrize("name", CASES)
def test_no_ray_slips_through(name):
    """Rays towards points inside, and along the coordinate axes, all enter; shape, box and reference agree on where they do."""
    case = CASES[name]
    rng = np.random.default_rng(3)
    low, high = case.shape.bounds()
    targets = rng.uniform(low, high, (1000, 3))
    targets = targets[case.inside(targets)]
    assert len(targets) > 100
    for origin in ([50.0, 20.0, 70.0], [-30.0, 60.0, 3.0], [20.0, -10.0, -50.0]):
        t, _ = case.shape.intersect(np.array(origin), targets - origin)
        assert np.all((t > 0) & (t < 1))
    for axis in range(3):
        for sign in (-1.0, 1.0):
            direction = np.zeros((1, 3))
            direction[0, axis] = -sign
            for target in targets[:5]:
                t, _ = case.shape.intersect(target - 100.0 * direction[0], direction)
                assert 60.0 < t[0] < 100.0


@pytest.mark.parametrize("name", CASES)
def test_nothing_is_hit_behind_the_origin(name):
    t, _ = CASES[name].shape.intersect(np.array([0.0, 0.0, 80.0]), np.array([[0.0, 0.0, 1.0], [0.01, 0.0, 1.0]]))
    assert np.all(np.isinf(t))


@pytest.mark.parametrize("name", CASES)
def test_rays_along_the_box_give_a_distance_or_none(name):
    """Parallel to faces, tangent, through corners of the box and through the axis: never NaN, never a warning."""
    shape = CASES[name].shape
    low, high = shape.bounds()
    middle = (low + high) / 2
    grid = np.stack(np.meshgrid(*zip(low, middle, high, strict=True)), axis=-1).reshape(-1, 3)
    for origin in middle + 4.0 * (grid - middle):
        if np.all(origin == middle):
            continue
        directions = np.vstack([grid - origin, np.eye(3), -np.eye(3)])
        t, faces = shape.intersect(origin, directions)
        assert np.all(t > 0)
        hit = np.isfinite(t)
        assert hit[:27].any()
        normals = shape.normals(origin + t[hit, None] * directions[hit], faces[hit])
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)


def test_a_ray_along_a_face_hits_only_from_within_its_height():
    for z, expected in ((16.0, np.inf), (14.0, 45.0)):
        t, _ = CASES["groove"].shape.intersect(np.array([-60.0, 0.0, z]), np.array([[1.0, 0.0, 0.0]]))
        assert t[0] == pytest.approx(expected)


def test_a_ray_along_the_groove_passes_through_it():
    for x, z, expected in ((0.0, 12.0, np.inf), (-4.9, 12.0, np.inf), (0.0, 6.9, 50.0), (6.0, 12.0, 50.0)):
        t, _ = CASES["groove"].shape.intersect(np.array([x, -60.0, z]), np.array([[0.0, 1.0, 0.0]]))
        assert t[0] == pytest.approx(expected)


def test_faces_in_one_plane_have_one_number_and_the_two_at_an_edge_have_two():
    groove = CASES["groove"].shape
    side = np.array([[-1.0, 0.0, z] for z in (-0.15, 0.0, 0.1)])  # below and above the floor of the groove
    _, faces = groove.intersect(np.array([60.0, 0.0, 7.0]), side * [45.0, 1.0, 40.0])
    assert len(set(faces.tolist())) == 1
    _, top_and_side = CASES["rod"].shape.intersect(
        np.array([60.0, 0.0, 60.0]), np.array([[-55.0, 0, -28], [-52.0, 0, -50]])
    )
    assert top_and_side[0] != top_and_side[1]


def test_boxes_fit():
    np.testing.assert_allclose(Rod(16.0, 30.0, 2.0).bounds(), [[-8, -8, 2], [8, 8, 32]])
    np.testing.assert_allclose(Ball(20.0).bounds(), [[-10, -10, 0], [10, 10, 20]])
    np.testing.assert_allclose(Block(30.0, 20.0, 6.0).bounds(), [[-15, -10, 0], [15, 10, 6]])
    np.testing.assert_allclose(Ball(20.0, form_error=FORM).bounds(), [[-10.1, -10.1, -0.1], [10.1, 10.1, 20.1]])


def test_a_part_sends_back_what_its_material_does():
    for shape in (Ball(20.0, Material(0.3)), Rod(16.0, 30.0, 2.0, Material(0.3)), Cone(20.0, 0.0, 5.0, Material(0.3))):
        np.testing.assert_array_equal(shape.albedo(np.zeros((4, 3)), np.zeros(4, int)), 0.3)


def test_sizes_are_true_ones():
    assert SteppedRod(STEPPED, chamfer=0.5).sizes() == {
        "diameter_small": 12.0,
        "diameter_large": 24.0,
        "height_small": 9.0,
        "height_large": 11.0,
    }
    assert Cone(20.0, 8.0, 5.0).sizes() == {"diameter_bottom": 20.0, "diameter_top": 8.0, "height": 5.0}
    assert Block(3.0, 2.0, 1.0).sizes() == {"width": 3.0, "length": 2.0, "height": 1.0}


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: GrooveBlock(30.0, 20.0, 15.0, 16.0, 14.0, 6.0), "groove must fit"),
        (lambda: GrooveBlock(30.0, 20.0, 15.0, 8.0, 14.0, 6.0, chamfer=8.5), "uses up a side"),
        (lambda: GrooveBlock(30.0, 2.0, 15.0, 8.0, 14.0, 6.0, chamfer=1.0), "2.0 mm long"),
        (lambda: Ball(0.0), "diameter of a ball must be above 0"),
        (lambda: Rod(10.0, float("nan")), "height of a rod"),
        (lambda: Rod(10.0, 4.0, chamfer=2.0), "uses up a side"),
        (lambda: Rod(10.0, 4.0, chamfer=-1.0), "0 mm or more"),
        (lambda: SteppedRod(SteppedCylinder(24.0, 24.0, 9.0, 11.0)), "narrower"),
        (lambda: Cone(-1.0, 10.0, 5.0), "must not be negative"),
        (lambda: Cone(0.0, 0.0, 5.0), "larger_diameter"),
        (lambda: Block(10.0, 10.0, 2.0, chamfer=1.0), "does not fit"),
        (lambda: Rod(2.0, 4.0, form_error=FORM), "needs a radius of at least 2.4 mm"),
        (lambda: Ball(4.0, form_error=FORM), "too small for a form error"),
    ],
)
def test_parts_that_cannot_be_are_refused(make, match):
    with pytest.raises(ValueError, match=match):
        make()
