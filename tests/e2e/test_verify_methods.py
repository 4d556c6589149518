"""``rotaline verify-methods --rendered``: both methods on the images of a small rendered session."""

import json

import pytest

from rotaline.simulation.rig import build_rig
from rotaline.simulation.session import write_session
from rotaline.simulation.small_session import small_plan


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rendered") / "small"
    rig = build_rig((320, 240))
    write_session(folder, rig, small_plan(rig))
    return folder


def test_both_methods_are_compared_on_rendered_images(rendered, tmp_path, call):
    out = call("verify-methods", "--rendered", rendered, "--out", tmp_path / "out", "--jobs", "1", "--json")
    assert out.code == 0, out.err
    result = json.loads(out.out)
    assert (result["n_sessions"], result["rendered"], result["failures"]) == (1, True, [])
    rows = {row["quantity"]: row for row in result["rows"]}
    axis = rows["axis, position at the table"]
    assert 0 < axis["joint"] < 0.1
    assert 0 < axis["article"] < 1.0
    assert 0 < rows["ball, diameter"]["joint"] < 0.1
    assert rows["rod, diameter"]["joint"] is None  # there is none in this session
    assert (tmp_path / "out" / "small-joint" / "calibration.json").is_file()
    assert (tmp_path / "out" / "small-article" / "measurements.json").is_file()
