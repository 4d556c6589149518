"""What a preview shows of a target, and what a person is told: against plates of the simulated rig whose poses are known."""

import csv
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.io.acquired_session import COLUMNS
from rotaline.io.plan_file import parse_plan
from rotaline.pipeline.acquire import guidance
from rotaline.pipeline.acquire.earlier_poses import earlier_views, target_of
from rotaline.pipeline.acquire.guidance import Goal, Guide, Rest, followed, judged, moved_meanwhile, zone_name
from rotaline.pipeline.acquire.sighting import (
    EDGES,
    crosses,
    focal_px,
    look,
    motion_px,
    stripe_level,
    stripe_on,
    view_of,
)
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.imaging.render import Moment, render_exposure
from rotaline.simulation.parts.boards import Plate
from rotaline.simulation.rig import build_rig
from rotaline.vision.images import encode_png
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid

RIG = build_rig((480, 360))
SIZE = RIG.camera.image_size
FOCAL = RIG.camera.fx
CHECKERBOARD, DOTS = Checkerboard((10, 7), 5.0), DotGrid((9, 9), 5.0, 2.5)
CHARUCO = CharucoBoard((9, 7), 7.0, 4.0, "DICT_4X4_50")
TURNS = {"upper": (1, 0, 0), "right": (0, 1, 0), "lower": (-1, 0, 0), "left": (0, -1, 0)}
DEPTH_MM = 290.0


def held(target, edge="upper", tilt_deg=0.0, at=(0.5, 0.5), depth_mm=DEPTH_MM, roll_deg=0.0):
    """The plate with its middle at a place of the image (shares of it), and one edge tilted towards the camera."""
    columns, rows = target.grid_size
    middle = np.array([(columns - 1) / 2, (rows - 1) / 2, 0.0]) * target.pitch
    ray = RIG.camera.rays(np.array([at]) * SIZE - 0.5)[0]
    turn = Rotation.from_rotvec(np.radians(tilt_deg) * np.array(TURNS[edge]))
    rotation = turn * Rotation.from_rotvec([0.0, 0.0, math.radians(roll_deg)])
    camera_from_board = RigidTransform.from_components(ray / ray[2] * depth_mm - rotation.apply(middle), rotation)
    return Placed(Plate(target), RIG.camera_from_base.inv() * camera_from_board)


def picture(*plates, exposure=1.0, laser=0.0, seed=1):
    """A frame in which the plate is in each of these places for an equal time."""
    moments = [Moment([plate], laser, RIG.light.ambient_e_per_ms) for plate in plates]
    return render_exposure(RIG, moments, exposure_ms=exposure * RIG.light.exposure_off_ms, seed=seed)


def view(target=CHECKERBOARD, **where):
    return view_of(look(picture(held(target, **where)), target).detection)


@pytest.fixture(scope="module")
def seen():
    return look(picture(held(CHECKERBOARD)), CHECKERBOARD, 1.0)


# what a preview shows


@pytest.mark.parametrize("target", [CHECKERBOARD, DOTS, CHARUCO], ids=lambda t: type(t).__name__)
@pytest.mark.parametrize("sigma_px", [0.0, 1.0])
def test_the_blur_of_edges_is_measured_for_each_kind_of_target(target, sigma_px):
    plate = held(target, "right", 30.0, roll_deg=25.0)
    sharp = picture(plate)
    blurred = gaussian_filter(sharp.astype(float), sigma_px).round().astype(np.uint8) if sigma_px else sharp
    blur = look(blurred, target).blur
    # the rig's own blur, a pixel's area and linear interpolation (1/12 + 1/6 px^2), and what was added
    expected = math.sqrt(RIG.optics.blur_px**2 + 0.25 + sigma_px**2)
    assert blur.most_px == pytest.approx(expected, rel=0.12)
    assert blur.least_px == pytest.approx(expected, rel=0.12)
    assert not blur.of_motion


def test_motion_is_told_from_defocus():
    defocused = look(gaussian_filter(picture(held(CHECKERBOARD)).astype(float), 2.2).astype(np.uint8), CHECKERBOARD)
    way = np.linspace(-0.007, 0.007, 9)
    moving = look(picture(*[held(CHECKERBOARD, at=(0.5 + d, 0.5)) for d in way]), CHECKERBOARD)
    assert not defocused.blur.sharp
    assert not defocused.blur.of_motion
    assert moving.blur.of_motion
    assert moving.blur.most_px == pytest.approx(SIZE[0] * 0.014 * 9 / 8 / math.sqrt(2 * math.pi), rel=0.1)
    assert judged(defocused) is None
    assert "blurred by motion" in judged(moving)


def test_light_is_measured_on_the_target():
    assert look(picture(held(DOTS)), DOTS).light.white == pytest.approx(0.62, abs=0.06)
    assert look(picture(held(DOTS), exposure=0.2), DOTS).light.white < 0.2
    assert look(picture(held(DOTS), exposure=4.0), DOTS).light.saturated > 0.9


def test_what_is_not_there_is_not_found():
    nothing = look(picture(held(CHECKERBOARD, at=(1.5, 0.5))), CHECKERBOARD)
    assert nothing.detection is None
    assert "No checkerboard" in nothing.missing
    assert "not found" in judged(nothing)


@pytest.mark.parametrize("target", [CHECKERBOARD, DOTS], ids=lambda t: type(t).__name__)
@pytest.mark.parametrize("edge", EDGES)
def test_tilt_and_nearest_edge_are_right_without_a_calibrated_camera(target, edge):
    guide = Guide("camera", SIZE, 20)
    attitude = guide.attitude(view(target, edge=edge, tilt_deg=28.0, at=(0.45, 0.55), roll_deg=15.0))
    assert attitude.nearest == edge
    assert attitude.tilt_deg == pytest.approx(28.0, abs=3.0)


def test_a_few_tilted_plates_give_the_focal_length_and_none_gives_a_guess():
    views = [view(edge=e, tilt_deg=30.0) for e in EDGES]
    assert focal_px(views, SIZE) == pytest.approx(FOCAL, rel=0.03)
    assert focal_px([], SIZE) == 2.0 * SIZE[0]
    distance = Guide("camera", SIZE, 20, tuple(views)).attitudes[0].distance_mm
    assert distance == pytest.approx(DEPTH_MM, rel=0.04)


@pytest.mark.parametrize(("shift_px", "refused"), [(0.0, False), (0.2, False), (0.7, True), (5.0, True)])
def test_frames_between_which_the_target_moved_are_refused(shift_px, refused):
    before = look(picture(held(DOTS)), DOTS)
    after = look(picture(held(DOTS, at=(0.5 + shift_px / SIZE[0], 0.5)), seed=2), DOTS)
    why = moved_meanwhile(before, after)
    assert (why is not None) == refused
    if why is not None:
        assert float(why.split("moved by ")[1].split(" px")[0]) == pytest.approx(shift_px, abs=0.15)


def test_a_target_that_was_taken_away_meanwhile_is_noticed():
    before = look(picture(held(DOTS)), DOTS)
    assert "not found any more" in moved_meanwhile(before, look(picture(held(DOTS, at=(1.5, 0.5))), DOTS))


def test_motion_is_that_of_the_points_however_they_are_numbered(seen):
    moved = look(picture(held(CHECKERBOARD, at=(0.5 + 2.0 / SIZE[0], 0.5)), seed=2), CHECKERBOARD)
    turned = replace(moved, detection=replace(moved.detection, uv=moved.detection.uv[::-1]))
    assert motion_px(seen, moved) == pytest.approx(2.0, abs=0.2)
    assert motion_px(seen, turned) == pytest.approx(2.0, abs=0.2)
    nothing = look(np.zeros(SIZE[::-1], np.uint8), CHECKERBOARD)
    assert motion_px(seen, nothing) == math.inf


def in_the_sheet(shift_mm=0.0):
    """A plate in the light of the laser, moved out of it along its own row by so much."""
    from rotaline.simulation.plan import laser_capture

    shot = laser_capture(RIG, DOTS, "dots", 1, 1).shots[0]
    moved = shot.held[0].frame_from_part * RigidTransform.from_translation([shift_mm, 0.0, 0.0])
    return Placed(shot.held[0].shape, moved)


@pytest.mark.parametrize("room_light", [1.0, 0.02], ids=["room-light-stays", "room-light-goes"])
def test_the_stripe_on_a_target_is_found_whether_the_room_stays_lit_or_not(room_light):
    plate = in_the_sheet()
    off = picture(plate)
    found = look(off, DOTS).detection
    moment = Moment([plate], 1.0, room_light * RIG.light.ambient_e_per_ms)
    on = render_exposure(RIG, [moment], exposure_ms=RIG.light.exposure_off_ms, seed=3)
    stripe_uv = stripe_on(found, on, off)
    assert crosses(stripe_uv, found)
    lines = np.linalg.svd(stripe_uv - stripe_uv.mean(axis=0), compute_uv=False)
    assert lines[1] / math.sqrt(len(stripe_uv)) < 1.0
    assert not crosses(stripe_on(found, off, off), found)


def test_the_level_of_a_stripe_is_that_of_its_core():
    image = np.full((100, 200), 8, np.uint16)
    image[20:80, 50] = 40_000
    assert stripe_level(image) == pytest.approx(40_000 / 65_535)


# what is told


def test_a_goal_does_not_change_while_it_is_followed_and_asks_for_what_lacks(seen):
    guide = Guide("camera", SIZE, 20)
    assert guide.goal == Goal((1, 1), "upper")
    views = [view(edge=e, tilt_deg=25.0, at=at) for e in EDGES for at in ((0.5, 0.4), (0.45, 0.6))]
    middle = replace(guide, views=tuple(views))
    assert middle.tilts == dict.fromkeys(EDGES, 2)
    assert middle.goal.edge is None
    assert middle.goal.zone in {(0, 0), (2, 0), (0, 2), (2, 2)}
    before = middle.goal
    middle.advise(seen)
    assert middle.goal == before
    assert zone_name(before.zone) in before.text
    one_sided = replace(guide, views=tuple(views[:2]))
    assert one_sided.tilts["upper"] == 2
    assert one_sided.goal.edge != "upper"
    assert any("right, lower, left edge" in text for text in one_sided.lacks)


def test_following_the_goals_leaves_nothing_lacking():
    guide, taken = Guide("camera", SIZE, 20), 0
    while guide.lacks or not guide.views:
        zone, edge = guide.goal.zone, guide.goal.edge
        at = ((0.24, 0.5, 0.76)[zone[0]], (0.24, 0.5, 0.76)[zone[1]]) if zone else (0.5, 0.5)
        pose = view(edge=edge or "upper", tilt_deg=25.0 if edge else 5.0, at=at)
        assert guide.fills(pose)
        guide = guide.with_view(pose)
        taken += 1
        assert taken <= 12
    assert guide.share_covered > 0.6


def test_a_pose_that_was_taken_already_adds_nothing():
    guide = Guide("camera", SIZE, 20, (view(edge="left", tilt_deg=25.0), view(edge="upper", tilt_deg=25.0)))
    assert guide.like(view(edge="upper", tilt_deg=26.0)) == 2
    assert guide.like(view(edge="lower", tilt_deg=25.0)) is None
    assert guide.like(view(edge="upper", tilt_deg=25.0, at=(0.6, 0.5))) is None
    again = look(picture(held(CHECKERBOARD, "upper", 25.0)), CHECKERBOARD)
    long = Rest(again, replace(again, time_s=100.0))
    assert guide.advise(again, long).level == "move"
    assert "like pose 2" in guide.advise(again, long).text


def test_what_is_no_good_is_named_with_what_to_do():
    guide = Guide("camera", SIZE, 20)

    def advice(*plates, **light):
        said = guide.advise(look(picture(*plates, **light), CHECKERBOARD))
        assert said.level == "bad"
        return said.text

    assert "Dark" in advice(held(CHECKERBOARD), exposure=0.2)
    assert "Dark" in advice(held(CHECKERBOARD), exposure=0.01)
    assert "Too bright" in advice(held(CHECKERBOARD), exposure=4.0)
    assert "Too bright" in advice(held(CHECKERBOARD, depth_mm=120.0), exposure=40.0)
    assert "No checkerboard" in advice(held(CHECKERBOARD, at=(1.1, 0.5)))
    assert advice(held(CHECKERBOARD, at=(0.97, 0.5))).endswith("show all of it.")
    moving = advice(*[held(CHECKERBOARD, at=(0.5, 0.5 + d)) for d in np.linspace(-0.01, 0.01, 9)])
    assert "Blurred by" in moving
    assert "hold it still" in moving


def test_out_of_focus_says_where_it_was_sharp():
    views = tuple(view(edge=e, tilt_deg=25.0) for e in EDGES)
    far = picture(held(CHECKERBOARD, depth_mm=350.0))
    seen = look(gaussian_filter(far.astype(float), 2.0).astype(np.uint8), CHECKERBOARD)
    assert "nearer to the camera" in Guide("camera", SIZE, 20, views).advise(seen).text
    assert "nearer or farther" in Guide("camera", SIZE, 20).advise(seen).text


def test_a_pose_is_taken_once_it_has_been_at_rest_for_long_enough_by_the_clock():
    guide, rest, levels = Guide("camera", SIZE, 20), None, []
    for i, (time_s, shift) in enumerate([(0.0, 0.0), (0.3, 8.0), (0.5, 8.0), (1.0, 8.05), (1.29, 8.0), (1.31, 8.0)]):
        plate = held(CHECKERBOARD, "upper", 25.0, at=(0.5 + shift / SIZE[0], 0.5))
        seen = look(picture(plate, seed=i), CHECKERBOARD, time_s)
        rest = followed(rest, seen)
        levels.append(guide.advise(seen, rest).level)
    assert levels == ["hold", "hold", "hold", "hold", "hold", "take"]


@settings(max_examples=20)
@given(speed=st.floats(0.05, 3.0), step_s=st.floats(0.05, 0.4))
def test_what_creeps_is_not_at_rest(speed, step_s):
    rest, start = None, _bare([[100.0, 100.0], [200.0, 100.0], [100.0, 220.0]])
    for i in range(40):
        now = replace(
            start, time_s=i * step_s, detection=replace(start.detection, uv=start.detection.uv + speed * i * step_s)
        )
        rest = followed(rest, now)
        assert rest.seconds * speed * math.sqrt(2) <= guidance.REST_PX + 1e-6


def _bare(uv):
    from rotaline.pipeline.acquire.sighting import Light, Sighting
    from rotaline.vision.targets.model import TargetDetection

    found = TargetDetection(CHECKERBOARD, np.arange(len(uv)), np.array(uv), 0.01)
    return Sighting(SIZE, 0.0, Light(0.6, 0.0), found)


def test_a_pose_that_brings_nothing_is_taken_only_if_it_is_held_for_long():
    views = [view(edge=e, tilt_deg=25.0, at=at) for e in EDGES for at in ((0.5, 0.4), (0.45, 0.6))]
    guide = Guide("camera", SIZE, 20, tuple(views))
    seen = look(picture(held(CHECKERBOARD, "upper", 5.0)), CHECKERBOARD, 0.0)
    assert guide.advise(seen, Rest(seen, replace(seen, time_s=3.9))).level == "move"
    assert guide.advise(seen, Rest(seen, replace(seen, time_s=4.1))).level == "take"


def test_the_laser_plane_wants_distances_that_differ():
    guide = Guide("laser-plane", SIZE, 10)
    assert "where parts will stand" in guide.goal.text
    near, far = view(DOTS, depth_mm=250.0, tilt_deg=10.0), view(DOTS, depth_mm=330.0, tilt_deg=10.0)
    guide = guide.with_view(view(DOTS, tilt_deg=10.0))
    assert "as near to the camera" in guide.goal.text
    assert guide.lacks == ()
    assert guide.like(view(DOTS, depth_mm=293.0, tilt_deg=10.0, at=(0.6, 0.6))) == 1
    assert guide.like(near) is None
    guide = guide.with_view(near)
    assert "as far away" in guide.goal.text
    guide = guide.with_view(far)
    assert "nearer to the camera than the last one" in guide.goal.text
    flat = Guide("laser-plane", SIZE, 10, (near, near, near))
    assert flat.lacks == ("poses clearly nearer and farther",)
    assert "clearly nearer" in flat.goal.text


def test_a_stripe_beside_the_plate_is_named(seen):
    assert "stripe does not run over it" in Guide("laser-plane", SIZE, 10).advise(seen, None, True).text


def test_the_map_of_the_laser_plane_shows_where_the_stripe_was():
    line = np.stack([np.full(60, SIZE[0] / 2), np.linspace(100, 300, 60)], axis=1)
    guide = Guide("laser-plane", SIZE, 10, (view(DOTS).with_stripe(line),))
    assert set(np.flatnonzero(guide.covered.any(axis=0))) == {8}


PLAN = parse_plan(
    """version = 1
[targets.board]
kind = "checkerboard"
inner_corners = [10, 7]
pitch = 5.0
[targets.dots]
kind = "dots"
dots = [9, 9]
pitch = 5.0
diameter = 2.5
[[captures]]
folder = "camera"
role = "camera"
target = "board"
[[captures]]
folder = "laser"
role = "laser-plane"
target = "dots"
""",
    "plan.toml",
).tables


def _write(folder, rows):
    folder.mkdir()
    with (folder / "frames.csv").open("w", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        for i, (image, laser, pose) in enumerate(rows):
            writer.writerow({"image": f"{i}.png", "laser": laser, "pose": pose})
            if image is not None:
                (folder / f"{i}.png").write_bytes(encode_png(image))


def test_poses_of_an_earlier_start_count(tmp_path):
    camera, laser = PLAN.captures
    assert target_of(PLAN, camera) == CHECKERBOARD
    assert earlier_views(tmp_path, camera, CHECKERBOARD) == ()
    blank = np.zeros(SIZE[::-1], np.uint8)
    boards = [picture(held(CHECKERBOARD, e, 25.0)) for e in ("upper", "left")]
    _write(tmp_path / "camera", [(boards[0], "off", ""), (blank, "off", ""), (None, "off", ""), (boards[1], "off", "")])
    guide = Guide("camera", SIZE, 20, earlier_views(tmp_path, camera, CHECKERBOARD))
    assert guide.tilts == {"upper": 1, "right": 0, "lower": 0, "left": 1}
    plate = in_the_sheet()
    lit = render_exposure(RIG, [Moment([plate], 1.0, 0.0)], exposure_ms=RIG.light.exposure_on_ms, seed=1)
    _write(tmp_path / "laser", [(picture(plate), "off", "0"), (lit, "on", "0"), (picture(held(DOTS)), "off", "1")])
    first, second = earlier_views(tmp_path, laser, DOTS)
    assert len(first.stripe_uv) > 50
    assert second.stripe_uv is None
