"""Cross-ratios, and crossings of a stripe with rows of dots."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform

from rotaline.calibration.laser_plane import StripeView
from rotaline.calibration.row_crossings import distance_from_cross_ratio, find_intervals
from rotaline.calibration.stripe_on_board import place_stripe_on_board
from rotaline.geometry.primitives import Plane, unit
from rotaline.simulation.ideal.observations import observe_stripe, observe_target, random_board_poses
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import DotGrid

CAMERA = CameraModel((1280, 960), 2400.0, 2390.0, 645.0, 482.0, -0.11, 0.09, 0.0006, -0.0004)
UPRIGHT = Plane(unit(np.array([0.85, -0.1, 0.5])), -150.0)
LYING = Plane(unit(np.array([0.1, -0.85, 0.5])), -150.0)
TARGET = DotGrid((9, 9), 6.0, 3.0)


@given(
    d4=st.floats(-40, 40),
    scale=st.floats(0.5, 50),
    shift=st.floats(-500, 500),
    tilt=st.floats(-0.015, 0.015),
)
@settings(deadline=None, max_examples=200)
def test_cross_ratio_finds_the_fourth_point(d4: float, scale: float, shift: float, tilt: float) -> None:
    """Eq. (4), (5): D4 anywhere on the row, on either side of the dots and on them, under any perspective."""
    pitch = 6.0

    def image(x: float) -> float:
        return (scale * x + shift) / (1 + tilt * x)

    found = distance_from_cross_ratio(image(-pitch), image(0.0), image(pitch), image(d4), pitch)
    assert found == pytest.approx(d4, abs=1e-6)


@pytest.mark.parametrize("plane", [UPRIGHT, LYING])
@pytest.mark.parametrize("dots", ["row", "triple"])
@pytest.mark.parametrize("window", [None, 1.0])
def test_perfect_images_give_perfect_intervals(plane: Plane, dots: str, window: float | None) -> None:
    """The intervals are those on the plate, whether the stripe stands or lies, from three dots or the row."""
    rng = np.random.default_rng(1)
    n_found, directions = 0, set()
    for pose in random_board_poses(CAMERA, TARGET, 8, rng):
        stripe = observe_stripe(CAMERA, plane, pose, TARGET, 0.0, rng)
        if len(stripe) < 150:
            continue
        view = StripeView("laser/0001.png", observe_target(CAMERA, pose, TARGET, 0.0, rng), stripe)
        placed = place_stripe_on_board(CAMERA, view, 2.5)
        intervals = find_intervals(CAMERA, view.detection, placed, dots, window)
        slope = placed.line_board.direction
        expected = TARGET.pitch / np.abs(slope[0 if intervals.by_columns else 1])
        np.testing.assert_allclose(intervals.reference_mm, expected, rtol=1e-8)
        n_found += len(intervals.row)
        directions.add(intervals.by_columns)
    assert n_found > 15


def test_a_missing_row_costs_two_intervals() -> None:
    """A row of which two dots are seen has no crossing; its neighbours keep theirs."""
    rng = np.random.default_rng(2)
    pose = random_board_poses(CAMERA, TARGET, 1, rng, tilt_deg=(0.0, 5.0), spread=0.05)[0]
    plane = _through_middle(pose)
    detection = observe_target(CAMERA, pose, TARGET, 0.0, rng)
    stripe = observe_stripe(CAMERA, plane, pose, TARGET, 0.0, rng)
    keep = np.flatnonzero((detection.point_ids // 9 != 4) | (detection.point_ids % 9 < 2))
    partial = type(detection)(TARGET, detection.point_ids[keep], detection.uv[keep], detection.u_px)
    found = []
    for d in (detection, partial):
        placed = place_stripe_on_board(CAMERA, StripeView("a", d, stripe), 2.5)
        found.append(find_intervals(CAMERA, d, placed, "row", None))
    assert not found[0].by_columns
    assert set(found[0].row) - set(found[1].row) == {3, 4}
    assert set(found[1].row) < set(found[0].row)


def _through_middle(pose: RigidTransform) -> Plane:
    """A laser plane that crosses the rows of the board through its middle, far from the camera's centre."""
    middle = pose.apply([24.0, 24.0, 0.0])
    along, depth = pose.rotation.apply([0.15, 1.0, 0.0]), np.array([0.5, 0.0, 1.0])
    normal = unit(np.cross(along, depth))
    return Plane(normal, -float(normal @ middle))
