from dataclasses import replace

import numpy as np
import pytest

from rotaline.io.session import Capture, Session
from rotaline.pipeline.reproduce.plan import FULL, QUICK, article_rig, mount_names, session_plans
from rotaline.pipeline.reproduce.sessions import joined


@pytest.fixture(scope="module")
def quick_plans():
    rig_file = article_rig(QUICK.small_images)
    return {seed: session_plans(rig_file, QUICK, seed) for seed in (1, 2)}


def _stands(plans, name):
    return [c.shots[0].on_table[0].frame_from_part.translation for c in plans[name].captures]


def test_there_is_a_session_for_the_sensor_for_each_mount_and_for_each_part(quick_plans):
    plans = quick_plans[1]
    assert list(plans) == ["sensor", *mount_names(), "ball", "cylinder", "groove"]
    folders = [c.folder for plan in plans.values() for c in plan.captures]
    assert len(set(folders)) == len(folders)
    assert [c.role for c in plans["W3"].captures] == ["axis", "artifact"]
    assert all(len(plans[name].captures) == 5 for name in ("ball", "cylinder", "groove"))


def test_mounts_and_positions_differ_and_follow_the_seed(quick_plans):
    first, other = quick_plans[1], quick_plans[2]
    stands = np.array([_stands(first, name)[1] for name in mount_names()])
    assert np.all((np.hypot(*stands[:, :2].T) > 2.0) & (np.hypot(*stands[:, :2].T) < 6.0))
    boards = np.array([_stands(first, name)[0] for name in mount_names()])
    for places in (stands, boards, np.array(_stands(first, "ball"))):
        distances = np.linalg.norm(places[:, None] - places[None], axis=2) + np.eye(5)
        assert distances.min() > 0.05
    assert not np.allclose(_stands(first, "ball"), _stands(other, "ball"))
    again = session_plans(article_rig(QUICK.small_images), QUICK, 1)
    assert np.array_equal(_stands(first, "groove"), _stands(again, "groove"))


def test_the_full_effort_is_the_article_s():
    rig = article_rig(FULL.small_images).rig()
    assert rig.camera.image_size == (1280, 960)
    assert (FULL.n_camera_views, FULL.n_laser_poses, FULL.axis_step_deg, FULL.n_artifact_frames) == (20, 10, 2.0, 90)


def test_the_quick_rig_sees_the_same_as_the_full_one():
    full, quick = (article_rig(effort.small_images).rig() for effort in (FULL, QUICK))
    corners = np.array([[-40.0, -40.0, 20.0], [40.0, 40.0, 20.0]])
    seen = [rig.camera.project(rig.camera_from_base.apply(corners)) for rig in (full, quick)]
    # pixel centres: the edge of the image lies half a pixel beyond the first
    np.testing.assert_allclose((seen[0] + 0.5) / 2 - 0.5, seen[1], atol=0.1)


def test_captures_of_one_name_cannot_be_joined(tmp_path):
    capture = Capture("ball", "scan", "", None, ())
    session = Session(tmp_path / "a", {}, (capture,), (), (640, 480))
    other = replace(session, path=tmp_path / "b")
    with pytest.raises(ValueError, match="ball"):
        joined({"a": session, "b": other})
    assert joined({"a": session, "b": replace(other, captures=())}).captures == (capture,)
