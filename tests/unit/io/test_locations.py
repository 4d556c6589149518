import zipfile
from importlib.util import find_spec

import fsspec
import pytest

from rotaline.errors import SessionError
from rotaline.io.frame_images import read_source, read_sources, source_state
from rotaline.io.locations import Location, locate
from rotaline.io.session import inspect_session, read_session
from rotaline.pipeline.observer import Silent
from rotaline.pipeline.pack import pack_session, unpack_session


@pytest.fixture
def memory():
    """An empty file system that has addresses."""
    fs = fsspec.filesystem("memory")
    fs.rm("/", recursive=True) if fs.ls("/") else None
    yield fs
    fs.rm("/", recursive=True) if fs.ls("/") else None


def _put(fs, folder, address):
    for path in folder.rglob("*"):
        if path.is_file():
            fs.pipe_file(f"{address}/{path.relative_to(folder).as_posix()}", path.read_bytes())


def _pixels(session):
    frames = [f for c in session.captures for f in c.frames if "hollow" not in f.name]
    return [
        (f.name, f.angle_rad, image.tobytes())
        for f, image in zip(frames, read_sources(f.source for f in frames), strict=True)
    ]


def test_a_session_at_an_address_is_read_like_its_folder(mixed_session, memory):
    _put(memory, mixed_session, "/bucket/rod")
    here, there = read_session(mixed_session), read_session("memory://bucket/rod")
    assert there.name == here.name
    assert [p.text for p in there.problems] == [p.text for p in here.problems] != []
    assert _pixels(there) == _pixels(here)


def test_a_packed_session_at_an_address_is_read_with_few_requests(mixed_session, memory, monkeypatch):
    packed = pack_session(mixed_session, None, Silent()).folder
    _put(memory, packed, "/bucket/rod.rotaline.zarr")
    there = read_session("memory://bucket/rod.rotaline.zarr/")
    assert there.name == "rod"
    assert _pixels(there) == _pixels(read_session(packed))
    requests = []
    original = type(memory).cat_file
    monkeypatch.setattr(
        type(memory), "cat_file", lambda self, path, **where: requests.append(path) or original(self, path, **where)
    )
    session = read_session("memory://bucket/rod.rotaline.zarr")
    assert len(requests) == 1
    for frame in session.captures[0].frames:
        source_state(frame.source)
    assert len(requests) == 1, "the state of an image is known without asking"
    list(read_sources(f.source for f in session.captures[0].frames))
    assert len(requests) == 3


def test_a_session_at_an_address_can_be_packed_and_unpacked_here(mixed_session, memory, tmp_path, monkeypatch):
    _put(memory, mixed_session, "/bucket/rod")
    (tmp_path / "desk").mkdir()
    monkeypatch.chdir(tmp_path / "desk")
    packed = pack_session("memory://bucket/rod", None, Silent()).folder
    assert packed == tmp_path / "desk" / "rod.rotaline.zarr"
    _put(memory, packed, "/bucket/rod.rotaline.zarr")
    unpacked = unpack_session("memory://bucket/rod.rotaline.zarr", None, Silent()).folder
    assert unpacked == tmp_path / "desk" / "rod"
    assert [p[1:] for p in _pixels(read_session(unpacked))] == [p[1:] for p in _pixels(read_session(mixed_session))]


@pytest.mark.parametrize("kind", ["folder", "packed"])
def test_a_session_inside_an_archive_is_read(mixed_session, tmp_path, kind):
    folder = mixed_session if kind == "folder" else pack_session(mixed_session, None, Silent()).folder
    with zipfile.ZipFile(tmp_path / "archive.zip", "w") as archive:
        for path in folder.rglob("*"):
            archive.write(path, f"deep/{path.relative_to(folder)}")
    there = read_session(f"zip://deep::file://{tmp_path}/archive.zip")
    assert there.name == "deep"
    assert _pixels(there) == _pixels(read_session(mixed_session))


def test_a_file_address_is_a_folder_of_this_machine(mixed_session):
    assert locate(f"file://{mixed_session}") == locate(mixed_session)
    assert _pixels(read_session(f"file://{mixed_session}")) == _pixels(read_session(mixed_session))


def test_the_state_of_a_remote_image_changes_with_the_file(mixed_session, memory):
    _put(memory, mixed_session, "/rod")

    def states():
        return [source_state(f.source) for f in read_session("memory://rod").captures[1].frames]

    before = states()
    assert states() == before
    _put(memory, mixed_session, "/rod")
    assert all(a != b for a, b in zip(before, states(), strict=True)), "they are newer, though of the same size"


def test_an_image_that_vanished_is_named(mixed_session, memory):
    _put(memory, mixed_session, "/rod")
    source = read_session("memory://rod").captures[1].frames[0].source
    memory.rm("/rod/mixed/grey.png")
    with pytest.raises(SessionError, match=r"memory://rod/mixed/grey\.png: the image is missing"):
        read_source(source)
    assert any("grey.png" in p.where and "missing" in p.text for p in inspect_session("memory://rod")[1])


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({}, "no such folder"),
        ({"/a/x.txt": b""}, "no session.toml"),
        ({"/a": b""}, "this is a file"),
        ({"/a/session.toml": b"version = = 1"}, "session.toml, line 1"),
    ],
)
def test_what_is_no_session_at_an_address_is_said_as_such(memory, files, words):
    for name, data in files.items():
        memory.pipe_file(name, data)
    session, problems = inspect_session("memory://a")
    assert session is None
    assert words in str(problems[0])
    assert str(problems[0]).startswith("memory://a")


@pytest.mark.skipif(find_spec("s3fs") is not None, reason="the package that is missing elsewhere is there")
def test_a_missing_package_is_named():
    with pytest.raises(SessionError, match=r"s3://bucket/rod: a package .* s3fs"):
        read_session("s3://bucket/rod")


def test_an_unknown_kind_of_address_is_refused():
    with pytest.raises(SessionError, match=r"carrier-pigeon.*Expected"):
        read_session("carrier-pigeon://x")


@pytest.mark.parametrize(
    ("error", "words"), [(PermissionError(13, "denied"), "no permission"), (TimeoutError("after 5 s"), "after 5 s")]
)
def test_what_goes_wrong_on_the_way_becomes_a_sentence(memory, monkeypatch, error, words):
    def fail(*args, **where):
        raise error

    monkeypatch.setattr(type(memory), "cat_file", fail)
    with pytest.raises(SessionError, match=f"memory://x: cannot be read .*{words}.*credentials"):
        read_session("memory://x")


def test_names_come_from_where_the_session_is():
    names = {"s3://bucket/rod/": "rod", "zip::https://host/rod.zip": "rod", "memory://rod.rotaline.zarr": "rod"}
    assert {address: Location(address).name for address in names} == names
