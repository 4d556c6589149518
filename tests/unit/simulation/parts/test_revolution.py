"""Special rays at surfaces of revolution: through corners, along the axis, tangent, parallel to a flank."""

import numpy as np
import pytest

from rotaline.simulation.parts.revolution import RevolutionSurface, SphereSurface

CONE = RevolutionSurface(np.array([[0.0, 0.0], [10.0, 0.0], [0.0, 20.0]]))
STEPPED = RevolutionSurface(np.array([[0.0, 0.0], [12.0, 0.0], [12.0, 11.0], [6.0, 11.0], [6.0, 20.0], [0.0, 20.0]]))


def _one(surface, origin, direction):
    t, faces = surface.intersect(np.array(origin, dtype=float), np.array([direction], dtype=float))
    return float(t[0]), int(faces[0])


def test_the_apex_of_a_cone_is_hit_and_has_a_normal():
    assert _one(CONE, [0, 0, 50], [0, 0, -1]) == (pytest.approx(30.0), 1)
    t, _ = _one(CONE, [40, 0, 20], [-1, 0, 0])
    assert t == pytest.approx(40.0, abs=1e-6)
    normal = CONE.normals(np.array([[0.0, 0.0, 20.0]]), np.array([1]))[0]
    assert np.linalg.norm(normal) == pytest.approx(1.0)
    assert normal[2] == pytest.approx(1 / np.sqrt(5.0))


def test_there_is_no_second_cone_above_the_apex():
    assert _one(CONE, [40, 0, 30], [-1, 0, 0])[0] == np.inf
    t, face = _one(CONE, [3, 0, 50], [0, 0, -1])  # from within the second one down to the first
    assert (t, face) == (pytest.approx(50.0 - 14.0), 1)


def test_a_ray_parallel_to_a_flank_has_one_entry():
    # along (1, 0, -2): the flank's own direction; it enters through the flank on the other side, where x = -(20 - z) / 2
    t, face = _one(CONE, [-22.0, 0.0, 60.0], [1.0, 0.0, -2.0])
    z = 60.0 - 2 * t
    assert face == 1
    assert -22.0 + t == pytest.approx(-(20.0 - z) / 2)


def test_rays_along_the_axis_enter_the_flat_below_them():
    for x, z, face in ((0.0, 20.0, 4), (5.9, 20.0, 4), (6.1, 11.0, 2), (11.9, 11.0, 2)):
        assert _one(STEPPED, [x, 0, 50], [0, 0, -1]) == (pytest.approx(50.0 - z), face)
    assert _one(STEPPED, [6.1, 0, -50], [0, 0, 1]) == (pytest.approx(50.0), 0)
    assert _one(STEPPED, [12.1, 0, 50], [0, 0, -1])[0] == np.inf


def test_level_rays_enter_the_side_at_their_height_and_corners_do_not_leak():
    for z, radius in ((0.0, 12.0), (5.0, 12.0), (11.0, 12.0), (15.0, 6.0), (20.0, 6.0)):
        assert _one(STEPPED, [50, 0, z], [-1, 0, 0])[0] == pytest.approx(50.0 - radius, abs=1e-6)
    assert _one(STEPPED, [50, 0, 20.1], [-1, 0, 0])[0] == np.inf
    phi = np.linspace(0.0, 2 * np.pi, 200)
    origin = np.array([50.0, 8.0, 40.0])
    for r, z in STEPPED.outline_rz:
        corners = np.column_stack([r * np.cos(phi), r * np.sin(phi), np.full(200, z)])
        inwards = 0.999999 * (corners - [0.0, 0.0, 8.0]) + [0.0, 0.0, 8.0]
        assert np.all(np.isfinite(STEPPED.intersect(origin, inwards - origin)[0]))


def test_tangents_touch_within_rounding():
    for offset, hits in ((12.0 - 1e-7, True), (12.0 + 1e-7, False)):
        t, _ = _one(STEPPED, [50, offset, 5], [-1, 0, 0])
        assert np.isfinite(t) == hits
    sphere = SphereSurface(10.0, 10.0)
    for offset, hits in ((10.0 - 1e-7, True), (10.0 + 1e-7, False)):
        t, _ = _one(sphere, [50, offset, 10], [-1, 0, 0])
        assert np.isfinite(t) == hits


def test_far_away_the_entry_is_as_exact_as_near():
    t, _ = _one(STEPPED, [12_000.0, 0.0, 5.0], [-1.0, 0.0, 0.0])
    assert t == pytest.approx(12_000.0 - 12.0, abs=1e-8)


@pytest.mark.parametrize("surface", [CONE, STEPPED, SphereSurface(10.0, 10.0)])
def test_the_grown_surface_holds_the_surface(surface):
    rng = np.random.default_rng(5)
    points = rng.uniform(-15, 25, (4000, 3))
    inside, grown = surface.contains(points), surface.grown(0.5)
    assert inside.sum() > 100
    beside = points[inside] + 0.49 * np.array([1.0, 0.0, 0.0])
    assert np.all(grown.contains(beside))
    assert np.all(grown.bounds()[1] >= surface.bounds()[1])


@pytest.mark.parametrize(
    "outline",
    [
        [[0.0, 0.0], [5.0, 0.0]],
        [[1.0, 0.0], [5.0, 0.0], [0.0, 4.0]],
        [[0.0, 0.0], [5.0, 0.0], [1.0, 4.0]],
        [[0.0, 0.0], [5.0, 3.0], [5.0, 1.0], [0.0, 4.0]],
        [[0.0, 0.0], [-5.0, 0.0], [0.0, 4.0]],
        [[0.0, 0.0], [5.0, 0.0], [0.0, 0.0]],
        [[0.0, 0.0], [5.0, 0.0], [5.0, 0.0], [0.0, 4.0]],
    ],
)
def test_outlines_that_close_no_solid_are_refused(outline):
    with pytest.raises(ValueError, match="outline"):
        RevolutionSurface(np.array(outline))
