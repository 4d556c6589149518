import os

import numpy as np
import pytest

from rotaline.io.frame_images import ImageFile
from rotaline.pipeline.observer import Silent
from rotaline.pipeline.store import StageResult, StageStore, key_of, sources_key
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


def test_a_stage_of_pieces_goes_on_and_replaces_an_older_one_when_it_is_complete(tmp_path):
    old = _store(tmp_path).pieces("stripes-a", "k1")
    old.write(0, StageResult(1.0, "old"))
    store = _store(tmp_path)
    pieces = store.pieces("stripes-a", "k2")
    pieces.write(0, StageResult(1.0, "new"))
    assert [pieces.has(n) for n in (0, 32)] == [True, False]
    assert old.has(0), "the new one is not complete"
    pieces.write(32, StageResult(2.0, "more"))
    store.pieces_complete("stripes-a", "k2")
    assert not old.has(0)
    again = _store(tmp_path).pieces("stripes-a", "k2")
    assert (again.read(0).value, again.read(32).value) == ("new", "more")
    assert not _store(tmp_path, force=True).pieces("stripes-a", "k2").has(0)


def test_a_capture_whose_name_has_a_dot_keeps_its_results(tmp_path):
    store = _store(tmp_path)
    store.get("detect-part.1", "A", "k", lambda: 1)
    store.get("detect-part.2", "B", "k", lambda: 2)
    assert sorted(p.name for p in (tmp_path / "stages").iterdir()) == ["detect-part.1.k.npz", "detect-part.2.k.npz"]


def test_a_key_follows_every_digit_of_an_array():
    values = np.array([1.0, 2.0])
    assert key_of(values) == key_of(values.copy())
    assert key_of(values) != key_of(values + 1e-15)
