import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.model import SystemCalibration, TableMotion
from rotaline.geometry.primitives import Line, Plane, unit
from rotaline.geometry.transforms import rotate_about_line
from rotaline.scanning.table_pose import (
    base_from_table,
    directions_base_from_table,
    inverse_poses,
    poses_table_from_camera,
    table_from_base,
)
from rotaline.vision.camera import CameraModel

CAMERA = CameraModel((1280, 960), 2400.0, 2400.0, 640.0, 480.0)
AXIS = Line(np.array([2.0, 20.0, 290.0]), unit(np.array([0.02, -0.8, -0.6])))
PIVOT_MM = 12.0
RUN_OUT, WOBBLE = (0.03, -0.02), (4e-4, 7e-4)
POINTS = np.random.default_rng(1).uniform(-30, 30, (40, 3))
ANGLES = np.random.default_rng(2).uniform(-7, 7, 40)


def _system(motion=None):
    return SystemCalibration(CAMERA, Plane(np.array([1.0, 0.0, 0.0]), 0.0), AXIS, 1, True, table_motion=motion)


MOVING = _system(TableMotion(RUN_OUT, WOBBLE, AXIS.point + PIVOT_MM * AXIS.direction))


def test_the_table_is_turned_then_tilted_about_the_pivot_then_shifted():
    pivot = np.array([0.0, 0.0, PIVOT_MM])
    found = base_from_table(POINTS, ANGLES, MOVING)
    turned_back = directions_base_from_table(ANGLES, MOVING)
    for k, angle in enumerate(ANGLES):
        turn = Rotation.from_rotvec([0.0, 0.0, angle])
        tilt = Rotation.from_rotvec(turn.inv().apply([*WOBBLE, 0.0]))
        shift = turn.inv().apply([*RUN_OUT, 0.0])
        pose = RigidTransform.from_components(tilt.apply(-pivot) + pivot + shift, tilt * turn)
        assert found[k] == pytest.approx(pose.apply(POINTS[k]), abs=1e-12)
        assert turned_back[k].as_matrix() == pytest.approx(pose.rotation.as_matrix(), abs=1e-14)
        assert base_from_table(POINTS[k : k + 1], float(angle), MOVING)[0] == pytest.approx(found[k], abs=1e-12)


@pytest.mark.parametrize("system", [_system(), MOVING], ids=["steady axis", "moving axis"])
def test_back_and_forth(system):
    there = base_from_table(POINTS, ANGLES, system)
    assert np.abs(there - POINTS).max() > 1.0
    assert table_from_base(there, ANGLES, system) == pytest.approx(POINTS, abs=1e-12)


def test_without_movements_the_table_turns_about_the_axis_to_the_last_bit():
    z = Line(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    assert (base_from_table(POINTS, ANGLES, _system()) == rotate_about_line(POINTS, z, ANGLES)).all()
    assert (table_from_base(POINTS, 0.7, _system()) == rotate_about_line(POINTS, z, -0.7)).all()


@pytest.mark.parametrize("system", [_system(), MOVING], ids=["steady axis", "moving axis"])
def test_poses_move_points_of_the_camera_to_the_table_and_back(system):
    poses = poses_table_from_camera(ANGLES, system)
    expected = table_from_base(system.base_from_camera.apply(POINTS + AXIS.point), ANGLES, system)
    moved = np.einsum("nij,nj->ni", poses[:, :, :3], POINTS + AXIS.point) + poses[:, :, 3]
    assert moved == pytest.approx(expected, abs=1e-12)
    back = inverse_poses(poses)
    assert np.einsum("nij,nj->ni", back[:, :, :3], moved) + back[:, :, 3] == pytest.approx(
        POINTS + AXIS.point, abs=1e-12
    )
