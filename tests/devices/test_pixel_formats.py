"""Bytes as cameras send them, packed by hand after the Pixel Format Naming Convention."""

import numpy as np
import pytest

from rotaline.errors import DeviceStateError, LostFrameError
from rotaline.hardware.cameras.pixel_formats import depth_bits, is_colour, supported, to_full_scale, to_image

WIDTH, HEIGHT = 7, 4  # odd: groups of packed pixels go over the ends of lines


def bits_little_endian(values, bits):
    """Values one behind the other, the lowest bit first."""
    stream = "".join(format(int(v), f"0{bits}b")[::-1] for v in values)
    stream += "0" * (-len(stream) % 8)
    return bytes(int(stream[i : i + 8][::-1], 2) for i in range(0, len(stream), 8))


def gige_packed(values, bits):
    """Two pixels in three bytes: high bits of the first, low bits of both, high bits of the second."""
    low = bits - 8
    padded = [*map(int, values), *([0] * (len(values) % 2))]
    out = bytearray()
    for a, b in zip(padded[::2], padded[1::2], strict=True):
        out += bytes([a >> low, (a & ((1 << low) - 1)) | (b & ((1 << low) - 1)) << 4, b >> low])
    return bytes(out)[: (len(values) * 12 + 7) // 8]


def sent(values, bits, packing):
    flat = values.ravel()
    if bits == 8:
        return flat.astype(np.uint8).tobytes()
    if packing == "p":
        return bits_little_endian(flat, bits)
    if packing == "Packed":
        return gige_packed(flat, bits)
    return flat.astype("<u2").tobytes()


GREY = [
    (f"Mono{bits}{packing}", bits, packing)
    for bits in (8, 10, 12, 14, 16)
    for packing in ("", "p", "Packed")
    if not (packing and bits in (8, 16)) and not (packing == "Packed" and bits == 14)
]


@pytest.mark.parametrize(("name", "bits", "packing"), GREY)
def test_grey(name, bits, packing):
    values = np.random.default_rng(1).integers(0, 1 << bits, (HEIGHT, WIDTH))
    values[0, :2] = 0, (1 << bits) - 1
    image = to_image(sent(values, bits, packing) + b"behind it", name, WIDTH, HEIGHT)
    full = 255 if bits == 8 else 65535
    assert image.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert (image[0, 0], image[0, 1]) == (0, full)
    assert np.abs(image - values * (full / ((1 << bits) - 1))).max() < 1.0
    assert depth_bits(name) == bits
    assert not is_colour(name)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
def test_each_step_of_the_camera_stays_a_step(bits):
    values = to_full_scale(np.arange(1 << bits, dtype=np.uint16), bits)
    assert values[-1] == 65535
    assert (np.diff(values.astype(np.int64)) >= 1 << (16 - bits)).all()


@pytest.mark.parametrize(("name", "bits", "packing"), [("Mono8", 8, ""), ("Mono12", 12, ""), ("Mono12p", 12, "p")])
def test_padding_behind_lines_is_no_image(name, bits, packing):
    values = np.random.default_rng(2).integers(0, 1 << bits, (HEIGHT, WIDTH))
    lines = [sent(line, bits, packing) + b"\xff\xff\xff" for line in values]
    padded = to_image(b"".join(lines), name, WIDTH, HEIGHT, padding_bytes=3)
    assert np.array_equal(padded, to_image(b"".join(lines)[:-3], name, WIDTH, HEIGHT, padding_bytes=3))
    assert np.array_equal(padded, to_image(sent(values, bits, packing), name, WIDTH, HEIGHT))


@pytest.mark.parametrize(("name", "order"), [("RGB8", "rgb"), ("BGR8", "bgr"), ("RGBa8", "rgba"), ("BGRa8", "bgra")])
def test_colours_come_as_red_green_blue(name, order):
    colours = {"r": 200, "g": 100, "b": 50, "a": 255}
    pixel = bytes(colours[letter] for letter in order)
    image = to_image(pixel * (WIDTH * HEIGHT), name, WIDTH, HEIGHT)
    assert image.shape == (HEIGHT, WIDTH, 3)
    assert (image == (200, 100, 50)).all()


@pytest.mark.parametrize("first_row", ["RG", "GR", "GB", "BG"])
@pytest.mark.parametrize(
    ("suffix", "bits", "packing"), [("8", 8, ""), ("12p", 12, "p"), ("10Packed", 10, "Packed"), ("16", 16, "")]
)
def test_a_mosaic_becomes_red_green_blue(first_row, suffix, bits, packing):
    """A field of one colour seen through the filters is that colour again."""
    full = (1 << bits) - 1
    colour = {"R": full, "G": full // 2, "B": full // 8}
    second_row = {"RG": "GB", "GR": "BG", "GB": "RG", "BG": "GR"}[first_row]
    tile = np.array([[colour[c] for c in first_row], [colour[c] for c in second_row]])
    image = to_image(sent(np.tile(tile, (4, 4)), bits, packing), f"Bayer{first_row}{suffix}", 8, 8)
    expected = [to_full_scale(np.array([colour[c]], np.uint16), bits)[0] if bits > 8 else colour[c] for c in "RGB"]
    assert image.shape == (8, 8, 3)
    assert (image == np.array(expected)).all()
    assert is_colour(f"Bayer{first_row}{suffix}")


def test_the_image_is_a_copy():
    data = bytearray(WIDTH * HEIGHT)
    image = to_image(data, "Mono8", WIDTH, HEIGHT)
    data[0] = 99
    assert image[0, 0] == 0
    image[0, 0] = 5  # and may be written to


@pytest.mark.parametrize("name", ["Mono8", "Mono16", "Mono12p", "Mono12Packed", "BayerRG8", "RGB8"])
def test_too_few_bytes_are_a_lost_frame(name):
    with pytest.raises(LostFrameError, match="bytes"):
        to_image(bytes(WIDTH * HEIGHT - 1), name, WIDTH, HEIGHT)


@pytest.mark.parametrize("name", ["Mono9", "Mono8p", "Coord3D_ABC32f", "YUV422_8", "Mono14Packed"])
def test_other_formats_are_refused(name):
    assert not supported(name)
    with pytest.raises(DeviceStateError, match=name):
        to_image(b"", name, 1, 1)
    with pytest.raises(DeviceStateError, match=name):
        depth_bits(name)
