import json
import os

import numpy as np
import pytest

from rotaline.errors import OutputError, SessionError
from rotaline.io.files import read_json, whole_file, write_json


def test_a_file_that_fails_half_way_leaves_the_old_one(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def fail_half_way():
        with whole_file(path) as temporary:
            temporary.write_text("ne")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_half_way()
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_no_space_is_said_as_such_and_leaves_nothing(tmp_path):
    path = tmp_path / "a.txt"
    with pytest.raises(OutputError, match=r"a\.txt: no space left"), whole_file(path):
        raise OSError(28, os.strerror(28))
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_a_file_is_said_as_such(tmp_path):
    (tmp_path / "a").write_text("")
    with pytest.raises(OutputError, match="cannot be written"), whole_file(tmp_path / "a" / "b.txt"):
        pass


def test_json_has_numbers_for_numpy_and_null_for_nan(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"x": np.float64(1.5), "y": np.array([1, 2]), "z": (np.nan, np.int64(3)), "b": np.bool_(True)})
    assert json.loads(path.read_text()) == {"x": 1.5, "y": [1, 2], "z": [None, 3], "b": True}


def test_broken_json_is_said_with_its_line(tmp_path):
    (tmp_path / "a.json").write_text('{"a": 1,\n "b": }')
    with pytest.raises(SessionError, match=r"a\.json, line 2: the thing"):
        read_json(tmp_path / "a.json", "thing")
