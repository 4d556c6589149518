"""A small rig whose pictures cost nothing, a plan with every role, and one start of an acquisition: for tests of what is kept of it."""

import csv
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np

from rotaline.hardware.cameras import simulated as cameras
from rotaline.hardware.clock import VirtualClock
from rotaline.hardware.connections import Connections
from rotaline.hardware.lasers import simulated as lasers
from rotaline.hardware.rig import DeviceTables, open_rig
from rotaline.hardware.simulated.world import SimulatedWorld
from rotaline.hardware.turntables import simulated as turntables
from rotaline.io.plan_file import parse_plan
from rotaline.pipeline.acquire.acquire import acquire
from rotaline.pipeline.acquire.stand_ins import SimulatedPerson
from rotaline.simulation.plan import laser_off
from rotaline.simulation.rig import build_rig
from rotaline.simulation.small_session import small_plan

TARGETS = """\
version = 1
[targets.checkerboard]
kind = "checkerboard"
inner_corners = [14, 9]
pitch = 4.5
[targets.dots]
kind = "dots"
dots = [9, 9]
pitch = 6.0
diameter = 3.0
[targets.stepped-cylinder]
kind = "stepped-cylinder"
diameters = [23.051, 36.006]
heights = [22.003, 25.005]
"""
CAMERA = """
[[captures]]
folder = "camera"
role = "camera"
target = "checkerboard"
poses = 3
exposure_off_us = 10000.0
"""
LASER = """
[[captures]]
folder = "laser"
role = "laser-plane"
target = "dots"
poses = 3
bracket = [1.0, 2.0]
exposure_off_us = 10000.0
exposure_on_us = 10000.0
"""
AXIS = """
[[captures]]
folder = "axis"
role = "axis"
target = "checkerboard"
to_deg = 20.0
step_deg = 5.0
exposure_off_us = 10000.0
"""
STEPPED = """
[[captures]]
folder = "stepped"
role = "artifact"
target = "stepped-cylinder"
frames = 7
laser_off_frames = true
reference_every = 3
exposure_off_us = 10000.0
"""
BALL = """
[[captures]]
folder = "ball"
role = "scan"
frames = 8
exposure_on_us = 10000.0
"""
TURNING = """
[[captures]]
folder = "ball"
role = "scan"
to_deg = 60.0
step_deg = 2.0
mode = "continuous"
speed_deg_s = 25.0
exposure_on_us = 20000.0
"""
EVERYTHING = TARGETS + CAMERA + LASER + AXIS + STEPPED + BALL
IMAGE_SIZE = (64, 48)


def rendered(rig, moments, *, exposure_ms, seed):
    """In place of the renderer: noise by the seed, and a stripe as bright as laser and exposure make it."""
    width, height = rig.camera.image_size
    grey = np.random.default_rng(seed).normal(6.0, 1.0, (height, width))
    light = np.mean([moment.laser_power for moment in moments]) * exposure_ms
    grey += 8.0 * light * np.exp(-0.5 * ((np.arange(width) - 0.4 * width) / 1.5) ** 2)
    grey += 0.5 * exposure_ms
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@cache
def rig_and_plan():
    """The simulated rig, with everything that the plans above need."""
    rig = build_rig(IMAGE_SIZE)
    plan = small_plan(rig, captures=("camera", "laser", "axis", "stepped", "ball"))
    captures = []
    for capture in plan.captures:
        shots = capture.shots[:8]
        if capture.folder == "stepped":
            pairs = [(laser_off(rig, angle_deg=s.angle_deg, on_table=s.on_table), s) for s in capture.shots]
            shots = tuple(shot for pair in pairs for shot in pair)
        captures.append(replace(capture, shots=shots))
    return rig, replace(plan, captures=tuple(captures))


def small_world(faults=None, clock=None):
    """A new world of this rig."""
    return SimulatedWorld(*rig_and_plan(), clock or VirtualClock(), faults)


@dataclass
class Heard:
    """An observer that remembers."""

    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    stages: list[tuple[str, bool]] = field(default_factory=list)

    def stage(self, title, stored):
        self.stages.append((title, stored))

    def work(self, label, total):
        return nullcontext(lambda: None)

    def note(self, text):
        self.notes.append(text)

    def warning(self, text):
        self.warnings.append(text)


@contextmanager
def devices(world, table=(), camera=()):
    """The devices of a world, open; whatever happens, they leave it dark and still."""
    connections = Connections()
    connections.provide("world", world)
    tables = DeviceTables(
        cameras.Settings(driver="simulated", **dict(camera)),
        turntables.Settings(driver="simulated", **dict(table)),
        lasers.Settings(driver="simulated"),
    )
    with open_rig(tables, world.clock, connections) as rig:
        yield rig


def start(out, plan=EVERYTHING, world=None, *, person=None, heard=None, table=(), camera=(), wrap=None, rig_text="rig"):
    """One start of an acquisition; ``wrap`` changes the open rig.

    Whatever ends it: the laser is off and the table stands, before the devices are closed.
    """
    world = world or small_world()
    with devices(world, table, camera) as rig:
        used = rig if wrap is None else wrap(rig)
        try:
            return acquire(
                parse_plan(plan, "plan.toml"), rig_text, used, out, person or SimulatedPerson(world), heard or Heard()
            )
        finally:
            assert not world.shines()
            assert world.table_stands()


def rows(folder: Path):
    """Of frames.csv."""
    with (folder / "frames.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def content(session: Path):
    """All that two acquisitions of the same plan have in common: files, images, tables without times and numbers."""
    files = {}
    for path in sorted(session.rglob("*")):
        name = str(path.relative_to(session))
        if path.name == "frames.csv":
            files[name] = [{k: v for k, v in row.items() if k not in ("time", "number")} for row in rows(path.parent)]
        elif path.is_file() and path.name != "events.jsonl":
            files[name] = path.read_bytes()
    return files
