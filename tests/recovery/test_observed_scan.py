"""From traced stripes back to the surface, with the true system: exact without noise, within the prediction with it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rotaline.calibration.model import SystemCalibration, TableMotion
from rotaline.scanning.triangulation import scan_points
from rotaline.simulation.ideal.observed_scan import trace_scan
from rotaline.simulation.ideal.stripe_trace import trace_stripe
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.imaging.render import render_frame
from rotaline.simulation.parts.shapes import SteppedRod
from rotaline.simulation.plan import mount, table_disc
from rotaline.simulation.rig import Mechanics, build_rig
from rotaline.simulation.small_session import BALL, ROD, STEPPED_CYLINDER
from rotaline.vision.stripe.extract import extract_stripe

ANGLES_DEG = tuple(30.0 * i for i in range(12))
RIGS = {
    "article": build_rig((640, 480)),
    "other side, other sense, rolled": build_rig((640, 480), camera_side=1, turn_sense=-1, roll_deg=90.0),
}


def _true_system(rig):
    return SystemCalibration(rig.camera, rig.laser_plane_camera, rig.rotation_axis_camera, rig.turn_sense, True)


def _cloud(rig, scan, stripes, motion=None):
    """Points in the rig's own table frame: the x of a calibrated base points elsewhere."""
    system = replace(_true_system(rig), table_motion=motion)
    cloud = scan_points(stripes, scan.angles_rad, system)
    assert len(cloud) == len(scan.uv)
    rig_from_system = (system.base_from_camera * rig.camera_from_base).inv()
    return rig_from_system.apply(cloud.points_table), cloud


def _heights_over(part, points_table):
    """Distance outside the surface of the ball, or of the rod's side; NaN for points elsewhere."""
    p = part.frame_from_part.inv().apply(points_table)
    if part.shape is BALL:
        radius = np.linalg.norm(p - [0.0, 0.0, BALL.diameter / 2], axis=1)
        return np.where((radius < 20.0) & (p[:, 2] > 0.5), radius - BALL.diameter / 2, np.nan)
    radius = np.hypot(p[:, 0], p[:, 1])
    side = (radius < 25.0) & (p[:, 2] > 0.5) & (p[:, 2] < ROD.height - 0.5)
    return np.where(side, radius - ROD.diameter / 2, np.nan)


@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS.keys())
@pytest.mark.parametrize("shape", [BALL, ROD], ids=["ball", "rod"])
def test_ideal_stripes_give_the_true_surface(rig, shape):
    part = Placed(shape, mount(3.1, -1.2, tilt_deg=0.5))
    scan = trace_scan(rig, [part, table_disc(rig)], ANGLES_DEG)
    points_table, _ = _cloud(rig, scan, scan.observed(0.0, 1))
    np.testing.assert_allclose(points_table, scan.points_table, atol=1e-8)
    heights = _heights_over(part, points_table)
    on_part = np.isfinite(heights)
    assert on_part.sum() > 1000
    assert np.abs(heights[on_part]).max() < 1e-6
    assert np.abs(points_table[points_table[:, 2] < 1e-3][:, 2]).max() < 1e-6


@pytest.mark.parametrize("rig", RIGS.values(), ids=RIGS.keys())
def test_movements_of_the_axis_that_are_known_leave_no_trace(rig):
    """``a cos(angle + phase)`` is half a movement against the table, which is undone, and half one with it: another place on the table."""
    run_out_mm, wobble_rad, phase, pivot = 0.05, 4e-4, np.radians(40.0), rig.rotation_axis_camera.point
    errors = Mechanics(run_out_um=50.0, run_out_phase_deg=40.0, wobble_urad=400.0, wobble_phase_deg=40.0)
    shaken = replace(rig, mechanics=errors)
    scan = trace_scan(shaken, [Placed(BALL, mount(8.0, -1.2)), table_disc(rig)], ANGLES_DEG)
    with_table = Rotation.from_euler("z", rig.turn_sense * phase)
    halves = 0.5 * np.array([[run_out_mm, 0.0, 0.0], [0.0, wobble_rad, 0.0]])
    shift, turn = with_table.apply(halves)
    elsewhere = Rotation.from_rotvec(turn).apply(scan.points_table) + shift

    system_from_rig = _true_system(rig).base_from_camera.rotation * rig.camera_from_base.rotation
    run_out, wobble = (system_from_rig * with_table.inv()).apply(halves)[:, :2].tolist()
    motion = TableMotion(tuple(run_out), tuple(wobble), pivot)
    stripes = scan.observed(0.0, 1)
    undone, as_seen = (_cloud(rig, scan, stripes, m)[0] for m in (motion, None))
    assert np.abs(undone - elsewhere).max() < 2e-5  # products of the two
    assert np.abs(as_seen - elsewhere).max() > 0.02


@pytest.mark.parametrize("shape", [BALL, ROD], ids=["ball", "rod"])
def test_noise_moves_points_as_far_as_predicted(shape):
    rig = RIGS["article"]
    part = Placed(shape, mount(3.1, -1.2))
    scan = trace_scan(rig, [part, table_disc(rig)], ANGLES_DEG)
    z = []
    for seed in range(10):
        points_table, cloud = _cloud(rig, scan, scan.observed(0.1, seed))
        moved = np.linalg.norm(points_table - scan.points_table, axis=1)
        z.append(moved / cloud.u_mm)
    z = np.concatenate(z)
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1.0, abs=4 / np.sqrt(2 * len(z)))
    assert np.mean(z < 1) == pytest.approx(0.6827, abs=4 * np.sqrt(0.22 / len(z)))


def test_traced_stripes_are_what_the_extractor_finds_in_a_rendered_frame():
    """A bowed sheet on the stepped cylinder: centres, widths and heights of the profiles, and where there are any."""
    rig = RIGS["article"]
    rig = replace(rig, laser=replace(rig.laser, bow_mm=0.5, speckle_contrast=0.0))
    parts = [Placed(SteppedRod(STEPPED_CYLINDER), mount(1.0, 2.0)), table_disc(rig)]
    light = rig.light
    image = render_frame(
        rig,
        parts,
        laser_on=True,
        ambient_e_per_ms=light.ambient_on_fraction * light.ambient_e_per_ms,
        exposure_ms=light.exposure_on_ms,
        seed=1,
    )
    found, trace = extract_stripe(image), trace_stripe(rig, parts)
    gap, nearest = cKDTree(trace.uv).query(found.uv)
    same = gap < 1.0
    off = ((found.uv - trace.uv[nearest]) * trace.normal[nearest]).sum(axis=1)
    for k in np.unique(trace.segment):
        here = same & (trace.segment[nearest] == k)
        assert here.sum() > 0.9 * (trace.segment == k).sum() - 2
        # on the cylinders the sheet's own width moves the centroid; the bow moves it by pixels
        assert abs(np.median(off[here])) < 0.02
    assert np.median(found.width_px[same] / trace.width_px[nearest][same]) == pytest.approx(1.0, abs=0.02)
    assert np.median(found.intensity[same] / trace.intensity_dn[nearest][same]) == pytest.approx(1.0, abs=0.03)
    flat = trace_stripe(replace(rig, laser=replace(rig.laser, bow_mm=0.0)), parts)
    assert cKDTree(flat.uv).query(trace.uv)[0].max() > 0.5
