"""What every device keeps to, whoever made it: one suite a type, run for every driver that can run here.

A test file subclasses a suite and gives its fixture::

    class TestSimulatedCamera(CameraContract):
        @pytest.fixture
        def camera(self): ...   # an open camera; closed by the fixture
"""

import dataclasses
import itertools
import math

import numpy as np
import pytest

from rotaline.errors import DeviceLimitError, DeviceStateError
from rotaline.hardware.camera import CameraInfo, Region
from rotaline.hardware.laser import LaserInfo
from rotaline.hardware.turntable import TurntableInfo


class CameraContract:
    """Fixture: ``camera``. Class attributes say what the device under test lacks, with the reason."""

    timeout_s = 10.0
    no_region: str | None = None
    """Why its region cannot be changed."""
    n_frames = 4

    def between(self, camera) -> float:
        """An exposure that is not at a limit, us."""
        low, high = camera.info.exposure_limits_us
        return float(np.clip(math.sqrt(max(low, 1.0) * high), low, min(high, 20_000.0)))

    def test_says_what_it_is(self, camera):
        info = camera.info
        assert isinstance(info, CameraInfo)
        assert info.device
        assert min(info.sensor_size) >= 16
        assert 0 <= info.exposure_limits_us[0] < info.exposure_limits_us[1]
        assert 8 <= info.bit_depth <= 16
        assert "free" in info.triggers

    def test_settings_are_complete(self, camera):
        settings = camera.settings
        low, high = camera.info.exposure_limits_us
        assert low <= settings.exposure_us <= high
        assert settings.region is not None
        assert (settings.gain is None) == (camera.info.gain_limits is None)

    def test_takes_frames_that_are_whole_and_counted(self, camera):
        frames = [camera.take(self.timeout_s) for _ in range(self.n_frames)]
        region = camera.settings.region
        shape = (region.height, region.width, 3) if camera.info.colour else (region.height, region.width)
        for frame in frames:
            assert frame.image.shape == shape
            assert frame.image.dtype == (np.uint8 if camera.info.bit_depth == 8 else np.uint16)
            assert frame.settings == camera.settings
            assert frame.u_time_s >= 0
        numbers = [frame.number for frame in frames]
        assert numbers == sorted(set(numbers)), "each exposure has a number of its own"
        times = [frame.time_s for frame in frames]
        assert all(b > a for a, b in itertools.pairwise(times))

    def test_a_frame_owns_its_image(self, camera):
        first = camera.take(self.timeout_s)
        copy = first.image.copy()
        for _ in range(self.n_frames):
            camera.take(self.timeout_s)
        assert np.array_equal(first.image, copy)

    def test_exposure_is_what_the_camera_says_it_is(self, camera):
        wanted = self.between(camera)
        made = camera.configure(dataclasses.replace(camera.settings, exposure_us=wanted))
        assert made.exposure_us == pytest.approx(wanted, rel=0.2), "rounded to the steps of the device"
        assert camera.settings == made
        assert camera.take(self.timeout_s).settings.exposure_us == made.exposure_us

    def test_an_exposure_beyond_the_limits_is_refused_and_nothing_changes(self, camera):
        before = camera.settings
        low, high = camera.info.exposure_limits_us
        for value in (high * 2, -1.0, *([low / 2] if low > 0 else [])):
            with pytest.raises(DeviceLimitError) as caught:
                camera.configure(dataclasses.replace(before, exposure_us=value))
            assert camera.info.device in str(caught.value)
            assert "us" in str(caught.value)
        assert camera.settings == before

    def test_a_gain_beyond_the_limits_is_refused(self, camera):
        if camera.info.gain_limits is None:
            pytest.skip("its gain cannot be set")
        before = camera.settings
        with pytest.raises(DeviceLimitError, match="gain"):
            camera.configure(dataclasses.replace(before, gain=camera.info.gain_limits[1] + 100.0))
        assert camera.settings == before

    def test_a_region_is_read_and_given_back(self, camera):
        if self.no_region is not None:
            pytest.skip(self.no_region)
        width, height = camera.info.sensor_size
        before = camera.settings
        wanted = Region(width // 4 // 16 * 16, height // 4 // 16 * 16, width // 2 // 16 * 16, height // 2 // 16 * 16)
        made = camera.configure(dataclasses.replace(before, region=wanted))
        frame = camera.take(self.timeout_s)
        assert frame.image.shape[:2] == (made.region.height, made.region.width)
        assert made.region.width < width
        assert made.region.height < height
        whole = camera.configure(dataclasses.replace(before, region=None))
        assert (whole.region.width, whole.region.height) == (width, height)
        assert camera.take(self.timeout_s).image.shape[:2] == (height, width)

    def test_a_region_outside_the_sensor_is_refused(self, camera):
        if self.no_region is not None:
            pytest.skip(self.no_region)
        before = camera.settings
        width, height = camera.info.sensor_size
        with pytest.raises(DeviceLimitError, match="region"):
            camera.configure(dataclasses.replace(before, region=Region(16, 16, width, height)))
        assert camera.settings == before

    def test_streams_in_order_without_a_gap(self, camera):
        camera.start()
        try:
            frames = [camera.next_frame(self.timeout_s) for _ in range(self.n_frames)]
        finally:
            camera.stop()
        numbers = [frame.number for frame in frames]
        assert numbers == list(range(numbers[0], numbers[0] + len(frames)))
        assert all(b.time_s > a.time_s for a, b in itertools.pairwise(frames))

    def test_works_on_after_a_stream(self, camera):
        camera.start()
        last = camera.next_frame(self.timeout_s)
        camera.stop()
        camera.stop()
        assert camera.take(self.timeout_s).number > last.number

    def test_cannot_be_changed_while_it_streams(self, camera):
        camera.start()
        try:
            with pytest.raises(DeviceStateError):
                camera.configure(camera.settings)
        finally:
            camera.stop()

    def test_gives_no_next_frame_without_a_stream(self, camera):
        with pytest.raises(DeviceStateError):
            camera.next_frame(self.timeout_s)

    def test_can_be_closed_twice_and_says_so_afterwards(self, camera):
        camera.close()
        camera.close()
        with pytest.raises(DeviceStateError):
            camera.take(self.timeout_s)


class TurntableContract:
    """Fixture: ``turntable``, homed or calling its place 0."""

    timeout_s = 20.0
    angles_deg = (10.0, 4.0, 0.0)
    speed_deg_s = 20.0

    def within(self, turntable) -> float:
        """How near the table comes to an angle, deg."""
        return turntable.info.resolution_deg / 2 + 4 * turntable.info.u_angle_deg + 1e-9

    def test_says_what_it_is(self, turntable):
        info = turntable.info
        assert isinstance(info, TurntableInfo)
        assert info.device
        assert info.resolution_deg > 0
        assert info.u_angle_deg >= 0
        assert info.limits_deg is None or info.limits_deg[0] < info.limits_deg[1]

    def test_stands_where_it_was_sent(self, turntable):
        for angle in self.angles_deg:
            reached = turntable.move_to(angle, self.timeout_s)
            assert reached == pytest.approx(angle, abs=self.within(turntable))
            assert turntable.angle_deg() == pytest.approx(reached, abs=self.within(turntable))

    def test_counts_on_beyond_a_turn(self, turntable):
        limits = turntable.info.limits_deg
        if limits is not None and limits[1] < 370.0:
            pytest.skip("its limits end before a turn")
        assert turntable.move_to(365.0, self.timeout_s) == pytest.approx(365.0, abs=self.within(turntable))

    def test_home_is_zero(self, turntable):
        turntable.move_to(self.angles_deg[0], self.timeout_s)
        turntable.home(self.timeout_s)
        assert turntable.angle_deg() == pytest.approx(0.0, abs=self.within(turntable))

    def test_a_move_beyond_the_limits_is_refused_before_anything_moves(self, turntable):
        limits = turntable.info.limits_deg
        if limits is None:
            pytest.skip("it turns without end")
        before = turntable.angle_deg()
        for angle in (limits[0] - 1.0, limits[1] + 1.0):
            with pytest.raises(DeviceLimitError) as caught:
                turntable.move_to(angle, self.timeout_s)
            assert "deg" in str(caught.value)
            assert turntable.info.device in str(caught.value)
        assert turntable.angle_deg() == pytest.approx(before, abs=self.within(turntable))

    @pytest.mark.parametrize("angle", [math.nan, math.inf])
    def test_an_angle_that_is_none_is_refused(self, turntable, angle):
        with pytest.raises(DeviceLimitError):
            turntable.move_to(angle, self.timeout_s)

    def test_turns_and_stops_and_knows_where(self, turntable):
        if not turntable.info.continuous:
            with pytest.raises(DeviceStateError):
                turntable.turn(1.0)
            return
        turntable.turn(self.speed_deg_s)
        turntable.stop(self.timeout_s)
        there = turntable.angle_deg()
        assert there > 0
        assert turntable.angle_deg() == pytest.approx(there, abs=self.within(turntable)), "it stands"
        assert turntable.move_to(0.0, self.timeout_s) == pytest.approx(0.0, abs=self.within(turntable))

    def test_too_fast_is_refused(self, turntable):
        if not turntable.info.continuous or turntable.info.max_speed_deg_s is None:
            pytest.skip("it does not turn continuously, or its greatest speed is not known")
        before = turntable.angle_deg()
        with pytest.raises(DeviceLimitError, match="deg/s"):
            turntable.turn(2 * turntable.info.max_speed_deg_s)
        assert turntable.angle_deg() == pytest.approx(before, abs=self.within(turntable))

    def test_may_be_stopped_while_it_stands(self, turntable):
        turntable.stop(self.timeout_s)
        turntable.stop(self.timeout_s)

    def test_can_be_closed_twice_and_says_so_afterwards(self, turntable):
        turntable.close()
        turntable.close()
        with pytest.raises(DeviceStateError):
            turntable.move_to(1.0, self.timeout_s)


class LaserContract:
    """Fixtures: ``laser``, and ``shines``: a function that says whether the device itself has the light on."""

    def test_begins_dark(self, laser, shines):
        assert isinstance(laser.info, LaserInfo)
        assert laser.info.device
        assert not laser.is_on
        assert not shines()

    def test_switches(self, laser, shines):
        for _ in range(2):
            laser.on()
            assert laser.is_on
            assert shines()
            laser.off()
            assert not laser.is_on
            assert not shines()

    def test_switching_twice_is_switching_once(self, laser, shines):
        laser.on()
        laser.on()
        assert shines()
        laser.off()
        laser.off()
        assert not shines()

    def test_power_is_set_or_refused(self, laser, shines):
        if not laser.info.can_set_power:
            with pytest.raises(DeviceStateError):
                laser.set_power(0.5)
            return
        laser.set_power(0.5)
        assert not shines(), "setting the power switches nothing on"
        laser.on()
        assert shines()
        laser.set_power(1.0)
        assert shines()

    @pytest.mark.parametrize("fraction", [-0.1, 1.1, math.nan])
    def test_power_beyond_the_limits_is_refused(self, laser, fraction):
        if not laser.info.can_set_power:
            pytest.skip("its power cannot be set")
        with pytest.raises(DeviceLimitError):
            laser.set_power(fraction)

    def test_is_dark_once_it_is_closed(self, laser, shines):
        laser.on()
        laser.close()
        laser.close()
        assert not shines()
        with pytest.raises(DeviceStateError):
            laser.on()
