import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.pipeline.reproduce.complex import covered_fraction, judge_detail, standing_out_mm
from rotaline.simulation.parts.complex_parts import ComplexPart, Detail
from rotaline.simulation.parts.mesh import MeshPart


def _pyramid(height_mm, n=61, half_mm=6.0):
    """A square plate of 4 mm with a round cone of this height and 1 mm radius in the middle of its top: vertices, triangles."""
    line = np.linspace(-half_mm, half_mm, n)
    x, y = (a.ravel() for a in np.meshgrid(line, line))
    cone = np.clip(1.0 - np.hypot(x, y), 0.0, None) * height_mm
    top, bottom = np.column_stack([x, y, 4.0 + cone]), np.column_stack([x, y, np.zeros(n * n)])
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    upper = np.concatenate([np.stack([i, i + 1, i + n + 1], axis=1), np.stack([i, i + n + 1, i + n], axis=1)])
    rim = np.concatenate(
        [np.arange(n), np.arange(1, n) * n + n - 1, n * (n - 1) + np.arange(n - 2, -1, -1), np.arange(n - 2, 0, -1) * n]
    )
    a, b = rim, np.roll(rim, -1)
    sides = np.concatenate([np.stack([a, a + n * n, b], axis=1), np.stack([b, a + n * n, b + n * n], axis=1)])
    return np.concatenate([top, bottom]), np.concatenate([upper, upper[:, ::-1] + n * n, sides])


def _detail(height_mm):
    return Detail("tip", np.array([0.0, 0.0, 4.0 + height_mm]), height_mm, np.array([0.0, 0.0, 1.0]), 1.2)


@pytest.mark.parametrize("height_mm", [0.5, -0.4])
def test_the_height_of_a_detail_is_that_over_its_surroundings(height_mm):
    vertices, _ = _pyramid(height_mm)
    assert standing_out_mm(_detail(height_mm), vertices) == pytest.approx(height_mm, abs=1e-6)
    turned = RigidTransform.from_components([3.0, -2.0, 1.0], Rotation.from_rotvec([0.3, -0.8, 0.5]))
    detail = _detail(height_mm)
    moved = Detail(
        "tip", turned.apply(detail.position_part), height_mm, turned.rotation.apply(detail.direction_part), 1.2
    )
    # the grid turns about the direction, so it meets the tip within its own step
    assert standing_out_mm(moved, turned.apply(vertices)) == pytest.approx(height_mm, abs=0.05)


def test_without_a_surface_there_is_no_height():
    vertices, _ = _pyramid(0.5)
    away = vertices[np.hypot(vertices[:, 0], vertices[:, 1]) > 3.0]
    assert np.isnan(standing_out_mm(_detail(0.5), away))
    assert np.isnan(standing_out_mm(_detail(0.5), np.empty((0, 3))))


@pytest.mark.parametrize(
    ("measured_mm", "resolved"), [(0.48, True), (0.3, True), (0.2, False), (0.8, False), (0.0, False)]
)
def test_a_detail_is_resolved_if_about_its_height_was_measured(measured_mm, resolved):
    part = ComplexPart(MeshPart(*_pyramid(0.5)), (_detail(0.5),))
    vertices, _ = _pyramid(measured_mm)
    shift = RigidTransform.from_translation([5.0, 0.0, 1.0])
    result = judge_detail(_detail(0.5), part, vertices, np.zeros(len(vertices)), shift)
    assert result.resolved == resolved
    assert result.height_mm == pytest.approx(0.5)
    assert result.measured_height_mm == pytest.approx(measured_mm, abs=1e-6)
    np.testing.assert_allclose(result.position_table, [5.0, 0.0, 5.5])


def test_the_covered_fraction_counts_area_without_the_bottom():
    part = ComplexPart(MeshPart(*_pyramid(0.5)), ())
    middle = part.shape.vertices[part.shape.triangles].mean(axis=1)
    right = middle[middle[:, 0] > 0.25]
    assert covered_fraction(part, middle) == pytest.approx(1.0)
    assert covered_fraction(part, right) == pytest.approx(0.5, abs=0.05)
    assert covered_fraction(part, middle[middle[:, 2] < 0.1] - 1.0) == 0.0
