"""Distances, angles and pixel sizes of a rig whose numbers are known."""

import numpy as np
import pytest

from rotaline.calibration.model import SystemCalibration
from rotaline.geometry.primitives import Line, Plane, unit
from rotaline.io.report.rig_geometry import describe_rig
from rotaline.vision.camera import CameraModel

CAMERA = CameraModel((1000, 800), 2000.0, 2000.0, 500.0, 400.0)


def rig(angle_deg: float, depth: float = 400.0) -> SystemCalibration:
    """Upright axis in front of the camera; the laser plane holds the axis and makes an angle with the optical axis."""
    a = np.deg2rad(angle_deg)
    normal = np.array([np.cos(a), 0.0, -np.sin(a)])
    point = np.array([0.0, 30.0, depth])
    return SystemCalibration(
        CAMERA, Plane(normal, float(-normal @ point)), Line(point, np.array([0.0, -1.0, 0.0])), 1, True
    )


@pytest.mark.parametrize("angle_deg", [10.0, 30.0, 45.0, 80.0])
def test_distances_and_angles(angle_deg):
    geometry = describe_rig(rig(angle_deg))
    assert geometry.camera_to_axis_mm == pytest.approx(400.0)
    assert geometry.axis_to_plane_mm == pytest.approx(0.0, abs=1e-9)
    assert geometry.plane_to_optical_axis_deg == pytest.approx(angle_deg)
    assert geometry.plane_to_rotation_axis_deg == pytest.approx(0.0, abs=1e-6)
    assert geometry.mm_per_px_across == pytest.approx(0.2)


@pytest.mark.parametrize("angle_deg", [10.0, 30.0, 45.0, 80.0])
def test_one_pixel_of_shift_is_longer_the_smaller_the_triangulation_angle(angle_deg):
    assert describe_rig(rig(angle_deg)).mm_per_px_triangulation == pytest.approx(0.2 / np.sin(np.deg2rad(angle_deg)))


def test_one_pixel_of_shift_agrees_with_moving_a_pixel():
    system = rig(25.0)
    system = SystemCalibration(
        CAMERA,
        Plane(unit(system.laser_plane_camera.normal + np.array([0, 0.2, 0])), -150.0),
        system.rotation_axis_camera,
        1,
        True,
    )
    geometry = describe_rig(system)
    uv = CAMERA.project(geometry.meeting_camera[None])

    def point(pixel: np.ndarray) -> np.ndarray:
        ray = CAMERA.rays(pixel[None])[0]
        return -system.laser_plane_camera.offset / (system.laser_plane_camera.normal @ ray) * ray

    turns = np.linspace(0, np.pi, 400)
    moved = [
        np.linalg.norm(point(uv[0] + 1e-3 * np.array([np.cos(t), np.sin(t)])) - point(uv[0])) / 1e-3 for t in turns
    ]
    assert geometry.mm_per_px_triangulation == pytest.approx(max(moved), rel=1e-3)


def test_a_plane_through_the_projection_centre_has_no_resolution():
    system = SystemCalibration(CAMERA, Plane(np.array([1.0, 0, 0]), 0.0), rig(30.0).rotation_axis_camera, 1, True)
    assert np.isnan(describe_rig(system).mm_per_px_triangulation)
