"""The generated parts: closed, without self-intersections, of the size of the article's parts, with details where they say."""

import numpy as np
import pytest

from rotaline.simulation.parts.complex_parts import GENERATORS
from rotaline.simulation.parts.mesh import open_half_edges, triangle_normals, unit_rows
from rotaline.simulation.parts.mesh_distance import signed_distances_to_mesh

NAMES = ("bust", "casting_with_flash", "rubber_model", "thread_connector")


@pytest.fixture(scope="module")
def parts():
    return {name: generate() for name, generate in GENERATORS.items()}


def test_there_are_the_four_kinds_of_the_article():
    assert tuple(GENERATORS) == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_they_fit_on_the_table_and_are_fine_enough(parts, name):
    shape = parts[name].shape
    lower, upper = shape.bounds()
    size = upper - lower
    assert lower[2] == pytest.approx(0.0, abs=1e-9)
    assert 30.0 <= size[2] <= 50.0
    assert size[:2].min() >= 25.0
    assert size[:2].max() <= 45.0
    assert 1e5 <= len(shape.triangles) <= 2.5e5
    assert len(open_half_edges(shape.triangles)) == 0


@pytest.mark.parametrize("name", NAMES)
def test_no_part_of_the_surface_is_inside_out_or_buried(parts, name):
    shape = parts[name].shape
    some = np.random.default_rng(2).integers(0, len(shape.triangles), 800)
    middles = shape.vertices[shape.triangles[some]].mean(axis=1)
    normals = unit_rows(triangle_normals(shape.vertices, shape.triangles))[some]
    heights = np.where(np.arange(len(some)) % 2 == 0, 0.01, -0.01)
    found = signed_distances_to_mesh(shape, middles + heights[:, None] * normals)
    assert np.abs(found - heights).max() < 1e-9


@pytest.mark.parametrize("name", NAMES)
def test_details_stand_out_of_their_surroundings_by_their_size(parts, name):
    part = parts[name]
    assert len({detail.name for detail in part.details}) == len(part.details) >= 3
    for detail in part.details:
        assert np.linalg.norm(detail.direction_part) == pytest.approx(1.0)
        assert 0.3 <= abs(detail.size_mm) <= 1.2
        offsets = part.shape.vertices - detail.position_part
        assert np.linalg.norm(offsets, axis=1).min() < 1e-9
        height = offsets @ detail.direction_part
        aside = np.linalg.norm(offsets - height[:, None] * detail.direction_part, axis=1)
        near = np.linalg.norm(offsets, axis=1) < 3.0
        around = near & (aside > 0.9 * detail.radius_mm) & (aside < 1.3 * detail.radius_mm)
        drop = -np.median(height[around])
        if "nose" in detail.name:  # a narrow ridge: its sides fall away
            drop = -height[around].max()
        if "thread" in detail.name:  # between crests
            drop = -height[around].min()
        # surroundings are curved
        assert drop == pytest.approx(detail.size_mm, abs=0.15), detail.name


@pytest.mark.parametrize("name", NAMES)
def test_the_camera_sees_them(parts, name):
    shape = parts[name].shape
    eye = np.array([200.0, 60.0, 150.0])
    targets = shape.vertices[:: len(shape.vertices) // 500]
    t, faces = shape.intersect(eye, targets - eye)
    hit = np.isfinite(t)
    assert hit.mean() > 0.95
    normals = shape.normals(eye + t[hit, None] * (targets - eye)[hit], faces[hit])
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)


def test_the_thread_has_its_pitch_and_depth(parts):
    shape = parts["thread_connector"].shape
    z = np.linspace(23.0, 35.0, 241)
    radius = []
    for height in z:
        t, _ = shape.intersect(np.array([100.0, 0.0, height]), np.array([[-1.0, 0.0, 0.0]]))
        radius.append(100.0 - t[0])
    radius = np.array(radius)
    assert np.ptp(radius) == pytest.approx(1.1, abs=0.02)
    shifted = np.abs(radius[:-40] - radius[40:])  # one pitch of 2 mm further
    assert np.median(shifted) < 0.02
    assert np.median(np.abs(radius[:-20] - radius[20:])) > 0.3


def test_the_flash_is_thin_and_stands_out(parts):
    shape = parts["casting_with_flash"].shape
    radius = []
    for height in np.arange(15.0, 17.0, 0.02):
        t, _ = shape.intersect(np.array([100.0, 0.0, height]), np.array([[-1.0, 0.0, 0.0]]))
        radius.append(100.0 - t[0])
    radius = np.array(radius)
    thickness = 0.02 * np.count_nonzero(radius > np.median(radius) + 0.4)
    assert 0.28 <= thickness <= 0.42
    assert 0.6 < np.ptp(radius) < 0.9
