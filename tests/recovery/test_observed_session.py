"""A session of ideal observations through every stage of the calibration: the truth comes back, as well as is stated."""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.calibration.artifact import ArtifactCapture, optimise_axis
from rotaline.calibration.feature_points import extract_mount_features
from rotaline.calibration.intrinsics import calibrate_camera
from rotaline.calibration.laser_plane import StripeView, calibrate_laser_plane
from rotaline.calibration.model import TargetView
from rotaline.calibration.rotation_axis import calibrate_axis
from rotaline.geometry.primitives import Line, unit
from rotaline.simulation.ideal.observed_scan import trace_scan
from rotaline.simulation.ideal.observed_session import trace_session
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.parts.shapes import SteppedRod
from rotaline.simulation.plan import full_turn, mount, table_disc
from rotaline.simulation.rig import Mechanics, build_rig
from rotaline.simulation.small_session import STEPPED_CYLINDER, small_plan

RIG = build_rig((640, 480), turn_sense=-1)


def _views(frames):
    return [
        TargetView(str(i), frame.detection, None if frame.angle_deg is None else float(np.radians(frame.angle_deg)))
        for i, frame in enumerate(frames)
        if frame.detection is not None
    ]


def _stripe_views(frames):
    plates = {frame.pose: frame.detection for frame in frames if not frame.laser_on}
    return [StripeView(frame.pose, plates[frame.pose], frame.stripe) for frame in frames if frame.laser_on]


def _angle_rad(a, b):
    return float(np.linalg.norm(np.cross(a, b)))


@pytest.fixture(scope="module")
def session():
    return trace_session(RIG, small_plan(RIG, captures=("camera", "laser", "axis")))


def test_without_noise_every_stage_finds_the_truth(session):
    observed = session.observed(0.0, 0.0, 1)
    camera = calibrate_camera(_views(observed["camera"]), RIG.camera.image_size).camera
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(camera, name) == pytest.approx(getattr(RIG.camera, name), abs=1e-4)
    plane = calibrate_laser_plane(camera, _stripe_views(observed["laser"])).plane_camera
    assert _angle_rad(plane.normal, RIG.laser_plane_camera.normal) < 1e-7
    assert plane.offset == pytest.approx(RIG.laser_plane_camera.offset, abs=1e-4)
    axis = calibrate_axis(camera, _views(observed["axis"]))
    assert axis.turn_sense == -1
    assert _angle_rad(axis.axis_camera.direction, RIG.rotation_axis_camera.direction) < 1e-6
    assert RIG.rotation_axis_camera.distance_to(axis.axis_camera.point[None])[0] < 1e-4


def test_with_noise_camera_and_axis_are_as_good_as_stated(session):
    observed = session.observed(0.02, 0.05, 5)
    camera = calibrate_camera(_views(observed["camera"]), RIG.camera.image_size)
    assert camera.rms_px == pytest.approx(0.02 * np.sqrt(2), rel=0.05)
    for name, u in zip(camera.parameter_names, camera.u_parameters, strict=True):
        if name in ("fx", "fy", "cx", "cy"):
            assert abs(getattr(camera.camera, name) - getattr(RIG.camera, name)) < 4 * u
    plane = calibrate_laser_plane(RIG.camera, _stripe_views(observed["laser"]))
    assert _angle_rad(plane.plane_camera.normal, RIG.laser_plane_camera.normal) < 4 * np.hypot(*plane.u_normal_rad)
    axis = calibrate_axis(RIG.camera, _views(observed["axis"]))
    assert _angle_rad(axis.axis_camera.direction, RIG.rotation_axis_camera.direction) < 4 * axis.u_direction_rad


def _axis_from_artifact(rig):
    """The axis from two mounts without noise of the stripes; how far it is off, mm and rad."""
    captures, angles_deg = [], full_turn(18)
    for name, pose in (("1", mount(-4.1, 2.9)), ("2", mount(2.0, 4.0, tilt_deg=0.02))):
        scan = trace_scan(rig, [Placed(SteppedRod(STEPPED_CYLINDER), pose), table_disc(rig)], angles_deg)
        stripes = scan.observed(0.0, 3)
        found = extract_mount_features(
            stripes, rig.camera, rig.laser_plane_camera, STEPPED_CYLINDER, rig.rotation_axis_camera
        )
        features, reasons = np.array([f.points_camera for f in found]), tuple(f.reason for f in found)
        assert np.isfinite(features).all()
        captures.append(ArtifactCapture(name, tuple(map(str, angles_deg)), scan.angles_rad, features, reasons))
    true = rig.rotation_axis_camera
    start = Line(true.point + np.array([0.1, -0.2, 0.1]), unit(true.direction + np.array([0.002, 0.001, -0.002])))
    result = optimise_axis(start, rig.turn_sense, captures, STEPPED_CYLINDER)
    moved_mm = float(result.axis_camera.distance_to(true.point[None])[0])
    return result, moved_mm, _angle_rad(result.axis_camera.direction, true.direction)


def test_the_stepped_cylinder_gives_the_axis_and_run_out_spoils_it():
    """A budget in small: what 30 um of run-out do to the axis and to the mean distance of the feature points."""
    clean, moved_mm, turned_rad = _axis_from_artifact(RIG)
    assert clean.mean_distance_mm < 0.005
    assert clean.mean_distance_before_mm > 5 * clean.mean_distance_mm
    assert moved_mm < 5e-4
    assert turned_rad < 1e-5
    shaky, moved_mm, _ = _axis_from_artifact(replace(RIG, mechanics=Mechanics(run_out_um=30.0)))
    assert shaky.mean_distance_mm > clean.mean_distance_mm + 0.001
    assert 0.005 < moved_mm < 0.1
