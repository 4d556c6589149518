"""The plan of a small session with every stage of the chain, in seconds: for tests and first tries.

Together with :func:`rotaline.simulation.rig.build_rig`; whole rigs with all that can be said of them come from rig files.
"""

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import RigidTransform

from rotaline.geometry.primitives import SteppedCylinder
from rotaline.simulation.parts.shapes import Ball, GrooveBlock, Rod, Shape, SteppedRod
from rotaline.simulation.plan import (
    CapturePlan,
    MeasurementPlan,
    SessionPlan,
    axis_capture,
    camera_capture,
    full_turn,
    laser_capture,
    mount,
    scan_capture,
)
from rotaline.simulation.rig import Rig
from rotaline.vision.targets.model import Checkerboard, DotGrid, Target

CHECKERBOARD = Checkerboard((14, 9), 4.5)
DOTS = DotGrid((9, 9), 6.0, 3.0)
STEPPED_CYLINDER = SteppedCylinder(23.051, 36.006, 22.003, 25.005)
BALL = Ball(28.475)
ROD = Rod(38.004, 40.0)
GROOVE = GrooveBlock(46.0, 32.0, 24.0, 12.003, 22.0, 12.0)


def shuffled_turn(n_frames: int, seed: int) -> tuple[float, ...]:
    """A full turn in uneven steps and mixed order, as ``angle_deg`` may come, deg."""
    rng = np.random.default_rng([seed, 3])
    angles = (np.arange(n_frames) + rng.uniform(-0.35, 0.35, n_frames)) * 360.0 / n_frames
    return tuple(float(a) for a in np.round(rng.permutation(angles), 4))


def _stepped(rig: Rig, folder: str, pose: RigidTransform, angles_deg: tuple[float, ...]) -> CapturePlan:
    shape = SteppedRod(STEPPED_CYLINDER)
    return scan_capture(rig, shape, pose, angles_deg, folder=folder, role="artifact", target="stepped-cylinder")


_SCANS: tuple[tuple[str, Shape, str, RigidTransform, str], ...] = (
    ("ball", BALL, "sphere", mount(3.1, -1.2), "diameter"),
    ("rod", ROD, "cylinder", mount(-2.4, 0.8, tilt_deg=0.02, tilt_towards_deg=70.0), "diameter"),
    ("groove", GROOVE, "groove", mount(0.9, 1.6, turn_deg=34.0), "depth"),
)
_TARGETS: dict[str, Target | SteppedCylinder] = {
    "checkerboard": CHECKERBOARD,
    "dots": DOTS,
    "stepped-cylinder": STEPPED_CYLINDER,
}


def small_plan(
    rig: Rig,
    *,
    captures: tuple[str, ...] = ("camera", "laser", "axis", "stepped", "ball"),
    shuffled: bool = False,
    plate_visible: bool = False,
    image_format: str = "png",
    seed: int = 1,
) -> SessionPlan:
    """A session for tests: few frames, only the captures that are asked for.

    Parameters
    ----------
    rig : Rig
    captures : of "camera", "laser", "axis", "stepped" (one mount, 5 mm off centre), "ball", "rod", "groove"
    shuffled : uneven angles in mixed order
    plate_visible : the dot plate can be seen in its laser-on frames
    image_format : one of ``IMAGE_FORMATS``
    seed : of poses, angles and noise
    """

    def turn(n: int) -> tuple[float, ...]:
        return shuffled_turn(n, seed) if shuffled else full_turn(n)

    axis_angles = tuple(5.0 * i for i in range(9))
    ambient_fraction = 0.4 if plate_visible else None
    makers: dict[str, Callable[[], CapturePlan]] = {
        "camera": lambda: camera_capture(rig, CHECKERBOARD, "checkerboard", 10, seed),
        "laser": lambda: laser_capture(rig, DOTS, "dots", 5, seed, ambient_fraction=ambient_fraction),
        "axis": lambda: axis_capture(rig, CHECKERBOARD, "checkerboard", axis_angles),
        "stepped": lambda: _stepped(rig, "stepped", mount(-4.1, 2.9), turn(16)),
    }
    measurements = []
    for folder, shape, feature, pose, key in _SCANS:
        makers[folder] = lambda folder=folder, shape=shape, pose=pose: scan_capture(  # type: ignore[misc]
            rig, shape, pose, turn(16), folder=folder, target=folder
        )
        if folder in captures:
            measurements.append(MeasurementPlan(folder, feature, {key: shape.sizes()[key]}))
    unknown = [name for name in captures if name not in makers]
    if unknown:
        raise ValueError(f"Unknown captures {unknown}; there are {list(makers)}.")
    plans = tuple(makers[name]() for name in captures)
    return SessionPlan(_TARGETS, plans, tuple(measurements), image_format, seed)
