"""Which sessions the article's experiments need: what is rendered, frame by frame."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from rotaline.geometry.primitives import SteppedCylinder
from rotaline.io.rig_file import RigFile, quick_look, read_preset
from rotaline.io.rig_values import plate_of, shape_of
from rotaline.pipeline.reproduce.article import (
    ARTIFACT_STEP_DEG,
    AXIS_RANGE_DEG,
    AXIS_STEP_DEG,
    N_CAMERA_VIEWS,
    N_LASER_POSES,
    STEPPED_CYLINDER,
)
from rotaline.simulation.parts.boards import Plate
from rotaline.simulation.parts.complex_parts import ComplexPart
from rotaline.simulation.plan import (
    CapturePlan,
    SessionPlan,
    axis_capture,
    camera_capture,
    full_turn,
    laser_capture,
    laser_on,
    mount,
    scan_capture,
)
from rotaline.simulation.rig import Rig
from rotaline.vision.targets.model import Target

N_MOUNTS = 5
MOUNT_SEED, POSITION_SEED = 11, 12


@dataclass(frozen=True)
class BudgetEffort:
    """How much the budget works out: frames, parts, which levels beside the first, and whether with errors that only images show."""

    n_stepped_frames: int
    n_part_frames: int
    parts: tuple[str, ...]
    levels: tuple[int, ...]
    with_images: bool


@dataclass(frozen=True)
class Effort:
    """How much is rendered: with half the pixels along each side or not, and how many frames of what."""

    small_images: bool
    n_camera_views: int
    n_laser_poses: int
    axis_step_deg: float
    n_artifact_frames: int
    n_part_frames: int
    n_complex_frames: int
    budget: BudgetEffort


FULL = Effort(
    small_images=False,
    n_camera_views=N_CAMERA_VIEWS,
    n_laser_poses=N_LASER_POSES,
    axis_step_deg=AXIS_STEP_DEG,
    n_artifact_frames=round(360 / ARTIFACT_STEP_DEG),
    n_part_frames=48,
    n_complex_frames=270,
    budget=BudgetEffort(36, 16, ("ball", "cylinder", "groove"), (1, 2, 3), with_images=True),
)
QUICK = Effort(
    small_images=True,
    n_camera_views=12,
    n_laser_poses=8,
    axis_step_deg=4.0,
    n_artifact_frames=20,
    n_part_frames=12,
    n_complex_frames=72,
    budget=BudgetEffort(20, 10, ("ball",), (3,), with_images=False),
)


@dataclass(frozen=True)
class Part:
    """A part of tables 3 to 5: its names here and in the rig file, and what is measured in it."""

    name: str
    in_rig_file: str
    feature: str
    key: str


PARTS = (
    Part("ball", "ball", "sphere", "diameter"),
    Part("cylinder", "rod", "cylinder", "diameter"),
    Part("groove", "groove", "groove", "depth"),
)


COMPLEX_TITLES = {
    "bust": "Bust",
    "casting_with_flash": "Casting with flash",
    "rubber_model": "Rubber model",
    "thread_connector": "Pipe connector with a thread",
}
"""The parts of figure 16, by their name in :mod:`rotaline.simulation.parts.complex_parts`."""

_PHOTO_ANGLE_DEG, _PHOTO_LIGHT = 20.0, 0.8


def article_rig(small_images: bool) -> RigFile:
    """The rig of section 5.1; with ``small_images`` a quarter of the pixels see the same."""
    rig_file = read_preset("article")
    return quick_look(rig_file) if small_images else rig_file


def mount_names() -> tuple[str, ...]:
    """W1 to W5."""
    return tuple(f"W{k + 1}" for k in range(N_MOUNTS))


def session_plans(rig_file: RigFile, effort: Effort, seed: int) -> Mapping[str, SessionPlan]:
    """The sessions by name: ``sensor``, ``W1`` to ``W5``, and one for each part of tables 3 to 5.

    Targets and parts are those of the rig file. Captures have names of their own, so that captures of several sessions can be
    processed together.

    Raises
    ------
    RigError
        If a target does not fit into the view.
    """
    rig, tables = rig_file.rig(), rig_file.tables
    checkerboard, dots = plate_of(tables.targets["checkerboard"]), plate_of(tables.targets["dots"])
    targets: dict[str, Target | SteppedCylinder] = {
        "checkerboard": checkerboard.target,
        "dots": dots.target,
        "stepped-cylinder": STEPPED_CYLINDER,
    }
    sensor = (
        camera_capture(rig, checkerboard, "checkerboard", effort.n_camera_views, seed),
        laser_capture(rig, dots, "dots", effort.n_laser_poses, seed),
    )
    plans = {"sensor": SessionPlan(targets, sensor, seed=seed)}
    mounts = _stands(N_MOUNTS, 2.0, 6.0, seed, MOUNT_SEED)
    shape, turn = shape_of(tables.parts["stepped-cylinder"]), full_turn(effort.n_artifact_frames)
    for k, (name, stand) in enumerate(zip(mount_names(), mounts, strict=True)):
        stepped = scan_capture(
            rig, shape, stand, turn, folder=f"stepped-{name}", role="artifact", target="stepped-cylinder"
        )
        axis = board_on_table(rig, checkerboard, f"axis-{name}", effort, k, seed)
        plans[name] = SessionPlan(targets, (axis, stepped), seed=seed + k + 1)
    for p, part in enumerate(PARTS):
        shape = shape_of(tables.parts[part.in_rig_file])
        stands = _stands(N_MOUNTS, 0.5, 5.0, seed, POSITION_SEED, p)
        captures = tuple(
            scan_capture(rig, shape, stand, full_turn(effort.n_part_frames), folder=f"{part.name}-{k + 1}")
            for k, stand in enumerate(stands)
        )
        plans[part.name] = SessionPlan(targets, captures, seed=seed + 100 + p)
    return plans


def complex_plans(rig: Rig, parts: Mapping[str, ComplexPart], effort: Effort, seed: int) -> Mapping[str, SessionPlan]:
    """A session for each part of figure 16: the scan, and one frame with the light on."""
    plans = {}
    for p, (name, part) in enumerate(parts.items()):
        scan = scan_capture(rig, part.shape, mount(1.2, -0.8, 15.0), full_turn(effort.n_complex_frames), folder=name)
        photo = laser_on(rig, _PHOTO_LIGHT, angle_deg=_PHOTO_ANGLE_DEG, on_table=scan.shots[0].on_table)
        captures = (scan, CapturePlan(f"{name}-photo", "scan", None, (photo,)))
        plans[name] = SessionPlan({}, captures, seed=seed + 200 + p)
    return plans


def _stands(n: int, nearest_mm: float, farthest_mm: float, *seed: int) -> list[RigidTransform]:
    """Places of a part that is put down anew each time: flat on the table, off centre by a random distance, turned anyhow."""
    rng = np.random.default_rng(seed)
    stands = []
    for _ in range(n):
        radius_mm, azimuth_rad, turn_deg = rng.uniform((nearest_mm, 0.0, 0.0), (farthest_mm, 2 * np.pi, 360.0))
        x_mm, y_mm = radius_mm * np.cos(azimuth_rad), radius_mm * np.sin(azimuth_rad)
        stands.append(mount(float(x_mm), float(y_mm), float(turn_deg)))
    return stands


def board_on_table(rig: Rig, board: Plate, folder: str, effort: Effort, k: int, seed: int) -> CapturePlan:
    """The checkerboard on the table, put down anew for mount k: shifted by up to 1.5 mm and turned by up to 2 deg."""
    rng = np.random.default_rng([seed, MOUNT_SEED, 100 + k])
    n = round(AXIS_RANGE_DEG / effort.axis_step_deg) + 1
    angles = tuple(effort.axis_step_deg * i for i in range(n))
    capture = axis_capture(rig, board, "checkerboard", angles, folder=folder)
    x_mm, y_mm = rng.uniform(-1.5, 1.5, 2)
    turned = Rotation.from_rotvec([0.0, 0.0, np.radians(rng.uniform(-2.0, 2.0))])
    moved = RigidTransform.from_components([x_mm, y_mm, 0.0], turned)
    shots = tuple(replace(s, on_table=(s.on_table[0].moved(moved), *s.on_table[1:])) for s in capture.shots)
    return replace(capture, shots=shots)
