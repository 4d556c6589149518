import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotaline.errors import GeometryError
from rotaline.geometry.primitives import Line, SteppedCylinder, unit
from rotaline.geometry.transforms import base_from_axis, rotate_about_line, table_from_base

coordinate = st.floats(-100, 100)
vector = st.tuples(coordinate, coordinate, coordinate).map(np.array)
direction = vector.filter(lambda v: np.linalg.norm(v) > 1).map(unit)


@settings(deadline=None, max_examples=40)
@given(point=vector, along=direction, angle=st.floats(-10, 10), x=vector)
def test_equation_11_is_a_rotation_about_the_line(point, along, angle, x):
    line = Line(point, along)
    turned = rotate_about_line(x[None], line, angle)
    expected = Rotation.from_rotvec(angle * along).apply(x - point) + point
    assert turned[0] == pytest.approx(expected, abs=1e-9)
    assert rotate_about_line(turned, line, -angle)[0] == pytest.approx(x, abs=1e-9)


@settings(deadline=None, max_examples=40)
@given(point=vector, along=direction)
def test_the_base_frame_has_its_z_on_the_axis_and_the_camera_on_the_positive_x_side(point, along):
    if np.linalg.norm(np.cross(point, along)) < 1e-3:
        return
    axis = Line(point, along)
    base_from_camera = base_from_axis(axis)
    on_axis = base_from_camera.apply(point + np.outer([0.0, 7.0], along))
    assert on_axis == pytest.approx(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 7.0]]), abs=1e-9)
    camera = base_from_camera.apply(np.zeros(3))
    assert camera[0] > 0
    assert camera[1] == pytest.approx(0, abs=1e-9)


def test_an_axis_through_the_camera_has_no_base_frame():
    with pytest.raises(GeometryError):
        base_from_axis(Line(np.array([0.0, 0.0, 100.0]), np.array([0.0, 0.0, 1.0])))


def test_a_point_that_turns_with_the_table_keeps_its_table_coordinates():
    point_base = np.array([10.0, 0.0, 5.0])
    turned_base = Rotation.from_rotvec([0, 0, 0.3]).apply(point_base)
    assert table_from_base(0.3).apply(turned_base) == pytest.approx(point_base, abs=1e-12)


def test_the_feature_circles_of_the_article():
    circles = SteppedCylinder(23.051, 36.006, 22.003, 25.005).edge_circles_part()
    assert [c.centre[2] for c in circles] == pytest.approx([47.008, 25.005, 25.005, 0.0])
    assert [c.radius for c in circles] == pytest.approx([11.5255, 11.5255, 18.003, 18.003])


def test_the_zero_vector_has_no_direction():
    with pytest.raises(GeometryError):
        unit(np.zeros(3))
