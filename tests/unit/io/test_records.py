import json

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform

from rotaline.calibration.model import StripeOnBoard, TargetView
from rotaline.errors import SessionError
from rotaline.io.records import read_record, write_record
from rotaline.vision.targets.model import CharucoBoard, Checkerboard, TargetDetection


def test_a_tree_of_values_comes_back(tmp_path):
    detection = TargetDetection(Checkerboard((3, 2), 4.0), np.arange(6), np.random.default_rng(0).random((6, 2)), 0.02)
    pose = RigidTransform.from_translation([1.0, 2.0, 3.0])
    points = np.array([[np.nan, 1.0, 2.0]])
    stripe = StripeOnBoard("laser/1", False, "too few", pose, np.ones((1, 2)), points, np.array([np.inf]))
    value = {
        "a": (TargetView("x", detection, None), stripe),
        "b": [1, 2.5, "text", True, None],
        "c": CharucoBoard((5, 4), 8.0, 6.0, "D"),
    }
    write_record(tmp_path / "r.npz", value)
    back = read_record(tmp_path / "r.npz")
    assert back["b"] == [1, 2.5, "text", True, None]
    assert back["c"] == value["c"]
    view, board = back["a"]
    assert (view.detection.uv == detection.uv).all()
    assert view.detection.target == detection.target
    assert view.angle_rad is None
    assert np.array_equal(board.points_camera, points, equal_nan=True)
    assert board.camera_from_board.as_matrix() == pytest.approx(pose.as_matrix())
    assert board.used is False


@pytest.mark.parametrize("content", [b"", b"no record", b"PK\x03\x04" + b"\0" * 50])
def test_a_damaged_record_is_refused(tmp_path, content):
    (tmp_path / "r.npz").write_bytes(content)
    with pytest.raises(SessionError, match=r"r\.npz"):
        read_record(tmp_path / "r.npz")


@pytest.mark.parametrize("name", ["os:system", "rotaline.io.files:write_json", "rotaline.nothing:X"])
def test_a_record_never_names_foreign_code(tmp_path, name):
    tree = json.dumps({"class": name, "fields": {}})
    np.savez(tmp_path / "r.npz", tree=np.array(tree))
    with pytest.raises(SessionError):
        read_record(tmp_path / "r.npz")


def test_a_value_that_cannot_be_stored_leaves_no_file(tmp_path):
    with pytest.raises(TypeError, match="object"):
        write_record(tmp_path / "r.npz", {"a": object()})
    assert list(tmp_path.iterdir()) == []
