"""Opening the rig that a ``rig.toml`` names: real devices, a simulated rig, or a recorded session."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from rotaline.errors import RigError
from rotaline.hardware.clock import Clock, SystemClock, VirtualClock
from rotaline.hardware.connections import Connections
from rotaline.hardware.replay import RECORDING, REPLAY, RecordedCapture, RecordedFrame, Recording
from rotaline.hardware.rig import OpenRig, open_rig
from rotaline.hardware.simulated.world import SimulatedWorld
from rotaline.io.device_file import DeviceFile
from rotaline.io.frame_images import read_source
from rotaline.io.rig_file import PRESETS, read_preset, read_rig_file
from rotaline.io.session import Capture, read_session
from rotaline.io.toml_file import where
from rotaline.pipeline.acquire.person import Person
from rotaline.pipeline.acquire.stand_ins import RecordedPerson, SimulatedPerson

Prompt = Callable[[str], str]
"""Asks the person at the terminal, and returns the answer."""


@dataclass(frozen=True, eq=False)
class Opened:
    """The devices, and who stands in for a person; None: a person is needed."""

    rig: OpenRig
    person: Person | None


def open_devices(file: DeviceFile, prompt: Prompt | None = None) -> Opened:
    """Open the devices of a ``rig.toml``.

    Parameters
    ----------
    file : DeviceFile
    prompt : for devices that are worked by hand; None: there is no terminal

    Raises
    ------
    RigError
        If real and simulated devices are mixed, or the simulated rig's file is wrong.
    DeviceError
        If a device cannot be opened.
    """
    feigned = file.drivers & {"simulated", "replay"}
    if feigned and len(file.drivers - {"manual"}) > 1:
        raise RigError(
            f"{file.source}: driver {' and '.join(sorted(file.drivers - {'manual'}))} are mixed; a {sorted(feigned)[0]} device works with its own kind only."
        )
    connections = Connections()
    if prompt is not None:
        connections.provide("prompt", prompt)
    if "simulated" in feigned:
        return _simulated(file, connections)
    if "replay" in feigned:
        return _replayed(file, connections)
    return Opened(open_rig(file.devices, SystemClock(), connections), None)


def _simulated(file: DeviceFile, connections: Connections) -> Opened:
    clock: Clock = SystemClock() if file.simulated.real_time else VirtualClock()
    name = file.simulated.rig
    if name not in PRESETS and not (file.folder / name).is_file():
        raise RigError(
            f"{where(file.source, file.text, ('simulated', 'rig'))}: found {name!r}, expected one of {', '.join(PRESETS)}, or a rig file of "
            f"`rotaline simulate`; there is no file {file.folder / name}."
        )
    rig_file = read_preset(name) if name in PRESETS else read_rig_file(file.folder / name)
    world = SimulatedWorld(rig_file.rig(), rig_file.plan(file.simulated.seed), clock)
    connections.provide("world", world)
    return Opened(open_rig(file.devices, clock, connections), SimulatedPerson(world))


def _replayed(file: DeviceFile, connections: Connections) -> Opened:
    assert file.replay is not None
    session = read_session(file.folder / file.replay.session)
    connections.provide(RECORDING, Recording(str(session.path), tuple(_recorded(c) for c in session.captures)))
    rig = open_rig(file.devices, VirtualClock(), connections)
    return Opened(rig, RecordedPerson(connections.get(REPLAY)))


def _recorded(capture: Capture) -> RecordedCapture:
    """Frames without angle and pose are poses of their own."""
    frames = []
    for index, f in enumerate(capture.frames):
        alone = str(index) if f.angle_rad is None else None
        angle = None if f.angle_rad is None else math.degrees(f.angle_rad)
        read = partial(read_source, f.source)
        frames.append(RecordedFrame(f.name, angle, f.laser_on, f.pose or alone, read))
    return RecordedCapture(capture.folder, capture.role, tuple(frames))
