"""What an acquisition lists beyond the four columns of every session: uncertain angles, times, and frames that watch the drift."""

import math
import shutil

import numpy as np
import pytest

from rotaline.io.acquired_session import COLUMNS, REFERENCE, FrameRow
from rotaline.io.frame_images import read_source
from rotaline.io.session import inspect_session, read_session
from rotaline.pipeline.observer import Silent
from rotaline.pipeline.pack import pack_session, unpack_session
from rotaline.vision.images import encode_png

TOML = 'version = 1\n[[captures]]\nfolder = "ball"\nrole = "scan"\n'
HEADER = ",".join(COLUMNS) + "\n"


def _image(seed, shape=(40, 50)):
    return np.random.default_rng(seed).integers(0, 200, shape).astype(np.uint8)


def _fill(folder, rows, images=None):
    folder.mkdir()
    (folder / "frames.csv").write_text(HEADER + "".join(row.text() for row in rows))
    for k, row in enumerate(rows):
        (folder / row.image).write_bytes(encode_png(_image(k) if images is None else images[k]))


@pytest.fixture
def session(tmp_path):
    """Two frames of a ball, three reference frames."""
    path = tmp_path / "session"
    path.mkdir()
    (path / "session.toml").write_text(TOML)
    angles = (("a.png", 0.0, 0.02), ("b.png", 4.0, None))
    _fill(path / "ball", [FrameRow(image, angle, True, u_angle_deg=u) for image, angle, u in angles])
    times = ("2026-03-01T12:00:00.000Z", "2026-03-01T12:10:30.500Z", "")
    _fill(
        path / REFERENCE,
        [FrameRow(f"ball-{k:04d}.png", 0.0, True, pose="ball", time=time) for k, time in enumerate(times)],
    )
    return path


def test_angles_have_the_uncertainty_that_is_stated(session):
    a, b = read_session(session).captures[0].frames
    assert (math.degrees(a.u_angle_rad), b.u_angle_rad) == (pytest.approx(0.02), None)


@pytest.mark.parametrize("wrong", ["much", "-0.1", "nan", "inf"])
def test_an_uncertainty_that_is_none_is_told_and_not_used(session, wrong):
    table = session / "ball" / "frames.csv"
    table.write_text(table.read_text().replace(",0.02,", f",{wrong},"))
    read, (problem,) = inspect_session(session)
    assert read.captures[0].frames[0].u_angle_rad is None
    assert "frames.csv, line 2, u_angle_deg" in problem.where
    assert f"'{wrong}'" in problem.text
    assert not problem.fatal


def test_reference_frames_name_their_capture_and_time(session):
    frames = read_session(session).references
    assert [f.name for f in frames] == [f"{REFERENCE}/ball-{k:04d}.png" for k in range(3)]
    assert {f.pose for f in frames} == {"ball"}
    assert frames[1].time_s - frames[0].time_s == pytest.approx(630.5)
    assert frames[2].time_s is None
    assert [f.name for f in read_session(session).captures[0].frames] == ["ball/a.png", "ball/b.png"]


@pytest.mark.parametrize("time", ["noon", "12", "2026-03-01T12:00:00", "2026-03-01T13:00:00+01:00"])
def test_columns_of_other_programs_do_no_harm(session, time):
    table = session / REFERENCE / "frames.csv"
    table.write_text(table.read_text().replace("2026-03-01T12:00:00.000Z", time))
    frames = read_session(session).references
    assert len(frames) == 3
    if frames[0].time_s is not None:
        assert frames[1].time_s - frames[0].time_s == pytest.approx(630.5)


def test_without_the_folder_there_are_none(session):
    shutil.rmtree(session / REFERENCE)
    assert read_session(session).references == ()
    (session / REFERENCE).mkdir()  # something of the user's own
    read, problems = inspect_session(session)
    assert (read.references, problems) == ((), ())


def test_a_capture_of_that_name_is_a_capture(session):
    (session / "session.toml").write_text(TOML + '[[captures]]\nfolder = "reference"\nrole = "scan"\n')
    read = read_session(session)
    assert [len(c.frames) for c in read.captures] == [2, 3]
    assert read.references == ()


def test_whatever_is_wrong_with_them_the_session_can_be_processed(session):
    (session / REFERENCE / "ball-0000.png").unlink()
    (session / REFERENCE / "ball-0002.png").write_bytes(encode_png(_image(2, (30, 50))))
    read, problems = inspect_session(session)
    assert [f.name for f in read.references] == [f"{REFERENCE}/ball-0001.png"]
    assert [p.fatal for p in problems] == [False, False]
    assert "ball-0000.png" in problems[0].where
    assert "1 frame(s) without the capture" in problems[1].text


def test_a_packed_session_keeps_them(session, tmp_path):
    packed = pack_session(session, None, Silent()).folder
    back = unpack_session(packed, tmp_path / "back", Silent()).folder
    expected = read_session(session)
    for other in (packed, back):
        read = read_session(other)
        assert [(f.name, f.pose, f.time_s) for f in read.references] == [
            (f.name, f.pose, f.time_s) for f in expected.references
        ]
        assert [f.u_angle_rad for f in read.captures[0].frames] == [f.u_angle_rad for f in expected.captures[0].frames]
        for a, b in zip(read.references, expected.references, strict=True):
            assert (read_source(a.source) == read_source(b.source)).all()
    assert (back / REFERENCE / "frames.csv").read_bytes() == (session / REFERENCE / "frames.csv").read_bytes()
