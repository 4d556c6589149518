"""Plates are held in view, sharp and lit, whatever the rig; where that cannot be, the message says why."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.errors import RigError
from rotaline.simulation.parts.boards import Plate
from rotaline.simulation.plan import axis_capture, camera_capture, laser_capture, table_disc
from rotaline.simulation.poses import in_image, is_sharp
from rotaline.simulation.rig import Optics, build_rig
from rotaline.simulation.small_session import small_plan
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid

BOARD = Checkerboard((14, 9), 4.5)
ARTICLE_BOARD = Checkerboard((18, 16), 4.0)
DOTS = DotGrid((9, 9), 6.0, 3.0)
CHARUCO = CharucoBoard((12, 9), 8.0, 6.0, "DICT_5X5_100")
ANGLES_DEG = tuple(4.0 * i for i in range(11))


def _with_focal_length(rig, factor):
    camera = rig.camera
    return replace(rig, camera=replace(camera, fx=camera.fx * factor, fy=camera.fy * factor))


RIGS = {
    "landscape": build_rig((1280, 960)),
    "portrait, camera to the left": build_rig((960, 1280), camera_side=1),
    "camera on its side": build_rig((1280, 960), roll_deg=90.0),
    "upside down, wide image": build_rig((1920, 1080), roll_deg=180.0, camera_side=1),
    "small image": build_rig((320, 240), roll_deg=-90.0, turn_sense=-1),
    "twice as far": build_rig((2448, 2048), distance=600.0),
    "wide view": _with_focal_length(build_rig((1280, 960)), 0.5),
    "little depth of field": replace(build_rig((1280, 960)), optics=Optics(focus_mm=300.0, f_number=2.0)),
}


FOLDING = replace(RIGS["landscape"], camera=replace(RIGS["landscape"].camera, k1=-0.3, k2=0.0))
"""What is far outside the view is projected into the image."""


def _rim_camera(rig, placed, base_from_frame=None):
    """Points all along the rim of the print, camera frame."""
    plate = placed.shape
    columns, rows = plate.target.grid_size
    s = np.linspace(-1.0, 1.0, 21)
    one = np.ones(21)
    square = np.vstack([np.column_stack(side) for side in ((s, -one), (s, one), (-one, s), (one, s))])
    grid = (square + 1) / 2 * [columns + 1, rows + 1] - 1
    xy = grid * plate.target.pitch
    base_from_board = placed.frame_from_part if base_from_frame is None else base_from_frame * placed.frame_from_part
    return (rig.camera_from_base * base_from_board).apply(np.column_stack([xy, plate.heights(xy)]))


def _assert_in_view(rig, placed, base_from_frame=None):
    rim = _rim_camera(rig, placed, base_from_frame)
    assert np.all(rim[:, 2] > 0)
    uv = rig.camera.project(rim)
    assert np.all((uv >= 0) & (uv <= np.array(rig.camera.image_size) - 1))
    assert np.all(is_sharp(rig, placed.shape, rim[:, 2]))


def _towards_camera(rig, placed):
    """Cosine of the angle between the plate's front and the direction to the camera."""
    pose = rig.camera_from_base * placed.frame_from_part
    centre = pose.apply(placed.shape.centre_board()[None])[0]
    return pose.rotation.as_matrix()[:, 2] @ centre / np.linalg.norm(centre)


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("target", [BOARD, ARTICLE_BOARD, DOTS])
def test_views_for_the_camera_cover_the_image(name, target):
    rig = RIGS[name]
    capture = camera_capture(rig, target, "t", 15, 1)
    assert len(capture.shots) == 15
    points = []
    for shot in capture.shots:
        (placed,) = shot.held
        _assert_in_view(rig, placed)
        pose = rig.camera_from_base * placed.frame_from_part
        tilt_deg = np.degrees(np.arccos(pose.rotation.as_matrix()[2, 2]))
        assert 20 <= tilt_deg <= 42
        points.append(rig.camera.project(pose.apply(target.points_board())))
    covered = np.ptp(np.vstack(points), axis=0) / rig.camera.image_size
    assert np.all(covered > 0.7)


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("target", [BOARD, ARTICLE_BOARD, DOTS, CHARUCO])
def test_plates_in_the_laser_sheet_are_lit_and_seen_and_the_stripe_crosses_them(name, target):
    rig = RIGS[name]
    capture = laser_capture(rig, target, "t", 8, 1)
    assert [(shot.laser, shot.pose) for shot in capture.shots[:3]] == [(False, "0"), (True, "0"), (False, "1")]
    centres = []
    for shot in capture.shots[::2]:
        (placed,) = shot.held
        if target is not CHARUCO:
            _assert_in_view(rig, placed)
        pose = placed.frame_from_part
        centres.append(pose.apply(placed.shape.centre_board()[None])[0])
        assert abs(rig.laser.plane_base.signed_distance_to(centres[-1][None])[0]) < 1e-6
        front = -pose.rotation.as_matrix()[:, 2]
        to_laser = rig.laser.position_base - centres[-1]
        assert front @ to_laser > 0.4 * np.linalg.norm(to_laser)
        assert _towards_camera(rig, placed) > 0.6
        stripe = np.cross(front, rig.laser.plane_base.normal)
        along_columns = abs(stripe @ pose.rotation.as_matrix()[:, 1]) / np.linalg.norm(stripe)
        assert along_columns > 0.9 or (target.grid_size[0] != target.grid_size[1] and along_columns < 0.4)
    assert np.linalg.norm(np.ptp(centres, axis=0)) > 15.0, "not all in one place"


@pytest.mark.parametrize("name", RIGS)
@pytest.mark.parametrize("target", [BOARD, ARTICLE_BOARD, DOTS])
def test_the_plate_on_the_table_is_in_view_at_all_angles(name, target):
    rig = RIGS[name]
    capture = axis_capture(rig, target, "t", ANGLES_DEG)
    assert [shot.angle_deg for shot in capture.shots] == list(ANGLES_DEG)
    for shot in capture.shots:
        placed, disc = shot.on_table
        assert disc.shape == table_disc(rig).shape
        _assert_in_view(rig, placed, rig.base_from_table(shot.angle_deg))
    corners_table = placed.frame_from_part.apply(placed.shape.corners_board())
    assert 0 < corners_table[:, 2].min() < 20
    middle = placed.moved(rig.base_from_table(20.0))
    assert _towards_camera(rig, middle) > max(
        _towards_camera(rig, placed.moved(rig.base_from_table(angle))) for angle in (0.0, 40.0)
    )


@given(
    size=st.tuples(st.integers(160, 4000), st.integers(160, 4000)),
    side=st.sampled_from([-1, 1]),
    roll_deg=st.floats(-180, 180),
    distance=st.floats(150, 600),
    seed=st.integers(0, 100),
)
@settings(max_examples=6, deadline=None)
def test_a_plan_is_in_view_or_there_is_none(size, side, roll_deg, distance, seed):
    rig = build_rig(size, camera_side=side, roll_deg=roll_deg, distance=distance)
    for make in (camera_capture, laser_capture):
        for shot in make(rig, BOARD, "t", 4, seed).shots:
            _assert_in_view(rig, shot.held[0])


def test_a_large_target_is_held_farther_away():
    near, far = (camera_capture(RIGS["landscape"], Checkerboard(n, 4.5), "t", 6, 1) for n in ((8, 6), (24, 19)))
    depths = [
        np.mean(
            [
                np.linalg.norm(
                    s.held[0].frame_from_part.translation - RIGS["landscape"].camera_from_base.inv().translation
                )
                for s in c.shots
            ]
        )
        for c in (near, far)
    ]
    assert depths[1] > 1.08 * depths[0]
    for shot in far.shots:
        _assert_in_view(RIGS["landscape"], shot.held[0])


def test_a_charuco_board_may_leave_the_view_where_a_checkerboard_may_not():
    rig = _with_focal_length(RIGS["landscape"], 1.5)
    capture = laser_capture(rig, CHARUCO, "t", 5, 1)
    shares = []
    for shot in capture.shots:
        pose = rig.camera_from_base * shot.held[0].frame_from_part
        shares.append(in_image(rig.camera, pose.apply(CHARUCO.points_board())).mean())
    assert 0.6 <= min(shares) < 1.0
    with pytest.raises(RigError, match=r"^Capture laser, target t: only \d of 5 poses"):
        laser_capture(rig, Checkerboard((11, 8), 8.0), "t", 5, 1)


def test_the_seed_fixes_the_poses():
    def poses(make, seed):
        return np.array(
            [s.held[0].frame_from_part.as_matrix() for s in make(RIGS["landscape"], DOTS, "t", 5, seed).shots]
        )

    for make in (camera_capture, laser_capture):
        np.testing.assert_array_equal(poses(make, 3), poses(make, 3))
        assert np.all(np.abs(poses(make, 3) - poses(make, 4)).max(axis=(1, 2)) > 0.01)


def test_a_plate_with_errors_is_recorded_as_it_is():
    plate = Plate(DOTS, pitch_error=1e-3, print_offset_um=10.0, flatness_um=80.0)
    rig = RIGS["landscape"]
    for capture in (
        camera_capture(rig, plate, "dots", 2, 1),
        laser_capture(rig, plate, "dots", 2, 1),
        axis_capture(rig, plate, "dots", ANGLES_DEG),
    ):
        for shot in capture.shots:
            assert (*shot.held, *shot.on_table)[0].shape == plate


def test_a_distortion_that_folds_does_not_bring_outside_points_into_view():
    camera = CameraModel((640, 480), 600.0, 600.0, 320.0, 240.0, k1=-0.5)
    points_camera = 300.0 * np.array([[0.1, 0.0, 1.0], [1.2, 0.0, 1.0], [0.1, 0.0, -1.0]])
    folded = camera.project(points_camera)[1]
    assert np.all((folded > 0) & (folded < camera.image_size))
    assert in_image(camera, points_camera).tolist() == [True, False, False]
    assert in_image(camera, points_camera, margin_px=300.0).tolist() == [False] * 3


def _looking_away(rig):
    turn = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, np.pi, 0.0]))
    return replace(rig, camera_from_base=turn * rig.camera_from_base)


@pytest.mark.parametrize(
    ("rig", "make", "target", "text"),
    [
        (FOLDING, camera_capture, Checkerboard((18, 16), 40.0), r"768 x 688 mm.*smaller"),
        (RIGS["landscape"], camera_capture, Checkerboard((40, 30), 8.0), r"336 x 256 mm.* sees 128 x 96 mm.*smaller"),
        (
            RIGS["landscape"],
            laser_capture,
            Checkerboard((20, 15), 8.0),
            r"176 x 136 mm; at a distance of 302 mm .* sees",
        ),
        (_looking_away(RIGS["landscape"]), camera_capture, BOARD, "looks away from the table.*302 mm behind it"),
        (_looking_away(RIGS["landscape"]), laser_capture, BOARD, "looks away"),
        (
            replace(RIGS["landscape"], optics=Optics(focus_mm=300.0, f_number=0.2)),
            camera_capture,
            BOARD,
            r"sharp from \d+ to \d+ mm",
        ),
        (
            replace(RIGS["landscape"], laser=replace(RIGS["landscape"].laser, fan_deg=5.0)),
            laser_capture,
            DOTS,
            r"fan of the laser \(5 deg\)",
        ),
    ],
)
def test_what_cannot_be_planned_is_explained(rig, make, target, text):
    with pytest.raises(RigError, match=r"(?s)^Capture (camera|laser), target cal: .*" + text):
        make(rig, target, "cal", 5, 1)


def test_a_plate_that_turns_out_of_view_is_explained():
    with pytest.raises(
        RigError, match=r"in view and sharp in \d+ of 10 frames at best \(0 to 324 deg\).*turn the table less"
    ):
        axis_capture(RIGS["landscape"], BOARD, "cal", tuple(36.0 * i for i in range(10)))


@pytest.mark.parametrize("camera_side", [-1, 1])
@pytest.mark.parametrize("roll_deg", [0.0, 90.0, 180.0])
def test_boards_of_a_small_session_are_wholly_in_view(camera_side, roll_deg):
    rig = build_rig((640, 480), camera_side=camera_side, roll_deg=roll_deg)
    for capture in small_plan(rig, captures=("camera", "laser", "axis")).captures:
        if capture.role in ("camera", "laser-plane", "axis"):
            for shot in capture.shots:
                for placed in shot.held or shot.on_table[:1]:
                    _assert_in_view(rig, placed, rig.base_from_table(shot.angle_deg or 0.0))
