"""Acquisition: what streaming to disk takes of the machine, and what a scan takes longer than its exposures, rests and moves.

(a) The camera is the emulator of the pylon library, as fast as it gives frames; they go through the real writer, each one forced to disk before it
is listed. Its test picture makes small files, so the writer is measured alone as well, with a frame that has the noise of a real one.
(b) Turntable and laser are simulated, by the clock of the machine. Rendering a frame takes longer than an exposure, so the camera is a stand-in
that returns one recorded frame after the time of the exposure.
"""

import os
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.harness import Measurement, Setting
from rotaline.errors import DeviceConnectionError
from rotaline.hardware.camera import CameraFrame, CameraInfo, CameraSettings, Region
from rotaline.hardware.clock import Clock, SystemClock
from rotaline.hardware.connections import Connections
from rotaline.hardware.drivers import open_camera, settings_type
from rotaline.hardware.lasers import simulated as lasers
from rotaline.hardware.rig import OpenRig
from rotaline.hardware.simulated.trajectory import move
from rotaline.hardware.simulated.world import SimulatedWorld
from rotaline.hardware.turntables import simulated as turntables
from rotaline.io.acquired_session import AcquiredSession, FrameRow
from rotaline.io.frame_writer import FrameWriter
from rotaline.io.plan_file import parse_plan
from rotaline.io.session import read_session
from rotaline.pipeline.acquire.acquire import acquire
from rotaline.pipeline.acquire.person import Nobody
from rotaline.pipeline.observer import Silent
from rotaline.simulation.rig import build_rig
from rotaline.simulation.small_session import small_plan

SIZE = (1280, 960)
EXPOSURE_US = 10_000.0
STEP_EXPOSURE_US, SETTLE_S = 20_000.0, 0.1
_PLAN = """version = 1
[[captures]]
folder = "scan"
role = "scan"
frames = {n}
exposure_on_us = {exposure}
settle_s = {settle}
"""


@dataclass(frozen=True)
class Streamed:
    """Frames of a stream on their way to the disk; ``n_gaps``: numbers that are missing; ``processor``: its time over that of the clock."""

    n_frames: int
    n_gaps: int
    seconds: float
    processor: float
    megabytes: float


def stream(folder: Path, n_frames: int) -> Streamed | None:
    """Stream from the pylon emulator to the disk; None: the library is not installed."""
    os.environ["PYLON_CAMEMU"] = "1"
    try:
        settings = settings_type("camera", "pylon")(driver="pylon")
        camera = open_camera(settings, SystemClock(), Connections())
    except DeviceConnectionError as error:
        print(f"pylon emulator: left out. {error}")
        return None
    try:
        camera.configure(CameraSettings(EXPOSURE_US, region=Region(0, 0, *SIZE)))
        numbers = []
        with AcquiredSession(folder, "a benchmark", "") as session, FrameWriter(session) as writer:
            camera.start()
            begun_s, processor_s = time.perf_counter(), time.process_time()
            for i in range(n_frames):
                frame = camera.next_frame(10.0)
                numbers.append(frame.number)
                writer.put("stream", FrameRow(f"{i:04d}.png", None, False, number=frame.number), frame.image)
            writer.flush()
            seconds, processor = time.perf_counter() - begun_s, time.process_time() - processor_s
            camera.stop()
    finally:
        camera.close()
    files = list((folder / "stream").glob("*.png"))
    assert len(files) == n_frames
    gaps = numbers[-1] - numbers[0] + 1 - n_frames
    return Streamed(n_frames, gaps, seconds, processor / seconds, sum(f.stat().st_size for f in files) / 1e6)


def write(folder: Path, image: np.ndarray, n_frames: int) -> float:
    """Frames a second that the writer brings to the disk."""
    with AcquiredSession(folder, "a benchmark", "") as session, FrameWriter(session) as writer:
        begun_s = time.perf_counter()
        for i in range(n_frames):
            writer.put("written", FrameRow(f"{i:04d}.png", None, False), image)
        writer.flush()
        return n_frames / (time.perf_counter() - begun_s)


class RecordedFrame:
    """A camera that returns one and the same frame after the time of an exposure; see :class:`rotaline.hardware.camera.Camera`."""

    def __init__(self, image: np.ndarray, clock: Clock) -> None:
        self._image, self._clock, self._number = image, clock, 0
        self.info = CameraInfo("one recorded frame", SIZE, (1.0, 1e6))
        self.settings = CameraSettings(STEP_EXPOSURE_US, region=Region(0, 0, *SIZE))

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Only the exposure matters."""
        self.settings = replace(settings, region=self.settings.region)
        return self.settings

    def take(self, timeout_s: float) -> CameraFrame:
        """Let the exposure go by."""
        begun_s, exposure_s = self._clock.now_s(), self.settings.exposure_us * 1e-6
        self._clock.wait(exposure_s)
        self._number += 1
        return CameraFrame(self._image.copy(), self._number, begun_s + exposure_s / 2, 0.0, self.settings)

    def start(self) -> None:
        """It does not stream."""
        raise NotImplementedError

    def next_frame(self, timeout_s: float) -> CameraFrame:
        """It does not stream."""
        raise NotImplementedError

    def stop(self) -> None:
        """It does not stream."""

    def close(self) -> None:
        """Nothing to do."""


@dataclass(frozen=True)
class Stepped:
    """A scan in steps: seconds of the clock, and of exposures, rests and moves alone."""

    n_frames: int
    seconds: float
    least_s: float
    processor: float

    @property
    def overhead(self) -> float:
        """What it takes longer than it must."""
        return self.seconds / self.least_s - 1.0


def scanned() -> tuple[SimulatedWorld, np.ndarray]:
    """The world of a scan, and a frame of it."""
    rig = build_rig(SIZE)
    world = SimulatedWorld(rig, small_plan(rig, captures=("ball",)), SystemClock())
    world.set_up("ball")
    world.switch_laser(1.0)
    image = world.expose(world.clock.now_s(), STEP_EXPOSURE_US, 1.0, streamed=True)()
    world.switch_laser(None)
    return world, image


def step_and_shoot(folder: Path, world: SimulatedWorld, image: np.ndarray, n_frames: int) -> Stepped:
    """A scan of a full turn."""
    clock = world.clock
    connections = Connections()
    connections.provide("world", world)
    table_settings = turntables.Settings(driver="simulated")
    table = turntables.open_device(table_settings, clock, connections)
    laser = lasers.open_device(lasers.Settings(driver="simulated"), clock, connections)
    plan = parse_plan(_PLAN.format(n=n_frames, exposure=STEP_EXPOSURE_US, settle=SETTLE_S), "plan")
    speed, acceleration = table_settings.speed_deg_s, table_settings.acceleration_deg_s2
    _, move_s = move(0.0, 0.0, 360.0 / n_frames, speed, acceleration)
    least_s = n_frames * (STEP_EXPOSURE_US * 1e-6 + SETTLE_S) + (n_frames - 1) * move_s
    with OpenRig(RecordedFrame(image, clock), table, laser, clock, connections) as opened:
        begun_s, processor_s = time.perf_counter(), time.process_time()
        acquire(plan, "", opened, folder, Nobody(), Silent())
        seconds, processor = time.perf_counter() - begun_s, time.process_time() - processor_s
    assert len(read_session(folder).captures[0].frames) == n_frames
    return Stepped(n_frames, seconds, least_s, processor / seconds)


def measure(setting: Setting) -> list[Measurement]:
    """Both; prints what came out."""
    found = []
    streamed = stream(setting.folder / "streamed", 200 if setting.quick else 1000)
    if streamed is not None:
        s, name = streamed, f"pylon emulator, {SIZE[0]} x {SIZE[1]}, to disk"
        print(
            f"{name}: {s.n_frames} frames, {s.n_gaps} missing, {s.n_frames / s.seconds:.1f} frames/s, "
            f"{s.megabytes / s.seconds:.1f} MB/s, {100 * s.processor:.0f} % of one core"
        )
        found += [
            Measurement("acquisition", f"{name}: missing", "frames", (float(s.n_gaps),), s.n_frames, "frames"),
            Measurement("acquisition", f"{name}: rate", "frames/s", (s.n_frames / s.seconds,), s.n_frames, "frames"),
            Measurement("acquisition", f"{name}: processor", "of one core", (s.processor,), s.n_frames, "frames"),
        ]
    world, image = scanned()
    rate = write(setting.folder / "written", image, 50 if setting.quick else 300)
    print(
        f"the writer alone, {SIZE[0]} x {SIZE[1]} with noise: {rate:.1f} frames/s, {rate * image.nbytes / 1e6:.0f} MB/s of pixels"
    )
    found.append(Measurement("acquisition", "the writer alone: rate", "frames/s", (rate,)))
    stepped = step_and_shoot(setting.folder / "stepped", world, image, 30 if setting.quick else 360)
    print(
        f"step and shoot, {stepped.n_frames} frames: {stepped.seconds:.1f} s; exposures, rests and moves alone {stepped.least_s:.1f} s: "
        f"{100 * stepped.overhead:+.1f} %; {100 * stepped.processor:.0f} % of one core"
    )
    name = "step and shoot"
    found.append(Measurement("acquisition", name, "s", (stepped.seconds,), stepped.n_frames, "frames"))
    found.append(
        Measurement(
            "acquisition",
            f"{name}: beyond exposures, rests and moves",
            "",
            (stepped.overhead,),
            stepped.n_frames,
            "frames",
        )
    )
    return found
