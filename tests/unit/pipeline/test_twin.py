"""Observations of the twin under the names of a session folder."""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.pipeline.twin import trace_twin
from rotaline.simulation.rig import build_rig
from rotaline.simulation.small_session import CHECKERBOARD, STEPPED_CYLINDER, small_plan

RIG = build_rig((640, 480), turn_sense=-1)
PLAN = small_plan(RIG)


@pytest.fixture(scope="module")
def twin():
    return trace_twin(RIG, PLAN, spacing_px=4.0)


def test_every_part_of_a_session_is_there_under_its_name(twin):
    session = twin.observed(0.02, 0.05, 3)
    seen = session.observations
    assert seen.image_size == (640, 480)
    assert [v.name for v in seen.camera_views] == [f"camera/{i:04d}.png" for i in range(10)]
    assert all(v.angle_rad is None for v in seen.camera_views)
    assert seen.preferred_folders == {"laser"}
    assert [(v.name, v.detection_name) for v in seen.plate_views] == [
        (f"laser/{2 * i + 1:04d}.png", f"laser/{2 * i:04d}.png") for i in range(5)
    ]
    assert [v.angle_rad for v in seen.table_views] == pytest.approx(np.radians(np.arange(0.0, 45.0, 5.0)).tolist())
    (mount,) = seen.mounts
    assert (mount.name, mount.artifact, len(mount.stripes)) == ("stepped", STEPPED_CYLINDER, 16)
    assert mount.angles_rad == pytest.approx(np.radians(np.arange(16) * 22.5))
    assert set(session.scans) == {"stepped", "ball"}
    assert session.scans["ball"].frame_names[-1] == "ball/0015.png"
    assert sum(len(s) for s in session.scans["ball"].stripes) > 500


def test_the_noise_is_that_of_the_seed_and_has_the_size_asked_for(twin):
    clean, noisy, again, other = (
        twin.observed(target_px, 0.1, seed).observations
        for target_px, seed in ((0.0, 1), (0.05, 1), (0.05, 1), (0.05, 2))
    )
    errors = np.concatenate(
        [b.detection.uv - a.detection.uv for a, b in zip(clean.camera_views, noisy.camera_views, strict=True)]
    )
    assert np.std(errors) == pytest.approx(0.05, rel=0.06)  # 2 * 1260 numbers
    assert np.array_equal(noisy.mounts[0].stripes[0].uv, again.mounts[0].stripes[0].uv)
    assert not np.array_equal(noisy.mounts[0].stripes[0].uv, other.mounts[0].stripes[0].uv)
    outliers = twin.observed(0.0, 0.0, 1, outlier_fraction=0.03).observations.mounts[0]
    exact = twin.observed(0.0, 0.0, 1).observations.mounts[0]
    pairs = zip(outliers.stripes, exact.stripes, strict=True)  # of those that no outlier has left
    moved = np.concatenate([np.linalg.norm(a.uv - b.uv, axis=1) for a, b in pairs if len(a) == len(b)])
    assert 0.01 < np.mean(moved > 0.01) < 0.06


def test_targets_are_those_that_the_session_states():
    stated = replace(CHECKERBOARD, pitch=4.6)
    plan = replace(small_plan(RIG, captures=("camera",)), targets={"checkerboard": stated})
    session = trace_twin(RIG, plan).observed(0.0, 0.0, 1)
    assert {v.detection.target for v in session.observations.camera_views} == {stated}
    assert session.observations.plate_views == session.observations.table_views == session.observations.mounts == ()
    assert session.scans == {}
