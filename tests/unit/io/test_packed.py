import json
import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rotaline.errors import OutputError, SessionError
from rotaline.io.frame_images import read_source, read_sources, source_state
from rotaline.io.session import inspect_session, read_session
from rotaline.pipeline.observer import Silent
from rotaline.pipeline.pack import pack_session, unpack_session


@pytest.fixture
def packed(mixed_session):
    """The container that the session was packed into."""
    return pack_session(mixed_session, None, Silent()).folder


def _frames(session):
    return [frame for capture in session.captures for frame in capture.frames]


def _facts(frame):
    return frame.name, frame.angle_rad, frame.laser_on, frame.pose


def _same(a, b):
    return a.dtype == b.dtype and a.shape == b.shape and bool((a == b).all())


def test_a_packed_session_is_read_like_its_folder(mixed_session, packed):
    folder, container = read_session(mixed_session), read_session(packed)
    assert container.name == folder.name == "rod"
    assert container.image_size == folder.image_size
    readable = [f for f in _frames(folder) if not f.name.endswith("hollow.png")]
    assert [_facts(f) for f in _frames(container)] == [_facts(f) for f in readable]
    images = list(read_sources(f.source for f in _frames(container)))
    assert len(images) == len(readable) == 77
    for frame, packed_frame, image in zip(readable, _frames(container), images, strict=True):
        assert _same(read_source(frame.source), image)
        assert _same(read_source(packed_frame.source), image)


def test_images_are_given_in_any_order_and_from_several_places(mixed_session, packed):
    here = [f.source for f in _frames(read_session(packed))]
    there = [f.source for f in _frames(read_session(mixed_session)) if "hollow" not in f.name]
    order = np.random.default_rng(2).permutation(len(here))
    chosen = [here[i] if i % 4 else there[i] for i in order]
    for i, image in zip(order, read_sources(chosen), strict=True):
        assert _same(image, read_source(there[i]))


def test_frames_that_cannot_be_read_are_left_out_with_the_same_words(mixed_session, packed):
    _, of_folder = inspect_session(mixed_session)
    _, of_packed = inspect_session(packed)
    assert [p.text for p in of_folder] == [p.text for p in of_packed if "hollow" not in p.where]
    (cut,) = (p for p in of_packed if "cut.png" in p.where)
    assert "cut off (500 bytes)" in cut.text
    assert "frames.csv, line 9" in cut.where
    (hollow,) = (p for p in of_packed if "hollow.png" in p.where)
    with pytest.raises(SessionError) as error:
        read_source(next(f.source for f in _frames(read_session(mixed_session)) if "hollow" in f.name))
    assert hollow.text == f"{str(error.value).partition('hollow.png: ')[2]} The frame is left out."


def test_unpacking_gives_texts_and_pixels_back(mixed_session, packed, tmp_path):
    result = unpack_session(packed, tmp_path / "again", Silent())
    assert (result.n_images, result.n_left_out, result.n_renamed) == (77, 2, 3)
    for name in ("session.toml", "scans/ball/frames.csv"):
        assert (result.folder / name).read_bytes() == (mixed_session / name).read_bytes()
    before = [f for f in _frames(read_session(mixed_session)) if "hollow" not in f.name]
    after = _frames(read_session(result.folder))
    for a, b in zip(before, after, strict=True):
        assert _facts(a)[1:] == _facts(b)[1:]
        assert _same(read_source(a.source), read_source(b.source))
    renamed = {Path(a.name).name: Path(b.name).name for a, b in zip(before, after, strict=True) if a.name != b.name}
    assert renamed == {"grey.bmp": "grey-1.png", "photo.jpg": "photo.png", "deep.tif": "deep-1.png"}
    assert '"gain, 5"' in (result.folder / "mixed" / "frames.csv").read_text()


def test_any_zarr_library_reads_the_arrays(packed):
    zarr = pytest.importorskip("zarr")
    session = read_session(packed)
    ball, mixed = (zarr.open_group(packed, mode="r")[c.folder] for c in session.captures)
    images = np.stack([read_source(f.source) for f in session.captures[0].frames])
    np.testing.assert_array_equal(ball["48x64-uint8"][:], images)
    assert {name: a.shape for name, a in mixed.arrays()} == {
        "48x64-uint8": (2, 48, 64),
        "48x64-uint16": (2, 48, 64),
        "48x64x3-uint8": (2, 48, 64, 3),
        "48x64x3-uint16": (1, 48, 64, 3),
    }
    for frame in session.captures[1].frames:
        image = read_source(frame.source)
        array = mixed[f"{'x'.join(map(str, image.shape))}-{image.dtype}"]
        assert any(_same(array[i], image) for i in range(array.shape[0]))


def test_the_state_of_an_image_changes_with_the_content_only(mixed_session, packed, tmp_path):
    def states(path):
        return [source_state(f.source) for f in _frames(read_session(path))]

    again = pack_session(mixed_session, tmp_path / "again.rotaline.zarr", Silent()).folder
    assert states(again) == states(packed)
    shutil.copy(mixed_session / "mixed" / "grey.png", mixed_session / "scans" / "ball" / "0000.png")
    other = pack_session(mixed_session, tmp_path / "other.rotaline.zarr", Silent()).folder
    assert not set(states(other)) & set(states(packed))


def test_sources_are_small_and_can_be_sent(packed):
    source = _frames(read_session(packed))[3].source
    sent = pickle.dumps(source)
    assert pickle.loads(sent) == source
    assert len(sent) < 1000


@pytest.mark.parametrize("damage", ["changed", "cut", "missing"])
def test_a_damaged_container_is_noticed(packed, damage):
    frames = _frames(read_session(packed))
    source = frames[0].source
    file = packed / source.file
    if damage == "changed":
        data = bytearray(file.read_bytes())
        data[source.start + source.length // 2] ^= 1
        file.write_bytes(data)
    elif damage == "cut":
        file.write_bytes(file.read_bytes()[: source.length - 1])
    else:
        file.unlink()
    with pytest.raises(SessionError, match="again") as error:
        read_source(source)
    assert "scans/ball/0069.png" in str(error.value)
    assert read_source(frames[-1].source).shape == (48, 64)


def test_a_container_that_is_not_complete_or_of_another_kind_is_refused(packed, mixed_session):
    text = (packed / "zarr.json").read_text()
    content = json.loads(text)
    content["attributes"]["rotaline"]["version"] = 2
    (packed / "zarr.json").write_text(json.dumps(content))
    with pytest.raises(SessionError, match=r"version 2.*Update"):
        read_session(packed)
    for wrong in (text[:1000], '{"zarr_format": 3, "node_type": "group", "attributes": {}}', "[]"):
        (packed / "zarr.json").write_text(wrong)
        with pytest.raises(SessionError, match=r"zarr\.json .*`rotaline pack`"):
            read_session(packed)
    (packed / "zarr.json").unlink()
    with pytest.raises(SessionError, match="not complete"):
        read_session(packed)


def test_what_stands_there_is_replaced_only_when_told_and_only_by_its_like(mixed_session, packed, tmp_path):
    before = (packed / "zarr.json").read_bytes()
    with pytest.raises(OutputError, match="--force"):
        pack_session(mixed_session, None, Silent())
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    for function, place in ((pack_session, mixed_session), (unpack_session, packed)):
        with pytest.raises(OutputError, match="--force replaces"):
            function(place, tmp_path / "mine", Silent(), force=True)
    with pytest.raises(OutputError):
        unpack_session(packed, None, Silent())
    assert (tmp_path / "mine" / "letter.txt").read_text() == "dear"
    assert (packed / "zarr.json").read_bytes() == before
    (mixed_session / "mixed" / "colour.png").unlink()
    pack_session(mixed_session, None, Silent(), force=True)
    assert (packed / "zarr.json").read_bytes() != before
    assert len(_frames(read_session(packed))) == 76
    assert sorted(p.name for p in tmp_path.iterdir()) == ["mine", "rod", "rod.rotaline.zarr"]


def test_nothing_is_written_into_a_session_nor_packed_twice(mixed_session, packed, tmp_path):
    with pytest.raises(SessionError, match="into a session"):
        pack_session(mixed_session, mixed_session / "packed", Silent())
    with pytest.raises(SessionError, match="packed already"):
        pack_session(packed, tmp_path / "x", Silent())
    with pytest.raises(SessionError, match="folder of images already"):
        unpack_session(mixed_session, tmp_path / "x", Silent())
    outside = (mixed_session / "session.toml").read_text(encoding="utf-8-sig").replace('"mixed"', '"../rod/mixed"')
    (mixed_session / "session.toml").write_text(outside, encoding="utf-8")
    with pytest.raises(SessionError, match="outside the session"):
        pack_session(mixed_session, tmp_path / "x", Silent())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["rod", "rod.rotaline.zarr"]


class _Stops(Silent):
    def work(self, label, total):
        if label == "mixed":
            raise KeyboardInterrupt
        return super().work(label, total)


@pytest.mark.parametrize("function", [pack_session, unpack_session])
def test_an_interrupt_leaves_nothing_behind(mixed_session, packed, tmp_path, function):
    place = mixed_session if function is pack_session else packed
    with pytest.raises(KeyboardInterrupt):
        function(place, tmp_path / "out", _Stops())
    assert sorted(p.name for p in tmp_path.iterdir()) == ["rod", "rod.rotaline.zarr"]


def test_long_rows_are_read_in_pieces(packed, monkeypatch):
    sources = [f.source for f in read_session(packed).captures[0].frames]
    expected = [read_source(s) for s in sources]
    monkeypatch.setattr("rotaline.io.packed._AT_ONCE", 2 * sources[0].length)
    read = []
    original = type(_location(sources[0])).read
    monkeypatch.setattr(
        "rotaline.io.locations.Location.read",
        lambda self, name, start=0, stop=None: read.append(stop - start) or original(self, name, start, stop),
    )
    assert all(_same(a, b) for a, b in zip(expected, read_sources(sources), strict=True))
    assert max(read) <= 2 * sources[0].length
    assert len(read) < len(sources)
    read.clear()
    monkeypatch.setattr("rotaline.io.packed._AT_ONCE", 1 << 23)
    list(read_sources(sources))
    assert len(read) == 2, "one request for each file"
    read.clear()
    list(read_sources([replace(sources[0]), sources[2], sources[1]]))
    assert len(read) == 2, "backwards is another request"


def _location(source):
    from rotaline.io.locations import Location

    return Location(source.address)
