"""Features in scanned clouds: found among other surfaces, and refused where they are not."""

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.errors import MeasurementError
from rotaline.metrology.features import MeasureOptions, measure_feature
from rotaline.metrology.model import FeatureMeasurement, Region
from rotaline.simulation.ideal.clouds import ScannedPoints

TRUTH = {
    ("ball", "sphere"): {"diameter": 28.475},
    ("rod", "cylinder"): {"diameter": 38.004},
    ("block", "step"): {"height": 7.0},
    ("groove", "groove"): {"depth": 12.0, "width_top": 24.0, "width_bottom": 15.0},
    ("stepped", "stepped-cylinder"): {
        "diameter_small": 23.051,
        "diameter_large": 36.006,
        "height_small": 22.003,
        "height_large": 25.005,
    },
}


def measure(scan: ScannedPoints, feature: str) -> FeatureMeasurement:
    return measure_feature(scan.points_table, feature, viewpoints=scan.viewpoints_table)


@pytest.mark.parametrize(("part", "feature"), TRUTH)
def test_a_feature_finds_itself_beside_the_table(scans: dict[str, ScannedPoints], part: str, feature: str) -> None:
    measured = measure(scans[part], feature)
    truth = TRUTH[part, feature]
    assert set(measured.value) == set(truth) == set(measured.uncertainty)
    for key, value in truth.items():
        assert abs(measured.value[key] - value) < 4 * measured.uncertainty[key]
        assert measured.uncertainty[key] < 0.001
    assert measured.n_points == len(measured.indices) == len(measured.residuals)
    assert len(np.unique(measured.indices)) == measured.n_points
    assert measured.rms == pytest.approx(np.sqrt(np.mean(measured.residuals**2)))
    assert measured.rms < 0.005
    assert measured.rms < measured.form_error < 0.03
    assert measured.warnings == ()


@pytest.mark.parametrize(("part", "feature"), TRUTH)
def test_without_viewpoints_and_in_any_order_the_value_is_the_same(
    scans: dict[str, ScannedPoints], part: str, feature: str
) -> None:
    points = scans[part].points_table
    shuffled = points[np.random.default_rng(1).permutation(len(points))]
    measured = measure_feature(shuffled, feature)
    for key, value in TRUTH[part, feature].items():
        assert abs(measured.value[key] - value) < 5 * measured.uncertainty[key]


@pytest.mark.parametrize(("part", "feature"), [("ball", "sphere"), ("groove", "groove")])
def test_a_cloud_of_another_frame_gives_the_same_value(
    scans: dict[str, ScannedPoints], part: str, feature: str
) -> None:
    move = RigidTransform.from_components([200, -90, 55], Rotation.from_euler("xyz", [3, -2, 120], degrees=True))
    measured = measure_feature(move.apply(scans[part].points_table), feature)
    for key, value in TRUTH[part, feature].items():
        assert abs(measured.value[key] - value) < 5 * measured.uncertainty[key]


REFUSED = [
    ("rod", "sphere", "cylinder fits"),
    ("ball", "cylinder", "sphere fits"),
    ("block", "sphere", "No sphere"),
    ("block", "cylinder", "No cylinder"),
    ("stepped", "sphere", "No sphere"),
    ("block", "groove", "Measure it as a step"),
    ("rod", "groove", "No groove"),
    ("rod", "stepped-cylinder", "no second one"),
    ("ball", "stepped-cylinder", "No cylinder"),
    ("ball", "step", "No step"),
    ("empty", "sphere", "No sphere"),
    ("empty", "step", "No step"),
    ("empty", "groove", "No groove"),
]


@pytest.mark.parametrize(("part", "feature", "message"), REFUSED)
def test_what_is_not_there_is_refused_with_what_was_found(
    scans: dict[str, ScannedPoints], part: str, feature: str, message: str
) -> None:
    with pytest.raises(MeasurementError, match=message) as caught:
        measure(scans[part], feature)
    assert "Found: " in str(caught.value)


def test_the_plane_is_the_parts_not_the_tables(scans: dict[str, ScannedPoints]) -> None:
    measured = measure(scans["rod"], "plane")
    assert measured.geometry["normal"] == pytest.approx([0, 0, 1], abs=1e-4)
    assert measured.geometry["offset"] == pytest.approx(-40, abs=0.01)
    assert measured.value["flatness"] == measured.form_error
    # Noise of 5 um along rays that meet the disc at some 35 deg: 5.15 standard deviations between the two quantiles.
    assert measured.value["flatness"] == pytest.approx(5.15 * measured.rms, rel=0.15)
    alone = measure(scans["ball"], "plane")
    assert alone.geometry["offset"] == pytest.approx(0, abs=0.01)
    assert "table top" in alone.warnings[0]


def test_a_step_may_stand_on_the_table(scans: dict[str, ScannedPoints]) -> None:
    measured = measure(scans["rod"], "step")
    assert abs(measured.value["height"] - 40.0) < 4 * measured.uncertainty["height"]
    assert measured.geometry["lower_is_table"] == 1.0


def test_nominal_values_choose_and_do_not_bias(scans: dict[str, ScannedPoints]) -> None:
    points = scans["stepped"].points_table
    small = measure_feature(points, "cylinder", nominal={"diameter": 23.0})
    large = measure_feature(points, "cylinder", nominal={"diameter": 35.0})
    assert abs(small.value["diameter"] - 23.051) < 4 * small.uncertainty["diameter"]
    assert abs(large.value["diameter"] - 36.006) < 4 * large.uncertainty["diameter"]
    wrong = measure_feature(points, "cylinder", nominal={"diameter": 5.0})
    assert wrong.value["diameter"] == pytest.approx(large.value["diameter"], abs=1e-3)
    step = measure_feature(points, "step", nominal={"height": 25.0})
    assert abs(step.value["height"] - 25.005) < 4 * step.uncertainty["height"]


def test_a_region_chooses_and_indices_refer_to_the_whole_cloud(scans: dict[str, ScannedPoints]) -> None:
    points = scans["stepped"].points_table
    measured = measure_feature(points, "cylinder", region=Region(z=(27.0, 45.0)))
    assert abs(measured.value["diameter"] - 23.051) < 4 * measured.uncertainty["diameter"]
    z = points[measured.indices, 2]
    assert z.min() >= 27.0
    assert z.max() <= 45.0
    with pytest.raises(MeasurementError, match="Only 0 points in the region"):
        measure_feature(points, "cylinder", region=Region(x=(500.0, 600.0), radius=(1.0, 2.0)))


def test_points_that_are_not_finite_are_left_out(scans: dict[str, ScannedPoints]) -> None:
    points = scans["ball"].points_table.copy()
    points[::3] = np.nan
    measured = measure_feature(points, "sphere")
    assert abs(measured.value["diameter"] - 28.475) < 4 * measured.uncertainty["diameter"]
    assert not np.any(measured.indices % 3 == 0)
    with pytest.raises(MeasurementError, match="Only 0 points"):
        measure_feature(np.full((100, 3), np.nan), "sphere")


def test_a_short_arc_is_measured_with_a_warning(scans: dict[str, ScannedPoints]) -> None:
    points = scans["rod"].points_table
    angle = np.arctan2(points[:, 1] - 2.0, points[:, 0] - 3.0)
    measured = measure_feature(points[np.abs(angle) < np.deg2rad(25)], "cylinder")
    assert abs(measured.value["diameter"] - 38.004) < 4 * measured.uncertainty["diameter"]
    assert measured.coverage == pytest.approx(50 / 360, abs=0.02)
    assert "leans on the calibration" in measured.warnings[0]


def test_a_poor_scan_is_measured_with_a_warning(scans: dict[str, ScannedPoints]) -> None:
    points = scans["ball"].points_table
    noisy = points + np.random.default_rng(0).normal(0, 0.4, points.shape)
    measured = measure_feature(noisy, "sphere")
    assert any("scatter" in text for text in measured.warnings)


def test_levels_that_were_not_seen_leave_their_heights_out(scans: dict[str, ScannedPoints]) -> None:
    points = scans["stepped"].points_table
    measured = measure_feature(points, "stepped-cylinder", region=Region(z=(2.0, 60.0)))
    assert set(measured.value) == {"diameter_small", "diameter_large", "height_small"}
    assert "table" in measured.warnings[0]


def test_the_seed_fixes_the_result(scans: dict[str, ScannedPoints]) -> None:
    first, second = (measure(scans["groove"], "groove") for _ in range(2))
    assert first.value == second.value
    other = measure_feature(scans["groove"].points_table, "groove", options=MeasureOptions(seed=5))
    assert abs(other.value["depth"] - first.value["depth"]) < first.uncertainty["depth"]


def test_an_unknown_feature_is_a_wrong_call() -> None:
    with pytest.raises(ValueError, match="expected one of sphere"):
        measure_feature(np.zeros((100, 3)), "cone")
