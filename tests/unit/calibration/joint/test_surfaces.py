"""Surfaces of artefacts: which one a point lies on, how far from it, and how that changes."""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.calibration.joint.surfaces import (
    NONE,
    assign,
    by_sizes,
    curvature_of,
    mid_height,
    size_names,
    sizes_of,
    surface_names,
    with_sizes,
)
from rotaline.geometry.primitives import KnownCylinder, KnownSphere, SteppedCylinder

STEPPED = SteppedCylinder(20.0, 36.0, 22.0, 25.0)
ARTIFACTS = [STEPPED, KnownCylinder(30.0, 40.0), KnownCylinder(30.0), KnownSphere(28.0)]
IDS = ["stepped", "rod", "endless", "ball"]


def _at(rho, z, turn=0.7):
    return [rho * np.cos(turn), rho * np.sin(turn), z]


def _assign(artifact, points, margin=0.5, band=1.0):
    points = np.array(points, dtype=float).reshape(-1, 3)
    return assign(artifact, points, np.full(len(points), margin), band)


@pytest.mark.parametrize(
    ("rho", "z", "surface", "distance"),
    [
        (4.0, 47.2, "top disc", 0.2),
        (10.3, 40.0, "small side", 0.3),
        (9.8, 30.0, "small side", -0.2),
        (14.0, 24.9, "step", -0.1),
        (18.4, 10.0, "large side", 0.4),
        (9.7, 47.1, None, None),  # 0.3 mm from the top edge
        (10.1, 46.8, None, None),
        (10.1, 25.3, None, None),  # in the inner corner
        (17.8, 25.1, None, None),
        (18.1, 0.2, None, None),  # near the bottom
        (18.1, -0.2, None, None),
        (5.0, 10.0, None, None),  # inside
        (25.0, 10.0, None, None),
    ],
)
def test_points_of_a_stepped_cylinder(rho, z, surface, distance):
    found = _assign(STEPPED, _at(rho, z))
    if surface is None:
        assert found.surface[0] == NONE
        assert np.isnan(found.distance[0])
        return
    assert surface_names(STEPPED)[found.surface[0]] == surface
    assert found.distance[0] == pytest.approx(distance)
    outward = [0, 0, 1] if surface in ("top disc", "step") else [np.cos(0.7), np.sin(0.7), 0]
    assert found.normal[0] == pytest.approx(outward)


def test_points_of_rods_and_balls():
    rod, endless, ball = ARTIFACTS[1:]
    found = _assign(rod, [_at(15.2, 20.0), _at(3.0, 39.9), _at(14.8, 40.1), _at(15.1, 0.3), _at(15.1, 39.7)])
    assert found.surface.tolist() == [0, 1, NONE, NONE, NONE]
    assert found.distance[:2] == pytest.approx([0.2, -0.1])
    column = [_at(15.1, z, turn) for turn, z in enumerate(np.linspace(3.0, 33.0, 61))]
    found = _assign(endless, [*column, _at(3.0, 20.0)])
    assert found.surface[-1] == NONE
    assert (found.surface == NONE)[[0, 60]].all()  # the ends of what is seen are as good as edges
    assert (found.surface[3:-4] == 0).all()
    found = _assign(ball, [[0.0, 0.0, 14.3], [8.0, 0.0, 11.0], [0.0, 12.0, 0.0]])
    assert found.surface.tolist() == [0, 0, NONE]
    assert found.distance[:2] == pytest.approx([0.3, np.hypot(8.0, 11.0) - 14.0])
    assert found.normal[1] == pytest.approx(np.array([8.0, 0.0, 11.0]) / np.hypot(8.0, 11.0))


def test_a_wider_margin_or_a_narrower_band_takes_points_away():
    points = [_at(10.1, 27.0), _at(10.1, 30.0), _at(10.6, 40.0)]
    assert _assign(STEPPED, points, margin=0.5).surface.tolist() == [1, 1, 1]
    assert _assign(STEPPED, points, margin=3.0).surface.tolist() == [NONE, 1, 1]
    assert _assign(STEPPED, points, band=0.5).surface.tolist() == [1, 1, NONE]
    own = assign(STEPPED, np.array(points), np.array([3.0, 0.5, 0.5]), np.array([1.0, 1.0, 0.3]))
    assert own.surface.tolist() == [NONE, 1, NONE]


def _cloud(artifact, seed=1):
    """Points near all surfaces."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-25.0, 25.0, (4000, 3))
    points[:, 2] = rng.uniform(-16.0, 50.0, 4000)
    return points[_assign(artifact, points).surface != NONE]


@pytest.mark.parametrize("artifact", ARTIFACTS, ids=IDS)
def test_derivatives_by_sizes(artifact):
    points = _cloud(artifact)
    before = _assign(artifact, points)
    rows = by_sizes(artifact, before.surface)
    assert set(before.surface[before.surface != NONE]) == set(range(len(surface_names(artifact))))
    for k in range(len(size_names(artifact))):
        step = 1e-4 * np.eye(len(size_names(artifact)))[k]
        ends = [_assign(with_sizes(artifact, sizes_of(artifact) + s * step), points) for s in (1, -1)]
        same = (ends[0].surface == before.surface) & (ends[1].surface == before.surface) & (before.surface != NONE)
        assert np.mean(same[before.surface != NONE]) > 0.9
        difference = (ends[0].distance - ends[1].distance)[same] / 2e-4
        assert rows[same, k] == pytest.approx(difference, abs=1e-8)
    assert not by_sizes(artifact, np.array([NONE])).any()


@pytest.mark.parametrize("artifact", ARTIFACTS, ids=IDS)
def test_normals_and_curvatures_are_the_first_and_second_derivatives_of_the_distance(artifact):
    points = _cloud(artifact, 2)
    before = _assign(artifact, points)
    known = before.surface != NONE
    curvature = curvature_of(artifact, points, before.surface)
    second = np.zeros(len(points))
    for axis in np.eye(3):
        ends = [_assign(artifact, points + s * 1e-3 * axis) for s in (1, -1)]
        same = known & (ends[0].surface == before.surface) & (ends[1].surface == before.surface)
        slope = (ends[0].distance - ends[1].distance)[same] / 2e-3
        assert before.normal[same] @ axis == pytest.approx(slope, abs=1e-6)
        second += (ends[0].distance - 2 * before.distance + ends[1].distance) / 1e-6
    inner = np.isfinite(second)
    n_curved = 2 if isinstance(artifact, KnownSphere) else 1
    # of a sphere at its own radius, not at the point's
    expected = n_curved / np.linalg.norm(points, axis=1) if isinstance(artifact, KnownSphere) else curvature
    assert second[inner] == pytest.approx(expected[inner], abs=1e-4)
    if isinstance(artifact, KnownSphere):
        assert curvature[known] == pytest.approx(np.full(np.count_nonzero(known), 1 / 14.0))
    assert not curvature_of(artifact, points[:1], np.array([NONE])).any()


@pytest.mark.parametrize("artifact", ARTIFACTS, ids=IDS)
def test_sizes_go_in_and_out(artifact):
    sizes = sizes_of(artifact)
    assert with_sizes(artifact, sizes) == artifact
    grown = with_sizes(artifact, sizes + np.arange(1, len(sizes) + 1))
    assert sizes_of(grown) - sizes == pytest.approx(np.arange(1, len(sizes) + 1))
    assert replace(artifact, tolerance=0.1) == with_sizes(replace(artifact, tolerance=0.1), sizes)
    assert (
        mid_height(artifact)
        == {"stepped": 23.5, "rod": 20.0, "endless": 15.0, "ball": 0.0}[IDS[ARTIFACTS.index(artifact)]]
    )
