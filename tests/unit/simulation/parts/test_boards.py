"""The print on the plates, looked up at places where its colour is known."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotaline.simulation.parts.boards import BACK, BLACK, WHITE, Plate
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid

FRONT = np.zeros(1, int)


def _albedo(plate, x, y):
    return plate.albedo(np.array([[x, y, 0.0]]), FRONT)[0]


def test_checkerboard_alternates_and_has_a_white_rim():
    plate = Plate(Checkerboard((5, 4), 3.0))
    for column in range(-1, 5):
        for row in range(-1, 4):
            expected = BLACK if (column + row) % 2 == 0 else WHITE
            assert _albedo(plate, (column + 0.5) * 3.0, (row + 0.5) * 3.0) == expected
    assert _albedo(plate, -3.5, -3.5) == WHITE


def test_dots_have_their_diameter():
    plate = Plate(DotGrid((4, 3), 5.0, 2.0))
    for x, y, expected in ((0.0, 0.0, BLACK), (5.98, 0.0, BLACK), (6.02, 0.0, WHITE), (15.0, 10.98, BLACK)):
        assert _albedo(plate, x, y) == expected
    assert _albedo(plate, 20.0, 0.0) == WHITE, "there is no fifth column"


def test_charuco_print_is_the_one_that_opencv_knows():
    target = CharucoBoard((6, 5), 8.0, 6.0, "DICT_4X4_50")
    plate = Plate(target)
    x0, x1, y0, y1 = plate.extent
    px_per_mm = 12
    x = np.arange(x0 + 0.5 / px_per_mm, x1, 1 / px_per_mm)
    y = np.arange(y0 + 0.5 / px_per_mm, y1, 1 / px_per_mm)
    points = np.stack([*np.meshgrid(x, y), np.zeros((len(y), len(x)))], axis=-1).reshape(-1, 3)
    image = (255 * plate.albedo(points, np.zeros(len(points), int))).reshape(len(y), len(x)).astype(np.uint8)

    board = cv2.aruco.CharucoBoard((6, 5), 8.0, 6.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    corners, ids, _, _ = cv2.aruco.CharucoDetector(board).detectBoard(image)
    assert ids.ravel().tolist() == list(range(20))
    found_mm = (corners.reshape(-1, 2) + 0.5) / px_per_mm + [x0, y0]
    np.testing.assert_allclose(found_mm, target.points_board()[:, :2], atol=0.05)


def test_the_front_is_seen_from_negative_z():
    plate = Plate(Checkerboard((5, 4), 3.0))
    middle = plate.centre_board()
    towards = np.array([[0.0, 0.0, 1.0]])
    t, faces = plate.intersect(middle - np.array([0.0, 0.0, 50.0]), towards)
    assert t.tolist() == [50.0]
    assert faces.tolist() == [0]
    t, faces = plate.intersect(middle + np.array([0.0, 0.0, 50.0]), -towards)
    assert (t.tolist(), faces.tolist()) == ([50.0], [1])
    assert plate.albedo(middle[None], faces)[0] == pytest.approx(BACK)
    t, _ = plate.intersect(middle - np.array([0.0, 0.0, 50.0]), np.array([[1.0, 0.0, 1.0]]))
    assert np.isinf(t[0]), "the plate ends"


TARGETS = st.sampled_from(
    [Checkerboard((7, 5), 4.0), DotGrid((6, 4), 6.0, 3.0), CharucoBoard((8, 6), 5.0, 3.7, "DICT_4X4_50")]
)


@given(target=TARGETS, flatness_um=st.sampled_from([-3000.0, -100.0, 0.0, 50.0, 3000.0]), seed=st.integers(0, 1000))
@settings(max_examples=30, deadline=None)
def test_rays_meet_the_bent_front_where_they_were_aimed_at(target, flatness_um, seed):
    plate = Plate(target, flatness_um=flatness_um)
    rng = np.random.default_rng(seed)
    x0, x1, y0, y1 = plate.extent
    xy = rng.uniform([x0 + 0.1, y0 + 0.1], [x1 - 0.1, y1 - 0.1], (50, 2))
    aimed = np.column_stack([xy, plate.heights(xy)])
    for side, face in ((-1.0, 0), (1.0, 1)):
        origin = np.array([*rng.uniform(-100, 100, 2), side * 300.0])
        directions = (aimed - origin) * rng.uniform(0.1, 3.0, (50, 1))
        t, faces = plate.intersect(origin, directions)
        np.testing.assert_allclose(origin + t[:, None] * directions, aimed, atol=1e-9)
        assert np.all(faces == face)
        normals = plate.normals(aimed, faces)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
        assert np.all(np.einsum("ij,ij->i", normals, directions) < 0), "outward"
        step = 1e-3
        slopes = [(plate.heights(xy + d) - plate.heights(xy - d)) / (2 * step) for d in step * np.eye(2)]
        np.testing.assert_allclose(normals[:, :2] / -normals[:, 2:], np.transpose(slopes), atol=1e-9)


def test_the_middle_stands_out_by_the_flatness_and_the_corners_do_not():
    plate = Plate(Checkerboard((7, 5), 4.0), flatness_um=80.0)
    np.testing.assert_allclose(plate.heights(plate.corners_board()[:, :2]), 0.0, atol=1e-15)
    towards_the_viewer = -plate.heights(plate.centre_board()[None, :2])[0]
    assert towards_the_viewer == pytest.approx(0.080)
    assert plate.centre_board()[2] == pytest.approx(-0.080)
    np.testing.assert_allclose(plate.bounds(), [[-8.0, -8.0, -0.08], [32.0, 24.0, 0.0]])
    np.testing.assert_allclose(plate.points_true_board()[:, 2], plate.heights(plate.target.points_board()[:, :2]))


def test_a_ray_along_a_hollow_plate_meets_its_near_rim_and_one_over_it_the_far_one():
    plate = Plate(Checkerboard((7, 5), 4.0), flatness_um=-2000.0)
    middle = plate.centre_board()
    along = np.array([[1.0, 0.0, 0.0]])
    x = plate.extent[0] - 50.0
    t, faces = plate.intersect(np.array([x, middle[1], 1.0]), along)
    # z = 1 is reached where the paraboloid has risen by half: the back on the way in is met first
    half = np.sqrt(0.5 * (20.0**2 + 16.0**2))
    assert half < 20.0
    assert (x + t[0], faces[0]) == (pytest.approx(middle[0] - half), 1)
    # started beyond the near rim, the nearer crossing lies behind
    t, faces = plate.intersect(np.array([middle[0] - 5.0, middle[1], 1.0]), along)
    assert (t[0], faces[0]) == (pytest.approx(half + 5.0), 0)


@given(target=TARGETS, error=st.sampled_from([-0.01, 1e-4, 0.02]))
@settings(max_examples=10, deadline=None)
def test_a_pitch_error_scales_the_print(target, error):
    nominal, plate = Plate(target), Plate(target, pitch_error=error)
    np.testing.assert_allclose(plate.points_true_board(), target.points_board() * (1 + error))
    points = np.random.default_rng(0).uniform(nominal.bounds()[0], nominal.bounds()[1], (500, 3))
    printed = np.all((points > -target.pitch) & (points < np.array([*target.grid_size, 1]) * target.pitch), axis=1)
    faces = np.zeros(printed.sum(), int)
    np.testing.assert_array_equal(
        plate.albedo(points[printed] * (1 + error), faces), nominal.albedo(points[printed], faces)
    )
    assert plate.sizes() == {"pitch": target.pitch * (1 + error)}


def test_print_offsets_have_their_standard_deviation_and_their_seed():
    target = DotGrid((40, 40), 3.0, 1.5)
    plate = Plate(target, print_offset_um=20.0, print_seed=4)
    off_um = 1e3 * (plate.points_true_board() - target.points_board())[:, :2]
    assert off_um.std() == pytest.approx(20.0, rel=4 / np.sqrt(2 * 3200))
    again, other = (Plate(target, print_offset_um=20.0, print_seed=seed) for seed in (4, 5))
    np.testing.assert_array_equal(again.points_true_board(), plate.points_true_board())
    assert np.all(other.points_true_board()[:, :2] != plate.points_true_board()[:, :2])


def test_dots_are_printed_where_they_truly_are():
    plate = Plate(DotGrid((6, 4), 6.0, 3.0), pitch_error=1e-3, print_offset_um=200.0, flatness_um=100.0)
    turn = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    rim = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    faces = np.zeros(16, int)
    for dot in plate.points_true_board():
        assert np.all(plate.albedo(dot + 1.4999 * 1.001 * rim, faces) == BLACK)
        assert np.all(plate.albedo(dot + 1.5001 * 1.001 * rim, faces) == WHITE)


@pytest.mark.parametrize("target", [Checkerboard((7, 5), 4.0), CharucoBoard((8, 6), 4.0, 3.0, "DICT_4X4_50")])
def test_squares_meet_where_the_corners_truly_are(target):
    """Within a tenth of a micrometre: black and white change places across each corner."""
    plate = Plate(target, pitch_error=1e-3, print_offset_um=40.0)
    corners = plate.points_true_board()
    assert np.abs(corners - target.points_board()).max() > 0.08
    near = 1e-4 * np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [1.0, -1.0, 0.0]])
    # a marker's rim is white: only the two white squares of a ChArUco corner may hold one
    albedo = np.stack([plate.albedo(corners + d, np.zeros(len(corners), int)) for d in near], axis=1)
    parity = np.add(*np.divmod(np.arange(len(corners)), target.grid_size[0])) % 2
    first_black = parity == (0 if albedo[0, 0] == BLACK else 1)
    np.testing.assert_array_equal(albedo[first_black], np.tile([BLACK, WHITE, BLACK, WHITE], (first_black.sum(), 1)))
    np.testing.assert_array_equal(
        albedo[~first_black], np.tile([WHITE, BLACK, WHITE, BLACK], ((~first_black).sum(), 1))
    )


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"margin": -1.0}, "margin"),
        ({"print_offset_um": -1.0}, "print_offset_um"),
        ({"print_offset_um": 300.0}, r"at most 5 % of the pitch \(200 um\)"),
        ({"pitch_error": 0.5}, "fraction"),
    ],
)
def test_plates_that_do_not_exist_are_refused(wrong, text):
    with pytest.raises(ValueError, match=text):
        Plate(Checkerboard((7, 5), 4.0), **wrong)
