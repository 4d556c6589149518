"""Surfaces from rings, against bodies of known volume."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.simulation.parts.detailed_body import DetailedBody
from rotaline.simulation.parts.loft import (
    between,
    circle,
    fine_near,
    graded,
    half_ball,
    plateau,
    ring_normals,
    round_rings,
    skin,
)
from rotaline.simulation.parts.mesh import open_half_edges, triangle_normals

PHI = np.linspace(0.0, 2 * np.pi, 200, endpoint=False)
ROD = np.concatenate([between(circle(PHI, 5.0, 0.0), circle(PHI, 5.0, 8.0), 80), circle(PHI, 5.0, 8.0)])


def _volume(vertices, triangles):
    return np.einsum("ti,ti->", vertices[triangles[:, 0]], triangle_normals(vertices, triangles)) / 6


def test_rings_closed_by_caps_enclose_the_volume():
    vertices, triangles = skin(ROD)
    assert len(open_half_edges(triangles)) == 0
    assert _volume(vertices, triangles) == pytest.approx(np.pi * 25 * 8, rel=1e-3)


def test_rings_joined_to_a_pipe_enclose_the_wall():
    corners = [(5.0, 0.0), (5.0, 8.0), (3.0, 8.0), (3.0, 0.0)]
    ends = [circle(PHI, *corner) for corner in corners]
    vertices, triangles = skin(
        np.concatenate([between(a, b, 10) for a, b in zip(ends, ends[1:] + ends[:1], strict=True)]), pipe=True
    )
    assert len(open_half_edges(triangles)) == 0
    assert _volume(vertices, triangles) == pytest.approx(np.pi * (25 - 9) * 8, rel=1e-3)


@given(start=st.floats(-50, 50), length=st.floats(1, 100), place=st.floats(0, 1), fine=st.floats(0.02, 0.2))
@settings(max_examples=30, deadline=None)
def test_graded_values_are_fine_near_a_place_and_end_where_they_should(start, length, place, fine):
    at = start + place * length
    values = graded(start, start + length, fine_near(0.5, fine, (at, 0.3)))
    steps = np.diff(values)
    assert values[0] == start
    assert values[-1] == pytest.approx(start + length)
    assert (steps > 0).all()
    assert steps.max() <= 0.51
    near = np.abs((values[1:] + values[:-1]) / 2 - at) < 0.2
    assert steps[near].max() <= 1.3 * fine


def test_normals_of_a_cone_have_its_slope():
    z = np.linspace(0.0, 8.0, 40)[:, None]
    normals = ring_normals(round_rings(PHI, 5.0 - 0.25 * z, z))
    assert normals[:, :, 2] == pytest.approx(0.25 / np.hypot(1.0, 0.25), abs=1e-6)
    assert normals[:, 0, 0] == pytest.approx(1.0 / np.hypot(1.0, 0.25), abs=1e-6)


def test_a_detail_is_where_it_was_put_and_as_high():
    body = DetailedBody.of(ROD)
    body = body.raised(half_ball(body.distances_from((5.0, 0.0, 4.0)), 0.6))
    detail = body.detail("ball", (5.0, 0.0, 4.0), 0.6, 0.7)
    assert detail.position_part == pytest.approx([5.6, 0.0, 4.0], abs=1e-9)
    assert detail.direction_part == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)
    aside = np.linalg.norm(ROD - [5.0, 0.0, 4.0], axis=2) > 0.6
    assert np.array_equal(body.points[aside], ROD[aside])


def test_a_plateau_is_flat_and_ends():
    assert plateau(np.array([0.0, -1.0, 1.0, 1.25, 1.5, 2.0]), 1.0, 0.5) == pytest.approx([1, 1, 1, 0.5, 0, 0])
