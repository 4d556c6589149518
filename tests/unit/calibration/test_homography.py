"""Homographies and the poses in them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.homography import fit_homography, map_homography, pose_from_homography
from rotaline.errors import GeometryError

GRID = np.stack(np.meshgrid(np.arange(5.0), np.arange(4.0)), axis=-1).reshape(-1, 2) * 6.0


@settings(deadline=None, max_examples=50)
@given(
    angles=st.tuples(*[st.floats(-0.9, 0.9)] * 3),
    shift=st.tuples(st.floats(-80, 80), st.floats(-80, 80), st.floats(150, 900)),
)
def test_pose_of_a_perfect_view_comes_back(
    angles: tuple[float, float, float], shift: tuple[float, float, float]
) -> None:
    """Projecting a board and taking its homography apart gives the pose, whatever it is."""
    pose = RigidTransform.from_components(np.array(shift), Rotation.from_euler("zyx", angles))
    points = pose.apply(np.column_stack([GRID, np.zeros(len(GRID))]))
    homography = fit_homography(GRID, points[:, :2] / points[:, 2:])
    difference = pose_from_homography(homography) * pose.inv()
    assert difference.rotation.magnitude() < 1e-7
    assert np.linalg.norm(difference.translation) < 1e-6 * shift[2]


def test_four_points_are_met_exactly() -> None:
    """Four points in general position fix a homography."""
    corners = GRID[[0, 4, 15, 19]]
    images = np.array([[10.0, 20.0], [600.0, 35.0], [40.0, 400.0], [500.0, 460.0]])
    np.testing.assert_allclose(map_homography(fit_homography(corners, images), corners), images, atol=1e-9)


def test_points_on_a_line_are_refused() -> None:
    """A line of points leaves a homography open."""
    with pytest.raises(GeometryError, match="on a line"):
        fit_homography(GRID[:5], GRID[:5] * 10)


def test_three_points_are_refused() -> None:
    """The message says how many points are needed."""
    with pytest.raises(GeometryError, match="at least 4 points, found 3"):
        fit_homography(GRID[:3], GRID[:3])


def test_coinciding_points_are_refused() -> None:
    """One point, four times."""
    with pytest.raises(GeometryError, match="coincide"):
        fit_homography(np.zeros((4, 2)), GRID[:4])
