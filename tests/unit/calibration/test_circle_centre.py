"""Circle centres from chords, eq. (8)-(10)."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.calibration.circle_centre import fit_circles_by_chords


def _circle(angles_deg: list[float], radius: float = 30.0) -> np.ndarray:
    t = np.radians(angles_deg)
    return np.stack([radius * np.cos(t), radius * np.sin(t), np.zeros_like(t)], axis=1)


@given(
    rotation=st.tuples(*[st.floats(-3, 3)] * 3),
    shift=st.tuples(*[st.floats(-500, 500)] * 3),
    angles=st.lists(st.floats(0, 300), min_size=3, max_size=12, unique_by=lambda a: round(a / 2)),
)
@settings(deadline=None, max_examples=40)
def test_centre_moves_with_the_points(rotation: tuple, shift: tuple, angles: list[float]) -> None:
    if np.ptp(angles) < 8:
        angles = [*angles, min(angles) + 40]
    motion = RigidTransform.from_components(np.array(shift), Rotation.from_rotvec(rotation))
    fits = fit_circles_by_chords(motion.apply(_circle(sorted(angles)))[:, None])
    np.testing.assert_allclose(fits.centres[0], shift, atol=1e-6)
    np.testing.assert_allclose(fits.radii_mm, 30.0, atol=1e-6)
    np.testing.assert_allclose(fits.rms_mm, 0.0, atol=1e-6)
    assert abs(fits.normals[0] @ motion.rotation.apply([0, 0, 1])) > 1 - 1e-9


def test_plane_through_the_origin() -> None:
    """The article writes the plane as G . O = 1, which no plane through the origin satisfies."""
    points = _circle([0, 20, 45, 80]) + np.array([5.0, 7.0, 0.0])
    np.testing.assert_allclose(fit_circles_by_chords(points[:, None]).centres[0], [5.0, 7.0, 0.0], atol=1e-9)


def test_chords_span_missing_positions() -> None:
    points = np.stack([_circle([0, 10, 20, 30, 40]), _circle([5, 15, 25, 35, 45], 12.0)], axis=1)
    points[2, 0] = np.nan
    points[0, 1] = np.nan
    fits = fit_circles_by_chords(points)
    np.testing.assert_allclose(fits.centres, 0.0, atol=1e-9)
    np.testing.assert_allclose(fits.radii_mm, [30.0, 12.0])


def test_points_without_a_circle_are_nan() -> None:
    points = np.stack([_circle([0, 10, 20]), _circle([0, 10, 20]), np.tile([1.0, 2.0, 3.0], (3, 1))], axis=1)
    points[1, 1] = np.nan
    fits = fit_circles_by_chords(points)
    assert np.isfinite(fits.centres).all(axis=1).tolist() == [True, False, False]
    assert np.isnan(fits.rms_mm[1:]).all()
    assert np.isnan(fit_circles_by_chords(points[:2]).centres).all()


def test_centre_stays_in_the_plane_of_noisy_points() -> None:
    rng = np.random.default_rng(3)
    points = _circle([0, 4, 9, 13, 20, 24, 31, 36]) + rng.normal(0, 0.05, (8, 3))
    fits = fit_circles_by_chords(points[:, None])
    assert abs((fits.centres[0] - points.mean(axis=0)) @ fits.normals[0]) < 1e-9
