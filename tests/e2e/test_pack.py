"""Every command reads a packed session, and one at an address, like the folder: the same results bit for bit."""

import json
import os
import shutil

import fsspec
import pytest

from rotaline.cli.app import main
from rotaline.io.frame_images import read_source
from rotaline.io.session import read_session

OK, INCOMPLETE, BAD_INPUT, NOT_WRITTEN, INTERRUPTED = 0, 1, 2, 4, 130


@pytest.fixture(scope="module")
def packed(calibrated, tmp_path_factory):
    """The session of the tests as a container; not to be changed."""
    path = tmp_path_factory.mktemp("packed") / "session.rotaline.zarr"
    assert main(["pack", str(calibrated.session), str(path), "--quiet"]) == OK
    return path


@pytest.fixture
def memory(calibrated, packed):
    """The session and the container at addresses."""
    fs = fsspec.filesystem("memory")
    for folder in (calibrated.session, packed):
        for path in folder.rglob("*"):
            if path.is_file():
                fs.pipe_file(f"/bucket/{folder.name}/{path.relative_to(folder).as_posix()}", path.read_bytes())
    yield "memory://bucket"
    fs.rm("/bucket", recursive=True)


@pytest.fixture(scope="module")
def scanned(calibrated, tmp_path_factory):
    """What scan and measure give for the folder."""
    folder = tmp_path_factory.mktemp("scanned")
    given = ["--calibration", str(calibrated.results / "calibration.json"), "--out", str(folder), "--quiet"]
    assert main(["measure", str(calibrated.session), *given]) == OK
    return folder


def _result_bytes(folder):
    return {name: (folder / name).read_bytes() for name in ("clouds/ball.ply", "measurements.json")}


@pytest.mark.parametrize("place", ["session.rotaline.zarr", "memory:session", "memory:session.rotaline.zarr"])
def test_a_scan_is_the_same_from_wherever_it_is_read(
    place, calibrated, packed, scanned, memory, call, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    session = f"{memory}/{place.partition(':')[2]}" if ":" in place else packed
    outcome = call(
        "measure", session, "--calibration", calibrated.results / "calibration.json", "--out", tmp_path / "out"
    )
    assert outcome.code == OK, outcome.err
    assert _result_bytes(tmp_path / "out") == _result_bytes(scanned)
    again = call(
        "measure", session, "--calibration", calibrated.results / "calibration.json", "--out", tmp_path / "out"
    )
    assert again.code == OK
    assert "stored result" in again.err, "an image that did not change is known again"


def test_a_calibration_is_the_same_from_a_container(calibrated, memory, call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = call("calibrate", f"{memory}/session.rotaline.zarr")
    assert outcome.code == OK, outcome.err
    results = tmp_path / "session-results"
    for name in ("calibration.json", "verdict.json"):
        assert (results / name).read_bytes() == (calibrated.results / name).read_bytes()
    verdict = call("diagnose", f"{memory}/session.rotaline.zarr", "--json")
    assert verdict.out == call("diagnose", calibrated.results, "--json").out


def test_check_says_the_same_of_a_container(calibrated, packed, memory, call):
    expected = json.loads(call("check", calibrated.session, "--json").out)
    for place in (packed, f"{memory}/session", f"{memory}/session.rotaline.zarr"):
        outcome = call("check", place, "--json")
        assert outcome.code == OK
        assert json.loads(outcome.out) | {"session": ""} == expected | {"session": ""}


def test_packing_and_unpacking_a_session(fresh, call, tmp_path):
    outcome = call("pack", fresh.session)
    assert outcome.code == OK, outcome.err
    packed = tmp_path / "session.rotaline.zarr"
    assert f"{packed}: " in outcome.out
    assert call("pack", fresh.session).code == NOT_WRITTEN
    assert call("pack", fresh.session, "--force").code == OK
    assert call("unpack", packed, tmp_path / "again").code == OK
    names = sorted(p.relative_to(fresh.session) for p in fresh.session.rglob("*"))
    assert sorted(p.relative_to(tmp_path / "again") for p in (tmp_path / "again").rglob("*")) == names
    for name in names:
        if name.suffix in (".toml", ".csv"):
            assert (tmp_path / "again" / name).read_bytes() == (fresh.session / name).read_bytes()
    sessions = read_session(fresh.session), read_session(tmp_path / "again")
    for a, b in zip(*([f for c in s.captures for f in c.frames] for s in sessions), strict=True):
        assert (read_source(a.source) == read_source(b.source)).all()


def test_frames_that_cannot_be_read_are_named_when_packing_and_ever_after(fresh, call, tmp_path):
    data = (fresh.session / "axis" / "0003.png").read_bytes()
    (fresh.session / "axis" / "0003.png").write_bytes(data[: len(data) // 2])
    outcome = call("pack", fresh.session)
    assert outcome.code == INCOMPLETE
    assert "0003.png" in outcome.err
    assert "cannot be read: 1" in outcome.out
    for command in ("check", "unpack"):
        outcome = call(
            command, tmp_path / "session.rotaline.zarr", *([tmp_path / "again"] if command == "unpack" else [])
        )
        assert outcome.code == INCOMPLETE
        text = " ".join((outcome.err + outcome.out).split())
        assert "0003.png: the file is cut off" in text
        assert "left out" in text


def test_results_never_go_into_a_container(packed, call):
    outcome = call("calibrate", packed, "--out", packed / "results")
    assert outcome.code == BAD_INPUT
    assert "into the session" in outcome.err
    assert not (packed / "results").exists()


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("run", "memory://nowhere"), BAD_INPUT, "no such folder"),
        (("check", "s4://bucket/x"), BAD_INPUT, "s4"),
        (("pack", "nowhere"), BAD_INPUT, "no such folder"),
        (("unpack", "nowhere"), BAD_INPUT, "no such folder"),
        (("measure", "memory://nowhere"), BAD_INPUT, "no such folder"),
        (("diagnose", "memory://nowhere"), 3, "no such folder"),
        (("measure", "nowhere.ply", "--feature", "sphere"), BAD_INPUT, "nowhere.ply"),
    ],
    ids=lambda v: " ".join(v) if isinstance(v, tuple) else None,
)
def test_addresses_that_lead_nowhere_are_refused_with_a_sentence(arguments, code, words, call, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = call(*arguments)
    assert outcome.code == code
    assert words in outcome.err + " ".join(outcome.out.split())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("n_files", [0, 3])
def test_a_full_disk_leaves_no_part_of_a_container(n_files, fresh, call, tmp_path, monkeypatch):
    import rotaline.io.packed_writer as writer

    count = iter(range(1000))
    made = writer.shard_file

    def fill_up(*where):
        if next(count) >= n_files:
            raise OSError(28, os.strerror(28))
        return made(*where)

    monkeypatch.setattr(writer, "shard_file", fill_up)
    outcome = call("pack", fresh.session)
    assert outcome.code == NOT_WRITTEN
    assert "no space left" in outcome.err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["session"]


def test_an_interrupted_pack_says_that_nothing_was_written(fresh, call, tmp_path, monkeypatch):
    def press_ctrl_c(frame):
        raise KeyboardInterrupt

    monkeypatch.setattr("rotaline.pipeline.pack._pack", press_ctrl_c)
    outcome = call("pack", fresh.session)
    assert outcome.code == INTERRUPTED
    assert "Nothing was written" in outcome.err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["session"]


def test_a_container_that_was_copied_in_part_is_refused(packed, call, tmp_path):
    shutil.copytree(packed, tmp_path / "part.rotaline.zarr")
    (tmp_path / "part.rotaline.zarr" / "zarr.json").unlink()
    outcome = call("check", tmp_path / "part.rotaline.zarr")
    assert outcome.code == BAD_INPUT
    assert "not complete" in " ".join(outcome.out.split())
