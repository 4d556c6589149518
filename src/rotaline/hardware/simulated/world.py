"""The world of the simulated rig: what stands where, what turns, what shines; and what a camera sees of it.

One world is shared by the simulated camera, turntable and laser, and by whoever plays the person who places targets and parts. Turn
the table, and the next frame shows it; switch the laser off, and the stripe is gone.

What is planned, and what is not
--------------------------------
The world is made from the plan of a session. A frame that :meth:`SimulatedWorld.expose` makes of a state that the plan holds (capture,
held pose, angle within 1e-6 deg, laser off or at full power, exposure within 1e-6 of it, gain 1) is bit for bit the frame that
:func:`rotaline.simulation.session.write_session` renders. Frames of all other states have noise of their own, drawn from the seed of
the plan, the state, and how many frames of it there have been; so have all further frames of a planned state, frames of a
stream, and frames that are taken aside (:meth:`SimulatedWorld.aside`). A new world begins anew: what was taken before an
interruption does not change what comes after it.

At a planned angle the table stands as it does in that frame of the plan, whatever the light; at other angles each stop has errors
of its own, drawn likewise. What changes during an exposure is rendered at :data:`SUB_POSES` moments, evenly over the exposure, whose
light is added up.
"""

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import RigidTransform

from rotaline.errors import DeviceConnectionError
from rotaline.hardware.camera import Image
from rotaline.hardware.clock import Clock
from rotaline.hardware.connections import Connections
from rotaline.hardware.simulated.faults import Faults
from rotaline.hardware.simulated.history import History
from rotaline.hardware.simulated.trajectory import Piece
from rotaline.simulation.imaging.raycast import Placed
from rotaline.simulation.imaging.render import Moment, render_exposure
from rotaline.simulation.mechanics import base_from_table
from rotaline.simulation.plan import CapturePlan, SessionPlan, Shot, table_disc
from rotaline.simulation.rig import Rig
from rotaline.simulation.truth import true_poses

SUB_POSES = 5
"""Moments of an exposure during which something changes."""

_SAME_ANGLE_DEG = 1e-6
_SAME_EXPOSURE = 1e-6


@dataclass(frozen=True)
class _Setup:
    """What a person has placed: the capture by its index in the plan, and the pose that is held."""

    capture: int | None = None
    pose: int | None = None


@dataclass(frozen=True)
class _State:
    """All that a frame depends on, noise aside.

    ``angle_deg`` is None where the table plays no part; ``stop``: how often it has stopped at this angle, None while it turns;
    ``laser_power``: share of full power, None while it is off.
    """

    setup: _Setup
    angle_deg: float | None
    stop: int | None
    laser_power: float | None


@dataclass(frozen=True, eq=False)
class _Capture:
    """A capture of the plan, with the true pose of the table and the number of the held pose in each shot."""

    plan: CapturePlan
    base_from_table: tuple[RigidTransform, ...]
    pose: tuple[int | None, ...]

    @property
    def n_poses(self) -> int:
        """Poses that a person has to hold."""
        return len({pose for pose in self.pose if pose is not None})

    @property
    def turns(self) -> bool:
        """Whether the angle of the table plays a part."""
        return any(shot.angle_deg is not None for shot in self.plan.shots)

    def shots_at(self, state: _State) -> list[int]:
        """The shots in which the same things stand in the same places."""

        def same(shot: Shot, pose: int | None) -> bool:
            if pose is not None and pose != state.setup.pose:
                return False
            if shot.angle_deg is None:
                return True
            stands = state.angle_deg is not None and state.stop is not None
            return stands and abs(shot.angle_deg - state.angle_deg) <= _SAME_ANGLE_DEG  # type: ignore[operator]

        return [i for i, (shot, pose) in enumerate(zip(self.plan.shots, self.pose, strict=True)) if same(shot, pose)]


def _poses_of(capture: CapturePlan) -> tuple[int | None, ...]:
    """Numbers of the held poses: shots that share a name share a pose, and one without a name is a pose of its own."""
    names: list[object] = []
    poses: list[int | None] = []
    for i, shot in enumerate(capture.shots):
        if not shot.held:
            poses.append(None)
            continue
        name = shot.pose or i
        if name not in names:
            names.append(name)
        poses.append(names.index(name))
    return tuple(poses)


class SimulatedWorld:
    """One world for all devices of a simulated rig; provided to them as the connection "world".

    Parameters
    ----------
    rig : Rig   with its errors
    plan : SessionPlan   what stands where in each capture, and the seed
    clock : the one that the devices are opened with
    faults : what goes wrong, and when
    """

    def __init__(self, rig: Rig, plan: SessionPlan, clock: Clock, faults: Faults | None = None) -> None:
        self.rig, self.plan, self.clock, self.faults = rig, plan, clock, faults or Faults()
        poses = true_poses(rig, plan)
        self._captures = tuple(_Capture(c, poses[c.folder], _poses_of(c)) for c in plan.captures)
        self._setup: History[_Setup] = History(_Setup())
        self._laser_power: History[float | None] = History(None)
        self._table: History[Piece] = History(Piece(clock.now_s(), 0.0, stop=1))
        self._stops: Counter[tuple[int | None, float]] = Counter()
        self._taken: Counter[tuple[object, ...]] = Counter()
        self._aside: str | None = None
        self._held_devices: set[str] = set()
        self.counts: Counter[str] = Counter()
        """Frames, moves and switchings so far: what the numbers of :class:`Faults` count."""

    # what a person does

    def set_up(self, folder: str) -> None:
        """Put what a capture is of on the table, and nothing else; its planned frames are there to be taken again.

        Raises
        ------
        KeyError
            If the plan has no such capture.
        """
        folders = [capture.folder for capture in self.plan.captures]
        if folder not in folders:
            raise KeyError(f"The simulated session has no capture '{folder}', only {', '.join(folders)}.")
        self._place(_Setup(folders.index(folder)))

    def hold(self, pose: int | None) -> None:
        """Hold the target in one of the poses of the capture that is set up, or take it away; what is planned can be taken again.

        Raises
        ------
        IndexError
            If there is no such pose.
        """
        setup = self._setup.at(self.clock.now_s())
        n_poses = 0 if setup.capture is None else self._captures[setup.capture].n_poses
        if pose is not None and not 0 <= pose < n_poses:
            raise IndexError(f"The capture has {n_poses} poses, from 0 on; there is no pose {pose}.")
        self._place(replace(setup, pose=pose))

    def _place(self, setup: _Setup) -> None:
        self._setup.put(self.clock.now_s(), setup)
        for counter in (self._taken, self._stops):
            for key in [key for key in counter if key[0] == setup.capture]:
                del counter[key]

    def n_poses(self, folder: str) -> int:
        """How many poses a person has to hold in a capture; 0: the table does it all."""
        return next(capture.n_poses for capture in self._captures if capture.plan.folder == folder)

    @contextmanager
    def aside(self, name: str) -> Iterator[None]:
        """Frames taken within are none of the plan (a preview, the search for an exposure, a reference): they use nothing of it up.

        Their noise depends on the name, and on how many of the same state there were under this name.
        """
        before, self._aside = self._aside, name
        try:
            yield
        finally:
            self._aside = before

    # what the devices do

    def claim(self, device: str) -> None:
        """Open a device.

        Raises
        ------
        DeviceConnectionError
            If it is open already.
        """
        if device in self._held_devices:
            raise DeviceConnectionError(f"{device}: another program holds it. Close that one first.")
        self._held_devices.add(device)

    def release(self, device: str) -> None:
        """Close a device."""
        self._held_devices.discard(device)

    def count(self, what: str) -> int:
        """The number of one more frame, move or switching."""
        self.counts[what] += 1
        return self.counts[what]

    def switch_laser(self, power: float | None) -> None:
        """Share of the laser's full power from now on; None: it is off, and the room as bright as it is then."""
        self._laser_power.put(self.clock.now_s(), power)

    def shines(self) -> bool:
        """Whether there is laser light."""
        return bool(self._laser_power.at(self.clock.now_s()))

    def table_at(self, time_s: float) -> tuple[float, float]:
        """Angle, deg, and speed, deg/s, of the table."""
        piece = self._table.at(time_s)
        return piece.angle_at(time_s), 0.0 if piece.stop is not None else piece.speed_at(time_s)

    def table_stands(self) -> bool:
        """Whether the table is at rest now."""
        return self._table.at(self.clock.now_s()).stop is not None

    def turn_table(self, *pieces: Piece) -> None:
        """How the table moves from now on."""
        for piece in pieces:
            self._table.put(piece.start_s, piece)

    def rest(self, start_s: float, angle_deg: float) -> Piece:
        """The table stands from a moment on; each stop has errors of its own."""
        key = (self._setup.at(self.clock.now_s()).capture, round(angle_deg, 6))
        self._stops[key] += 1
        return Piece(start_s, angle_deg, stop=self._stops[key])

    # what the camera sees

    def expose(self, start_s: float, exposure_us: float, gain: float, *, streamed: bool) -> Callable[[], Image]:
        """The frame of an exposure, which must be over. It is settled now, and rendered by the callable: most frames of a stream are never looked at.

        Parameters
        ----------
        start_s : its beginning, by the clock
        exposure_us : its length
        gain : factor of the sensor's own
        streamed : it is one of a stream, and so none of the plan
        """
        shares = (np.arange(SUB_POSES) + 0.5) / SUB_POSES
        states = [self._state_at(start_s + float(share) * exposure_us * 1e-6) for share in shares]
        if all(state == states[0] for state in states):
            states = states[:1]
            if not streamed and self._aside is None and gain == 1.0:
                shot = self._planned(states[0], exposure_us)
                if shot is not None:
                    return self._planned_frame(states[0], shot)
        seed = self._fresh_seed(states, round(exposure_us, 3), gain, streamed)
        sensor = replace(self.rig.sensor, gain=self.rig.sensor.gain * gain)
        moments = [self._moment(state, seed) for state in states]
        rig = replace(self.rig, sensor=sensor)
        return partial(render_exposure, rig, moments, exposure_ms=exposure_us * 1e-3, seed=seed)

    def _planned_frame(self, state: _State, index: int) -> Callable[[], Image]:
        assert state.setup.capture is not None
        capture = self._captures[state.setup.capture]
        shot = capture.plan.shots[index]
        power = state.laser_power or 0.0
        moment = Moment(_parts(shot, capture.base_from_table[index]), power, shot.ambient_e_per_ms)
        seed = (self.plan.seed, state.setup.capture, index)
        return partial(render_exposure, self.rig, [moment], exposure_ms=shot.exposure_ms, seed=seed)

    def _state_at(self, time_s: float) -> _State:
        setup, piece = self._setup.at(time_s), self._table.at(time_s)
        angle, stop = piece.angle_at(time_s), piece.stop
        if setup.capture is not None and not self._captures[setup.capture].turns:
            return _State(setup, None, None, self._laser_power.at(time_s))
        return _State(setup, angle, stop, self._laser_power.at(time_s))

    def _planned(self, state: _State, exposure_us: float) -> int | None:
        """The shot of the plan that this frame is; of several that are alike, the first that has not been taken."""
        if state.setup.capture is None or state.laser_power not in (None, 1.0):
            return None
        capture = self._captures[state.setup.capture]

        def lit_alike(shot: Shot) -> bool:
            same_light = shot.laser == (state.laser_power is not None)
            return same_light and math.isclose(exposure_us, shot.exposure_ms * 1e3, rel_tol=_SAME_EXPOSURE)

        shots = [i for i in capture.shots_at(state) if lit_alike(capture.plan.shots[i])]
        key = (state.setup.capture, *shots)
        if self._taken[key] >= len(shots):
            return None
        self._taken[key] += 1
        return shots[self._taken[key] - 1]

    def _fresh_seed(self, states: list[_State], *what: object) -> tuple[int, ...]:
        """The seed of a frame that is none of the plan."""
        angles = [None if s.angle_deg is None else round(s.angle_deg, 6) for s in states]
        lit = [s.laser_power for s in states]
        digest = _digest(states[0].setup, self._aside, angles, lit, *what)
        key = (states[0].setup.capture, "fresh", digest)
        self._taken[key] += 1
        return self.plan.seed, digest, self._taken[key]

    def _moment(self, state: _State, seed: tuple[int, ...]) -> Moment:
        """What a frame that is none of the plan shows: as in the shot of the plan that is most alike."""
        light, laser_on, power = self.rig.light, state.laser_power is not None, state.laser_power or 0.0
        ambient = light.ambient_e_per_ms * (light.ambient_on_fraction if laser_on else 1.0)
        if state.setup.capture is None:
            return Moment([table_disc(self.rig)], power, ambient)
        capture = self._captures[state.setup.capture]
        here = capture.shots_at(state)
        lit_alike = [i for i, shot in enumerate(capture.plan.shots) if shot.laser == laser_on]
        if lit_alike:
            most_alike = next((i for i in lit_alike if i in here), lit_alike[0])
            ambient = capture.plan.shots[most_alike].ambient_e_per_ms
        if here:
            parts = _parts(capture.plan.shots[here[0]], capture.base_from_table[here[0]])
        elif state.angle_deg is not None:
            parts = _parts(capture.plan.shots[0], self._table_pose(state, seed))
        else:
            parts = [table_disc(self.rig)]  # nobody holds anything
        return Moment(parts, power, ambient)

    def _table_pose(self, state: _State, seed: tuple[int, ...]) -> RigidTransform:
        """``base_from_table`` at an angle that the plan does not know: one draw a stop; while it turns, one a frame."""
        assert state.angle_deg is not None
        if state.stop is not None:
            stop = _digest("stop", state.setup.capture, round(state.angle_deg, 6), state.stop)
            seed = (self.plan.seed, stop)
        rng = np.random.default_rng([*seed, 1])
        return base_from_table(self.rig.turn_sense, self.rig.mechanics, state.angle_deg, rng)


def _parts(shot: Shot, table: RigidTransform) -> list[Placed]:
    return [*shot.held, *(part.moved(table) for part in shot.on_table)]


def _digest(*what: object) -> int:
    return int.from_bytes(hashlib.sha256(repr(what).encode()).digest()[:8], "big")


def world_of(device: str, clock: Clock, connections: Connections) -> SimulatedWorld:
    """The world that was provided for the devices of a simulated rig.

    Raises
    ------
    DeviceConnectionError
        If there is none.
    ValueError
        If it goes by another clock than the devices.
    """
    world = connections.get("world")
    if not isinstance(world, SimulatedWorld):
        raise DeviceConnectionError(
            f"{device}: there is no simulated world for it. Use it with a command that makes one from a rig file and a plan, such as "
            "`rotaline acquire`, or take the driver of a real device."
        )
    if world.clock is not clock:
        raise ValueError("The simulated world and its devices must go by the same clock.")
    return world
