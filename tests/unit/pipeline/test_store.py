import os

import pytest

from rotaline.io.frame_images import ImageFile
from rotaline.pipeline.observer import Silent
from rotaline.pipeline.store import StageStore, key_of, sources_key
from rotaline.vision.targets.model import Checkerboard


def _store(tmp_path, force=False):
    return StageStore(tmp_path / "stages", Silent(), force)


def test_a_stage_is_done_once_while_its_key_stays(tmp_path):
    calls = []

    def compute():
        calls.append(1)
        return (1.0, "x")

    for _ in range(2):
        assert _store(tmp_path).get("a", "A", "key1", compute) == (1.0, "x")
    assert len(calls) == 1
    _store(tmp_path).get("a", "A", "key2", compute)
    assert len(calls) == 2
    assert [p.name for p in (tmp_path / "stages").iterdir()] == ["a.key2.npz"]


def test_force_does_a_stage_again_but_only_once_a_run(tmp_path):
    calls = []
    _store(tmp_path).get("a", "A", "k", lambda: calls.append(1))
    store = _store(tmp_path, force=True)
    for _ in range(2):
        store.get("a", "A", "k", lambda: calls.append(1))
    assert len(calls) == 2


def test_a_damaged_result_is_made_again(tmp_path):
    _store(tmp_path).get("a", "A", "k", lambda: 1)
    (tmp_path / "stages" / "a.k.npz").write_bytes(b"half")
    assert _store(tmp_path).get("a", "A", "k", lambda: 2) == 2


def test_a_stage_that_fails_stores_nothing(tmp_path):
    def fail():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        _store(tmp_path).get("a", "A", "k", fail)
    assert list((tmp_path / "stages").iterdir()) == []


def test_stages_whose_names_begin_alike_do_not_remove_each_other(tmp_path):
    store = _store(tmp_path)
    store.get("stripes-a", "A", "k1", lambda: 1)
    store.get("stripes-a-b", "B", "k2", lambda: 2)
    store.get("stripes-a", "A", "k3", lambda: 3)
    assert sorted(p.name for p in (tmp_path / "stages").iterdir()) == ["stripes-a-b.k2.npz", "stripes-a.k3.npz"]


def test_variants_are_kept_until_nothing_asks_for_them(tmp_path):
    first = StageStore(tmp_path, Silent(), keep_variants=True)
    assert [first.get("axis", "A", key, lambda key=key: key) for key in ("k1", "k2", "k1")] == ["k1", "k2", "k1"]
    second = StageStore(tmp_path, Silent(), keep_variants=True)
    assert second.get("axis", "A", "k1", lambda: "made again") == "k1"
    second.forget_unused()
    assert [p.name for p in tmp_path.iterdir()] == ["axis.k1.npz"]


def test_the_key_follows_files_and_values(tmp_path):
    file = tmp_path / "x.png"
    file.write_bytes(b"1")
    first = sources_key([ImageFile(str(file))])
    assert sources_key([ImageFile(str(file))]) == first
    os.utime(file, ns=(1, 1))
    assert sources_key([ImageFile(str(file))]) != first
    assert key_of(Checkerboard((3, 2), 4.0)) != key_of(Checkerboard((3, 2), 4.1))
    assert key_of(Checkerboard((3, 2), 4.0)) == key_of(Checkerboard((3, 2), 4.0))
