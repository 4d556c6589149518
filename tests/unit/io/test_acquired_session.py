"""The session that grows: what is on disk when, and what is said."""

import csv
import json
import os
import re
from dataclasses import replace

import numpy as np
import pytest

from rotaline.errors import OutputError, SessionError
from rotaline.io import acquired_session
from rotaline.io.acquired_session import COLUMNS, AcquiredSession, FrameRow
from rotaline.vision.images import encode_png

PNG = encode_png(np.arange(64, dtype=np.uint8).reshape(8, 8))


def row(i, **changes):
    return replace(
        FrameRow(f"{i:04d}.png", 1.5 * i, True, "", 1e4, 1.0, "2026-01-01T00:00:00.000Z", 0.002, i), **changes
    )


def opened(path, plan="plan", rig="rig"):
    return AcquiredSession(path, plan, rig)


@pytest.fixture
def session(tmp_path):
    with opened(tmp_path / "s") as session:
        yield session


def table(session, folder="a"):
    return (session.path / folder / "frames.csv").read_text()


def test_a_row_holds_what_is_known():
    assert row(2, pose="4").text() == "0002.png,3.000000,on,4,10000,1,2026-01-01T00:00:00.000Z,0.002,2\n"
    assert FrameRow("a.png", None, False).text() == "a.png,,off,,,,,,\n"
    fields = next(csv.reader([row(1, pose='odd, "pose"').text()]))
    assert fields[3] == 'odd, "pose"'
    assert len(fields) == len(COLUMNS)


def test_an_image_is_on_disk_before_its_row(session, monkeypatch):
    """The order of what is forced to disk: image, its name, row."""
    done = []
    fsync, replaced = os.fsync, acquired_session.Path.replace

    def synced(handle):
        done.append(os.path.basename(os.readlink(f"/proc/self/fd/{handle}")))
        fsync(handle)

    def renamed(self, target):
        done.append(f"{self.name} -> {target.name}")
        return replaced(self, target)

    if not os.path.isdir("/proc/self/fd"):
        pytest.skip("the names of open files cannot be read here")
    session.add("a", row(0), PNG)
    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(acquired_session.Path, "replace", renamed)
    session.add("a", row(1), PNG)
    assert done == ["0001.png.part", "0001.png.part -> 0001.png", "a", "frames.csv"]


def test_what_was_added_is_found(session):
    for i in range(3):
        session.add("a", row(i), PNG)
    found = session.found(["a", "b"])
    assert found.listed == {"a": ("0000.png", "0001.png", "0002.png"), "b": ()}
    assert [r["angle_deg"] for r in found.rows["a"]] == ["0.000000", "1.500000", "3.000000"]
    assert found.repaired == ()
    assert table(session).splitlines()[0] == ",".join(COLUMNS)


@pytest.mark.parametrize("n_bytes", range(1, 60, 7))
def test_a_torn_last_line_is_cut_off(session, n_bytes):
    session.add("a", row(0), PNG)
    session.add("a", row(1), PNG)
    path = session.path / "a/frames.csv"
    data = path.read_bytes()
    last = data.splitlines(keepends=True)[-1]
    path.write_bytes(data[: len(data) - len(last) + min(n_bytes, len(last) - 1)])
    found = session.found(["a"])
    assert found.listed["a"] == ("0000.png",)
    assert found.repaired == ("a/frames.csv: the last line was half written; its frame is taken again.",)
    assert path.read_bytes() == data[: len(data) - len(last)]


def test_a_table_with_half_a_header_begins_anew(session):
    session.add("a", row(0), PNG)
    path = session.path / "a/frames.csv"
    path.write_text("image,ang")
    assert session.found(["a"]).listed["a"] == ()
    assert not path.exists()
    session.add("a", row(0), PNG)
    assert table(session).startswith(",".join(COLUMNS))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("image,angle_deg", "picture,angle", "line 1: found 'picture,angle,laser"),
        ("0001.png,1.5", "0001.png,x,1.5", "line 3: found '0001.png,x,1.500000"),
        ("0001.png", "../0001.png", "line 3: found '../0001.png"),
        ("0000.png", "", "line 2: found ',0.000000"),
    ],
)
def test_a_table_that_somebody_changed_is_refused(session, old, new, said):
    for i in range(2):
        session.add("a", row(i), PNG)
    path = session.path / "a/frames.csv"
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(SessionError, match=re.escape(said)) as error:
        session.found(["a"])
    assert "The table was changed since; acquire into another folder." in str(error.value)


def test_images_that_are_gone_or_cut_off_are_not_found(session):
    for i in range(3):
        session.add("a", row(i), PNG)
    (session.path / "a/0000.png").unlink()
    (session.path / "a/0001.png").write_bytes(PNG[:-20])
    found = session.found(["a"])
    assert [r["image"] for r in found.rows["a"]] == ["0002.png"]
    assert len(found.listed["a"]) == 3
    assert found.repaired == (
        "a/0000.png: it is listed, but the image is gone; it is taken again.",
        "a/0001.png: it is listed, but the image is damaged; it is taken again.",
    )


def test_the_last_rows_can_be_taken_back(session):
    for i in range(4):
        session.add("a", row(i), PNG)
    before = table(session)
    session.take_back("a", 2)
    assert table(session) == "".join(before.splitlines(keepends=True)[:3])
    assert sorted(p.name for p in (session.path / "a").glob("*.png")) == ["0000.png", "0001.png"]


@pytest.mark.parametrize("call", range(1, 5))
@pytest.mark.parametrize("operation", ["write", "fsync"])
def test_a_frame_that_cannot_be_written_is_not_listed(session, monkeypatch, operation, call):
    session.add("a", row(0), PNG)
    before, function, n = table(session), getattr(os, operation), []

    def failing(*args):
        n.append(None)
        if len(n) == call:
            if operation == "write":
                function(args[0], bytes(args[1])[:5])
            raise OSError(28, "No space left on device")
        return function(*args)

    with monkeypatch.context() as patch:
        patch.setattr(os, operation, failing)
        failed = call <= (2 if operation == "write" else 3)
        if failed:
            with pytest.raises(OutputError, match=r"0001\.png: cannot be written \(No space left on device\)"):
                session.add("a", row(1), PNG)
        else:
            session.add("a", row(1), PNG)
    assert table(session).startswith(before)
    assert (table(session) == before) == failed
    assert not list(session.path.rglob("*.part"))
    assert session.found(["a"]).listed["a"] == (("0000.png",) if failed else ("0000.png", "0001.png"))


def test_short_writes_are_continued(session, monkeypatch):
    write = os.write
    monkeypatch.setattr(os, "write", lambda handle, data: write(handle, bytes(data)[:7]))
    session.add("a", row(0), PNG)
    assert (session.path / "a/0000.png").read_bytes() == PNG
    assert table(session).splitlines()[1] + "\n" == row(0).text()


# the folder


def test_a_folder_of_something_else_is_refused(tmp_path):
    (tmp_path / "s").mkdir()
    (tmp_path / "s/notes.txt").write_text("mine")
    with pytest.raises(SessionError, match="exists already, and is no session that an acquisition began"):
        opened(tmp_path / "s")
    with pytest.raises(SessionError, match="exists already"):
        opened(tmp_path / "s/notes.txt")
    assert [p.name for p in (tmp_path / "s").iterdir()] == ["notes.txt"]


def test_an_empty_folder_and_one_that_was_hardly_begun_are_taken(tmp_path):
    (tmp_path / "empty").mkdir()
    opened(tmp_path / "empty").close()
    (tmp_path / "s/acquisition").mkdir(parents=True)
    (tmp_path / "s/acquisition/lock").touch()
    (tmp_path / "s/acquisition/.plan-x1.toml").write_text("ver")
    with opened(tmp_path / "s") as session:
        assert session.same_rig
        assert sorted(p.name for p in (tmp_path / "s/acquisition").iterdir()) == ["lock", "plan.toml", "rig.toml"]
    assert not (tmp_path / "s").exists(), "nothing was put into it"


BALL = '[[captures]]\nfolder = "ball"\nrole = "scan"\nstep_deg = 2.0\n'
ROD = '[[captures]]\nfolder = "rod"\nrole = "scan"\n'


def test_plan_and_rig_are_kept(tmp_path):
    plan = "version = 1\r\n# ä\n" + BALL
    with opened(tmp_path / "s", plan, "rig") as session:
        session.remember("ball.exposure_on_us", 1.0)
    assert (tmp_path / "s/acquisition/plan.toml").read_bytes() == plan.encode()
    with opened(tmp_path / "s", plan, "another") as session:
        assert not session.same_rig
    with pytest.raises(SessionError, match="begun with another plan"):
        opened(tmp_path / "s", plan + ROD)
    opened(tmp_path / "s", plan).close()  # what was refused holds nothing
    opened(tmp_path / "s", "version = 1\n" + BALL + "# only a comment").close()
    assert (tmp_path / "s/acquisition/plan.toml").read_bytes() == plan.encode()


@pytest.mark.parametrize(
    ("now", "said"),
    [
        (BALL.replace("2.0", "4.0") + ROD, ["capture 'ball', step_deg: 2.0 then, 4.0 now"]),
        (BALL + ROD + "frames = 3\n", ["capture 'rod', frames: not stated then, 3 now"]),
        (BALL, ["capture 'rod': not in the new plan"]),
        (BALL + ROD + ROD.replace("rod", "cone"), ["capture 'cone': only in the new plan"]),
        (ROD + BALL, ["the order of the captures"]),
        (
            "home = false\n" + BALL + ROD + '[targets.board]\nkind = "dots"\n[[measurements]]\nfeature = "sphere"\n',
            [
                "home: not stated then, False now",
                "targets.board.kind: not stated then, 'dots' now",
                "measurements[1].feature: not stated then, 'sphere' now",
            ],
        ),
    ],
)
def test_what_another_plan_says_differently_is_named(tmp_path, now, said):
    with opened(tmp_path / "s", BALL + ROD) as session:
        session.remember("ball.exposure_on_us", 1.0)
    with pytest.raises(SessionError) as error:
        opened(tmp_path / "s", now)
    first, *differences, go_on, begin = str(error.value).splitlines()
    assert first == f"{tmp_path / 's'}: this session was begun with another plan. What differs:"
    assert differences == [f"  {line}" for line in said]
    assert go_on.endswith(f"the plan that it was begun with: {tmp_path / 's/acquisition/plan.toml'}")
    assert "choose another folder" in begin


def test_of_many_differences_some_are_named(tmp_path):
    with opened(tmp_path / "s", BALL) as session:
        session.remember("ball.exposure_on_us", 1.0)
    with pytest.raises(SessionError, match="and 3 more"):
        opened(tmp_path / "s", BALL + "".join(ROD.replace("rod", f"rod-{i}") for i in range(11)))


def test_one_program_at_a_time(tmp_path):
    with opened(tmp_path / "s") as first:
        with pytest.raises(OutputError, match="another `rotaline acquire` writes this session"):
            opened(tmp_path / "s")
        first.close()
        opened(tmp_path / "s").close()


def test_values_are_remembered(tmp_path):
    with opened(tmp_path / "s") as session:
        assert session.remembered() == {}
        session.remember("a.exposure_on_us", 123.5)
        session.remember("images", [8, 8])
    with opened(tmp_path / "s") as session:
        assert session.remembered() == {"a.exposure_on_us": 123.5, "images": [8, 8]}


def test_events_are_lines_also_after_half_a_line(tmp_path):
    with opened(tmp_path / "s") as session:
        session.event("t", "resumed", "one", n=3)
    path = tmp_path / "s/acquisition/events.jsonl"
    path.write_text(path.read_text() + '{"time": "t", "ki')
    with opened(tmp_path / "s") as session:
        session.event("t", "resumed", "two")
    assert [json.loads(line)["text"] for line in path.read_text().splitlines()] == ["one", "two"]


def test_errors_name_the_file_and_no_option_that_is_not_there(session, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(acquired_session.Path, "write_bytes", full)
    for call in (lambda: session.write_session_file("x"), lambda: session.remember("a", 1)):
        with pytest.raises(
            OutputError, match=r"s(ession|ettings)\.(toml|json): cannot be written \(No space left"
        ) as error:
            call()
        assert "--out" not in str(error.value)
    assert not (session.path / "session.toml").exists()
