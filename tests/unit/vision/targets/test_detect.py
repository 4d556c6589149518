import numpy as np
import pytest

from rotaline.errors import DetectionError
from rotaline.vision.targets.detect import TargetOptions, detect_target
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid, TargetDetection
from rotaline.vision.targets.ordering import permuted, symmetry_permutations

CHECKERBOARD = Checkerboard((8, 5), 4.0)  # odd sum: colours tell its order
SYMMETRIC = Checkerboard((7, 5), 4.0)
DOTS = DotGrid((7, 5), 6.0, 3.0)
CHARUCO = CharucoBoard((8, 6), 10.0, 7.0, "DICT_4X4_50")


def worst_error_px(detection: TargetDetection, uv: np.ndarray) -> float:
    """Largest distance from the truth, under the symmetry that fits best."""
    errors = []
    for permutation in symmetry_permutations(detection.target):
        turned = permuted(detection, permutation)
        errors.append(float(np.linalg.norm(turned.uv - uv[turned.point_ids], axis=1).max()))
    return min(errors)


@pytest.mark.parametrize("target", [CHECKERBOARD, SYMMETRIC, Checkerboard((6, 6), 4.0), DOTS, DotGrid((6, 6), 5.0)])
@pytest.mark.parametrize("roll_deg", [0.0, 47.0, 90.0, 163.0, 270.0])
def test_any_roll(photograph, target, roll_deg):
    scene = photograph(target, roll_deg=roll_deg)
    detection = detect_target(scene.image, target)
    assert len(detection.point_ids) == len(target.points_board())
    assert worst_error_px(detection, scene.uv) < 8 * detection.u_px
    assert detection.u_px < 0.05


@pytest.mark.parametrize("roll_deg", [0.0, 90.0, 180.0, 290.0])
def test_colours_fix_the_order_of_a_checkerboard(photograph, roll_deg):
    scene = photograph(CHECKERBOARD, roll_deg=roll_deg)
    detection = detect_target(scene.image, CHECKERBOARD)
    np.testing.assert_allclose(detection.uv, scene.uv[detection.point_ids], atol=0.2)


def test_columns_and_rows_may_be_stated_either_way(photograph):
    scene = photograph(CHECKERBOARD, roll_deg=15.0)
    detection = detect_target(scene.image, Checkerboard((5, 8), 4.0))
    distance = np.linalg.norm(detection.uv[:, None] - scene.uv[None], axis=2)
    assert sorted(distance.argmin(axis=1).tolist()) == list(range(40))
    assert distance.min(axis=1).max() < 0.2


@pytest.mark.parametrize("target", [SYMMETRIC, DOTS, DotGrid((6, 6), 5.0)])
def test_never_mirrored(photograph, target):
    detection = detect_target(photograph(target, roll_deg=200.0).image, target)
    columns = target.grid_size[0]
    along_x = detection.uv[columns - 1] - detection.uv[0]
    along_y = detection.uv[-columns] - detection.uv[0]
    assert along_x[0] * along_y[1] - along_x[1] * along_y[0] > 0


def test_light_dots_on_a_dark_plate(photograph):
    scene = photograph(DOTS, white=25.0, black=150.0)
    assert worst_error_px(detect_target(scene.image, DOTS), scene.uv) < 0.1


@pytest.mark.parametrize("target", [CHECKERBOARD, DOTS, CHARUCO])
def test_sixteen_bit_and_colour(photograph, target):
    scene = photograph(target)
    grey = detect_target(scene.image, target)
    deep = detect_target(scene.image.astype(np.uint16) * 16, target)
    colour = detect_target(np.repeat(scene.image[:, :, None], 3, axis=2), target)
    np.testing.assert_allclose(deep.uv, grey.uv, atol=1e-3)
    np.testing.assert_allclose(colour.uv, grey.uv, atol=1e-3)


@pytest.mark.parametrize("target", [CHECKERBOARD, DOTS, CHARUCO])
def test_low_contrast_and_a_shadow(photograph, target):
    scene = photograph(target, white=90.0, black=45.0, background=50.0, noise=0.8)
    v, u = np.mgrid[0:480, 0:640]
    shaded = np.round(scene.image * np.clip(1.2 - 0.9 * u / 640 - 0.3 * v / 480, 0.15, 1.0)).astype(np.uint8)
    assert worst_error_px(detect_target(shaded, target), scene.uv) < 0.6


@pytest.mark.parametrize("target", [CHECKERBOARD, DOTS, CHARUCO])
def test_clutter_around(photograph, target):
    rng = np.random.default_rng(3)
    background = np.full((480, 640), 90.0)
    for _ in range(150):  # boxes of all sizes and grey values, whose corners and areas could mislead
        v, u = rng.integers(0, 460), rng.integers(0, 620)
        background[v : v + rng.integers(4, 60), u : u + rng.integers(4, 60)] = rng.uniform(0, 255)
    scene = photograph(target, background=background)
    detection = detect_target(scene.image, target)
    assert len(detection.point_ids) == len(target.points_board())
    assert worst_error_px(detection, scene.uv) < 0.2


@pytest.mark.parametrize("target", [Checkerboard((9, 7), 4.0), DotGrid((9, 7), 6.0, 3.0)])
def test_points_under_a_finger_are_left_out(photograph, target):
    scene = photograph(target, fill=0.9)
    covered = scene.image.copy()
    u, v = np.round(scene.uv[30]).astype(int)
    covered[v - 30 : v + 30, u - 20 : u + 20] = 120
    detection = detect_target(covered, target)
    assert 0.7 * 63 < len(detection.point_ids) < 63
    assert worst_error_px(detection, scene.uv) < 0.2


@pytest.mark.parametrize("angle_deg", [5.0, 70.0])
def test_dots_crossed_by_a_laser_line_are_right_or_left_out(photograph, angle_deg):
    target = DotGrid((9, 9), 6.0, 3.0)
    scene = photograph(target, fill=0.9)
    v, u = np.mgrid[0:480, 0:640]
    middle = scene.uv.mean(axis=0) + 3.0
    across = (u - middle[0]) * np.sin(np.deg2rad(angle_deg)) - (v - middle[1]) * np.cos(np.deg2rad(angle_deg))
    light = 140.0 * np.exp(-(across**2) / (2 * 1.5**2)) * np.where(scene.image > 100, 1.0, 0.2)
    image = np.clip(scene.image + light, 0, 255).astype(np.uint8)
    detection = detect_target(image, target)
    assert len(detection.point_ids) >= 60
    assert worst_error_px(detection, scene.uv) < 0.15


def test_the_darkest_channel_does_not_see_a_red_line(photograph):
    scene = photograph(DOTS)
    rows = np.abs(np.arange(480) - scene.uv[:, 1].mean()) < 4
    image = np.repeat(scene.image[:, :, None], 3, axis=2)
    image[rows, :, 0] = 255
    darkest = detect_target(image, DOTS, TargetOptions(channel="darkest"))
    np.testing.assert_allclose(darkest.uv, detect_target(scene.image, DOTS).uv, atol=1e-3)
    assert len(detect_target(image, DOTS).point_ids) >= 30


@pytest.mark.parametrize("shift", [(0.2, 0.1), (-0.2, -0.15)])
def test_a_charuco_board_may_be_partly_out_of_view(photograph, shift):
    scene = photograph(CHARUCO, fill=1.1, shift=shift, roll_deg=30.0)
    detection = detect_target(scene.image, CHARUCO)
    assert 8 <= len(detection.point_ids) < 35
    np.testing.assert_allclose(detection.uv, scene.uv[detection.point_ids], atol=0.1)


def test_a_large_image_is_searched_reduced_and_measured_whole(photograph):
    scene = photograph(CHECKERBOARD)
    options = TargetOptions(coarse_size_px=320)
    np.testing.assert_allclose(
        detect_target(scene.image, CHECKERBOARD, options).uv, detect_target(scene.image, CHECKERBOARD).uv, atol=0.02
    )


@pytest.mark.parametrize(
    ("shown", "stated", "message"),
    [
        (Checkerboard((8, 5), 4.0), Checkerboard((7, 5), 4.0), "8 x 5 inner corners was found, 7 x 5 inner corners"),
        (Checkerboard((8, 5), 4.0), Checkerboard((9, 6), 4.0), "8 x 5 inner corners was found, 9 x 6 inner corners"),
        (DotGrid((7, 5), 6.0), DotGrid((6, 5), 6.0), "7 x 5 dots was found, 6 x 5 dots"),
        (DotGrid((7, 5), 6.0), DotGrid((8, 8), 6.0), "7 x 5 dots was found, 8 x 8 dots"),
        (CHARUCO, CharucoBoard((6, 6), 10.0, 7.0, "DICT_4X4_50"), "8 squares in a row"),
        (CHARUCO, CharucoBoard((8, 6), 10.0, 7.0, "DICT_6X6_250"), "family DICT_4X4_1000"),
    ],
)
def test_a_wrong_size_is_named(photograph, shown, stated, message):
    with pytest.raises(DetectionError, match=message):
        detect_target(photograph(shown).image, stated)


@pytest.mark.parametrize("target", [CHECKERBOARD, DOTS, CHARUCO])
@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((1, 1), np.uint8), "1 x 1 pixels"),
        (np.zeros((480, 640), np.uint8), "dark all over"),
        (np.full((480, 640), 255, np.uint8), "white all over"),
        (np.full((480, 640, 3), 60000, np.uint16), "white all over|no contrast"),
        (np.full((480, 640), 128, np.uint8), "no contrast"),
        (np.tile(np.arange(640, dtype=np.uint16) * 100, (480, 1)), "was found"),
    ],
)
def test_an_image_without_target_says_what_is_wrong(target, image, message):
    with pytest.raises(DetectionError, match=message):
        detect_target(image, target)


def test_noise_alone_is_no_target():
    image = np.random.default_rng(0).integers(0, 255, (240, 320)).astype(np.uint8)
    for target in (CHECKERBOARD, DOTS, CHARUCO):
        with pytest.raises(DetectionError, match="was found"):
            detect_target(image, target)


def test_an_unknown_dictionary_is_a_wrong_call(photograph):
    with pytest.raises(ValueError, match="no dictionary of OpenCV"):
        detect_target(photograph(CHARUCO).image, CharucoBoard((8, 6), 10.0, 7.0, "DICT_3X3"))
