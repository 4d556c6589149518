"""Frames of a turning table: angles against the truth of the simulated world, gaps, limits, and what is left when something fails."""

import math
from dataclasses import replace

import numpy as np
import pytest
from tests.unit.pipeline import small_acquisition as small
from tests.unit.pipeline.small_acquisition import TARGETS, TURNING, Heard, devices, rows, small_world, start

from rotaline.errors import (
    DeviceConnectionError,
    DeviceError,
    DeviceStateError,
    DeviceTimeoutError,
    LostFrameError,
    OutputError,
)
from rotaline.hardware.camera import CameraFrame, CameraSettings
from rotaline.hardware.simulated import world as world_module
from rotaline.hardware.simulated.faults import Faults
from rotaline.io.acquired_session import AcquiredSession
from rotaline.pipeline.acquire.continuous import (
    Report,
    angle_at,
    frame_period_s,
    is_wanted,
    suitable_speed_deg_s,
    turning_frames,
    uncovered,
)

PLAN = TARGETS + TURNING
STEP = 2.0
PLANNED = [STEP * i for i in range(31)]


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(world_module, "render_exposure", small.rendered)


class Wrapped:
    """A device with something of it changed."""

    def __init__(self, inner):
        self._inner = inner

    def __getattr__(self, name):
        return getattr(self._inner, name)


class Jittery(Wrapped):
    """A camera whose moments are as uncertain as it says; ``offset_s``: its clock is ahead."""

    def __init__(self, camera, u_s=0.0, offset_s=0.0):
        super().__init__(camera)
        self._u_s, self._offset_s, self._rng = u_s, offset_s, np.random.default_rng(5)
        self.true_s = {}

    def next_frame(self, timeout_s):
        frame = self._inner.next_frame(timeout_s)
        self.true_s[frame.number] = frame.time_s
        time_s = frame.time_s + self._offset_s + self._rng.normal(0.0, self._u_s)
        return replace(frame, time_s=time_s, u_time_s=self._u_s)


class Rough(Wrapped):
    """A table whose scale is eccentric, with a resolution, and that takes a while to answer."""

    def __init__(self, table, clock, eccentricity_deg=0.0, resolution_deg=0.0, noise_deg=0.0, answer_s=0.0):
        super().__init__(table)
        self._clock, self._eccentricity_deg, self._resolution_deg = clock, eccentricity_deg, resolution_deg
        self._noise_deg, self._answer_s, self._rng = noise_deg, answer_s, np.random.default_rng(6)
        u = math.hypot(eccentricity_deg / math.sqrt(2), resolution_deg / math.sqrt(12), noise_deg)
        self.info = replace(table.info, u_angle_deg=u, resolution_deg=resolution_deg or table.info.resolution_deg)

    def angle_deg(self):
        share = self._rng.uniform()
        self._clock.wait(share * self._answer_s)
        angle = self._inner.angle_deg()
        self._clock.wait((1 - share) * self._answer_s)
        angle += self._eccentricity_deg * math.sin(math.radians(angle)) + self._rng.normal(0.0, self._noise_deg)
        return round(angle / self._resolution_deg) * self._resolution_deg if self._resolution_deg else angle


def turned(camera_errors, table_errors, *, span=(0.0, 356.0), speed=20.0, table=(), exposure_us=40_000.0):
    """Errors of the angles of one pass against the world, deg, and their standard uncertainties."""
    world = small_world()
    with devices(world, table) as rig:
        camera, turntable = Jittery(rig.camera, **camera_errors), Rough(rig.turntable, world.clock, **table_errors)
        camera.configure(CameraSettings(exposure_us))
        frames = list(turning_frames(camera, turntable, world.clock, span, speed, 5.0))
        assert world.table_stands()
    assert all(not isinstance(f, int) for f in frames)
    errors = [f.angle_deg - world.table_at(camera.true_s[f.frame.number])[0] for f in frames]
    return np.array(errors), np.array([f.u_angle_deg for f in frames]), frames


def test_exact_devices_give_exact_angles():
    errors, u, frames = turned({}, {})
    assert np.max(np.abs(errors)) < 2e-6
    assert np.max(u) < 2e-6
    angles = [f.angle_deg for f in frames]
    assert min(angles) >= 0.0
    assert max(angles) <= 356.0
    assert min(angles) < 0.8
    assert max(angles) > 355.2
    assert np.all(np.diff(angles) > 0)


@pytest.mark.parametrize(
    ("camera_errors", "table_errors", "expected_u_deg"),
    [
        ({"u_s": 2e-3}, {}, 0.04),
        ({}, {"eccentricity_deg": 0.05}, 0.035),
        ({"u_s": 1e-3}, {"eccentricity_deg": 0.03}, 0.029),
        ({"u_s": 1e-3}, {"answer_s": 4e-3}, 0.03),
    ],
)
def test_the_spread_of_the_errors_is_the_stated_uncertainty(camera_errors, table_errors, expected_u_deg):
    errors, u, _ = turned(camera_errors, table_errors)
    assert len(errors) > 250
    assert np.median(u) == pytest.approx(expected_u_deg, rel=0.1)
    ratio = np.sqrt(np.mean((errors / u) ** 2))
    assert 0.65 < ratio < 1.2
    assert np.max(np.abs(errors / u)) < 4.5


@pytest.mark.parametrize("table_errors", [{"noise_deg": 0.02}, {"resolution_deg": 0.1}])
def test_what_averages_out_is_not_claimed_to(table_errors):
    """Noise and steps of the read-out are less in the angle than in a report; the table states a report's, and that stays."""
    errors, u, _ = turned({}, table_errors)
    assert np.sqrt(np.mean(errors**2)) < np.median(u) < 2.5 * np.sqrt(np.mean(errors**2)) + 0.02


def test_the_parabola_holds_while_the_table_slows_down():
    errors, u, _ = turned({"u_s": 1e-3}, {}, span=(0.0, 60.0), table={"limits_deg": (-20.0, 60.0)})
    assert np.max(np.abs(errors / np.maximum(u, 1e-6))) < 4.5
    assert np.max(np.abs(errors)) < 0.1


def test_angle_and_uncertainty_by_hand():
    reports = [Report(0.1 * i, 0.0, 2.0 * 0.1 * i + 3.0 * (0.1 * i) ** 2) for i in range(12)]
    frame = CameraFrame(np.zeros((2, 2), np.uint8), 1, 0.55, 0.01, CameraSettings(1.0))
    angle, u = angle_at(frame, reports, 0.003)
    assert angle == pytest.approx(2.0 * 0.55 + 3.0 * 0.55**2)
    speed = 2.0 + 6.0 * 0.55
    assert u == pytest.approx(math.hypot(0.003, speed * 0.01))


@pytest.mark.parametrize("offset_s", [0.5, -0.5])
def test_a_camera_with_another_clock_is_refused(tmp_path, offset_s):
    with pytest.raises(DeviceStateError, match="its clock does not agree with that of this machine"):
        turned({"offset_s": offset_s}, {})
    world = small_world()
    with pytest.raises(DeviceStateError, match='Use mode = "step"'):
        start(tmp_path / "s", PLAN, world, wrap=lambda rig: replace(rig, camera=Jittery(rig.camera, offset_s=offset_s)))


def test_an_offset_within_the_stated_uncertainty_is_within_that_of_the_angle():
    errors, u, _ = turned({"u_s": 5e-3, "offset_s": 5e-3}, {})
    assert np.sqrt(np.mean((errors / u) ** 2)) < 1.6


# whole captures


def taken(folder):
    table = rows(folder)
    assert [row["image"] for row in table] == [f"{i:04d}.png" for i in range(len(table))]
    assert all((folder / row["image"]).is_file() for row in table)
    return [float(row["angle_deg"]) for row in table], table


def test_a_turning_capture_has_a_frame_near_each_planned_angle(tmp_path):
    heard = Heard()
    done = start(tmp_path / "s", PLAN, heard=heard)
    angles, table = taken(tmp_path / "s/ball")
    assert uncovered(PLANNED, angles) == []
    assert 31 <= len(angles) == done.n_frames <= 40  # those of the stream that are nearest; not all 120
    assert min(angles) > -0.3
    assert max(angles) < 60.3
    assert {row["laser"] for row in table} == {"on"}
    assert {row["u_angle_deg"] for row in table} != {""}
    numbers = [int(row["number"]) for row in table]
    assert numbers == sorted(set(numbers))
    again = start(tmp_path / "s", PLAN)
    assert again.n_before == again.n_frames == done.n_frames


def test_backwards_and_without_the_laser(tmp_path):
    plan = TARGETS + small.AXIS.replace("to_deg = 20.0", 'from_deg = 20.0\nto_deg = 0.0\nmode = "continuous"')
    start(tmp_path / "s", plan)
    angles, table = taken(tmp_path / "s/axis")
    assert uncovered([20.0, 15.0, 10.0, 5.0, 0.0], angles) == []
    assert angles[0] > angles[-1]
    assert {row["laser"] for row in table} == {"off"}


@pytest.mark.parametrize("limits", [(0.0, 60.0), (-1.0, 61.0), (-300.0, 300.0)])
def test_the_run_up_stays_within_the_limits(tmp_path, limits):
    world = small_world()
    reached = []

    class Watched(Wrapped):
        def move_to(self, angle_deg, timeout_s):
            reached.append(angle_deg)
            return self._inner.move_to(angle_deg, timeout_s)

    start(
        tmp_path / "s",
        PLAN,
        world,
        table={"limits_deg": limits},
        wrap=lambda rig: replace(rig, turntable=Watched(rig.turntable)),
    )
    angles, _ = taken(tmp_path / "s/ball")
    assert uncovered(PLANNED, angles) == []
    assert limits[0] <= min(reached) <= max(reached) <= limits[1]
    assert min(reached) < -2.0 or limits[0] > -2.0


@pytest.mark.parametrize(
    "faults",
    [
        Faults(lost_frames=frozenset({40, 41, 42, 43, 44, 45, 46, 47, 48, 49, 50, 51, 90, 91})),
        Faults(damaged_frames=frozenset(range(40, 52))),
        Faults(damaged_frames=frozenset({3, 4})),  # while the period is measured
        Faults(late_frames={60: 11.0}),
        Faults(lost_frames=frozenset(range(20, 110))),
    ],
)
def test_gaps_are_taken_again(tmp_path, faults):
    heard = Heard()
    done = start(tmp_path / "s", PLAN, small_world(faults), heard=heard)
    angles, _ = taken(tmp_path / "s/ball")
    assert uncovered(PLANNED, angles) == []
    if max(faults.lost_frames | faults.damaged_frames, default=0) > 30:
        assert done.n_retaken > 0
        assert "frame(s) of the stream were lost; their angles are taken again." in heard.notes[0]


def test_a_stream_that_loses_most_frames_ends_in_words(tmp_path):
    world = small_world(Faults(lost_frames=frozenset(i for i in range(30, 100_000) if i % 40)))
    with pytest.raises(
        LostFrameError,
        match=r"of 31 angles of capture 'ball' are still missing after 6 passes|did not arrive|of a stream arrived",
    ):
        start(tmp_path / "s", PLAN, world)
    taken(tmp_path / "s/ball")


def test_a_camera_that_falls_silent_ends_in_words(tmp_path):
    world = small_world(Faults(late_frames=dict.fromkeys(range(60, 100_000), 60.0)))
    with pytest.raises(DeviceTimeoutError, match="did not arrive within"):
        start(tmp_path / "s", PLAN, world)
    assert len(taken(tmp_path / "s/ball")[0]) >= 3


def test_unplugged_while_it_turns_and_plugged_in_again(tmp_path):
    world = small_world(Faults(camera_gone_at_frames=frozenset({65})))
    with pytest.raises(DeviceConnectionError):
        start(tmp_path / "s", PLAN, world)
    first, _ = taken(tmp_path / "s/ball")
    assert 5 < len(first) < 25
    heard = Heard()
    start(tmp_path / "s", PLAN, world, heard=heard)
    angles, _ = taken(tmp_path / "s/ball")
    assert angles[: len(first)] == first
    assert all(abs(later - earlier) > 1.0 for later in angles[len(first) :] for earlier in first)
    assert uncovered(PLANNED, angles) == []


def test_a_table_that_gets_stuck_while_it_turns_is_said(tmp_path):
    world = small_world()

    class Stuck(Wrapped):
        def turn(self, speed_deg_s):
            self._inner.turn(speed_deg_s)
            stuck_s = world.clock.now_s() + 1.0
            world.turn_table(world.rest(stuck_s, world.table_at(stuck_s)[0]))

    with pytest.raises(
        DeviceStateError, match=r"it stands at \d+\.\d+ deg, but was told to turn to 60 deg. See what holds it"
    ):
        start(tmp_path / "s", PLAN, world, wrap=lambda rig: replace(rig, turntable=Stuck(rig.turntable)))
    first, _ = taken(tmp_path / "s/ball")
    assert 5 < len(first) < 15
    start(tmp_path / "s", PLAN, world)
    assert uncovered(PLANNED, taken(tmp_path / "s/ball")[0]) == []


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OutputError("no space left"), ZeroDivisionError()])
def test_whatever_ends_it_the_table_stands_and_the_stream_has_ended(tmp_path, monkeypatch, error):
    world = small_world()
    streams = []

    class Watched(Wrapped):
        def start(self):
            streams.append("start")
            self._inner.start()

        def stop(self):
            streams.append("stop")
            self._inner.stop()

        def next_frame(self, timeout_s):
            if world.counts["frames"] == 60 and not isinstance(error, OutputError):
                raise error
            return self._inner.next_frame(timeout_s)

    add, n = AcquiredSession.add, []

    def full(self, folder, row, encoded):
        n.append(row)
        if len(n) == 5 and isinstance(error, OutputError):
            raise error
        add(self, folder, row, encoded)

    monkeypatch.setattr(AcquiredSession, "add", full)
    with pytest.raises(type(error)):
        start(tmp_path / "s", PLAN, world, wrap=lambda rig: replace(rig, camera=Watched(rig.camera)))
    assert streams == ["start", "stop"] * 2
    assert len(taken(tmp_path / "s/ball")[0]) >= 4


# speeds and choices


@pytest.mark.parametrize(
    ("exposure_us", "step", "expected"), [(10_000.0, 2.0, 20.0), (10_000.0, 4.0, 30.0), (100.0, 0.1, 25.0)]
)
def test_the_speed_suits_the_step(exposure_us, step, expected):
    with devices(small_world()) as rig:
        rig.camera.configure(CameraSettings(exposure_us))
        period_s = frame_period_s(rig.camera)
        assert period_s == pytest.approx(max(exposure_us * 1e-6, 4e-3))
        assert suitable_speed_deg_s(rig.camera, rig.turntable.info, step, period_s) == pytest.approx(expected)


def test_the_frames_nearest_to_the_plan_are_wanted():
    planned = (0.0, 2.0, 4.0)
    angles = np.arange(-0.3, 4.5, 0.25)
    wanted = [round(float(a), 2) for a in angles if is_wanted(float(a), planned, 0.25)]
    assert wanted == [-0.05, 1.95, 3.95]
    assert all(is_wanted(float(a), planned, 2.5) for a in angles)


def test_a_camera_without_frames_has_no_period():
    silent = small_world(Faults(damaged_frames=frozenset(range(100))))
    with devices(silent) as rig, pytest.raises(LostFrameError, match="0 of 15 frames of a stream arrived"):
        frame_period_s(rig.camera)
    with devices(small_world(Faults(late_frames=dict.fromkeys(range(100), 1e3)))) as rig, pytest.raises(DeviceError):
        frame_period_s(rig.camera)
