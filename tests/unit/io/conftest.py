"""A session with every kind of image: grey and colour, 8 and 16 bit, PNG and others, and some that cannot be read."""

import cv2
import numpy as np
import pytest

TOML = """version = 1  # ünïcode
[[captures]]
folder = "scans/ball"
role = "scan"

[[captures]]
folder = "mixed"
role = "scan"
"""
SHAPE = (48, 64)
N_BALL = 70


def _images():
    rng = np.random.default_rng(11)
    grey = rng.integers(0, 255, SHAPE).astype(np.uint8)
    colour = rng.integers(0, 255, (*SHAPE, 3)).astype(np.uint8)
    return {
        "grey.png": grey,
        "colour.png": colour,
        "deep.png": grey.astype(np.uint16) * 200,
        "deep-colour.png": colour.astype(np.uint16) * 231,
        "grey.bmp": grey[::-1],
        "photo.jpg": cv2.GaussianBlur(colour, (0, 0), 5),
        "deep.tif": grey.astype(np.uint16) * 13,
    }


@pytest.fixture
def mixed_session(tmp_path):
    """The folder; two of its nine images in ``mixed`` cannot be read, one of them only seems to be whole."""
    path = tmp_path / "rod"
    (path / "mixed").mkdir(parents=True)
    (path / "scans" / "ball").mkdir(parents=True)
    (path / "session.toml").write_bytes(b"\xef\xbb\xbf" + TOML.replace("\n", "\r\n").encode())
    images = _images()
    for name, image in images.items():
        cv2.imwrite(str(path / "mixed" / name), image)
    whole = (path / "mixed" / "grey.png").read_bytes()
    (path / "mixed" / "cut.png").write_bytes(whole[:500])
    (path / "mixed" / "hollow.png").write_bytes(whole[:33] + whole[-12:])
    names = [*images, "cut.png", "hollow.png"]
    rows = [f'{name},{7.5 * i},on,,"gain, {i}"' for i, name in enumerate(names)]
    (path / "mixed" / "frames.csv").write_bytes("\r\n".join(["image, angle_deg,laser,pose,note", *rows, ""]).encode())
    rng = np.random.default_rng(5)
    for i in range(N_BALL):
        cv2.imwrite(str(path / "scans" / "ball" / f"{i:04d}.png"), rng.integers(0, 9, SHAPE).astype(np.uint8))
    rows = [f"{i:04d}.png,{i},{'on' if i % 5 else 'off'}," for i in reversed(range(N_BALL))]
    (path / "scans" / "ball" / "frames.csv").write_text("\n".join(["image,angle_deg,laser,pose", *rows]))
    return path
