import cv2
import numpy as np
import pytest

from rotaline.errors import SessionError
from rotaline.geometry.primitives import KnownCylinder, KnownSphere, SteppedCylinder
from rotaline.io.session import inspect_session, read_session
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, DotGrid

TOML = """version = 1

[targets.cb]
kind = "checkerboard"
inner_corners = [18, 16]
pitch = 4.0

[targets.dots]
kind = "dots"
dots = [9, 8]
pitch = 6.0

[targets.board]
kind = "charuco"
squares = [12, 9]
pitch = 8.0
marker = 6.0
dictionary = "DICT_5X5_100"

[targets.step]
kind = "stepped-cylinder"
diameters = [23.051, 36.006]
heights = [22.003, 25.005]

[[captures]]
folder = "camera"
role = "camera"
target = "cb"

[[captures]]
folder = "step-1"
role = "artifact"
target = "step"

[[captures]]
folder = "ball"
role = "scan"
target = "a ball"

[[measurements]]
capture = "ball"
feature = "sphere"
[measurements.reference]
diameter = 28.475
"""
ROWS = {
    "camera": ["0.png,,off,", "1.png,,off,"],
    "step-1": ["0.png,90,on,", "1.png,-3.5,on,", "2.png,90.0,off,"],
    "ball": ["0.png,1e1,on,a", "1.png,20,on,b", "2.png,,off,b"],
}


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "s"
    path.mkdir()
    (path / "session.toml").write_text(TOML)
    for name, rows in ROWS.items():
        (path / name).mkdir()
        (path / name / "frames.csv").write_text(
            "\n".join(["image,angle_deg,laser,pose,gain", *(r + ",2" for r in rows)])
        )
        for row in rows:
            cv2.imwrite(str(path / name / row.split(",")[0]), np.zeros((48, 64), np.uint8))
    return path


def test_a_session_is_read_as_it_stands(folder):
    session = read_session(folder)
    assert session.problems == ()
    assert session.image_size == (64, 48)
    assert session.targets == {
        "cb": Checkerboard((18, 16), 4.0),
        "dots": DotGrid((9, 8), 6.0, None),
        "board": CharucoBoard((12, 9), 8.0, 6.0, "DICT_5X5_100"),
        "step": SteppedCylinder(23.051, 36.006, 22.003, 25.005),
    }
    artifact = session.in_role("artifact")[0]
    assert [f.angle_rad for f in artifact.on_frames] == pytest.approx(np.radians([90, -3.5]))
    assert artifact.background_of(artifact.on_frames[0]).name == "step-1/2.png"
    assert artifact.background_of(artifact.on_frames[1]) is None
    ball = session.in_role("scan")[0]
    assert ball.target is None
    assert ball.background_of(ball.on_frames[1]).name == "ball/2.png"
    assert session.measurements[0].reference == {"diameter": 28.475}


def _edit(folder, name, old, new):
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new, 1))


@pytest.mark.parametrize(
    ("file", "old", "new", "says"),
    [
        ("session.toml", "version = 1", "version = 3", r"line 1, version: found 3, expected 1"),
        ("session.toml", "version = 1\n", "", r"version: it is missing"),
        ("session.toml", "pitch = 4.0", "pitch = -4.0", r"line 6, targets.cb.pitch: found -4.0"),
        ("session.toml", "pitch = 6.0", "pitch = nan", r"line 11, targets.dots.pitch"),
        ("session.toml", '"checkerboard"', '"chess"', r"line 4, targets.cb.kind: found 'chess', expected one of"),
        (
            "session.toml",
            '"camera"\ntarget',
            '"kamera"\ntarget',
            r"captures\[1\].role: found 'kamera', expected camera",
        ),
        ("session.toml", 'target = "cb"', 'target = "ch"', r"found 'ch', expected the name of a table"),
        ("session.toml", 'target = "step"', 'target = "cb"', r"'cb' does not suit role 'artifact'"),
        ("session.toml", "[18, 16]", "[18]", r"too short"),
        ("session.toml", "[18, 16]", "[18, 1]", r"inner_corners\[2\]: found 1"),
        ("session.toml", "[23.051, 36.006]", "[36.006, 23.051]", r"expected \[small \(upper\), large"),
        ("session.toml", "marker = 6.0", "marker = 9.0", r"marker"),
        ("session.toml", "25.005]", "25.005]\ntolerance = -0.1", r"line 24, targets.step.tolerance: found -0.1"),
        (
            "session.toml",
            "25.005]",
            "25.005]\ntolerance = 2.3",
            r"step.tolerance: found 2.3 mm, expected less than a tenth",
        ),
        ("session.toml", 'target = "step"', 'target = "dots"', r"expected a stepped-cylinder, cylinder or sphere"),
        ("session.toml", "[measurements.reference]\ndiameter = 28.475", "check = true", r"check: .* known sizes"),
        ("session.toml", 'feature = "sphere"', 'feature = "sphere"\ncheck = 1', r"measurements\[1\].check: found 1"),
        (
            "session.toml",
            'capture = "ball"',
            'capture = "step-1"\ncheck = true',
            r"line 42, measurements\[1\].check: 'step-1' is an artefact and takes part in the calibration",
        ),
        ("session.toml", 'role = "scan"', "role = scan", r"line 37: this is not valid TOML"),
        ("session.toml", 'capture = "ball"', 'capture = "bal"', r"no scan capture 'bal'"),
        ("session.toml", 'folder = "ball"', 'folder = "bowl"', r"no folder 'bowl'"),
        ("ball/frames.csv", "1e1", "ten", r"frames.csv, line 2, angle_deg: found 'ten'"),
        ("ball/frames.csv", "1e1", "nan", r"line 2, angle_deg: found 'nan'"),
        ("ball/frames.csv", "1e1,on", "1e1,yes", r"line 2, laser: found 'yes', expected 'on' or 'off'"),
        ("ball/frames.csv", "0.png", "../0.png", r"line 2, image: found '../0.png'"),
        ("ball/frames.csv", "image,angle_deg", "image,angle", r"the header lacks angle_deg"),
        ("ball/frames.csv", "20,on", ",on", r"without angle_deg, the first is ball/1.png"),
    ],
)
def test_what_is_wrong_is_said_with_its_place(folder, file, old, new, says):
    _edit(folder, file, old, new)
    with pytest.raises(SessionError, match=says):
        read_session(folder)


@pytest.mark.parametrize(
    ("table", "artifact"),
    [
        ('kind = "sphere"\ndiameter = 28.475', KnownSphere(28.475)),
        ('kind = "sphere"\ndiameter = 28.475\ntolerance = 0.002', KnownSphere(28.475, 0.002)),
        ('kind = "cylinder"\ndiameter = 38', KnownCylinder(38.0)),
        ('kind = "cylinder"\ndiameter = 38\nheight = 40\ntolerance = 0.01', KnownCylinder(38.0, 40.0, 0.01)),
        (
            'kind = "stepped-cylinder"\ndiameters = [20, 30]\nheights = [15, 16]\ntolerance = 0',
            SteppedCylinder(20.0, 30.0, 15.0, 16.0, 0.0),
        ),
    ],
)
def test_artefacts_of_every_kind(folder, table, artifact):
    _edit(
        folder,
        "session.toml",
        '[[captures]]\nfolder = "camera"',
        f'[targets.a]\n{table}\n[[captures]]\nfolder = "camera"',
    )
    _edit(folder, "session.toml", 'target = "step"', 'target = "a"')
    session = read_session(folder)
    assert session.problems == ()
    assert session.in_role("artifact")[0].target == artifact


def test_a_check_is_marked_as_such(folder):
    assert [m.check for m in read_session(folder).measurements] == [False]
    _edit(folder, "session.toml", 'feature = "sphere"', 'feature = "sphere"\ncheck = true')
    session = read_session(folder)
    assert session.problems == ()
    assert session.measurements[0].check
    assert session.measurements[0].reference == {"diameter": 28.475}


def test_a_frame_that_is_missing_or_cut_off_is_left_out_and_named(folder):
    (folder / "ball" / "0.png").unlink()
    data = (folder / "step-1" / "1.png").read_bytes()
    (folder / "step-1" / "1.png").write_bytes(data[: len(data) // 2])
    session = read_session(folder)
    assert [f.name for f in session.in_role("scan")[0].on_frames] == ["ball/1.png"]
    texts = [str(p) for p in session.problems]
    assert any("ball/0.png" in t and "missing" in t for t in texts)
    assert any("step-1/1.png" in t and "cut off" in t for t in texts)


def test_images_of_two_sizes_are_refused(folder):
    cv2.imwrite(str(folder / "ball" / "1.png"), np.zeros((40, 64), np.uint8))
    with pytest.raises(SessionError, match="64 x 40 pixels, but 7 of 64 x 48"):
        read_session(folder)


def test_a_tiny_image_is_refused(folder):
    for image in folder.rglob("*.png"):
        cv2.imwrite(str(image), np.zeros((1, 1), np.uint8))
    with pytest.raises(SessionError, match="1 x 1 pixels"):
        read_session(folder)


def test_all_mistakes_are_listed_at_once(folder):
    _edit(folder, "ball/frames.csv", "1e1", "ten")
    _edit(folder, "camera/frames.csv", "0.png,,off", "0.png,,dark")
    session, problems = inspect_session(folder)
    assert session is None
    assert len([p for p in problems if p.fatal]) == 2


def test_an_unknown_key_is_a_warning_only(folder):
    _edit(folder, "session.toml", "pitch = 4.0", "pitch = 4.0\nmaker = 'x'")
    session, problems = inspect_session(folder)
    assert session is not None
    assert "line 7, targets.cb.maker" in str(problems[0])


@pytest.mark.parametrize("what", ["missing", "file", "empty", "no toml"])
def test_what_is_no_session_is_said_as_such(tmp_path, what):
    path = tmp_path / "x"
    if what == "file":
        path.write_text("")
    elif what != "missing":
        path.mkdir()
        if what == "no toml":
            (path / "a.txt").write_text("")
    with pytest.raises(SessionError, match=r"session\.toml"):
        read_session(path)


def test_a_table_with_a_byte_order_mark_and_spaces_is_read(folder):
    path = folder / "ball" / "frames.csv"
    path.write_text("\ufeff" + path.read_text().replace(",", " , ").replace("\n", "\r\n"), encoding="utf-8")
    assert len(read_session(folder).in_role("scan")[0].frames) == 3
