import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rotaline.calibration.model import SystemCalibration
from rotaline.errors import WorkError
from rotaline.io.frame_images import ImageFile, read_source
from rotaline.io.session import Capture, Frame, read_session
from rotaline.pipeline import capture_ranges
from rotaline.pipeline.capture_ranges import CaptureRanges, ranges_of
from rotaline.pipeline.frames import CaptureStripes
from rotaline.pipeline.observer import Silent
from rotaline.pipeline.options import Options, ScanOptions
from rotaline.pipeline.ranges import FRAMES_A_RANGE, RangeTask, backgrounds_of, process_range, program, spans
from rotaline.pipeline.scan import Clouds, ScannedCapture, scan_capture
from rotaline.pipeline.store import StageStore
from rotaline.scanning.triangulation import scan_points
from rotaline.simulation.rig import build_rig
from rotaline.simulation.session import write_session
from rotaline.simulation.small_session import small_plan
from rotaline.vision.stripe.extract import StripeOptions, extract_stripe

RIG = build_rig((320, 240))
SYSTEM = SystemCalibration(RIG.camera, RIG.laser_plane_camera, RIG.rotation_axis_camera, RIG.turn_sense, True)


def _frame(name, angle, on, pose):
    return Frame(ImageFile(name), name, angle, on, pose)


@st.composite
def _frames(draw):
    angle = st.none() | st.sampled_from([0.0, 5e-10, 1e-3, 1.0, 2.0])
    rows = draw(st.lists(st.tuples(angle, st.booleans(), st.none() | st.sampled_from("ab")), max_size=12))
    return tuple(_frame(f"{i}.png", *row) for i, row in enumerate(rows))


@given(_frames())
def test_backgrounds_are_those_that_each_frame_would_find(frames):
    capture = Capture("c", "scan", "", None, frames)
    expected = [capture.background_of(f) for f in capture.on_frames]
    assert backgrounds_of(frames) == tuple(None if f is None else f.source for f in expected)


@given(st.integers(0, 500))
def test_ranges_hold_every_frame_once(n):
    parts = spans(n)
    assert [i for a, b in parts for i in range(a, b)] == list(range(n))
    assert all(0 < b - a <= FRAMES_A_RANGE for a, b in parts)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ranges") / "session"
    write_session(folder, RIG, small_plan(RIG, captures=("ball",)))
    return read_session(folder)


def _task(session, **changes):
    frames = session.captures[0].on_frames[:3]
    task = RangeTask("ball", 5, frames, (None,) * 3, StripeOptions(), SYSTEM, None, program())
    return replace(task, **changes)


def test_a_range_is_the_same_after_a_journey(session):
    task = _task(session)
    assert len(pickle.dumps(task)) < 10_000
    here, there = process_range(task), process_range(pickle.loads(pickle.dumps(task)))
    assert here.cloud.points_table.tobytes() == there.cloud.points_table.tobytes()
    assert here.stripes.uv.tobytes() == there.stripes.uv.tobytes()
    assert set(here.cloud.frame) == {5, 6, 7}
    image = session.captures[0].on_frames[1].source
    assert (here.stripes.stripes()[1].uv == extract_stripe(read_source(image)).uv).all()


def test_another_program_is_refused_before_it_works(session):
    with pytest.raises(WorkError) as caught:
        process_range(_task(session, program="rotaline 0.0.1"))
    text = str(caught.value)
    assert "rotaline 0.0.1" in text
    assert program() in text
    assert "ball, frames 6 to 8 (ball/0000.png" in text


@pytest.fixture
def small_ranges(monkeypatch):
    """Ranges of five frames, so that a short scan has several."""
    monkeypatch.setattr("rotaline.pipeline.ranges.FRAMES_A_RANGE", 5)


def _ranges(session, tmp_path, **scan):
    store = StageStore(tmp_path / "stages", Silent())
    return ranges_of(session.captures[0], Options(scan=ScanOptions(**scan)), store, Silent())


def test_a_cloud_from_ranges_is_the_cloud_of_all_frames(session, tmp_path, small_ranges):
    ranges = _ranges(session, tmp_path)
    whole = scan_points(ranges.joined.stripes(), ranges.joined.angles_rad, SYSTEM)
    cloud = ranges.cloud(SYSTEM)
    assert len(list((tmp_path / "stages").glob("*/*.npz"))) == 4
    assert ranges.thinning() == 1
    for name in ("points_table", "intensity", "angle_rad", "frame", "u_mm"):
        assert getattr(cloud, name).tobytes() == getattr(whole, name).tobytes(), name
    scanned = scan_capture("ball", ranges, SYSTEM, tmp_path / "ball.ply")
    assert (scanned.n_points, scanned.n_frames, scanned.n_frames_without_points) == (len(whole), 16, 0)


def test_of_many_points_every_nth_of_the_capture_comes_into_memory(session, tmp_path, small_ranges):
    whole = _ranges(session, tmp_path).cloud(SYSTEM)
    most = len(whole) // 3
    ranges = _ranges(session, tmp_path, max_points_in_memory=most)
    step = ranges.thinning()
    assert step == 4 or len(whole) == 3 * most
    cloud = ranges.cloud(SYSTEM)
    assert np.array_equal(cloud.points_table, whole.points_table[::step])
    assert np.array_equal(cloud.frame, whole.frame[::step])
    assert len(cloud) <= most


def test_a_frame_without_a_stripe_is_counted_and_named(session, tmp_path, small_ranges, monkeypatch):
    done = capture_ranges.process_range

    def without_seventh(task):
        result = done(task)
        gone = result.stripes.select(result.stripes.frame + task.first_frame != 7)
        cloud = result.cloud.select(result.cloud.frame != 7)
        return replace(result, stripes=gone, cloud=cloud)

    monkeypatch.setattr(capture_ranges, "process_range", without_seventh)
    scanned = scan_capture("ball", _ranges(session, tmp_path), SYSTEM, tmp_path / "ball.ply")
    assert scanned.n_frames_without_points == 1
    assert scanned.frames_without_stripe == ("ball/0007.png",)


def test_the_key_of_a_scan_follows_its_points(session, tmp_path):
    ranges = _ranges(session, tmp_path)
    key = scan_capture("ball", ranges, SYSTEM, tmp_path / "a.ply").key
    assert scan_capture("ball", ranges, SYSTEM, tmp_path / "a.ply").key == key
    other = replace(SYSTEM, turn_sense=-SYSTEM.turn_sense)
    assert scan_capture("ball", ranges, other, tmp_path / "a.ply").key != key


def test_few_clouds_stay_in_memory(session, tmp_path):
    cloud = _ranges(session, tmp_path).cloud(SYSTEM)
    loaded = []

    def load(folder):
        loaded.append(folder)
        return cloud

    scanned = {name: ScannedCapture(name, len(cloud), 16, 0, (), 1, name) for name in "abc"}
    clouds = Clouds(scanned, load, 2 * len(cloud))
    assert list(clouds) == ["a", "b", "c"]
    assert "d" not in clouds
    assert clouds.get("d") is None
    assert not loaded
    for name in "aabacca":
        assert clouds[name] is cloud
    assert loaded == ["a", "b", "c"]
    clouds["b"]
    assert loaded == ["a", "b", "c", "b"]


def test_stripes_without_points_join():
    none = np.empty(0)
    empty = CaptureStripes(
        ("x",), np.array([math.nan]), (None,), none.astype(int), np.empty((0, 2)), np.empty((0, 2)),
        none, none, none, none.astype(bool), none.astype(int), np.zeros(1),
    )  # fmt: skip
    assert empty.points_per_frame().tolist() == [0]
    assert [len(s) for s in empty.stripes()] == [0]


def test_ranges_stay_open_as_long_as_the_store(session, tmp_path):
    store = StageStore(tmp_path / "stages", Silent())
    first = ranges_of(session.captures[0], Options(), store, Silent())
    assert ranges_of(session.captures[0], Options(), store, Silent()) is first
    other = Options(stripe=StripeOptions(threshold=9.0))
    assert isinstance(ranges_of(session.captures[0], other, store, Silent()), CaptureRanges)
    assert ranges_of(session.captures[0], other, store, Silent()).key != first.key
