"""The joint estimate on sessions of the twin: the truth comes back within its uncertainty, and what is planted is found.

The line of the laser is thin here: ideal stripes are centred on the middle of the sheet, whatever their width, and the estimate would
correct a broad line's for its width.
"""

from dataclasses import replace

import numpy as np
import pytest

from rotaline.calibration.intrinsics import CameraOptions, calibrate_camera
from rotaline.calibration.joint.estimate import JointOptions, estimate_jointly
from rotaline.calibration.joint.model import JointStart
from rotaline.calibration.laser_plane import calibrate_laser_plane
from rotaline.calibration.mount_start import start_from_artifact, start_mounts
from rotaline.calibration.rotation_axis import AxisOptions, calibrate_axis
from rotaline.geometry.primitives import KnownCylinder, KnownSphere
from rotaline.pipeline.calibrate_joint import joint_system
from rotaline.pipeline.twin import trace_twin
from rotaline.pipeline.twin_errors import system_errors, truth_of
from rotaline.simulation.ideal.observed_session import IdealSession
from rotaline.simulation.parts.boards import Plate
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
from rotaline.simulation.rig import Mechanics, build_rig
from rotaline.simulation.small_session import CHECKERBOARD, DOTS, STEPPED_CYLINDER

TARGET_PX, STRIPE_PX = 0.02, 0.05
PLAIN = build_rig((640, 480))
RIG = replace(PLAIN, laser=replace(PLAIN.laser, sigma_mm=0.02, peak_e_per_ms=5000.0))
SHAPES = {
    "stepped": (SteppedRod(STEPPED_CYLINDER), STEPPED_CYLINDER),
    "rod": (Rod(38.004, 40.0), KnownCylinder(38.004)),
    "ball": (Ball(28.475), KnownSphere(28.475)),
}
MOUNTS = {
    "m1": ("stepped", mount(-4.1, 2.9, tilt_deg=0.05)),
    "m2": ("stepped", mount(6.0, 3.0, tilt_deg=0.02)),
    "centred": ("stepped", mount(0.05, -0.03)),
    "rod": ("rod", mount(4.0, 4.0, tilt_deg=0.1)),
    "ball": ("ball", mount(5.0, -2.0)),
}
FULL = ("camera", "laser", "axis", "m1", "m2")


def capture(rig, name, board=CHECKERBOARD, dots=DOTS, frames=24):
    """The plan of one capture."""
    if name == "camera":
        return camera_capture(rig, board, "checkerboard", 10, 1)
    if name == "laser":
        return laser_capture(rig, dots, "dots", 6, 1)
    if name == "axis":
        return axis_capture(rig, board, "checkerboard", tuple(5.0 * i for i in range(9)))
    kind, pose = MOUNTS[name]
    return scan_capture(rig, SHAPES[kind][0], pose, full_turn(frames), folder=name, role="artifact", target=kind)


def twin(names=FULL, rig=RIG, **what):
    """A traced session of some captures."""
    targets = {"checkerboard": CHECKERBOARD, "dots": DOTS, **{k: a for k, (_, a) in SHAPES.items()}}
    plan = SessionPlan(targets, tuple(capture(rig, name, **what) for name in names))
    return trace_twin(rig, plan, spacing_px=3.0)


@pytest.fixture(scope="module")
def parts():
    """Every capture of the plain rig by itself: sessions are put together of them."""
    return twin(("camera", "laser", "axis", *MOUNTS))


def put_together(parts, names=FULL, other=None):
    """A session of some captures, some of them from another twin."""
    sources = [other if other is not None and n in [c.folder for c in other.plan.captures] else parts for n in names]
    chosen = [(s, [c.folder for c in s.plan.captures].index(n)) for s, n in zip(sources, names, strict=True)]
    plan = replace(parts.plan, captures=tuple(s.plan.captures[i] for s, i in chosen))
    return replace(parts, plan=plan, ideal=IdealSession(tuple(s.ideal.captures[i] for s, i in chosen)))


def observe(session, seed=1, **noise):
    return session.observed(TARGET_PX, STRIPE_PX, seed, **noise).observations


def start_of(observations):
    """What the stages find."""
    camera = calibrate_camera(
        list(observations.camera_views), observations.image_size, CameraOptions(), observations.preferred_folders
    )

    def found(view):
        return replace(view, detection=camera.with_target_as_found(view.detection))

    plane = calibrate_laser_plane(camera.camera, [found(v) for v in observations.plate_views])
    axis = None
    line, sense, mounts = None, 1, ()
    if observations.table_views:
        axis = calibrate_axis(
            camera.camera, [found(v) for v in observations.table_views], AxisOptions(method="joint")
        )
        line, sense = axis.axis_camera, axis.turn_sense
    elif observations.mounts:
        line, sense = start_from_artifact(camera.camera, plane.plane_camera, observations.mounts, 1)
    if observations.mounts:
        mounts, warnings = start_mounts(camera.camera, plane.plane_camera, line, sense, observations.mounts)
        assert warnings == ()
    return JointStart(camera, plane, plane.plane_camera, axis, line, sense, mounts)


def estimate(observations, **options):
    return estimate_jointly(observations, start_of(observations), JointOptions(**options))


def errors(found, rig=RIG):
    """Errors in standard uncertainties, by name."""
    truth = truth_of(rig, SessionPlan({}, ()))
    return {e.name: e.standardised for e in system_errors(truth, joint_system(found))}


def assert_true(found, rig=RIG, without=()):
    """Every parameter within 4 of its standard uncertainties, all together as chance has it."""
    z = {name: v for name, v in errors(found, rig).items() if not name.startswith(without or ("-",))}
    assert max(np.abs(list(z.values()))) < 4.0, z
    assert 0.3 < np.sqrt(np.mean(np.square(list(z.values())))) < 2.0, z
    assert found.converged


def on(found):
    return {o.name for o in found.optional if o.on}


def optional(found, name):
    """Values and uncertainties of a group that is on."""
    (group,) = [o for o in found.optional if o.name == name]
    assert group.on, group.reason
    return np.array(list(group.values.values())), np.array(list(group.u.values()))
