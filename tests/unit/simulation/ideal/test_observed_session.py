"""Frames of an observed session: which have what, where the true points are, and the noise."""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.simulation.ideal.observed_session import trace_session
from rotaline.simulation.parts.boards import Plate
from rotaline.simulation.rig import Mechanics, build_rig
from rotaline.simulation.small_session import small_plan

RIG = build_rig((320, 240))
PLAN = small_plan(RIG, captures=("camera", "laser", "axis", "ball"))


@pytest.fixture(scope="module")
def ideal():
    return trace_session(RIG, PLAN)


def test_every_shot_has_its_frame_with_what_it_shows(ideal):
    observed = ideal.observed(0.0, 0.0, 1)
    assert list(observed) == ["camera", "laser", "axis", "ball"]
    for capture in PLAN.captures:
        frames = observed[capture.folder]
        assert len(frames) == len(capture.shots)
        for frame, shot in zip(frames, capture.shots, strict=True):
            assert (frame.angle_deg, frame.pose, frame.laser_on) == (shot.angle_deg, shot.pose, shot.laser)
            assert (frame.stripe is not None) == shot.laser
            assert (frame.detection is not None) == (not shot.laser)
            if frame.stripe is not None:
                assert len(frame.stripe) > 20


def test_the_points_are_those_of_the_print_in_its_true_place():
    """A plate with a wrong pitch is seen as it is, and stated as it should be."""
    capture = PLAN.captures[0]
    wrong = [
        replace(shot, held=tuple(replace(p, shape=Plate(p.shape.target, pitch_error=0.002)) for p in shot.held))
        for shot in capture.shots
    ]
    plan = replace(PLAN, captures=(replace(capture, shots=tuple(wrong)),))
    frames = trace_session(RIG, plan).observed(0.0, 0.0, 1)["camera"]
    for frame, shot in zip(frames, wrong, strict=True):
        target = frame.detection.target
        assert target == shot.held[0].shape.target
        points = shot.held[0].frame_from_part.apply(target.points_board() * 1.002)
        expected = RIG.camera.project(RIG.camera_from_base.apply(points))
        np.testing.assert_allclose(frame.detection.uv, expected[frame.detection.point_ids], atol=1e-9)


def test_plates_on_the_table_turn_with_it_as_it_truly_does(ideal):
    shaky = replace(RIG, mechanics=Mechanics(angle_eccentricity_deg=1.0))
    still, moved = (session.observed(0.0, 0.0, 1)["axis"] for session in (ideal, trace_session(shaky, PLAN)))
    for a, b in zip(still, moved, strict=True):
        angle = np.sin(np.radians(a.angle_deg))
        shift = np.abs(a.detection.uv - b.detection.uv).max()
        assert shift < 1e-9 if abs(angle) < 1e-12 else shift > 0.3 * angle
        assert a.angle_deg == b.angle_deg


def test_noise_has_the_stated_size_and_depends_on_the_seed(ideal):
    true, noisy, again, other = (
        ideal.observed(*noise) for noise in ((0.0, 0.0, 1), (0.1, 0.05, 2), (0.1, 0.05, 2), (0.1, 0.05, 3))
    )
    shifts = np.concatenate(
        [b.detection.uv - a.detection.uv for a, b in zip(true["camera"], noisy["camera"], strict=True)]
    )
    np.testing.assert_allclose(shifts.std(axis=0), 0.1, rtol=4 / np.sqrt(2 * len(shifts)))
    assert noisy["camera"][0].detection.u_px == 0.1
    np.testing.assert_array_equal(noisy["ball"][3].stripe.uv, again["ball"][3].stripe.uv)
    np.testing.assert_array_equal(noisy["axis"][3].detection.uv, again["axis"][3].detection.uv)
    assert np.abs(noisy["axis"][3].detection.uv - other["axis"][3].detection.uv).max() > 0.05
    assert np.all(noisy["laser"][1].stripe.u_normal_px == 0.05)


def test_the_stripe_lies_on_the_plate(ideal):
    for shot, frame in zip(PLAN.captures[1].shots, ideal.observed(0.0, 0.0, 1)["laser"], strict=True):
        if not shot.laser:
            continue
        plane = RIG.laser_plane_camera
        rays = RIG.camera.rays(frame.stripe.uv)
        points = rays * (-plane.offset / (rays @ plane.normal))[:, None]
        board_from_camera = (RIG.camera_from_base * shot.held[0].frame_from_part).inv()
        on_board = board_from_camera.apply(points)
        assert np.abs(on_board[:, 2]).max() < 1e-9


def test_a_plate_out_of_view_is_not_detected():
    capture = PLAN.captures[0]
    shot = capture.shots[0]
    away = replace(shot.held[0], frame_from_part=shot.held[0].frame_from_part)
    away = away.moved(type(away.frame_from_part).from_translation([500.0, 0.0, 0.0]))
    plan = replace(PLAN, captures=(replace(capture, shots=(replace(shot, held=(away,)), replace(shot, held=()))),))
    frames = trace_session(RIG, plan).observed(0.0, 0.0, 1)["camera"]
    assert [frame.detection for frame in frames] == [None, None]
