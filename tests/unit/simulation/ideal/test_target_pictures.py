import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.simulation.ideal.targets import pixel_rays, plate_size, render_target
from rotaline.vision.camera import CameraModel
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid

CAMERA = CameraModel((320, 240), 500.0, 500.0, 160.0, 120.0, k1=-0.1, p1=1e-3)
TARGETS = [Checkerboard((6, 4), 5.0), DotGrid((6, 4), 6.0, 3.0), CharucoBoard((7, 5), 6.0, 4.0, "DICT_4X4_50")]


def pose_of(target, distance: float = 110.0, flip: bool = False) -> RigidTransform:
    rotation = Rotation.from_euler("zyx", [15, 20 + 180 * flip, -10], degrees=True)
    return RigidTransform.from_components(
        [0, 0, distance] - rotation.apply(target.points_board().mean(axis=0)), rotation
    )


@pytest.mark.parametrize("target", TARGETS)
def test_grey_values_and_coverage(target):
    picture = render_target(CAMERA, pose_of(target), target, white=200.0, black=30.0)
    covered = picture.coverage > 0.999
    assert covered.sum() > 3000
    assert picture.grey[covered].min() == pytest.approx(30.0)
    assert picture.grey[covered].max() == pytest.approx(200.0)
    assert picture.coverage.min() == 0.0
    assert picture.coverage.max() <= 1.0 + 1e-12
    background = picture.over(77.0)
    np.testing.assert_allclose(background[picture.coverage == 0], 77.0)


@pytest.mark.parametrize("target", TARGETS)
def test_the_plate_covers_what_its_outline_encloses(target):
    picture = render_target(CAMERA, pose_of(target), target)
    x0, y0, x1, y1 = plate_size(target)
    s = np.linspace(0, 1, 200)
    rim = np.concatenate(
        [
            np.column_stack([x0 + s * (x1 - x0), np.full(200, y0)]),
            np.column_stack([np.full(200, x1), y0 + s * (y1 - y0)]),
            np.column_stack([x1 - s * (x1 - x0), np.full(200, y1)]),
            np.column_stack([np.full(200, x0), y1 - s * (y1 - y0)]),
        ]
    )
    uv = CAMERA.project(pose_of(target).apply(np.column_stack([rim, np.zeros(len(rim))])))
    area = 0.5 * abs(np.sum(uv[:, 0] * np.roll(uv[:, 1], -1) - uv[:, 1] * np.roll(uv[:, 0], -1)))
    assert picture.coverage.sum() == pytest.approx(area, rel=2e-4)


def test_the_area_of_dots_is_kept():
    target = TARGETS[1]
    picture = render_target(CAMERA, pose_of(target), target, white=1.0, black=0.0)
    dark = float(np.sum(picture.coverage * (1 - picture.grey)))
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    area = 0.0
    for x, y, _ in target.points_board():
        ring = np.column_stack([x + 1.5 * np.cos(angle), y + 1.5 * np.sin(angle), np.zeros(400)])
        uv = CAMERA.project(pose_of(target).apply(ring))
        area += 0.5 * abs(np.sum(uv[:, 0] * np.roll(uv[:, 1], -1) - uv[:, 1] * np.roll(uv[:, 0], -1)))
    assert dark == pytest.approx(area, rel=1e-3)


def test_more_samples_hardly_change_the_picture():
    target = TARGETS[0]
    rays = pixel_rays(CAMERA)
    coarse = render_target(CAMERA, pose_of(target), target, samples=4, rays=rays).over(0.0)
    fine = render_target(CAMERA, pose_of(target), target, samples=12, rays=rays).over(0.0)
    assert np.sqrt(np.mean((coarse - fine) ** 2)) < 0.3  # of 155 grey values between print and plate


def test_blur_before_the_pixels_keeps_the_light():
    target = TARGETS[1]
    sharp = render_target(CAMERA, pose_of(target), target)
    soft = render_target(CAMERA, pose_of(target), target, blur_px=0.8)
    assert soft.over(0.0).sum() == pytest.approx(sharp.over(0.0).sum(), rel=1e-3)
    assert np.abs(np.diff(soft.over(0.0), axis=1)).max() < np.abs(np.diff(sharp.over(0.0), axis=1)).max()


def test_charuco_markers_are_those_of_the_dictionary():
    target = TARGETS[2]
    image = np.round(render_target(CAMERA, pose_of(target, 80.0), target).over(60.0)).astype(np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard(target.squares, target.pitch, target.marker, dictionary)
    _, ids, _, markers = cv2.aruco.CharucoDetector(board).detectBoard(image)
    assert len(markers) == 17
    assert sorted(ids.ravel().tolist()) == list(range(24))


def test_the_back_of_a_plate_is_not_drawn():
    picture = render_target(CAMERA, pose_of(TARGETS[0], flip=True), TARGETS[0])
    assert picture.coverage.max() == 0.0
    behind = RigidTransform.from_components([0.0, 0.0, -100.0], Rotation.identity())
    assert render_target(CAMERA, behind, TARGETS[0]).coverage.max() == 0.0
