"""Captures that show one camera, and captures that do not: what is found in sessions with realistic errors of the target."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.intrinsics import calibrate_camera
from rotaline.calibration.model import TargetView
from rotaline.simulation.ideal.observations import random_board_poses
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import Checkerboard, TargetDetection

SIZE = (1280, 960)
TARGET = Checkerboard((9, 7), 6.0)


def turntable_poses(camera: CameraModel, centre: np.ndarray, depth_mm: float) -> list[RigidTransform]:
    """A board that stands near the axis of a turntable, seen from above, over 40 deg."""
    middle = camera.rays(np.array([[640.0, 480.0]]))[0] * depth_mm
    poses = []
    for angle in np.linspace(-20, 20, 9):
        rotation = Rotation.from_euler("x", -30, degrees=True) * Rotation.from_euler("y", angle, degrees=True)
        poses.append(RigidTransform.from_components(middle - rotation.apply(centre - [5.0, 0.0, 8.0]), rotation))
    return poses


def session(seed: int, change: float) -> list[TargetView]:
    """Views by hand and on the turntable of a bent, unevenly printed board; in the latter the focal length has changed."""
    rng = np.random.default_rng(seed)
    focal = rng.uniform(1400, 2600)
    camera = CameraModel(
        SIZE, focal, focal, 639.5 + 25 * rng.standard_normal(), 479.5 + 25 * rng.standard_normal(), -0.1, 0.05
    )
    other = replace(camera, fx=focal * (1 + change), fy=focal * (1 + change))
    bend = 0.1 * rng.standard_normal(3)
    points = replace(TARGET, bend=(float(bend[0]), float(bend[1]), float(bend[2]))).points_board()
    points = points + np.column_stack([0.01 * rng.standard_normal((len(points), 2)), np.zeros(len(points))])
    depth = 0.1 * focal
    by_hand = random_board_poses(
        camera, TARGET, int(rng.integers(7, 13)), rng, spread=0.3, distance_mm=(0.85 * depth, 1.2 * depth)
    )

    def view(name: str, seen_by: CameraModel, pose: RigidTransform) -> TargetView:
        uv = seen_by.project(pose.apply(points)) + 0.1 * rng.standard_normal((len(points), 2))
        return TargetView(name, TargetDetection(TARGET, np.arange(len(points)), uv, 0.1))

    views = [view(f"laser/{k}.png", camera, pose) for k, pose in enumerate(by_hand)]
    turned = turntable_poses(camera, TARGET.points_board().mean(axis=0), depth)
    return views + [view(f"axis/{k}.png", other, pose) for k, pose in enumerate(turned)]


@pytest.mark.parametrize("seed", range(8))
def test_one_camera_is_never_taken_for_two(seed: int) -> None:
    """A bent board with points off by 0.01 mm disturbs both captures, each in its own way; that is no other camera."""
    result = calibrate_camera(session(seed, 0.0), SIZE, preferred=frozenset({"laser"}))
    assert not any("different cameras" in text for text in result.warnings)
    assert all(view.used for view in result.views)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("change", [-0.03, 0.03])
def test_a_changed_focal_length_is_found(seed: int, change: float) -> None:
    """By 3 %: the warning says so, and the camera is that of the preferred capture alone."""
    views = session(seed, change)
    result = calibrate_camera(views, SIZE, preferred=frozenset({"laser"}))
    warning = next(text for text in result.warnings if "different cameras" in text)
    assert "The views of axis were left out" in warning
    assert {view.name.partition("/")[0] for view in result.views if view.used} == {"laser"}
    assert all("another camera" in view.reason for view in result.views if view.name.startswith("axis/"))
    alone = calibrate_camera([v for v in views if v.name.startswith("laser/")], SIZE)
    assert result.camera.fx == pytest.approx(alone.camera.fx, rel=1e-4)


def test_without_a_preference_all_views_are_used() -> None:
    """The warning says that the camera is a compromise."""
    result = calibrate_camera(session(0, 0.03), SIZE)
    assert any("a compromise" in text for text in result.warnings)
    assert {view.name.partition("/")[0] for view in result.views if view.used} == {"laser", "axis"}


def test_few_views_of_a_capture_are_no_evidence() -> None:
    """Three views of another camera are judged one by one, like any bad view."""
    views = session(1, 0.03)
    kept = [v for v in views if v.name.startswith("laser/")] + [v for v in views if v.name.startswith("axis/")][:3]
    result = calibrate_camera(kept, SIZE, preferred=frozenset({"laser"}))
    assert not any("different cameras" in text for text in result.warnings)
