"""What the figures compute before they draw."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.io.report.contents import FittedPoints
from rotaline.io.report.figures import artifact, axis, camera, features, laser_plane, scan


def test_the_outline_of_a_board_holds_its_points(full_contents):
    calibration = full_contents.camera
    for view in calibration.views:
        outline = camera.board_outline(calibration.camera, view)
        board = view.camera_from_board.inv().apply(outline)
        np.testing.assert_allclose(board[:, 2], 0.0, atol=1e-9)
        np.testing.assert_allclose(board[:, :2], [[0, 0], [68, 0], [68, 60], [0, 60]], atol=0.5)


def test_points_that_were_left_out_spoil_no_mean(full_contents):
    """NaN residuals mark single points that were left out; the cells that they stand in keep their mean."""
    calibration = full_contents.camera
    view = calibration.views[0]
    residuals = view.residuals_px.copy()
    residuals[::7] = np.nan
    views = (dataclasses.replace(view, residuals_px=residuals), *calibration.views[1:])
    complete, holes = (
        camera.residual_vectors(dataclasses.replace(calibration, views=v)).axes[1].collections[0]
        for v in (calibration.views, views)
    )
    assert holes.N > 10
    assert holes.N >= complete.N - 5
    assert np.isfinite(holes.U).all()


def test_the_patch_of_the_laser_plane_lies_in_it_and_holds_the_stripes(full_contents):
    calibration = full_contents.laser_plane
    points = np.vstack([v.points_camera for v in calibration.views])
    patch = laser_plane.plane_patch(calibration.plane_camera, points)
    np.testing.assert_allclose(calibration.plane_camera.signed_distance_to(patch), 0.0, atol=1e-9)
    edges = np.roll(patch, -1, axis=0) - patch
    assert edges[0] @ edges[1] == pytest.approx(0.0, abs=1e-6)
    for corner, edge in zip(patch, edges, strict=True):
        along = (points - corner) @ edge / (edge @ edge)
        assert along.min() > -0.01
        assert along.max() < 1.01


@pytest.mark.parametrize("sense", [1, -1])
def test_the_board_angles_follow_the_table_in_either_sense(full_contents, sense):
    calibration = full_contents.axis
    frames = tuple(dataclasses.replace(f, angle_rad=sense * f.angle_rad) for f in calibration.frames)
    turned = dataclasses.replace(calibration, frames=frames, turn_sense=sense)
    angles, residuals = axis.board_angle_residuals(turned)
    assert len(angles) == 20  # one frame was left out
    assert np.abs(residuals).max() < 6e-4  # the poses carry 1e-4 rad of noise
    disturbed = list(frames)
    disturbed[10] = dataclasses.replace(frames[10], angle_rad=frames[10].angle_rad + 0.01)
    _, residuals = axis.board_angle_residuals(dataclasses.replace(turned, frames=tuple(disturbed)))
    assert np.abs(residuals).max() == pytest.approx(0.01, abs=6e-4)


def test_ideal_circles_come_from_the_artefact_or_else_from_the_points(full_contents):
    mount = full_contents.artifact.mounts[1]
    with_sizes = artifact.feature_circles(mount, full_contents.artifacts["stepped-2"])
    without = artifact.feature_circles(mount, None)
    for figure in (with_sizes, without):
        radii = [np.hypot(*ax.lines[0].get_data()).max() for ax in figure.axes]
        np.testing.assert_allclose(radii, [11.5255, 11.5255, 18.003, 18.003], atol=0.01)


def test_counts_of_a_thinned_cloud_are_scaled_up(full_contents):
    summary = full_contents.clouds[0]
    (ax,) = scan.points_by_frame(summary.cloud, summary.n_points).axes
    assert ax.lines[0].get_ydata().sum() == pytest.approx(summary.n_points)


@pytest.mark.parametrize("name", ["sphere", "cylinder", "groove", "stepped-cylinder"])
def test_fits_are_charted_in_their_own_coordinates(full_contents, name):
    fitted = next(f for f in full_contents.fitted_points if f.feature == name)
    entry = next(e for e in full_contents.measurements if e.feature == name)
    figure = features.fit(entry.measurement, fitted)
    labels = {ax.get_xlabel() for ax in figure.axes}
    expected = {"sphere": "longitude [deg]", "groove": "across the feature [mm]"}.get(
        name, "angle about the fitted axis [deg]"
    )
    assert expected in labels


def test_a_fit_without_geometry_is_still_drawn(full_contents):
    fitted = next(f for f in full_contents.fitted_points if f.feature == "sphere")
    entry = next(e for e in full_contents.measurements if e.feature == "sphere")
    bare = dataclasses.replace(entry.measurement, geometry={"centre": [float("nan"), 0.0, 0.0]})
    assert "Residuals, seen along the normal" in {ax.get_title(loc="left") for ax in features.fit(bare, fitted).axes}


@settings(deadline=None, max_examples=50)
@given(st.floats(0, 360), st.integers(2, 20), st.floats(0.5, 15), st.randoms())
def test_the_arc_of_the_table_angles_does_not_depend_on_where_they_begin(start, n, step, random):
    angles = start + step * np.arange(n)
    order = random.sample(range(n), n)
    arc = axis.unwrapped(np.deg2rad(angles[order] % 360.0))
    assert np.rad2deg(np.ptp(arc)) == pytest.approx(step * (n - 1), abs=1e-6)
    np.testing.assert_allclose(np.cos(arc), np.cos(np.deg2rad(angles[order])), atol=1e-9)


def test_means_of_cells_show_what_the_noise_hides(full_contents):
    """A wave of 2 um under 10 um of noise stands out of the chart's cells."""
    rng = np.random.default_rng(5)
    angle, height = rng.uniform(-np.pi, np.pi, 40000), rng.uniform(0.0, 40.0, 40000)
    wave = 0.002 * np.cos(angle)
    points = np.stack([19 * np.cos(angle), 19 * np.sin(angle), height], axis=1)
    fitted = FittedPoints("rod", "cylinder", "rod", points, wave + rng.normal(0, 0.010, len(wave)))
    entry = next(e for e in full_contents.measurements if e.feature == "cylinder")
    chart = next(
        ax for ax in features.fit(entry.measurement, fitted).axes if ax.get_title(loc="left") == "Residuals, unrolled"
    )
    (mesh,) = chart.collections
    means = np.ma.filled(mesh.get_array(), np.nan).mean(axis=0)
    middles = np.deg2rad(np.linspace(-180, 180, len(means) + 1)[:-1] + 180 / len(means))
    assert np.corrcoef(means, np.cos(middles))[0, 1] > 0.9


def test_a_stepped_cylinder_unrolls_along_its_profile_without_overlap(full_contents):
    """Disc, side, ring and side follow each other on the chart."""
    parts = {"disc": (5.0, 47.0), "small": (11.5, 36.0), "ring": (15.0, 25.0), "large": (18.0, 10.0)}
    points = np.array([[r, 0.0, z] for r, z in parts.values()])
    fitted = FittedPoints("stepped-1", "stepped-cylinder", "stepped-cylinder", points, np.zeros(4))
    entry = full_contents.measurements[0]
    chart = next(
        ax for ax in features.fit(entry.measurement, fitted).axes if ax.get_title(loc="left") == "Residuals, unrolled"
    )
    down = chart.collections[0].get_offsets()[:, 1]
    np.testing.assert_allclose(np.sort(down)[::-1], [0.0, -17.5, -32.0, -50.0], atol=1e-9)


def test_the_uncertainty_from_the_calibration_is_shown_where_it_is_known(full_contents):
    cloud = full_contents.clouds[0].cloud
    titles = {ax.get_title(loc="left") for ax in scan.cloud_attributes(cloud, True).axes}
    assert {"u from the stripe", "u from the calibration"} <= titles
    unknown = dataclasses.replace(cloud, u_calibration_mm=cloud.u_calibration_mm * np.nan)
    titles = {ax.get_title(loc="left") for ax in scan.cloud_attributes(unknown, True).axes}
    assert "u from the calibration" not in titles
