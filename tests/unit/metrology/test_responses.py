"""How values follow their points, and what the frames say about their scatter."""

import numpy as np
import pytest

from rotaline.geometry.fitting import fit_cylinder_orthogonal, fit_plane_orthogonal, fit_sphere_orthogonal
from rotaline.geometry.primitives import Cylinder, Line
from rotaline.metrology.features import measure_feature
from rotaline.metrology.model import FeatureMeasurement
from rotaline.metrology.responses import frame_variance
from rotaline.simulation.ideal.clouds import ScannedPoints

MEASURED = [
    ("ball", "sphere"),
    ("rod", "cylinder"),
    ("block", "step"),
    ("groove", "groove"),
    ("stepped", "stepped-cylinder"),
]


@pytest.fixture(scope="module")
def measured(scans: dict[str, ScannedPoints]) -> dict[str, FeatureMeasurement]:
    return {
        part: measure_feature(scans[part].points_table, feature, viewpoints=scans[part].viewpoints_table)
        for part, feature in MEASURED
    }


def _moves(points: np.ndarray) -> dict[str, np.ndarray]:
    """Smooth and random small displacements of points, of the order of 1."""
    rng = np.random.default_rng(5)
    relative = (points - points.mean(axis=0)) / 20.0
    return {
        "scale": relative,
        "shear": relative @ rng.normal(size=(3, 3)),
        "waves": np.sin(points @ rng.normal(size=(3, 3)) / 8.0),
        "random": rng.normal(size=points.shape),
    }


def _predicted(measurement: FeatureMeasurement, moves: np.ndarray) -> dict[str, float]:
    along = np.sum(measurement.normals * moves, axis=1)
    return {key: float(responses @ along) for key, responses in measurement.responses.items()}


@pytest.mark.parametrize(("part", "feature"), MEASURED)
def test_rigid_motions_change_nothing_and_a_scale_all_values_alike(
    scans: dict[str, ScannedPoints], measured: dict[str, FeatureMeasurement], part: str, feature: str
) -> None:
    found = measured[part]
    points = scans[part].points_table[found.indices]
    assert set(found.responses) == set(found.value)
    assert found.normals.shape == points.shape
    np.testing.assert_allclose(np.linalg.norm(found.normals, axis=1), 1.0, atol=1e-12)
    for change in _predicted(found, np.tile([3.0, -2.0, 5.0], (len(points), 1))).values():
        assert abs(change) < 2e-4
    for change in _predicted(found, np.cross([0.3, 0.5, -0.4], points)).values():
        assert abs(change) < 2e-3
    for key, change in _predicted(found, points).items():
        assert change == pytest.approx(found.value[key], rel=1e-4)


@pytest.mark.parametrize("part", ["ball", "rod"])
def test_fits_of_the_same_points_move_as_predicted(
    scans: dict[str, ScannedPoints], measured: dict[str, FeatureMeasurement], part: str
) -> None:
    found = measured[part]
    points = scans[part].points_table[found.indices]

    def diameter(moved: np.ndarray) -> float:
        if part == "ball":
            return 2 * fit_sphere_orthogonal(moved).sphere.radius
        axis = Line(np.array(found.geometry["axis_point"]), np.array(found.geometry["axis_direction"]))
        return 2 * fit_cylinder_orthogonal(moved, Cylinder(axis, 19.0)).cylinder.radius

    assert diameter(points) == pytest.approx(found.value["diameter"], abs=1e-9)
    size = 1e-3
    for moves in _moves(points).values():
        change = (diameter(points + size * moves) - diameter(points - size * moves)) / (2 * size)
        assert _predicted(found, moves)["diameter"] == pytest.approx(change, rel=1e-3, abs=2e-4)


def test_the_planes_of_a_groove_fitted_to_the_same_points_move_as_predicted(
    scans: dict[str, ScannedPoints], measured: dict[str, FeatureMeasurement]
) -> None:
    found = measured["groove"]
    points = scans["groove"].points_table[found.indices]
    jumps = np.any(np.diff(found.normals, axis=0) != 0, axis=1) | (np.abs(np.diff(points[:, 2])) > 11.5)
    starts = np.append(0, np.flatnonzero(jumps) + 1)
    assert len(starts) == 4
    along = np.array(found.geometry["direction"])

    def sizes(moved: np.ndarray) -> dict[str, float]:
        pieces = np.split(moved, starts[1:])
        top, bottom, left, right = (fit_plane_orthogonal(piece).plane for piece in pieces)
        corners = {
            (level, flank): np.linalg.solve(
                np.array([level.normal, flank.normal, along]),
                [-level.offset, -flank.offset, along @ np.array(found.geometry["bottom_centroid"])],
            )
            for level in (top, bottom)
            for flank in (left, right)
        }
        widths = {level: np.linalg.norm(corners[level, right] - corners[level, left]) for level in (top, bottom)}
        depth = abs(float(top.signed_distance_to(pieces[1]).mean()))
        return {"depth": depth, "width_top": float(widths[top]), "width_bottom": float(widths[bottom])}

    assert sizes(points) == pytest.approx(found.value, abs=1e-6)
    size = 1e-3
    for moves in _moves(points).values():
        ends = [sizes(points + sign * size * moves) for sign in (1, -1)]
        for key, change in _predicted(found, moves).items():
            assert change == pytest.approx((ends[0][key] - ends[1][key]) / (2 * size), rel=2e-3, abs=1e-3)


@pytest.mark.parametrize(("part", "feature"), MEASURED)
def test_a_moved_cloud_measured_again_gives_the_predicted_value(
    scans: dict[str, ScannedPoints], measured: dict[str, FeatureMeasurement], part: str, feature: str
) -> None:
    """Other points may be chosen: what that changes is less than the scatter."""
    found, points = measured[part], scans[part].points_table
    moves = 0.01 * _moves(points)["shear"]
    again = measure_feature(points + moves, feature, viewpoints=scans[part].viewpoints_table)
    predicted = _predicted(found, moves[found.indices])
    assert max(abs(change) / found.u_scatter[key] for key, change in predicted.items()) > 5
    for key, change in predicted.items():
        slack = 0.5 * found.u_scatter[key] + 0.01 * abs(change)
        assert abs(again.value[key] - found.value[key] - change) < slack


def test_responses_are_those_of_least_squares(
    scans: dict[str, ScannedPoints], measured: dict[str, FeatureMeasurement]
) -> None:
    """On a full turn the diameter is twice the mean distance: every point pulls about alike. A level moves a height by its mean."""
    rod = measured["rod"]
    assert rod.responses["diameter"].sum() == pytest.approx(2.0, rel=1e-9)
    block = measured["block"]
    top = scans["block"].points_table[block.indices, 2] > 13.5
    assert block.responses["height"][top].sum() == pytest.approx(1.0, rel=1e-9)
    assert block.responses["height"][~top].sum() == pytest.approx(-1.0, rel=1e-9)


def test_flatness_is_not_smooth_and_has_no_responses(scans: dict[str, ScannedPoints]) -> None:
    plane = measure_feature(scans["rod"].points_table, "plane")
    assert plane.responses == {}
    assert plane.normals.shape == (0, 3)
    assert plane.uncertainty == plane.u_scatter
    assert set(plane.u_scatter) == {"flatness"}


def test_the_calibration_adds_to_the_scatter(measured: dict[str, FeatureMeasurement]) -> None:
    found = measured["groove"]
    assert found.uncertainty == found.u_scatter
    assert found.u_calibration == {}
    both = found.with_calibration({"depth": 0.003, "width_top": 0.004})
    assert both.u_calibration == {"depth": 0.003, "width_top": 0.004}
    assert both.u_scatter == found.u_scatter
    assert both.uncertainty["depth"] == pytest.approx(np.hypot(found.u_scatter["depth"], 0.003))
    assert both.uncertainty["width_bottom"] == found.u_scatter["width_bottom"]
    assert both.with_calibration({}).uncertainty == found.uncertainty


def _frames_of(scan: ScannedPoints) -> np.ndarray:
    """The frame of each point, from where it was seen."""
    return np.unique(np.round(scan.viewpoints_table, 6), axis=0, return_inverse=True)[1].ravel()


@pytest.mark.parametrize(("part", "feature"), [("rod", "cylinder"), ("groove", "groove")])
def test_errors_that_frames_have_in_common_are_seen(scans: dict[str, ScannedPoints], part: str, feature: str) -> None:
    scan = scans[part]
    frame = _frames_of(scan)
    n_frames = frame.max() + 1
    assert n_frames == 120
    independent = measure_feature(scan.points_table, feature, viewpoints=scan.viewpoints_table, frame=frame)
    plain = measure_feature(scan.points_table, feature, viewpoints=scan.viewpoints_table)
    for key, u in independent.u_scatter.items():
        assert u == pytest.approx(plain.u_scatter[key], rel=0.3)

    # Each frame is off as a whole, by 8 um.
    off = np.random.default_rng(4).normal(0, 0.008, n_frames)[frame]
    rays = scan.points_table - scan.viewpoints_table
    shaken = scan.points_table + off[:, None] * rays / np.linalg.norm(rays, axis=1)[:, None]
    common = measure_feature(shaken, feature, viewpoints=scan.viewpoints_table, frame=frame)
    label = np.random.default_rng(1).permutation(n_frames)
    renamed = measure_feature(shaken, feature, viewpoints=scan.viewpoints_table, frame=label[frame])
    for key, u in common.u_scatter.items():
        assert u > 1.3 * independent.u_scatter[key]
        # The order of the frames is that of the turn, whatever their numbers.
        assert renamed.u_scatter[key] == pytest.approx(u, rel=1e-9)


def test_few_frames_count_neighbours_on_the_surface_too(scans: dict[str, ScannedPoints]) -> None:
    scan = scans["rod"]
    keep = _frames_of(scan) % 24 == 0
    points, frame = scan.points_table[keep], _frames_of(scan)[keep]
    bent = points + 0.01 * np.sin(points[:, 2:] / 3.0) * [1.0, 0.0, 0.0]
    with_frames = measure_feature(bent, "cylinder", frame=frame)
    without = measure_feature(bent, "cylinder")
    assert len(np.unique(frame)) == 5
    assert with_frames.u_scatter["diameter"] >= without.u_scatter["diameter"]


def test_neighbouring_frames_count_together_only_where_they_are_alike() -> None:
    rng = np.random.default_rng(2)
    alone = rng.normal(size=60)
    assert frame_variance(alone) == pytest.approx(alone @ alone)
    alternating = alone * np.resize([1.0, -1.0], 60) * np.sign(alone)
    assert frame_variance(alternating) == pytest.approx(alone @ alone)
    # Sums of three neighbours: the sum of all varies three times as much as their squares say.
    alike = [np.convolve(rng.normal(size=62), np.ones(3), "valid") for _ in range(200)]
    ratio = np.mean([frame_variance(s) for s in alike]) / np.mean([s @ s for s in alike])
    assert 2.0 < ratio < 3.0
    assert frame_variance(np.zeros(5)) == 0.0
    assert frame_variance(np.array([0.5])) == 0.25
