import cv2
import numpy as np
import pytest

from rotaline.errors import SessionError
from rotaline.vision.background import shows_same_scene
from rotaline.vision.images import encode_png, image_size, read_image, small_picture, to_grey

RNG = np.random.default_rng(3)


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tif"])
@pytest.mark.parametrize(("depth", "colour"), [("uint8", False), ("uint8", True), ("uint16", False), ("uint16", True)])
def test_lossless_formats_give_the_pixels_back(tmp_path, suffix, depth, colour):
    if suffix == ".bmp" and depth == "uint16":
        pytest.skip("BMP holds 8 bit only")
    shape = (40, 60, 3) if colour else (40, 60)
    image = RNG.integers(0, np.iinfo(depth).max, shape).astype(depth)
    path = tmp_path / f"image{suffix}"
    cv2.imwrite(str(path), image[:, :, ::-1] if colour else image)
    read = read_image(path)
    assert read.dtype == image.dtype
    assert (to_grey(read) == to_grey(image)).all()
    assert (read == image).all() or read.ndim != image.ndim
    with path.open("rb") as stream:
        assert image_size(stream, path.name) == (60, 40)


def test_jpeg_colours_come_as_red_green_blue(tmp_path):
    image = np.zeros((32, 32, 3), np.uint8)
    image[:, :, 0] = 200
    cv2.imwrite(str(tmp_path / "red.jpg"), image[:, :, ::-1])
    assert read_image(tmp_path / "red.jpg").mean(axis=(0, 1)) == pytest.approx([200, 0, 0], abs=3)


def test_an_alpha_channel_is_dropped(tmp_path):
    image = RNG.integers(0, 255, (32, 32, 4)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    assert (read_image(tmp_path / "a.png") == image[:, :, 2::-1]).all()


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tif"])
@pytest.mark.parametrize("part", [0.0, 0.3, 0.98])
def test_a_file_that_is_cut_off_is_refused_with_its_name(tmp_path, suffix, part):
    path = tmp_path / f"cut{suffix}"
    cv2.imwrite(str(path), RNG.integers(0, 255, (64, 64)).astype(np.uint8))
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * part)])
    with pytest.raises(SessionError, match=f"cut{suffix}"):
        read_image(path)


def test_a_missing_file_and_a_text_file_are_refused(tmp_path):
    with pytest.raises(SessionError, match="missing"):
        read_image(tmp_path / "none.png")
    (tmp_path / "text.png").write_text("not an image, but long enough to be one" * 10)
    with pytest.raises(SessionError, match="not a readable image"):
        read_image(tmp_path / "text.png")
    (tmp_path / "film.gif").write_bytes(b"GIF89a")
    with pytest.raises(SessionError, match="expected one of"):
        read_image(tmp_path / "film.gif")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(SessionError, match=r"folder.png: .*cannot be read"):
        read_image(tmp_path / "folder.png")


@pytest.mark.parametrize(("depth", "colour"), [("uint8", False), ("uint8", True), ("uint16", False), ("uint16", True)])
def test_a_png_gives_the_pixels_back(tmp_path, depth, colour):
    image = RNG.integers(0, np.iinfo(depth).max, (40, 60, 3) if colour else (40, 60)).astype(depth)
    (tmp_path / "image.png").write_bytes(encode_png(image))
    read = read_image(tmp_path / "image.png")
    assert read.dtype == image.dtype
    np.testing.assert_array_equal(read, image)


def test_a_background_in_the_same_light_is_recognised_and_one_in_other_light_is_not():
    scene = RNG.integers(20, 120, (240, 320)).astype(np.uint8)
    with_stripe = scene.copy()
    with_stripe[100:106] = 250
    assert shows_same_scene(with_stripe, scene)
    dark = np.zeros_like(scene)
    dark[100:106] = 250
    lit_plate = np.zeros_like(scene)
    lit_plate[60:160, 80:200] = 180
    assert not shows_same_scene(dark, lit_plate)
    assert shows_same_scene(dark, np.zeros_like(scene))
    assert not shows_same_scene(scene, scene[:100])


def test_a_small_picture_of_a_dark_frame_can_be_seen():
    image = np.zeros((960, 1280), np.uint16)
    image[480:484] = 900
    picture, scale = small_picture(image, 640)
    assert picture.shape == (480, 640, 3)
    assert scale == 0.5
    assert picture.max() == 255
