"""Small sessions of the twin as the joint estimate sees them, with every kind of artefact, for both senses of rotation."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from rotaline.calibration.intrinsics import CameraOptions, calibrate_camera
from rotaline.calibration.joint.begin import in_one_order, start_noise, start_state
from rotaline.calibration.joint.data import JointData, gather
from rotaline.calibration.joint.iterate import iterate
from rotaline.calibration.joint.linear import Setting, board_pivot
from rotaline.calibration.joint.model import JointStart
from rotaline.calibration.joint.state import Layout, State, n_mount_parameters
from rotaline.calibration.joint.surfaces import size_names
from rotaline.calibration.laser_plane import calibrate_laser_plane
from rotaline.calibration.mount_start import start_mounts
from rotaline.calibration.observations import SessionObservations
from rotaline.calibration.rotation_axis import AxisOptions, calibrate_axis
from rotaline.geometry.primitives import KnownCylinder, KnownSphere
from rotaline.pipeline.twin import trace_twin
from rotaline.simulation.parts.shapes import Ball, Rod, SteppedRod
from rotaline.simulation.plan import (
    SessionPlan,
    axis_capture,
    camera_capture,
    full_turn,
    laser_capture,
    mount,
    scan_capture,
)
from rotaline.simulation.rig import build_rig
from rotaline.simulation.small_session import CHECKERBOARD, DOTS, STEPPED_CYLINDER

_ARTIFACTS = {
    "stepped": (SteppedRod(STEPPED_CYLINDER), STEPPED_CYLINDER, mount(-4.1, 2.9, tilt_deg=0.3)),
    "rod": (Rod(38.004, 40.0), KnownCylinder(38.004, 40.0), mount(3.0, 4.0, tilt_deg=0.2, tilt_towards_deg=70.0)),
    "endless": (Rod(38.004, 40.0), KnownCylinder(38.004), mount(-2.0, 5.0)),
    "ball": (Ball(28.475), KnownSphere(28.475), mount(5.0, -2.0)),
}


@dataclass(frozen=True, eq=False)
class Case:
    """A session at the start of the joint estimate."""

    observations: SessionObservations
    start: JointStart
    data: JointData
    state: State
    setting: Setting

    @property
    def names(self) -> tuple[str, ...]:
        """Camera parameters."""
        return self.start.camera.parameter_names

    def layout(self, *extra: str) -> Layout:
        """Camera, plane, axis, boards and mounts, and further slots."""
        sizes = {"curvature": 3, "angle": 2, "run-out": 2, "wobble": 2, "line": 1, "pitch": 1, "bend": 3}
        slots = [("camera", len(self.names)), ("plane", 3), ("axis", 4)]
        slots += [(f"board:{b}", 6) for b in range(self.data.n_boards)]
        slots += [(f"mount:{k}", n_mount_parameters(a)) for k, a in enumerate(self.state.artifacts)]
        for name in extra:
            kind, _, number = name.partition(":")
            of_sizes = len(size_names(self.setting.artifact_of(int(number)))) if kind == "sizes" else 0
            slots.append((name, of_sizes or sizes[kind]))
        return Layout(tuple(slots))

    def after(self, state: State, layout: Layout, step: np.ndarray) -> State:
        """The state after a step of the global parameters."""
        pivots = [board_pivot(self.data, b) for b in range(self.data.n_boards)]
        return state.after(layout, step, self.names, {}, pivots, self.data.artifact_groups)

    def solved(self, layout: Layout | None = None):
        """The end of the iteration."""
        layout = layout or self.layout()
        return iterate(self.setting, layout, self.state, start_noise(self.data), 1.0)


def _case(turn_sense: int) -> Case:
    rig = build_rig((640, 480), camera_side=-turn_sense, turn_sense=turn_sense)
    captures = [
        camera_capture(rig, CHECKERBOARD, "checkerboard", 8, 1),
        laser_capture(rig, DOTS, "dots", 5, 1),
        axis_capture(rig, CHECKERBOARD, "checkerboard", tuple(7.0 * i for i in range(7))),
    ]
    for name, (shape, _, pose) in _ARTIFACTS.items():
        captures.append(scan_capture(rig, shape, pose, full_turn(8), folder=name, role="artifact", target=name))
    targets = {"checkerboard": CHECKERBOARD, "dots": DOTS, **{k: a for k, (_, a, _) in _ARTIFACTS.items()}}
    twin = trace_twin(rig, SessionPlan(targets, tuple(captures)), spacing_px=5.0)
    observations = twin.observed(0.02, 0.05, 3).observations
    camera = calibrate_camera(list(observations.camera_views), observations.image_size, CameraOptions())
    found = [replace(v, detection=camera.with_target_as_found(v.detection)) for v in observations.plate_views]
    plane = calibrate_laser_plane(camera.camera, found)
    axis = calibrate_axis(camera.camera, list(observations.table_views), AxisOptions(method="joint"))
    line, sense = axis.axis_camera, axis.turn_sense
    mounts, _ = start_mounts(camera.camera, plane.plane_camera, line, sense, observations.mounts)
    start = JointStart(camera, plane, plane.plane_camera, axis, line, sense, mounts)
    data = in_one_order(gather(observations, start), start)
    state = start_state(observations, start, data)
    setting = Setting(data, camera.parameter_names, state.artifacts, observations.image_size)
    return Case(observations, start, data, state, setting)


@pytest.fixture(scope="session")
def right_handed():
    """The read-out is right-handed about the axis."""
    return _case(1)


@pytest.fixture(scope="session")
def left_handed():
    """The other sense, and the camera on the other side of the laser."""
    return _case(-1)


@pytest.fixture(params=["right_handed", "left_handed"])
def case(request):
    """Both."""
    return request.getfixturevalue(request.param)
