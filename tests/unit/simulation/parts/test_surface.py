"""Boxes that rays meet, and bevelled outlines."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.simulation.parts.polyhedra import PolyhedraSurface, box_solid
from rotaline.simulation.parts.surface import bevelled, box_interval, meets_box

BOX = np.array([[-3.0, -2.0, 0.0], [3.0, 2.0, 5.0]])
SQUARE = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 4.0], [0.0, 4.0]])


@given(seed=st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_the_box_is_met_where_a_solid_of_its_size_is_entered(seed):
    rng = np.random.default_rng(seed)
    origin = 20.0 * rng.normal(size=3) + [0.0, 0.0, 40.0]
    directions = rng.uniform(-6, 6, (100, 3)) - origin
    t_in, _ = box_interval(BOX, origin, directions)
    t, _ = PolyhedraSurface((box_solid(*BOX.tolist()),), BOX).intersect(origin, directions)
    met = meets_box(BOX, origin, directions)
    np.testing.assert_array_equal(met, np.isfinite(t))
    np.testing.assert_allclose(t[met], t_in[met], rtol=1e-12)


def test_rays_in_the_plane_of_a_face_and_rays_that_look_away():
    along = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    np.testing.assert_array_equal(meets_box(BOX, np.array([3.0, 2.0, 20.0]), along), [True, False, False])


def test_a_bevelled_right_angle_is_a_chamfer_of_45_deg():
    cut = bevelled(SQUARE, (2,), 1.0)
    np.testing.assert_allclose(cut, [[0, 0], [4, 0], [4, 3], [3, 4], [0, 4]])


def test_a_bevel_takes_as_much_of_both_sides_and_the_first_corner_can_be_cut():
    slanted = np.array([[0.0, 0.0], [4.0, 0.0], [7.0, 4.0], [0.0, 4.0]])
    cut = bevelled(slanted, (0, 1), 0.5)
    np.testing.assert_allclose(cut, [[0, 0.5], [0.5, 0], [3.5, 0], [4.3, 0.4], [7, 4], [0, 4]])


def test_no_leg_leaves_the_outline_and_too_long_ones_are_refused():
    np.testing.assert_array_equal(bevelled(SQUARE, (0, 1, 2), 0.0), SQUARE)
    assert len(bevelled(SQUARE, (1, 2), 1.99)) == 6
    with pytest.raises(ValueError, match="uses up a side that is 4 mm long"):
        bevelled(SQUARE, (1, 2), 2.0)
    with pytest.raises(ValueError, match="0 mm or more"):
        bevelled(SQUARE, (1,), float("nan"))
