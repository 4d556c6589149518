"""The print on the plates, looked up at places where its colour is known."""

import cv2
import numpy as np
import pytest

from rotaline.simulation.boards import BACK, BLACK, WHITE, Plate
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
