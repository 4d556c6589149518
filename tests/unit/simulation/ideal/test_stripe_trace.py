"""Traced stripes against what pixel rays say, against rendered light, and against the definition of the sheet."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.geometry.primitives import SteppedCylinder
from rotaline.simulation.ideal.stripe_trace import sheet_rays, trace_stripe
from rotaline.simulation.imaging.laser_light import sheet_distance
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.imaging.render import render_irradiance
from rotaline.simulation.parts.shapes import Ball, GrooveBlock, Rod, SteppedRod
from rotaline.simulation.plan import mount, table_disc
from rotaline.simulation.rig import Optics, build_rig

PARTS = {
    "ball": Ball(28.0),
    "rod": Rod(30.0, 35.0),
    "stepped": SteppedRod(SteppedCylinder(20.0, 34.0, 18.0, 20.0)),
    "groove": GrooveBlock(40.0, 30.0, 24.0, 10.0, 20.0, 12.0),
}


def _scene(rig, name, pose=None):
    return [Placed(PARTS[name], mount(2.0, -1.5, 30.0) if pose is None else pose), table_disc(rig)]


def _hits(parts, origin, directions):
    """Nearest entry of rays: distance, part, face."""
    t, part, face = np.full(len(directions), np.inf), np.full(len(directions), -1), np.zeros(len(directions), int)
    for i, placed in enumerate(parts):
        to_part = placed.frame_from_part.inv()
        t_i, face_i = placed.shape.intersect(to_part.apply(origin[None])[0], to_part.rotation.apply(directions))
        part, face, t = np.where(t_i < t, i, part), np.where(t_i < t, face_i, face), np.minimum(t, t_i)
    return t, part, face


@given(
    name=st.sampled_from(list(PARTS)),
    side=st.sampled_from([-1, 1]),
    roll_deg=st.floats(-180, 180),
    x=st.floats(-6, 6),
    y=st.floats(-6, 6),
    turn_deg=st.floats(0, 360),
)
@settings(max_examples=15, deadline=None, derandomize=True)
def test_points_are_on_the_sheet_and_the_first_thing_that_laser_and_camera_meet(name, side, roll_deg, x, y, turn_deg):
    rig = build_rig((160, 120), camera_side=side, roll_deg=roll_deg)
    parts = _scene(rig, name, mount(x, y, turn_deg))
    trace = trace_stripe(rig, parts)
    assert len(trace.uv) > 20
    points = trace.points_base
    assert np.abs(rig.laser.plane_base.signed_distance_to(points)).max() < 1e-10
    eye = np.asarray(rig.camera_from_base.inv().translation)
    for start in (rig.laser.position_base, eye):
        t, _, _ = _hits(parts, start, points - start)
        np.testing.assert_allclose(t, 1.0, atol=1e-6)
    uv = rig.camera.project(rig.camera_from_base.apply(points))
    np.testing.assert_allclose(trace.uv, uv, atol=1e-8)
    assert np.all((uv >= 0) & (uv <= np.array(rig.camera.image_size) - 1))
    np.testing.assert_allclose(np.linalg.norm(trace.normal, axis=1), 1.0)
    same = np.diff(trace.segment) == 0
    step = np.diff(trace.uv, axis=0)[same]
    # an even distance, and normals across it; twice as long steps would be seen
    np.testing.assert_allclose(np.linalg.norm(step, axis=1), 1.0, atol=0.1)
    assert np.abs((step * trace.normal[:-1][same]).sum(axis=1)).max() < 0.2
    assert np.all(np.diff(trace.segment) >= 0)


@pytest.mark.parametrize("name", list(PARTS))
def test_nothing_is_left_out_and_nothing_is_invented(name):
    """Every pixel's ray says on which side of the sheet it ends: between the sides lies the stripe."""
    rig = build_rig((320, 240))
    parts = _scene(rig, name)
    width, height = rig.camera.image_size
    v, u = np.mgrid[0:height, 0:width]
    rays = rig.camera_from_base.rotation.inv().apply(rig.camera.rays(np.stack([u.ravel(), v.ravel()], 1).astype(float)))
    eye = np.asarray(rig.camera_from_base.inv().translation)
    t, part, face = _hits(parts, eye, rays)
    points = eye + np.where(part >= 0, t, 1.0)[:, None] * rays
    distance = rig.laser.plane_base.signed_distance_to(points)
    kind = part * 100 + face
    crossings = []
    for step, move in ((1, (1.0, 0.0)), (width, (0.0, 1.0))):
        a = np.arange(width * height - step)
        if step == 1:
            a = a[(a + 1) % width != 0]
        b = a + step
        keep = (kind[a] == kind[b]) & (part[a] >= 0) & (np.sign(distance[a]) != np.sign(distance[b]))
        a, b = a[keep], b[keep]
        share = distance[a] / (distance[a] - distance[b])
        at = points[a] + share[:, None] * (points[b] - points[a])
        t_laser, _, _ = _hits(parts, rig.laser.position_base, at - rig.laser.position_base)
        lit = t_laser > 0.999  # chords of curved surfaces lie a little inside
        crossings.append(np.stack([u.ravel()[a], v.ravel()[a]], 1)[lit] + share[lit, None] * move)
    expected = np.concatenate(crossings)
    found = trace_stripe(rig, parts, spacing_px=0.25, edge_px=0.0, min_intensity_dn=0.0).uv
    gaps = np.linalg.norm(expected[:, None] - found[None], axis=2)
    assert len(expected) > 250
    assert gaps.min(axis=1).max() < 0.2
    # crossings are found between pixels of the same face only: none at its very end, least of all where a ball's limb hides it
    assert np.quantile(gaps.min(axis=0), 0.98) < 0.7
    assert gaps.min(axis=0).max() < 3.0


def _centroid_errors(rig, parts, sigma_mm):
    """Mean distance of the centroids of rendered light, row by row, from the traced curve; each segment, px."""
    rig = replace(rig, laser=replace(rig.laser, sigma_mm=sigma_mm), optics=Optics(blur_px=0.0))
    light = render_irradiance(rig, parts, laser_on=True, ambient_e_per_ms=0.0).laser
    trace = trace_stripe(rig, parts, spacing_px=0.5, edge_px=8.0)
    errors = []
    for k in np.unique(trace.segment):
        uv = trace.uv[trace.segment == k]
        uv = uv[np.argsort(uv[:, 1])]
        rows = np.arange(np.ceil(uv[0, 1]), np.floor(uv[-1, 1]))
        centres = np.interp(rows, uv[:, 1], uv[:, 0])
        near = np.floor(centres)[:, None].astype(int) + np.arange(-9, 11)
        values = light[rows.astype(int)[:, None], near]
        errors.append((values * near).sum(axis=1) / values.sum(axis=1) - centres)
    return errors


def test_centroids_of_rendered_light_lie_on_the_traced_stripe():
    """On flat faces at once; on cylinders, where a stripe's own width moves its centroid by its square, for no width."""
    rig = build_rig((640, 480))
    parts = _scene(rig, "stepped")
    narrow, wide = (_centroid_errors(rig, parts, sigma_mm) for sigma_mm in (0.15, 0.25))
    assert len(narrow) == 6
    assert min(map(len, narrow)) >= 8
    for k, (a, b) in enumerate(zip(narrow, wide, strict=True)):
        if k in (1, 3):  # the sides of the cylinders
            assert np.abs(a).max() < 0.03
            assert abs(np.mean(b)) > 2 * abs(np.mean(a))
            assert abs(np.mean(a) * 0.25**2 - np.mean(b) * 0.15**2) / (0.25**2 - 0.15**2) < 0.002
        else:
            assert np.abs(a).max() < 0.005


def test_no_points_within_the_stated_distance_of_an_edge():
    rig = build_rig((320, 240))
    parts = _scene(rig, "stepped")
    whole, inner = (trace_stripe(rig, parts, edge_px=edge, spacing_px=0.5) for edge in (0.0, 4.0))
    ends = []
    for k in np.unique(whole.segment):
        piece = whole.uv[whole.segment == k]
        ends += [piece[0], piece[-1]]
    from_ends = np.linalg.norm(inner.uv[:, None] - np.array(ends)[None], axis=2).min(axis=1)
    assert 3.4 < from_ends.min() < 4.6
    assert len(np.unique(inner.segment)) == 6
    np.testing.assert_array_equal(np.unique(inner.segment), np.arange(6))


def test_edges_stand_where_the_part_ends():
    """The uppermost lit points of the rod's side are at its height, the lowest ones on the table, to 0.03 px."""
    rig = build_rig((320, 240))
    trace = trace_stripe(rig, _scene(rig, "rod"), edge_px=0.0, spacing_px=0.01)
    heights = [trace.points_base[trace.segment == k][:, 2] for k in np.unique(trace.segment)]
    side = next(z for z in heights if np.ptp(z) > 20)
    assert 35.0 - 0.02 < side.max() <= 35.0 + 1e-9
    assert -1e-9 <= side.min() < 0.02


def test_a_bowed_sheet_sags_by_the_stated_amount_at_its_ends():
    laser = replace(build_rig().laser, bow_mm=0.3, fan_deg=50.0, waist_mm=210.0)
    half = np.radians(25.0)
    angles = np.array([-half, -half / 2, 0.0, half / 2, half])
    x, y = sheet_rays(laser, angles).T
    np.testing.assert_allclose(np.arctan(x), angles)
    for distance, sag in ((210.0, 0.3), (420.0, 0.6)):  # from the laser, in its plane
        np.testing.assert_allclose(
            distance * y / np.hypot(1.0, x), sag * np.array([1.0, 0.25, 0.0, 0.25, 1.0]), atol=1e-12
        )


def test_a_bowed_sheet_leaves_the_plane_on_the_parts():
    rig = build_rig((160, 120))
    bowed = replace(rig, laser=replace(rig.laser, bow_mm=0.5))
    trace = trace_stripe(bowed, _scene(rig, "rod"))
    assert np.abs(sheet_distance(bowed.laser, trace.points_base)).max() < 1e-10
    off = rig.laser.plane_base.signed_distance_to(trace.points_base)
    assert off.max() > 0.02
    assert off.min() > -1e-9


def test_there_is_no_light_beyond_the_fan():
    rig = build_rig((320, 240))
    narrow = replace(rig, laser=replace(rig.laser, fan_deg=6.0))
    points = trace_stripe(narrow, [table_disc(rig)], edge_px=0.0).points_base
    to_points = points - rig.laser.position_base
    angle = np.arccos(to_points @ rig.laser.beam_base / np.linalg.norm(to_points, axis=1))
    assert len(points) > 30
    assert np.degrees(angle.max()) == pytest.approx(3.0, abs=0.1)


def test_width_is_that_of_the_sheet_on_the_surface_of_the_lens_and_of_the_pixels():
    """Where the sheet falls at an angle on the table, its foot is wider than the sheet; lens and pixels add their blur."""
    rig = build_rig((640, 480))
    bare = replace(rig, optics=Optics(blur_px=0.0))
    table = [table_disc(rig)]
    sharp, blurred = trace_stripe(bare, table), trace_stripe(rig, table)
    np.testing.assert_allclose(blurred.width_px, np.hypot(sharp.width_px, 0.8), rtol=1e-9)
    foot_px = np.sqrt(sharp.width_px**2 - 1 / 12)  # without the area of the pixels
    # the profile's flank one sigma away from the sheet, on the table
    plane = rig.laser.plane_base
    shift = (
        rig.laser.sigma_mm
        / np.hypot(*plane.normal[:2])
        * np.append(plane.normal[:2], 0.0)
        / np.hypot(*plane.normal[:2])
    )
    flank = rig.camera.project(rig.camera_from_base.apply(sharp.points_base + shift))
    across = ((flank - sharp.uv) * sharp.normal).sum(axis=1)
    np.testing.assert_allclose(foot_px, np.abs(across), rtol=0.01)


def test_brightness_falls_with_exposure_and_faint_points_are_lost():
    rig = build_rig((160, 120))
    dim = replace(rig, light=replace(rig.light, exposure_on_ms=rig.light.exposure_on_ms / 4))
    bright, dimmed = (trace_stripe(r, _scene(rig, "rod"), min_intensity_dn=0.0) for r in (rig, dim))
    np.testing.assert_allclose(dimmed.intensity_dn * 4, bright.intensity_dn)
    assert not bright.saturated.any()
    strong = trace_stripe(replace(rig, light=replace(rig.light, exposure_on_ms=1e3)), _scene(rig, "rod"))
    assert strong.saturated.all()
    assert strong.intensity_dn.max() <= 253.0
    limit = float(np.median(bright.intensity_dn))
    kept = trace_stripe(rig, _scene(rig, "rod"), min_intensity_dn=limit)
    assert 0 < len(kept.uv) < 0.7 * len(bright.uv)
    assert kept.intensity_dn.min() >= limit


def test_no_stripe_where_there_is_nothing_to_see():
    rig = build_rig((160, 120))
    assert len(trace_stripe(rig, []).uv) == 0
    away = [Placed(Ball(10.0), mount(500.0, 0.0))]
    assert len(trace_stripe(rig, away).uv) == 0
