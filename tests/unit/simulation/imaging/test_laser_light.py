"""The laser sheet: profile, energy, fan, bow; and what surfaces send back of it."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.geometry.primitives import Plane, unit
from rotaline.simulation.imaging.laser_light import reflected, sheet_distance, sheet_light, sheet_sigma_mm
from rotaline.simulation.parts.material import Material
from rotaline.simulation.rig import Laser

# the beam goes along z, the fan opens along x, the sheet is the plane y = 0
LASER = Laser(
    Plane(np.array([0.0, 1.0, 0.0]), 0.0),
    np.zeros(3),
    np.array([0.0, 0.0, 1.0]),
    sigma_mm=0.1,
    waist_mm=200.0,
    divergence_mrad=2.0,
    fan_deg=60.0,
)


def _fan_point(angle_deg, distance, off=0.0):
    angle = np.radians(angle_deg)
    return np.array([[distance * np.sin(angle), off, distance * np.cos(angle)]])


def test_the_profile_is_gaussian_and_one_in_the_middle_of_the_waist():
    off = np.linspace(-0.3, 0.3, 31)
    points = np.column_stack([np.zeros(31), off, np.full(31, 200.0)])
    np.testing.assert_allclose(sheet_light(LASER, points), np.exp(-0.5 * (off / 0.1) ** 2), rtol=1e-12)


@pytest.mark.parametrize("distance", [100.0, 200.0, 350.0])
def test_the_sheet_keeps_its_energy(distance):
    """Across the sheet and along an arc of the fan the light adds up to the same at every distance."""
    off = np.linspace(-5.0, 5.0, 20001)
    points = np.column_stack([np.zeros(off.size), off, np.full(off.size, distance)])
    across = sheet_light(LASER, points).sum() * (off[1] - off[0])
    assert across * distance == pytest.approx(0.1 * np.sqrt(2 * np.pi) * 200.0, rel=1e-4)
    width = np.sqrt((sheet_light(LASER, points) * off**2).sum() / sheet_light(LASER, points).sum())
    assert width == pytest.approx(np.hypot(0.1, 0.002 * abs(distance - 200.0)), rel=1e-3)
    assert sheet_sigma_mm(LASER, np.array([distance]))[0] == pytest.approx(width, rel=1e-3)


def test_the_fan_ends_softly_at_the_stated_angle():
    angles = np.linspace(-40.0, 40.0, 801)
    light = np.array([sheet_light(LASER, _fan_point(a, 200.0))[0] for a in angles])
    assert np.all(light[np.abs(angles) > 30.0001] == 0.0)
    np.testing.assert_allclose(light[np.abs(angles) < 29.499], 1.0)
    assert np.abs(np.diff(light)).max() < 0.4
    assert sheet_light(LASER, np.array([[0.0, 0.0, -200.0]]))[0] == 0.0


@pytest.mark.parametrize("distance", [100.0, 200.0, 320.0])
def test_the_bow_is_the_sag_at_the_ends_of_the_fan(distance):
    bowed = replace(LASER, bow_mm=0.4)
    sag = 0.4 * distance / 200.0
    for angle_deg, share in ((-30.0, 1.0), (0.0, 0.0), (15.0, 0.25), (30.0, 1.0)):
        on_sheet = _fan_point(angle_deg, distance, share * sag)
        assert sheet_distance(bowed, on_sheet)[0] == pytest.approx(0.0, abs=1e-12)
        assert sheet_distance(bowed, on_sheet + np.array([0.0, 0.07, 0.0]))[0] == pytest.approx(0.07)
        assert sheet_distance(LASER, on_sheet)[0] == pytest.approx(share * sag)


@given(st.floats(-0.5, 0.5), st.floats(50.0, 500.0), st.floats(-2.0, 2.0), st.integers(0, 1000))
@settings(deadline=None, max_examples=40)
def test_the_sheet_is_the_same_in_every_pose(angle, length, bow, seed):
    rng = np.random.default_rng(seed)
    normal = unit(rng.standard_normal(3))
    position = 50.0 * rng.standard_normal(3)
    beam = unit(np.cross(normal, rng.standard_normal(3)))
    laser = replace(
        LASER, plane_base=Plane(normal, -float(normal @ position)), position_base=position, beam_base=beam, bow_mm=bow
    )
    in_plane = position + length * (np.cos(angle) * beam + np.sin(angle) * np.cross(normal, beam))
    sag = bow * length / 200.0 * (angle / np.radians(30.0)) ** 2
    assert sheet_distance(laser, (in_plane + sag * normal)[None])[0] == pytest.approx(0.0, abs=1e-9)
    assert sheet_distance(laser, (in_plane - normal)[None])[0] == pytest.approx(-1.0 - sag, abs=1e-9)


def _directions(n=40000):
    """Even directions over the half sphere about z."""
    i = np.arange(n) + 0.5
    z, turn = i / n, np.pi * (1 + np.sqrt(5)) * i
    r = np.sqrt(1 - z * z)
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), z])


@pytest.mark.parametrize("incidence_deg", [0.0, 30.0, 60.0, 80.0])
@pytest.mark.parametrize("width_deg", [3.0, 12.0, 40.0])
def test_no_surface_sends_back_more_than_falls_on_it(incidence_deg, width_deg):
    views = _directions()
    angle = np.radians(incidence_deg)
    light = np.broadcast_to(np.array([np.sin(angle), 0.0, np.cos(angle)]), views.shape)
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), views.shape)
    for albedo, gloss in ((0.8, 0.0), (0.0, 0.6)):
        radiance = reflected(Material(0.5, gloss, width_deg), np.full(len(views), albedo), up, light, views)
        # of a white surface that faces the light, the same sum is pi
        share = 2 * np.pi * (radiance * views[:, 2]).mean() / np.pi / np.cos(angle)
        assert share <= (albedo + gloss) * 1.01
        if gloss == 0.0:
            assert share == pytest.approx(albedo, rel=1e-3)
        elif incidence_deg <= 30.0 and width_deg <= 12.0:
            assert share > 0.8 * gloss


def test_the_lobe_is_as_wide_as_stated_about_the_mirror_direction():
    incidence = np.radians(25.0)
    turn = np.radians(np.linspace(-30.0, 30.0, 601))
    views = np.column_stack([np.sin(turn - incidence), np.zeros(601), np.cos(turn - incidence)])
    light = np.broadcast_to(np.array([np.sin(incidence), 0.0, np.cos(incidence)]), views.shape)
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), views.shape)
    lobe = reflected(Material(0.5, 0.3, 5.0), np.zeros(601), up, light, views)
    assert abs(np.degrees(turn[lobe.argmax()])) < 1.0
    mean = (lobe * turn).sum() / lobe.sum()
    assert np.degrees(np.sqrt((lobe * (turn - mean) ** 2).sum() / lobe.sum())) == pytest.approx(5.0, rel=0.1)


def test_light_and_view_are_the_same_the_other_way_round():
    views = _directions(500)
    light = np.roll(views, 137, axis=0)
    up = np.broadcast_to(np.array([0.0, 0.0, 1.0]), views.shape)
    shiny = Material(0.4, 0.5, 15.0)
    there = reflected(shiny, np.full(500, 0.4), up, light, views) / light[:, 2]
    back = reflected(shiny, np.full(500, 0.4), up, views, light) / views[:, 2]
    np.testing.assert_allclose(there, back, rtol=1e-9)


def test_nothing_comes_from_behind():
    up, side = np.array([[0.0, 0.0, 1.0]]), np.array([unit(np.array([1.0, 0.0, -0.1]))])
    for light, view in ((side, up), (up, side)):
        assert reflected(Material(0.8, 0.5), np.array([0.8]), up, light, view)[0] == 0.0
