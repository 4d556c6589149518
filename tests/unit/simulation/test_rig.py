"""The rig's true values, in the frames that a calibration gives them in."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.geometry.transforms import rotate_about_line
from rotaline.simulation.rig import Sensor, build_rig

RIGS = st.builds(
    build_rig,
    st.sampled_from([(320, 240), (240, 320)]),
    camera_side=st.sampled_from([-1, 1]),
    roll_deg=st.floats(-180, 180),
    turn_sense=st.sampled_from([-1, 1]),
    distance=st.floats(150, 600),
)


@given(rig=RIGS, seed=st.integers(0, 1000))
@settings(max_examples=25, deadline=None)
def test_planes_and_axis_in_the_camera_frame_are_those_of_the_base_frame(rig, seed):
    points_base = np.random.default_rng(seed).uniform(-40, 40, (10, 3))
    points_camera = rig.camera_from_base.apply(points_base)
    plane = rig.laser_plane_camera
    assert plane.offset < 0
    np.testing.assert_allclose(
        np.abs(plane.signed_distance_to(points_camera)),
        np.abs(rig.laser.plane_base.signed_distance_to(points_base)),
        atol=1e-9,
    )
    np.testing.assert_allclose(
        rig.rotation_axis_camera.distance_to(points_camera), np.hypot(points_base[:, 0], points_base[:, 1]), atol=1e-9
    )
    assert abs(rig.laser.plane_base.signed_distance_to(rig.laser.position_base[None])[0]) < 1e-9


@given(rig=RIGS, angle_deg=st.floats(-400, 400))
@settings(max_examples=25, deadline=None)
def test_the_table_turns_about_the_axis_in_the_stated_sense(rig, angle_deg):
    points_table = np.array([[20.0, 3.0, 5.0], [-7.0, 30.0, 11.0]])
    turned = rig.camera_from_base.apply(rig.base_from_table(angle_deg).apply(points_table))
    at_zero = rig.camera_from_base.apply(points_table)
    expected = rotate_about_line(at_zero, rig.rotation_axis_camera, float(rig.turn_sense * np.radians(angle_deg)))
    np.testing.assert_allclose(turned, expected, atol=1e-9)


@given(rig=RIGS)
@settings(max_examples=25, deadline=None)
def test_the_parts_stand_in_view(rig):
    turn = np.linspace(0, 2 * np.pi, 30)
    edge = np.column_stack([18 * np.cos(turn), 18 * np.sin(turn)])
    points_base = np.vstack([np.column_stack([edge, np.full(30, z)]) for z in (0.0, 47.0)])
    uv = rig.camera.project(rig.camera_from_base.apply(points_base))
    assert np.all((uv > 0) & (uv < rig.camera.image_size))


def test_a_bit_depth_that_no_file_has_is_refused():
    with pytest.raises(ValueError, match="bit_depth"):
        Sensor(bit_depth=10)
