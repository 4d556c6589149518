"""Rig files: what they mean, and what is said about a wrong one."""

import numpy as np
import pytest

from rotaline.errors import RigError
from rotaline.io.rig_file import parse_rig, preset_text, read_preset, read_rig_file

SMALL = """version = 1
[camera]
position_mm = [200, -80, 180]
[laser]
position_mm = [150, 60, 210]
[parts.ball]
kind = "sphere"
diameter_mm = 28.475
[[captures]]
folder = "ball"
role = "scan"
part = "ball"
"""


def test_a_few_lines_are_enough():
    file = parse_rig(SMALL, "rig.toml")
    rig, plan = file.rig(), file.plan()
    assert rig.camera.image_size == (1280, 960)
    assert len(plan.captures[0].shots) == 90
    np.testing.assert_allclose(rig.camera.project(rig.camera_from_base.apply([[0.0, 0.0, 24.0]])), [[639.5, 479.5]])


def test_the_article_has_its_targets_parts_and_frames():
    file = read_preset("article")
    plan = file.plan()
    frames = {capture.folder: len(capture.shots) for capture in plan.captures}
    assert frames == {
        "camera": 20,
        "laser": 20,
        "axis": 21,
        "stepped-1": 90,
        "stepped-2": 90,
        "ball": 90,
        "rod": 90,
        "groove": 90,
    }
    assert plan.targets["checkerboard"].inner_corners == (18, 16)
    assert plan.targets["stepped-cylinder"].diameter_large == 36.006
    assert [m.reference for m in plan.measurements] == [{"diameter": 28.475}, {"diameter": 38.004}, {"depth": 12.003}]


def test_a_preset_can_be_changed_in_one_place():
    file = parse_rig('preset = "article"\n[turntable]\nangle_noise_deg = 0.02\n', "rig.toml")
    assert file.rig().mechanics.angle_noise_deg == 0.02
    assert file.rig().mechanics.run_out_um == 1.0
    assert file.rig().camera == read_preset("article").rig().camera


def test_a_wrong_key_is_named_with_its_line():
    with pytest.raises(
        RigError, match=r"rig.toml, line 3, camera.position: there is no such key; expected one of position_mm"
    ):
        parse_rig(SMALL.replace("position_mm = [200", "position = [200"), "rig.toml")


def test_a_file_that_is_missing_is_named(tmp_path):
    with pytest.raises(RigError, match=r"none\.toml: the rig file cannot be read"):
        read_rig_file(tmp_path / "none.toml")
    with pytest.raises(RigError, match="expected one of article"):
        preset_text("demo")
