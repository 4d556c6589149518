"""What a session says about the angles of its frames reaches those who use them."""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.io.acquired_session import COLUMNS, FrameRow
from rotaline.io.session import read_session
from rotaline.pipeline.observe import SessionSource
from rotaline.pipeline.observer import Silent
from rotaline.pipeline.options import Options
from rotaline.pipeline.stage_runner import StoredStageRunner
from rotaline.pipeline.store import StageStore
from rotaline.simulation.ideal.stripes import StripeScene, render_stripe
from rotaline.vision.images import encode_png

SCENE = StripeScene(image_size=(100, 80), angle_deg=80.0)
TOML = """version = 1
[targets.ball]
kind = "sphere"
diameter = 20.0
[targets.board]
kind = "checkerboard"
inner_corners = [5, 4]
pitch = 4.0
[[captures]]
folder = "axis"
role = "axis"
target = "board"
[[captures]]
folder = "ball"
role = "artifact"
target = "ball"
"""
U_DEG = (0.02, None, 0.05)


@pytest.fixture
def session(tmp_path):
    """Three angles of a stripe on a ball, and of a board that cannot be seen; the second angle has no uncertainty."""
    path = tmp_path / "session"
    path.mkdir()
    (path / "session.toml").write_text(TOML)
    for folder, lit in (("axis", False), ("ball", True)):
        (path / folder).mkdir()
        rows = [FrameRow(f"{k}.png", 10.0 * k, lit, u_angle_deg=u) for k, u in enumerate(U_DEG)]
        (path / folder / "frames.csv").write_text(",".join(COLUMNS) + "\n" + "".join(row.text() for row in rows))
        for k in range(3):
            image = render_stripe(SCENE, np.random.default_rng(k))
            (path / folder / f"{k}.png").write_bytes(encode_png(image))
    return read_session(path)


def _source(session, tmp_path):
    store = StageStore(tmp_path / "stages", Silent())
    return SessionSource(session, Options(), store, Silent(), StoredStageRunner(store, Silent()))


def test_uncertain_angles_reach_the_observations(session, tmp_path):
    source = _source(session, tmp_path)
    (mount,) = source.mounts
    assert np.degrees(mount.u_angles_rad) == pytest.approx([0.02, 0.0, 0.05])
    detected, _ = source._detections(session.captures[0], "axis")
    assert np.degrees([d.u_angle_rad for d in detected]) == pytest.approx([0.02, 0.0, 0.05])


@pytest.mark.parametrize("changed", [{"angle_rad": 1.0}, {"u_angle_rad": 1e-3}])
def test_what_is_said_of_angles_later_is_noticed(session, tmp_path, changed):
    axis, ball = session.captures
    source = _source(session, tmp_path)
    _, before = source._detections(axis, "axis")
    mount_before = (source.mounts, source._runner.keys["mounts"])[1]

    def edited(capture):
        return replace(capture, frames=(replace(capture.frames[0], **changed), *capture.frames[1:]))

    again = _source(replace(session, captures=(edited(axis), edited(ball))), tmp_path)
    detected, after = again._detections(edited(axis), "axis")
    assert after != before
    assert [getattr(detected[0], name) for name in changed] == list(changed.values())
    assert (again.mounts, again._runner.keys["mounts"])[1] != mount_before
